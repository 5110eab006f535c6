"""Detection limits of companions beside a disc, a ring or a crescent, whose parameters are free.

The light around the star is a part of the model of the search: its parameters are nuisances,
whose directions are projected out of every template. Companions are injected into the best fit
of star and disc, and found by the same search.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.comparison.compare import Compared, ModelComparison
from amibayes.detection.false_alarm import Significance, significance
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.completeness import detection_limit
from amibayes.limits.limit import DetectionLimit
from amibayes.models.extended import Extended
from amibayes.parallel import Executor
from amibayes.support.options import LIMITS_NULL_DRAWS


@dataclass(frozen=True, eq=False)
class LimitsBeside:
    """What would be seen beside light around the star.

    Parameters
    ----------
    model : str
        Of that light.
    result : SearchResult
        Of a companion beside it.
    significance : Significance
        Of that companion.
    limit : DetectionLimit
    """

    model: str
    result: SearchResult
    significance: Significance
    limit: DetectionLimit


def searchable(model: Compared) -> bool:
    """Whether a model is extended light alone, beside which a linear search finds companions.

    Where bands have contrasts of their own, or images a response off the axis, that search
    takes the star and what is around it as real; a crescent is not.
    """
    likelihood = model.fit.model.likelihood
    parts = likelihood.model.surroundings
    lopsided = any(isinstance(p, Extended) and p.crescent for p in parts)
    simple = likelihood.samples.off_axis is None and not likelihood.model.bands
    light = bool(parts) and all(isinstance(p, Extended) for p in parts)
    return model.fit.hypothesis.family == "extended" and light and (simple or not lopsided)


def limits_beside(
    found: ModelComparison,
    base: Likelihood,
    separation_mas: tuple[float, float],
    rng: np.random.Generator,
    *,
    alpha: float,
    null_draws: int = LIMITS_NULL_DRAWS,
    executor: Executor | None = None,
) -> LimitsBeside | None:
    """Measure the limit beside the most probable disc, ring or crescent; None where it is none.

    Parameters
    ----------
    found : ModelComparison
    base : Likelihood
        Of the search, with a companion and its own noise.
    separation_mas : (inner, outer)
    rng : numpy.random.Generator
    alpha : float
        False-positive rate.
    null_draws : int
    executor : Executor, optional
    """
    best = found.best
    if not searchable(best):
        return None
    fit = best.fit.model.likelihood
    # The noise of the fit, without the average over its amounts: a search needs one covariance.
    noise = getattr(fit.noise, "fit", fit.noise)
    around = replace(best.fit.hypothesis.model(base.model), companions=1)
    likelihood = base.with_noise(noise).with_model(around)
    result = search(likelihood, separation_mas, single=best.theta)
    streams = rng.spawn(2)
    tested = significance(
        statistic_of(result, stated_errors=True), null_draws, streams[0], alpha, executor=executor
    )
    if tested.detected is None:
        return None  # a false-positive rate that so few draws cannot reach
    limit = detection_limit(result, tested, streams[1], executor=executor)
    return LimitsBeside(best.name, result, tested, limit)
