"""t distributions on the unit cube that draws for an evidence are made from.

Their places, shapes and shares are fitted to weighted draws (population Monte Carlo, Cappé et al.
2008). Draws are weighted with the density of prior and mixture together, so that the mean of the
weights is the evidence without bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from amibayes.comparison.unit_cube import CubeModel
from amibayes.likelihood.quadrature import log_sum
from amibayes.posterior.sampler import log_mean, tempered
from amibayes.units import FloatArray

TAILS = 6.0
"""Degrees of freedom of the t distributions: heavier than any posterior's own tails."""

UNIFORM_PRECISION = 12.0
"""1/variance of the prior in each dimension of the cube: no fit is narrower known than that."""

SAME, CANDIDATES = 0.02, 32
"""Fits nearer than this in every dimension of the cube are one, and so many may be drawn around."""

MODE_LIMIT = 30.0
"""How much worse in χ² than the best one fits may be that are drawn around."""

LEAST_SHARE = 0.02
"""Every t distribution keeps so much of the draws."""

KEPT = 0.2
"""Share of the draws that always come from around the best fits."""

ENOUGH, LEAST_POWER = 12.0, 0.02
"""Draws that count in a fit of the mixture, in each dimension, and the least power of weights."""

REACHES = np.geomspace(0.5, 1e-4, 13)
"""Steps along one dimension of the cube, a factor of two from one to the next."""


@dataclass(frozen=True, eq=False)
class PriorDraws:
    """Draws from the prior and what they predict; the same for all data sets of a kind."""

    cube: FloatArray
    predicted: FloatArray

    @classmethod
    def of(cls, model: CubeModel, n: int, rng: np.random.Generator) -> PriorDraws:
        """Draw ``n`` points."""
        cube = model.brighter_first(rng.random((n, model.n_dim)))
        return cls(cube, model.predict(cube))


@dataclass(frozen=True, eq=False)
class WeightedDraws:
    """Draws from the prior and a mixture, weighted for m data sets.

    Parameters
    ----------
    cube : (k, n_dim) float array
        Those inside the cube.
    log_prob, log_weight : (k, m) float array
    n : int
        All draws: those outside the cube count as 0.
    """

    cube: FloatArray
    log_prob: FloatArray
    log_weight: FloatArray
    n: int

    @property
    def log_z(self) -> tuple[FloatArray, FloatArray]:
        """Evidences and their errors, (m,)."""
        return log_mean(self.log_weight, self.n)


