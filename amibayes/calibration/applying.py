"""The response of the instrument taken from a target's data, with the covariance of both."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, triu

from amibayes.calibration.freedom import calibrated_freedom
from amibayes.calibration.matching import Keys
from amibayes.calibration.transfer import wrapped
from amibayes.calibration.weighted import TransferFunction
from amibayes.data.observables import CovarianceKind, Observables
from amibayes.data.shared_errors import SharedErrors
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
    sharing = target.select(*_on_entries(target, keep)).unflagged()
    used = sharing.without_shared_errors()
    key, sign = keys.key[keep], keys.sign[keep]
    value, target_slope, response_slope = _values(used, key, sign, response, keys.periodic[key])
    spread = coo_array((response_slope, (np.arange(len(key)), key)), shape=(len(key), len(keys)))
    own = diags_array(target_slope)
    shared = _shared(sharing.shared, target_slope, response.shared, key, response_slope)
    by_target = csr_array(own @ used.covariance.sparse @ own)
    by_response = csr_array(spread @ response.covariance @ spread.T)
    kind = _kind(target, calibrators, keys)
    made = _rebuilt(target, keep, value, csr_array(by_target + by_response), kind, keys, notes)
    freedom = calibrated_freedom(
        made.covariance, by_target, used.freedom, by_response, response.freedom
    )
    if used.scatter is None and response.scatter is None:
        return replace(made, freedom=freedom).with_shared_errors(shared)
    by_target = by_target if used.scatter is None else csr_array(own @ used.scatter @ own)
    if response.scatter is not None:
        by_response = csr_array(spread @ response.scatter @ spread.T)
    scatter = csr_array(by_target + by_response)
    return replace(made, freedom=freedom, scatter=scatter).with_shared_errors(shared)


def _shared(
    target: SharedErrors | None,
    target_slope: FloatArray,
    response: SharedErrors | None,
    key: np.ndarray,
    response_slope: FloatArray,
) -> SharedErrors | None:
    """What is left of errors that target and calibrators have in common."""
    names = tuple(dict.fromkeys([n for s in (target, response) if s is not None for n in s.names]))
    if not names:
        return None
    nothing = np.zeros(len(key))
    changes = [
        target_slope * (nothing if target is None else target.change(name))
        + response_slope * (nothing if response is None else response.change(name)[key])
        for name in names
    ]
    return SharedErrors(names, np.stack(changes, axis=1))


def _values(
    used: Observables,
    key: np.ndarray,
    sign: np.ndarray,
    response: TransferFunction,
    periodic: BoolArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Calibrated data and their derivatives by the target's datum and by the response.

    Derivatives at the measured values would give data that came out low small errors, and a fit
    would follow them (the bias of d'Agostini 1994). They are taken where V² and response are
    expected: V² by `expected_vis2`; the response as the mean, by inverse variance, of itself and
    of the target's datum over that V², whose error does not go with that of the ratio.
    """
    n, data, m = used.n_vis2, used.data, response.value[key]
    value = np.concatenate([data[:n] / m[:n], wrapped(data[n:] - (sign * m)[n:], periodic[n:])])
    by_target, by_response = np.ones(len(data)), -sign.astype(float)
    if n:
        own = used.covariance.variance[:n]
        others = np.asarray(response.covariance.diagonal())[key[:n]]
        expected = expected_vis2(used, value[:n], m[:n], own, others)
        near_zero = expected < 1e-3  # there V² tells nothing of the response
        from_target = own / np.where(near_zero, 1.0, expected) ** 2
        share = np.where(near_zero, 1.0, from_target / (from_target + others))
        ratio = data[:n] / np.where(near_zero, 1.0, expected)
        # A target's datum far below zero by chance must not turn the response negative.
        level = np.maximum(share * m[:n] + (1.0 - share) * ratio, 0.5 * m[:n])
        by_target[:n], by_response[:n] = 1.0 / level, -expected / level
    return value, by_target, by_response


def expected_vis2(
    used: Observables,
    value: FloatArray,
    response: FloatArray,
    target_variance: FloatArray,
    response_variance: FloatArray,
) -> FloatArray:
    """Calibrated V² without as much of their noise as their scatter shows.

    A straight line in squared spatial frequency (a disc, to first order) for each setup's
    instrument, towards which each value is drawn by the share that noise has in the scatter
    about it (James & Stein): strong fringes of a binary stay, the noise of a point goes.

    Parameters
    ----------
    value, response, target_variance, response_variance : (n_vis2,) float array
    """
    m = used.vis2
    frequency = (m.u_m[:, 0] ** 2 + m.v_m[:, 0] ** 2) / m.wavelength_m**2
    names = {s.insname: i for i, s in enumerate(used.setups)}
    instrument = np.array([names[s.insname] for s in used.setups])[m.setup]
    out = value.copy()
    for number in np.unique(instrument):
        ours = instrument == number
        level = np.full(int(ours.sum()), max(float(np.median(value[ours])), 0.0))
        for _ in range(2):  # the variances, once at the median and once at what comes of it
            variance = target_variance[ours] + level**2 * response_variance[ours]
            level = _drawn_to_line(value[ours], variance / response[ours] ** 2, frequency[ours])
        out[ours] = level
    return out


def _drawn_to_line(value: FloatArray, variance: FloatArray, x: FloatArray) -> FloatArray:
    degree = 2 if len(value) > 4 and np.ptp(x) > 0 else 1
    design = np.stack([np.ones_like(x), x / x.max(initial=1e-300)], axis=1)[:, :degree]
    scatter = 0.0
    for _ in range(20):
        weight = 1.0 / (variance + scatter)
        root = np.sqrt(weight)
        line = design @ np.linalg.lstsq(design * root[:, None], value * root, rcond=None)[0]
        excess = float((weight * (value - line) ** 2).sum()) - max(len(value) - degree, 1)
        scatter = max(scatter + excess / float(weight.sum()), 0.0)
    return np.asarray(line + scatter / (scatter + variance) * (value - line))


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
        shared=None,
    )


def _kind(target: Observables, calibrators: list[Observables], keys: Keys) -> CovarianceKind:
    """That of the least certain part; independent errors only where they were asked for."""
    if keys.independent:
        return "diagonal"
    kinds: list[CovarianceKind] = ["assumed", "estimated", "given"]
    found = [o.covariance_kind for o in (target, *calibrators)]
    return min([k for k in found if k in kinds] or ["assumed"], key=kinds.index)
