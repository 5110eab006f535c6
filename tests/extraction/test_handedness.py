"""Which way round the image is, and the hexagons: settled against images made elsewhere.

The cubes are ami_sim's and MIRAGE's (ImPlaneIA and others); nothing here made them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.instrument import Instrument, Mask, load_instrument
from amibayes.optics import fringe_basis
from amibayes.scene.spectrum import g2v
from amibayes.units import MAS, FloatArray

CUBES = {
    "niriss_f480m_calibrator.fits": "F480M",
    "niriss_f430m_amisim.fits": "F430M",
    "niriss_f480m_calints.fits": "F480M",
}


def read(path: Path) -> tuple[FloatArray, float]:
    """Mean image and pixel scale in radians."""
    with fits.open(path) as units:
        unit = units["SCI"] if "SCI" in units else units[0]
        return unit.data.astype(float).mean(axis=0), unit.header.get("PIXELSCL", 0.0656) * 1e3 * MAS


def instrument_of(name: str, mirrored: bool, pointed: bool, size_m: float) -> Instrument:
    instrument = load_instrument("niriss", filter=CUBES[name])
    holes = instrument.mask.holes_m * ([-1.0, 1.0] if mirrored else [1.0, 1.0])
    turn = np.pi / 6.0 if pointed else 0.0
    mask = replace(instrument.mask, holes_m=holes, orientation_rad=turn, size_m=size_m)
    return instrument.with_mask(mask)


def residual(
    instrument: Instrument, scale: float, image: FloatArray, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residual of the fringe model and a pedestal, and the coefficients."""
    channels = instrument.bandpass.channels(g2v(), 3)
    basis = fringe_basis(
        instrument, channels, image.shape, centre_px=tuple(centre), pixel_scale_rad=scale
    )
    matrix = np.column_stack([basis.matrix * image.size, np.ones(image.size)])
    found = np.linalg.solve(matrix.T @ matrix, matrix.T @ image.ravel())
    return image.ravel() - matrix @ found, found


@cache
def fitted(
    path: Path, mirrored: bool = False, pointed: bool = False, size_m: float = 0.80
) -> tuple[float, FloatArray]:
    """Relative residual at the best centre (two Gauss–Newton steps), and visibilities."""
    image, scale = read(path)
    instrument = instrument_of(path.name.replace("target", "calibrator"), mirrored, pointed, size_m)
    peak = np.unravel_index(image.argmax(), image.shape)
    centre = np.array(peak[::-1]) - 0.5 * (np.array(image.shape[::-1]) - 1.0)
    step = 0.05
    for _ in range(2):
        middle, found = residual(instrument, scale, image, centre)
        moved = [residual(instrument, scale, image, centre + step * e)[0] for e in np.eye(2)]
        slope = np.stack([(m - middle) / step for m in moved], axis=1)
        centre = centre - np.linalg.lstsq(slope, middle, rcond=None)[0]
    last, found = residual(instrument, scale, image, centre)
    n = instrument.mask.n_baselines
    visibility = (found[1 : 1 + n] + 1j * found[1 + n : 1 + 2 * n]) / found[0]
    return float(np.linalg.norm(last) / np.linalg.norm(image)), visibility


@pytest.mark.parametrize("name", sorted(CUBES))
def test_holes_are_in_the_image_axes_not_mirrored(data: Path, name: str) -> None:
    straight, visibility = fitted(data / "cubes" / name)
    mirrored, wrong = fitted(data / "cubes" / name, mirrored=True)
    assert straight < 0.1
    assert mirrored > 3.5 * straight
    # Mirrored, some baselines look where there is no fringe.
    assert np.abs(visibility).min() > 0.9
    assert np.abs(wrong).min() < 0.1


@pytest.mark.parametrize("name", sorted(CUBES))
def test_hexagons_have_flat_top_and_bottom(data: Path, name: str) -> None:
    flat_top, _ = fitted(data / "cubes" / name)
    pointed, _ = fitted(data / "cubes" / name, pointed=True)
    assert flat_top < pointed


def test_ami_sim_images_have_the_wider_holes(data: Path) -> None:
    # Its header says 0.82 m; with that, the hexagons' direction cannot be mistaken.
    path = data / "cubes" / "niriss_f430m_amisim.fits"
    right, _ = fitted(path, size_m=0.82)
    turned, _ = fitted(path, size_m=0.82, pointed=True)
    narrow, _ = fitted(path)
    assert right < 0.5 * min(narrow, turned)


def closure_phases(mask: Mask, visibility: FloatArray) -> FloatArray:
    ij, jk, ik = mask.triangle_baselines.T
    return np.angle(visibility[ij] * visibility[jk] * visibility[ik].conj())


def test_the_companion_is_on_the_side_where_it_was_put(data: Path) -> None:
    name = "niriss_f480m_calibrator.fits"
    instrument = load_instrument("niriss", filter=CUBES[name])
    mask = instrument.mask
    target = fitted(data / "cubes" / name.replace("calibrator", "target"))[1]
    calibrator = fitted(data / "cubes" / name)[1]
    found = closure_phases(mask, target) - closure_phases(mask, calibrator)
    grid = np.arange(-298.0, 301.0, 4.0)  # not the star's own place, which explains nothing
    x, y = (axis.ravel() for axis in np.meshgrid(grid, grid))
    turn = np.exp(
        -2j * np.pi / instrument.bandpass.pivot_m * MAS * (np.stack([x, y], axis=1) @ mask.uv_m.T)
    )
    ij, jk, ik = mask.triangle_baselines.T
    # A faint companion's closure phases are linear in its flux.
    template = (turn[:, ij] + turn[:, jk] + turn[:, ik].conj()).imag
    contrast = template @ found / np.sum(template**2, axis=1)
    explained = contrast * (template @ found)
    explained[contrast < 0.0] = 0.0
    best = explained.argmax()
    assert np.hypot(x[best] - 160.0, y[best] - 117.0) < 12.0
    assert contrast[best] == pytest.approx(0.01, rel=0.15)
    # Its mirror images, which a wrong sign would find, explain much less.
    for wrong in ((-160.0, 117.0), (160.0, -117.0), (-160.0, -117.0)):
        near = np.hypot(x - wrong[0], y - wrong[1]) < 40.0
        assert explained[near].max() < 0.6 * explained[best]
