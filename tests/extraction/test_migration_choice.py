"""What charge migration is taken out of which cube, what is said of it, and what its errors do."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from amibayes.cube import Cube
from amibayes.cube.source import InMemoryCube
from amibayes.extraction.charge import (
    BIAS_UNKNOWN,
    LINEARITY_UNKNOWN,
    TOO_FEW_GROUPS,
    CubeMigration,
    _chosen,
    _decided,
    _Known,
    _stated,
    observable_changes,
    shared_errors,
    stated,
    visit_migration,
)
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import make_operator
from amibayes.instrument import ChargeMigration, load_instrument
from amibayes.optics import psf
from amibayes.ramps.converter import WAVES, WaveColumns
from amibayes.ramps.correction import MigrationFree
from amibayes.ramps.curvature import Curvature
from amibayes.ramps.fit import MigrationFit
from amibayes.ramps.header import P_VALUES, SOURCE
from amibayes.ramps.migration import Migration
from amibayes.ramps.own_response import OwnResponse
from amibayes.ramps.transfer import SIDES, gain
from amibayes.units import FloatArray

FIT = ExtractOptions()
HEADER = {"NGROUPS": 6, "TGROUP": 0.1, "TFRAME": 0.1}
BLANK = Cube(np.empty((0, 5, 5)), 3e-7, "NIRISS", "F480M", header=HEADER, unit="DN/s")
INSTRUMENT = ChargeMigration(3.6e-7, 1.2e-7)
BOTH = Migration(
    (*SIDES, *WAVES),
    np.concatenate([[4e-7, 2e-7, 3e-6, -5e-6], np.full(len(WAVES) - 2, 1e-6)]),
    np.diag(np.concatenate([[3e-8, 4e-8, 2e-6, 1e-6], np.full(len(WAVES) - 2, 4e-7)])) ** 2,
    "fit",
)


def fitted(migration: Migration = BOTH, **more: Any) -> MigrationFit:
    known: dict[str, Any] = {
        "chi2": 90.0, "dof": 100, "chi2_without": 200.0, "p_value": 0.4, "bend_chi2": 30.0,
        "bend_p_value": 0.3, "error_scale": 1.0, "exposures": (),
    }  # fmt: skip
    return MigrationFit(migration, **(known | more))


def curvature(waves: WaveColumns | None = None) -> Curvature:
    one, none = np.ones((5, 5)), np.empty((0, 5, 5))
    return Curvature("a", 4, 5, 0.3, one, one, one, none, none, none, np.zeros(0), 0.0, 0, waves)


N = len(WAVES)
WAVED = WaveColumns(
    *(np.zeros((N, *more, 5, 5)) for more in ((), (), (2,))), np.eye(N), np.zeros(N)
)


def known(**more: Any) -> _Known:
    made = {"template": BLANK, "is_ramp": False, "curvature": None, "stated": INSTRUMENT}
    return _Known(**(made | more))


def own(spread: float = 2.5e-7, p: float = 1e-5, shape: tuple[int, int] = (5, 5)) -> OwnResponse:
    rng = np.random.default_rng(1)
    value, error = rng.normal(size=(2, *shape)) * 1e-7
    return OwnResponse(spread, 1e-8, p, value, np.abs(error), np.array([[2, 3], [1, 4]]))


def test_ramps_decide_where_they_know_more_than_the_instruments_file() -> None:
    """The error of their mean, 2.5e-8, is below the file's, or not."""
    fit = fitted()
    assert fit.migration.mean[1] == pytest.approx(2.5e-8)
    for error, source in ((2.6e-8, "fit"), (2.4e-8, "instrument")):
        found, notes = _chosen(known(stated=ChargeMigration(3.6e-7, error)), fit, FIT)
        assert found is not None
        assert found.source == source
        assert notes == ()
        # Only ramps know the converter; it stays beside the file's value.
        assert found.kinds == BOTH.kinds
    assert found.value[0] == found.value[1] == 3.6e-7
    np.testing.assert_array_equal(found.value[2:], BOTH.value[2:])
    alone, _ = _chosen(known(stated=None), fit, FIT)
    assert alone is fit.migration
    assert _chosen(known(stated=None), None, FIT) == (None, ())
    plain, _ = _chosen(known(), fitted(BOTH.of_pixels), FIT)
    assert plain is not None
    assert plain.kinds == SIDES
    given, _ = _chosen(known(), fit, replace(FIT, charge_migration=5e-7))
    assert given is not None
    assert (given.source, given.mean) == ("given", (pytest.approx(5e-7), 0.0))


