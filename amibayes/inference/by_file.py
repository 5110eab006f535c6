"""The data of each file of a joint fit, and what the fit leaves of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.covariance import Covariance
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.refine import single_likelihood
from amibayes.inference.results import SearchResult
from amibayes.observables import BoolArray, Observables
from amibayes.units import FloatArray


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


@dataclass(frozen=True)
class FileResiduals:
    """Reduced χ² of one file under a joint fit; NaN where it has no data of a kind.

    The parameters take the same share of degrees of freedom of every file.

    Parameters
    ----------
    source : str
    n_vis2, n_closure_phases : int
    vis2, closure_phase : float
        With the companion.
    single_vis2, single_closure_phase : float
        Without one.
    """

    source: str
    n_vis2: int
    n_closure_phases: int
    vis2: float
    closure_phase: float
    single_vis2: float
    single_closure_phase: float


def file_residuals(result: SearchResult) -> tuple[FileResiduals, ...]:
    """Reduced χ² of every file and kind of observable, with the companion and without."""
    binary, single = result.likelihood, single_likelihood(result.likelihood)
    data = binary.observables
    left = residual(binary, result.theta), residual(single, result.single_theta)
    share = result.ndof / binary.n_independent
    out = []
    for file in files_of(data):
        kinds = [np.flatnonzero(file.of_kind(kind)) for kind in ("vis2", "cp")]
        reduced = [_reduced(data.covariance, r, at, share) for r in left for at in kinds]
        out.append(FileResiduals(file.source, len(kinds[0]), len(kinds[1]), *reduced))
    return tuple(out)


def residual(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Data less model, closure phases the short way round, (n_data,)."""
    data = likelihood.observables
    difference = data.data - likelihood.predict(np.atleast_2d(theta))[:, 0]
    closure = difference[data.n_vis2 :]
    closure -= 2.0 * np.pi * np.rint(closure / (2.0 * np.pi))
    return np.asarray(difference)


def _reduced(covariance: Covariance, difference: FloatArray, at: np.ndarray, share: float) -> float:
    if not len(at):
        return float("nan")
    part = covariance.select(at)
    return float((part.whiten(difference[at]) ** 2).sum() / (share * part.rank))
