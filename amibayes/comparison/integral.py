"""Evidence and posterior by adaptive importance sampling on the unit cube.

Draws come from the prior and from t distributions around the best fits, whose places, shapes
and shares are fitted to weighted draws before they count (population Monte Carlo, Cappé et al.
2008). The draws that count are weighted with the density of the whole mixture, so that the mean
of the weights is the evidence without bias, and their scatter is its error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import gammaln

from amibayes.comparison.unit_cube import CubeModel
from amibayes.likelihood.quadrature import log_sum
from amibayes.posterior.sampler import Draws
from amibayes.units import FloatArray

TAILS = 6.0
"""Degrees of freedom of the t distributions: heavier than any posterior's own tails."""

UNIFORM_PRECISION = 12.0
"""1/variance of the prior in each dimension of the cube: no fit is narrower known than that."""

MODE_LIMIT = 30.0
"""How much worse in χ² than the best one fits may be that are drawn around."""

LEAST_SHARE = 0.02
"""Every t distribution keeps so much of the draws."""

ENOUGH, LEAST_POWER = 12.0, 0.02
"""Draws that count in a fit of the mixture, in each dimension, and the least power of weights."""

REACHES = np.geomspace(0.5, 1e-4, 13)
"""Steps along one dimension of the cube, a factor of two from one to the next."""

GOOD_ERROR, REPEATS = 0.15, 3
"""Error of ln Z below which no more draws are made: odds change by 3 at ln Z 1; and how often
twice as many draws may be made for it."""


@dataclass(frozen=True)
class Effort:
    """How many draws an evidence is worth.

    Parameters
    ----------
    prior : int
        Draws from the prior.
    modes : int
        Draws around the best fits that count; each adaptation takes half as many.
    repeats : int
        How often the mixture is fitted again, and drawn from twice as much, where the error is
        large.
    centres : int
        Best fits that are drawn around.
    rounds : int
        Adaptations of the mixture before the draws that count.
    """

    prior: int = 8192
    modes: int = 4096
    repeats: int = REPEATS
    centres: int = 12
    rounds: int = 7


@dataclass(frozen=True, eq=False)
class PriorDraws:
    """Draws from the prior and what they predict; the same for all data sets of a kind."""

    cube: FloatArray
    predicted: FloatArray

    @classmethod
    def of(cls, model: CubeModel, n: int, rng: np.random.Generator) -> PriorDraws:
        """Draw ``n`` points."""
        cube = rng.random((n, model.n_dim))
        return cls(cube, model.predict(cube))


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
        """Draw points; some lie outside the cube."""
        which = rng.choice(len(self.share), n, p=self.share)
        normal = rng.standard_normal((n, self.model.n_dim))
        stretch = np.sqrt(TAILS / rng.chisquare(TAILS, n))[:, None]
        step = stretch * np.einsum("nij,nj->ni", self.scatter[which], normal)
        found = self.centre[which] + step
        # An angle more than half a turn away is another point's: it is drawn in vain.
        turned = self.model.turning & (np.abs(step) > 0.5)
        found = np.where(self.model.turning, found % 1.0, found)
        return np.where(turned.any(axis=1)[:, None], np.nan, found)

    def log_parts(self, cube: FloatArray) -> FloatArray:
        """Log-density of each distribution times its share, (k, n)."""
        d = self.model.n_dim
        norm = gammaln(0.5 * (TAILS + d)) - gammaln(0.5 * TAILS) - 0.5 * d * np.log(TAILS * np.pi)
        out = np.empty((len(self.share), len(cube)))
        for k, (centre, scatter) in enumerate(zip(self.centre, self.scatter, strict=True)):
            white = self.model.apart(cube, centre) @ np.linalg.inv(scatter).T
            size = np.einsum("nd,nd->n", white, white)
            log_volume = np.log(np.diag(scatter)).sum()
            out[k] = norm - log_volume - 0.5 * (TAILS + d) * np.log1p(size / TAILS)
        return out + np.log(self.share)[:, None]

    def adapted(self, cube: FloatArray, weight: FloatArray) -> Mixture:
        """Fit to draws with weights that sum to 1, by one step of expectation and maximisation."""
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


def tempered(log_weight: FloatArray, n_dim: int) -> FloatArray:
    """Weights that sum to 1, raised to the power at which enough draws count for a fit.

    A mixture that is too narrow gives a few draws nearly all of the weight; fitted to these it
    would become narrower still.
    """
    power, weight, least = 1.0, np.zeros(0), ENOUGH * n_dim
    while power > LEAST_POWER:
        weight = np.exp(power * (log_weight - log_weight.max()))
        weight /= weight.sum()
        if 1.0 / (weight**2).sum() >= least:
            break
        power *= 0.7
    return weight


def _cholesky(matrix: FloatArray) -> FloatArray:
    """Lower triangle of a covariance, which may be singular to rounding."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-20))
    unit = matrix / np.outer(scale, scale) + 1e-9 * np.eye(len(matrix))
    return np.asarray(np.linalg.cholesky(unit) * scale[:, None])


def first_mixture(model: CubeModel, cube: FloatArray, chi2: FloatArray, centres: int) -> Mixture:
    """t distributions at the distinct best fits (n, n_dim), by Laplace's approximation."""
    kept: list[int] = []
    for i in np.argsort(chi2, kind="stable"):
        near = [np.abs(model.apart(cube[i], cube[j])).max(initial=0.0) < 0.02 for j in kept]
        if any(near):
            continue
        if len(kept) == centres or (kept and chi2[i] > chi2[kept[0]] + MODE_LIMIT):
            break
        kept.append(int(i))
    share = np.exp(-0.25 * (chi2[kept] - chi2[kept[0]])) + LEAST_SHARE
    shapes = laplace_shapes(model, cube[kept])
    return Mixture(model, off_edges(model, cube[kept], shapes), shapes, share / share.sum())


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


