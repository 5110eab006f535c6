"""Quantities of astropy where the number of a name with a unit is asked for."""

from __future__ import annotations

import inspect
import pickle

import numpy as np
import pytest
from astropy import units as u
from helpers import niriss, simulated

import amibayes as ab
from amibayes.errors import UsageError
from amibayes.scene.sources import Point
from amibayes.support.quantities import UNITS, plain
from amibayes.units import MAS


@pytest.mark.parametrize("word", UNITS)
def test_a_number_is_worth_what_astropy_says(word: str) -> None:
    unit = u.Unit(UNITS[word])
    given = {"mas": 0.02 * u.arcsec, "rad": 3.0 * u.deg, "deg": 2.0 * u.rad, "m": 4.8 * u.um,
             "s": 2.0 * u.min, "days": 3.0 * u.hour}[word]  # fmt: skip
    assert plain(f"some_{word}", given) == (given / unit).to_value(u.one)
    assert plain(f"some_{word}", [given, 7.0]) == [given.to_value(unit), 7.0]
    with pytest.raises(UsageError, match=f"some_{word} is in .* cannot be"):
        plain(f"some_{word}", 1.0 * u.kg)


def test_containers_hold_the_same_numbers() -> None:
    assert ab.Prior(0.05 * u.arcsec, 400 * u.mas) == ab.Prior(50.0, 400.0)
    east = (110 * u.mas).to(u.arcsec)
    assert ab.Companion(east, -75.0, 0.01).east_mas == pytest.approx(110.0)
    assert ab.Orientation(90 * u.deg) == ab.Orientation(np.pi / 2)
    assert ab.Exposure(3, 4, jitter_rad=0 * u.mas).jitter_rad == 0.0
    assert Point(0.1, 30 * u.mas).east_rad == pytest.approx(Point(0.1, 30 * MAS).east_rad)
    options = ab.SearchOptions(separation_mas=(0.05 * u.arcsec, 400 * u.mas))
    assert options == ab.SearchOptions(separation_mas=(50.0, 400.0))
    assert ab.BinaryModel(diameter_mas=3e-4 * u.arcsec).diameter_mas == pytest.approx(0.3)
    assert ab.BinaryModel(diameter_mas="free").diameter_mas == "free"
    with pytest.raises(UsageError, match="contrast_min is a plain number"):
        ab.Prior(50.0, 400.0, 1e-5 * u.mas)


def test_a_search_and_a_calibration_take_them() -> None:
    rng = np.random.default_rng(1)
    data, cal = (simulated(niriss(), [90.0, 0.0, c], rng) for c in (0.03, 0.0))
    likelihood = ab.Likelihood(data)
    found = ab.search(likelihood, (60.0 * u.mas, 0.15 * u.arcsec))
    assert found.companion == ab.search(likelihood, (60.0, 150.0)).companion
    sizes = [(1e-3 * u.arcsec, 0.1 * u.mas)]
    one, other = (ab.calibrate(data, [cal], diameters_mas=d) for d in (sizes, [(1.0, 0.1)]))
    np.testing.assert_allclose(one.observables.data, other.observables.data, rtol=1e-14)


def test_what_takes_them_is_what_it_was() -> None:
    names = ["likelihood", "separation_mas", "known", "single", "check"]
    assert list(inspect.signature(ab.search).parameters) == names
    assert pickle.loads(pickle.dumps(ab.search)) is ab.search
    prior = ab.Prior(50.0, 400.0)
    assert pickle.loads(pickle.dumps(prior)) == prior