def test_what_does_not_explain_the_ramps_is_said_with_the_smaller_probability() -> None:
    for p, bend, said in ((2e-4, 0.5, "2e-04"), (0.5, 3e-5, "3e-05")):
        _, notes = _chosen(known(), fitted(p_value=p, bend_p_value=bend), FIT)
        assert len(notes) == 1
        assert f"does not explain all that changes along the ramps (p = {float(said):.2g})" \
            in notes[0]  # fmt: skip
    few = _chosen(known(is_ramp=True), fitted(), FIT)[1]
    assert few == (TOO_FEW_GROUPS,)
    assert _chosen(known(is_ramp=True, curvature=curvature()), fitted(), FIT)[1] == ()


def test_errors_of_the_converter_are_taken_out_where_the_bias_is_known() -> None:
    named = replace(BLANK, header=HEADER | {"R_SUPERB": "crds://a.fits"})
    ramp = known(template=named, is_ramp=True, curvature=curvature())
    found = _decided(ramp, fitted(), FIT)
    assert found.notes[0] == BIAS_UNKNOWN
    assert "converter too" not in found.notes[-1]
    assert _decided(replace(ramp, template=BLANK), fitted(), FIT).notes[0] != BIAS_UNKNOWN
    waved = replace(ramp, curvature=curvature(WAVED))
    found = _decided(waved, fitted(), FIT)
    assert found.waves is WAVED
    assert len(found.notes) == 1
    assert "sine 3.0 ± 2.0, cosine -5.0 ± 1.0, fitted to ramps" in found.notes[0]
    lacks = _decided(replace(waved, lacks_linearity=True), fitted(), FIT)
    assert lacks.notes[0] == LINEARITY_UNKNOWN
    assert _decided(replace(ramp, lacks_linearity=True), fitted(), FIT).notes[0] == BIAS_UNKNOWN


def test_single_pixels_are_told_of_ramps_that_know_them() -> None:
    ramp, text = known(is_ramp=True, curvature=curvature()), "single pixels differ"
    for pixels, told in ((own(), True), (own(p=0.5), False), (None, False)):
        assert any(text in n for n in _decided(ramp, fitted(own=pixels), FIT).notes) == told
    assert not any(text in n for n in _decided(known(), fitted(own=own()), FIT).notes)
    (said,) = _decided(ramp, fitted(own=own()), FIT).notes
    assert "by 2.50 e-7 per electron (rms)" in said


@pytest.mark.parametrize(
    ("header", "unit", "missing"),
    [
        ({}, "DN/s", "NGROUPS and TGROUP"),
        (HEADER, "furlong", "a unit of electrons or DN per second"),
        ({}, "furlong", "NGROUPS and TGROUP, and a unit of electrons or DN per second"),
    ],
)
def test_slopes_that_cannot_be_corrected_say_what_they_lack(
    header: dict[str, Any], unit: str, missing: str
) -> None:
    template = replace(BLANK, header=header, unit=unit)
    found = _decided(known(template=template), None, FIT)
    assert found.migration is None
    assert found.notes == (f"charge migration not taken out: the header lacks {missing}",)
    assert _decided(known(template=template, is_ramp=True), None, FIT).migration is not None


def test_instruments_and_simulations_state_what_they_know() -> None:
    file = load_instrument("NIRISS", "F480M").charge_migration
    assert file is not None
    assert _stated(BLANK) == file
    moved = {"BNDSHFTX": 0.0, "BNDSHFTY": 1e-7}
    assert _stated(replace(BLANK, header=moved)) == file
    assert _stated(replace(BLANK, header=dict.fromkeys(moved, 0.0))) is None
    assert _stated(replace(BLANK, filter="none")) is None
    off = visit_migration([BLANK, BLANK], ExtractOptions(charge_migration="off"), {})
    assert [o.migration for o in off] == [None, None]


def test_a_line_says_what_is_taken_out() -> None:
    line = stated(Migration.isotropic(3.61e-7, 1.24e-7, "instrument"))
    assert line == ("charge migration taken out: 3.61 ± 1.24 e-7 pixels per electron, "
                    "of the instrument's file")  # fmt: skip
    assert stated(Migration.isotropic(-3e-7, 0.0, "given")).endswith("electron, given")
    assert "3.00 ± 0.25 e-7 pixels per electron, fitted to ramps; errors" in stated(BOTH)


def test_headers_and_json_keep_what_was_done() -> None:
    done = CubeMigration(BOTH, fitted(p_value=0.2, bend_p_value=0.7))
    cards = {k.removeprefix("HIERARCH "): v for k, v in done.in_header.items()}
    assert [cards[key] for key in P_VALUES] == [0.2, 0.7]
    back = CubeMigration.of_header(cards)
    assert back is not None
    assert back.p_values == (0.2, 0.7)
    for p, bend, explained in ((0.2, 0.7, True), (1e-3, 0.7, False), (0.7, 9e-4, False)):
        told = replace(back, p_values=(p, bend)).as_json()
        assert (told["p_value"], told["p_value_bend"], told["explained"]) == (p, bend, explained)
    assert CubeMigration.of_header(cards | {P_VALUES[1]: "?"}).p_values is None
    assert CubeMigration.of_header(cards | {P_VALUES[0]: "?"}).p_values is None
    assert CubeMigration.of_header({}) is None
    off = CubeMigration.of_header({SOURCE: "off"})
    assert off is not None
    assert off.as_json() == {"value_per_e": 0.0, "error_per_e": 0.0, "source": "off"}
    assert list(off.in_header.values()) == ["off"]
    # A fit that was not used says nothing of what was taken out.
    other = CubeMigration(Migration.isotropic(3e-7, 1e-8, "instrument"), fitted(), p_values=None)
    assert not any(key in str(other.in_header) for key in P_VALUES)
    assert "p_value" not in other.as_json()
    assert done.as_json()["p_value"] == 0.2


