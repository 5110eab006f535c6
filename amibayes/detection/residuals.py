"""What the fit leaves: of the data of each file, and in common to neighbouring channels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.data.covariance import Covariance
from amibayes.data.measurements import Measurements
from amibayes.likelihood.chi2 import chi2_of_part
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.likelihood.residuals import files_of
from amibayes.likelihood.student import symmetric_whitening
from amibayes.support.arguments import checks_arguments
from amibayes.units import FloatArray, IntArray


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
    """Reduced χ² of every file and kind of observable, with the companion and without.

    By the covariance of the fit, which has the errors that channels of an exposure share.
    """
    binary, single = result.likelihood, single_likelihood(result.likelihood)
    data, covariance = binary.observables, binary.noise.covariance
    left = binary.difference(result.theta)[:, 0], single.difference(result.single_theta)[:, 0]
    share = result.ndof / binary.n_independent
    out = []
    for file in files_of(data):
        kinds = [np.flatnonzero(file.of_kind(kind)) for kind in ("vis2", "cp")]
        reduced = [_reduced(covariance, r, at, share) for r in left for at in kinds]
        out.append(FileResiduals(file.source, len(kinds[0]), len(kinds[1]), *reduced))
    return tuple(out)


def chi2_of_kinds(result: SearchResult) -> dict[str, tuple[float, float]]:
    """χ² of V² and of closure phases with the companion, and degrees of freedom, of those seen."""
    fit = result.likelihood
    left, share = fit.difference(result.theta)[:, 0], result.ndof / fit.n_independent
    vis2, closure = np.split(np.arange(len(left)), [fit.observables.n_vis2])
    out = {}
    for name, at in (("V2", vis2), ("closure phases", closure)):
        if len(at):
            chi2, rank = chi2_of_part(fit.noise.covariance, at, left)
            out[name] = chi2, share * rank
    return out


def _reduced(covariance: Covariance, difference: FloatArray, at: np.ndarray, share: float) -> float:
    if not len(at):
        return float("nan")
    chi2, rank = chi2_of_part(covariance, at, difference)
    return chi2 / (share * rank)


NOTABLE, SURE = 0.2, 5.0
"""Correlation between channels that matters, and its size in chance errors.

A correlation of 0.2 makes the variance of a sum over ten channels nearly three times as large.
"""


def channel_correlation(result: SearchResult) -> tuple[float, int]:
    """Correlation of the residuals of a fit between neighbouring channels of a row.

    Residuals are whitened symmetrically, so that correlations which the covariance has in it
    do not count.

    Returns
    -------
    correlation : float
        0 where there is one channel.
    n_pairs : int
        Pairs of data it rests on; by chance it scatters by 1/√n_pairs.
    """
    return _correlation(*_channels(result))


def _correlation(residuals: FloatArray, pairs: list[IntArray]) -> tuple[float, int]:
    """The same of what `_channels` gives."""
    first, second = residuals[np.concatenate(pairs, axis=1)]
    norm = float(np.sqrt((first @ first) * (second @ second)))
    return (float(first @ second) / norm if norm else 0.0), len(first)


def correlated(result: SearchResult) -> float | None:
    """Correlation between channels beyond the model of the noise; None where it does not matter.

    It does not where errors are so large that means over channels scatter by less than they say.
    """
    data, (residuals, pairs) = result.likelihood.observables, _channels(result)
    correlation, n_pairs = _correlation(residuals, pairs)
    if correlation < NOTABLE or correlation * np.sqrt(n_pairs) < SURE:
        return None
    tables = (data.vis2, data.closure_phase)
    kinds = zip(tables, np.split(residuals, [data.n_vis2]), pairs, strict=True)
    beyond = [_beyond_errors(table, own, residuals[at]) for table, own, at in kinds if len(table)]
    return correlation if any(beyond) else None


def _beyond_errors(table: Measurements, own: FloatArray, pairs: FloatArray) -> bool:
    """Whether means over the channels of a row scatter by more than errors say, and by chance.

    ``pairs`` (2, n) are residuals of neighbouring channels: what they have in common, all have.
    """
    n_rows = len(np.unique(np.stack([table.setup, table.row]), axis=1).T)
    variance = float((own**2).mean() + (pairs[0] * pairs[1]).sum() / n_rows)
    return bool(variance > np.exp(CHANCE * np.sqrt(2.0 / n_rows)))


CHANCE = 2.0
"""Errors of ln of a variance that it has to be off by."""


def _channels(result: SearchResult) -> tuple[FloatArray, list[IntArray]]:
    """Residuals (n_data,) in units of their errors, and pairs (2, n) of each kind's neighbours."""
    data, noise = result.likelihood.observables, result.likelihood.noise
    # What the noise model knows of the correlation of channels is taken out by the whitening:
    # what is left shows between neighbours.
    white = result.likelihood.residuals(result.theta)
    residuals = symmetric_whitening(data, noise.covariance).residuals(white)[:, 0]
    return residuals, [_neighbours(data.vis2), _neighbours(data.closure_phase) + data.n_vis2]


def _neighbours(data: Measurements) -> IntArray:
    """Pairs (2, n) of entries of one row in neighbouring channels."""
    order = np.lexsort((data.channel, data.row, data.setup))
    step = np.diff(np.stack([data.setup, data.row, data.channel])[:, order], axis=1)
    beside = np.flatnonzero((step[0] == 0) & (step[1] == 0) & (step[2] == 1))
    return np.stack([order[beside], order[beside + 1]])
