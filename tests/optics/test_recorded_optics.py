"""Numbers of images and fringes as they were recorded: a change of any of them is seen.

`pytest tests/optics/test_recorded_optics.py --force-regen` records them anew.
"""

from __future__ import annotations

import numpy as np
import pytest
from recorded_numbers import checker

from amibayes.instrument import Channels, Mask, load_instrument
from amibayes.optics import (
    PupilMap,
    Wavefront,
    fringe_basis,
    fringe_field,
    fringe_image,
    psf,
    scene_image,
)
from amibayes.optics.holes import coverage, hole_transform
from amibayes.optics.psf import amplitude, axis_nodes, intensity, pixel_rule
from amibayes.optics.sampling import (
    fine_sampling,
    fine_size,
    interpolator,
    pixel_operator,
    pixel_transform,
    pixel_weights,
    shifted_images,
)
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import GaussianDisc, Point, Scene, UniformDisc
from amibayes.units import MAS

F430M = load_instrument("niriss", filter="F430M")
CHANNELS = F430M.bandpass.channels(n=2)


@pytest.mark.parametrize("shape", ["hexagon", "circle"])
def test_holes_are_those_recorded(shape: str, num_regression) -> None:
    """Transforms, cells that a hole covers, and images through wavefronts."""
    mask = Mask(shape, np.array([[0.0, 0.0], [2.0, 0.3], [-0.5, 1.8]]), shape, 0.8, 0.3)
    rng = np.random.default_rng(1)
    f = rng.normal(0.0, 2.0, (2, 30))
    edges = np.linspace(-0.6, 0.6, 14)
    x, y = np.linspace(-4e-6, 4e-6, 7), np.linspace(-3e-6, 5e-6, 6)
    pupil = PupilMap(1e-7 * rng.normal(size=(24, 24)), 6.0)
    waves = {
        "flat": None,
        "pistons": Wavefront(np.array([0.0, 2e-7, -1e-7]), 1e-7 * rng.normal(size=(3, 2))),
        "map": Wavefront(map=pupil),
    }
    checker(num_regression)(
        transform=hole_transform(mask, *f),
        zero=hole_transform(mask, np.zeros(1), np.zeros(1)),
        covered=coverage(mask, np.array([0.02, -0.03]), edges, edges),
        intensity={k: intensity(mask, 4.3e-6, x, y, w) for k, w in waves.items()},
        amplitude={k: amplitude(mask, 4.3e-6, x, y, w) for k, w in waves.items()},
        cell=(pupil.cell_m, pupil.edges_m, pupil.cell_transform(*f)),
        patches=pupil.patches(mask),
    )


def test_images_of_stars_are_those_recorded(num_regression) -> None:
    """Pixels, fine pixels, points of pixels, and a scene that is turned and moved."""
    rng = np.random.default_rng(2)
    wavefront = Wavefront(3e-8 * rng.normal(size=7), 2e-8 * rng.normal(size=(7, 2)))
    scene = Scene(
        (
            Point(),
            Point(0.1, 150 * MAS, -90 * MAS),
            UniformDisc(0.2, 10 * MAS, 30 * MAS, 90 * MAS),
            GaussianDisc(0.1, 0.0, 0.0, 40 * MAS),
        )
    )
    options = {"centre_px": (0.3, -0.2), "reach_px": 0.4}
    image = scene_image(scene, F430M, CHANNELS, 20, orientation=Orientation(0.6, -1), **options)
    rough = scene_image(
        Scene(), F430M, CHANNELS, 20, wavefront=wavefront, pixel_response=0.05, **options
    )
    shifts = np.array([[0.1, 0.2], [-0.3, 0.05], [0.0, 0.0]])
    checker(num_regression, 1e-5)(
        pixels=psf(F430M, CHANNELS, 20, centre_px=(0.2, 0.7)),
        fine=psf(F430M, CHANNELS, 10, oversample=2),
        points=psf(F430M, CHANNELS, 12, integrate=False, wavefront=wavefront),
        scene=(image.centred, image.at(shifts), image.mean(shifts), image.nodes_px),
        rough=(rough.centred, rough.at(shifts), rough.mean(shifts)),
        rule=pixel_rule(F430M.mask, CHANNELS, F430M.pixel_scale_rad),
        nodes=axis_nodes(9, 3e-7, 0.3, np.array([-0.3, 0.3])),
    )


def test_fringes_are_those_recorded(num_regression) -> None:
    """The fringe model, the fields of fringes, and their images."""
    basis = fringe_basis(F430M, CHANNELS, 14, centre_px=(0.2, -0.1), rotation_rad=0.02)
    scaled = fringe_basis(F430M, CHANNELS, (11, 13), pixel_scale_rad=3.3e-7)
    field = fringe_field(F430M, CHANNELS, 14, rotation_rad=0.01)
    coefficients = np.r_[1.0, np.random.default_rng(3).normal(size=42)]
    visibility = np.exp(1j * np.linspace(0.0, 2.0, basis.n_baselines)) * 0.8
    checker(num_regression)(
        basis=(basis.matrix, basis.image(visibility), basis.image()),
        scaled=(scaled.matrix, scaled.image(0.5)),
        field=(field.hills, field.frequency_px, field.spacing_px),
        at=field.basis((9, 10), (0.4, -0.3)),
        image=fringe_image(F430M, CHANNELS, coefficients, 14, 2, rotation_rad=0.02),
    )


def test_sampling_is_that_recorded(num_regression) -> None:
    """Pixels of fine images, moved by parts of pixels, with a response that falls to the edges."""
    rng = np.random.default_rng(4)
    fine = rng.normal(size=(48, 48)).astype(np.float32)
    shifts = rng.uniform(-0.4, 0.4, (3, 2))
    mono = Channels.monochromatic(4.3e-6)
    checker(num_regression, 1e-5)(
        sizes=[fine_sampling(b) for b in (0.2, 0.37, 0.49)],
        side=[fine_size(20, 3, 0.6), fine_size(21, 4, 1.0)],
        operator=[pixel_operator(8, 48, 3, s, r) for s, r in ((0.0, 0.0), (0.3, 0.05))],
        shifted=shifted_images(fine, 3, (8, 8), shifts),
        transform=[pixel_transform(np.linspace(0.0, 0.6, 9), r) for r in (0.0, 0.04)],
        weights=[pixel_weights(r) for r in (0.0, 0.04)],
        weighted=interpolator(np.array([-1.0, 0.2, 0.9])),
        mono=psf(F430M, mono, 6),
    )