def images(n: int = 40) -> tuple[Cube, FloatArray]:
    """Bright images in DN per second, and their mean in electrons per second."""
    instrument = load_instrument("niriss", "F480M")
    light = psf(instrument, instrument.bandpass.channels(n=2), n, centre_px=(0.2, -0.3))
    rng, mean = np.random.default_rng(4), 4e6 * light + 50.0
    noisy = mean + np.sqrt(mean) * rng.standard_normal((6, n, n))
    cube = Cube(
        noisy / 1.61, instrument.pixel_scale_rad, "NIRISS", "F480M",
        error=np.sqrt(np.broadcast_to(mean, noisy.shape)) / 1.61, header=HEADER, unit="DN/s",
    )  # fmt: skip
    return cube, mean


@pytest.mark.parametrize("method", ["fringes", "gauss"])
def test_changes_of_observables_are_those_of_changed_images(method: str) -> None:
    """V² and closure phases where charge, waves and single pixels do a little more or less."""
    cube, _ = images()
    rng = np.random.default_rng(5)
    pixels = own(shape=(40, 40))
    pixels = replace(pixels, error=np.full((40, 40), 3e-7), carried=np.array([[19, 20], [22, 17]]))
    waves = rng.normal(size=(len(WAVES), 40, 40)) * 4e6
    file = MigrationFree(InMemoryCube(cube), BOTH, 1.61, 0.35, waves, pixels)
    operator = make_operator(file, ExtractOptions(method=method), None)
    image = operator.reference.image
    current, sampling = image * 1.61, operator.sampling
    flux, samples = sampling.apply(image[operator.view.part].reshape(1, -1))
    moved = [gain(kind, 0.35 * current, current) for kind in SIDES] + list(waves)
    changes = [sum(c * m for c, m in zip(d, moved, strict=True)) for d in BOTH.directions.T]
    for row, column in pixels.carried:
        alone = np.zeros_like(current)
        alone[row, column] = 3e-7 * 0.35 * current[row, column] ** 2
        changes.append(alone)
    found = observable_changes(file, operator, samples[0], float(flux[0]))
    assert found.shape == (21 + 35, 2 + len(WAVES) + 2)
    step = 1e-2
    for own_change, column in zip(changes, found.T, strict=True):
        sides = []
        for sign in (1.0, -1.0):
            other = image - sign * step * own_change / 1.61
            f, s = sampling.apply(other[operator.view.part].reshape(1, -1))
            sides.append((sampling.power(s)[0] / f[0] ** 2, sampling.bispectrum(s)[0]))
        (high, high3), (low, low3) = sides
        exact = np.concatenate([high - low, np.angle(high3 * low3.conj())]) / (2.0 * step)
        np.testing.assert_allclose(column, exact, atol=2e-3 * np.abs(exact).max())


def test_errors_of_one_name_add_up_over_files() -> None:
    rng = np.random.default_rng(6)
    one, other = rng.normal(size=(2, 5, 2))
    same = Migration.isotropic(3e-7, 1e-8, "given")
    found = shared_errors([(same, one), (same, other[:, :1]), (BOTH, other)])
    assert found is not None
    assert found.names == (*same.error_names(2), *BOTH.error_names(2))
    np.testing.assert_allclose(found.changes[:, 0], one[:, 0] + other[:, 0])
    np.testing.assert_allclose(found.changes[:, 1:], np.column_stack([one[:, 1], other]))
    assert shared_errors([]) is None


def test_slopes_of_a_unit_are_corrected_in_electrons() -> None:
    cube, mean = images()
    charge = CubeMigration(Migration.isotropic(5e-7, 0.0, "given"))
    free = charge.applied(InMemoryCube(cube))
    assert isinstance(free, MigrationFree)
    assert (free.electrons, free.own, free.waves) == (1.61, None, None)
    assert free.time_s == pytest.approx(0.35)
    file = InMemoryCube(cube)
    assert CubeMigration().applied(file) is file
    lost = (cube.images.mean(axis=0) - free.read().images.mean(axis=0)) * 1.61
    exact = 5e-7 * sum(gain(kind, 0.35 * mean, mean) for kind in SIDES)
    assert np.corrcoef(lost.ravel(), exact.ravel())[0, 1] > 0.99
