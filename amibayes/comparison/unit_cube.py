"""A model on the unit cube of its prior, where the prior is uniform and evidence a mean."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.comparison.hypotheses import Hypothesis, groups, periodic
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.priors import Prior
from amibayes.units import BoolArray, FloatArray, IntArray

STEP = 1e-5
"""Step of the derivative of parameters by the cube: rounding and curvature below 1e-6."""

BATCH_VALUES = 400_000
"""Model values (points × parameter sets) that are worked on together: they stay in the cache."""

FAR = 25.0
"""Models whose ln L is so far below the best fit's count for nothing in an evidence (1e-11)."""

WIDE_PHASES = 1.0
"""Scatter of closure phases between data sets, in radians, from which on differences of whitened
data do not tell which models are near: a difference may go the other way round the circle."""


@dataclass(frozen=True, eq=False)
class CubeModel:
    """A model of the sky with data, noise and prior; parameter sets are points of a cube.

    Parameters
    ----------
    hypothesis : Hypothesis
    likelihood : Likelihood
    prior : Prior
    """

    hypothesis: Hypothesis
    likelihood: Likelihood
    prior: Prior

    @property
    def n_dim(self) -> int:
        """Number of parameters."""
        return len(self.likelihood.parameters)

    @cached_property
    def groups(self) -> list[tuple[IntArray, int]]:
        """Columns of each source beside the star, and which is its flux."""
        return groups(self.likelihood)

    @cached_property
    def turning(self) -> BoolArray:
        """Which dimensions come back to where they began, (n_dim,)."""
        found = np.zeros(self.n_dim, dtype=bool)
        found[periodic(self.likelihood)] = True
        return found

    @property
    def exchangeable(self) -> bool:
        """Whether there are two companions, which may be called by either's number."""
        return self.likelihood.parameters.companions == 2

    def exchanged(self, points: FloatArray) -> FloatArray:
        """Points (…, n_dim), of the cube or parameter sets, with the companions exchanged."""
        return points[..., self.likelihood.parameters.swapped]

    def brighter_first(self, points: FloatArray) -> FloatArray:
        """The same sky with the brighter companion first: points (…, n_dim) or parameter sets."""
        if not self.exchangeable:
            return points
        one, two = (self.likelihood.parameters.columns("flux", component=k)[0] for k in (1, 2))
        fainter = points[..., one] < points[..., two]
        return np.where(fainter[..., None], self.exchanged(points), points)

    @property
    def log_names(self) -> float:
        """ln of how many ways the companions may be numbered."""
        return float(np.log(2.0)) if self.exchangeable else 0.0

    def inside(self, cube: FloatArray) -> FloatArray:
        """Bring points (n, n_dim) back: angles by whole turns, the rest to the nearest edge."""
        return np.where(self.turning, cube % 1.0, np.clip(cube, 0.0, 1.0))

    def apart(self, cube: FloatArray, centre: FloatArray) -> FloatArray:
        """Differences of points (…, n_dim), angles the short way round."""
        change = cube - centre
        return np.where(self.turning, change - np.rint(change), change)

    def theta(self, cube: FloatArray) -> FloatArray:
        """Parameter sets (n, n_dim)."""
        return self.prior.from_cube(cube)

    def cube(self, theta: FloatArray) -> FloatArray:
        """Points (n, n_dim) of parameter sets."""
        return self.prior.to_cube(np.atleast_2d(theta))

    def predict(self, cube: FloatArray) -> FloatArray:
        """Model of the data, (n_data, n)."""
        pieces = [self.likelihood.predict(self.theta(part)) for part in self._batches(cube)]
        return np.concatenate(pieces, axis=1)

    def _batches(self, cube: FloatArray) -> list[FloatArray]:
        n = 1 + len(cube) * len(self.likelihood.samples) // BATCH_VALUES
        return np.array_split(cube, n)

    def log_prob(self, cube: FloatArray, data: FloatArray) -> FloatArray:
        """Log-likelihood (n,) of data (n_data,)."""
        return self.log_prob_of(self.predict(cube), data)

    def log_prob_of(self, predicted: FloatArray, data: FloatArray) -> FloatArray:
        """Log-likelihood (n,) of data (n_data,) given what models predict (n_data, n)."""
        return self.likelihood.noise.log_prob(self.difference(predicted, data[:, None]))

    def log_prob_of_many(
        self, predicted: FloatArray, data: FloatArray, best: FloatArray
    ) -> FloatArray:
        """Log-likelihoods (n, m) of data sets (n_data, m) given what models predict (n_data, n).

        Where ln L is below that of a best fit, of χ² (m,), by more than `FAR`, it is −∞: which
        pairs these are is seen in one product of matrices of whitened data.
        """
        far = self.likelihood.noise.delta_chi2(np.full(1, FAR))
        seen = self._near(predicted, data, best + self.inflation(best) * far)
        out = np.full(seen.shape, -np.inf)
        rows = np.flatnonzero(seen.any(axis=1))
        first = self.difference(predicted[:, rows], data[:, :1])
        second = self.difference(data[:, :1], data)
        n = self.likelihood.observables.n_vis2
        most = np.abs(second[n:]).max(axis=1, initial=0.0)
        # A sum of two differences of closure phases goes the short way round where it is below π.
        short = (np.abs(first[n:]) + most[:, None] < np.pi).all(axis=0)[:, None]
        out[rows] = self.likelihood.noise.log_prob_of_sums(first, second, seen[rows] & short)
        seen[rows] &= ~short
        for k in np.flatnonzero(seen.any(axis=0)):
            out[seen[:, k], k] = self.log_prob_of(predicted[:, seen[:, k]], data[:, k])
        return out

    def inflation(self, chi2: FloatArray) -> FloatArray:
        """Variance of the noise at fits of some χ², in units of that they are whitened by.

        Where even the best fit is bad, noise of unknown amount makes up for it.
        """
        noise = self.likelihood.noise
        ratio = np.maximum(chi2 / noise.n_independent, 1.0)
        return ratio if noise.parameters else np.ones_like(ratio)

    def _near(self, predicted: FloatArray, data: FloatArray, limit: FloatArray) -> BoolArray:
        """Which pairs of a model (n) and a data set (m) have a χ² below the limits (m,)."""
        apart = self.difference(data[:, :1], data)[self.likelihood.observables.n_vis2 :]
        if np.abs(apart).max(initial=0.0) > WIDE_PHASES:
            return np.ones((predicted.shape[1], data.shape[1]), dtype=bool)
        return np.asarray(self.chi2_of_pairs(predicted, data) < limit)

    def chi2_of_pairs(self, predicted: FloatArray, data: FloatArray) -> FloatArray:
        """χ² (n, m) of predictions (n_data, n) for data sets (n_data, m) that are nearly alike.

        Closure phases go the short way round to the first data set, and from there to the others.
        """
        whiten, first = self.likelihood.noise.whiten, data[:, :1]
        near, far = whiten(self.difference(first, data)), whiten(self.difference(predicted, first))
        sizes = (far**2).sum(axis=0)[:, None] + (near**2).sum(axis=0)
        return np.asarray(sizes + 2.0 * far.T @ near)

    def difference(self, predicted: FloatArray, data: FloatArray) -> FloatArray:
        """Data minus model, closure phases the short way round."""
        return self.likelihood.wrapped(data - predicted)

    def linear(self, cube: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What models predict (n_data, n), and whitened derivatives (n, n_independent, n_dim)."""
        predicted, slopes = self.likelihood.model_and_slopes(self.theta(cube))
        white = self.likelihood.noise.whiten(slopes.reshape(len(slopes), -1))
        white = white.reshape(-1, *slopes.shape[1:])
        return predicted, np.einsum("kdn,nde->nke", white, self._stretch(cube), optimize=True)

    def _stretch(self, cube: FloatArray) -> FloatArray:
        """Derivatives of the parameters by the cube, (n, n_dim, n_dim)."""
        n, d = cube.shape
        low = np.repeat(cube[:, None], d, axis=1)
        high = low.copy()
        every = np.arange(d)
        low[:, every, every] = np.maximum(low[:, every, every] - STEP, 0.0)
        high[:, every, every] = np.minimum(high[:, every, every] + STEP, 1.0)
        width = (high - low)[:, every, every]
        ends = [self.theta(x.reshape(n * d, d)).reshape(n, d, d) for x in (low, high)]
        return np.asarray(((ends[1] - ends[0]) / width[:, :, None]).transpose(0, 2, 1))
