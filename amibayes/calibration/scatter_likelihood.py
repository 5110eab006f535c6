"""Likelihood of the scatter between calibrators, the instrument's response integrated out.

Calibrator j sees the response k of the instrument with its own deviation,
z_j = D_j k + δ_j + n_j, where n_j has the covariance of its data and δ_j a variance τ² per
observable type: τ² for every V², and for closure phases that of independent baseline phases,
τ² K Kᵀ/3, so that every closure phase scatters by τ and shared baselines correlate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from amibayes.calibration.matching import Keys
from amibayes.calibration.transfer import ClosureSet, Transfer, closure_sets
from amibayes.units import BoolArray, FloatArray, IntArray

PRIOR_WIDTH = 5.0
"""Scale of the half-normal prior of τ in units of the median error of its type."""

AT_ONCE = 2e7
"""Numbers (160 MB) in the matrices of as many scatters as are computed together."""


@dataclass(frozen=True, eq=False)
class Group:
    """Components of one size: sets of keys tied by correlations or shared baselines.

    g components, J calibrators, r parameters (V² and kernel phases) each; what a calibrator
    does not see is padded with unit noise and no signal.

    Parameters
    ----------
    keys : list of int array
        Keys of each component.
    basis : list of (n_keys, r) float array
        From parameters to keys.
    design : (g, J, r, q) float array
        From parameters (q = r, or 2r with a slope) to what a calibrator sees.
    data : (g, J, r) float array
    noise : (g, J, r, r) float array
    scatter : (2, g, J, r, r) float array
        Covariance between calibrators at τ = 1, of V² and of closure phase.
    target_scatter : (2, g, r, r) float array
        The same for the target.
    """

    keys: list[IntArray]
    basis: list[FloatArray]
    design: FloatArray
    data: FloatArray
    noise: FloatArray
    scatter: FloatArray
    target_scatter: FloatArray

    def log_likelihood(self, tau: FloatArray) -> FloatArray:
        """Marginal likelihood of scatters τ, the response integrated out, (n, 2) → (n,)."""
        log_det, chi2, fisher, moment = self._normal_equations(tau)
        explained = (moment * np.linalg.solve(fisher, moment)).sum(axis=(-2, -1))
        log_det = log_det + np.linalg.slogdet(fisher)[1]
        return np.asarray(-0.5 * (log_det + chi2 - explained).sum(axis=-1))

    def response(self, tau: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (n, g, q) and covariance (n, g, q, q) of the parameters at scatters τ, (n, 2).

        Without the scatter of the target itself.
        """
        _, _, fisher, moment = self._normal_equations(tau)
        inverse = np.asarray(np.linalg.inv(fisher), dtype=np.float64)
        return (inverse @ moment)[..., 0], inverse

    def _normal_equations(
        self, tau: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """ln|M|, zᵀM⁻¹z, DᵀM⁻¹D and DᵀM⁻¹z, summed over calibrators, M = N + τ²B."""
        square = tau[:, :, None, None, None, None] ** 2
        total = self.noise + square[:, 0] * self.scatter[0] + square[:, 1] * self.scatter[1]
        lower, white = _whiten(total, np.concatenate([self.design, self.data[..., None]], axis=-1))
        gram = (white.swapaxes(-1, -2) @ white).sum(axis=2)
        log_det = 2 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(axis=(-2, -1))
        return np.asarray(log_det), gram[..., -1, -1], gram[..., :-1, :-1], gram[..., :-1, -1:]


def _whiten(matrix: FloatArray, right: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cholesky factor L of the matrices, and L⁻¹ times the right-hand sides."""
    if matrix.shape[-1] == 1:
        lower = np.asarray(np.sqrt(matrix), dtype=np.float64)
        return lower, np.asarray(right / lower, dtype=np.float64)
    lower = np.asarray(np.linalg.cholesky(matrix), dtype=np.float64)
    right = np.broadcast_to(right, (*lower.shape[:-1], right.shape[-1]))
    return lower, np.asarray(np.linalg.solve(lower, right), dtype=np.float64)


@dataclass(frozen=True, eq=False)
class Population:
    """All components, and the prior of the scatters.

    Parameters
    ----------
    groups : tuple of Group
    prior_scale : (2,) float array
        Of τ for V² and closure phase; NaN for a kind that is absent.
    """

    groups: tuple[Group, ...]
    prior_scale: FloatArray

    def log_prob(self, tau: FloatArray) -> FloatArray:
        """Logarithm of the posterior density of τ, (n, 2) → (n,)."""
        allowed = np.asarray((tau >= 0).all(axis=1))
        safe = np.where(allowed[:, None], tau, 0.0)
        largest = max((group.noise.size for group in self.groups), default=1)
        parts = np.array_split(safe, 1 + int(len(safe) * largest / AT_ONCE))
        log_l = np.concatenate([sum(g.log_likelihood(part) for g in self.groups) for part in parts])
        scaled = safe / np.where(np.isfinite(self.prior_scale), self.prior_scale, 1.0)
        return np.where(allowed, log_l - 0.5 * (scaled**2).sum(axis=1), -np.inf)


def population_of(
    transfers: Sequence[Transfer],
    keys: Keys,
    known: BoolArray,
    covariate: FloatArray | None = None,
) -> Population:
    """Lay calibrators out for the fit.

    Parameters
    ----------
    known : (n_keys,) bool array
        Keys that at least one calibrator sees.
    covariate : (n_calibrators,) float array, optional
        Calibrator's charge level (or brightness) less that of the target; the response then
        depends on it linearly, with a slope for every parameter.
    """
    seen_sets = [closure_sets(keys, t.seen & known) for t in transfers]
    target_sets = closure_sets(keys, known)
    label = _components(transfers, known, target_sets)
    built: dict[int, list[_Component]] = {}
    for entries in _members(label, known):
        component = _component(entries, transfers, keys, target_sets, seen_sets, covariate)
        built.setdefault(component.basis.shape[1], []).append(component)
    groups = tuple(_stack(parts) for parts in built.values())
    return Population(groups, PRIOR_WIDTH * _median_errors(transfers, keys.n_vis2, known))


def _median_errors(transfers: Sequence[Transfer], n_vis2: int, known: BoolArray) -> FloatArray:
    out = []
    for part in (slice(0, n_vis2), slice(n_vis2, None)):
        sigma = [np.sqrt(t.variance[part][(t.seen & known)[part]]) for t in transfers]
        pooled = np.concatenate(sigma)
        out.append(np.median(pooled) if len(pooled) else np.nan)
    return np.array(out)


def _components(
    transfers: Sequence[Transfer], known: BoolArray, sets: list[ClosureSet]
) -> IntArray:
    """Label of each key: keys tied by a correlation or by shared baselines have one label."""
    n = len(known)
    tied = sum((abs(t.covariance) for t in transfers), csr_array((n, n))).tocoo()
    first = np.concatenate([tied.row, *(s.keys[:-1] for s in sets)])
    second = np.concatenate([tied.col, *(s.keys[1:] for s in sets)])
    links = coo_array((np.ones(len(first)), (first, second)), shape=(n, n))
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.intp)


def _members(label: IntArray, known: BoolArray) -> list[IntArray]:
    entries = np.flatnonzero(known)
    order = entries[np.argsort(label[entries], kind="stable")]
    return list(np.split(order, np.flatnonzero(np.diff(label[order])) + 1))


@dataclass(frozen=True, eq=False)
class _Component:
    keys: IntArray
    basis: FloatArray
    design: FloatArray
    data: FloatArray
    noise: FloatArray
    scatter: FloatArray
    target_scatter: FloatArray


def _component(
    entries: IntArray,
    transfers: Sequence[Transfer],
    keys: Keys,
    target_sets: list[ClosureSet],
    seen_sets: list[list[ClosureSet]],
    covariate: FloatArray | None,
) -> _Component:
    basis, target_scatter = _basis(entries, entries, keys.n_vis2, target_sets)
    r = basis.shape[1]
    slopes = 1 if covariate is None else 2
    design, data = np.zeros((len(transfers), r, slopes * r)), np.zeros((len(transfers), r))
    noise = np.tile(np.eye(r), (len(transfers), 1, 1))
    scatter = np.zeros((2, len(transfers), r, r))
    for j, transfer in enumerate(transfers):
        seen = entries[transfer.seen[entries]]
        own, between = _basis(entries, seen, keys.n_vis2, seen_sets[j])
        q = own.shape[1]
        inner = own.T @ basis
        design[j, :q, :r] = inner
        if covariate is not None:
            design[j, :q, r:] = covariate[j] * inner
        data[j, :q] = own.T @ transfer.value[entries]
        matrix = transfer.covariance[entries][:, entries].toarray()
        noise[j, :q, :q] = own.T @ matrix @ own
        scatter[:, j, :q, :q] = between
    return _Component(entries, basis, design, data, noise, scatter, target_scatter)


def _basis(
    entries: IntArray, seen: IntArray, n_vis2: int, sets: list[ClosureSet]
) -> tuple[FloatArray, FloatArray]:
    """Basis (n_entries, q) of what is seen, and the two scatters in it, (2, q, q), at τ = 1."""
    place = {int(key): i for i, key in enumerate(entries)}
    vis2 = [place[int(key)] for key in seen if key < n_vis2]
    ours = [s for s in sets if int(s.keys[0]) in place]
    q = len(vis2) + sum(s.basis.shape[1] for s in ours)
    basis, scatter = np.zeros((len(entries), q)), np.zeros((2, q, q))
    basis[vis2, np.arange(len(vis2))] = 1.0
    scatter[0, np.arange(len(vis2)), np.arange(len(vis2))] = 1.0
    column = len(vis2)
    for s in ours:
        span = slice(column, column + s.basis.shape[1])
        basis[[place[int(key)] for key in s.keys], span] = s.basis
        inner = s.basis.T @ s.matrix
        scatter[1, span, span] = inner @ inner.T / 3.0
        column = span.stop
    return basis, scatter


def _stack(parts: list[_Component]) -> Group:
    return Group(
        [p.keys for p in parts],
        [p.basis for p in parts],
        np.array([p.design for p in parts]),
        np.array([p.data for p in parts]),
        np.array([p.noise for p in parts]),
        np.stack([p.scatter for p in parts], axis=1),
        np.stack([p.target_scatter for p in parts], axis=1),
    )
