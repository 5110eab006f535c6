"""The choice of a field, by what the looks inside and outside gain: limits and their sides."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import NIRISS_HOLES, niriss, simulated
from scipy.special import j1

from amibayes.companion_search import field
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.result import Companion, Mode
from amibayes.companion_search.search import _refuse_huge
from amibayes.companion_search.seeds import _without
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.point_source import point_source
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box
from amibayes.units import MAS

LENGTHS = np.hypot(*(NIRISS_HOLES[:, None] - NIRISS_HOLES)[np.triu_indices(7, 1)].T)
FRINGE = 4.817e-6 / LENGTHS.max() / MAS
NEAREST = 0.5 * FRINGE
PATH = "amibayes.companion_search.field."


def pair(metres: float, wavelength_m: float, error: float = 0.01) -> Observables:
    """Three telescopes in a line, two of the baselines half as long as the third."""
    holes = np.array([[0.0, 0.0], [0.0, metres / 2.0], [0.0, metres]])
    return point_source(
        holes, wavelength_m, 1e-9, vis2_error=error, closure_error_rad=0.01, covariance="diagonal"
    )


def found_in(grid: Any, gain: float, **options: Any) -> Any:
    """A result of which the looks around need but few numbers."""
    known: dict[str, Any] = {"delta_chi2": 100.0, "single_theta": np.empty(0), "chi2_single": 150.0}
    bank_gain = np.array([0.2 * gain, gain, 0.0])
    likelihood = Likelihood(niriss())
    known |= {"companion": Companion(0.0, 90.0, 0.01), "aliases": ()}
    return SimpleNamespace(
        grid=grid, bank_gain=bank_gain, likelihood=likelihood, **(known | options)
    )


def mode(east: float, north: float, delta_chi2: float) -> Mode:
    return Mode((east, north, 0.01), delta_chi2, (Companion(east, north, 0.01),))


@pytest.fixture
def looked(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """What a look finds, whatever the data; and the grid that it was made on."""
    seen = SimpleNamespace(gain=0.0, place=np.array([30.0, -40.0]), grid=None)

    def bank(grid: Any, result: Any) -> Any:
        seen.grid = grid
        return grid

    monkeypatch.setattr(PATH + "_bank", bank)
    monkeypatch.setattr(PATH + "_best_of", lambda bank, result: (seen.place, seen.gain))
    return seen


def test_scales_of_the_data() -> None:
    likelihood = Likelihood(niriss(channels=4))
    band, shortest = 0.302e-6 / 4, 4.817e-6 - 0.375 * 0.302e-6
    longest = 4.817e-6 + 0.375 * 0.302e-6
    expected = (0.5 * shortest / LENGTHS.max() / MAS, longest / LENGTHS.min() / MAS)
    assert field.default_separation(likelihood) == pytest.approx(expected)
    assert field.resolution_mas(likelihood) == pytest.approx(2.0 * expected[0])
    reach = 2.0 * expected[0] * longest / band
    assert field.outermost(likelihood) == pytest.approx(reach)
    assert field.outermost(Likelihood(niriss(channels=4).only(["vis2"]))) == pytest.approx(reach)


def test_no_default_field_is_wider_than_the_response_is_known() -> None:
    """Beyond its lattice it is that of the edge: V² that err together look like light there."""
    data, nodes = niriss(channels=4), 43
    c, s = np.cos(0.3), np.sin(0.3)
    response = OffAxisResponse(
        np.ones((7, 7, nodes, nodes)), np.array([[c, s], [-s, c]]) / (50.0 * MAS), np.zeros(2)
    )
    setups = tuple(replace(setup, response=response) for setup in data.setups)
    found = field.outermost(Likelihood(replace(data, setups=setups)))
    assert found == pytest.approx(20.0 * 50.0)  # two nodes a side are for the slope at the edge
    assert found < field.outermost(Likelihood(data))


@pytest.mark.parametrize(("z", "resolved"), [(0.199, False), (0.201, True)])
def test_stars_are_resolved_where_vis2_falls_by_a_hundredth(z: float, resolved: bool) -> None:
    """1 − (πθB/λ)²/4 of 0.3 mas."""
    metres = z * 1.5e-6 / (np.pi * 0.3 * MAS)
    data = pair(metres, 1.5e-6)
    assert field.resolves_stars(Likelihood(data)) is resolved
    assert not field.resolves_stars(Likelihood(data.only(["cp"])))


@pytest.mark.parametrize("factor", [0.98, 1.02])
def test_a_disc_is_noticed_by_its_chi2(factor: float) -> None:
    """Of V² = (2 J₁(x)/x)² on three baselines, closure phases of a disc being 0."""
    diameter = 3.0
    x = np.pi * diameter * MAS * np.array([20.0, 20.0, 40.0]) / 1.5e-6
    size = np.sqrt(((1.0 - (2.0 * j1(x) / x) ** 2) ** 2).sum())
    likelihood = Likelihood(pair(40.0, 1.5e-6, float(size / factor)))
    assert field.notices_disc(likelihood, diameter) is (factor > 1.0)


@pytest.mark.parametrize("edges", [(0.0, 1.0), (1.0, 2.0), (1.0, np.inf)])
def test_no_field_without_lengths(
    edges: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    likelihood = SimpleNamespace(observables=niriss())
    monkeypatch.setattr(PATH + "default_separation", lambda _: edges)
    if edges[1] < np.inf:
        field.refuse_no_length(likelihood)
        return
    with pytest.raises(DataError, match="has baselines of zero or infinite length"):
        field.refuse_no_length(likelihood)


@pytest.mark.parametrize(
    ("best", "gain", "seen"),
    [
        (100.0, 70.1, True),  # 0.95 · 100 − 25
        (100.0, 69.9, False),
        (40.0, 30.1, True),  # what noise does not give, where 0.95 · 40 − 25 is less
        (40.0, 29.9, False),
        (40.0, 30.0, True),
    ],
)
def test_a_place_inside_counts_where_it_is_as_good(
    best: float, gain: float, seen: bool, looked: SimpleNamespace
) -> None:
    looked.gain = gain
    result = found_in(make_grid(200.0, 300.0, 12.0), best)
    assert field.look_inside(result) == (pytest.approx(50.0) if seen else None)
    grid = looked.grid
    assert (grid.inner_mas, grid.outer_mas, grid.step_mas) == pytest.approx((NEAREST, 200.0, 12.0))


def test_nothing_is_inside_a_field_that_begins_at_the_resolution(looked: SimpleNamespace) -> None:
    looked.gain = 1e4
    for inner in (0.99 * NEAREST, NEAREST, 1.001 * NEAREST):
        assert field.look_inside(found_in(make_grid(inner, 300.0, 12.0), 100.0)) is None
    assert looked.grid is None


def test_a_look_inside_has_a_bounded_number_of_places(looked: SimpleNamespace) -> None:
    """The area of the disc over the square of the step."""
    looked.gain = 1e4
    assert field.look_inside(found_in(make_grid(200.0, 201.0, 1.0), 100.0)) is not None
    assert np.pi * (200.0 / looked.grid.step_mas) ** 2 == pytest.approx(40_000)


@pytest.mark.parametrize(
    ("options", "gain", "fitted", "seen"),
    [
        ({"delta_chi2": 19.9}, 1e3, 1e3, False),
        ({"delta_chi2": 20.0}, 1e3, 1e3, True),
        ({"delta_chi2": 1e5}, 1e3, 1e3, True),
        ({"aliases": (None,)}, 1e3, 1e3, False),
        ({}, 70.9, 1e3, False),  # 0.8 · 100 − 9
        ({}, 71.1, 1e3, True),
        ({}, 1e3, 90.9, False),  # the fit of 100, less 9
        ({}, 1e3, 91.1, True),
    ],
)
def test_a_place_outside_counts_where_it_is_as_good(
    options: dict[str, Any],
    gain: float,
    fitted: float,
    seen: bool,
    looked: SimpleNamespace,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked.gain, given = gain, []

    def fit(*arguments: Any) -> Mode:
        given.append(arguments)
        return mode(300.0, 400.0, fitted)

    monkeypatch.setattr(PATH + "_fit_from", fit)
    result = found_in(make_grid(80.0, 300.0, 12.0), 100.0, modes=(mode(9, 9, 100.0),), **options)
    assert field.look_outside(result) == (pytest.approx(500.0) if seen else None)
    if given:
        place, _, _, _, box, alone = given[0]
        assert list(place) == [30.0, -40.0]
        assert (box.inner_mas, box.outer_mas) == (300.0, np.inf)
        assert box.fringe_mas == pytest.approx(FRINGE)
        assert alone == pytest.approx(150.0)


def test_an_alias_outside_is_left_out(
    looked: SimpleNamespace, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked.gain, found = 1e3, mode(300.0, 400.0, 100.5)
    monkeypatch.setattr(PATH + "_fit_from", lambda *_: found)
    asked: list[Any] = []

    def first(likelihood: Any, modes: list[Mode], single: Any, fringe: float) -> Any:
        asked.append([m.delta_chi2 for m in modes])
        return modes, aliases

    monkeypatch.setattr(PATH + "innermost_first", first)
    result = found_in(make_grid(80.0, 300.0, 12.0), 100.0, modes=(mode(9, 9, 100.0),))
    for aliases in ((), (found,)):
        assert (field.look_outside(result) is None) is bool(aliases)
    assert asked[0] == [100.5, 100.0]


def test_a_look_outside_reaches_as_far_as_channels_and_work_allow(looked: SimpleNamespace) -> None:
    step = FRINGE / field.COARSE_STEPS_PER_FRINGE
    field.look_outside(found_in(make_grid(80.0, 300.0, 12.0), 100.0))
    grid = looked.grid
    assert (grid.inner_mas, grid.step_mas) == pytest.approx((300.0, step))
    assert grid.outer_mas == pytest.approx(FRINGE * 4.817 / 0.302)
    # In narrow channels the annulus holds as many places as the work affords.
    result = found_in(make_grid(80.0, 900.0, 12.0), 100.0)
    result.likelihood = Likelihood(niriss(channels=40))
    field.look_outside(result)
    fringe = field.resolution_mas(result.likelihood)
    area = np.pi * (looked.grid.outer_mas**2 - 900.0**2) / (fringe / 4.0) ** 2
    points = len(result.likelihood.samples) + field.WORK_PER_POSITION
    assert area == pytest.approx(min(field.MAX_WORK / points, field.MAX_LOOKED_AT), rel=1e-6)
    assert len(looked.grid) == pytest.approx(area, rel=0.01)


def test_nothing_is_beyond_the_reach_of_the_channels(looked: SimpleNamespace) -> None:
    field.look_outside(found_in(make_grid(80.0, FRINGE * 4.817 / 0.302 + 1.0, 12.0), 100.0))
    assert looked.grid is None


@pytest.mark.parametrize(
    ("inside", "scatter"),
    [(50.0, 0.1), (400.0, 0.1), (50.0, 6.0), (900.0, 6.0)],
)
def test_what_is_notable_outside(
    inside: float, scatter: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By 25, by as much more as errors are too small in χ², and by a tenth of what is inside."""
    data = niriss(0.005, 0.3)
    noise = data.covariance.draw(np.random.default_rng(3), 1)[:, 0]
    data = data.with_data(data.data + scatter * noise)
    likelihood = Likelihood(data)
    chi2, n = float(likelihood.chi2([0.0, 0.0, 0.0])[0]), likelihood.n_independent
    # inside + 25·(chi2 − outside)/n = outside
    stretched = (inside + 25.0 * chi2 / n) / (1.0 + 25.0 / n)
    least = max(inside + 25.0, 1.1 * inside, stretched)
    within, beyond = make_grid(80.0, 100.0, 15.0), make_grid(400.0, 410.0, 15.0)
    for factor in (0.999, 1.001):
        gains = {within: np.linspace(0.0, inside, len(within)), beyond: np.zeros(len(beyond))}
        gains[beyond][3] = factor * least
        monkeypatch.setattr(PATH + "_gains", lambda _, grid, __, of=gains: of[grid])
        place, gain = field._notable(likelihood, within, beyond, np.empty(0))
        if factor < 1.0:
            assert (place, gain) == (None, 0.0)
        else:
            assert gain == pytest.approx(factor * least)
            assert list(place) == [beyond.east_mas[3], beyond.north_mas[3]]
    none = make_grid(400.0, 400.0001, 150.0)
    assert not len(none)
    monkeypatch.undo()
    assert field._notable(likelihood, within, none, np.empty(0)) == (None, 0.0)
    assert field._notable(likelihood, none, within, np.empty(0)) == (None, 0.0)


