"""A search with Student-t residuals: data that fit nothing lose their weight, step by step.

What channels of an exposure share is fitted to the residuals of a first search, outliers at
little weight; the search that counts has it in its noise, in units of the stretched errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.field import box_of, resolution_mas
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.likelihood.channel_noise import noise_with_channels, noise_with_rows
from amibayes.likelihood.combinations import combination_of, require
from amibayes.likelihood.extra_noise import ExtraNoise, FileNoise, NoisePrior, mean_of_files
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.likelihood.residuals import files_of, groups_of
from amibayes.likelihood.student import (
    DEGREES,
    Robustness,
    StudentNoise,
    StudentTerm,
    SymmetricWhitening,
    normal_moments,
    reweighted,
    scales,
    student_terms,
    symmetric_whitening,
    weights_of,
)
from amibayes.models.parameters import Box
from amibayes.units import BoolArray, FloatArray

MAX_SEARCHES, MAX_STEPS = 3, 30
CONVERGED = 0.01


def search_robust(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
    *,
    free_scale: bool = True,
    per_file: bool = False,
    prior: NoisePrior | None = None,
) -> tuple[SearchResult, ExtraNoise]:
    """Search with residuals of Student's t distribution.

    Parameters
    ----------
    likelihood, separation_mas
        As for `amibayes.likelihood.extra_noise.search_with_noise`.
    free_scale : bool
        Fit the scale of the errors of each kind of observable (never below the stated ones).
    per_file : bool
        Every file has scales of its own.
    prior : NoisePrior, optional
        Whether channels of an exposure may share some of their noise, and floors.

    Returns
    -------
    result : SearchResult
        Of the data with the errors of outliers stretched; ``robustness`` says which.
    noise : ExtraNoise
        What the fitted scales amount to, in quadrature to the typical error.

    Raises
    ------
    UsageError
        Where the covariance was estimated from the scatter of integrations: weights of single
        data and the errors of that covariance, which all data share, cannot be told apart.
    """
    data = likelihood.observables
    require(combination_of(likelihood, residuals="student"), data.source)
    work = RobustFits(likelihood, separation_mas, free_scale, per_file=per_file)
    found = work.first()
    first = found[0]
    shared = shared_noise(first.likelihood, first.theta, prior or NoisePrior(), per_file=per_file)
    correlated = with_shared(likelihood.expecting(first.theta), shared)
    if correlated.noise.rows is not None:
        likelihood = correlated
        work = RobustFits(likelihood, separation_mas, free_scale, per_file=per_file)
        found = work.converge(likelihood.residuals(first.theta)[:, 0])
    result, weights, residuals, scale = work.settled(found)
    base = work.stretched(scale)
    robustness = Robustness(
        base.observables, likelihood.observables, likelihood.noise.covariance, weights, residuals
    )
    symmetric = symmetric_whitening(base.observables, base.noise.covariance)
    student = StudentNoise(result.likelihood.noise, base.noise, symmetric)
    noise = _as_noise(likelihood, scale, shared, per_file=per_file)
    likelihood = result.likelihood.with_noise(student)
    return replace(result, likelihood=likelihood, robustness=robustness), noise


Found = tuple[SearchResult, FloatArray, FloatArray, FloatArray]
"""A search, and of every datum its weight, its residual and the scale of its error, (n_data,)."""


def shared_noise(
    weighted: Likelihood, theta: FloatArray, prior: NoisePrior, *, per_file: bool = False
) -> ExtraNoise:
    """What channels share of the noise, and floors, from what a fit with weights leaves.

    ``weighted`` has the errors of outliers stretched. The amount of noise is left to the scales.
    """
    fixed = replace(prior, vis2=0.0, closure_phase_rad=0.0)
    return fit_noise(weighted.expecting(theta), theta, per_file=per_file, prior=fixed)


def with_shared(likelihood: Likelihood, noise: ExtraNoise) -> Likelihood:
    """The likelihood with noise of which channels share some, and floors."""
    data = likelihood.observables
    return likelihood.with_noise(noise_with_channels(data, noise.channels, noise.floors))


def _as_noise(
    stated: Likelihood, scale: FloatArray, shared: ExtraNoise, *, per_file: bool
) -> ExtraNoise:
    """Fitted scales (n_data,), in quadrature to the typical error of each kind (and file).

    Beside what channels share.
    """
    data = stated.observables
    added = stated.noise.covariance.variance * np.maximum(scale**2 - 1.0, 0.0)

    def of(which: BoolArray) -> float:
        return float(np.sqrt(np.median(added[which]))) if which.any() else 0.0

    parts = files_of(data)
    vis2 = np.arange(len(scale)) < data.n_vis2
    if not per_file or len(parts) < 2:
        return replace(shared, vis2=of(vis2), closure_phase_rad=of(~vis2))
    files = [FileNoise(f.source, of(f.of_kind("vis2")), of(f.of_kind("cp"))) for f in parts]
    found = mean_of_files(data, files)
    return replace(found, channels=shared.channels, floors=shared.floors)


class RobustFits:
    """Weights and fits in turn.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors, and what channels share.
    separation_mas : (inner, outer), optional
    free_scale, per_file : bool
    """

    def __init__(
        self,
        likelihood: Likelihood,
        separation_mas: tuple[float, float] | None,
        free_scale: bool,
        *,
        per_file: bool = False,
    ) -> None:
        data, covariance = likelihood.observables, likelihood.noise.covariance
        self.likelihood, self.field = likelihood, separation_mas
        self.symmetric = symmetric_whitening(data, covariance)
        self.free_scale = free_scale
        self.terms: list[StudentTerm] = student_terms(data, covariance, per_file=per_file)
        parts = groups_of(data, per_file=per_file)
        kinds = self.symmetric.groups
        self.groups = [here & kind for _, here in parts for kind in kinds if (here & kind).any()]

    def log_prob(self, theta: FloatArray) -> float:
        """The t likelihood at the most likely scale of each kind."""
        difference = self.likelihood.difference(theta)
        nodes = [t.best(difference[:, 0]) if self.free_scale else 0.0 for t in self.terms]
        each = zip(self.terms, nodes, strict=True)
        return float(sum(t.log_likelihoods(difference, np.array([n]))[0, 0] for t, n in each))

    def first(self) -> Found:
        """The more likely one of those that start from the best fit and from no companion."""
        plain, alone = search(self.likelihood, self.field), single_likelihood(self.likelihood)
        fits = (self.likelihood, plain.theta), (alone, plain.single_theta)
        tried = [self.converge(model.residuals(theta)[:, 0]) for model, theta in fits]
        return max(tried, key=lambda t: self.log_prob(t[0].theta))

    def converge(self, white: FloatArray) -> Found:
        """Search, and again with new weights until the place holds."""
        place, stretch = np.full(2, np.nan), self._stretch(white)[0]
        for _ in range(MAX_SEARCHES):
            result = search(self.stretched(stretch), self.field)
            stretch, _ = self.steps(result.theta, box_of(result.grid, self.likelihood))
            here = np.array([result.companion.east_mas, result.companion.north_mas])
            moved, place = np.hypot(*(here - place)), here
            if moved < CONVERGED * resolution_mas(self.likelihood):
                break
        result = search(self.stretched(stretch), self.field)
        _, weights, residuals, scale = self._stretch(self.likelihood.residuals(result.theta)[:, 0])
        return result, weights, residuals, scale

    def settled(self, found: Found) -> Found:
        """The most likely solution, and how much less likely others are, each with its own weights.

        Weights that were found beside one solution take from all others what speaks for them.
        """
        fits, log = self._of_modes(found[0])
        for _ in range(MAX_SEARCHES):
            best = int(log.argmax())
            if best == 0:
                break
            other = self.converge(self.likelihood.residuals(fits[best])[:, 0])
            if self.log_prob(other[0].theta) <= log[0]:
                break
            found = other
            fits, log = self._of_modes(found[0])
        result = found[0]
        gain = result.modes[0].delta_chi2 + np.minimum(2.0 * (log - log[0]), 0.0)
        modes = [replace(m, delta_chi2=float(g)) for m, g in zip(result.modes, gain, strict=True)]
        aliases = [
            new for old, new in zip(result.modes, modes, strict=True) if old in result.aliases
        ]
        modes.sort(key=lambda m: -m.delta_chi2)
        return replace(result, modes=tuple(modes), aliases=tuple(aliases)), *found[1:]

    def _of_modes(self, result: SearchResult) -> tuple[list[FloatArray], FloatArray]:
        """Fits near every solution with weights of their own, and their log-likelihoods."""
        box = box_of(result.grid, self.likelihood)
        fits = [result.theta, *(self.steps(np.array(m.theta), box)[1] for m in result.modes[1:])]
        return fits, np.array([self.log_prob(theta) for theta in fits])

    def stretched(self, stretch: FloatArray) -> Likelihood:
        """The Gaussian likelihood of stretched errors (n_data,)."""
        given = self.likelihood
        data = reweighted(given.observables, stretch)
        noise = noise_with_rows(data, given.noise.rows, floor=given.noise.floor)
        return Likelihood(data, given.model, noise)

    def steps(self, theta: FloatArray, box: Box) -> tuple[FloatArray, FloatArray]:
        """Weights and fit in turn, near one place: stretch of the errors, and the fit."""
        stretch = np.ones(self.likelihood.observables.covariance.size)
        for _ in range(MAX_STEPS):
            before = stretch
            stretch = self._stretch(self.likelihood.residuals(theta)[:, 0])[0]
            theta = np.array(refine(self.stretched(stretch), theta, box, 0.0).theta)
            if np.abs(np.log(stretch / before)).max() < CONVERGED:
                break
        return stretch, theta

    def _stretch(self, white: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Stretch of the errors, weights, residuals and scales (n_data,) of whitened residuals."""
        standard = self.symmetric.residuals(white[:, None])
        scale = np.ones(len(standard))
        share = len(self.likelihood.parameters) / self.likelihood.n_independent
        for group in self.groups if self.free_scale else ():
            part = SymmetricWhitening(
                self.symmetric.rows[group], self.symmetric.share[group], self.symmetric.vis2[group]
            )
            fitted = scales(part, standard[group], share * float(part.share.sum()))
            scale[group] = max(1.0, float(fitted[0]))
        residuals = standard[:, 0] / scale
        weights = weights_of(residuals)
        # So much that errors of the fit are right where residuals are normal.
        moments = normal_moments()
        level = moments.efficiency / moments.weight * (DEGREES + 1.0) / DEGREES
        return scale / np.sqrt(level * weights), weights, residuals, scale
