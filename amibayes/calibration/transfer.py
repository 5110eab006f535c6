"""One calibrator's response on the keys of a target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_array, coo_array, csr_array, diags_array

from amibayes.calibration.matching import Keys, Match, match
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.observables import Observables
from amibayes.data.shared_errors import SharedErrors
from amibayes.scene.disc import uniform_disc
from amibayes.units import BoolArray, FloatArray, IntArray

Diameter = tuple[float, float]
"""Uniform-disc diameter of a calibrator and its error, mas."""


@dataclass(frozen=True, eq=False)
class Transfer:
    """The instrument's response by one calibrator: V² and closure phases.

    Parameters
    ----------
    value : (n_keys,) float array
        V² over that of the calibrator's disc; closure phase in radians. 0 where not seen.
    covariance : (n_keys, n_keys) sparse array
    seen : (n_keys,) bool array
    scatter : (n_keys, n_keys) sparse array, optional
        The covariance by measured scatter alone; see `amibayes.data.observables.Observables`.
    shared : SharedErrors, optional
        Errors in common with other data, of the keys; the covariances do not hold them.
    """

    value: FloatArray
    covariance: csr_array
    seen: BoolArray
    scatter: csr_array | None = None
    shared: SharedErrors | None = None

    @property
    def variance(self) -> FloatArray:
        """Diagonal of the covariance."""
        return np.asarray(self.covariance.diagonal())


def transfer_of(calibrator: Observables, keys: Keys, diameter: Diameter) -> Transfer:
    """Average a calibrator over its exposures, key by key, by inverse variance.

    Parameters
    ----------
    diameter : (diameter, error)
        Uniform disc in mas; the error makes all its V² err together.
    """
    shared, calibrator = calibrator.shared, calibrator.without_shared_errors()
    found = match(calibrator, keys)
    n_vis2 = calibrator.n_vis2
    scale, slope = _disc_correction(calibrator, found, diameter[0])
    value = calibrator.data[found.entry] * found.sign
    value = np.where(found.entry < n_vis2, value, _unwrapped(value, found.key, keys))
    weight = 1.0 / (calibrator.covariance.variance[found.entry] * scale**2)
    weight /= np.bincount(found.key, weight, len(keys))[found.key]
    combine = coo_array(
        (weight * scale * found.sign, (found.key, found.entry)),
        shape=(len(keys), calibrator.covariance.size),
    ).tocsr()
    scatter = calibrator.scatter
    covariance = combine @ calibrator.covariance.sparse @ combine.T
    scatter = None if scatter is None else combine @ scatter @ combine.T
    if diameter[1] > 0:
        by_disc = np.bincount(found.key, weight * value * slope, len(keys)) * diameter[1]
        common = csr_array(by_disc[:, None])
        covariance = covariance + common @ common.T
        scatter = None if scatter is None else scatter + common @ common.T
    return Transfer(
        np.bincount(found.key, weight * scale * value, len(keys)).astype(float),
        csr_array(covariance),
        np.bincount(found.key, minlength=len(keys)) > 0,
        None if scatter is None else csr_array(scatter),
        None if shared is None else SharedErrors(shared.names, combine @ shared.changes),
    )


def _unwrapped(value: FloatArray, key: IntArray, keys: Keys) -> FloatArray:
    """Phases of one key on one branch: within half a turn of the first."""
    first = np.zeros(len(keys))
    first[key[::-1]] = value[::-1]
    return np.asarray(first[key] + wrapped(value - first[key], keys.periodic[key]))


def on_one_branch(transfers: Sequence[Transfer], keys: Keys) -> list[Transfer]:
    """Closure phases of all calibrators within half a turn of the first one's."""
    first = np.zeros(len(transfers[0].value))
    for transfer in reversed(transfers):
        first[transfer.seen] = transfer.value[transfer.seen]
    out = []
    for transfer in transfers:
        near = first + wrapped(transfer.value - first)
        value = np.where(transfer.seen & keys.periodic, near, transfer.value)
        out.append(replace(transfer, value=value))
    return out


def wrapped(phase: FloatArray, periodic: BoolArray | bool = True) -> FloatArray:
    """Phase in [−π, π); one that is there already, or has no period, keeps every bit."""
    turns = np.where(periodic, np.floor((phase + np.pi) / (2 * np.pi)), 0.0)
    return np.where(turns == 0, phase, phase - 2 * np.pi * turns)


def _disc_correction(
    calibrator: Observables, found: Match, diameter_mas: float
) -> tuple[FloatArray, FloatArray]:
    """1/V² of the calibrator's disc for each match, and its slope per mas; 1, 0 for closures."""
    m = calibrator.vis2.select(~calibrator.vis2.flag)
    frequency = np.hypot(m.u_m[:, 0], m.v_m[:, 0]) / m.wavelength_m
    amplitude, slope = uniform_disc(frequency, diameter_mas)
    is_vis2 = found.entry < calibrator.n_vis2
    scale, change = np.ones(len(found.entry)), np.zeros(len(found.entry))
    entry = found.entry[is_vis2]
    scale[is_vis2] = 1.0 / amplitude[entry] ** 2
    change[is_vis2] = -2.0 * slope[entry] / amplitude[entry] ** 3
    return scale, change


@dataclass(frozen=True, eq=False)
class ClosureSet:
    """Triangles that share baselines: their keys, incidence matrix and kernel basis."""

    keys: IntArray
    matrix: FloatArray
    basis: FloatArray


def closure_sets(keys: Keys, seen: BoolArray) -> list[ClosureSet]:
    """The closure sets of what is seen."""
    kernels: dict[bytes, tuple[FloatArray, FloatArray]] = {}
    sets = []
    for entries in keys.closure_sets():
        entries = entries[seen[entries]]
        if len(entries):
            stations = keys.table[entries, 3:]
            name = stations.tobytes()
            if name not in kernels:
                matrix = closure_matrix(stations)[0]
                kernels[name] = matrix, kernel_basis(matrix)
            sets.append(ClosureSet(entries, *kernels[name]))
    return sets


def kernel_projector(keys: Keys, seen: BoolArray) -> csr_array:
    """The matrix (n_keys, n_keys) that keeps V² and of closure phases what baselines can make.

    Means with weights of their own for every triangle do not close; this makes them.
    """
    parts = [(s.keys, s.basis @ s.basis.T) for s in closure_sets(keys, seen)]
    vis2 = diags_array(seen[: keys.n_vis2].astype(float))
    n = len(keys) - keys.n_vis2
    if not parts or not n:
        return csr_array(block_array([[vis2, None], [None, csr_array((n, n))]]))
    rows = np.concatenate([np.repeat(k, len(k)) for k, _ in parts]) - keys.n_vis2
    columns = np.concatenate([np.tile(k, len(k)) for k, _ in parts]) - keys.n_vis2
    values = np.concatenate([p.ravel() for _, p in parts])
    closures = coo_array((values, (rows, columns)), shape=(n, n))
    if not keys.n_vis2:
        return csr_array(closures)
    return csr_array(block_array([[vis2, None], [None, closures]]))


__all__ = [
    "ClosureSet",
    "Diameter",
    "Transfer",
    "closure_sets",
    "kernel_projector",
    "on_one_branch",
    "transfer_of",
    "wrapped",
]
