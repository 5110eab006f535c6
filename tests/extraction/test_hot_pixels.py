"""Hot pixels that every integration has, beside bright fringes and beside each other."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from amibayes.cube import Cube
from amibayes.cube.source import InMemoryCube
from amibayes.extraction.cleaning import FAINT, LIGHT, _hot, _misfitting
from amibayes.extraction.extract import extract_all
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import make_operator
from amibayes.instrument import load_instrument
from amibayes.optics import psf
from amibayes.units import FloatArray

NIRISS = load_instrument("niriss", "F480M")
HOT = [(19, 37), (31, 18), (49, 0), (49, 1), (40, 45)]
"""One in a bright fringe, one in the dark, and two that hide each other from their neighbours."""


def stars(contrast: float, step_px: tuple[float, float] = (0.0, 0.0)) -> FloatArray:
    """Three integrations of 1e7 photons, with read noise, of a star and a companion."""
    rng, channels = np.random.default_rng(8), NIRISS.bandpass.channels()
    both = [
        share * psf(NIRISS, channels, 64, centre_px=(0.1 + f * step_px[0], -0.2 + f * step_px[1]))
        for f, share in ((0.0, 1.0), (1.0, contrast))
        if share
    ]
    image = 1e7 * np.sum(both, axis=0)
    return np.array([rng.poisson(image) + rng.normal(0.0, 12.0, image.shape) for _ in range(3)])


def cube(images: FloatArray) -> Cube:
    """Images without flags or errors."""
    return Cube(images, NIRISS.pixel_scale_rad, "NIRISS", "F480M")


def test_hot_pixels_of_every_integration_are_left_out() -> None:
    """As bright as 0.3 of the image's peak, and dead ones; V² and phases as without them."""
    clean = stars(0.02, (-2.3, -1.8))
    hot = clean.copy()
    for k, (y, x) in enumerate(HOT):
        hot[:, y, x] += (-0.3 if k == 4 else 0.3) * clean.max()
    good = make_operator(InMemoryCube(cube(hot)), ExtractOptions()).reference.good
    assert sorted(map(tuple, np.argwhere(~good).tolist())) == sorted(HOT)
    (one,), (two,) = (extract_all(cube(images)) for images in (clean, hot))
    assert np.abs(one.average.vis2 - two.average.vis2).max() < 2e-3
    apart = one.average.closure_phase - two.average.closure_phase
    assert np.abs(apart).max() < np.radians(0.1)


@pytest.mark.parametrize(("contrast", "step"), [(0.3, (7.0, 3.0)), (0.9, (-4.3, 1.6))])
def test_light_far_off_the_axis_is_no_hot_pixel(contrast: float, step: tuple[float, float]) -> None:
    """Its envelope is not the star's: the fit leaves tens of percent of the peak."""
    made = make_operator(InMemoryCube(cube(stars(contrast, step))), ExtractOptions())
    assert made.reference.good.all()


def misfits(image: np.ndarray, model: np.ndarray) -> list[list[int]]:
    """Rows and columns of hot pixels of an image that is fitted by a model of one shape."""
    fit = SimpleNamespace(
        design=model.reshape(-1, 1),
        inverse=np.zeros((1, model.size)),
        solve=lambda _: np.ones((1, 1)),
    )
    good = np.ones(model.shape, dtype=bool)
    found = _misfitting(image, good, np.zeros(model.shape), fit)  # type: ignore[arg-type]
    return np.argwhere(found).tolist()


@pytest.mark.parametrize(
    ("sizes", "expected"),
    [((0.8, 0.0), []), ((1.3, 0.8), [0]), ((3.0, 1.3), [0]), ((2.5, -1.4), [0, 1])],
)
def test_a_misfit_in_the_dark_is_hot_by_a_share_of_the_peak(
    sizes: tuple[float, float], expected: list[int]
) -> None:
    """In units of the least: those are found that differ by half of the worst one or more."""
    model = np.zeros((24, 24))
    model[3, 3] = 50.0
    places = [(18, 6), (12, 19)]
    image = model.copy()
    for place, size in zip(places, sizes, strict=True):
        image[place] += size * FAINT * 50.0
    assert misfits(image, model) == sorted([list(places[k]) for k in expected])


@pytest.mark.parametrize(("size", "found"), [(0.8, 0), (1.3, 1)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_misfit_beside_modelled_light_is_hot_by_a_share_of_it(
    size: float, found: int, sign: float
) -> None:
    """Whatever its sign, and up to two pixels away."""
    model = np.zeros((24, 24))
    model[12, 12], model[3, 3] = sign * 50.0, 60.0
    image = model.copy()
    image[14, 11] += size * LIGHT * 50.0
    assert misfits(image, model) == [[14, 11]] * found


@pytest.mark.parametrize("place", [(0, 0), (0, 9), (11, 4), (5, 6), (19, 19)])
@pytest.mark.parametrize("size", [9.0, -9.0])
def test_a_pixel_unlike_its_neighbours_is_hot_or_dead_at_edges_too(
    place: tuple[int, int], size: float
) -> None:
    """And beside bad pixels, of any value; what differs by less is neither."""
    rng = np.random.default_rng(4)
    image = rng.uniform(-1.0, 1.0, (20, 20))
    good = np.ones(image.shape, dtype=bool)
    good[11, 5] = good[12, 4] = good[5, 5] = False
    image[~good] = [1e6, -1e6, 1e6]
    assert not _hot(image, good).any()
    image[place] = size
    assert np.argwhere(_hot(image, good)).tolist() == [list(place)]
    image[place] = size / 3.5
    assert not _hot(image, good).any()
