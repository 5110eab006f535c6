"""The likelihood with the extra noise integrated over: for posteriors and evidences.

A search needs one covariance, and takes the most likely extra noise
(`amibayes.likelihood.extra_noise`).
An interval must not pretend to know it: here each kind of observable has its own unknown noise.
With even odds there is none, else the total error is log-uniform from the stated one upward;
the likelihood is the mean over that. Both covariances, C as stated and N of the extra noise,
are made diagonal together once (W C Wᵀ = 1, W N Wᵀ = Λ), so that χ² and determinant for any
amount s² of noise are Σ y²/(1 + s²Λ) and Π (1 + s²Λ): all amounts cost one product of matrices.
Where channels share noise no rows are independent for all amounts: those of the fitted one are
taken, with their variances for any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.csgraph import connected_components
from scipy.special import logsumexp

from amibayes.data.covariance import Covariance
from amibayes.data.observables import Observables
from amibayes.likelihood.channel_noise import (
    ChannelCovariance,
    noise_with_channels,
)
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior, add_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import MAX_EXPONENT, FittedNoise, NoiseModel
from amibayes.likelihood.noise_terms import (
    NoiseTerm,
    kinds_of,
    with_nodes,
)
from amibayes.likelihood.quadrature import Marginal, log_sum
from amibayes.likelihood.residuals import files_of, groups_of
from amibayes.units import BoolArray, FloatArray, IntArray


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
        parts = [log_sum(term.log_parts(residual)) for term in self.terms]
        return np.asarray(np.sum(parts, axis=0))

    def log_prob_of_sums(self, a: FloatArray, b: FloatArray, pairs: BoolArray) -> FloatArray:
        """Log-likelihoods (n, m) of sums of residuals (n_data, n) and (n_data, m).

        Both are whitened once; a pair costs a sum of whitened data.
        """
        out = np.full(pairs.shape, -np.inf)
        # One residual to a row: rows of pairs are then taken without strides.
        white = [[np.array(t.white(x).T, order="C") for x in (a, b)] for t in self.terms]
        for k in np.flatnonzero(pairs.any(axis=0)):
            which = pairs[:, k]
            parts = [
                log_sum(term.log_parts_of_white((one[which] + other[k]).T))
                for term, (one, other) in zip(self.terms, white, strict=True)
            ]
            out[which, k] = np.sum(parts, axis=0)
        return out

    def fisher(self, slopes: FloatArray, difference: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Of all combinations of the amounts of the terms, with likelihood times prior."""
        return _sums(
            [(term.fisher(slopes), term.log_parts(difference)[:, 0]) for term in self.terms]
        )

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
    noise: ExtraNoise | None = None,
    prior: NoisePrior | None = None,
) -> AveragedNoise:
    """Average over the extra noise of each kind of observable.

    Parameters
    ----------
    fit : NoiseModel
        Of the search.
    stated : Observables
        The same data with the stated errors.
    fits : sequence of (Likelihood, (n_dim,) float array)
        Best fits of every model that will be compared: nodes cover the noise each asks for.
    per_file : bool
        The noise of every file is unknown by itself; files that share errors (through their
        calibrators) are unknown together.
    noise : ExtraNoise, optional
        That was fitted: what channels of an exposure share, of the stated errors and of extra
        noise alike, and how much extra noise there is.
    prior : NoisePrior, optional

    Notes
    -----
    With probability `PRIOR_STATED_ERRORS_CORRECT` the stated errors are right; else the total
    error has Jeffreys' prior of a scale, from the stated error to `MAX_INFLATION` times that,
    times the half-normal one of `NoisePrior`.
    """
    prior, noise = prior or NoisePrior(), noise or ExtraNoise()
    differences = differences_of(fits)
    data = stated.unflagged()
    parts = groups_of(data, per_file=per_file)
    # Files that share errors have one relative amount: their data cannot be told apart.
    whole = len(parts) > 1 and files_share_errors(data)
    parts = [("", np.ones(data.covariance.size, dtype=bool))] if whole else parts
    found = [
        _term(data, name, *kind, noise, prior)
        for name, here in parts
        for kind in kinds_of(data, here)
    ]
    return AveragedNoise(fit, tuple(with_nodes(t, differences) for t in found))


def errors_beside_noise(likelihood: Likelihood, theta: FloatArray) -> FloatArray | None:
    """Covariance (n_dim, n_dim) of the parameters of a fit, averaged over the amounts of noise.

    The mean of the inverse Fisher matrices of all amounts, each with its share in the likelihood of
    the residuals and the volume that it leaves to the parameters: `Likelihood.errors` knows the
    amounts of the fit alone, and noise that no test noticed is not in them.

    Parameters
    ----------
    likelihood : Likelihood
        None is given where its noise has no unknown amounts, or its covariance was estimated.
    theta : (n_dim,) float array
        The best fit.
    """
    if not likelihood.noise.parameters or np.isfinite(likelihood.degrees):
        return None
    slopes = likelihood.slopes(likelihood.sized(theta))
    scale = np.linalg.norm(slopes, axis=0)
    scale[scale == 0.0] = 1.0
    fisher, log_weight = likelihood.noise.fisher(slopes / scale, likelihood.difference(theta))
    log_weight = log_weight - 0.5 * _log_volume(fisher)
    weight = np.exp(log_weight - log_weight.max())
    inverse = np.linalg.pinv(fisher, hermitian=True)
    mean = np.tensordot(weight / weight.sum(), inverse, axes=1)
    return np.asarray(mean / np.outer(scale, scale))


