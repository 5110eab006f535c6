"""Extra noise: a variance per kind of observable, for errors that are too small.

Where the best model leaves residuals that the stated errors cannot explain, a variance is
added to every V² and one to every closure phase (through the baselines that its triangles
share) that makes the residuals as likely as can be. A reduced χ² of ten then means errors
three times larger, and not a companion. Of a joint fit each file may be judged by itself:
one with calibration errors of its own then does not spoil the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize
from scipy.sparse import csr_array

from amibayes.closure import closure_matrix
from amibayes.covariance import (
    Block,
    BlockCovariance,
    Covariance,
    DiagonalCovariance,
    as_blocks,
    sparse_covariance,
)
from amibayes.freedom import squared_share, welch_satterthwaite
from amibayes.inference.by_file import files_of, residual
from amibayes.inference.detection import chi2_survival
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.results import SearchResult
from amibayes.inference.search import search
from amibayes.observables import Observables, closure_sets
from amibayes.units import FloatArray

IntArray = NDArray[np.intp]

UNLIKELY = 1e-3
"""Probability of a χ² as large as that of a kind of observable, below which noise is added."""

MOST_ROUNDS = 4

SETTLED = 0.01
"""Relative change of the extra noise at which search and noise agree."""


@dataclass(frozen=True)
class FileNoise:
    """Standard deviations added to the V² and to the closure phases of one file."""

    source: str
    vis2: float = 0.0
    closure_phase_rad: float = 0.0


@dataclass(frozen=True)
class ExtraNoise:
    """Standard deviations added in quadrature.

    Parameters
    ----------
    vis2 : float
        To every V².
    closure_phase_rad : float
        To every closure phase.
    files : tuple of FileNoise
        What each file gets, where files are told apart; the two above are then the root mean
        squares over all data.
    """

    vis2: float = 0.0
    closure_phase_rad: float = 0.0
    files: tuple[FileNoise, ...] = ()

    @property
    def any(self) -> bool:
        """Whether there is any."""
        return self.vis2 > 0.0 or self.closure_phase_rad > 0.0

    def of(self, data: Observables) -> tuple[FloatArray, FloatArray]:
        """Variance added to each unflagged V² (n_vis2,) and closure phase (n_closure,)."""
        vis2 = np.full(data.n_vis2, self.vis2**2)
        closure = np.full(data.n_closure_phases, self.closure_phase_rad**2)
        if self.files:
            own = {f.source: f for f in self.files}
            for part in files_of(data):
                vis2[part.vis2] = own[part.source].vis2 ** 2
                closure[part.closure_phase] = own[part.source].closure_phase_rad ** 2
        return vis2, closure


def add_noise(observables: Observables, extra: ExtraNoise) -> Observables:
    """Add extra noise to the covariance of unflagged observables.

    Its size is taken as known: an estimated covariance then has more degrees of freedom.
    """
    if not extra.any:
        return observables
    data = observables.unflagged()
    noisy = _with_noise(data, extra)
    if data.freedom is None:
        return noisy
    stated, whole = sparse_covariance(data.covariance), sparse_covariance(noisy.covariance)
    freedom = welch_satterthwaite([(squared_share(stated, noisy.covariance), data.freedom)])
    scatter = None if data.scatter is None else csr_array(data.scatter + whole - stated)
    return replace(noisy, freedom=freedom, scatter=scatter)


def _with_noise(data: Observables, extra: ExtraNoise) -> Observables:
    n_vis2, (vis2, closure) = data.n_vis2, extra.of(data)
    diagonal = np.concatenate([vis2, np.zeros(len(closure))])
    if isinstance(data.covariance, DiagonalCovariance):
        diagonal[n_vis2:] = closure
        return replace(data, covariance=DiagonalCovariance(data.covariance.variance + diagonal))
    blocks = as_blocks(data.covariance)
    matrices = [b.matrix + np.diag(diagonal[b.index]) for b in blocks]
    home, place = _places(blocks, data.covariance.size)
    for entries, shared in _shared_noise(data):
        at, block = place[entries + n_vis2], home[entries + n_vis2]
        # A covariance may hold triangles of one exposure apart (independent errors).
        for number in np.unique(block):
            own = np.flatnonzero(block == number)
            noise = closure[entries[0]] * shared[np.ix_(own, own)]
            matrices[number][np.ix_(at[own], at[own])] += noise
    noisy: Covariance = BlockCovariance(
        data.covariance.size,
        [Block(b.index, m, b.basis) for b, m in zip(blocks, matrices, strict=True)],
    )
    return replace(data, covariance=noisy)


def _places(blocks: list[Block], size: int) -> tuple[IntArray, IntArray]:
    """The block each datum stands in, and where in it."""
    home, place = np.empty(size, dtype=np.intp), np.empty(size, dtype=np.intp)
    for number, block in enumerate(blocks):
        home[block.index], place[block.index] = number, np.arange(len(block.index))
    return home, place


def _shared_noise(data: Observables) -> Iterator[tuple[IntArray, FloatArray]]:
    """Covariance K Kᵀ/3 of closure phases whose baseline phases have variance 1/3 each."""
    for entries in closure_sets(data.closure_phase):
        matrix, _ = closure_matrix(data.closure_phase.stations[entries])
        yield entries, matrix @ matrix.T / 3.0


def fit_noise(likelihood: Likelihood, theta: FloatArray, *, per_file: bool = False) -> ExtraNoise:
    """Find the extra noise that makes the residuals of a fit most likely.

    Each kind of observable is judged by itself: it gets extra noise only where its χ² has a
    probability below `UNLIKELY`. The likelihood is the restricted one: the parameters of
    the fit take their share of the degrees of freedom.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    theta : (n_dim,) float array
        The fit.
    per_file : bool
        Judge the files apart.
    """
    data, difference = likelihood.observables, residual(likelihood, theta)
    vis2 = np.arange(data.covariance.size) < data.n_vis2
    share = 1.0 - len(theta) / likelihood.n_independent
    parts = files_of(data)
    if not per_file or len(parts) < 2:
        return ExtraNoise(
            _one_kind(data, difference, vis2, share, "vis2"),
            _one_kind(data, difference, ~vis2, share, "closure_phase_rad"),
        )
    files = tuple(
        FileNoise(
            part.source,
            _one_kind(data, difference, part.of_kind("vis2"), share, "vis2"),
            _one_kind(data, difference, part.of_kind("cp"), share, "closure_phase_rad"),
        )
        for part in parts
    )
    vis2_mean, closure_mean = (_rms(v) for v in ExtraNoise(files=files).of(data))
    return ExtraNoise(vis2_mean, closure_mean, files)


def _rms(variance: FloatArray) -> float:
    return float(np.sqrt(variance.mean())) if len(variance) else 0.0


def _one_kind(
    data: Observables, difference: FloatArray, which: NDArray[np.bool_], share: float, name: str
) -> float:
    """Extra noise of one kind of observable from its residuals."""
    if not which.any():
        return 0.0
    n = data.n_vis2
    part = data.select(which[:n], which[n:])
    residual = difference[which]
    chi2, dof = _chi2(part.covariance, residual), share * part.covariance.rank
    if chi2_survival(chi2, dof, data.degrees_of_freedom) > UNLIKELY:
        return 0.0
    typical = float(np.sqrt(np.median(part.covariance.variance)))
    largest = typical * np.sqrt(chi2 / dof)

    def loss(log_sigma: float) -> float:
        sigma = float(np.exp(log_sigma))
        extra = ExtraNoise(vis2=sigma) if name == "vis2" else ExtraNoise(closure_phase_rad=sigma)
        noisy = _with_noise(part, extra).covariance
        return _chi2(noisy, residual) + share * noisy.logdet()

    bounds = float(np.log(1e-2 * typical)), float(np.log(10.0 * largest))
    best = optimize.minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    return float(np.exp(best.x))


def _chi2(covariance: Covariance, residual: FloatArray) -> float:
    return float((covariance.whiten(residual) ** 2).sum())


def search_with_noise(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
    *,
    per_file: bool = False,
) -> tuple[SearchResult, ExtraNoise]:
    """Search, and search again with the extra noise that the residuals ask for.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    separation_mas : (inner, outer), optional
    per_file : bool
        Judge the noise of every file by itself.

    Returns
    -------
    result : SearchResult
        Of the data with the extra noise.
    noise : ExtraNoise
        None (zeros) where the stated errors explain the residuals.
    """
    result, noise = search(likelihood, separation_mas), ExtraNoise()
    tried = [(_score(result), result, noise)]
    settled = False
    while not settled and len(tried) <= MOST_ROUNDS:
        before, noise = noise, fit_noise(likelihood, result.theta, per_file=per_file)
        settled = _same(before, noise)
        if not settled:
            noisy = Likelihood(add_noise(likelihood.observables, noise), likelihood.model)
            result = search(noisy, separation_mas)
            tried.append((_score(result), result, noise))
    if settled:
        return tried[-1][1], tried[-1][2]
    # Noise and position chase each other: the most likely pair of those tried stands.
    _, result, noise = min(tried, key=lambda t: t[0])
    return replace(result, warnings=(*result.warnings, UNSETTLED)), noise


UNSETTLED = (
    "companion and extra noise do not settle: the data fit neither, and the most likely of the "
    "pairs tried is given"
)


def _score(result: SearchResult) -> float:
    """−2 ln L of a best fit."""
    return float(-2.0 * result.likelihood.log_prob(result.theta)[0])


def _same(a: ExtraNoise, b: ExtraNoise) -> bool:
    pairs = [(a.vis2, b.vis2), (a.closure_phase_rad, b.closure_phase_rad)]
    if a.files and b.files:
        for x, y in zip(a.files, b.files, strict=True):
            pairs += [(x.vis2, y.vis2), (x.closure_phase_rad, y.closure_phase_rad)]
    return all(abs(x - y) <= SETTLED * max(x, y) for x, y in pairs)