def test_the_field_that_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    model = BinaryModel(fastest_mas_yr=20.0, reference_mjd=60000.0)
    likelihood = Likelihood(niriss(channels=3), model)
    inner, outer = field.default_separation(likelihood)
    near, seen = [0.0], {}

    def notable(still: Any, within: Any, beyond: Any, single: Any) -> Any:
        seen.update(still=still, within=within, beyond=beyond)
        return place, 100.0

    def gains(still: Any, grid: Any, single: Any) -> Any:
        seen.update(near=grid)
        return np.append(np.zeros(len(grid) - 1), near[0])

    monkeypatch.setattr(PATH + "_notable", notable)
    monkeypatch.setattr(PATH + "_holds", lambda *_: holds)
    monkeypatch.setattr(PATH + "_gains", gains)
    place, holds = None, True
    assert field.choose_field(likelihood) == ((inner, outer), None)
    place, holds = np.array([300.0, -400.0]), False
    assert field.choose_field(likelihood) == ((inner, outer), None)
    holds, near[0] = True, 74.9
    assert field.choose_field(likelihood) == ((inner, pytest.approx(600.0)), pytest.approx(500.0))
    near[0] = 75.1
    (begin, end), where = field.choose_field(likelihood)
    assert (begin, end) == pytest.approx((0.3 * inner, outer))
    grid, step = seen["near"], 0.5 * inner
    assert where == pytest.approx(np.hypot(grid.east_mas[-1], grid.north_mas[-1]))
    assert (grid.inner_mas, grid.outer_mas) == pytest.approx((0.3 * inner, inner))
    assert grid.step_mas == pytest.approx(0.3 * step)
    assert seen["within"].step_mas == seen["beyond"].step_mas == pytest.approx(step)
    assert (seen["within"].inner_mas, seen["within"].outer_mas) == (inner, outer)
    farthest = field.outermost(likelihood)
    assert (seen["beyond"].inner_mas, seen["beyond"].outer_mas) == pytest.approx((outer, farthest))
    assert not seen["still"].model.moves


