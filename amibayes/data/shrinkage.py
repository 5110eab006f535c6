"""The covariance of the mean: scatter between integrations, shrunk towards what physics expects.

The scatter of N integrations knows N − 1 directions of p; for few of them its inverse is
far too sure of itself. The covariance is given an inverse-Wishart prior whose mean is the
covariance that photons and read noise make, each kind of observable with a scale of its own,
and a change that all V² share (jitter, flux, gains of the holes), which photons do not make
and which looks like a companion's contrast. Scales, shared change and degrees of freedom are
those that the scatter itself supports best (marginal likelihood).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import minimize
from scipy.special import digamma, gammaln

from amibayes.data.degrees_of_freedom import Freedom
from amibayes.errors import DataError
from amibayes.units import BoolArray, FloatArray, read_only

MAX_FREEDOM = 1e4
"""The prior never counts for more integrations than this."""

SIGNIFICANT = 4.0
"""Standard deviations of the correlation from one integration to the next that count."""


@dataclass(frozen=True, eq=False)
class Shrunk:
    """Covariance of one integration, and what it rests on.

    Parameters
    ----------
    matrix : (m, m) array
    prior_freedom : float
        Integrations that the physical covariance counts for (infinite: it alone).
    freedom : float
        Degrees of freedom of the t distribution of data of this covariance (infinite: a
        Gaussian). The matrix is the covariance of that distribution.
    scatter_freedom : float
        Degrees of freedom of the scatter: integrations, or blocks of them, less one.
    scale_vis2, scale_closure : float
        Measured variances in units of the physical ones.
    block : int
        Integrations that were averaged because they are correlated in time; 1 where not.
    correlation : float
        From one integration to the next, over all observables.
    scatter : (m, m) array
        Covariance of one integration by the scatter alone.
    """

    matrix: FloatArray
    prior_freedom: float
    freedom: float
    scatter_freedom: float
    scale_vis2: float
    scale_closure: float
    block: int
    correlation: float
    scatter: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "matrix", "scatter")

    @property
    def carried(self) -> Freedom | None:
        """What the observables carry on; None where the covariance is taken as known."""
        return Freedom(self.freedom, self.scatter_freedom) if np.isfinite(self.freedom) else None


def shrunk_covariance(
    deviation: FloatArray,
    physical: FloatArray,
    basis: FloatArray,
    n_vis2: int,
    kind: str = "shrunk",
) -> Shrunk:
    """Covariance of the observables of one integration.

    Parameters
    ----------
    deviation : (n, m) array
        Of each integration from the mean, in order of time.
    physical : (m, m) array
        Covariance that noise of known size makes.
    basis : (m, p) array
        Orthonormal basis of the independent observables, those of V² first.
    n_vis2 : int
        How many of the independent observables are V².
    kind : {"shrunk", "scatter", "physical"}

    Raises
    ------
    DataError
        Where the scatter alone is asked for and has not more than p + 2 integrations.
    """
    lower = np.asarray(np.linalg.cholesky(basis.T @ physical @ basis), dtype=float)
    white = solve_triangular(lower, basis.T @ deviation.T, lower=True)
    white, block, correlation = _uncorrelated(white)
    p, n = white.shape
    groups = np.arange(p) < n_vis2
    if kind == "physical" or n < 2:
        inner, prior, freedom, scales = np.eye(p), np.inf, np.inf, (1.0, 1.0)
    elif kind == "scatter":
        inner, prior, freedom = _scatter_alone(white), 0.0, float(n - p)
        scales = _scales(white @ white.T / (n - 1), groups)
    else:
        prior, scales, mean = _most_likely(white, groups, _shared(lower, basis, n_vis2))
        freedom = prior + n - p
        inner = ((prior - p - 1.0) * mean + white @ white.T) / (freedom - 2.0)
    spread = basis @ lower
    matrix = spread @ inner @ spread.T
    scatter = spread @ (white @ white.T / max(n - 1, 1)) @ spread.T
    return Shrunk(matrix, prior, freedom, n - 1.0, *scales, block, correlation, scatter)


def _scatter_alone(white: FloatArray) -> FloatArray:
    """Covariance of the t distribution that scatter without a prior makes of data, (p, p)."""
    p, n = white.shape
    if n <= p + 2:
        raise DataError(
            f"the scatter of {n} integrations is no covariance of {p} independent observables",
            remedy="take it together with the expected noise (shrunk)",
        )
    return np.asarray(white @ white.T / (n - p - 2.0))


def _scales(inner: FloatArray, groups: BoolArray) -> tuple[float, float]:
    diagonal = np.diag(inner)
    mean = [float(diagonal[g].mean()) if g.any() else 1.0 for g in (groups, ~groups)]
    return mean[0], mean[1]


def _shared(lower: FloatArray, basis: FloatArray, n_vis2: int) -> FloatArray:
    """Whitened direction, of length one, in which all V² change by as much, (p,)."""
    vis2 = np.abs(basis[:, :n_vis2]).max(axis=1, initial=0.0) > 0.0
    white = solve_triangular(lower, basis.T @ vis2.astype(float), lower=True)
    return np.asarray(white / max(np.linalg.norm(white), 1e-300))


def _most_likely(
    white: FloatArray, groups: BoolArray, shared: FloatArray
) -> tuple[float, tuple[float, float], FloatArray]:
    """Degrees of freedom, scales and mean (p, p) of the prior of greatest marginal likelihood."""
    p, n = white.shape
    scatter = white @ white.T
    start = np.log(np.maximum(_scales(scatter / (n - 1), groups), 1e-3))
    most = np.log(max(shared @ scatter @ shared / (n - 1), 1e-3))
    bounds = [(-2.0, np.log(MAX_FREEDOM)), *((s - 2.0, s + 2.0) for s in start)]
    # From e⁻⁷ of the V²'s own variance, which is nothing, to well above what was measured.
    bounds.append((start[0] - 7.0, max(most, start[0]) + 2.0))
    tries = [
        minimize(
            _loss,
            [first, *start, most - 1.0],
            args=(scatter, n - 1, groups, shared),
            jac=True,
            bounds=bounds,
            method="L-BFGS-B",
        )
        for first in (1.0, 4.0, 7.0)
    ]
    best = np.exp(min(tries, key=lambda t: float(t.fun)).x)
    mean = np.diag(np.where(groups, *best[1:3])) + best[3] * np.outer(shared, shared)
    return float(p + 2.0 + best[0]), (float(best[1]), float(best[2])), mean


def _loss(
    at: FloatArray, scatter: FloatArray, m: int, groups: BoolArray, shared: FloatArray
) -> tuple[float, FloatArray]:
    """−ln of the marginal likelihood of a scatter of m degrees of freedom, and its gradient.

    ``at`` holds the logarithms of ν0 − p − 2, of the two scales and of the variance shared.
    """
    p, (excess, vis2, closure, common) = len(scatter), np.exp(at)
    nu, own = p + 2.0 + excess, np.where(groups, vis2, closure)
    k = nu - p - 1.0
    total = k * (np.diag(own) + common * np.outer(shared, shared)) + scatter
    logdet, inverse = float(np.linalg.slogdet(total)[1]), np.linalg.inv(total)
    # Of Ψ, diagonal but for one direction, by the formula of Sherman and Morrison.
    scaled = shared / own
    share = float(shared @ scaled)
    lost = common / (1.0 + common * share)
    before = p * np.log(k) + np.log(own).sum() + np.log1p(common * share)
    steps = -0.5 * np.arange(p)
    gammas = gammaln(0.5 * nu + steps) - gammaln(0.5 * (nu + m) + steps)
    loss = gammas.sum() - 0.5 * nu * before + 0.5 * (nu + m) * logdet
    digammas = digamma(0.5 * nu + steps) - digamma(0.5 * (nu + m) + steps)
    after = 0.5 * (nu + m) * k
    pull = after * inverse.diagonal() * own - 0.5 * nu * (1.0 - lost * scaled**2 * own)
    along = common * (after * (shared @ inverse @ shared) - 0.5 * nu * share * (1.0 - lost * share))
    by_nu = 0.5 * (digammas.sum() - before + logdet)
    by_nu += (after * (inverse.diagonal() @ own + common * (shared @ inverse @ shared))) / k
    by_nu -= 0.5 * nu * p / k
    slope = [by_nu * excess, pull[groups].sum(), pull[~groups].sum(), along]
    return float(loss), np.array(slope)


def _uncorrelated(white: FloatArray) -> tuple[FloatArray, int, float]:
    """Average neighbours in time until one says nothing of the next.

    Block means are scaled by √(length), so that their covariance is that of one
    integration if nothing is correlated.
    """
    block, series = 1, white
    first = lag_one(series)
    while series.shape[1] >= 12 and lag_one(series) > SIGNIFICANT / np.sqrt(series.size):
        block *= 2
        n = white.shape[1] // block
        series = white[:, : n * block].reshape(len(white), n, block).mean(axis=2) * np.sqrt(block)
        series = series - series.mean(axis=1, keepdims=True)
    return series, block, first


def lag_one(series: FloatArray) -> float:
    """Correlation of neighbours in time, over all rows, freed of its bias −1/n."""
    n = series.shape[1]
    if n < 3:
        return 0.0
    power = float((series**2).sum())
    return float((series[:, 1:] * series[:, :-1]).sum() / max(power, 1e-300) + 1.0 / n)
