"""The response of the instrument taken from a target's data, with the covariance of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, triu

from amibayes.calibration.freedom import calibrated_freedom
from amibayes.calibration.matching import Keys
from amibayes.calibration.transfer import sparse_covariance, wrapped
from amibayes.calibration.weighted import TransferFunction
from amibayes.data.observables import CovarianceKind, Observables
from amibayes.errors import DataError
from amibayes.oifits.correlations import Pairs, given_covariance
from amibayes.units import BoolArray, FloatArray

FAINTEST = 3.0
"""A calibrator's V² below this many of its errors divides nothing: the ratio has no moments."""


def apply_response(
    target: Observables,
    keys: Keys,
    response: TransferFunction,
    calibrators: list[Observables],
    notes: tuple[str, ...],
) -> Observables:
    """Divide V² by the response and subtract its closure phases.

    Parameters
    ----------
    target : Observables
    keys : Keys
        Which value of the response goes with which datum.
    response : TransferFunction
    calibrators : list of Observables
        All that were given: the kind of the covariance is that of the least certain.
    notes : tuple of str
        To be kept with the data.

    Raises
    ------
    DataError
        Where no datum is left.
    """
    error = np.sqrt(response.covariance.diagonal())
    usable = response.known.copy()
    usable[: keys.n_vis2] &= (response.value > FAINTEST * error)[: keys.n_vis2]
    keep = usable[keys.key]
    if not keep.any():
        raise DataError(
            "nothing is left: the V² of the calibrators are lost in their errors",
            source=target.source,
            remedy="use brighter calibrators",
        )
    used = target.select(*_on_entries(target, keep)).unflagged()
    key, sign = keys.key[keep], keys.sign[keep]
    value, target_slope, response_slope = _values(used, key, sign, response)
    spread = coo_array((response_slope, (np.arange(len(key)), key)), shape=(len(key), len(keys)))
    own = diags_array(target_slope)
    by_target = csr_array(own @ sparse_covariance(used.covariance) @ own)
    by_response = csr_array(spread @ response.covariance @ spread.T)
    kind = _kind(target, calibrators, keys)
    made = _rebuilt(target, keep, value, csr_array(by_target + by_response), kind, keys, notes)
    freedom = calibrated_freedom(
        made.covariance, by_target, used.freedom, by_response, response.freedom
    )
    if used.scatter is None and response.scatter is None:
        return replace(made, freedom=freedom)
    by_target = by_target if used.scatter is None else csr_array(own @ used.scatter @ own)
    if response.scatter is not None:
        by_response = csr_array(spread @ response.scatter @ spread.T)
    return replace(made, freedom=freedom, scatter=csr_array(by_target + by_response))


def _values(
    used: Observables, key: np.ndarray, sign: np.ndarray, response: TransferFunction
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Calibrated data and their derivatives by the target's datum and by the response."""
    n, data, m = used.n_vis2, used.data, response.value[key]
    value = np.concatenate([data[:n] / m[:n], wrapped(data[n:] - (sign * m)[n:])])
    by_target, by_response = np.ones(len(data)), -sign.astype(float)
    by_target[:n] = 1.0 / m[:n]
    by_response[:n] = -data[:n] / m[:n] ** 2
    return value, by_target, by_response


def _on_entries(target: Observables, keep: BoolArray) -> tuple[BoolArray, BoolArray]:
    """A mask of the unflagged data as masks of all V² and closure phases."""
    vis2, closure = ~target.vis2.flag, ~target.closure_phase.flag
    vis2[vis2] = keep[: target.n_vis2]
    closure[closure] = keep[target.n_vis2 :]
    return vis2, closure


def _rebuilt(
    target: Observables,
    keep: BoolArray,
    value: FloatArray,
    covariance: csr_array,
    kind: CovarianceKind,
    keys: Keys,
    notes: tuple[str, ...],
) -> Observables:
    """The target with calibrated values; what could not be calibrated is flagged."""
    vis2_kept, closure_kept = _on_entries(target, keep)
    vis2, closure = target.vis2.value.copy(), target.closure_phase.value.copy()
    n = int(vis2_kept.sum())
    vis2[vis2_kept], closure[closure_kept] = value[:n], value[n:]
    new_vis2 = replace(target.vis2, value=vis2, flag=~vis2_kept)
    new_closure = replace(target.closure_phase, value=closure, flag=~closure_kept)
    upper = triu(covariance, 1).tocoo()
    used = upper.data != 0
    pairs = Pairs(
        upper.row[used].astype(np.intp), upper.col[used].astype(np.intp), upper.data[used]
    )
    everywhere = np.ones(len(value), dtype=bool)
    lost = int((~keep).sum())
    notes = (*notes, *((f"{lost} value(s) without calibrator flagged",) if lost else ()))
    return replace(
        target,
        vis2=new_vis2,
        closure_phase=new_closure,
        covariance=given_covariance(
            covariance.diagonal(),
            pairs,
            new_closure.select(closure_kept),
            covered=everywhere,
            independent=everywhere & keys.independent,
        ),
        covariance_kind=kind,
        notes=(*target.notes, *notes),
        scatter=None,
    )


def _kind(target: Observables, calibrators: list[Observables], keys: Keys) -> CovarianceKind:
    """That of the least certain part; independent errors only where they were asked for."""
    if keys.independent:
        return "diagonal"
    kinds: list[CovarianceKind] = ["assumed", "estimated", "given"]
    found = [o.covariance_kind for o in (target, *calibrators)]
    return min([k for k in found if k in kinds] or ["assumed"], key=kinds.index)
