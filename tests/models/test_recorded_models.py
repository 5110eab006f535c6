"""Numbers of the models of the sky as they were recorded: a change of any of them is seen.

`pytest tests/models/test_recorded_models.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import niriss
from recorded_numbers import numbers_of
from test_off_axis import with_lattice

from amibayes.data.observables import Observables, join
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.bands import bands_of, dates, reference_wavelength
from amibayes.models.binary import BinaryModel
from amibayes.models.brightness import brightness, points
from amibayes.models.extended import Extended
from amibayes.models.light_points import light_points
from amibayes.models.limb_darkening import power_law_disc, power_law_with_slopes
from amibayes.models.projection import Projection

TOLERANCE = {"rtol": 0.0, "atol": 1e-6}


def two_epochs() -> Observables:
    """Two filters, three channels each, 200 days apart."""
    one, other = niriss(channels=3), niriss(0.01, 0.5, channels=3)
    setups = tuple(
        replace(s, wavelength_m=0.8 * s.wavelength_m, band_m=0.9 * s.band_m) for s in other.setups
    )
    moved = [
        replace(m, mjd=m.mjd + 200.0, wavelength_m=0.8 * m.wavelength_m, band_m=0.9 * m.band_m)
        for m in (other.vis2, other.closure_phase)
    ]
    return join([one, replace(other, setups=setups, vis2=moved[0], closure_phase=moved[1])])


COMPANION = (110.0, -75.0, 0.3)
RING = Extended("ring", "ring", smoothed=True, crescent=True, slope="free")
MODELS: dict[str, tuple[dict[str, Any], tuple[float, ...]]] = {
    "plain": ({}, COMPANION),
    "monochromatic": ({"smearing": False}, COMPANION),
    "star": (
        {"diameter_mas": "free", "limb_darkening": "free", "background": "free"},
        (*COMPANION, 40.0, 0.6, 0.1),
    ),
    "fixed star": (
        {"diameter_mas": 40.0, "limb_darkening": 0.3, "background": 0.2},
        COMPANION,
    ),
    "uniform disc": ({"diameter_mas": "free"}, (*COMPANION, 40.0)),
    "discs": (
        {"companion_diameter_mas": "free", "contrast_slope": "free"},
        (*COMPANION, 30.0, 1.5),
    ),
    "fixed colour": (
        {
            "companion_diameter_mas": 30.0,
            "contrast_slope": 1.5,
            "reference_wavelength_m": 4.3e-6,
        },
        COMPANION,
    ),
    "two": ({"companions": 2}, (*COMPANION, -60.0, 90.0, 0.1)),
    "moving": ({"fastest_mas_yr": 100.0, "reference_mjd": 60100.0}, (*COMPANION, 20.0, -35.0)),
    "bands": ({"bands": True}, (*COMPANION, 0.2)),
    "gaussian": ({"surroundings": (Extended(),)}, (*COMPANION, 0.4, 120.0, 0.6, 35.0)),
    "uniform": (
        {"surroundings": (Extended("uniform", inclined=False, slope=1.2),)},
        (*COMPANION, 0.4, 120.0),
    ),
    "ring": ({"surroundings": (RING,)}, (*COMPANION, 0.4, 120.0, 0.6, 35.0, 0.3, 0.7, 80.0, 1.1)),
    "sharp ring": (
        {"surroundings": (Extended("ring", smearing=False),)},
        (*COMPANION, 0.4, 120.0, 0.6, 35.0),
    ),
    "thin crescent": (
        {"surroundings": (Extended("ring", inclined=False, crescent=True),)},
        (*COMPANION, 0.4, 120.0, 0.7, 80.0),
    ),
}


@pytest.fixture(scope="module")
def data() -> Observables:
    return two_epochs()


def test_visibilities_and_their_slopes(data: Observables, num_regression) -> None:
    numbers = {}
    for name, (options, theta) in MODELS.items():
        if options.get("bands"):
            options = options | {"bands": tuple(b.name for b in bands_of(data))}
        likelihood = Likelihood(data, BinaryModel(**options))
        sets = np.array([theta, 0.9 * np.array(theta)])
        model, samples = likelihood.model, likelihood.samples
        value, slopes = model.gradient(samples, sets)
        found = {"visibility": model.visibility(samples, sets), "value": value, "slopes": slopes}
        parameters = likelihood.parameters
        found["bounds"] = np.array(parameters.bounds(parameters.columns()))
        found["discs"], found["at_rest"] = parameters.discs, model.at_rest(sets[:, :3])
        if name not in ("two", "moving", "bands", "discs"):
            found["response"] = model.linear_response(samples, sets[0, 3:])
        numbers |= numbers_of(**{name: found})
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_points_of_the_uv_plane(data: Observables, num_regression) -> None:
    likelihood = Likelihood(data, BinaryModel(fastest_mas_yr=1.0, contrast_slope=1.0))
    points = likelihood.samples
    numbers = numbers_of(
        points=points,
        years=points.years(60000.0),
        colour=points.log_colour(4e-6),
        colour_of_mean=points.log_colour(0.0),
        bands=bands_of(data),
        reference=reference_wavelength(data),
        dates=dates(data),
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


EXTENDED = (
    (Extended(), (0.4, 120.0, 0.6, 35.0)),
    (Extended("uniform"), (0.4, 120.0, 0.6, 35.0)),
    (RING, (0.4, 120.0, 0.6, 35.0, 0.3, 0.7, 80.0, 1.1)),
    (Extended("ring", inclined=False), (0.4, 120.0)),
)


def test_light_on_the_sky(num_regression) -> None:
    axis, numbers = np.linspace(-90.0, 90.0, 13), {}
    for k, (component, values) in enumerate(EXTENDED):
        seen = brightness(component, np.array(values), 30.0)
        numbers |= numbers_of(
            **{
                f"light {k}": seen,
                f"image {k}": seen.through(30.0, axis),
                f"points {k}": light_points(component, np.array(values)),
            }
        )
    stars = points([0.0, 10.0], [5.0, -20.0], [1.0, 0.3])
    numbers |= numbers_of(stars=stars, image=stars.through(30.0, axis))
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_discs_and_projections(num_regression) -> None:
    # Small ones by a series, large ones by Bessel functions.
    frequency = np.linspace(1e5, 3e8, 9)[:, None]
    diameter, exponent = np.array([3.0, 12.0, 30.0]), np.array([0.0, 0.6, 1.7])
    plane = Projection.of(
        np.linspace(-2.0, 3.0, 7), np.linspace(4.0, -1.0, 7), np.array([0.6]), np.array([35.0])
    )
    numbers = numbers_of(
        disc=power_law_disc(frequency, diameter, exponent),
        slopes=power_law_with_slopes(frequency, diameter, exponent)[1:],
        plane=plane,
        length=plane.length,
        length_slopes=plane.length_slopes(),
        along=plane.along(np.array([50.0])),
        along_slopes=plane.along_slopes(np.array([50.0])),
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_responses_off_the_axis(num_regression) -> None:
    """Two exposures through responses of their own, light around the star beside a companion."""
    parts = [with_lattice(np.random.default_rng(k), 60000.0 + k) for k in (1, 2)]
    data, numbers = join(parts), {}
    around = replace(RING, slope=0.0)
    for name, options, theta in (
        ("companion", {}, (30.0, -20.0, 0.3)),
        ("star", {"diameter_mas": "free", "background": "free"}, (30.0, -20.0, 0.3, 40.0, 0.1)),
        ("moving", {"fastest_mas_yr": 9.0, "reference_mjd": 59000.0}, (30.0, -20.0, 0.3, 2.0, -3)),
        ("ring", {"surroundings": (around,)}, (30, -20, 0.3, 0.4, 60, 0.6, 35, 0.3, 0.7, 80)),
    ):
        likelihood = Likelihood(data, BinaryModel(**options))
        samples, sets = likelihood.samples, np.array([theta, 0.9 * np.array(theta)])
        value, slopes = likelihood.model.gradient(samples, sets)
        seen = {"seen": likelihood.model.visibility(samples, sets), "value": value}
        numbers |= numbers_of(**{name: seen | {"slopes": slopes}})
    off_axis, waves = samples.off_axis, samples.response_waves
    assert off_axis is not None
    numbers |= numbers_of(
        waves=waves,
        start=off_axis.start,
        through=off_axis.with_slopes((np.array([5.0, -30.0]), np.array([20.0, 8.0]))),
        centre=off_axis.centre(value),
        moves=off_axis.centre_slopes(value, slopes),
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-5})
