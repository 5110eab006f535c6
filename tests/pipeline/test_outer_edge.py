"""A fit that ends on the outer edge of all that is searched is no companion inside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import NIRISS_HOLES, simulated
from interferometer import observed

from amibayes.companion_search.field import default_separation, on_outer_edge
from amibayes.companion_search.search import search
from amibayes.data.point_source import point_source
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.pipeline.false_alarm import false_alarm, verdict_of
from amibayes.pipeline.field import FieldSearch, search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.units import MAS

OPTIONS = SearchOptions(null_draws=4000)


@pytest.mark.parametrize(
    ("place", "statement"), [((212.0, 0.0), "model rejected"), ((150.0, 40.0), "companion")]
)
def test_a_companion_beyond_the_edge_is_not_stated_on_it(place, statement, rng) -> None:
    sheet = point_source(
        NIRISS_HOLES, [4.8e-6], 0.3e-6, vis2_error=0.02, closure_error_rad=np.radians(1.0)
    )
    data = simulated(sheet, (*place, 0.05), rng)
    result = search(Likelihood(data), (80.0, 200.0))
    assert on_outer_edge(result) == (statement != "companion")
    found = FieldSearch(result, ExtraNoise(), (), data)
    tested = false_alarm(result, OPTIONS, rng)
    assert tested.detected
    assert verdict_of(found, tested, OPTIONS, rng)[0].statement == statement
    # A field that was asked for ends where its user wants it to; a warning tells of the edge.
    asked = replace(OPTIONS, separation_mas=(80.0, 200.0))
    assert verdict_of(found, tested, asked, rng)[0].statement == "companion"


def test_the_default_field_is_widened_where_the_fit_ends_on_its_edge() -> None:
    """One per cent beyond λ/B_min: the fit stood on the edge, seven errors from its place."""
    rng = np.random.default_rng(0)
    holes = NIRISS_HOLES + rng.normal(scale=0.3, size=NIRISS_HOLES.shape)  # no lattice, no aliases
    sheet = point_source(
        holes, [4.8e-6], 0.1e-6, vis2_error=0.005, closure_error_rad=np.radians(0.3)
    )
    truth = 1.01 * default_separation(Likelihood(sheet))[1]
    found = search_field(simulated(sheet, (0.0, truth, 0.02), rng), OPTIONS)
    companion = found.result.companion
    assert abs(companion.separation_mas - truth) < 3.0 * companion.separation_error_mas
    assert any("ended on the edge" in w for w in found.warnings)


def test_an_alias_outside_that_fits_as_well_is_warned_of_however_sure_a_companion_is(rng) -> None:
    """The holes of NIRISS repeat the sky at 866 mas: of 790 mas one inside fits.

    Δχ² is some ten thousand, that of the places a few.
    """
    sheet = point_source(
        NIRISS_HOLES, [4.8e-6], 0.3e-6, vis2_error=0.005, closure_error_rad=np.radians(0.3)
    )

    def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        fringe = np.exp(-2j * np.pi * MAS * (548.8 * u + 568.3 * v))
        return (1.0 + 0.05 * fringe) / 1.05

    found = search_field(observed(sheet, binary, rng), SearchOptions())
    assert found.result.delta_chi2 > 3000.0
    assert found.result.companion.separation_mas < found.result.grid.outer_mas
    # By noise one inside fits nearly as well, too: then it is that the sky repeats itself.
    said = ("outside the field", "sky repeats itself")
    assert any(s in warning for warning in (*found.warnings, *found.result.warnings) for s in said)
