"""Whether the errors are those of the data: scatter, redundancy, correlations."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import chi2

from amibayes.data.closure import canonical, canonical_uv, closure_matrix, kernel_basis
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.oifits.audit.finding import Finding, Findings, column, count, listed
from amibayes.oifits.reader import observables_of
from amibayes.oifits.tables import OIFits
from amibayes.units import FloatArray, IntArray

SAME_PLACE = 0.005
"""Repeats are of one point of the (u, v) plane where they differ by less than this part."""

CHANCE = 1e-6
"""Scatter less probable than this, from errors as given, is a finding."""


def independent_closures(oifits: OIFits, parts: Sequence[Observables]) -> Findings:
    """More closure phases than baselines can make, and no correlations."""
    if oifits.named("CPCOV"):
        return
    for part in parts:
        closure = part.closure_phase.select(~part.closure_phase.flag)
        correlated = _correlated_setups(oifits)
        n = rank = 0
        for entries in closure.sets:
            if part.setups[int(closure.setup[entries[0]])].insname not in correlated:
                n += len(entries)
                rank += _rank(closure.stations[entries])
        if n > rank:
            yield Finding(
                "warning",
                "closures-as-independent",
                listed(s.insname for s in part.setups),
                f"{n} closure phases of which {rank} are independent, and no correlations",
                "triangles share baselines: a fit that takes them as independent makes its "
                f"errors too small by {np.sqrt(n / rank):.2f}",
                "read them as correlated (the default here), or write the correlations (OI_CORR)",
            )


def _correlated_setups(oifits: OIFits) -> set[str]:
    """INSNAME of the closure-phase tables that have a place in a correlation matrix."""
    return {
        t.keyword("INSNAME")
        for t in oifits.named("OI_T3")
        if t.keyword("CORRNAME") and "CORRINDX_T3PHI" in t.columns
    }


def _rank(stations: IntArray) -> int:
    return int(kernel_basis(closure_matrix(stations)[0]).shape[1])


def correlations(oifits: OIFits) -> Findings:
    """OI_CORR that is out of bounds, or no correlation matrix."""
    for table in oifits.named("OI_CORR"):
        first, second, value = (column(table, n) for n in ("IINDX", "JINDX", "CORR"))
        if first is None or second is None or value is None:
            continue
        size = table.header.get("NDATA", 0)
        faults = []
        if max(first.max(), second.max()) > size or min(first.min(), second.min()) < 1:
            faults.append(f"indices outside 1…NDATA = {size}")
        if not (np.abs(value) <= 1 + 1e-9).all():
            faults.append("values that are not between −1 and 1")
        if (first >= second).any():
            faults.append(f"{count(int((first >= second).sum()), 'row')} with IINDX ≥ JINDX")
        if faults:
            yield Finding(
                "error",
                "correlations",
                table.label,
                "; ".join(faults),
                "it is no correlation matrix",
                "write the correlations again",
            )


def unusable(oifits: OIFits, names: Sequence[str]) -> Findings:
    """Data that cannot be read with their correlations though they can without."""
    for name in names:
        fault = ""
        try:
            observables_of(oifits, target=name)
        except DataError as error:
            fault = error.what
        if fault and readable_without(oifits, name):
            yield Finding(
                "error",
                "correlations",
                "file",
                fault,
                "the covariance cannot be inverted",
                "correct the correlations, or fit with independent errors",
            )


def readable_without(oifits: OIFits, name: str) -> bool:
    """Whether a target can be read when correlations are set aside."""
    try:
        observables_of(oifits, target=name, closure_covariance="diagonal")
    except DataError:
        return False
    return True


def scatter(oifits: OIFits, parts: Sequence[Observables]) -> Findings:
    """Repeats at one point of the (u, v) plane that scatter more than their errors say."""
    for part in parts:
        instrument = _instruments(part)
        for m, error, what in (
            (part.vis2, part.errors[0], "V²"),
            (part.closure_phase, part.errors[1], "closure phases"),
        ):
            used = ~m.flag
            alike = replace(m, setup=instrument[m.setup]).select(used)
            total, degrees = _repeat_chi2(alike, error[used], what != "V²")
            if degrees >= 5 and total / degrees > 2 and chi2.sf(total, degrees) < CHANCE:
                yield Finding(
                    "warning",
                    "errors-too-small",
                    listed(s.insname for s in part.setups),
                    f"repeats of {what} at one (u, v) scatter {np.sqrt(total / degrees):.1f} "
                    f"times more than their errors ({degrees} degrees of freedom)",
                    "contrasts and their errors will be too optimistic",
                    "fit an extra noise, or find what makes the scatter",
                )


def _instruments(part: Observables) -> IntArray:
    """Number of each setup's instrument: setups of one name, stations and channels are one."""
    known: dict[tuple[object, ...], int] = {}
    keys = [(s.insname, s.stations, s.wavelength_m.tobytes()) for s in part.setups]
    return np.array([known.setdefault(key, len(known)) for key in keys], dtype=np.intp)


def _repeat_chi2(m: Measurements, error: FloatArray, is_phase: bool) -> tuple[float, int]:
    """χ² of repeats about their weighted means, and its degrees of freedom."""
    total, degrees = 0.0, 0
    for entries in _repeats(m):
        sign = canonical(m.stations[entries])[1] if is_phase else 1.0
        value = m.value[entries] * sign
        if is_phase:
            value = np.angle(np.exp(1j * (value - value[0])))
        weight = 1.0 / error[entries] ** 2
        mean = (weight * value).sum() / weight.sum()
        total += float((weight * (value - mean) ** 2).sum())
        degrees += len(entries) - 1
    return total, degrees


def _repeats(m: Measurements) -> Iterator[IntArray]:
    """Groups of entries of one setup, baseline or triangle and channel at the same (u, v)."""
    if not len(m):
        return
    ordered, _ = canonical(m.stations)
    key = np.column_stack([m.setup, m.channel, ordered])
    order = np.lexsort((m.mjd, *key.T))
    uv = canonical_uv(m.stations, m.u_m, m.v_m)[order]
    moved = np.abs(np.diff(uv, axis=0)).max(axis=1) > SAME_PLACE * np.abs(uv[1:]).max(axis=1)
    cut = (np.diff(key[order], axis=0) != 0).any(axis=1) | moved
    for group in np.split(order, np.flatnonzero(cut) + 1):
        if len(group) > 1:
            yield group


CHECKS = (correlations,)
DATA_CHECKS = (independent_closures, scatter)
