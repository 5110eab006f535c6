"""Whether parts of the data agree on the companion: V² and closure phases, files, epochs.

At the best fit of all data together each part asks for a change of the companion's parameters,
its own star and background free. What the parts gain in χ² by going their own ways, over going
one way, is the test; its probability is the share of data sets drawn from the model and its
noise whose parts go as far apart. To first order in the changes: the same for the data and for
the draws.

The target calibrated with one calibrator, and with the others, are no parts of the data: see
`amibayes.detection.calibrator_consistency`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.calibration.transfer import Diameter
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import Observables
from amibayes.detection.calibrator_consistency import compare_calibrators
from amibayes.detection.null_draws import pieces_of
from amibayes.detection.splits import (
    ENOUGH,
    SIMULATIONS,
    SINGULAR,
    Consistency,
    Split,
    gain_of,
)
from amibayes.likelihood.channel_noise import noise_with_channels
from amibayes.likelihood.chi2 import touched
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.residuals import files_of
from amibayes.models.binary import BinaryModel
from amibayes.parallel import spawn
from amibayes.support.options import ALPHA
from amibayes.units import BoolArray, FloatArray

EPOCH_GAP_DAYS = 0.5
"""Data further apart in time are of two nights."""

MAX_PARTS = 12
"""Parts of a split that are compared: each is searched by itself."""

DRAWS_PER_RATE = 2.0
"""Draws of each comparison in units of their number over α: the verdict shares α between them."""


def consistency(
    result: SearchResult,
    rng: np.random.Generator,
    *,
    noise: ExtraNoise | None = None,
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
    noise : ExtraNoise, optional
        That was fitted: what channels of an exposure share of it counts in the parts likewise.
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
        ("epochs", by_night(data)),
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
                    known[mask.tobytes()] = _own_noise(result, mask, noise, stated, prior)
            own = [known[mask.tobytes()] for mask in parts.values()]
        found.append(compare(whole, theta, name, parts, rng, simulations, own, noise))
    apart = compare_calibrators(result, calibrators, own_rng, simulations)
    return (*found, *apart)


def _own_noise(
    result: SearchResult,
    mask: BoolArray,
    noise: ExtraNoise | None,
    stated: Observables | None,
    prior: NoisePrior | None,
) -> Likelihood:
    """Likelihood of a part with the noise of its own best fit, if it has data enough for one."""
    whole = result.likelihood
    if stated is None:
        return _selected(whole.observables, whole.model, mask, noise)
    part = _selected(stated.unflagged(), whole.model, mask)
    field = result.grid.inner_mas, result.grid.outer_mas
    if part.n_independent <= len(part.parameters):
        return part
    return search_with_noise(part, field, prior=prior)[0].likelihood


def _selected(
    data: Observables, model: BinaryModel, mask: BoolArray, noise: ExtraNoise | None = None
) -> Likelihood:
    part = data.select(mask[: data.n_vis2], mask[data.n_vis2 :])
    shared = None if noise is None else noise_with_channels(part, noise.channels, noise.floors)
    return Likelihood(part, model, shared)


def _kinds(data: Observables) -> dict[str, BoolArray]:
    vis2 = np.arange(len(data.data)) < data.n_vis2
    return {name: mask for name, mask in (("vis2", vis2), ("cp", ~vis2)) if mask.any()}


def by_night(data: Observables) -> dict[str, BoolArray]:
    """Nights, by their mean date: masks (n_data,); empty where a date is unknown."""
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

    @cached_property
    def unexplained(self) -> int:
        """Number of independent data beyond what companion, star and background take."""
        scale = np.sqrt(np.maximum(np.diag(self.fisher), 1e-300))
        rank = np.linalg.matrix_rank(self.fisher / np.outer(scale, scale), SINGULAR, hermitian=True)
        return int(max(len(self.rows) - self.basis.shape[1] - rank, 0))

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
    noise: ExtraNoise | None = None,
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
    noise : ExtraNoise, optional
        As for `consistency`.
    """
    data, model, masks = likelihood.observables, likelihood.model, list(parts.values())
    each = own or [_selected(data, model, mask, noise) for mask in masks]
    made = [_Part.of(one, theta, mask) for one, mask in zip(each, masks, strict=True)]
    ratio, gain = _apart(made, likelihood.difference(np.atleast_2d(theta)))
    # A stated covariance may have V² and closure phases share errors: these are drawn together.
    together = not own and _share_errors(likelihood, masks)
    gaussian = all(np.isinf(one.degrees) for one in each) and not together
    above = made_draws = 0
    for n in pieces_of(simulations, len(theta) if gaussian else len(data.data)):
        if gaussian:
            drawn, by_noise = _apart_by_noise(made, n, rng)
        else:
            errors = likelihood.noise.draw(n, rng)
            for one, mask in zip(own or (), masks, strict=False):
                errors[mask] = one.noise.draw(n, rng)
            drawn, by_noise = _apart(made, errors)
        # What a part cannot explain by itself is no excuse for going apart, once its noise is
        # known.
        above += int(((by_noise >= gain[0]) if own else (drawn >= ratio[0])).sum())
        made_draws += n
        if above >= ENOUGH:
            break
    return Consistency(split, tuple(parts), float(gain[0]), (1 + above) / (1 + made_draws))


