"""The likelihood with the extra noise integrated over: for posteriors and evidences.

A search needs one covariance, and takes the most likely extra noise
(`amibayes.likelihood.extra_noise`).
An interval must not pretend to know it: here each kind of observable has its own unknown noise.
With even odds there is none, else the total error is log-uniform from the stated one upward;
the likelihood is the mean over that. Both covariances, C as stated and N of the extra noise,
are made diagonal together once (W C Wᵀ = 1, W N Wᵀ = Λ), so that χ² and determinant for any
amount s² of noise are Σ y²/(1 + s²Λ) and Π (1 + s²Λ): all amounts cost one product of matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.sparse import csr_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.special import logsumexp

from amibayes.data.covariance import DiagonalCovariance, as_blocks
from amibayes.data.observables import Observables
from amibayes.likelihood.extra_noise import ExtraNoise, add_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import MAX_EXPONENT, FittedNoise, NoiseModel, deviance, log_peak
from amibayes.likelihood.quadrature import Marginal
from amibayes.likelihood.residuals import files_of, groups_of
from amibayes.units import BoolArray, FloatArray, IntArray

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
    whitening : (rank, n_data) sparse array
        Of the whole data vector; also makes the extra noise's covariance diagonal.
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
    """

    kind: str
    whitening: csr_array
    share: FloatArray
    typical: dict[str, float]
    log_det: float
    degrees: float = np.inf
    node: FloatArray = field(default_factory=lambda: np.zeros(1))
    edges: FloatArray = field(default_factory=lambda: np.zeros(1))
    log_prior: FloatArray = field(default_factory=lambda: np.zeros(1))
    source: str = ""

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return len(self.share)

    def log_likelihoods(self, difference: FloatArray, node: FloatArray) -> FloatArray:
        """ln L (n_nodes, n) of data minus model (n_data, n) for amounts of noise (n_nodes,)."""
        variance = 1.0 + np.outer(np.expm1(2.0 * node), self.share)
        n = self.n_independent
        norm = log_peak(n, self.degrees) - 0.5 * (np.log(variance).sum(axis=1) + self.log_det)
        chi2 = (1.0 / variance) @ np.asarray(self.whitening @ difference) ** 2
        return np.asarray(norm[:, None] - 0.5 * deviance(chi2, n, self.degrees))

    def log_parts(self, difference: FloatArray) -> FloatArray:
        """Logarithm of likelihood times prior at the nodes, (n_nodes, n)."""
        return self.log_likelihoods(difference, self.node) + self.log_prior[:, None]

    def best(self, difference: FloatArray) -> float:
        """Most likely ln(total error/stated error) of residuals (n_data,)."""

        def loss(node: float) -> float:
            return float(-self.log_likelihoods(difference[:, None], np.array([node]))[0, 0])

        found = minimize_scalar(loss, bounds=(0.0, np.log(MAX_INFLATION)), method="bounded")
        return float(found.x)

    def amounts(self, node: FloatArray, name: str) -> FloatArray:
        """Extra noise of a kind of observable for values of ln(total/stated), any shape."""
        return np.asarray(self.typical[name] * np.sqrt(np.expm1(2.0 * np.maximum(node, 0.0))))


@dataclass(frozen=True, eq=False)
class NoisePosterior:
    """What the data say of the extra noise of one kind of observable.

    Parameters
    ----------
    probability_none : float
        Posterior probability that the stated errors are right.
    amount : Marginal
        Distribution of the extra noise, that at zero included.
    """

    probability_none: float
    amount: Marginal

    def interval(self, level: float = 0.68) -> tuple[float, float, float]:
        """(median, lower, upper) of the extra noise."""
        wanted = np.array([0.5 - 0.5 * level, 0.5, 0.5 + 0.5 * level])
        none = wanted <= self.probability_none
        low, mid, high = np.where(none, 0.0, self.amount.quantile(wanted))
        return float(mid), float(low), float(high)


