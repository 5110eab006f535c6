"""Calibrators combined by inverse variance: the field's way, with its scatter and its clipping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.stats import chi2

from amibayes.calibration.matching import Keys
from amibayes.calibration.transfer import Transfer, kernel_projector
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.shared_errors import SharedErrors
from amibayes.units import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class TransferFunction:
    """The response of the instrument when the target was observed.

    Parameters
    ----------
    value : (n_keys,) float array
    covariance : (n_keys, n_keys) sparse array
        Includes what the target, one more draw, may differ by.
    known : (n_keys,) bool array
    tau : (n_samples, 2) float array, optional
        Posterior draws of the scatter between calibrators of V² and closure phase (radians);
        NaN for a kind that is absent.
    freedom : Freedom, optional
        Of the covariance, where calibrators have estimated ones.
    scatter : (n_keys, n_keys) sparse array, optional
        The covariance by the scatter of the calibrators' integrations alone, where it is known.
    shared : SharedErrors, optional
        Errors in common with other data; the covariances do not hold them.
    unlike : tuple of (int, float)
        Calibrators of a population that are far from what the others predict, by number, and
        their χ² per datum.
    """

    value: FloatArray
    covariance: csr_array
    known: BoolArray
    tau: FloatArray | None = None
    freedom: Freedom | None = None
    scatter: csr_array | None = None
    shared: SharedErrors | None = None
    unlike: tuple[tuple[int, float], ...] = ()


def clipped(transfers: Sequence[Transfer], keys: Keys, clip: float) -> list[Transfer]:
    """Leave out values that are outliers among the calibrators.

    A value is compared with the mean of the others, in units of its error, the scatter that
    all keys of its type show between calibrators, and the error of that mean. The worst value
    of a key goes while it departs by more than ``clip``, as long as two remain: between two
    that disagree there is no telling which is wrong.
    """
    value = np.array([t.value for t in transfers])
    variance = np.array([t.variance for t in transfers])
    seen = np.array([t.seen for t in transfers])
    while True:
        total = variance + _excess(value, variance, seen, keys.n_vis2)
        off = np.where(seen & (seen.sum(axis=0) > 2), _departure(value, total, seen), 0.0)
        worst = np.argmax(off, axis=0)
        bad = np.flatnonzero(off.max(axis=0) > clip)
        if not len(bad):
            break
        seen[worst[bad], bad] = False
    return [replace(t, seen=s) for t, s in zip(transfers, seen, strict=True)]


def _inverse(variance: FloatArray, seen: BoolArray) -> FloatArray:
    """1/σ² of what is seen, 0 elsewhere."""
    return np.divide(1.0, variance, out=np.zeros_like(variance), where=seen)


def _departure(value: FloatArray, variance: FloatArray, seen: BoolArray) -> FloatArray:
    """|value − mean of the others| in standard deviations, (n_calibrators, n_keys)."""
    weight = _inverse(variance, seen)
    with np.errstate(divide="ignore", invalid="ignore"):
        others = weight.sum(axis=0) - weight
        mean = ((weight * value).sum(axis=0) - weight * value) / others
        off = np.abs(value - mean) / np.sqrt(variance + 1.0 / others)
    return np.asarray(np.nan_to_num(off))


def _excess(value: FloatArray, variance: FloatArray, seen: BoolArray, n_vis2: int) -> FloatArray:
    """Variance between calibrators beyond the errors, one number per type, (n_keys,).

    From the median over the keys of a type, so that a few outliers do not hide themselves.
    """
    count = seen.sum(axis=0)
    several = count >= 2
    degrees = np.maximum(count - 1, 1)
    mean = np.where(seen, value, 0.0).sum(axis=0) / np.maximum(count, 1)
    scatter = np.where(seen, (value - mean) ** 2, 0.0).sum(axis=0) / degrees
    # The median of χ²/ν is below 1: put the scatter on the scale of a variance.
    scatter /= chi2.ppf(0.5, degrees) / degrees
    expected = np.where(seen, variance, 0.0).sum(axis=0) / np.maximum(count, 1)
    out = np.zeros(value.shape[1])
    for part in (slice(0, n_vis2), slice(n_vis2, None)):
        chosen = several[part]
        if chosen.any():
            out[part] = max(np.median((scatter - expected)[part][chosen]), 0.0)
    return out


def weighted_response(transfers: Sequence[Transfer], keys: Keys) -> TransferFunction:
    """Inverse-variance mean of calibrators, key by key, and its full covariance.

    The error of a mean is that of its weights, or that of the scatter between calibrators
    where it is larger; closure phases are then brought back to what baselines can make.
    """
    value = np.array([t.value for t in transfers])
    seen = np.array([t.seen for t in transfers])
    known = np.asarray(seen.any(axis=0))
    raw = _inverse(np.array([t.variance for t in transfers]), seen)
    weight = raw / np.where(known, raw.sum(axis=0), 1.0)
    mean = (weight * value).sum(axis=0)
    degrees = np.maximum(seen.sum(axis=0) - 1, 1)
    birge = np.sqrt((raw * (value - mean) ** 2).sum(axis=0) / degrees)
    inflate = kernel_projector(keys, known) @ diags_array(np.maximum(birge, 1.0))
    scatters = [t.covariance if t.scatter is None else t.scatter for t in transfers]
    measured = any(t.scatter is not None for t in transfers)
    return TransferFunction(
        kernel_projector(keys, known) @ mean,
        _combined(inflate, weight, [t.covariance for t in transfers]),
        known,
        scatter=_combined(inflate, weight, scatters) if measured else None,
        shared=shared_changes(
            transfers, lambda own: kernel_projector(keys, known) @ (weight * own).sum(axis=0)
        ),
    )


def shared_changes(
    transfers: Sequence[Transfer], combine: Callable[[FloatArray], FloatArray]
) -> SharedErrors | None:
    """Errors that calibrators have in common with other data, in what they are combined to.

    Parameters
    ----------
    transfers : sequence of Transfer
    combine : callable
        From the changes (n_calibrators, n_keys) of all to that of the response (n_keys,).
    """
    names = dict.fromkeys(n for t in transfers if t.shared is not None for n in t.shared.names)
    if not names:
        return None
    nothing = np.zeros(len(transfers[0].value))
    changes = [
        combine(np.array([nothing if t.shared is None else t.shared.change(n) for t in transfers]))
        for n in names
    ]
    return SharedErrors(tuple(names), np.stack(changes, axis=1))


def _combined(
    inflate: csr_array, weight: FloatArray, covariances: Sequence[csr_array]
) -> csr_array:
    """Covariance of a weighted mean whose errors are inflated."""
    total = sum(
        (diags_array(w) @ c @ diags_array(w) for w, c in zip(weight, covariances, strict=True)),
        csr_array(inflate.shape),
    )
    return csr_array(inflate @ total @ inflate.T)
