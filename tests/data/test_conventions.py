"""What must not matter, and what must follow: the sky turned, rows and stations reordered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from hypothesis import given, settings
from hypothesis import strategies as st

from amibayes.companion_search.search import search
from amibayes.data.measurements import Measurements, exposure_labels
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel

SHEET = niriss()
DATA = simulated(SHEET, [120.0, -70.0, 0.02], np.random.default_rng(8))
FIELD = (60.0, 300.0)

angles = st.floats(0.0, 360.0)
offsets = st.floats(-300.0, 300.0)
contrasts = st.floats(1e-4, 1.0)


def with_coordinates(data: Observables, change) -> Observables:
    """The same numbers at other (u, v)."""

    def moved(m: Measurements) -> Measurements:
        u, v = change(m.u_m, m.v_m)
        return replace(m, u_m=u, v_m=v)

    return replace(data, vis2=moved(data.vis2), closure_phase=moved(data.closure_phase))


def turned(angle_deg: float):
    """Coordinates of a sky turned from north to east."""
    c, s = np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))
    return lambda u, v: (c * u + s * v, -s * u + c * v)


def chi2(data: Observables, theta: list[float], **model: object) -> float:
    return float(Likelihood(data, BinaryModel(**model)).chi2([theta])[0])  # type: ignore[arg-type]


@given(angle=angles, east=offsets, north=offsets, contrast=contrasts)
def test_turning_the_sky_turns_the_model(angle, east, north, contrast) -> None:
    e, n = turned(angle)(east, north)
    other = with_coordinates(DATA, turned(angle))
    assert chi2(other, [e, n, contrast]) == pytest.approx(chi2(DATA, [east, north, contrast]))


@given(east=offsets, north=offsets, contrast=contrasts)
def test_a_mirrored_sky_turns_the_signs_of_closure_phases(east, north, contrast) -> None:
    """(u, v) → −(u, v) is the conjugate: the companion on the other side, phases reversed."""
    mirrored = with_coordinates(DATA, lambda u, v: (-u, -v))
    phases = replace(DATA.closure_phase, value=-DATA.closure_phase.value)
    reversed_ = replace(DATA, closure_phase=phases)
    expected = chi2(DATA, [east, north, contrast])
    assert chi2(mirrored, [-east, -north, contrast]) == pytest.approx(expected)
    assert chi2(reversed_, [-east, -north, contrast]) == pytest.approx(expected)


@given(east=offsets, north=offsets, contrast=contrasts, scale=st.floats(0.1, 10.0))
def test_only_baseline_over_wavelength_counts(east, north, contrast, scale) -> None:
    def stretched(m: Measurements) -> Measurements:
        return replace(
            m,
            u_m=scale * m.u_m,
            v_m=scale * m.v_m,
            wavelength_m=scale * m.wavelength_m,
            band_m=scale * m.band_m,
        )

    other = replace(DATA, vis2=stretched(DATA.vis2), closure_phase=stretched(DATA.closure_phase))
    expected = chi2(DATA, [east, north, contrast])
    assert chi2(other, [east, north, contrast]) == pytest.approx(expected)
    longer = with_coordinates(DATA, lambda u, v: (scale * u, scale * v))
    near = chi2(longer, [east / scale, north / scale, contrast], smearing=False)
    assert near == pytest.approx(chi2(DATA, [east, north, contrast], smearing=False))


@given(seed=st.integers(0, 1000), east=offsets, north=offsets)
def test_the_order_of_rows_does_not_matter(seed, east, north) -> None:
    rng = np.random.default_rng(seed)
    n2, n3 = len(DATA.vis2), len(DATA.closure_phase)
    one, other = rng.permutation(n2), rng.permutation(n3)
    shuffled = replace(
        DATA,
        vis2=DATA.vis2.select(one),
        closure_phase=DATA.closure_phase.select(other),
        covariance=DATA.covariance.select(np.concatenate([one, n2 + other])),
    )
    expected = chi2(DATA, [east, north, 0.01])
    assert chi2(shuffled, [east, north, 0.01]) == pytest.approx(expected)


@given(pick=st.lists(st.booleans(), min_size=21, max_size=21), east=offsets, north=offsets)
def test_swapping_the_stations_of_a_baseline_changes_no_power(pick, east, north) -> None:
    sign = np.where(pick, -1.0, 1.0)[:, None]
    v = DATA.vis2
    swapped = replace(DATA, vis2=replace(v, u_m=sign * v.u_m, v_m=sign * v.v_m))
    expected = chi2(DATA, [east, north, 0.01])
    assert chi2(swapped, [east, north, 0.01]) == pytest.approx(expected)


@given(east=offsets, north=offsets, contrast=st.floats(1e-3, 1.0))
def test_which_star_is_the_primary_is_a_matter_of_names(east, north, contrast) -> None:
    """Without bandwidth smearing, c at ρ and 1/c at −ρ give the same V² and closure phases."""
    one = chi2(DATA, [east, north, contrast], smearing=False)
    other = chi2(DATA, [-east, -north, 1.0 / contrast], smearing=False)
    assert other == pytest.approx(one, rel=1e-6)


@settings(max_examples=6)
@given(angle=angles)
def test_the_search_turns_with_the_sky(angle) -> None:
    found = search(Likelihood(DATA), FIELD)
    other = search(Likelihood(with_coordinates(DATA, turned(angle))), FIELD)
    shift = other.companion.position_angle_deg - found.companion.position_angle_deg - angle
    # The minimiser ends within a small part of the error; the grid is turned, the data not.
    assert abs((shift + 180.0) % 360.0 - 180.0) < 0.02 * found.companion.position_angle_error_deg
    assert other.chi2_binary == pytest.approx(found.chi2_binary, abs=1e-3)
    assert other.companion.contrast == pytest.approx(found.companion.contrast, rel=1e-3)


def test_four_nights_halve_the_errors() -> None:
    one = search(Likelihood(DATA), FIELD).companion
    four = search(Likelihood(join([DATA] * 4)), FIELD).companion
    assert four.contrast_error == pytest.approx(one.contrast_error / 2.0, rel=1e-3)
    assert four.east_error_mas == pytest.approx(one.east_error_mas / 2.0, rel=1e-3)
    assert four.contrast == pytest.approx(one.contrast, rel=1e-3)


@given(names=st.permutations(range(7)))
def test_naming_the_holes_otherwise_gives_the_same_data(names) -> None:
    """Holes in another order: other triangles and signs, the same χ² of the same sky."""
    from helpers import NIRISS_HOLES

    def chi2_of(holes: np.ndarray) -> float:
        sheet = point_source(
            holes, 4.8e-6, 0.3e-6, vis2_error=0.01, closure_error_rad=0.01, covariance="assumed"
        )
        sky = simulated(sheet, [100.0, 40.0, 0.05], None)
        return chi2(sky, [80.0, 60.0, 0.03])

    expected = chi2_of(NIRISS_HOLES)
    assert chi2_of(NIRISS_HOLES[list(names)]) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("gap_s", "integrations_s", "exposures"),
    [
        (10.0, (1.0, 1.0), 1),
        (25.0, (1.0, 1.0), 2),
        (25.0, (40.0, 20.0), 1),
        (35.0, (40.0, 20.0), 2),
        (35.0, (40.0, np.nan), 2),
    ],
)
def test_rows_go_together_that_were_taken_together(
    gap_s: float, integrations_s: tuple[float, float], exposures: int
) -> None:
    """Nearer than 17 s, or begun before those before them had ended; times are mid-exposure."""
    closure = SHEET.closure_phase
    later = np.arange(len(closure)) >= 20
    rows = replace(
        closure,
        row=np.arange(len(closure)),
        mjd=60000.0 + later * gap_s / 86400.0,
        integration_s=np.where(later, integrations_s[1], integrations_s[0]),
    )
    found = exposure_labels(rows)
    np.testing.assert_array_equal(found, later * (exposures - 1))
