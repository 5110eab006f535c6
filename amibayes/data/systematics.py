"""Calibration errors of instruments, common to the channels of an exposure, as published."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.units import FloatArray

MIN_EXPOSURES = 10
"""Exposures of a file from which on their own scatter tells calibration errors: the variance
of ten is known to a half, and fewer cannot be resampled with a chance below 0.001."""


@dataclass(frozen=True)
class Systematics:
    """Floor of the calibration errors of one file, common to the channels of an exposure.

    Parameters
    ----------
    source : str
        The file.
    vis2 : float
        Relative to V².
    closure_phase_rad : float
    visibility : float
        Additive, coherent error of the visibility: 2|V| times it in V². It is what is left near
        a null, where a gain is nothing.
    instrument : str
        Entry of the table; empty for a floor that was asked for.
    reference : str
        Where the numbers come from.
    """

    source: str
    vis2: float
    closure_phase_rad: float
    visibility: float = 0.0
    instrument: str = ""
    reference: str = ""


@cache
def table() -> tuple[Systematics, ...]:
    """Floor of each instrument; of no file yet."""
    path = resources.files("amibayes.data") / "systematics.toml"
    found = tomllib.loads(path.read_text(encoding="utf-8"))
    return tuple(
        Systematics(
            "",
            e["vis2"],
            float(np.radians(e["closure_phase_deg"])),
            e["visibility"],
            name,
            e["reference"],
        )
        for name, e in found.items()
    )


def systematics_of(
    data: Observables, choice: str | tuple[float, float] = "table"
) -> tuple[Systematics, ...]:
    """Floor of every file that has one.

    Parameters
    ----------
    data : Observables
    choice : "table", "none" or (vis2, degrees)
        Of the table: files of fewer than `MIN_EXPOSURES` exposures, whose scatter cannot tell.
        Numbers: every file.
    """
    sources = dict.fromkeys(s.source for s in data.setups)
    if choice == "none" or data.freedom is not None:
        return ()
    if not isinstance(choice, str):
        vis2, degrees = choice
        floors = (Systematics(s, vis2, float(np.radians(degrees))) for s in sources)
        return tuple(f for f in floors if f.vis2 > 0.0 or f.closure_phase_rad > 0.0)
    return tabulated(data, [s for s in sources if n_exposures(data, s) < MIN_EXPOSURES])


def tabulated(data: Observables, sources: Iterable[str]) -> tuple[Systematics, ...]:
    """Floors of the table, of those files that have one."""
    found = [_tabulated(s, [x.insname for x in data.setups if x.source == s]) for s in sources]
    return tuple(f for f in found if f is not None and f.vis2 + f.closure_phase_rad > 0.0)


def calibration_errors(
    data: Observables, choice: str | tuple[float, float] = "table"
) -> FloatArray:
    """Calibration errors of unflagged data, (n_data,), whatever the number of exposures.

    Standard deviations, V² then closure phases in radians; 0 for files without an entry in the
    table, or with ``choice`` "none". Numbers are those of every file, as in `systematics_of`.
    """
    data = data.unflagged()
    out = np.zeros(data.covariance.size)
    sources = dict.fromkeys(s.source for s in data.setups)
    floors = tabulated(data, sources) if choice == "table" else systematics_of(data, choice)
    for floor in floors:
        own = np.array([s.source == floor.source for s in data.setups])
        value = np.abs(data.vis2.value)
        vis2 = np.hypot(floor.vis2 * value, 2.0 * np.sqrt(value) * floor.visibility)
        out[: data.n_vis2] += np.where(own[data.vis2.setup], vis2, 0.0)
        here = own[data.closure_phase.setup]
        out[data.n_vis2 :] += np.where(here, floor.closure_phase_rad, 0.0)
    return out


def _tabulated(source: str, insnames: Sequence[str]) -> Systematics | None:
    for insname in insnames:
        for floor in table():
            if insname.upper().startswith(floor.instrument):
                return replace(floor, source=source)
    return None


def n_exposures(data: Observables, source: str) -> int:
    """Number of times that a file has the baseline or triangle it has most often."""
    setups = [k for k, s in enumerate(data.setups) if s.source == source]
    return max((_repeats(m, k) for m in (data.vis2, data.closure_phase) for k in setups), default=0)


def _repeats(table_: Measurements, setup: int) -> int:
    here = table_.setup == setup
    if not here.any():
        return 0
    rows = np.unique(np.column_stack([table_.row[here], table_.stations[here]]), axis=0)
    return int(np.unique(np.sort(rows[:, 1:], axis=1), axis=0, return_counts=True)[1].max())