def _sums(each: list[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Fisher matrices of all combinations of nodes of terms, and their log likelihoods.

    Beyond `MAX_COMBINED` the other terms count with their mean: of many files the sum is known.
    """
    each = sorted(each, key=lambda one: -len(one[1]))
    fisher, log_weight = each[0]
    for own, log_own in each[1:]:
        if len(log_weight) * len(log_own) > MAX_COMBINED:
            share = np.exp(log_own - logsumexp(log_own))
            own, log_own = np.tensordot(share, own, axes=1)[None], np.zeros(1)
        fisher = (fisher[:, None] + own).reshape(-1, *own.shape[1:])
        log_weight = np.add.outer(log_weight, log_own).ravel()
    return fisher, log_weight


MAX_COMBINED = 5000
"""Combinations of amounts of noise: two kinds of data have 65² at most."""


def _log_volume(fisher: FloatArray) -> FloatArray:
    """ln of the determinants (n,) of matrices (n, d, d), of directions that the data tell."""
    values = np.linalg.eigvalsh(fisher)
    told = values > 1e-14 * values[:, -1:]
    return np.asarray(np.log(values, where=told, out=np.zeros_like(values)).sum(axis=1))


def differences_of(fits: Sequence[tuple[Likelihood, FloatArray]]) -> list[FloatArray]:
    """Data minus model (n_data,) of each fit."""
    return [likelihood.difference(theta)[:, 0] for likelihood, theta in fits]


def files_share_errors(stated: Observables) -> bool:
    """Whether errors of different files are correlated, as shared calibrators make them."""
    data = stated.unflagged()
    number = np.empty(data.covariance.size, dtype=np.intp)
    for k, file in enumerate(files_of(data)):
        number[file.of_kind("vis2") | file.of_kind("cp")] = k
    files = [number[stack.index] for stack in data.covariance.stacks]
    return any((of != of[:, :1]).any() for of in files)


def _term(
    stated: Observables,
    source: str,
    kind: str,
    which: BoolArray,
    typical: dict[str, float],
    noise: ExtraNoise,
    prior: NoisePrior,
) -> NoiseTerm:
    """Whiten some of the data and make their extra noise diagonal, block by block."""
    n = stated.n_vis2
    part = stated.select(which[:n], which[n:])
    extra = csr_array(add_noise(part, _amount(typical)).covariance.sparse - part.covariance.sparse)
    sources = {s.source for s in part.setups}
    floors = [f for f in prior.floors if f.source in sources]
    fitted = add_noise(part, noise)
    covariance = noise_with_channels(fitted, noise.channels, floors).covariance
    if isinstance(covariance, ChannelCovariance):
        added = csr_array(fitted.covariance.sparse - part.covariance.sparse)
        whitening, share, log_det = _about(covariance, added, extra)
    else:
        together, share = _together(part.covariance, extra)
        whitening = (together,)
        log_det = part.covariance.logdet()
    columns = np.flatnonzero(which)
    place = csr_array(
        (np.ones(len(columns)), (np.arange(len(columns)), columns)),
        shape=(len(columns), len(which)),
    )
    return NoiseTerm(
        kind,
        (*whitening[:-1], csr_array(whitening[-1] @ place)),
        share,
        typical,
        log_det,
        part.degrees_of_freedom,
        source=source,
        width={name: prior.width(part, name) for name in typical},
    )


def _together(covariance: Covariance, extra: csr_array) -> tuple[csr_array, FloatArray]:
    """Whitening that makes another covariance diagonal as well, and that diagonal."""
    white = covariance.whitening
    turn, share = _diagonal(csr_array(white @ extra @ white.T))
    return csr_array(turn @ white), share


def _about(
    covariance: ChannelCovariance, added: csr_array, extra: csr_array
) -> tuple[tuple[csr_array, ...], FloatArray, float]:
    """The same, in factors, where channels share some of the noise, and ln of the determinant.

    ``covariance`` has the noise ``added`` that was fitted. Channels share as much of the extra
    noise as of the errors, and which combinations of them err independently goes with its amount:
    they are those of the fitted amount, which the posterior is about. There the likelihood is
    that of the fit. Elsewhere a row has its own variance.
    """
    white, rows = covariance.base.whitening, covariance.rows

    def of_rows(matrix: csr_array) -> FloatArray:
        channels = np.asarray((white @ matrix).multiply(white).sum(axis=1))
        return np.asarray(rows.growing * (rows.rotation.power(2) @ channels))

    stated = 1.0 - of_rows(added)
    first, *rest = covariance.factors
    whitening = csr_array(diags_array(1.0 / np.sqrt(stated)) @ first), *rest
    return whitening, of_rows(extra) / stated, covariance.logdet() + float(np.log(stated).sum())


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
