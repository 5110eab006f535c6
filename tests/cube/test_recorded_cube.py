"""Numbers of cubes and ramps as they were recorded: a change of any of them is seen.

`pytest tests/cube/test_recorded_cube.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from flagged_cube import make_cube
from recorded_numbers import checker

from amibayes.cube import DO_NOT_USE, JUMP_DET, SATURATED, open_cube, read_cube, write_cube
from amibayes.cube.container import flag_bits
from amibayes.cube.header import pixel_scale_of, wcs_matrix
from amibayes.cube.ramps import SlopeWeights, median_of_variance
from amibayes.cube.reference_files import Linearity, as_read
from amibayes.cube.timing import GroupTiming, timing_of
from amibayes.cube.write import int_times

SHAPE = (6, 7, 9, 10)


def ramp_file(path: Path, unit: str = "DN", **header: Any) -> Path:
    """Ramps with jumps, saturation, pixels without numbers, and light that is excessive."""
    rng = np.random.default_rng(1)
    y, x = np.indices(SHAPE[2:]) - 4.2
    rate = 20_000.0 * np.exp(-(x**2 + y**2) / 6.0) + 30.0
    ramps = np.cumsum(rng.poisson(rate * 0.0754 * 1.61, SHAPE), axis=1) / 1.61
    ramps = ramps + rng.normal(0.0, 9.0, SHAPE) + 500.0
    flags = np.zeros(SHAPE, np.uint8)
    ramps[1, 4:, 5, 6] += 3e4
    flags[1, 4, 5, 6] = JUMP_DET
    flags[2, 5:, 4, 4] = SATURATED
    ramps[3, 5:, 7, 7] = np.nan
    flags[4, :, 2, 2] = DO_NOT_USE
    pixels = np.zeros(SHAPE[2:], np.uint32)
    pixels[1, 1] = DO_NOT_USE
    primary = fits.PrimaryHDU()
    keywords = {"INSTRUME": "NIRISS", "FILTER": "F480M", "TGROUP": 0.0754, "PIXELSCL": 0.0656,
                "BUNIT": unit}  # fmt: skip
    primary.header.update(keywords | header)
    images = {"SCI": ramps.astype(np.float32), "GROUPDQ": flags, "PIXELDQ": pixels}
    hdus = [fits.ImageHDU(array, name=name) for name, array in images.items()]
    fits.HDUList([primary, *hdus]).writeto(path)
    return path


@pytest.mark.parametrize("averaged", [False, True])
def test_ramps_are_read_as_recorded(averaged: bool, tmp_path: Path, num_regression) -> None:
    """Slopes, errors, flags, noise and differences, of groups of one read or of several."""
    header = {"NFRAMES": 4, "TFRAME": 0.0151, "GROUPGAP": 1} if averaged else {"TFRAME": 0.0754}
    path = ramp_file(tmp_path / "a_ramp.fits", **header)
    with open_cube(path) as file:
        cube, found = file.read(1, 5), file.differences(slice(0, 3))
        timed = file.read_with_time(0, 2)
        checker(num_regression, 1e-5)(
            cube=cube,
            timed=timed[1:],
            differences=found,
            flags=file.pixel_flags,
            noise=(file.noise, file.noise_degrees),
            gain=file.gain_e,
            timing=file.timing,
            pieces=[c.images.sum() for c in file.chunks(4)],
        )


def test_weights_and_times_are_those_recorded(num_regression) -> None:
    """Weights of differences, times of groups, medians of variances, responses."""
    timing = GroupTiming(6, 0.3, 0.075, 3, 0.02)
    linear = Linearity(np.stack([np.full((2, 3), c) for c in (0.0, 1.0, 2e-6, 1e-11)]))
    values = np.linspace(0.0, 4e4, 24).reshape(4, 2, 3)
    weights = SlopeWeights.of(np.array([50.0, 2e3, 3e4]), 150.0, timing)
    checker(num_regression)(
        timing=timing,
        stated=timing_of({"NFRAMES": 2, "TFRAME": 0.05, "GROUPGAP": 1}, 5, 0.15),
        weights=weights,
        medians=[median_of_variance(n, m) for n, m in ((3, 1), (10, 4), (40, 7))],
        undone=linear.undone(values),
        read=as_read(values, linear),
        bits=flag_bits(["DO_NOT_USE", "JUMP_DET"]),
        times=[c.array for c in int_times(60000.0 + np.arange(3) / 1e3, 7.5).columns
               if c.array.dtype.kind in "fi"],
    )  # fmt: skip


def test_files_of_cubes_are_those_recorded(tmp_path: Path, num_regression) -> None:
    """What is written, read and derived of a header: orientation, scale, times, flags."""
    rng = np.random.default_rng(2)
    cube = replace(make_cube(rng, 4, (6, 7)), header={"NGROUPS": 14, "TARGPROP": "AB-DOR"})
    path = tmp_path / "a_calints.fits"
    write_cube(path, cube)
    back = read_cube(path)
    plain = tmp_path / "plain.fits"
    header = {"CD1_1": -1.8e-5, "CD1_2": 3e-6, "CD2_1": 2.9e-6, "CD2_2": 1.81e-5, "PIXELSCL": 0.065,
              "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"}  # fmt: skip
    hdu = fits.PrimaryHDU(cube.images)
    hdu.header.update(header)
    hdu.writeto(plain)
    with fits.open(path) as hdus:
        cards = {k: v for h in hdus for k, v in h.header.items() if isinstance(v, float)}
    checker(num_regression)(
        back=back,
        cards=cards,
        variance=replace(cube, dq=None).variance,
        matrix=wcs_matrix(header, "a"),
        scale=pixel_scale_of({"PIXELSCL": 0.065}, "a"),
        turned=read_cube(plain, instrument="NIRISS", filter="F430M", position_angle_deg=33.0),
        sky=read_cube(plain, instrument="NIRISS", filter="F430M"),
        passed_over=("notes", "header"),
    )
