"""Numbers of simulated exposures as they were recorded: a change of any of them is seen.

`pytest tests/simulation/test_recorded_simulation.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from recorded_numbers import checker
from simulated_star import Star, still

from amibayes.instrument import load_instrument
from amibayes.parallel import SerialExecutor
from amibayes.scene.sources import Point, Scene
from amibayes.scene.spectrum import Blackbody
from amibayes.simulation.budget import (
    PlanOptions,
    integrations_for,
    make_plan,
    peak_fractions,
    published_rate,
    star_channels,
    sun_like,
)
from amibayes.simulation.detector import Detector, detector_preset, draw_maps
from amibayes.simulation.exposure import Exposure, draw_pointings
from amibayes.simulation.observation import Observation, star_rate
from amibayes.simulation.observe import prepare_exposure, simulate
from amibayes.simulation.program import example, read_program
from amibayes.simulation.ramps import (
    collected,
    converted,
    linearised,
    linearity_coefficients,
    measured_signal,
    read_ramps,
    striped,
    to_neighbours,
)
from amibayes.simulation.slopes import electron_variance, slope_weights
from amibayes.simulation.truth import exposure_header, truth_tables
from amibayes.simulation.wavefront import WavefrontErrors
from amibayes.units import MAS

REALISTIC = detector_preset("realistic")
F480M = load_instrument("niriss", "F480M")


def numbers_in(header) -> dict[str, float]:
    return {str(k): float(v) for k, v in dict(header).items() if isinstance(v, int | float)}


@pytest.mark.parametrize("preset", ["paper", "realistic", "ramps", "drifting"])
def test_exposures_are_those_recorded(preset: str, num_regression) -> None:
    """Slopes, errors and flags of presets, with and without a read at zero."""
    exposure = Exposure(5, 6, jitter_rad=10 * MAS, dither_rad=20 * MAS, n_pixels=20)
    if preset == "paper":
        detector = detector_preset("paper")
    elif preset == "realistic":
        detector = replace(REALISTIC, cosmic_rays_s=0.1)
    elif preset == "ramps":
        exposure = replace(exposure, keep_ramps=True, frame_jitter_rad=5 * MAS)
        detector = replace(
            REALISTIC, zero_read=False, cosmic_rays_s=0.1, full_well_e=3e4, linearity_error=0.01
        )
    else:
        detector = Detector(zero_read=False, boundary_shift_x=4e-7, boundary_shift_y=3e-7)
    star = Star(exposure, detector, rate_e_s=4e6)
    checker(num_regression, 1e-5)(
        taken=star.take(), pointings=star.pointings, maps=star.maps, light=star.recorder.light(
            star.pointings.jitter_px), fit=star.recorder.fit.weights, rows=still(3, 4).n_groups,
    )  # fmt: skip


def test_plans_are_those_recorded(num_regression) -> None:
    """By magnitude, count rate, photons and time, and where groups are limited."""
    plans = {
        "magnitude": make_plan(F480M, magnitude=7.0, photons=1e8),
        "counted": make_plan(F480M, count_rate_e_s=2e6, time_s=600.0),
        "faint": make_plan(F480M, magnitude=13.0, photons=1e7),
        "bright": make_plan(F480M, magnitude=2.5, photons=1e9),
        "limited": make_plan(
            F480M, magnitude=6.0, photons=1e8,
            options=PlanOptions(peak_limit_e=2e4, frame_time_s=0.1),
            detector=replace(REALISTIC, full_well_e=4e4),
        ),
    }  # fmt: skip
    checker(num_regression)(
        plans=plans,
        peaks=peak_fractions(F480M),
        sun=sun_like(F480M.bandpass),
        channels=star_channels(F480M),
        published=published_rate(load_instrument("niriss", "F430M"), 5.5),
        needed=integrations_for(3.3e8, 1.2e6, 7, 0.0754),
        rate=star_rate(Scene(magnitude=6.2, magnitude_filter="F480M"), F480M),
        passed_over=("instrument", "options"),
    )


def test_ramps_are_those_recorded(num_regression) -> None:
    """Reads with migration, non-linearity, stripes and a converter that errs."""
    rng = np.random.default_rng(1)
    y, x = np.indices((8, 9)) - 3.7
    rate = 6e4 * np.exp(-(x**2 + y**2) / 6.0) + 50.0
    detector = replace(
        REALISTIC, boundary_shift_x=5e-7, boundary_shift_y=4e-7, nonlinearity=0.03,
        linearity_error=0.02, migration=0.05, cosmic_rays_s=0.1, zero_read=False,
        stripe_noise_e=8.0, adc_nonlinearity=1.5,
    )  # fmt: skip
    ramps = read_ramps(np.stack([rate, 1.3 * rate]), detector, 6, rng)
    charge = np.cumsum(np.broadcast_to(rate, (3, 8, 9)), axis=0)
    checker(num_regression)(
        ramps=ramps,
        converted=converted(ramps.reads, detector),
        collected=collected(charge[1], rate, detector),
        striped=striped((2, 8, 9), 5.0, np.random.default_rng(2)),
        measured=measured_signal(charge, detector),
        linearised=linearised(charge, detector),
        coefficients=linearity_coefficients(detector, (3, 2)),
        neighbours=to_neighbours(rate, 0.01),
        reads=[detector.n_reads(n) for n in (2, 5)],
        noise=detector.single_read_noise_e,
        weights=slope_weights(rate, 6, detector),
        ideal=slope_weights(rate, 4, replace(detector, zero_read=True)),
        variance=electron_variance(rate, detector),
        maps=draw_maps(replace(REALISTIC, bad_pixel_fraction=0.1), (12, 11), rng),
    )


def test_truth_of_an_exposure_is_that_recorded(num_regression) -> None:
    """Header, tables, and images through errors of the wavefront."""
    scene = Scene(
        (Point(), Point(0.05, 150 * MAS, -90 * MAS)), "A", 6.5, "F480M", Blackbody(5200.0)
    )
    errors = WavefrontErrors(20e-9, 5e-9, 10e-9, 3e-9)
    seeds = np.random.SeedSequence(5).spawn(3)
    shared = errors.shared(7, seeds[0])
    wavefront = errors.drifted(shared, 7, seeds[1])
    exposure = Exposure(4, 3, n_pixels=40)
    observation = Observation(
        scene, F480M, exposure, detector_preset("paper"), wavefront=wavefront, start_mjd=60123.4
    )
    maps = draw_maps(observation.detector, (40, 40), np.random.default_rng(6))
    prepared = prepare_exposure(observation, seeds[2], maps)
    header = exposure_header(observation, prepared.pointings, observation.rate_e_s)
    tables = truth_tables(observation, prepared.pointings)
    cube = simulate(scene, F480M, exposure, np.random.default_rng(7), maps=maps)
    checker(num_regression, 1e-5)(
        shared=shared,
        wavefront=wavefront,
        rate=observation.rate_e_s,
        times=observation.mid_times_mjd,
        header=numbers_in(header),
        tables=[{n: t.data[n] for n in t.columns.names if t.data[n].dtype.kind in "fi"}
                for t in tables],
        chunks=[c for c in prepared.take(SerialExecutor())],
        cube=(cube.images, cube.error, cube.dq, cube.mjd),
        cube_header=numbers_in(cube.header),
        scale=cube.pixel_scale_rad,
        cornered=draw_pointings(exposure, 65 * MAS, seeds[0]),
    )  # fmt: skip


def test_program_is_that_recorded(tmp_path: Path, num_regression) -> None:
    """Exposures that a file asks for: rolls, dithers, calibrators, wavefronts."""
    path = tmp_path / "scene.toml"
    path.write_text(example(), encoding="utf-8")
    program = read_program(path)
    prepared = [p for _, p in islice(program.prepared_exposures(3), 1)]
    checker(num_regression)(
        specs=[s.observation for s in program.specs],
        errors=[s.errors for s in program.specs],
        pointings=[p.pointings for p in prepared],
        wavefronts=[p.observation.wavefront for p in prepared],
        passed_over=("instrument", "detector", "notes", "spectrum"),
    )
