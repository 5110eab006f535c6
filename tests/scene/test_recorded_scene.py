"""Numbers of scenes as they were recorded: a change of any of them is seen.

`pytest tests/scene/test_recorded_scene.py --force-regen` records them anew.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from recorded_numbers import checker

from amibayes import load_scene
from amibayes.scene.disc import disc_visibility, uniform_disc
from amibayes.scene.orientation import Orientation, orientation_of_matrix
from amibayes.scene.sources import GaussianDisc, Point, Ring, Scene, SkyImage, UniformDisc
from amibayes.scene.spectrum import Blackbody, Flat, Tabulated, g2v
from amibayes.units import DEGREE, MAS

FREQUENCY = np.array([0.0, 1e4, 2e5, 1.1e6, 1.6e6, 3e6, 7e6])
WAVELENGTH_M = np.linspace(3.7e-6, 5.0e-6, 9)


def scene() -> Scene:
    rng = np.random.default_rng(1)
    return Scene(
        (
            Point(0.5, 3 * MAS, -2 * MAS),
            UniformDisc(0.3, 50 * MAS, -20 * MAS, 120 * MAS),
            GaussianDisc(0.2, -10 * MAS, 15 * MAS, 60 * MAS),
            Ring(0.1, 5 * MAS, 7 * MAS, 150 * MAS, 40 * MAS),
            SkyImage(
                rng.uniform(0.0, 1.0, (5, 6)),
                np.array([[-20 * MAS, 3 * MAS], [2 * MAS, 21 * MAS]]),
                0.4, -30 * MAS, 40 * MAS,
            ),
        )
    )  # fmt: skip


def test_scenes_are_those_recorded(num_regression) -> None:
    """Visibilities, sizes and images of every kind of source."""
    found = scene()
    angle = np.linspace(0.1, 2.8, len(FREQUENCY))
    u, v = FREQUENCY * np.cos(angle), FREQUENCY * np.sin(angle)
    checker(num_regression)(
        each=[c.transform(u, v) for c in found.components],
        sizes=[(c.radius_rad, c.flux) for c in found.components],
        whole=(found.flux, found.radius_rad),
        kinds=(len(found.points), len(found.extended)),
        visibility=found.visibility(u * 4e-6, v * 4e-6, 4e-6),
        brightness=found.brightness(24, 15 * MAS),
        disc=disc_visibility(FREQUENCY, 40.0),
        slope=uniform_disc(FREQUENCY, 25.0),
    )


def test_spectra_and_orientations_are_those_recorded(num_regression) -> None:
    """Photons at wavelengths, and angles between the image and the sky."""
    grid = np.linspace(3e-6, 6e-6, 12)
    table = Tabulated("made", grid, 1.0 + np.sin(1e6 * grid))
    turned = Orientation(35.0 * DEGREE, -1, (1.01, 0.02, -0.015, 0.98))
    vectors = np.array([[1.0, 2.0], [-0.5, 3.0]])
    both = (turned, Orientation(200.0 * DEGREE))
    checker(num_regression)(
        densities=[
            s.photon_density(WAVELENGTH_M) for s in (Flat(), Blackbody(3500.0), table, g2v())
        ],
        matrices=[(o.matrix, o.inverse) for o in both],
        vectors=[
            (o.to_sky(vectors), o.to_image(vectors), o.baselines_to_sky(vectors)) for o in both
        ],
        again=[orientation_of_matrix(o.matrix) for o in both],
        alike=[turned.is_like(o) for o in (turned, both[1], Orientation(35.01 * DEGREE, -1))],
    )


SOURCES = """
name = "Made"
[star]
magnitude = 5.0
filter = "F480M"
diameter_mas = 2.5
[[companion]]
separation_mas = 120.0
position_angle_deg = 75.0
contrast = 0.02
[[companion]]
east_mas = -80.0
north_mas = 30.0
delta_mag = 3.0
[[disc]]
diameter_mas = 90.0
contrast = 0.1
[[gaussian]]
fwhm_mas = 70.0
contrast = 0.07
east_mas = 12.0
[[image]]
file = "a.fits"
scale_mas = 14.0
position_angle_deg = 20.0
contrast = 0.03
[[ring]]
diameter_mas = 200.0
width_mas = 30.0
contrast = 0.05
"""


def test_files_of_scenes_are_those_recorded(tmp_path: Path, num_regression) -> None:
    """What a file asks for, in radians and shares of the light."""
    path = tmp_path / "scene.toml"
    path.write_text(SOURCES, encoding="utf-8")
    example = Path(__file__).resolve().parents[2] / "examples" / "paper_scene.toml"
    fits.PrimaryHDU(np.ones((3, 3))).writeto(tmp_path / "a.fits")
    checker(num_regression)(made=load_scene(path), example=load_scene(example))
