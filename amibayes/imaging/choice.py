"""The weight of the regulariser, by data that an image was not made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.folds import folds_of
from amibayes.imaging.problem import FEWER_ITERATIONS, Problem
from amibayes.likelihood.chi2 import REJECTED, chi2_survival
from amibayes.models.uv_points import UVPoints
from amibayes.units import BoolArray, FloatArray

WEIGHTS = tuple(10.0 ** np.arange(3.5, -0.6, -0.5))
"""Weights that are tried, the smoothest image first: each begins at the one before."""


def cross_validated(
    problem: Problem,
    data: Observables,
    samples: UVPoints,
    rng: np.random.Generator,
    progress: Callable[[int, int], None] | None,
) -> FloatArray:
    """Weights, mean deviance per datum left out, and its standard error, (3, n_weights).

    Raises
    ------
    DataError
        Where all data are of one baseline.
    """
    splits = folds_of(data, rng)
    if not splits:
        raise DataError(
            "has one baseline: nothing can be left out to choose the regulariser's weight by",
            source=data.source,
            remedy="give --weight, or more baselines",
        )
    scores = np.empty((len(splits), len(WEIGHTS)))
    for k, (kept, out) in enumerate(splits):
        fitted, rest = (DataTerm.of(data, samples, part) for part in (kept, out))
        for j, values in enumerate(problem.path(fitted, WEIGHTS, FEWER_ITERATIONS)):
            left = rest.deviance(problem.visibility(values))
            scores[k, j] = left / rest.noise.n_independent
        if progress is not None:
            progress(k + 1, len(splits))
    error = scores.std(axis=0, ddof=1) / np.sqrt(len(scores)) if len(scores) > 1 else 0.0
    return np.stack([WEIGHTS, scores.mean(axis=0), np.broadcast_to(error, len(WEIGHTS))])


def as_good(scores: FloatArray, errors: FloatArray) -> BoolArray:
    """Which weights predict data left out as well as the best, within one standard error."""
    best = int(np.argmin(scores))
    return np.asarray(scores <= scores[best] + errors[best])


def p_fit(term: DataTerm, chi2: float) -> float:
    """Probability that noise alone gives a χ² as large, all data being degrees of freedom."""
    return float(chi2_survival(chi2, term.noise.n_independent, term.noise.degrees))


def largest_that_fits(
    problem: Problem, term: DataTerm, table: FloatArray
) -> tuple[float, FloatArray]:
    """Choose the weight, with variables (n,) to begin its image from.

    The largest that predicts as well as the best, and whose image fits the data: where few
    baselines are left to predict from, the standard error lets every weight pass. Where no image
    fits, the one that predicts best.
    """
    weights, scores, errors = table
    passed, best = as_good(scores, errors), int(np.argmin(scores))
    kept = []
    for k, values in enumerate(problem.path(term, weights)):
        kept.append(values)
        if passed[k] and p_fit(term, term.chi2(problem.visibility(values))) >= REJECTED:
            return float(weights[k]), values
    return float(weights[best]), kept[best]


def before(problem: Problem, term: DataTerm, weight: float) -> FloatArray:
    """Variables (n,) that the image of a weight begins with: those of the larger weights."""
    larger = [w for w in WEIGHTS if w > 1.001 * weight]
    return [problem.first(term), *problem.path(term, larger)][-1]
