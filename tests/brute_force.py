"""Binaries seen by five instruments, and brute force: fits of the same model from many points.

The fits share nothing with the search but the model: their starting points are drawn at random,
their optimiser is that of Levenberg and Marquardt, written here for many starts at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from helpers import niriss

from amibayes.companion_search.field import default_separation, outermost, resolution_mas
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel
from amibayes.units import FloatArray

AT = np.array([[0.0, 0.0], [52.0, 18.0], [10.0, 112.0], [-44.0, 66.0]])
UT = np.array([[0.0, 0.0], [25.0, 51.0], [55.0, 86.0], [113.0, 64.0]])
CHARA = np.array([[0, 0], [-8, 34], [125, 306], [70, 270], [-176, 216], [-69, 200]], dtype=float)

COVERAGES = ("pionier", "gravity", "mirc4t", "mirc6t", "niriss")

DRAWN = 40_000
"""At most so many points of which the best are fitted: some ten for each (λ/B_max)² of the widest
field."""

ROUNDS, KEPT = (5, 8, 30), (0.25, 0.1)
"""Steps of the fits, and which part of them goes on after the first and the second round."""


def exposures(
    stations: FloatArray, wavelengths: FloatArray, turns: tuple[float, ...], errors: tuple
) -> Observables:
    """Several exposures of an array that the sky turns over, narrow channels, no noise."""
    band = float(np.diff(wavelengths).mean())
    parts = []
    for k, turn in enumerate(turns):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        turned = stations @ np.array([[c, -s], [s, c]]) * (1.0 - 0.04 * k)
        parts.append(
            point_source(
                turned, wavelengths, band, vis2_error=errors[0], closure_error_rad=errors[1]
            )
        )
    return join(parts)


def coverage(name: str, vis2_error: float, closure_error_rad: float) -> Observables:
    """One of the five coverages."""
    errors = vis2_error, closure_error_rad
    if name == "niriss":
        return niriss(vis2_error, float(np.degrees(closure_error_rad)))
    stations, wavelengths, turns = {
        "pionier": (AT, np.linspace(1.53e-6, 1.77e-6, 4), (0.0, 20.0, 45.0)),
        "gravity": (UT, np.linspace(2.0e-6, 2.4e-6, 8), (0.0, 25.0)),
        "mirc4t": (CHARA[[0, 2, 4, 5]], np.linspace(1.5e-6, 1.75e-6, 6), (0.0, 30.0)),
        "mirc6t": (CHARA, np.linspace(1.5e-6, 1.75e-6, 4), (0.0,)),
    }[name]
    return exposures(stations, wavelengths, turns, errors)


@dataclass(frozen=True)
class Case:
    """Noisy data of one binary, and the field (inner, outer) in mas that is searched."""

    likelihood: Likelihood
    truth: FloatArray
    field: tuple[float, float]


def case(name: str, seed: int, *, smeared: bool = False, disc: bool = False) -> Case:
    """A binary drawn at random, its contrast log-uniform between 0.001 and 1.

    Parameters
    ----------
    name : str
    seed : int
    smeared : bool
        The field goes to where a channel smears a companion out, and its separation is
        log-uniform; else to λ/B of the shortest baseline, and uniform in area.
    disc : bool
        The companion's diameter is free, and every other companion is resolved.
    """
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    errors = 10.0 ** rng.uniform(-2.7, -1.3), 10.0 ** rng.uniform(-2.7, -1.3)
    sheet = coverage(name, *errors)
    point = name == "niriss"
    free = Likelihood(sheet, BinaryModel(diameter_mas="free", companion_diameter_mas="free"))
    inner, outer = default_separation(free)
    outer = outermost(free) if smeared else outer
    part, angle = rng.uniform(), rng.uniform(0.0, 2.0 * np.pi)
    even = np.sqrt(inner**2 + part * (outer**2 - inner**2))
    rho = inner * (outer / inner) ** part if smeared else even
    contrast = 10.0 ** rng.uniform(-3.0, 0.0)
    resolved = not point and rng.random() < 0.5
    sizes = resolved * rng.uniform(0.2, 1.0), (disc and seed % 2) * rng.uniform(0.2, 1.0)
    truth = np.zeros(5)
    truth[:3] = rho * np.sin(angle), rho * np.cos(angle), contrast
    names = free.parameters.names
    both = names.index("diameter_mas"), names.index("companion_diameter_mas")
    truth[list(both)] = np.array(sizes) * resolution_mas(free)
    data = free.predict([truth])[:, 0] + sheet.covariance.draw(rng, 1)[:, 0]
    noisy = sheet.with_data(data)
    model = BinaryModel(
        diameter_mas=0.0 if point else "free", companion_diameter_mas="free" if disc else 0.0
    )
    fitted = Likelihood(noisy, model)
    kept = [k for k, parameter in enumerate(names) if parameter in fitted.parameters.names]
    return Case(fitted, truth[kept], (inner, outer))


def brute_force(case: Case, starts: int, rng: np.random.Generator) -> tuple[float, FloatArray]:
    """Least χ² of many fits, and where: from the truth, and from the best of random points.

    Of every interval of the contrast as many are fitted.
    """
    work = _Fits(case)
    drawn = work.points(min(DRAWN, 200 * starts), rng)
    parts = np.array_split(drawn, len(drawn) // 2000)
    chi2 = np.concatenate([case.likelihood.chi2(part) for part in parts])
    faint = np.floor(2.0 * np.log10(np.maximum(drawn[:, 2], 1.001e-3)))
    order = np.lexsort((chi2, faint))
    first = np.searchsorted(faint[order], np.unique(faint))
    each = starts // len(first) + 1
    chosen = np.concatenate([order[k : k + each] for k in first])
    theta = np.vstack([case.truth, drawn[chosen]])
    chi2 = np.inf
    for rounds, part in zip(ROUNDS, (*KEPT, 1.0), strict=True):
        theta, chi2 = work.fitted(theta, rounds)
        best = np.argsort(chi2)[: max(int(part * len(theta)), min(8, len(theta)))]
        theta, chi2 = theta[best], chi2[best]
    return float(chi2[0]), theta[0]


class _Fits:
    """Fits of many starts at once, inside the field and the ranges of the parameters."""

    def __init__(self, case: Case) -> None:
        self.likelihood, self.field = case.likelihood, case.field
        parameters = self.likelihood.parameters
        low, high = np.array(parameters.bounds(np.arange(len(parameters)))).T
        self.low, self.high = low.copy(), high.copy()
        self.low[:2], self.high[:2] = -case.field[1], case.field[1]
        self.discs = parameters.discs
        self.sizes = resolution_mas(self.likelihood)

    def points(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Points drawn over the field, contrasts from 0.001 to 1, discs to λ/B, (n, n_dim)."""
        inner, outer = self.field
        rho = np.sqrt(rng.uniform(inner**2, outer**2, n))
        angle = rng.uniform(0.0, 2.0 * np.pi, n)
        theta = np.zeros((n, len(self.low)))
        theta[:, :2] = np.column_stack([rho * np.sin(angle), rho * np.cos(angle)])
        theta[:, 2] = 10.0 ** rng.uniform(-3.0, 0.0, n)
        theta[:, self.discs] = rng.uniform(0.02, 1.0, (n, len(self.discs))) * self.sizes
        return theta

    def inside(self, theta: FloatArray) -> FloatArray:
        """The nearest points (n, n_dim) that are allowed."""
        near = np.clip(theta, self.low, self.high)
        rho = np.maximum(np.hypot(near[:, 0], near[:, 1]), 1e-9)
        near[:, :2] *= (np.clip(rho, *self.field) / rho)[:, None]
        return near

    def fitted(self, theta: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Points (n, n_dim) after steps of Levenberg and Marquardt, and their χ² (n,)."""
        theta = self.inside(theta)
        residuals = self.likelihood.residuals(theta)
        chi2 = (residuals**2).sum(axis=0)
        damping = np.full(len(theta), 1e-2)
        for _ in range(steps):
            slopes = self._slopes(theta)
            normal = np.einsum("mnp,mnq->npq", slopes, slopes)
            pull = np.einsum("mnp,mn->np", slopes, residuals)
            held = (theta <= self.low) & (pull < 0) | (theta >= self.high) & (pull > 0)
            normal *= ~held[:, :, None] & ~held[:, None, :]
            size = np.einsum("npp->np", normal)
            diagonal = np.einsum("npp->np", normal)
            diagonal += damping[:, None] * size + 1e-9 * size.max(axis=1)[:, None] + 1e-300
            step = np.linalg.solve(normal, (pull * ~held)[:, :, None])[:, :, 0]
            trial = self.inside(theta + step)
            left = self.likelihood.residuals(trial)
            better = (left**2).sum(axis=0)
            good = better < chi2
            theta[good], residuals[:, good], chi2[good] = trial[good], left[:, good], better[good]
            damping = np.where(good, damping / 5.0, damping * 4.0)
        return theta, chi2

    def _slopes(self, theta: FloatArray) -> FloatArray:
        """Whitened derivatives of the model of the data, (n_independent, n, n_dim)."""
        likelihood = self.likelihood
        value, slopes = likelihood.model.gradient(likelihood.samples, theta)
        shape = slopes.shape[1:]
        columns = []
        for slope in slopes:
            slope = np.broadcast_to(slope, shape)
            by_vis2 = likelihood.samples.squares @ (2.0 * (slope * value.conj()).real)
            by_phase = likelihood.samples.legs @ (slope / (value + 1e-30)).imag
            columns.append(likelihood.noise.whiten(np.concatenate([by_vis2, by_phase])))
        return np.stack(columns, axis=-1)


@dataclass(frozen=True)
class Compared:
    """The search beside brute force, for one case.

    Parameters
    ----------
    excess, check_excess : float
        By how much χ² of the search, and of its global check by NLopt alone, is above that of
        brute force.
    check_adopted : bool
        NLopt found a fit better by Δχ² 0.1 than any from the templates and the exact map.
    separation_mas, contrast : float
        Of the companion.
    """

    excess: float
    check_excess: float
    check_adopted: bool
    separation_mas: float
    contrast: float


def compared(case: Case, starts: int, rng: np.random.Generator) -> Compared:
    """Search, and fit by brute force; a star without companion is one of its fits."""
    result = search(case.likelihood, case.field)
    best, _ = brute_force(case, starts, rng)
    single = single_likelihood(case.likelihood).chi2(result.single_theta[None])[0]
    best = min(best, float(single))
    assert result.global_check is not None
    check = result.global_check.delta_chi2
    # The inner one of two aliases is reported, though the other may fit a little better.
    found = max(mode.delta_chi2 for mode in result.modes)
    return Compared(
        result.chi2_single - found - best,
        result.chi2_single - check - best,
        any("global optimiser" in warning for warning in result.warnings),
        float(np.hypot(*case.truth[:2])),
        float(case.truth[2]),
    )
