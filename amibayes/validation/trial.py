"""One trial: files of a simulated star are searched, and the answer is compared with the truth."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.companion_search.field import resolution_mas
from amibayes.detection.verdict import STATEMENTS
from amibayes.errors import AmibayesError, RunError
from amibayes.extraction import ExtractOptions
from amibayes.extraction.reading import ImageOptions
from amibayes.limits.injection import at_its_place
from amibayes.parallel import child_seeds
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.search import search_companion
from amibayes.posterior.ensemble import Posterior
from amibayes.posterior.priors import Prior, PriorSetting
from amibayes.units import FloatArray, position_angle_deg
from amibayes.validation.plan import RANGES, ValidationPlan

RANKED = ("east_mas", "north_mas", "contrast")
"""Quantities whose ranks must be uniform; the position angle is circular."""

COVERED = ("separation_mas", "position_angle_deg", "delta_mag")
LEVELS = (0.68, 0.95)

STAR_K = 5800.0
"""Blackbody that the extraction takes for the simulated spectrum, which is that of a G2 star."""

Piece = tuple[int, str, np.random.SeedSequence]
"""Number of the trial, kind, and its randomness."""


def run_trial(plan: ValidationPlan, piece: Piece) -> dict[str, Any]:
    """Simulate one target with its calibrators, and search its files as ``amibayes search`` does.

    Parameters
    ----------
    plan : ValidationPlan
    piece : (number, kind, seed)

    Returns
    -------
    dict
        ``false_alarm_probability``, ``statement`` (number in `STATEMENTS`), and for a
        companion ``truth`` (3,), ``rank`` (3,), ``covered`` (3, 2), ``found``, ``expected``
        (probability that it would be found), ``second`` (false-alarm probability of a second).

    Raises
    ------
    RunError
        Where the analysis of simulated data fails: that too is an answer.
    """
    number, kind, seed = piece
    of_truth, of_data, of_search = child_seeds(seed, 3)
    setting = plan.settings[number % len(plan.settings)]
    prior = Prior(*setting.field_mas, *RANGES.get(kind, (1e-5, 1.0)))
    truth = None if kind == "alone" else prior.draw(np.random.default_rng(of_truth), 1)[0]
    options = options_of(plan, setting.field_mas, kind, int(of_search.generate_state(1)[0]))
    try:
        with threadpool_limits(1), TemporaryDirectory() as folder:
            files = setting.write(truth, of_data, Path(folder))
            report = search_companion(*files, options)
    except AmibayesError as error:
        raise RunError(f"trial {number} ({kind}): {error}", source="validate") from error
    return answer_of(report, truth)


def options_of(
    plan: ValidationPlan, field_mas: tuple[float, float], kind: str, seed: int
) -> SearchOptions:
    """Options of the search; what is compared with a truth alone is left out without one."""
    known = kind in RANGES
    return SearchOptions(
        separation_mas=field_mas,
        alpha=plan.alpha,
        null_draws=plan.null_draws,
        prior=(PriorSetting("contrast", bounds=RANGES[kind]),) if known else (),
        companions=(0, 1, 2) if known else (),
        # The second companion's false-alarm probability does not depend on it.
        evidence_method="laplace",
        posterior=known,
        limits=known,
        seed=seed,
        images=ImageOptions(ExtractOptions(temperature_k=STAR_K)),
        **plan.options,
    )


def answer_of(report: SearchReport, truth: FloatArray | None) -> dict[str, Any]:
    """Compare what a search delivers with the truth; see `run_trial`."""
    tested, verdict = report.significance, report.verdict
    assert tested is not None
    assert verdict is not None
    answer: dict[str, Any] = {
        "false_alarm_probability": tested.probability,
        "statement": STATEMENTS.index(verdict.statement),
    }
    posterior, limits, second = report.posterior, report.limits, report.second_significance
    if truth is None or posterior is None or limits is None or second is None:
        return answer
    companion, rho = report.result.companion, float(np.hypot(*truth[:2]))
    place = np.array([companion.east_mas, companion.north_mas])
    near = bool(at_its_place(place, truth[:2], resolution_mas(report.result.likelihood)))
    return answer | {
        "truth": truth,
        "rank": _ranks(posterior, truth),
        "covered": _covered(posterior, truth),
        "found": bool(tested.detected) and (near or limits.counts_anywhere(rho)),
        "expected": limits.probability(rho, truth[2]),
        "second": second.probability,
    }


def _ranks(posterior: Posterior, truth: FloatArray) -> list[float]:
    columns = (posterior.column(name) for name in RANKED)
    return [float(np.mean(c < x)) for c, x in zip(columns, truth, strict=True)]


def _covered(posterior: Posterior, truth: FloatArray) -> list[list[bool]]:
    """Whether the intervals of `LEVELS` hold the truth, for each quantity of `COVERED`."""
    values = {
        "separation_mas": float(np.hypot(truth[0], truth[1])),
        "position_angle_deg": float(position_angle_deg(truth[0], truth[1])),
        "delta_mag": float(-2.5 * np.log10(truth[2])),
    }
    return [[_inside(posterior, name, values[name], level) for level in LEVELS] for name in COVERED]


def _inside(posterior: Posterior, name: str, value: float, level: float) -> bool:
    median, low, high = posterior.interval(name, level)
    if name == "position_angle_deg":
        value = median + (value - median + 180.0) % 360.0 - 180.0
    return low <= value <= high
