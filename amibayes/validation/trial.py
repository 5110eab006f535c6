"""One trial: a star is simulated, observed, and analysed, and the answer held to the truth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from amibayes.calibration import calibrate
from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.with_extra_noise import noise_averaged
from amibayes.cube import Cube
from amibayes.data.observables import Observables
from amibayes.detection.verdict import STATEMENTS
from amibayes.errors import AmibayesError, RunError
from amibayes.extraction import ExtractOptions, extract
from amibayes.instrument import load_instrument
from amibayes.limits.completeness import detection_limit
from amibayes.limits.injection import at_its_place
from amibayes.parallel import child_seeds
from amibayes.pipeline.false_alarm import false_alarm, verdict_of
from amibayes.pipeline.field import noise_prior, search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.posterior.grid import GridPosterior, grid_posterior
from amibayes.posterior.priors import Prior, default_prior
from amibayes.scene.sources import Point, Scene
from amibayes.scene.spectrum import g2v
from amibayes.simulation import Detector, Exposure, draw_maps, simulate
from amibayes.units import MAS, FloatArray, position_angle_deg
from amibayes.validation.plan import FIELD_MAS, MAGNITUDE, RANGES, SimulatedExposure, ValidationPlan

RANKED = ("east_mas", "north_mas", "ln_contrast")
"""Quantities whose ranks must be uniform; the position angle is circular."""

COVERED = ("separation_mas", "position_angle_deg", "delta_mag")
LEVELS = (0.68, 0.95)

STAR_K = 5800.0

"""Blackbody that the extraction takes for the simulated spectrum, which is that of a G2 star."""

Piece = tuple[int, str, np.random.SeedSequence]
"""Number of the trial, kind, and its randomness."""


def run_trial(plan: ValidationPlan, piece: Piece) -> dict[str, Any]:
    """Simulate and analyse one target with its calibrators.

    Parameters
    ----------
    plan : ValidationPlan
    piece : (number, kind, seed)

    Returns
    -------
    dict
        ``false_alarm_probability``, ``statement`` (number in `STATEMENTS`), and for a
        companion ``truth`` (3,), ``rank`` (3,), ``covered`` (3, 2), ``found``, ``expected``
        (probability that it would be found).

    Raises
    ------
    RunError
        Where the analysis of simulated data fails: that too is an answer.
    """
    number, kind, seed = piece
    of_truth, of_images, of_search, of_limits = child_seeds(seed, 4)
    setting = plan.settings[number % len(plan.settings)]
    prior = Prior(*FIELD_MAS, *RANGES.get(kind, (1e-5, 1.0)))
    truth = None if kind == "alone" else prior.draw(np.random.default_rng(of_truth), 1)[0]
    try:
        with threadpool_limits(1):
            observables = observe(setting, truth, of_images)
            return _analysed(plan, observables, prior, truth, (of_search, of_limits))
    except AmibayesError as error:
        raise RunError(f"trial {number} ({kind}): {error}", source="validate") from error


def observe(
    setting: SimulatedExposure, truth: FloatArray | None, seed: np.random.SeedSequence
) -> Observables:
    """Simulate a target and its calibrators on one detector, extract and calibrate them."""
    stars = [_scene(truth), *[_scene(None)] * setting.n_calibrators]
    of_maps, *seeds = child_seeds(seed, 1 + len(stars))
    target, *calibrators = (
        extract(_cube(setting, scene, of_maps, child), options=ExtractOptions(temperature_k=STAR_K))
        for scene, child in zip(stars, seeds, strict=True)
    )
    return calibrate([target], calibrators).observables


def _scene(truth: FloatArray | None) -> Scene:
    companions = () if truth is None else (Point(truth[2], truth[0] * MAS, truth[1] * MAS),)
    return Scene((Point(), *companions), "star", MAGNITUDE, "F380M", g2v())


def _cube(
    setting: SimulatedExposure,
    scene: Scene,
    of_maps: np.random.SeedSequence,
    seed: np.random.SeedSequence,
) -> Cube:
    exposure = Exposure(setting.n_groups, setting.n_integrations)
    detector, shape = Detector(), (exposure.n_pixels, exposure.n_pixels)
    return simulate(
        scene,
        load_instrument("niriss", setting.filter),
        exposure,
        np.random.default_rng(seed),
        maps=draw_maps(detector, shape, np.random.default_rng(of_maps)),
        detector=detector,
    )


def _analysed(
    plan: ValidationPlan,
    observables: Observables,
    prior: Prior,
    truth: FloatArray | None,
    seeds: tuple[np.random.SeedSequence, np.random.SeedSequence],
) -> dict[str, Any]:
    options = SearchOptions(separation_mas=FIELD_MAS, alpha=plan.alpha, null_draws=plan.null_draws)
    field = search_field(observables, options)
    result = field.result
    streams = [np.random.default_rng(s) for s in child_seeds(seeds[0], 2)]
    tested = false_alarm(result, options, streams[0])
    verdict, _ = verdict_of(result, tested, observables, options, streams[1])
    answer: dict[str, Any] = {
        "false_alarm_probability": tested.probability,
        "statement": STATEMENTS.index(verdict.statement),
    }
    if truth is None:
        return answer
    # The posterior that a search delivers: averaged over the unknown extra noise.
    delivered, _ = noise_averaged(
        result,
        None,
        observables,
        channels=field.noise.channels,
        prior=noise_prior(observables, options),
    )
    own = default_prior(result.likelihood, *FIELD_MAS)
    own = replace(own, contrast_min=prior.contrast_min, contrast_max=prior.contrast_max)
    grid = grid_posterior(delivered.likelihood, own)
    limits = detection_limit(result, tested, np.random.default_rng(seeds[1]), noise=field.noise)
    found_at = result.companion
    place = np.array([found_at.east_mas, found_at.north_mas])
    rho = float(np.hypot(*truth[:2]))
    near = bool(at_its_place(place, truth[:2], resolution_mas(result.likelihood)))
    found = bool(tested.detected) and (near or limits.counts_anywhere(rho))
    return answer | {
        "truth": truth,
        "rank": _ranks(grid, truth),
        "covered": _covered(grid, truth),
        "found": found,
        "expected": limits.probability(rho, truth[2]),
    }


def _ranks(grid: GridPosterior, truth: FloatArray) -> list[float]:
    values = [truth[0], truth[1], np.log(truth[2])]
    return [grid.cdf(name, value) for name, value in zip(RANKED, values, strict=True)]


def _covered(grid: GridPosterior, truth: FloatArray) -> list[list[bool]]:
    """Whether the intervals of `LEVELS` hold the truth, for each quantity of `COVERED`."""
    values = {
        "separation_mas": float(np.hypot(truth[0], truth[1])),
        "position_angle_deg": float(position_angle_deg(truth[0], truth[1])),
        "delta_mag": float(-2.5 * np.log10(truth[2])),
    }
    return [[_inside(grid, name, values[name], level) for level in LEVELS] for name in COVERED]


def _inside(grid: GridPosterior, name: str, value: float, level: float) -> bool:
    median, low, high = grid.interval(name, level)
    if name == "position_angle_deg":
        value = median + (value - median + 180.0) % 360.0 - 180.0
    return low <= value <= high
