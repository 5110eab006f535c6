"""Numbers of extractions as they were recorded: a change of any of them is seen.

`pytest tests/extraction/test_recorded_extraction.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from recorded_numbers import checker

from amibayes.cube import Cube
from amibayes.extraction import ExtractOptions, extract_all
from amibayes.extraction.table import integrations, series
from amibayes.instrument import load_instrument
from amibayes.optics import psf
from amibayes.scene.orientation import Orientation
from amibayes.units import MAS

F480M = load_instrument("niriss", "F480M")
N = 48


@pytest.fixture(scope="module")
def cube() -> Cube:
    """A binary in eight jittered images with photon noise, a bad pixel and one bad image."""
    rng = np.random.default_rng(1)
    channels = F480M.bandpass.channels(n=2)
    step = np.array([-90.0, 60.0]) * MAS / F480M.pixel_scale_rad
    places = np.array([0.3, -0.2]) + 0.1 * rng.standard_normal((8, 2))
    light = np.stack(
        [
            psf(F480M, channels, N, centre_px=tuple(p))
            + 0.05 * psf(F480M, channels, N, centre_px=tuple(p + step))
            for p in places
        ]
    )
    images = rng.poisson(3e6 * light + 4.0).astype(float) - 4.0
    images[6] *= 0.6
    images[2, 20, 21] += 9e3
    dq = np.zeros(images.shape, np.uint32)
    dq[:, 30, 17] = 1
    return Cube(
        images=images,
        pixel_scale_rad=F480M.pixel_scale_rad,
        instrument="NIRISS",
        filter="F480M",
        orientation=Orientation(0.4, -1),
        error=np.sqrt(np.maximum(images, 0.0) + 10.0),
        dq=dq,
        integration_time_s=1.3,
        mjd=60000.0 + np.arange(8) / 1e4,
    )


def part_of(cube: Cube, rows: slice) -> Cube:
    """Some of the integrations."""
    names = ("images", "error", "dq", "mjd")
    return replace(cube, **{name: getattr(cube, name)[rows] for name in names})


@pytest.mark.parametrize(
    "options",
    [
        ExtractOptions(),
        ExtractOptions(method="matched", window_px=14.0, charge_migration="off"),
        ExtractOptions(method="gauss", outlier=4.0, temperature_k=4000.0),
        ExtractOptions(method="square", covariance="physical", keep_all=True),
    ],
    ids=lambda options: options.method,
)
def test_extractions_are_those_recorded(
    options: ExtractOptions, cube: Cube, num_regression
) -> None:
    """Frames, means, covariance, geometry, and the response to light beside the star."""
    (found,) = extract_all(cube, options)
    operator = found.operators[0]
    each = integrations(found)
    checker(num_regression, 1e-4)(
        frames=found.frames,
        average=found.average,
        covariance=found.covariance,
        physical=found.physical,
        observables=found.observables.covariance,
        data=found.observables.data,
        expected=found.observables.vis2.expected,
        slope=found.observables.vis2.coherent_slope,
        freedom=found.observables.freedom,
        scatter=found.observables.scatter,
        shared=found.observables.shared,
        response=found.observables.setups[0].response,
        stations=found.observables.setups[0].station_xyz_m,
        wave=(found.observables.setups[0].wavelength_m, found.observables.setups[0].band_m),
        geometry=(operator.geometry.scale, operator.geometry.scale_error,
                  operator.geometry.rotation_rad, operator.geometry.rotation_error_rad),
        noise=operator.reference.noise,
        reference=(operator.reference.image, operator.reference.scatter, operator.reference.n_bad),
        bias=operator.bias,
        weight=operator.weight,
        centre=operator.view.centre_px,
        series=series(found),
        each=each.covariance.variance,
        rejected=[number for _, number, _ in found.rejected],
        passed_over=("number", "file"),
    )  # fmt: skip


def test_single_images_and_several_files_are_extracted_as_recorded(
    cube: Cube, num_regression
) -> None:
    """No scatter to go by; and an exposure whose files differ."""
    single = replace(part_of(cube, slice(0, 1)), error=None)
    halves = [part_of(cube, s) for s in (slice(0, 5), slice(5, 8))]
    (one,) = extract_all(single)
    both = extract_all(halves, ExtractOptions(method="fft"))
    checker(num_regression, 1e-4)(
        one=(one.observables.data, one.observables.covariance),
        both=[(e.observables.data, e.observables.covariance, e.frames.flux) for e in both],
    )


def test_faint_and_migrating_images_are_extracted_as_recorded(cube: Cube, num_regression) -> None:
    """Where noise is of second order, and where charge between pixels is taken out."""
    rng = np.random.default_rng(2)
    light = np.maximum(1e-3 * cube.images, 0.0)
    noisy = rng.poisson(light) + rng.normal(0.0, 0.5, light.shape)
    faint = replace(cube, images=noisy, error=np.sqrt(light + 0.25))
    sampling = extract_all(cube, ExtractOptions(method="gauss"))[0].operators[0].sampling
    flux = 3.0
    samples = np.full(sampling.n_samples, 0.7 * flux, dtype=complex)
    timed = replace(cube, header={"NGROUPS": 6, "TGROUP": 0.07544, "TFRAME": 0.07544})
    weak = extract_all(faint, ExtractOptions(method="gauss", keep_all=True, clip=9.0))[0]
    moved = extract_all(timed, ExtractOptions(charge_migration=4e-7))[0]
    checker(num_regression, 1e-4)(
        weak=(weak.observables.data, weak.observables.covariance, weak.physical),
        moved=(moved.observables.data, moved.observables.covariance),
        squares=sampling.squares(flux, samples, np.linspace(1.0, 2.0, len(sampling.linear))),
        shared=moved.observables.shared,
        charge=moved.charge.migration,
    )
