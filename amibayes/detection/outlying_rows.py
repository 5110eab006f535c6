"""Rows of a file that the best fit of all others does not explain by far.

A row is one baseline, or one triangle, of one exposure with all its channels. A fringe that was
lost, or a calibration that failed, spoils one of them; extra noise for all then hides a companion,
or one at a wrong place explains the row. Light that the model lacks is seen in many rows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.systematics import calibration_errors
from amibayes.likelihood.likelihood import Likelihood
from amibayes.units import BoolArray, FloatArray

Kind = Literal["vis2", "cp"]
KINDS: tuple[Kind, ...] = get_args(Kind)

OUTLYING = 5.0
"""Deviation, in errors or in what is typical of the rows, from which on a row is outlying: one of
two million by chance where channels err together, fewer where they do not."""

LEAST_ROWS = 8
"""Rows of one kind and instrument from which on it is known what is typical of them."""

MOST = 0.05
"""Share of the rows of one kind and instrument that may be left out; one in any case."""


@dataclass(frozen=True)
class OutlyingRow:
    """A row of one table.

    Parameters
    ----------
    kind : {"vis2", "cp"}
    setup, row : int
        As in `amibayes.data.observables.Measurements`.
    path : str
        The file.
    stations : tuple of str
    mjd : float
        NaN where it is not known.
    phase : str
        What phases are called, see `amibayes.data.observables.Observables.phase_name`.
    deviation : float
        Root mean square over its channels, in units of the stated errors with the calibration
        errors known of the instrument, or of the median row where that deviates by more.
    """

    kind: Kind
    setup: int
    row: int
    path: str
    stations: tuple[str, ...]
    mjd: float = field(compare=False)
    phase: str = field(compare=False)
    deviation: float = field(compare=False)

    def __str__(self) -> str:
        name = "V2" if self.kind == "vis2" else self.phase
        date = f" at MJD {self.mjd:.4f}" if np.isfinite(self.mjd) else ""
        return f"{name} {'-'.join(self.stations)}{date}"

    def left_out(self) -> str:
        """Say that it was left out."""
        return (
            f"{self} was left out: it is {self.deviation:.0f} times as far from what fits all "
            "other data as its errors, or as others are (--keep-outliers takes it in)"
        )


def outlying_rows(
    data: Observables,
    likelihood: Likelihood,
    theta: FloatArray,
    systematics: str | tuple[float, float] = "table",
) -> tuple[OutlyingRow, ...]:
    """Find the rows that a fit does not explain, those that deviate most first.

    Parameters
    ----------
    data : Observables
        With the stated errors; rows that the fit was not made from may be among them.
    likelihood : Likelihood
        Of the fit: its model.
    theta : (n_dim,) float array
        The fit.
    systematics : "table", "none" or (vis2, degrees)
        Calibration errors: those of the table of instruments, however many exposures there are.
    """
    data = data.unflagged()
    difference = Likelihood(data, likelihood.model).difference(np.atleast_2d(theta))[:, 0]
    variance = data.covariance.variance + calibration_errors(data, systematics) ** 2
    square, n = difference**2 / variance, data.n_vis2
    found = [*_of_kind(data, "vis2", square[:n]), *_of_kind(data, "cp", square[n:])]
    return tuple(sorted(found, key=lambda row: -row.deviation))


def _of_kind(data: Observables, kind: Kind, square: FloatArray) -> Iterator[OutlyingRow]:
    table, instrument = _table(data, kind), _instruments(data)
    for insname in np.unique(instrument).tolist():
        here = np.flatnonzero(instrument[table.setup] == insname)
        key = np.column_stack([table.setup[here], table.row[here]])
        rows, first, which = np.unique(key, axis=0, return_index=True, return_inverse=True)
        if len(rows) < LEAST_ROWS:
            continue
        which = which.ravel()
        mean = np.bincount(which, square[here]) / np.bincount(which)
        deviation = np.sqrt(mean / max(1.0, float(np.median(mean))))
        for k in np.flatnonzero(deviation > OUTLYING):
            (j, row), at = rows[k].tolist(), here[first[k]]
            stations = tuple(data.setups[j].stations[s] for s in table.stations[at])
            mjd, away = float(table.mjd[at]), float(deviation[k])
            yield OutlyingRow(
                kind, j, row, data.setups[j].source, stations, mjd, data.phase_name, away
            )


def _instruments(data: Observables) -> NDArray[np.str_]:
    """Instrument of each setup."""
    return np.array([setup.insname for setup in data.setups])


def may_be_left_out(data: Observables, rows: Sequence[OutlyingRow]) -> bool:
    """Whether rows are so few that the others still are most of what an instrument gave."""
    instrument = _instruments(data)
    groups = Counter((row.kind, instrument[row.setup]) for row in rows)
    for (kind, insname), count in groups.items():
        table = _table(data, kind)
        here = (instrument[table.setup] == insname) & ~table.flag
        total = len(np.unique(np.column_stack([table.setup, table.row])[here], axis=0))
        if count > max(1.0, MOST * total):
            return False
    return True


def model_is_wrong(
    data: Observables, likelihood: Likelihood, theta: FloatArray, rows: Sequence[OutlyingRow]
) -> bool:
    """Whether a fit is so far from all other rows that no few of them are what is wrong.

    Parameters
    ----------
    data : Observables
        With the stated errors.
    likelihood : Likelihood
        Whose model was fitted.
    theta : (n_dim,) float array
    rows : sequence of OutlyingRow
    """
    others = Likelihood(without_rows(data, rows), likelihood.model)
    return bool(others.chi2(theta)[0] > FAR_FROM_ALL * others.n_independent)


FAR_FROM_ALL = 100.0
"""χ² per datum with the stated errors of such a fit: errors ten times too small are no errors."""


def without_rows(data: Observables, rows: Sequence[OutlyingRow]) -> Observables:
    """The data with some rows flagged."""
    vis2, closure = (_inside(data, kind, rows) for kind in KINDS)
    return data.flagged(vis2, closure)


def _inside(data: Observables, kind: Kind, rows: Sequence[OutlyingRow]) -> BoolArray:
    """Mask of the entries (n,) of a kind that are in one of the rows."""
    table = _table(data, kind)
    found = np.zeros(len(table), dtype=bool)
    for row in rows:
        if row.kind == kind:
            found |= (table.setup == row.setup) & (table.row == row.row)
    return found


def _table(data: Observables, kind: Kind) -> Measurements:
    return data.vis2 if kind == "vis2" else data.closure_phase
