"""The two polarisations of one combiner, which files give as instruments of their own."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence

import numpy as np

from amibayes.data.measurements import DAY_S, SIMULTANEOUS_S, Measurements
from amibayes.data.setup import Setup
from amibayes.units import IntArray

_POLARISATION = re.compile(r"[_ -]?(?:P|POL)[12]$", re.IGNORECASE)


def without_polarisation(insname: str) -> str:
    """INSNAME of both polarisations: ``GRAVITY_SC`` of ``GRAVITY_SC_P1``."""
    return _POLARISATION.sub("", insname.strip(" \0\t\n"))


def combiners(setups: Sequence[Setup]) -> IntArray:
    """Number the combiner of each setup: one of setups that differ in the polarisation alone."""
    first: dict[tuple[object, ...], int] = {}
    alike: Counter[tuple[object, ...]] = Counter()
    found = []
    for setup in setups:
        known = setup.source, setup.target, setup.stations, setup.wavelength_m.tobytes()
        own, name = (*known, setup.insname), without_polarisation(setup.insname)
        # Another setup of the very same name is another combiner, or another night of it.
        found.append(first.setdefault((*known, name, alike[own]), len(first)))
        alike[own] += 1
    return np.array(found, dtype=np.intp)


def rows_of_exposures(setups: Sequence[Setup], m: Measurements) -> IntArray:
    """Number the rows of tables, (n,): of both polarisations of an exposure as one.

    These are of one combiner, the same stations in the same order, and one time.
    """
    pairs, first, row = np.unique(
        np.stack([m.setup, m.row]), axis=1, return_index=True, return_inverse=True
    )
    row, home = row.ravel(), combiners(setups)
    if len(np.unique(home)) == len(home):
        return np.asarray(row)
    setup, mjd, stations = pairs[0], m.mjd[first], m.stations[first]
    key = np.column_stack([home[setup], stations])
    label, begin, seen = np.empty(len(first), dtype=np.intp), 0, set[int]()
    for k in np.lexsort((setup, pairs[1], mjd, *key.T)).tolist():
        late = DAY_S * (mjd[k] - mjd[begin]) > SIMULTANEOUS_S
        if not seen or setup[k] in seen or late or (key[k] != key[begin]).any():
            begin, seen = k, set()
        label[k] = begin
        seen.add(int(setup[k]))
    least = np.full(len(first), len(first))
    np.minimum.at(least, label, np.arange(len(first)))
    return np.asarray(least[label][row])