def test_few_data_have_the_default_field() -> None:
    """Three numbers of a companion cannot be told from three data."""
    data = simulated(pair(5.0, 4.8e-6).only(["vis2"]), [400.0, 0.0, 0.5], None)
    likelihood = Likelihood(data)
    assert likelihood.n_independent == len(likelihood.parameters)
    assert field.choose_field(likelihood) == (field.default_separation(likelihood), None)


@pytest.mark.parametrize(
    ("binary", "alone", "n_fields"),
    [(2.01, 10.1, 3), (1.99, 10.1, 0), (2.01, 9.9, 0), (1.99, 9.9, 0), (50.0, 60.0, 3)],
)
def test_wider_fields_where_nothing_fits(binary: float, alone: float, n_fields: int) -> None:
    """Of twice the data's number, and a fifth of what a star alone leaves."""
    n = Likelihood(niriss()).n_independent
    result = found_in(make_grid(80.0, 100.0, 12.0), 1.0)
    result.chi2_binary, result.chi2_single = binary * n, alone * n
    wider = field.wider_fields(result)
    assert wider == [
        (pytest.approx(a), pytest.approx(b))
        for a, b in [(24.0, 100.0), (80.0, 250.0), (80.0, 600.0)][:n_fields]
    ]
    # As far as the channels see, and each field once.
    farthest = FRINGE * 4.817 / 0.302
    result.grid = SimpleNamespace(inner_mas=80.0, outer_mas=0.45 * farthest, step_mas=12.0)
    expected = [(24.0, 0.45 * farthest), (80.0, farthest)]
    assert field.wider_fields(result) == [pytest.approx(e) for e in expected[: min(n_fields, 2)]]
    result.grid.outer_mas = farthest + 1.0
    assert len(field.wider_fields(result)) == min(n_fields, 1)


