"""F277W: pixels that are too large for the fringes of the longest baselines."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from jwst_products import binary, integrations, write_product

from amibayes.cube import Cube
from amibayes.data.observables import Observables
from amibayes.extraction.extract import extract_all
from amibayes.extraction.reading import read_observations
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import read_oifits, write_oifits
from amibayes.units import MAS

INSTRUMENT = load_instrument("niriss", "F277W")
PIXEL_MAS = INSTRUMENT.pixel_scale_rad / MAS
SIDE_PX, CELLS = 64, 48
NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)


def hexagon() -> tuple[np.ndarray, np.ndarray]:
    """Share of each cell (CELLS, CELLS) of a square that a hole fills, and the cells' places."""
    width, finer = 1.2 * INSTRUMENT.mask.size_m, 8
    axis = ((np.arange(CELLS * finer) + 0.5) / (CELLS * finer) - 0.5) * width
    x, y = np.meshgrid(axis, axis)
    flats = np.radians([30.0, 90.0, 150.0])
    across = [np.abs(x * np.cos(a) + y * np.sin(a)) for a in flats]
    inside = np.max(across, axis=0) < 0.5 * INSTRUMENT.mask.size_m
    share = inside.reshape(CELLS, finer, CELLS, finer).mean(axis=(1, 3))
    return share, axis.reshape(CELLS, finer).mean(axis=1)


def point(x_mas: float, y_mas: float) -> np.ndarray:
    """Image of a point: the sum over the pupil, squared, by three places of Gauss per pixel."""
    share, cell = hexagon()
    middle = (np.arange(SIDE_PX) + 0.5 - SIDE_PX / 2)[:, None]
    places = (middle + 0.5 * NODES).ravel() * PIXEL_MAS
    weight = np.tile(WEIGHTS / 2.0, SIDE_PX)
    channels = INSTRUMENT.bandpass.channels()
    image = np.zeros((len(places), len(places)))
    for wavelength, part in zip(channels.wavelength_m, channels.weight, strict=True):
        k = 2j * np.pi * MAS / wavelength
        by_y, by_x = (np.exp(k * np.outer(places - at, cell)) for at in (y_mas, x_mas))
        waves = (
            np.outer(np.exp(k * (places - y_mas) * b), np.exp(k * (places - x_mas) * a))
            for a, b in INSTRUMENT.mask.holes_m
        )
        image += part * np.abs(by_y @ share @ by_x.T * sum(waves) / wavelength) ** 2
    image *= np.outer(weight, weight)
    return np.asarray(image.reshape(SIDE_PX, 3, SIDE_PX, 3).sum(axis=(1, 3)))


def extracted(place_px: tuple[float, float], companion: tuple[float, float, float]) -> Observables:
    """Of images without noise, the star at a place, by (x, y), and north up, east left."""
    x, y = PIXEL_MAS * np.array(place_px)
    east, north, contrast = companion
    image = point(x, y) + contrast * point(x - east, y + north)
    images = np.repeat(1e9 * image[None] / image.sum(), 3, axis=0)
    cube = Cube(
        images=images,
        pixel_scale_rad=INSTRUMENT.pixel_scale_rad,
        instrument="NIRISS",
        filter="F277W",
        error=np.sqrt(images + 225.0),
        integration_time_s=1.0,
        mjd=60000.0 + np.arange(3) / 86400.0,
    )
    (found,) = extract_all(cube)
    assert found.operators[0].geometry.stated
    return found.observables


@pytest.mark.parametrize("companion", [(-130.0, 100.0, 0.06), (-270.0, 210.0, 0.06)])
@pytest.mark.parametrize("place_px", [(0.25, 0.0), (0.3, -0.2)])
def test_a_binary_is_what_the_response_at_its_place_predicts(
    place_px: tuple[float, float], companion: tuple[float, float, float], tmp_path: Path
) -> None:
    """Of images by sums over the pupil; a lone star elsewhere takes a calibrator's place.

    A response that is alike at opposite places is wrong by a third of what the companion does,
    and a pixel scale that the companion sways by as much.
    """
    found, star = extracted(place_px, companion), extracted((0.0, 0.0), (0.0, 0.0, 0.0))
    write_oifits(tmp_path / "a.oifits", found)
    for data in (found, read_oifits(tmp_path / "a.oifits")):
        response = data.setups[0].response
        assert response is not None
        assert not response.symmetric
        n = data.n_vis2
        expected = Likelihood(data, BinaryModel()).predict(np.array([companion]))[:, 0]
        left = np.append(data.data[:n] / star.data[:n], data.data[n:] - star.data[n:]) - expected
        change = np.append(expected[:n] - 1.0, expected[n:])
        for part in (slice(0, n), slice(n, None)):
            assert np.linalg.norm(left[part]) < 0.02 * np.linalg.norm(change[part])
    assert any("place within a pixel" in note for note in found.notes)


@pytest.mark.parametrize(("name", "coarse"), [("F277W", True), ("F480M", False)])
def test_a_product_does_not_tell_the_place_within_a_pixel(
    name: str, coarse: bool, tmp_path: Path
) -> None:
    visibility = integrations(binary(0.1, 120.0, -80.0), 0.02, 9, np.random.default_rng(1))
    path = write_product(tmp_path / "a.fits", "ami-oi", visibility, FILTER=name)
    (found,) = read_observations(path)
    assert any("where in a pixel the star is" in note for note in found.notes) == coarse
