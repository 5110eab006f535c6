"""Stars without a companion that fit the data as well as one with a companion.

The null hypothesis of a search is one disc, alike at all wavelengths. Data of real stars may ask
for more and need no companion: molecules make cool giants larger in some channels than in others,
and discs and shells surround hot stars. Both have point symmetry, so that their closure phases are
0 or 180°: where those of the data are not, nothing needs to be fitted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.optimize import least_squares
from scipy.stats import chi2 as chi2_law

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.optimise import fit_single
from amibayes.companion_search.result import SearchResult
from amibayes.likelihood.chi2 import chi2_of_part
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.extended import Extended
from amibayes.models.limb_darkening import power_law_disc
from amibayes.units import FloatArray, IntArray

CLEARLY = 10.0
"""Δχ² by which a companion is the better explanation: odds of 150 to 1, before they pay for the
choice among the field's positions."""

LOW_CHI2 = 0.05
"""Probability of so low a χ² by which stated errors are too large."""

MAX_NODES = 32
"""Wavelengths at which a diameter is free, linear in between; all channels' if there are fewer."""

LARGEST_CHANGE = 1.6
"""Ratio of diameters at two wavelengths that single stars are known to have: 1.4 of a Mira from 1.3
to 2.3 µm (Wittkowski et al. 2008, A&A 479, L21), with room for their errors."""

STEPS = 40
"""Evaluations of the Jacobian: a fit from the grey star's diameter takes 5 to 20."""

LEAST_AXES = 0.3
"""Least ratio of an elongated star's axes: what two stars in contact look like is longer."""

OVAL_SIZES, OVAL_ANGLES, OVAL_AXES = 32, 12, np.log([0.5, 0.65, 0.8, 0.92])
OVAL_FITS = 6
"""Sizes, angles and ratios of the axes that are tried, and fits that are finished."""

EDGE = 1e-6
"""How far inside of its bounds a fit begins."""

LADDER = np.linspace(0.94, 1.06, 121)
"""Factors that are tried of the diameter at one wavelength: where a baseline is at a null its
closure phases turn by 180° at once, and a fit by slopes does not see the other side."""

AT_ONCE = 16
"""Factors whose models are in memory together."""

FINE = 0.01
"""Step of ln of the diameter that all wavelengths are tried with: a twentieth of a lobe of the
visibility of a star that is seen past four nulls."""

STEP = 1e-6
"""Change of a diameter, relative, that its slopes are taken of."""


@dataclass(frozen=True)
class Alternative:
    """A point-symmetric source that fits as well as a star with a companion.

    Parameters
    ----------
    kind : {"chromatic star", "elongated star", "extended light"}
    chi2 : float
        With the noise of the search, and 1 more for each parameter beyond those of the companion's
        model: so much a parameter takes of noise. Less where the stated errors are too large.
    words : str
        What it is, for the reason of a verdict.
    plausible : bool
        Whether single stars of the kind are known.
    """

    kind: str
    chi2: float
    words: str
    plausible: bool = True


def alternative(result: SearchResult) -> Alternative | None:
    """One of these sources that fits nearly as well as the best companion does, or None.

    Parameters
    ----------
    result : SearchResult
        With its noise. Data without V² or closure phases have no alternative.
    """
    likelihood = result.likelihood
    most = result.chi2_binary + CLEARLY * _too_large(result)
    data = likelihood.observables
    both = 0 < data.n_vis2 < len(data.data)
    if not both or symmetric_chi2(likelihood) > most:
        return None
    star = _chromatic_star(likelihood, result)
    if star is not None and star.chi2 <= most:
        return star
    others = (_extended_light(likelihood, result), _elongated_star(likelihood, result))
    best = min(others, key=lambda other: other.chi2)
    return best if best.chi2 <= most else None


def _too_large(result: SearchResult) -> float:
    """χ² per datum where the stated errors are larger than chance allows, else 1.

    A detection is told by residuals of any size, and differences of models must be as well: of
    companions near the limit half were said to be light around the star where the stated errors
    were twice too large.
    """
    return min(1.0, result.chi2_binary / float(chi2_law.ppf(LOW_CHI2, result.ndof)))


def _noise_of(parameters: int, result: SearchResult) -> float:
    """χ² that some more parameters take of noise."""
    return _too_large(result) * max(parameters, 0)


def symmetric_chi2(likelihood: Likelihood) -> float:
    """χ² that closure phases leave at least with any point-symmetric source, its V² free.

    Each phase is compared with the nearer one of 0 and 180°, kernel phases with 0. (With
    correlated errors another choice may be better by the square of one error or so.)
    """
    data = likelihood.observables
    nearest = likelihood.wrapped(2.0 * data.data) / 2.0
    closure = np.arange(data.n_vis2, len(data.data))
    nearest[: data.n_vis2] = 0.0
    return chi2_of_part(likelihood.noise.covariance, closure, nearest)[0]