@pytest.mark.parametrize(
    ("separation", "delta_chi2", "n_fields"),
    [(82.9, 30.1, 1), (83.1, 30.1, 0), (82.9, 29.9, 0)],
)
def test_a_fit_on_the_inner_edge_asks_for_a_nearer_field(
    separation: float, delta_chi2: float, n_fields: int
) -> None:
    grid = make_grid(80.0, 100.0, 12.0)
    found = found_in(grid, 1.0, delta_chi2=delta_chi2, chi2_binary=1.0)
    found.companion = Companion(separation, 0.0, 0.01)
    assert field.on_inner_edge(found) is bool(n_fields)
    assert field.wider_fields(found) == [(pytest.approx(24.0), 100.0)][:n_fields]


def test_many_data_are_not_searched_again() -> None:
    result = found_in(make_grid(80.0, 100.0, 12.0), 1.0)
    result.chi2_binary = result.chi2_single = 1e9
    data = result.likelihood
    fields = []
    for n in (field.MAX_COARSE_DATA, field.MAX_COARSE_DATA + 1):
        noise = SimpleNamespace(n_independent=n, samples=data.samples, observables=data.observables)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(PATH + "_affordable", lambda likelihood, box: (likelihood, 1e5))
            result.likelihood = noise
            fields.append(field.wider_fields(result))
    assert [len(f) for f in fields] == [3, 0]


