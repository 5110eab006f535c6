"""Files laid together for one fit: what speaks against it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.observables import join as joined
from amibayes.errors import UsageError
from amibayes.support.arguments import checks_arguments
from amibayes.units import FloatArray

SEPARATOR = ", "
"""Between the names of files that are exposures of one."""


@checks_arguments
def join(parts: Sequence[Observables]) -> Observables:
    """Lay data sets together for one fit.

    The kind of the whole covariance is that of its least certain part, in the order
    given, estimated, assumed, diagonal.

    Parameters
    ----------
    parts : sequence of Observables

    Raises
    ------
    UsageError
        Where there are none, or all data of one stand in another: they would count twice.
    """
    if not parts:
        raise UsageError("no data set to join", source="join", remedy="give at least one")
    refuse_twice(parts)
    return joined(parts)


def in_order(parts: Sequence[Observables]) -> list[Observables]:
    """Files by date, wavelength and name: a result does not depend on the order given."""

    def key(part: Observables) -> tuple[float, float, str]:
        mjd = np.concatenate([part.vis2.mjd, part.closure_phase.mjd])
        wavelength = min(float(s.wavelength_m.min()) for s in part.setups)
        return float(np.nan_to_num(mjd).min(initial=np.inf)), wavelength, part.source

    return sorted(parts, key=key)


def refuse_twice(parts: Sequence[Observables]) -> tuple[str, ...]:
    """Refuse a file whose data stand in another one too; say where some of them do.

    Returns
    -------
    tuple of str
        Warnings of numbers that stand in the files more than once, but not as a whole.

    Raises
    ------
    UsageError
        Naming both files.
    """
    rows = [_rows(p.unflagged()) for p in parts]
    owner = np.repeat(np.arange(len(parts)), [len(r) for r in rows])
    _, group = np.unique(np.concatenate(rows), axis=0, return_inverse=True)
    group = group.ravel()
    for k, part in enumerate(parts):
        mine = np.unique(group[owner == k])
        for j, other in enumerate(parts):
            if j != k and len(mine) and np.isin(mine, group[owner == j]).all():
                raise UsageError(
                    f"holds the data of {other.source or 'another file'}",
                    source=part.source,
                    remedy="give every observation once",
                )
    repeated = np.bincount(group)[group] > 1
    if not repeated.any():
        return ()
    files = dict.fromkeys(parts[k].source for k in owner[repeated])
    surplus = int(repeated.sum() - len(np.unique(group[repeated])))
    return (
        f"{surplus} number(s) stand in the data more than once and count as often: "
        f"{', '.join(files)}",
    )


def _rows(data: Observables) -> FloatArray:
    """Every number with all that tells it from others, (n, 8)."""
    return np.concatenate([_of_kind(data.vis2), _of_kind(data.closure_phase)])


def _of_kind(m: Measurements) -> FloatArray:
    legs = np.zeros((len(m), 4))
    legs[:, : m.u_m.shape[1]], legs[:, 2 : 2 + m.v_m.shape[1]] = m.u_m, m.v_m
    kind = np.full(len(m), float(m.u_m.shape[1]))
    when = np.nan_to_num(m.mjd)
    return np.column_stack([kind, m.value, m.wavelength_m, when, legs])


def unused(parts: Sequence[Observables], kinds: Sequence[str]) -> tuple[str, ...]:
    """Name the files of several that hold nothing of the kinds that are fitted."""
    out = []
    for part in parts:
        numbers = {"vis2": part.n_vis2, "cp": part.n_closure_phases}
        if len(parts) > 1 and not sum(numbers[kind] for kind in kinds):
            out.append(
                f"{part.source} holds no usable {' or '.join(kinds)}: it has no part in this"
            )
    return tuple(out)


def different_targets(parts: Sequence[Observables]) -> tuple[str, ...]:
    """Say so where the files name different targets."""
    names = dict.fromkeys(s.target for p in parts for s in p.setups if s.target)
    if len(names) < 2:
        return ()
    return (f"targets of different names are fitted as one: {', '.join(names)}",)


__all__ = ["SEPARATOR", "different_targets", "in_order", "join", "refuse_twice", "unused"]
