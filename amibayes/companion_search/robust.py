"""A search with Student-t residuals: data that fit nothing lose their weight, step by step."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.optimise import refine
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import resolution_mas, search
from amibayes.errors import UsageError
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.student import (
    DEGREES,
    Robustness,
    StudentNoise,
    SymmetricWhitening,
    normal_moments,
    reweighted,
    scales,
    symmetric_whitening,
    weights_of,
)
from amibayes.likelihood.student_noise import StudentTerm, student_terms
from amibayes.models.parameters import Box
from amibayes.units import FloatArray

MAX_SEARCHES, MAX_STEPS = 3, 30
SETTLED = 0.01


def search_robust(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
    *,
    free_scale: bool = True,
) -> tuple[SearchResult, ExtraNoise]:
    """Search with residuals of Student's t distribution.

    Parameters
    ----------
    likelihood, separation_mas
        As for `amibayes.likelihood.extra_noise.search_with_noise`.
    free_scale : bool
        Fit the scale of the errors of each kind of observable (never below the stated ones).

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
    if data.covariance_kind == "estimated" or data.freedom is not None:
        raise UsageError(
            "robust residuals need errors that are stated, not estimated from the scatter",
            source=data.source,
            remedy="leave --robust out: extraction has left out the integrations that stand off",
        )
    work = RobustFits(likelihood, separation_mas, free_scale)
    plain = search(likelihood, separation_mas)
    alone = single_likelihood(likelihood)
    starts = [
        likelihood.residuals(plain.theta)[:, 0],
        alone.residuals(plain.single_theta)[:, 0],
    ]
    tried = [work.settle(white) for white in starts]
    result, weights, residuals, scale = max(tried, key=lambda t: work.log_prob(t[0].theta))
    stated = likelihood.observables
    base = reweighted(stated, scale)
    robustness = Robustness(base, stated, weights, residuals)
    student = StudentNoise(result.likelihood.noise, base.covariance, symmetric_whitening(base))
    noise = _as_noise(work.frame, stated.covariance.variance, scale)
    likelihood = result.likelihood.with_noise(student)
    return replace(result, likelihood=likelihood, robustness=robustness), noise


def _as_noise(frame: SymmetricWhitening, variance: FloatArray, scale: FloatArray) -> ExtraNoise:
    vis2, closure = (
        float(np.sqrt(np.median(variance[m]) * max(np.median(scale[m]) ** 2 - 1.0, 0.0)))
        if m.any()
        else 0.0
        for m in (frame.vis2, ~frame.vis2)
    )
    return ExtraNoise(vis2, closure)


class RobustFits:
    """Weights and fits in turn.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    separation_mas : (inner, outer), optional
    free_scale : bool
    """

    def __init__(
        self,
        likelihood: Likelihood,
        separation_mas: tuple[float, float] | None,
        free_scale: bool,
    ) -> None:
        self.likelihood, self.field = likelihood, separation_mas
        self.frame = symmetric_whitening(likelihood.observables)
        self.free_scale = free_scale
        self.terms: list[StudentTerm] = student_terms(likelihood.observables)

    def log_prob(self, theta: FloatArray) -> float:
        """The t likelihood at the most likely scale of each kind."""
        difference = self.likelihood.difference(theta)
        nodes = [t.best(difference[:, 0]) if self.free_scale else 0.0 for t in self.terms]
        each = zip(self.terms, nodes, strict=True)
        return float(sum(t.log_likelihoods(difference, np.array([n]))[0, 0] for t, n in each))

    def settle(self, white: FloatArray) -> tuple[SearchResult, FloatArray, FloatArray, FloatArray]:
        """Search, and again with new weights until the place holds."""
        place, stretch = np.full(2, np.nan), self._stretch(white)[0]
        for _ in range(MAX_SEARCHES):
            result = search(self.weighted(stretch), self.field)
            grid = result.grid
            box = Box(grid.inner_mas, grid.outer_mas, resolution_mas(self.likelihood))
            stretch, _ = self.steps(result.theta, box)
            moved = np.hypot(*(result.theta[:2] - place))
            place = result.theta[:2]
            if moved < SETTLED * resolution_mas(self.likelihood):
                break
        result = search(self.weighted(stretch), self.field)
        _, weights, residuals, scale = self._stretch(self.likelihood.residuals(result.theta)[:, 0])
        return result, weights, residuals, scale

    def weighted(self, stretch: FloatArray) -> Likelihood:
        """The Gaussian likelihood of stretched errors (n_data,)."""
        return Likelihood(reweighted(self.likelihood.observables, stretch), self.likelihood.model)

    def steps(self, theta: FloatArray, box: Box) -> tuple[FloatArray, FloatArray]:
        """Weights and fit in turn, near one place: stretch of the errors, and the fit."""
        stretch = np.ones(self.likelihood.observables.covariance.size)
        for _ in range(MAX_STEPS):
            before = stretch
            stretch = self._stretch(self.likelihood.residuals(theta)[:, 0])[0]
            theta = np.array(refine(self.weighted(stretch), theta, box, 0.0).theta)
            if np.abs(np.log(stretch / before)).max() < SETTLED:
                break
        return stretch, theta

    def _stretch(self, white: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Stretch of the errors, weights, residuals and scales (n_data,) of whitened residuals."""
        standard = self.frame.residuals(white[:, None])
        scale = np.ones(len(standard))
        share = len(self.likelihood.parameters) / self.likelihood.n_independent
        for group in self.frame.groups if self.free_scale else ():
            part = SymmetricWhitening(
                self.frame.rows[group], self.frame.share[group], self.frame.vis2[group]
            )
            fitted = scales(part, standard[group], share * float(part.share.sum()))
            scale[group] = max(1.0, float(fitted[0]))
        residuals = standard[:, 0] / scale
        weights = weights_of(residuals)
        # So much that errors of the fit are right where residuals are normal.
        moments = normal_moments()
        level = moments.efficiency / moments.weight * (DEGREES + 1.0) / DEGREES
        return scale / np.sqrt(level * weights), weights, residuals, scale