def test_a_look_is_affordable_by_averaged_channels() -> None:
    """Many channels are averaged to as many points as stay in cache; and the reach is less."""
    likelihood = Likelihood(niriss(channels=250))
    n = len(likelihood.samples)
    assert n > 2 * field.MAX_COARSE_DATA
    fringe = field.resolution_mas(likelihood)
    points = field.MAX_COARSE_DATA + field.WORK_PER_POSITION
    for outer in (1e6, 300.0):
        coarse, reach = field._affordable(likelihood, Box(50.0, outer, fringe))
        expected = 0.25 * fringe * np.sqrt(field.MAX_WORK / points / np.pi)
        assert reach == pytest.approx(min(outer, expected))
        assert len(coarse.samples) <= 2 * field.MAX_COARSE_DATA


def test_what_cannot_be_averaged_is_looked_at_less_far() -> None:
    """Data with errors of an own number of degrees of freedom are never averaged."""
    likelihood = Likelihood(replace(niriss(channels=250), freedom=Freedom(40.0, 39.0)))
    n = len(likelihood.samples)
    fringe = field.resolution_mas(likelihood)
    same, reach = field._affordable(likelihood, Box(50.0, 1e6, fringe))
    assert same is likelihood
    points = (n + field.WORK_PER_POSITION) * n / field.MAX_COARSE_DATA
    assert reach == pytest.approx(0.25 * fringe * np.sqrt(field.MAX_WORK / points / np.pi))


@pytest.mark.parametrize("wrong", range(3))
def test_fields_without_an_end_are_refused(wrong: int) -> None:
    ends = [50.0, 400.0, 5.0]
    _refuse_huge(*ends, "a")
    for value in (np.inf, np.nan):
        ends[wrong] = value
        with pytest.raises(DataError, match="baselines of zero or infinite length"):
            _refuse_huge(*ends, "a")
    with pytest.raises(UsageError, match="positions between 50 and 4e\\+05 mas"):
        _refuse_huge(50.0, 4e5, 5.0, "a")


def test_parameters_without_companions_have_no_light() -> None:
    likelihood = Likelihood(niriss(), BinaryModel(companions=2, diameter_mas="free"))
    pair = np.array([[90.0, 10.0, 0.1, -70.0, 60.0, 0.05, 20.0]])
    dark = _without(likelihood, pair)
    assert dark[0].tolist() == [90.0, 10.0, 0.0, -70.0, 60.0, 0.0, 20.0]
    star = Likelihood(niriss(), BinaryModel(companions=0, diameter_mas="free"))
    assert likelihood.chi2(dark)[0] == pytest.approx(star.chi2([[20.0]])[0], rel=1e-12)
    assert pair[0, 2] == 0.1
