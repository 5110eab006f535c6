"""The distribution of a statistic under noise alone.

It depends on the templates, on how the errors are treated and on the random numbers, and on
nothing else of the data: targets of a survey for which these are the same share the draws
(`amibayes.support.shared_results`).
"""

from __future__ import annotations

from functools import partial

import numpy as np

from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.exposure_noise import ExposureNoise
from amibayes.detection.ratio import Ratio
from amibayes.detection.treatments import ErrorTreatment
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.support.shared_results import shared
from amibayes.units import FloatArray

DRAWS_AT_ONCE, NUMBERS_AT_ONCE = 2048, 8_000_000
"""Null data sets per matrix product: what keeps the product in cache, and at most so many numbers
of data, which keeps large data within 64 MB."""


def pieces_of(n_draws: int, n_data: int) -> list[int]:
    """Sizes of the pieces that null draws are made in."""
    at_once = max(1, min(DRAWS_AT_ONCE, NUMBERS_AT_ONCE // max(n_data, 1)))
    return [len(range(n_draws)[part]) for part in slices(n_draws, at_once)]


def null_draws(
    bank: TemplateBank,
    treatment: ErrorTreatment,
    ratio: Ratio,
    n: int,
    rng: np.random.Generator,
    *,
    exposures: ExposureNoise | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> FloatArray:
    """Statistic of n data sets of noise alone, (n,).

    Parameters
    ----------
    bank : TemplateBank
    treatment : ErrorTreatment
    ratio : Ratio
    n : int
    rng : numpy.random.Generator
        Its seed decides the draws: targets with one seed have common random numbers.
    exposures : ExposureNoise, optional
        What exposures share of the noise.
    executor, progress, journal : optional, see `amibayes.parallel.run_job`
    """
    sizes = pieces_of(n, bank.n_rows)
    pieces = list(zip(spawn(rng, len(sizes)), sizes, strict=True))
    where, search = executor or SerialExecutor(), (bank, treatment.of_nulls, ratio, exposures)

    def drawn() -> FloatArray:
        work = partial(_piece, *search)
        done = run_job(work, pieces, where, journal=journal, progress=progress)
        return np.concatenate([piece["statistic"] for piece in done])

    return shared(drawn, "null draws", search, pieces)


def noise_of_rows(
    treatment: ErrorTreatment,
    exposures: ExposureNoise | None,
    normals: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Noise of data sets (n_rows, n) of a bank, out of independent unit normals."""
    if exposures is not None:
        normals = exposures.shared(normals, rng)
    return treatment.noise_of(normals, rng)


def _piece(
    bank: TemplateBank,
    treatment: ErrorTreatment,
    ratio: Ratio,
    exposures: ExposureNoise | None,
    piece: tuple[np.random.SeedSequence, int],
) -> dict[str, FloatArray]:
    rng, size = np.random.default_rng(piece[0]), piece[1]
    noise = noise_of_rows(treatment, exposures, bank.normals(size, rng), rng)
    found = treatment.search_simulated(bank, noise)
    return {"statistic": ratio(found.gain, found.chi2)}