def laplace_shapes(model: CubeModel, centre: FloatArray) -> FloatArray:
    """Lower triangles (k, n_dim, n_dim) of the covariances of fits (k, n_dim)."""
    scatter = []
    for part, reach in zip(model.linear(centre)[1], _reach(model, centre), strict=True):
        precision = part.T @ part + UNIFORM_PRECISION * np.eye(model.n_dim)
        bent = np.diag(precision) < 0.1 / reach**2
        precision[bent, bent] = 1.0 / reach[bent] ** 2
        scatter.append(_cholesky(np.linalg.inv(precision)))
    return np.array(scatter)


def _reach(model: CubeModel, centre: FloatArray) -> FloatArray:
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
    seen = np.where(inside & (size < 1.0), np.abs(step), REACHES[-1])
    return np.asarray(seen.max(axis=2))


def log_z_laplace(model: CubeModel, data: FloatArray, cube: FloatArray, chi2: FloatArray) -> float:
    """ln Z of a Gaussian at the best fit, half of it in every dimension that is at an edge."""
    best = cube[int(np.argmin(chi2))]
    edges = ((best <= 0.0) | (best >= 1.0)) & ~model.turning
    triangle = laplace_shapes(model, best[None])[0]
    volume = np.log(np.diag(triangle)).sum() + 0.5 * len(best) * np.log(2.0 * np.pi)
    at_best = model.log_prob(best[None], data)[0]
    return float(at_best + min(volume - np.log(2.0) * edges.sum(), 0.0))


def integrate(
    model: CubeModel,
    data: FloatArray,
    cube: FloatArray,
    chi2: FloatArray,
    rng: np.random.Generator,
    *,
    prior: PriorDraws | None = None,
    effort: Effort | None = None,
) -> Draws:
    """Measure the evidence of a model, and draw from its posterior.

    Parameters
    ----------
    model : CubeModel
    data : (n_data,) float array
    cube, chi2 : (n, n_dim), (n,) float array
        Fits of the data.
    rng : numpy.random.Generator
    prior : PriorDraws, optional
        Of the same model.
    effort : Effort, optional

    Returns
    -------
    Draws
        Parameter sets with their weights; ``log_z`` and ``log_z_error`` in its diagnostics.
    """
    effort = effort or Effort()
    if model.n_dim == 0:
        value = model.log_prob(np.zeros((1, 0)), data)
        return Draws(np.zeros((1, 0)), value, np.ones(1), {"log_z": value[0], "log_z_error": 0.0})
    known = prior or PriorDraws.of(model, effort.prior, rng)
    at_prior = model.log_prob_of(known.predicted, data)
    mixture = first_mixture(model, cube, chi2, effort.centres)
    for _ in range(effort.rounds):
        drawn, value = _drawn(model, data, mixture, effort.modes // 2, rng)
        mixture = _refitted(mixture, (known.cube, drawn), (at_prior, value))
    for k in range(1 + effort.repeats):
        n = effort.modes * 2**k
        drawn, value = _drawn(model, data, mixture, n, rng)
        found = _weighed(model, mixture, (known.cube, drawn), (at_prior, value), n)
        if found.diagnostics["log_z_error"] < GOOD_ERROR:
            break
        # What was drawn places the mixture better; the draws that count are then new ones.
        mixture = _refitted(mixture, (known.cube, drawn), (at_prior, value))
    return found


def _refitted(
    mixture: Mixture, cubes: tuple[FloatArray, FloatArray], values: tuple[FloatArray, FloatArray]
) -> Mixture:
    """Fit a mixture to draws from the prior and from itself, and their log-likelihoods."""
    cube = np.concatenate(cubes)
    log_weight = np.concatenate(values) - log_density(mixture, cube, len(cubes[0]) / len(cube))
    return mixture.adapted(cube, tempered(log_weight, mixture.model.n_dim))


def _weighed(
    model: CubeModel,
    mixture: Mixture,
    cubes: tuple[FloatArray, FloatArray],
    values: tuple[FloatArray, FloatArray],
    tried: int,
) -> Draws:
    """Weights of draws from the prior and from the mixture; those outside count as 0."""
    n = len(cubes[0]) + tried
    cube, value = np.concatenate(cubes), np.concatenate(values)
    log_weight = value - log_density(mixture, cube, len(cubes[0]) / n)
    log_z = float(log_sum(log_weight) - np.log(n))
    relative = np.exp(log_weight - log_z)
    error = float(np.sqrt(max((relative**2).sum() / n - 1.0, 0.0) / n))
    evidence = {"log_z": log_z, "log_z_error": error}
    return Draws(model.theta(cube), value, relative / relative.sum(), evidence)


def _drawn(
    model: CubeModel, data: FloatArray, mixture: Mixture, n: int, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Draws inside the cube, and their log-likelihoods."""
    cube = mixture.draw(n, rng)
    cube = cube[((cube >= 0.0) & (cube <= 1.0)).all(axis=1)]
    return cube, model.log_prob(cube, data) if len(cube) else np.zeros(0)


def log_density(mixture: Mixture, cube: FloatArray, prior_share: float) -> FloatArray:
    """Log-density of the prior and the mixture together."""
    parts = mixture.log_parts(cube) + np.log1p(-prior_share)
    return np.asarray(np.logaddexp(np.log(prior_share), log_sum(parts)))