@dataclass(frozen=True, eq=False)
class Mixture:
    """t distributions on the cube, angles measured the short way from each centre.

    Parameters
    ----------
    model : CubeModel
    centre : (k, n_dim) float array
    scatter : (k, n_dim, n_dim) float array
        Lower triangles of Cholesky.
    share : (k,) float array
    """

    model: CubeModel
    centre: FloatArray
    scatter: FloatArray
    share: FloatArray

    def draw(self, n: int, rng: np.random.Generator) -> FloatArray:
        """Draw points, (n, n_dim) at most: those outside the cube are left out."""
        which = rng.choice(len(self.share), n, p=self.share)
        normal = rng.standard_normal((n, self.model.n_dim))
        stretch = np.sqrt(TAILS / rng.chisquare(TAILS, n))[:, None]
        step = stretch * np.einsum("nij,nj->ni", self.scatter[which], normal)
        found = self.centre[which] + step
        # An angle more than half a turn away is another point's: it is drawn in vain.
        turned = self.model.turning & (np.abs(step) > 0.5)
        found = np.where(self.model.turning, found % 1.0, found)
        inside = ((found >= 0.0) & (found <= 1.0)).all(axis=1) & ~turned.any(axis=1)
        return self.model.brighter_first(found[inside])

    def log_parts(self, cube: FloatArray) -> FloatArray:
        """Log-density of each distribution times its share, (k, n).

        Of two companions the brighter one is the first: what is drawn the other way round is
        exchanged, and both ways count.
        """
        out = self._log_parts(cube)
        if not self.model.exchangeable:
            return out
        return np.logaddexp(out, self._log_parts(self.model.exchanged(cube)))

    def _log_parts(self, cube: FloatArray) -> FloatArray:
        """`log_parts` of points as they are."""
        d = self.model.n_dim
        norm = gammaln(0.5 * (TAILS + d)) - gammaln(0.5 * TAILS) - 0.5 * d * np.log(TAILS * np.pi)
        out = np.empty((len(self.share), len(cube)))
        for k, (centre, scatter) in enumerate(zip(self.centre, self.scatter, strict=True)):
            white = self.model.apart(cube, centre) @ np.linalg.inv(scatter).T
            size = np.einsum("nd,nd->n", white, white)
            log_volume = np.log(np.diag(scatter)).sum()
            out[k] = norm - log_volume - 0.5 * (TAILS + d) * np.log1p(size / TAILS)
        return out + np.log(self.share)[:, None]

    def beside(self, first: Mixture) -> Mixture:
        """The distributions of this mixture, and those of the first one with `KEPT` of the draws.

        Weights of few draws are tempered, and a mixture fitted to them may leave a narrow mode.
        """
        share = np.concatenate([(1.0 - KEPT) * self.share, KEPT * first.share])
        centre, scatter = (
            np.concatenate([getattr(m, name) for m in (self, first)])
            for name in ("centre", "scatter")
        )
        return Mixture(self.model, centre, scatter, share)

    def adapted(self, drawn: WeightedDraws) -> Mixture:
        """Fit to the mean of the data sets' posteriors: one step of expectation, maximisation."""
        cube, least = drawn.cube, ENOUGH * self.model.n_dim
        weight = np.mean([tempered(w, least, LEAST_POWER)[0] for w in drawn.log_weight.T], axis=0)
        parts = self.log_parts(cube)
        belongs = np.exp(parts - log_sum(parts)) * weight
        share = belongs.sum(axis=1)
        centre, scatter = np.array(self.centre), np.array(self.scatter)
        for k in np.flatnonzero(share > 1e-6):
            part = belongs[k] / share[k]
            if 1.0 / (part**2).sum() < 4.0 * self.model.n_dim:  # too few draws to tell a shape
                continue
            step = self.model.apart(cube, centre[k])
            mean = part @ step
            spread = (step - mean).T @ ((step - mean) * part[:, None])
            centre[k] = centre[k] + mean
            scatter[k] = _cholesky(1.2 * spread)
        share = np.maximum(share / share.sum(), min(LEAST_SHARE, 0.25 / len(share)))
        return Mixture(self.model, centre, scatter, share / share.sum())


def first_mixture(model: CubeModel, cube: FloatArray, chi2: FloatArray, most: int) -> Mixture:
    """t distributions at fits that lie outside each other's 1σ, by Laplace's approximation.

    Parameters
    ----------
    model : CubeModel
    cube, chi2 : (m, k, n_dim), (m, k) float array
        Fits of each data set; the best of each come first.
    most : int
    """
    best = chi2.min(axis=1, keepdims=True)
    # With more noise other fits are as good, and all of them less well known.
    scale = model.inflation(best)
    merit = ((chi2 - best) / scale).ravel()
    inflation = np.broadcast_to(scale, chi2.shape).ravel()
    fits = model.brighter_first(cube.reshape(-1, model.n_dim))
    order = np.argsort(merit, kind="stable")
    kept: list[int] = []
    for i in order[merit[order] <= MODE_LIMIT]:
        if len(kept) == CANDIDATES:
            break
        if not kept or np.abs(model.apart(fits[i], fits[kept])).max(axis=1).min() >= SAME:
            kept.append(int(i))
    centre, worth = fits[kept], np.exp(-0.25 * merit[kept])
    shapes = laplace_shapes(model, centre, inflation[kept])
    chosen: list[int] = []
    belongs = np.full(len(centre), -1)
    for i in range(len(centre)):
        if belongs[i] < 0 and len(chosen) < most:
            white = np.linalg.solve(shapes[i], model.apart(centre, centre[i]).T)
            near = (white**2).sum(axis=0) < model.n_dim
            belongs[near & (belongs < 0)] = i
            chosen.append(i)
    share = np.array([worth[belongs == i].sum() for i in chosen]) + LEAST_SHARE
    moved = off_edges(model, centre[chosen], shapes[chosen])
    return Mixture(model, moved, shapes[chosen], share / share.sum())