@dataclass(frozen=True, eq=False)
class ChromaticStar:
    """A star with a diameter of its own at several wavelengths, linear in between.

    Parameters
    ----------
    likelihood : Likelihood
        Of the star alone.
    nodes : (n_nodes,) float array
        The wavelengths, m.
    limb_darkening, background : float
        Those of the best fit of the search.
    """

    likelihood: Likelihood
    nodes: FloatArray
    limb_darkening: float
    background: float

    @cached_property
    def share(self) -> FloatArray:
        """What part of the diameter of each datum is that of each node, (n_data, n_nodes)."""
        data = self.likelihood.observables
        wavelengths = np.concatenate([data.vis2.wavelength_m, data.closure_phase.wavelength_m])
        return np.array(
            [np.interp(wavelengths, self.nodes, one) for one in np.eye(len(self.nodes))]
        ).T

    @cached_property
    def error(self) -> FloatArray:
        """Standard deviation of each datum, (n_data,)."""
        return np.sqrt(self.likelihood.noise.covariance.variance)

    def difference(self, diameters: FloatArray) -> FloatArray:
        """Data minus model (n_data, n) for diameters at the nodes (n_nodes, n), mas."""
        points = self.likelihood.samples
        wavelengths = np.asarray(points.wavelength_m)
        at = np.array([np.interp(wavelengths, self.nodes, one) for one in diameters.T]).T
        exponent = np.array(self.limb_darkening)
        wave = power_law_disc(points.frequency[:, None], at, exponent) / (1.0 + self.background)
        return self.likelihood.difference_from(self.likelihood.observe(wave.astype(complex)))

    def slopes(self, diameters: FloatArray) -> FloatArray:
        """Derivative (n_data, n_nodes) of `difference`, of one star (n_nodes,).

        A datum knows the diameter at its own wavelength alone: one more star gives all columns.
        """
        here, there = self.difference(np.outer(diameters, [1.0, 1.0 + STEP])).T
        moved = self.likelihood.wrapped(there - here) / (STEP * self.share @ diameters)
        return moved[:, None] * self.share

    def near(self, sizes: FloatArray) -> FloatArray:
        """Diameters (n_nodes,) that suit the data near each node best, among ``sizes``.

        Then one by one past nulls of baselines, every other node at once: no datum knows two of
        them. Errors count as independent; a phase on the wrong side of a null is off by 180°.
        """
        every = np.ones((len(self.nodes), 1))
        best = sizes[self._best(every * sizes, self.share)]
        for parity in (0, 1, 0, 1):
            group = np.arange(parity, len(best), 2)
            tried = np.repeat(best[:, None], len(LADDER), axis=1)
            tried[group] *= LADDER
            best[group] *= LADDER[self._best(tried, (self.share[:, group] > 0.0).astype(float))]
        return best

    def _best(self, tried: FloatArray, weight: FloatArray) -> IntArray:
        """Which of some stars (n_nodes, n) has the least χ² with each weight (n_data, k), (k,)."""
        loss = [
            (self.difference(few) / self.error[:, None]).T ** 2 @ weight
            for few in np.array_split(tried, 1 + tried.shape[1] // AT_ONCE, axis=1)
        ]
        return np.asarray(np.concatenate(loss).argmin(axis=0))


def _diameters(result: SearchResult) -> FloatArray:
    """Of the star with its companion, and alone, where they are seen, mas.

    A companion makes the star another one where it stands for changes with wavelength.
    """
    alone = result.star_alone().get("diameter_mas", (0.0, 0.0))[0]
    both = np.array([result.nuisance("diameter_mas"), alone])
    return both[both > 0.0]


def _chromatic_star(likelihood: Likelihood, result: SearchResult) -> Alternative | None:
    """A star with a diameter of its own at several wavelengths."""
    coloured = likelihood.with_model(
        replace(likelihood.model, companions=0, contrast_slope="free", surroundings=())
    )
    channels, grey = np.unique(np.asarray(coloured.samples.wavelength_m)), _diameters(result)
    if len(channels) < 3 or not len(grey):
        return None
    nodes = np.linspace(channels[0], channels[-1], min(MAX_NODES, len(channels)))
    star = ChromaticStar(
        coloured, nodes, result.nuisance("limb_darkening"), result.nuisance("background")
    )

    def white(diameters: FloatArray) -> FloatArray:
        return likelihood.noise.whiten(star.difference(diameters[:, None])[:, 0])

    def slopes(diameters: FloatArray) -> FloatArray:
        return likelihood.noise.whiten(star.slopes(diameters))

    bounds = 0.3 * grey.min(), 3.0 * grey.max()
    n_sizes = int(np.ceil(np.log(bounds[1] / bounds[0]) / FINE)) + 1
    start = np.clip(star.near(np.geomspace(*bounds, n_sizes)), *bounds)
    fit = least_squares(white, start, slopes, bounds=bounds, max_nfev=STEPS)
    more = _noise_of(len(nodes) - len(result.theta), result)
    words = (
        f"a star whose diameter changes with wavelength, from {fit.x.min():.4g} to "
        f"{fit.x.max():.4g} mas"
    )
    plausible = bool(fit.x.max() <= LARGEST_CHANGE * fit.x.min())
    return Alternative("chromatic star", 2.0 * float(fit.cost) + more, words, plausible)


def _elongated_star(likelihood: Likelihood, result: SearchResult) -> Alternative:
    """An elliptical disc, uniform or darkened as the star of the search is."""
    data, points = likelihood.observables, likelihood.samples
    exponent, background = (result.nuisance(name) for name in ("limb_darkening", "background"))
    error = np.sqrt(likelihood.noise.covariance.variance[: data.n_vis2])

    def difference(shapes: FloatArray) -> FloatArray:
        """Data less those of ln of the larger diameter, ln of the axes' ratio, angle (3, n)."""
        sine, cosine = np.sin(shapes[2]), np.cos(shapes[2])
        along = points.u[:, None] * sine + points.v[:, None] * cosine
        across = (points.u[:, None] * cosine - points.v[:, None] * sine) * np.exp(shapes[1])
        wave = power_law_disc(np.hypot(along, across), np.exp(shapes[0]), np.array(exponent))
        model = likelihood.observe((wave / (1.0 + background)).astype(complex))
        return likelihood.difference_from(model)

    def by_vis2(shape: FloatArray) -> FloatArray:
        return np.asarray(difference(shape[:, None])[: data.n_vis2, 0] / error)

    def white(shape: FloatArray) -> FloatArray:
        return np.asarray(likelihood.noise.whiten(difference(shape[:, None])[:, 0]))

    # Two stars that are nearly one are as long as they are apart.
    largest = max(result.nuisance("diameter_mas"), result.companion.separation_mas)
    sizes = np.log(largest * np.geomspace(0.5, 3.0, OVAL_SIZES))
    angles = np.linspace(0.0, np.pi, OVAL_ANGLES, endpoint=False)
    starts = []
    for axes, angle in product(OVAL_AXES, angles):
        tried = np.array([sizes, np.full(OVAL_SIZES, axes), np.full(OVAL_SIZES, angle)])
        loss = ((difference(tried)[: data.n_vis2] / error[:, None]) ** 2).sum(axis=0)
        starts.append((float(loss.min()), tried[:, loss.argmin()]))
    starts = sorted(starts, key=lambda start: start[0])[:OVAL_FITS]
    low = [sizes[0] - np.log(1e2), np.log(LEAST_AXES), -np.inf]
    high = [sizes[-1] + np.log(1e2), 0.0, np.inf]
    fits = []
    for _, start in starts:
        near = least_squares(by_vis2, start, bounds=(low, high), max_nfev=STEPS).x
        near = np.clip(near, np.add(low, EDGE), np.subtract(high, EDGE))
        fits.append(least_squares(white, near, bounds=(low, high), max_nfev=STEPS))
    fit = min(fits, key=lambda one: float(one.cost))
    size, axes = np.exp(fit.x[:2])
    words = f"an elongated star (axes of {size:.4g} and {size * axes:.4g} mas)"
    more = _noise_of(3 - len(result.theta), result)
    return Alternative("elongated star", 2.0 * float(fit.cost) + more, words)


def _extended_light(likelihood: Likelihood, result: SearchResult) -> Alternative:
    """An inclined Gaussian disc around the star."""
    disc = Extended("gaussian", "halo", smearing=likelihood.model.smearing)
    around = (*likelihood.model.surroundings, disc)
    model = replace(likelihood.model, companions=0, surroundings=around)
    wide = likelihood.with_model(model)
    theta, chi2 = fit_single(wide)
    found = dict(zip(wide.parameters.names, theta, strict=True))
    size = found[f"halo_{disc.size}"]
    ratio = size / resolution_mas(likelihood)
    words = (
        f"light around the star (an inclined disc of {size:.3g} mas, {ratio:.2g} λ/B, "
        f"{100.0 * found['halo_flux']:.3g} % of the star's light)"
    )
    more = _noise_of(len(theta) - len(likelihood.parameters), result)
    return Alternative("extended light", chi2 + more, words)