@dataclass(frozen=True, eq=False)
class AveragedNoise(FittedNoise):
    """Noise of unknown amounts, averaged over; each `NoiseTerm` has one.

    What needs one covariance (χ², gradients, errors) takes that of the fit; only `log_prob`,
    and what a gain in it means, are of the average.

    Parameters
    ----------
    fit : NoiseModel
        The noise of the fit, the most likely amounts included.
    terms : tuple of NoiseTerm
        Their data make up the whole data vector.
    """

    terms: tuple[NoiseTerm, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """One name for each kind of observable (and file) of every term."""
        return tuple(_key(term, name) for term in self.terms for name in term.typical)

    def log_prob(self, residual: FloatArray) -> FloatArray:
        """Log-likelihood (n,) of residuals (n_data, n), averaged over the amounts."""
        parts = [logsumexp(term.log_parts(residual), axis=0) for term in self.terms]
        return np.asarray(np.sum(parts, axis=0))

    def delta_chi2(self, log_gain: FloatArray) -> FloatArray:
        """Δχ², at the noise of the fit itself, that goes with a gain in ln L over no companion.

        Without a companion the noise is larger: 2Δln L = n ln(1 + Δχ²/n), n of the term with
        the fewest data.
        """
        n = min(term.n_independent for term in self.terms)
        return np.asarray(n * np.expm1(np.minimum(2.0 * log_gain / n, MAX_EXPONENT)))

    def log_loss(self, delta_chi2: FloatArray) -> FloatArray:
        """What a Δχ² from the best fit costs in ln L, (n,)."""
        n = self.n_independent
        return np.asarray(0.5 * n * np.log1p(delta_chi2 / n))

    def posterior(self, residual: FloatArray) -> dict[str, NoisePosterior]:
        """Posterior of the amounts, given residuals (n_data, n) of equal weight.

        Keys are `parameters`: those of `ExtraNoise`, followed by a colon and the file where
        files are told apart; V² is dimensionless, closure phases are in radians.
        """
        out = {}
        for term in self.terms:
            log = term.log_parts(residual)
            share = np.exp(log - logsumexp(log, axis=0)).mean(axis=1)
            for name in term.typical:
                ends = term.amounts(term.edges, name)
                low, high = np.append(0.0, ends[:-1]), np.append(0.0, ends[1:])
                out[_key(term, name)] = NoisePosterior(float(share[0]), Marginal(low, high, share))
        return out


def _key(term: NoiseTerm, name: str) -> str:
    return f"{name}:{term.source}" if term.source else name


def averaged_noise(
    fit: NoiseModel,
    stated: Observables,
    fits: Sequence[tuple[Likelihood, FloatArray]],
    *,
    per_file: bool = False,
) -> AveragedNoise:
    """Average over the extra noise of each kind of observable.

    Parameters
    ----------
    fit : NoiseModel
        Of the search.
    stated : Observables
        The same data with the stated errors.
    fits : sequence of (Likelihood, (n_dim,) float array)
        Best fits of every model that will be weighed: nodes cover the noise each asks for.
    per_file : bool
        The noise of every file is unknown by itself; files that share errors (through their
        calibrators) are unknown together.

    Notes
    -----
    With probability `PRIOR_STATED_ERRORS_CORRECT` the stated errors are right; else the total
    error has Jeffreys' prior of a scale, from the stated error to `MAX_INFLATION` times that.
    """
    differences = differences_of(fits)
    data = stated.unflagged()
    parts = groups_of(data, per_file=per_file)
    # Files that share errors have one relative amount: their data cannot be told apart.
    whole = len(parts) > 1 and files_share_errors(data)
    parts = [("", np.ones(data.covariance.size, dtype=bool))] if whole else parts
    found = [_term(data, name, *kind) for name, here in parts for kind in kinds_of(data, here)]
    return AveragedNoise(fit, tuple(with_nodes(t, differences) for t in found))


def differences_of(fits: Sequence[tuple[Likelihood, FloatArray]]) -> list[FloatArray]:
    """Data minus model (n_data,) of each fit."""
    return [likelihood.difference(theta)[:, 0] for likelihood, theta in fits]


def files_share_errors(stated: Observables) -> bool:
    """Whether errors of different files are correlated, as shared calibrators make them."""
    data = stated.unflagged()
    if isinstance(data.covariance, DiagonalCovariance):
        return False
    number = np.empty(data.covariance.size, dtype=np.intp)
    for k, file in enumerate(files_of(data)):
        number[file.of_kind("vis2") | file.of_kind("cp")] = k
    return any(len(np.unique(number[b.index])) > 1 for b in as_blocks(data.covariance))


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
    if isinstance(stated.covariance, DiagonalCovariance):
        return True
    sides = [b.index < n_vis2 for b in as_blocks(stated.covariance)]
    return not any(s.any() and not s.all() for s in sides)


def _term(
    stated: Observables, source: str, kind: str, which: BoolArray, typical: dict[str, float]
) -> NoiseTerm:
    """Whiten some of the data and make their extra noise diagonal, block by block."""
    n = stated.n_vis2
    part = stated.select(which[:n], which[n:])
    blocks = as_blocks(part.covariance)
    noisy = as_blocks(add_noise(part, _amount(typical)).covariance)
    pairs = [(a.index, b.matrix - a.matrix) for a, b in zip(blocks, noisy, strict=True)]
    white = part.covariance.whitening
    turn, share = _diagonal(white @ _sparse(pairs, part.covariance.size) @ white.T)
    columns = np.flatnonzero(which)
    place = csr_array(
        (np.ones(len(columns)), (np.arange(len(columns)), columns)),
        shape=(len(columns), len(which)),
    )
    whitening, log_det = csr_array(turn @ white @ place), part.covariance.logdet()
    degrees = part.degrees_of_freedom
    return NoiseTerm(kind, whitening, share, typical, log_det, degrees, source=source)


def _amount(typical: dict[str, float]) -> ExtraNoise:
    return ExtraNoise(typical.get("vis2", 0.0), typical.get("closure_phase_rad", 0.0))


def _sparse(blocks: Sequence[tuple[IntArray, FloatArray]], size: int) -> csr_array:
    rows = np.concatenate([np.repeat(i, len(i)) for i, _ in blocks])
    columns = np.concatenate([np.tile(i, len(i)) for i, _ in blocks])
    values = np.concatenate([m.ravel() for _, m in blocks])
    return csr_array((values, (rows, columns)), shape=(size, size))


def _diagonal(matrix: csr_array) -> tuple[csr_array, FloatArray]:
    """Rotation (n, n) that makes a symmetric matrix diagonal, group by group, and the diagonal."""
    n = matrix.shape[0]
    matrix = csr_array(matrix)
    matrix.data[np.abs(matrix.data) < 1e-12 * np.abs(matrix.data).max()] = 0.0
    matrix.eliminate_zeros()
    count, label = connected_components(matrix, directed=False)
    if count == n:
        return csr_array(eye_array(n)), matrix.diagonal()
    groups = [np.flatnonzero(label == k) for k in range(count)]
    found = [np.linalg.eigh(matrix[g][:, g].toarray()) for g in groups]
    turn = _sparse([(g, vectors.T) for g, (_, vectors) in zip(groups, found, strict=True)], n)
    share = np.empty(n)
    for g, (values, _) in zip(groups, found, strict=True):
        share[g] = np.clip(values, 0.0, None)
    return turn, share


def with_nodes(term: NoiseTerm, differences: Sequence[FloatArray]) -> NoiseTerm:
    """Gauss–Legendre nodes over what the fits say of the noise."""
    best = [term.best(d) for d in differences]
    error = 1.0 / np.sqrt(2.0 * term.n_independent)
    # Few data leave a long tail above: ln L falls by n per unit there.
    above = max(REACH_ABOVE * error, 2.0 * REACH_ABOVE / term.n_independent)
    most = float(np.log(MAX_INFLATION))
    low = max(min(best) - REACH_BELOW * error, 0.0)
    high = min(max(best) + above, most)
    low = min(low, high - error)
    wanted = int(np.ceil(NODES_PER_SIGMA * (high - low) / error))
    x, w = np.polynomial.legendre.leggauss(int(np.clip(wanted, MIN_NODES, MAX_NODES)))
    share = 0.5 * (high - low) * w
    mass = np.concatenate(
        [[PRIOR_STATED_ERRORS_CORRECT], (1.0 - PRIOR_STATED_ERRORS_CORRECT) * share / most]
    )
    return replace(
        term,
        node=np.concatenate([[0.0], low + 0.5 * (high - low) * (1.0 + x)]),
        edges=low + np.concatenate([[0.0], np.cumsum(share)]),
        log_prior=np.log(mass),
    )