def weighted(
    mixture: Mixture,
    prior: PriorDraws,
    at_prior: FloatArray,
    log_prob: Callable[[FloatArray], FloatArray],
    n: int,
    rng: np.random.Generator,
) -> WeightedDraws:
    """Draw from the mixture and weight the draws together with those from the prior.

    Parameters
    ----------
    mixture : Mixture
    prior : PriorDraws
    at_prior : (n_prior, m) float array
        Log-likelihoods there.
    log_prob : callable
        Gives log-likelihoods (k, m) of points (k, n_dim).
    n : int
        Draws from the mixture.
    rng : numpy.random.Generator
    """
    drawn = mixture.draw(n, rng)
    total = len(prior.cube) + n
    cube = np.concatenate([prior.cube, drawn])
    value = np.concatenate([at_prior, log_prob(drawn)]) if len(drawn) else at_prior
    share, log_names = len(prior.cube) / total, mixture.model.log_names
    parts = mixture.log_parts(cube) + np.log1p(-share)
    density = np.logaddexp(np.log(share) + log_names, log_sum(parts))
    return WeightedDraws(cube, value, value + log_names - density[:, None], total)


def _cholesky(matrix: FloatArray) -> FloatArray:
    """Lower triangle of a covariance, which may be singular to rounding."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-20))
    unit = 0.5 * (matrix + matrix.T) / np.outer(scale, scale)
    # Inverses of matrices of 1e12 may have lost more than rounding of the covariance itself.
    least = min(float(np.linalg.eigvalsh(unit)[0]), 0.0)
    unit += (1e-9 - 1.01 * least) * np.eye(len(matrix))
    return np.asarray(np.linalg.cholesky(unit) * scale[:, None])


def off_edges(model: CubeModel, centre: FloatArray, shapes: FloatArray) -> FloatArray:
    """Centres (k, n_dim) that are 1σ from the edges of the cube.

    Of a fit that stands at many edges (no flux, no width, no disc of the star) hardly a draw
    would lie inside. Other dimensions follow as the covariance says, and the data do not.
    """
    found = np.array(centre)
    for one, triangle in zip(found, shapes, strict=True):
        covariance = triangle @ triangle.T
        for k in np.flatnonzero(~model.turning):
            away = min(float(np.sqrt(covariance[k, k])), 0.5)
            step = np.clip(one[k], away, 1.0 - away) - one[k]
            one += step * covariance[:, k] / covariance[k, k]
    return np.where(model.turning, found, np.clip(found, 0.0, 1.0))


def laplace_shapes(model: CubeModel, centre: FloatArray, inflation: FloatArray) -> FloatArray:
    """Lower triangles (k, n_dim, n_dim) of the covariances of fits (k, n_dim).

    Variances of the data are ``inflation`` (k,) times those that are stated.
    """
    scatter = []
    reaches = _reach(model, centre, inflation)
    for part, reach, scale in zip(model.linear(centre)[1], reaches, inflation, strict=True):
        precision = part.T @ part / scale + UNIFORM_PRECISION * np.eye(model.n_dim)
        bent = np.diag(precision) < 0.1 / reach**2
        precision[bent, bent] = 1.0 / reach[bent] ** 2
        scatter.append(_cholesky(np.linalg.inv(precision)))
    return np.array(scatter)


def _reach(model: CubeModel, centre: FloatArray, inflation: FloatArray) -> FloatArray:
    """How far from points (k, n_dim) each dimension alone changes the data by 1σ, (k, n_dim).

    At an edge, as of a ring without width, the data do not move to first order: their slopes
    leave open what is well known.
    """
    step, d = np.concatenate([REACHES, -REACHES]), model.n_dim
    trial = centre[:, None, None] + np.eye(d)[:, None] * step[:, None]
    inside = ((trial >= 0.0) & (trial <= 1.0)).all(axis=3) | model.turning[:, None]
    there = np.repeat(model.predict(centre), d * len(step), axis=1)
    change = model.predict(model.inside(trial.reshape(-1, d))) - there
    white = model.likelihood.noise.whiten(model.likelihood.wrapped(change))
    size = (white**2).sum(axis=0).reshape(inside.shape)
    seen = np.where(inside & (size < inflation[:, None, None]), np.abs(step), REACHES[-1])
    return np.asarray(seen.max(axis=2))
