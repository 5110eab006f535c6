"""Limits that `plan` predicts against those that simulated, calibrated searches reach.

    python docs/plan_floor.py

For each number of photons a star and three calibrators of half its brightness are simulated in
images, extracted, calibrated and searched, and the limits of the search (95 % recovered at a
false-alarm probability of 0.0013, by injection) are compared with the plan's, with and without
its floor. Integrations are put together, 25 to an exposure, with the charge, the read noise and
the migration between pixels of as many as they stand for: their statistics are the same and the
10⁴ images of 10¹⁰ photons need not be drawn. Of charge migration the images have what the error of
the instrument's value leaves, and extraction attaches that error, as it does.
Writes the table of command_line.md, in some 10 minutes of one core.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from pages import put_table

from amibayes import Observables, calibrate, detection_limit, load_instrument
from amibayes.cube import Cube
from amibayes.data.shared_errors import SharedErrors
from amibayes.extraction import ExtractOptions
from amibayes.extraction.extract import extract_all
from amibayes.instrument import Instrument
from amibayes.pipeline.false_alarm import false_alarm
from amibayes.pipeline.field import search_field
from amibayes.pipeline.migration_plan import migration_change
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.planning import Expectation, Floor, Plan, expect, make_plan
from amibayes.scene.sources import Scene
from amibayes.simulation import Detector
from amibayes.simulation.detector import draw_maps
from amibayes.simulation.exposure import Exposure
from amibayes.simulation.observe import simulate
from amibayes.simulation.wavefront import WavefrontErrors
from amibayes.units import MAS, FloatArray, contrast_to_delta_mag

PHOTONS = (1e6, 1e7, 1e8, 1e9, 1e10)
SEPARATIONS = (110.0, 160.0, 230.0, 300.0, 370.0)
INTEGRATIONS = 25
N_PIXELS = 64
NULLS, TRIALS = 4000, 40
REALISATIONS = 3
"""Of pointings, flat field, wavefront and noise: the limits of one scatter by 0.2 mag."""


@dataclass(frozen=True)
class Row:
    """Limits (n,), magnitudes: of photons at a known place, of the plan, of searches (k, n)."""

    photons: float
    alone: FloatArray
    planned: FloatArray
    reached: FloatArray


def exposure(plan: Plan, brightness: float) -> tuple[Detector, float]:
    """Detector and count rate of integrations that stand for many."""
    share = plan.total_photons / INTEGRATIONS
    rate = share / (plan.n_groups * plan.options.frame_time_s)
    together = rate / (brightness * plan.count_rate_e_s)
    known = plan.instrument.charge_migration
    shift = 0.0 if known is None else known.error / together
    plain = Detector(frame_time_s=plan.options.frame_time_s)
    noise = plain.read_noise_e * np.sqrt(together)
    full = max(plain.full_well_e * together, plain.full_well_e)
    detector = replace(
        plain, read_noise_e=float(noise), full_well_e=float(full),
        boundary_shift_x=shift, boundary_shift_y=shift,
    )  # fmt: skip
    return detector, rate


def observed(plan: Plan, floor: Floor, rng: np.random.Generator) -> Observables:
    """A single star, calibrated with three."""
    instrument: Instrument = plan.instrument
    n_holes = instrument.mask.n_holes
    errors = WavefrontErrors(1e-9 * floor.piston_nm, 0.0, 1e-9 * floor.drift_nm, 0.0)
    shared, *own = rng.bit_generator.seed_seq.spawn(2 + floor.calibrators)
    together = errors.shared(n_holes, shared)
    flat = draw_maps(Detector(flat_error=floor.flat), (N_PIXELS, N_PIXELS), rng)
    cubes = []
    for k, seed in enumerate(own):
        detector, rate = exposure(plan, floor.brightness if k else 1.0)
        cube = simulate(
            Scene(), instrument, Exposure(plan.n_groups, INTEGRATIONS, n_pixels=N_PIXELS), rng,
            maps=flat, detector=detector, count_rate_e_s=rate,
            wavefront=errors.drifted(together, n_holes, seed),
        )  # fmt: skip
        cubes.append(replace(cube, header=dict(cube.header) | {"TARGNAME": f"star {k}"}))
    found = extract_all(cubes, ExtractOptions(charge_migration="off"))
    pairs = zip(cubes, found, strict=True)
    stars = [
        with_migration(plan, e.observables, cube, floor.brightness if k else 1.0)
        for k, (cube, e) in enumerate(pairs)
    ]
    return calibrate(stars[0], stars[1:], rng=rng).observables


def with_migration(plan: Plan, star: Observables, cube: Cube, brightness: float) -> Observables:
    """The error of the instrument's value, which all stars share, as extraction holds it."""
    known = plan.instrument.charge_migration
    if known is None:
        return star
    pixel = cube.pixel_scale_rad / MAS
    centre = tuple(float(cube.header[key]) / pixel for key in ("DITHER_X", "DITHER_Y"))
    change = known.error * brightness * migration_change(plan, Detector(), centre)
    return star.with_shared_errors(SharedErrors(("charge migration",), change[:, None]))


def searched(data: Observables, rng: np.random.Generator) -> FloatArray:
    """Limits of the search of some data, magnitudes."""
    options = SearchOptions(null_draws=NULLS)
    found = search_field(data, options)
    tested = false_alarm(found.result, options, rng)
    limit = detection_limit(
        found.result, tested, rng, separation_mas=SEPARATIONS, trials=TRIALS, noise=found.noise
    )
    return np.asarray(contrast_to_delta_mag(limit.contrast))


def compared(photons: float, seed: int = 1) -> Row:
    """Plan and search of so many photons."""
    instrument = load_instrument("niriss", "F430M").as_built()
    plan = make_plan(instrument, magnitude=6.0, photons=photons)
    # Integrations that are put together have no counts that a converter could err on.
    floor = Floor(converter=0.0)
    expected: Expectation = expect(plan, (SEPARATIONS[0], SEPARATIONS[-1]), floor=floor)
    assert expected.floor is not None

    def at(x: FloatArray, y: FloatArray) -> FloatArray:
        return np.asarray(np.interp(SEPARATIONS, x, y))

    reached = []
    for k in range(REALISATIONS):
        rng = np.random.default_rng([seed + k, int(np.log10(photons))])
        reached.append(searched(observed(plan, floor, rng), rng))
    return Row(
        photons,
        at(expected.curve.separation_mas, expected.curve.delta_mag),
        at(expected.floor.separation_mas, expected.floor.delta_mag),
        np.array(reached),
    )


def table(rows: list[Row]) -> list[str]:
    """The lines of the comparison."""
    lines = [
        "| photons | 3σ, photon noise alone | plan with floor | simulated searches | plan − search "
        "(each of them) |",
        "|---|---|---|---|---|",
    ]
    for row in rows:
        means = [float(np.nanmean(x)) for x in (row.alone, row.planned, row.reached)]
        off = row.planned.mean() - np.nanmean(row.reached, axis=1)
        lines.append(
            f"| 10^{np.log10(row.photons):.0f} | {means[0]:.2f} | {means[1]:.2f} | {means[2]:.2f} "
            f"| {np.nanmean(off):+.2f} ({', '.join(f'{x:+.2f}' for x in off)}) |"
        )
    return lines


def main() -> None:
    rows = []
    for n in PHOTONS:
        rows.append(compared(n))
        print(table(rows[-1:])[-1], flush=True)
    put_table("command_line.md", table(rows), "table: docs/plan_floor.py")


if __name__ == "__main__":
    main()