def _share_errors(likelihood: Likelihood, masks: Sequence[BoolArray]) -> bool:
    """Whether data of one part have errors in common with those of another."""
    both = (np.logical_and(*touched(likelihood.noise.covariance, mask)) for mask in masks)
    return any(shared.any() for shared in both)


def _apart(parts: Sequence[_Part], residual: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gain of the parts apart over the rest of χ², and the gain itself, (n,) each.

    The ratio does not depend on the scale of the noise: see `_ratio`.
    """
    white = [part.project(residual) for part in parts]
    slopes = [part.rows.T @ w for part, w in zip(parts, white, strict=True)]
    each, together = _gains(parts, slopes)
    gain = np.maximum(each - together, 0.0)
    chi2 = np.sum([(w**2).sum(axis=0) for w in white], axis=0)
    return _ratio(parts, gain, chi2 - each), gain


def _ratio(parts: Sequence[_Part], gain: FloatArray, rest: FloatArray) -> FloatArray:
    """Gain over the rest of χ² that no part can explain, (n,).

    What the companion of all data takes is no part of the rest: at the best fit it is taken, and
    draws of noise, about the truth, would have more of it. Errors with a floor are not smaller for
    data that do not show it: the rest then counts as no less than its expectation. Without a rest
    nothing tells the size of the noise, and the ratio is 0.
    """
    unexplained = sum(part.unexplained for part in parts)
    if not unexplained:
        return np.zeros_like(gain)
    floored = any(part.likelihood.noise.floor for part in parts)
    return np.asarray(gain / np.maximum(rest, unexplained if floored else 1e-300))


def _apart_by_noise(
    parts: Sequence[_Part], n: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """`_apart` of n data sets of Gaussian noise, from its slopes and what no parameter explains."""
    each, together = _gains(parts, [part.slopes_of_noise(n, rng) for part in parts])
    gain = np.maximum(each - together, 0.0)
    unexplained = sum(part.unexplained for part in parts)
    rest = rng.chisquare(unexplained, n) if unexplained else np.zeros(n)
    return _ratio(parts, gain, rest), gain


def _gains(parts: Sequence[_Part], slope: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Gain in χ² (n,) of the parts each for itself, and together, of slopes (n_companion, n)."""
    fisher = [part.fisher for part in parts]
    scale = np.sqrt(np.diag(np.sum(fisher, axis=0)))
    scale = np.where(scale > 0.0, scale, 1.0)
    each = [gain_of(f, s, scale) for f, s in zip(fisher, slope, strict=True)]
    together = gain_of(np.sum(fisher, axis=0), np.sum(slope, axis=0), scale)
    return np.sum(each, axis=0), together
