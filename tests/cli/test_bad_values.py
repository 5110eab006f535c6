"""What cannot be is refused where it enters, in one line that names the fault."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss
from oi_builders import HandMade

from amibayes.cube import Cube
from amibayes.data.covariance import (
    Block,
    BlockCovariance,
    diagonal_covariance,
    stack_covariances,
)
from amibayes.data.joining import different_targets
from amibayes.errors import AmibayesError, DataError, UsageError
from amibayes.extraction.options import ExtractOptions
from amibayes.instrument import Mask, load_instrument
from amibayes.oifits import read_oifits
from amibayes.optics.pupil import PupilMap
from amibayes.posterior.priors import Prior
from amibayes.scene.file import read_image
from amibayes.scene.sources import SkyImage
from amibayes.scene.spectrum import Blackbody, Tabulated, read_spectrum
from amibayes.simulation.detector import Detector
from amibayes.simulation.wavefront import WavefrontErrors
from amibayes.support.toml import read_toml

TRIANGLE = np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 2.0]])


@pytest.mark.parametrize(
    ("make", "fault"),
    [
        (lambda: Mask("m", TRIANGLE[:1], "disc", 0.5), "needs two holes or more"),
        (lambda: Mask("m", TRIANGLE[:, :1], "disc", 0.5), "needs two holes or more"),
        (lambda: Mask("m", TRIANGLE, "star", 0.5), "unknown shape 'star'"),
        (lambda: Mask("m", TRIANGLE, "hexagon", np.nan), "holes of size nan m"),
        (lambda: Mask("m", TRIANGLE, "hexagon", 2.1), "2.000 m apart: they overlap"),
        (lambda: Blackbody(0.0), "a blackbody of 0 K"),
        (lambda: Blackbody(np.inf), "a blackbody of inf K"),
        (lambda: Tabulated("s", np.ones(1), np.ones(1)), "two columns of two rows"),
        (lambda: Tabulated("s", np.array([2.0, 1.0]), np.ones(2)), "do not rise"),
        (lambda: Tabulated("s", np.array([1.0, 2.0]), np.zeros(2)), "nowhere positive"),
        (lambda: Tabulated("s", np.array([1.0, 2.0]), np.array([1.0, -1.0])), "negative"),
        (lambda: ExtractOptions(method="best"), "method 'best' is not known"),  # type: ignore[arg-type]
        (lambda: ExtractOptions(clip=0.0), "clip is 0; it must be above 0"),
        (lambda: ExtractOptions(outlier=np.nan), "outlier is nan"),
        (lambda: ExtractOptions(window_px=-1.0), "window is -1 pixels"),
        (lambda: ExtractOptions(window_px=float("inf")), "window is inf pixels"),
        (lambda: ExtractOptions(window_px=float("nan")), "window is nan pixels"),
        (lambda: Prior(50.0, 400.0, contrast_form="normal"), "form is 'normal'"),  # type: ignore[arg-type]
        (lambda: Prior(50.0, 400.0, position_form="disc"), "position_form is 'disc'"),  # type: ignore[arg-type]
        (lambda: SkyImage(np.ones((4, 4)), np.eye(2), flux=-1.0), "relative flux -1"),
        (lambda: SkyImage(np.ones(4), np.eye(2)), "two axes"),
        (lambda: SkyImage(-np.ones((4, 4)), np.eye(2)), "negative pixels"),
        (lambda: SkyImage(np.ones((4, 4)), np.zeros((2, 2))), "pixel scale above zero"),
        (lambda: Cube(np.ones((4, 4)), 3e-7, "NIRISS", "F430M"), "has 2 axes, not 3"),
        (lambda: PupilMap(np.full((4, 4), np.nan), 6.0), "not finite"),
        (lambda: WavefrontErrors(piston_m=-1e-9), "wavefront.piston_m is -1e-09"),
        (lambda: Detector(flat_error=0.5), "detector.flat_error is 0.5"),
        (lambda: replace(load_instrument("niriss", "F430M"), pixel_scale_rad=0.0), "a pixel of 0"),
    ],
)  # fmt: skip
def test_containers_refuse_what_cannot_be(make, fault: str) -> None:
    with pytest.raises(AmibayesError, match=fault):
        make()


def test_observables_refuse_what_does_not_fit() -> None:
    good = niriss()
    with pytest.raises(ValueError, match="has another length than value"):
        replace(good.vis2, wavelength_m=good.vis2.wavelength_m[:-1])
    with pytest.raises(DataError, match="a covariance of size 3 for 56 data"):
        replace(good, covariance=diagonal_covariance(np.ones(3)))
    spoilt = good.vis2.value.copy()
    spoilt[4] = np.nan
    with pytest.raises(DataError, match=r"not finite \(flag it\)"):
        replace(good, vis2=replace(good.vis2, value=spoilt))
    with pytest.raises(DataError, match="holds no usable cp"):
        good.only(("vis2",)).only(("cp",))
    assert "21 V², 35 closure phases, 36 independent data, assumed covariance" in repr(good)


def test_targets_of_two_names_are_told() -> None:
    one = niriss()
    named = [
        replace(one, setups=(replace(one.setups[0], target=name, source=f"{name}.fits"),))
        for name in ("HD 1", "HD 2")
    ]
    (said,) = different_targets(named)
    assert "HD 1" in said
    assert "HD 2" in said
    assert different_targets([named[0], named[0]]) == ()


@pytest.mark.parametrize(
    ("matrix", "fault"),
    [
        (np.array([[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (np.array([[np.nan, 0.0], [0.0, 1.0]]), "not (finite|positive definite)"),
    ],
)
def test_a_matrix_that_is_no_covariance(matrix, fault: str) -> None:
    with pytest.raises(DataError, match=fault):
        BlockCovariance(2, [Block(np.arange(2), matrix)])


def test_covariances_laid_end_to_end() -> None:
    diagonal = diagonal_covariance(np.array([1.0, 4.0]))
    full = BlockCovariance(2, [Block(np.arange(2), np.array([[2.0, 1.0], [1.0, 2.0]]))])
    both = stack_covariances([diagonal, full])
    expected = np.zeros((4, 4))
    expected[:2, :2], expected[2:, 2:] = np.diag([1.0, 4.0]), full.dense()
    np.testing.assert_array_equal(both.dense(), expected)
    np.testing.assert_array_equal(both.sparse.toarray(), expected)
    plain = stack_covariances([diagonal, diagonal])
    assert plain.independent
    np.testing.assert_array_equal(plain.variance, [1.0, 4.0, 1.0, 4.0])
    assert [b.index.tolist() for b in plain.blocks] == [[0], [1], [2], [3]]
    assert diagonal_covariance(np.empty(0)).sparse.shape == (0, 0)


@pytest.mark.parametrize(
    ("text", "ask", "fault"),
    [
        ("x = 1.5", lambda top: top.number("x", at_most=1.0), "'x' is 1.5; it must be at most 1"),
        ("x = true", lambda top: top.number("x"), "is True, not a number"),
        ("x = inf", lambda top: top.number("x"), "not a finite number"),
        ("x = 9", lambda top: top.whole("x", at_most=8), "is 9; it must be at most 8"),
        ("x = 1.0", lambda top: top.whole("x"), "not a whole number"),
        ("x = 1", lambda top: top.flag("x"), "is 1, neither true nor false"),
        ("x = 1", lambda top: top.text("x"), "is 1, not a text"),
        ("x = 'b'", lambda top: top.text("x", choices=("a",)), "choose from a"),
        ("x = [[1, 2]]", lambda top: top.numbers("x"), "is not a list of numbers"),
        ("x = [1, 2]", lambda top: top.numbers("x", columns=2), "not a list of rows of 2"),
        ("x = ['a']", lambda top: top.numbers("x"), "is not a list of numbers"),
        ("x = [nan]", lambda top: top.numbers("x"), "holds a number that is not finite"),
        ("x = 1", lambda top: top.section("x"), "is not a table"),
        ("x = 1", lambda top: top.sections("x"), r"write \[\[x\]\]"),
        ("", lambda top: top.text("x"), "'x' is missing"),
    ],
)
def test_settings_of_the_wrong_kind(text: str, ask, fault: str, tmp_path: Path) -> None:
    path = tmp_path / "settings.toml"
    path.write_text(text)
    with pytest.raises(DataError, match=fault) as caught:
        ask(read_toml(path))
    assert str(path) in str(caught.value)


def test_instruments_of_ones_own_are_checked(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("name = 'mine'\nfilters = {}\n")
    with pytest.raises(DataError, match="holds no filter"):
        load_instrument(path)
    with pytest.raises(UsageError, match=r"choose from .*niriss"):
        load_instrument("nirspeck")


def test_files_that_are_no_spectrum_and_no_image(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"gone\.txt: cannot be read|gone\.txt"):
        read_spectrum(tmp_path / "gone.txt")
    (tmp_path / "words.txt").write_text("one two\n")
    with pytest.raises(DataError, match="is not a table of numbers"):
        read_spectrum(tmp_path / "words.txt")
    HandMade(np.random.default_rng(1)).write(tmp_path / "tables.fits")
    with pytest.raises(DataError, match="holds no image"):
        read_image(tmp_path / "tables.fits")


def test_a_prior_says_what_it_is() -> None:
    assert Prior(50.0, 400.0).description == "uniform in area, log-uniform in contrast"
    several = Prior(50.0, 400.0, n_contrasts=3, position_form="separation", fastest_mas_yr=2.0)
    assert several.description == (
        "uniform in separation and angle, log-uniform in contrast (3 bands, independently), "
        "uniform in rate"
    )


def undated(made: HandMade) -> None:
    made.put("OI_VIS2", "MJD", np.full(6, np.nan))
    del made.keywords["OI_VIS2"]["DATE_OBS"]


@pytest.mark.parametrize(
    ("change", "outcome"),
    [
        (lambda m: m.put("OI_VIS2", "MJD", np.full(6, np.nan)), "MJD missing; taken from DATE-OBS"),
        (lambda m: undated(m), "OI_VIS2 (extension 4): no date"),
        (lambda m: m.put("OI_VIS2", "UCOORD", np.ones((6, 2)), form="2D"), "not one number a row"),
        (lambda m: m.put("OI_VIS2", "UCOORD", np.ones(6), unit="furlong"), "unit 'furlong'"),
        (lambda m: m.put("OI_WAVELENGTH", "EFF_WAVE", ["a", "b", "c"], form="4A"), "no numbers"),
    ],
)  # fmt: skip
def test_odd_columns_are_noted_or_refused(change, outcome: str, tmp_path: Path) -> None:
    made = HandMade(np.random.default_rng(3))
    change(made)
    made.write(tmp_path / "odd.fits")
    try:
        said = " ".join(read_oifits(tmp_path / "odd.fits").notes)
    except DataError as error:
        said = str(error)
    assert outcome in said
