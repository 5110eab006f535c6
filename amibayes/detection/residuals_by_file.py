"""What the fit leaves of the data of each file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.data.covariance import Covariance
from amibayes.likelihood.chi2 import chi2_of_part
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.likelihood.residuals import files_of
from amibayes.support.arguments import checks_arguments
from amibayes.units import FloatArray


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


@checks_arguments
def file_residuals(result: SearchResult) -> tuple[FileResiduals, ...]:
    """Reduced χ² of every file and kind of observable, with the companion and without."""
    binary, single = result.likelihood, single_likelihood(result.likelihood)
    data = binary.observables
    left = binary.difference(result.theta)[:, 0], single.difference(result.single_theta)[:, 0]
    share = result.ndof / binary.n_independent
    out = []
    for file in files_of(data):
        kinds = [np.flatnonzero(file.of_kind(kind)) for kind in ("vis2", "cp")]
        reduced = [_reduced(data.covariance, r, at, share) for r in left for at in kinds]
        out.append(FileResiduals(file.source, len(kinds[0]), len(kinds[1]), *reduced))
    return tuple(out)


def _reduced(covariance: Covariance, difference: FloatArray, at: np.ndarray, share: float) -> float:
    if not len(at):
        return float("nan")
    chi2, rank = chi2_of_part(covariance, at, difference)
    return chi2 / (share * rank)
