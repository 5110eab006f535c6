"""Whether parts of the data agree on the companion: V² and closure phases, files, epochs.

At the best fit of all data together each part asks for a change of the companion's parameters,
its own star and background free. What the parts gain in χ² by going their own ways, over going
one way, is the test; its probability is the share of data sets drawn from the model and its
noise whose parts go as far apart. To first order in the changes: the same for the data and for
the draws.

The target calibrated with one calibrator, and with the others, are no parts of the data: they
have the target's noise in common, which is in neither side of the comparison. What the two differ
by is what the calibrators differ by, and draws of these are its test.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from amibayes.calibration.leave_one_out import Comparison, LeftOut, leave_out
from amibayes.calibration.matching import Keys, keys_of
from amibayes.calibration.transfer import Diameter
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import Observables
from amibayes.detection.null_draws import pieces_of
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.residuals import files_of
from amibayes.models.binary import BinaryModel
from amibayes.parallel import spawn
from amibayes.support.options import ALPHA
from amibayes.units import BoolArray, FloatArray

Split = Literal["observables", "files", "epochs", "calibrators"]

EPOCH_GAP_DAYS = 0.5
"""Data further apart in time are of two nights."""

SIMULATIONS = 4000
"""Draws: a probability of 0.0013 is then known to 45 %."""

MAX_PARTS = 12
"""Parts of a split that are compared: each is searched by itself."""

DRAWS_PER_RATE = 2.0
"""Draws of each comparison in units of their number over α: the verdict shares α between them."""

ENOUGH = 100
"""Draws as extreme as the data after which no more are made: p is known to 10 % (Besag & Clifford
1991)."""

SINGULAR = 1e-10
"""Directions that a part measures so much worse than its best one it does not measure."""


@dataclass(frozen=True)
class Consistency:
    """How far the parts of a split go apart.

    Parameters
    ----------
    split : {"observables", "files", "epochs", "calibrators"}
    parts : tuple of str
    delta_chi2 : float
        Gain in χ² of the parts apart over the parts together.
    p : float
        Share of simulated data sets that go as far apart.
    """

    split: Split
    parts: tuple[str, ...]
    delta_chi2: float
    p: float


def consistency(
    result: SearchResult,
    rng: np.random.Generator,
    *,
    stated: Observables | None = None,
    prior: NoisePrior | None = None,
    calibrators: Sequence[tuple[Observables, Diameter]] = (),
    alpha: float = ALPHA,
) -> tuple[Consistency, ...]:
    """Compare all the parts that the data of a search have.

    Parameters
    ----------
    result : SearchResult
        Its best fit has a companion.
    rng : numpy.random.Generator
    stated : Observables, optional
        The data with their stated errors: each file and each night then has the noise that its
        own best fit leaves. The noise of a joint fit would hide that they disagree.
    prior : NoisePrior, optional
        Of that noise.
    calibrators : sequence of (Observables, (diameter, error))
        That the data were calibrated with, exchangeable with each other.
    alpha : float
        Probability that the verdict asks for, of all comparisons together.
    """
    own_rng = np.random.default_rng(spawn(rng, 1)[0])
    whole, theta = result.likelihood, result.theta
    data = whole.observables
    files = {f.source: np.concatenate([f.vis2, f.closure_phase]) for f in files_of(data)}
    found = []
    every: list[tuple[Split, dict[str, BoolArray]]] = [
        ("observables", _kinds(data)),
        ("files", files),
        ("epochs", _epochs(data)),
    ]
    splits = [(name, parts) for name, parts in every if 1 < len(parts) <= MAX_PARTS]
    wanted = int(DRAWS_PER_RATE * (len(splits) + len(calibrators)) / alpha)
    simulations = max(SIMULATIONS, wanted)
    known: dict[bytes, Likelihood] = {}  # one file a night is one part of both splits
    for name, parts in splits:
        own = None
        if name != "observables":
            for mask in parts.values():
                if mask.tobytes() not in known:
                    known[mask.tobytes()] = _own_noise(result, mask, stated, prior)
            own = [known[mask.tobytes()] for mask in parts.values()]
        found.append(compare(whole, theta, name, parts, rng, simulations, own))
    apart = compare_calibrators(result, calibrators, own_rng, simulations)
    return (*found, *apart)


def _own_noise(
    result: SearchResult, mask: BoolArray, stated: Observables | None, prior: NoisePrior | None
) -> Likelihood:
    """Likelihood of a part with the noise of its own best fit, if it has data enough for one."""
    whole = result.likelihood
    if stated is None:
        return _selected(whole.observables, whole.model, mask)
    part = _selected(stated.unflagged(), whole.model, mask)
    field = result.grid.inner_mas, result.grid.outer_mas
    if part.n_independent <= len(part.parameters):
        return part
    return search_with_noise(part, field, prior=prior)[0].likelihood


def _selected(data: Observables, model: BinaryModel, mask: BoolArray) -> Likelihood:
    return Likelihood(data.select(mask[: data.n_vis2], mask[data.n_vis2 :]), model)


def _kinds(data: Observables) -> dict[str, BoolArray]:
    vis2 = np.arange(len(data.data)) < data.n_vis2
    return {name: mask for name, mask in (("vis2", vis2), ("cp", ~vis2)) if mask.any()}


def _epochs(data: Observables) -> dict[str, BoolArray]:
    """Nights, by their mean date."""
    mjd = np.concatenate([data.vis2.mjd, data.closure_phase.mjd])
    if not np.isfinite(mjd).all():
        return {}
    order = np.argsort(mjd, kind="stable")
    night = np.empty(len(mjd), dtype=np.intp)
    night[order] = np.cumsum(np.diff(mjd[order], prepend=mjd[order[:1]]) > EPOCH_GAP_DAYS)
    masks = [night == k for k in np.unique(night)]
    return {f"MJD {mjd[mask].mean():.3f}": mask for mask in masks}


@dataclass(frozen=True, eq=False)
class _Part:
    """What one part says of the companion's parameters.

    Parameters
    ----------
    mask : (n_data,) bool array
    rows : (n_independent, n_companion) float array
        Whitened derivatives by these, what star and background can do taken out.
    basis : (n_independent, n_nuisance) float array
        What these can do.
    likelihood : Likelihood
    """

    mask: BoolArray
    rows: FloatArray
    basis: FloatArray
    likelihood: Likelihood

    @classmethod
    def of(cls, part: Likelihood, theta: FloatArray, mask: BoolArray) -> _Part:
        jacobian, star = part.jacobian(theta), part.parameters.nuisance
        left, singular, _ = np.linalg.svd(_scaled(jacobian[:, star]), full_matrices=False)
        basis = left[:, singular > np.sqrt(SINGULAR)] if len(star) else np.empty((len(jacobian), 0))
        rows = np.delete(jacobian, star, axis=1)
        return cls(mask, rows - basis @ (basis.T @ rows), basis, part)

    def project(self, residual: FloatArray) -> FloatArray:
        """Whitened residuals (n_independent, n) of data (n_data, n), star and background out."""
        white = self.likelihood.noise.whiten(residual[self.mask])
        return np.asarray(white - self.basis @ (self.basis.T @ white))

    @cached_property
    def fisher(self) -> FloatArray:
        """Information on the companion's parameters, (n_companion, n_companion)."""
        return np.asarray(self.rows.T @ self.rows)

    def slopes_of_noise(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Slopes of χ² (n_companion, n) by Gaussian noise: the information is their covariance."""
        values, vectors = np.linalg.eigh(self.fisher)
        scatter = vectors * np.sqrt(np.maximum(values, 0.0))
        return np.asarray(scatter @ rng.standard_normal((len(values), n)))


def _scaled(columns: FloatArray) -> FloatArray:
    length = np.linalg.norm(columns, axis=0)
    return np.asarray(columns / np.where(length > 0.0, length, 1.0))


def compare(
    likelihood: Likelihood,
    theta: FloatArray,
    split: Split,
    parts: dict[str, BoolArray],
    rng: np.random.Generator,
    simulations: int = SIMULATIONS,
    own: Sequence[Likelihood] | None = None,
) -> Consistency:
    """Compare some parts of the data.

    Parameters
    ----------
    likelihood : Likelihood
        Of all data.
    theta : (n_dim,) float array
        Its best fit.
    split : str
    parts : dict of str to (n_data,) bool array
    rng : numpy.random.Generator
    simulations : int
    own : sequence of Likelihood, optional
        Of the parts, with noise of their own.
    """
    data, model, masks = likelihood.observables, likelihood.model, list(parts.values())
    each = own or [_selected(data, model, mask) for mask in masks]
    made = [_Part.of(one, theta, mask) for one, mask in zip(each, masks, strict=True)]
    ratio, gain = _apart(made, likelihood.difference(np.atleast_2d(theta)))
    gaussian = all(np.isinf(one.degrees) for one in each)
    above = made_draws = 0
    for n in pieces_of(simulations, len(theta) if own and gaussian else len(data.data)):
        if own and gaussian:
            by_noise = _gain_apart(made, [part.slopes_of_noise(n, rng) for part in made])
        else:
            noise = likelihood.noise.draw(n, rng)
            for one, mask in zip(own or (), masks, strict=False):
                noise[mask] = one.noise.draw(n, rng)
            drawn, by_noise = _apart(made, noise)
        # What a part cannot explain by itself is no excuse for going apart, once its noise is
        # known.
        above += int(((by_noise >= gain[0]) if own else (drawn >= ratio[0])).sum())
        made_draws += n
        if above >= ENOUGH:
            break
    return Consistency(split, tuple(parts), float(gain[0]), (1 + above) / (1 + made_draws))


OTHERS = "the other calibrators"


def compare_calibrators(
    result: SearchResult,
    calibrators: Sequence[tuple[Observables, Diameter]],
    rng: np.random.Generator,
    simulations: int = SIMULATIONS,
) -> tuple[Consistency, ...]:
    """Compare the target calibrated with each calibrator, and with the others; the worst first.

    Either way the noise of the target is the same: what the two differ by, to first order, is
    what the calibrators differ by. The test is the gain in χ² of that difference by a companion of
    its own, with the calibrators' errors and the scatter between the others; as that scatter is a
    fitted one, the gain counts relative to the χ² of the others about their mean. Two calibrators
    are one comparison, relative to the rest of what they differ by. The weights are not those of
    the fit, whose errors hold how far the calibrators lie apart.

    Parameters
    ----------
    result : SearchResult
        Of the calibrated target.
    calibrators : sequence of (Observables, (diameter, error))
        Those that the target was calibrated with, and their uniform discs in mas.
    rng : numpy.random.Generator
    simulations : int
        Draws of the calibrators.
    """
    keys, found = keys_of(result.likelihood.observables), []
    star = result.likelihood.parameters.nuisance
    names = _names([c.source for c, _ in calibrators])
    for k, name in enumerate(names[:1] if len(names) == 2 else names):
        apart = leave_out(k, calibrators, keys)
        if apart is None:
            continue
        templates = _templates(result.likelihood, result.theta, keys, apart)
        comparison = apart.against(templates, star)
        gain = _difference(comparison, apart.measured)
        ratio = gain / _scale(apart, comparison, apart.measured, gain)
        above = made = 0
        for n in pieces_of(simulations, apart.n_independent * (1 + apart.n_others)):
            drawn = apart.draw(n, rng)
            by_noise = _difference(comparison, drawn)
            above += int((by_noise >= ratio * _scale(apart, comparison, drawn, by_noise)).sum())
            made += n
            if above >= ENOUGH:
                break
        parts = name, (names[1] if len(names) == 2 else OTHERS)
        found.append(Consistency("calibrators", parts, float(gain[0]), (1 + above) / (1 + made)))
    return tuple(sorted(found, key=lambda one: (one.p, -one.delta_chi2)))


def _names(sources: Sequence[str]) -> list[str]:
    """File names, or numbers where these do not tell them apart."""
    names = [Path(source).name for source in sources]
    return [n if names.count(n) == 1 else f"calibrator {k + 1}" for k, n in enumerate(names)]


def _templates(likelihood: Likelihood, theta: FloatArray, keys: Keys, apart: LeftOut) -> FloatArray:
    """Change of the response with the effect of a unit change of each parameter, (p, n_keys).

    V² is divided by the response, closure phases have it taken off. Data of one key are averaged
    by their variances: the response is the same in all of them.
    """
    data = likelihood.observables
    n, slope = data.n_vis2, -keys.sign.astype(float)
    response = apart.response[keys.key[:n]]
    model = likelihood.predict(np.atleast_2d(theta))[:n, 0]
    slope[:n] = -model / np.where(response > 0.0, response, np.inf)
    weight = slope / data.covariance.variance
    whole = np.bincount(keys.key, weight * slope, len(keys))
    change = [np.bincount(keys.key, weight * j, len(keys)) for j in likelihood.slopes(theta).T]
    return np.where(apart.keys & (whole > 0.0), change / np.where(whole > 0.0, whole, 1.0), 0.0)


def _difference(comparison: Comparison, seen: Sequence[FloatArray]) -> FloatArray:
    """χ² (n,) of what the parameters differ by."""
    scale = np.sqrt(np.diag(comparison.covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    return _gain(comparison.covariance, comparison.score(seen).T, scale)


def _scale(
    apart: LeftOut, comparison: Comparison, seen: Sequence[FloatArray], gain: FloatArray
) -> FloatArray:
    """Mean square (n,) of what scatters about the mean as the noise does."""
    if apart.n_others > 1:
        return comparison.scatter(seen) / (apart.n_independent * (apart.n_others - 1))
    left = max(apart.n_independent - len(comparison.covariance), 1)
    return np.asarray(np.maximum(comparison.whole(seen) - gain, 1e-300) / left)


def _apart(parts: Sequence[_Part], residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gain of the parts apart over the rest of χ², and the gain itself, (n,) each.

    The ratio does not depend on the scale of the noise.
    """
    white = [part.project(residual) for part in parts]
    gain = _gain_apart(parts, [part.rows.T @ w for part, w in zip(parts, white, strict=True)])
    chi2 = np.sum([(w**2).sum(axis=0) for w in white], axis=0)
    return np.asarray(gain / np.maximum(chi2 - gain, 1e-300)), gain


def _gain_apart(parts: Sequence[_Part], slope: Sequence[FloatArray]) -> FloatArray:
    """Gain in χ² (n,) of the parts apart over together, of their slopes (n_companion, n)."""
    fisher = [part.fisher for part in parts]
    scale = np.sqrt(np.diag(np.sum(fisher, axis=0)))
    scale = np.where(scale > 0.0, scale, 1.0)
    each = [_gain(f, s, scale) for f, s in zip(fisher, slope, strict=True)]
    together = _gain(np.sum(fisher, axis=0), np.sum(slope, axis=0), scale)
    return np.asarray(np.maximum(np.sum(each, axis=0) - together, 0.0))


def _gain(fisher: FloatArray, slope: FloatArray, scale: FloatArray) -> FloatArray:
    """Gain in χ² of the best change of the parameters, (n,)."""
    inverse = np.linalg.pinv(fisher / np.outer(scale, scale), rcond=SINGULAR, hermitian=True)
    unit = slope / scale[:, None]
    return np.asarray((unit * (inverse @ unit)).sum(axis=0))
