"""Two stars that are nearly equal: either may be the companion, at opposite places."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import NIRISS_HOLES, niriss, simulated

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.modes import with_exchanged
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.search import search
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box

FIELD = (80.0, 670.0)
TOLD = "fitted as two stars, they are equally bright"


def test_equal_stars_are_at_either_place(rng) -> None:
    """Data that give the contrast to 0.002 cannot tell 0.9999 from its inverse, turned round.

    A narrow band: a wide one smears the star that is off the axis, and tells it by that.
    """
    place = np.array([126.0, -62.0])
    sheet = point_source(
        NIRISS_HOLES, [4.8e-6], 1e-9, vis2_error=0.01, closure_error_rad=np.radians(2.0)
    )
    result = search(Likelihood(simulated(sheet, (*place, 0.9999), rng)), FIELD)
    places = [np.array(m.place) for m in result.modes]
    assert min(np.hypot(*(p - place)) for p in places) < 2.0
    assert min(np.hypot(*(p + place)) for p in places) < 2.0
    assert any(TOLD in w for w in result.warnings)


@pytest.mark.parametrize("contrast", [0.4, 0.8])
def test_unequal_stars_are_at_one(contrast: float, rng) -> None:
    result = search(Likelihood(simulated(niriss(), (126.0, -62.0, contrast), rng)), FIELD)
    assert not any(TOLD in w for w in result.warnings)
    assert not any(np.hypot(*np.add(m.place, (126.0, -62.0))) < 20.0 for m in result.modes)


def test_a_fit_to_the_wrong_star_is_turned_round(rng) -> None:
    """Discs and positions change places, and the fit is the better one."""
    stations = np.array([[-15.0, -56.0], [67.0, -95.0], [80.0, 63.0], [107.0, -2.0]])
    sheet = point_source(
        stations, [1.55e-6, 1.65e-6], 0.1e-6, vis2_error=0.01, closure_error_rad=0.02
    )
    model = BinaryModel(diameter_mas="free", companion_diameter_mas="free")
    truth = np.array([3.0, 0.7, 0.97, 0.7, 0.5])
    names = ["east_mas", "north_mas", "contrast", "diameter_mas", "companion_diameter_mas"]
    likelihood = Likelihood(sheet, model)
    order = [names.index(name) for name in likelihood.parameters.names]
    likelihood = Likelihood(simulated(sheet, truth[order], rng, model), model)
    box = Box(1.0, 10.0, resolution_mas(likelihood))
    wrong = refine(likelihood, np.array([-3.0, -0.7, 1.0, 0.5, 0.7])[order], box, 0.0)
    assert np.hypot(*np.add(wrong.place, truth[:2])) < 0.1
    first, turned = with_exchanged(likelihood, [wrong], box, 0.0)
    assert first is wrong
    assert turned.delta_chi2 > wrong.delta_chi2 + 1.0
    assert np.hypot(*np.subtract(turned.place, truth[:2])) < 0.1
