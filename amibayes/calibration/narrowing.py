"""Errors that all data of a visit share, narrowed by calibrators that they move differently.

A constant of the detector, such as the coefficient of charge migration, moves target and
calibrators alike, each by as much as its charge makes it. Calibrators are single stars: where
their charges differ, what they differ by tells the constant. With x_k = T + m_k·δ + noise, m_k
the changes by one standard deviation of what is known, the response T free and δ of unit
variance before, δ follows by generalised least squares; scatter between the calibrators that it
does not explain enlarges its error.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.calibration.transfer import Transfer
from amibayes.data.observables import Observables
from amibayes.data.shared_errors import SharedErrors
from amibayes.units import FloatArray

RELATIVE_RANK = 1e-9
"""Closure phases that share baselines: 35 of 7 holes have 15 directions."""

TOLD = 0.01
"""Share of the variance below which nothing is changed: data of other calibrations share it."""


@dataclass(frozen=True, eq=False)
class Narrowed:
    """What calibrators tell of shared errors.

    Parameters
    ----------
    names : tuple of str
    mean : (r,) array
        In units of the standard deviations known before.
    root : (r, r) array
        A root of their covariance, the identity where nothing is told.
    """

    names: tuple[str, ...]
    mean: FloatArray
    root: FloatArray

    def of_transfer(self, transfer: Transfer) -> Transfer:
        """A calibrator's response with the mean taken off, and what is left of the errors."""
        changes = _changes(transfer.shared, self.names, len(transfer.value))
        shared = SharedErrors(self._renamed(), changes @ self.root)
        return replace(transfer, value=transfer.value - changes @ self.mean, shared=shared)

    def of_target(self, target: Observables) -> Observables:
        """The same of a target."""
        if target.shared is None:
            return target
        changes = _changes(target.shared, self.names, len(target.data))
        alone, off = target.without_shared_errors(), changes @ self.mean
        parts = {}
        for name, part in (
            ("vis2", off[: target.n_vis2]), ("closure_phase", off[target.n_vis2 :]),
        ):  # fmt: skip
            measured = getattr(alone, name)
            value = measured.value.copy()
            value[~measured.flag] -= part
            parts[name] = replace(measured, value=value)
        left = SharedErrors(self._renamed(), changes @ self.root)
        return replace(alone, **parts).with_shared_errors(left)

    def number(self, steps: Mapping[str, float]) -> tuple[float, float] | None:
        """Change of a number that these errors are of, and its standard deviation afterwards.

        Parameters
        ----------
        steps : mapping of str to float
            Changes of the number by one standard deviation of each error, by its name.

        Returns
        -------
        (float, float) or None
            None where one of its errors is none of these.
        """
        if not steps or not set(steps) <= set(self.names):
            return None
        step = np.array([steps.get(name, 0.0) for name in self.names])
        # Data are off by what one took out of them too much: the number is less by that.
        return -float(step @ self.mean), float(np.linalg.norm(step @ self.root))

    def _renamed(self) -> tuple[str, ...]:
        """Other names: one standard deviation is another one now, and mixes them."""
        told = " ".join(f"{x:.6g}" for x in (*self.mean, *np.diag(self.root)))
        return tuple(f"{k} of {name}, narrowed ({told})" for k, name in enumerate(self.names, 1))


def narrowed(transfers: Sequence[Transfer]) -> Narrowed | None:
    """Find shared errors from calibrators; None where they tell nothing.

    Parameters
    ----------
    transfers : sequence of Transfer
        Of single stars, phases on one branch. Errors that one of them does not have are left.
    """
    named = [set(t.shared.names) if t.shared is not None else set() for t in transfers]
    names = tuple(sorted(set.intersection(*named)))
    if len(transfers) < 2 or not names or set.union(*named) != set(names):
        return None
    seen = np.all([t.seen for t in transfers], axis=0)
    if not seen.any():
        return None
    normal, right, chi2, dof = _equations(transfers, names, seen)
    best = np.linalg.pinv(normal, hermitian=True) @ right
    left = max(chi2 - float(best @ right), 0.0)
    dof = max(dof - int(np.linalg.matrix_rank(normal, hermitian=True)), 1)
    scale = max(left / dof, 1.0)
    covariance = np.linalg.inv(normal / scale + np.eye(len(names)))
    if np.trace(np.eye(len(names)) - covariance) < TOLD:
        return None
    return Narrowed(names, covariance @ (right / scale), np.linalg.cholesky(covariance))


def _equations(
    transfers: Sequence[Transfer], names: tuple[str, ...], seen: FloatArray
) -> tuple[FloatArray, FloatArray, float, int]:
    """Normal matrix and right side with the response free; χ² without, degrees of freedom."""
    weights, columns = [], []
    for t in transfers:
        whole = t.covariance.toarray()[np.ix_(seen, seen)]
        weights.append(np.linalg.pinv(whole, rcond=RELATIVE_RANK, hermitian=True))
        changes = _changes(t.shared, names, len(t.value))
        columns.append(np.column_stack([changes, t.value])[seen])
    response = np.linalg.pinv(sum(weights), rcond=RELATIVE_RANK, hermitian=True)
    pairs = list(zip(weights, columns, strict=True))
    half = sum(w @ c for w, c in pairs)
    system = sum(c.T @ w @ c for w, c in pairs) - half.T @ response @ half
    rank = int(np.linalg.matrix_rank(weights[0], rtol=RELATIVE_RANK, hermitian=True))
    return system[:-1, :-1], system[:-1, -1], float(system[-1, -1]), rank * (len(transfers) - 1)


def _changes(shared: SharedErrors | None, names: tuple[str, ...], n: int) -> FloatArray:
    if shared is None:
        return np.zeros((n, len(names)))
    return np.stack([shared.change(name) for name in names], axis=1)
