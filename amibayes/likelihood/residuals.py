"""Which data of a joint fit come from which file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.data.observables import Observables
from amibayes.units import BoolArray


@dataclass(frozen=True, eq=False)
class FileData:
    """Which of the unflagged data come from a file: masks of V², of closure phases."""

    source: str
    vis2: BoolArray
    closure_phase: BoolArray

    def of_kind(self, kind: str) -> BoolArray:
        """Mask of all data, V² first, of ``vis2`` or ``cp`` of this file."""
        vis2 = self.vis2 if kind == "vis2" else np.zeros_like(self.vis2)
        closure = self.closure_phase if kind == "cp" else np.zeros_like(self.closure_phase)
        return np.concatenate([vis2, closure])


def files_of(observables: Observables) -> tuple[FileData, ...]:
    """Files that unflagged observables come from, in the order of their names."""
    data = observables.unflagged()
    sources = np.array([s.source for s in data.setups])
    vis2, closure = sources[data.vis2.setup], sources[data.closure_phase.setup]
    names = sorted(set(vis2.tolist()) | set(closure.tolist()))
    return tuple(FileData(name, vis2 == name, closure == name) for name in names)


def groups_of(observables: Observables, *, per_file: bool) -> list[tuple[str, BoolArray]]:
    """File and mask (n_data,) of each part of unflagged data that has noise of its own.

    Where files are not told apart, or there is one, a single part without a name.
    """
    files = files_of(observables)
    if not per_file or len(files) < 2:
        return [("", np.ones(observables.covariance.size, dtype=bool))]
    return [(f.source, f.of_kind("vis2") | f.of_kind("cp")) for f in files]
