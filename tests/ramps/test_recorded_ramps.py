"""Numbers of charge migration as they were recorded: a change of any of them is seen.

`pytest tests/ramps/test_recorded_ramps.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from recorded_numbers import checker

from amibayes.cube import Cube
from amibayes.cube.ramps import RampFile
from amibayes.cube.reference_files import Linearity
from amibayes.cube.source import InMemoryCube
from amibayes.cube.timing import GroupTiming
from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.ramps.converter import WAVES, table, waves
from amibayes.ramps.correction import MigrationFree, charge_lost, electrons_of, slope_time_s
from amibayes.ramps.curvature import Curvature, curvature_of, expected_curvature, filled
from amibayes.ramps.fit import fit_migration, survival
from amibayes.ramps.header import migration_cards, migration_of
from amibayes.ramps.migration import Migration
from amibayes.ramps.own_response import own_response
from amibayes.ramps.transfer import KINDS, gains, side_densities, side_operator
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import Detector
from amibayes.simulation.ramps import read_ramps

N, FRAME_S = 24, 0.07544
MOVING = Detector(zero_read=False, boundary_shift_x=4e-7, boundary_shift_y=3e-7)


class Section:
    """An array that is read like an HDU."""

    def __init__(self, array: Any) -> None:
        self.section = array


def ramps(seed: int, n_int: int, n_groups: int, waves_too: bool = False) -> RampFile:
    """Ramps of a star, in electrons, or in DN with the bias and linearity of every pixel."""
    rng = np.random.default_rng(seed)
    instrument = load_instrument("niriss", "F480M")
    channels = instrument.bandpass.channels(n=2)
    image = scene_image(Scene(), instrument, channels, N, centre_px=(0.2, -0.3), reach_px=0.5)
    light = image.at(0.1 * rng.standard_normal((n_int, 2)).clip(-4, 4))
    rate = 28e3 / (image.centred.max() * n_groups * FRAME_S)
    reads = read_ramps(np.maximum(rate * light, 0.0), MOVING, n_groups, rng).reads
    flags = np.zeros((n_int, n_groups, N, N), np.uint8)
    flags[0, 3:, 5, 6] = 4
    hdus = {"GROUPDQ": Section(flags)}
    timing = GroupTiming(n_groups, FRAME_S, FRAME_S, first_s=FRAME_S)
    template = Cube(np.empty((0, N, N)), 3e-7, "NIRISS", "F480M", unit="electron/s")
    if not waves_too:
        hdus["SCI"] = Section(reads.swapaxes(0, 1))
        return RampFile(template, n_int, hdus, None, timing)
    hdus["SCI"] = Section(reads.swapaxes(0, 1) / 1.61)
    coefficients = np.zeros((6, N, N))
    coefficients[1], coefficients[2] = 1.0, 1e-7
    bias = 12000.0 + 300.0 * rng.standard_normal((N, N))
    counted = replace(template, unit="DN/s")
    return RampFile(counted, n_int, hdus, None, timing, bias, Linearity(coefficients))


@pytest.fixture(scope="module")
def measured() -> list[Curvature]:
    found = [curvature_of(ramps(k, 8, 6, k == 1)) for k in range(2)]
    assert found[0] is not None
    assert found[1] is not None
    return found


def test_fits_are_those_recorded(measured: list[Curvature], num_regression) -> None:
    """Curvature of two exposures, one with the converter's errors, and coefficients."""
    fit = fit_migration(measured)
    y, x = np.indices((9, 8)) - 4.2
    light = 6e4 * np.exp(-(x**2 + y**2) / 9.0) + 30.0
    checker(num_regression, 1e-5)(
        exposures=measured,
        fit=fit,
        predicted=[fit.predicted(e) for e in measured],
        alone=fit_migration(measured[:1]),
        expected=expected_curvature(light, 400.0, FRAME_S, 6, 9, FRAME_S),
        survival=[survival(30.0, 20, 0.0), survival(30.0, 20, 50.0)],
    )


def test_parts_of_the_model_are_those_recorded(num_regression) -> None:
    """Light at the sides of pixels, what charge does there, and single pixels."""
    rng = np.random.default_rng(3)
    y, x = np.indices((10, 11)) - 4.3
    current = 5e4 * np.exp(-(x**2 + y**2) / 9.0)
    charge = 0.4 * current + 100.0
    image = current.copy()
    good = rng.uniform(size=image.shape) < 0.8
    image[~good] = np.nan
    change = [1e-3 * current + rng.normal(size=current.shape) for _ in range(3)]
    counts = np.linspace(1e3, 6e4, 25)
    checker(num_regression)(
        operator=side_operator(9),
        densities=side_densities(current),
        gains=gains(KINDS, charge, current),
        own=own_response(
            change,
            [current * charge * s for s in (1.0, 0.9, 1.1)],
            [np.full(image.shape, 1.0 + 0.1 * k) for k in range(3)],
        ),
        waves=waves(counts),
        table=table(1e-5 * np.arange(1.0, 1.0 + len(WAVES))),
        filled=filled(image, good),
    )  # fmt: skip


def test_corrections_are_those_recorded(measured: list[Curvature], num_regression) -> None:
    """Migration in headers, with others, and taken off slopes and ramps."""
    fit = fit_migration(measured)
    stated = Migration.isotropic(4e-7, 5e-8, "stated")
    file = ramps(4, 3, 6)
    slopes = replace(file.read(0, 3), integration_time_s=6 * FRAME_S)
    header = {"NGROUPS": 6, "TGROUP": FRAME_S, "TFRAME": FRAME_S}
    current = slopes.images[:1].astype(float)
    time_s = np.full(current.shape[1:], 0.2)
    bad = np.zeros(current.shape, bool)
    bad[0, 3, 4] = True
    cards = {
        key.removeprefix("HIERARCH "): card for key, card in migration_cards(fit.migration).items()
    }
    checker(num_regression, 1e-5)(
        stated=stated,
        beside=stated.beside(fit.migration),
        cards={k: v for k, v in cards.items() if isinstance(v, float | int)},
        back=migration_of(cards),
        names=len(fit.migration.error_names(3)),
        lost=charge_lost(stated, current, time_s, bad),
        electrons=electrons_of(slopes),
        time=slope_time_s(header),
        ramps=MigrationFree(file, fit.migration, 1.0).read(0, 3).images,
        slopes=MigrationFree(InMemoryCube(slopes), stated, 1.0, 0.25).read(0, 2).images,
        free=MigrationFree(file, stated, 1.0).mean_time_s,
    )
