"""Flag data by a rule that a user can write: ``vis2>1.1``, ``station=A1``, ``error_deg>20``."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.units import DEGREE, BoolArray, FloatArray

_RULE = re.compile(r"^\s*(\w+)\s*(<=|>=|<|>|=)\s*(.+?)\s*$")
_COMPARE: dict[str, Callable[[FloatArray, float], BoolArray]] = {
    "<": lambda a, b: np.asarray(a < b),
    ">": lambda a, b: np.asarray(a > b),
    "<=": lambda a, b: np.asarray(a <= b),
    ">=": lambda a, b: np.asarray(a >= b),
    "=": lambda a, b: np.isclose(a, b, rtol=1e-6, atol=0.0),
}
QUANTITIES = {
    "vis2": "squared visibility",
    "vis2_error": "its error",
    "cp_deg": "closure phase, degrees",
    "cp_error_deg": "its error, degrees",
    "snr": "squared visibility over its error",
    "wavelength_um": "wavelength, micrometres",
    "baseline_m": "length of the baseline, or of a triangle's longest",
    "mjd": "date",
    "station": "name of a station (with =)",
}
"""What a rule may speak of."""


def flag_by_rule(observables: Observables, rules: Sequence[str]) -> Observables:
    """Flag what fulfils any of the rules.

    Parameters
    ----------
    rules : sequence of str
        ``QUANTITY OPERATOR NUMBER`` with one of `QUANTITIES` and <, <=, >, >= or =; or
        ``station=NAME``.

    Raises
    ------
    UsageError
        Where a rule cannot be understood, or names a station that is not there.
    DataError
        Where nothing would be left.
    """
    vis2, closure = observables.vis2.flag.copy(), observables.closure_phase.flag.copy()
    for rule in rules:
        for m, flag, error in (
            (observables.vis2, vis2, observables.errors[0]),
            (observables.closure_phase, closure, observables.errors[1]),
        ):
            flag |= _fulfils(rule, m, error, observables)
    if vis2.all() and closure.all():
        raise DataError(
            f"nothing is left by {', '.join(rules)}", source=observables.source, remedy="flag less"
        )
    return observables.flagged(vis2, closure)


def _fulfils(rule: str, m: Measurements, error: FloatArray, observables: Observables) -> BoolArray:
    parsed = _RULE.match(rule)
    if parsed is None or parsed[1] not in QUANTITIES:
        raise UsageError(
            f"the rule {rule!r} is not understood",
            remedy=f"compare {', '.join(QUANTITIES)} with a number, as in vis2>1.1",
        )
    name, operator, text = parsed.groups()
    if name == "station":
        return _has_station(rule, operator, text, m, observables)
    try:
        limit = float(text)
    except ValueError:
        raise UsageError(f"the rule {rule!r} has no number", remedy="as in vis2>1.1") from None
    quantity = _quantity(name, m, error)
    return np.zeros(len(m), bool) if quantity is None else _COMPARE[operator](quantity, limit)


def _quantity(name: str, m: Measurements, error: FloatArray) -> FloatArray | None:
    """A quantity of every entry, NaN (which fulfils nothing) where unknown; None if not of it."""
    if name == "wavelength_um":
        return m.wavelength_m * 1e6
    if name == "mjd":
        return m.mjd
    if name == "baseline_m":
        u, v = (np.column_stack([x, x.sum(axis=1)]) for x in (m.u_m, m.v_m))
        return np.asarray(np.hypot(u, v).max(axis=1))
    if m.stations.shape[1] == 2:
        return {"vis2": m.value, "vis2_error": error, "snr": m.value / error}.get(name)
    return {"cp_deg": m.value / DEGREE, "cp_error_deg": error / DEGREE}.get(name)


def _has_station(
    rule: str, operator: str, text: str, m: Measurements, observables: Observables
) -> BoolArray:
    known = {name.casefold() for s in observables.setups for name in s.stations}
    if operator != "=" or text.casefold() not in known:
        names = ", ".join(dict.fromkeys(n for s in observables.setups for n in s.stations))
        raise UsageError(f"the rule {rule!r} names no station", remedy=f"one of {names}")
    out = np.zeros(len(m), dtype=bool)
    for number, setup in enumerate(observables.setups):
        wanted = [i for i, n in enumerate(setup.stations) if n.casefold() == text.casefold()]
        out |= (m.setup == number) & np.isin(m.stations, wanted).any(axis=1)
    return out
