"""What is free unasked: limb darkening only where the star is resolved past its first null."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import simulated

from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import model_of
from amibayes.pipeline.options import SearchOptions

STATIONS = np.array([[0.0, 0.0], [30.0, 10.0], [-20.0, 45.0], [60.0, -30.0]])


@pytest.mark.parametrize(("diameter", "expected"), [(1.0, 0.0), (2.5, 0.0), (6.0, "free")])
def test_limb_darkening_is_free_where_the_star_is_past_its_null(diameter, expected, rng) -> None:
    """96 m in H: the first null of a disc is reached at 4.3 mas."""
    sheet = point_source(
        STATIONS, np.linspace(1.55e-6, 1.75e-6, 4), 0.04e-6, vis2_error=0.01, closure_error_rad=0.02
    )
    model = BinaryModel(diameter_mas=diameter)
    data = simulated(sheet, [5.0, 5.0, 0.0], rng, model)
    found = model_of(Likelihood(data), SearchOptions())
    assert found.limb_darkening == expected
    assert model_of(Likelihood(data), SearchOptions(limb_darkening=0.1)).limb_darkening == 0.1
