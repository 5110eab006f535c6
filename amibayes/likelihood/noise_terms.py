"""Data that share one unknown amount of extra noise, at the nodes of a quadrature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array

from amibayes.data.covariance import multiplied
from amibayes.data.observables import Observables
from amibayes.likelihood.chi2 import deviance, log_peak
from amibayes.likelihood.extra_noise import BOUND
from amibayes.units import BoolArray, FloatArray

MAX_INFLATION = 100.0
"""Largest total error, in units of the stated one, that the prior allows."""

PRIOR_STATED_ERRORS_CORRECT = 0.5
"""Prior probability that the stated errors are right."""

REACH_BELOW, REACH_ABOVE = 4.5, 6.0
"""Nodes reach this many of its errors below and above what the fits say of the noise."""

NODES_PER_SIGMA, MIN_NODES, MAX_NODES = 1.0, 6, 64

BOTH = "vis2 and closure phase"


@dataclass(frozen=True, eq=False)
class NoiseTerm:
    """Data that share one unknown amount of extra noise, at nodes of a quadrature.

    Parameters
    ----------
    kind : {"vis2", "closure_phase_rad", "vis2 and closure phase"}
        The last where the file correlates both: then they share the relative amount.
    whitening : tuple of sparse array
        Factors of the matrix (rank, n_data) that whitens the whole data vector, the first applied
        last; it also makes the extra noise's covariance diagonal.
    share : (rank,) float array
        Variance of the extra noise of one typical error, in whitened units.
    typical : dict
        Median stated error of each kind (V², or radians).
    log_det : float
        Logarithm of the determinant of the stated covariance.
    degrees : float
        Degrees of freedom of the t distribution of the data; infinite for a Gaussian.
    node : (n_nodes,) float array
        ln(total error/stated error) at the nodes; the first is 0, the stated error.
    edges : (n_nodes,) float array
        Ends of the ranges that the others stand for, one more than those.
    log_prior : (n_nodes,) float array
        Logarithm of the prior probability that each stands for.
    source : str
        The file whose data they are, where files are told apart.
    width : dict
        Width of the half-normal prior of the extra noise of each kind, in its unit.
    """

    kind: str
    whitening: tuple[csr_array, ...]
    share: FloatArray
    typical: dict[str, float]
    log_det: float
    degrees: float = np.inf
    node: FloatArray = field(default_factory=lambda: np.zeros(1))
    edges: FloatArray = field(default_factory=lambda: np.zeros(1))
    log_prior: FloatArray = field(default_factory=lambda: np.zeros(1))
    source: str = ""
    width: dict[str, float] = field(default_factory=dict)

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return len(self.share)

    def white(self, difference: FloatArray) -> FloatArray:
        """Whitened data minus model (rank, n) of those that are not, (n_data, n)."""
        return multiplied(self.whitening, difference)

    def log_likelihoods(self, difference: FloatArray, node: FloatArray) -> FloatArray:
        """ln L (n_nodes, n) of data minus model (n_data, n) for amounts of noise (n_nodes,)."""
        return self.log_likelihoods_of_white(self.white(difference), node)

    def log_likelihoods_of_white(self, white: FloatArray, node: FloatArray) -> FloatArray:
        """The same of whitened data minus model (rank, n)."""
        variance = self._variance(node)
        n = self.n_independent
        norm = log_peak(n, self.degrees) - 0.5 * (np.log(variance).sum(axis=1) + self.log_det)
        chi2 = (1.0 / variance) @ white**2
        return np.asarray(norm[:, None] - 0.5 * deviance(chi2, n, self.degrees))

    def fisher(self, slopes: FloatArray) -> FloatArray:
        """Fisher matrices (n_nodes, d, d) at the nodes, of slopes of the data (n_data, d)."""
        white = self.white(slopes)
        return np.array([white.T @ (white / row[:, None]) for row in self._variance(self.node)])

    def _variance(self, node: FloatArray) -> FloatArray:
        """Variances of whitened data for amounts of noise (n_nodes,), (n_nodes, rank)."""
        return 1.0 + np.outer(np.expm1(2.0 * node), self.share)

    def log_parts(self, difference: FloatArray) -> FloatArray:
        """Logarithm of likelihood times prior at the nodes, (n_nodes, n)."""
        return self.log_parts_of_white(self.white(difference))

    def log_parts_of_white(self, white: FloatArray) -> FloatArray:
        """The same of whitened data minus model (rank, n)."""
        return self.log_likelihoods_of_white(white, self.node) + self.log_prior[:, None]

    def best(self, difference: FloatArray) -> float:
        """Most likely ln(total error/stated error) of residuals (n_data,)."""

        def loss(node: float) -> float:
            at = np.array([node])
            found = self.log_likelihoods(difference[:, None], at)[0, 0]
            return float(-found - self.log_prior_of(at)[0])

        found = minimize_scalar(loss, bounds=(0.0, self.largest), method="bounded")
        return float(found.x)

    def log_prior_of(self, node: FloatArray) -> FloatArray:
        """Logarithm of the half-normal prior at nodes, any shape, 0 without extra noise."""
        squares = [(self.amounts(node, k) / w) ** 2 for k, w in self.width.items()]
        return np.asarray(-0.5 * np.sum(squares, axis=0) if squares else np.zeros_like(node))

    @property
    def largest(self) -> float:
        """Largest ln(total error/stated error) that the prior allows."""
        within = [BOUND * w / self.typical[k] for k, w in self.width.items()]
        return float(min([np.log(MAX_INFLATION), *(0.5 * np.log1p(np.square(within)))]))

    def amounts(self, node: FloatArray, name: str) -> FloatArray:
        """Extra noise of a kind of observable for values of ln(total/stated), any shape."""
        return np.asarray(self.typical[name] * np.sqrt(np.expm1(2.0 * np.maximum(node, 0.0))))


def kinds_of(
    stated: Observables, here: BoolArray | None = None
) -> list[tuple[str, BoolArray, dict[str, float]]]:
    """Name, mask (n_data,) and typical errors of data that share their noise.

    One entry for each kind of observable, or one for both where the file correlates them; of
    all data, or only of those ``here`` (n_data,).
    """
    here = np.ones(stated.covariance.size, dtype=bool) if here is None else here
    n = stated.n_vis2
    vis2 = np.arange(stated.covariance.size) < n
    kinds = {"vis2": vis2 & here, "closure_phase_rad": ~vis2 & here}
    typical = {
        name: float(np.sqrt(np.median(stated.covariance.variance[which])))
        for name, which in kinds.items()
        if which.any()
    }
    if len(typical) == 2 and not _separate(stated, n):
        return [(BOTH, here, typical)]
    return [(name, kinds[name], {name: typical[name]}) for name in typical]


def _separate(stated: Observables, n_vis2: int) -> bool:
    sides = [stack.index < n_vis2 for stack in stated.covariance.stacks]
    return all((side == side[:, :1]).all() for side in sides)


def with_nodes(term: NoiseTerm, differences: Sequence[FloatArray]) -> NoiseTerm:
    """Gauss–Legendre nodes over what the fits say of the noise."""
    best = [term.best(d) for d in differences]
    error = 1.0 / np.sqrt(2.0 * term.n_independent)
    # Few data leave a long tail above: ln L falls by n per unit there.
    above = max(REACH_ABOVE * error, 2.0 * REACH_ABOVE / term.n_independent)
    most = term.largest
    low = max(min(best) - REACH_BELOW * error, 0.0)
    high = min(max(best) + above, most)
    low = max(min(low, high - error), 0.0)
    wanted = int(np.ceil(NODES_PER_SIGMA * (high - low) / error))
    x, w = np.polynomial.legendre.leggauss(int(np.clip(wanted, MIN_NODES, MAX_NODES)))
    share = 0.5 * (high - low) * w
    node = low + 0.5 * (high - low) * (1.0 + x)
    mass = np.concatenate(
        [
            [PRIOR_STATED_ERRORS_CORRECT],
            (1.0 - PRIOR_STATED_ERRORS_CORRECT)
            * share
            * np.exp(term.log_prior_of(node))
            / _prior_mass(term, most),
        ]
    )
    return replace(
        term,
        node=np.concatenate([[0.0], node]),
        edges=low + np.concatenate([[0.0], np.cumsum(share)]),
        log_prior=np.log(np.maximum(mass, 1e-300)),
    )


def _prior_mass(term: NoiseTerm, most: float) -> float:
    """Integral of the half-normal prior over the logarithm of the total error."""
    x, w = np.polynomial.legendre.leggauss(PRIOR_NODES)
    node = 0.5 * most * (1.0 + x)
    return float(0.5 * most * w @ np.exp(term.log_prior_of(node)))


PRIOR_NODES = 64
"""Nodes of the integral of a smooth prior over the five units that ln(100) is."""
