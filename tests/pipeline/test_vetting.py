"""Vetting finds the bad calibrator, keeps the good ones, and says why."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from epochs import F430M, epoch, noisy
from helpers import niriss, simulated
from interferometer import darkened_disc, four_telescopes, observed
from scipy import stats

from amibayes.calibration import without_disc
from amibayes.cli import main
from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.likelihood.extra_noise import ExtraNoise, add_noise
from amibayes.models.binary import BinaryModel
from amibayes.oifits import read_oifits, write_oifits
from amibayes.pipeline.prepare import Prepared, _two_that_disagree
from amibayes.pipeline.vetting import Vetted, Vetting, _compare, _decided, _LeaveOut, notes, vet
from amibayes.report import words
from amibayes.report.vetting import vetting_picture, vetting_table
from amibayes.support.terminal import tail
from amibayes.units import MAS

FIELD = (50.0, 400.0)


@pytest.fixture
def rng() -> np.random.Generator:
    """Good calibrators are dropped 0.9 % of the time: this seed has none of those."""
    return np.random.default_rng(7)


def calibrator(rng, theta=(0.0, 0.0, 0.0), name="cal", scatter=0.0, model=None):
    sheet = niriss()
    noisy = add_noise(sheet, ExtraNoise(0.005 * scatter, np.radians(0.3 * scatter)))
    data = simulated(noisy, list(theta), rng, model)
    setups = tuple(replace(s, source=name) for s in sheet.setups)
    return replace(data, covariance=sheet.covariance, setups=setups)


def test_companion_of_one_among_four_is_found_and_only_that_one_is_dropped(rng) -> None:
    data = [calibrator(rng, name=f"good{k}") for k in range(3)]
    data.insert(2, calibrator(rng, (120.0, 60.0, 0.01), "bad"))
    vetting = vet(data, separation_mas=FIELD, limits=False, null_draws=2000)
    assert [v.kept for v in vetting.calibrators] == [True, True, False, True]
    bad = vetting.calibrators[2]
    assert "disagrees" in bad.reason
    assert "companion of 5.0 mag" in bad.reason
    assert bad.agreement is not None
    assert bad.agreement < 1e-6
    assert bad.companion is not None
    assert bad.companion.companion.separation_mas == pytest.approx(134.0, abs=15.0)


def test_a_diameter_that_is_off_by_its_error_is_no_reason_to_drop(rng) -> None:
    """Of 60 mas, and told to be 45 ± 15: what is left of its disc is what that error allows."""
    data = [calibrator(rng, name=f"good{k}") for k in range(3)]
    data.append(calibrator(rng, name="big", model=BinaryModel(diameter_mas=60.0)))
    kept = {}
    for error in (0.0, 15.0):
        points = [*data[:3], without_disc(data[3], 45.0, error)]
        vetting = vet(points, separation_mas=FIELD, limits=False, null_draws=1000)
        kept[error] = [v.kept for v in vetting.calibrators]
    assert kept == {0.0: [True, True, True, False], 15.0: [True] * 4}


@pytest.mark.slow
def test_resolved_calibrator_is_named(rng) -> None:
    data = [calibrator(rng, name=f"good{k}") for k in range(3)]
    model = BinaryModel(diameter_mas=30.0)
    data.append(calibrator(rng, name="big", model=model))
    vetting = vet(data, separation_mas=FIELD, limits=False, null_draws=2000)
    assert [v.kept for v in vetting.calibrators] == [True, True, True, False]
    big = vetting.calibrators[3]
    assert big.diameter_mas == pytest.approx(30.0, abs=5.0)
    assert big.diameter_probability is not None
    assert big.diameter_probability < 1e-4


@pytest.mark.slow
def test_leave_one_out_probability_of_good_calibrators() -> None:
    """Between-calibrator scatter of twice the errors: p < 0.05 in at most 5 % of 120 cases.

    Binomial: more than 17 of 120 has a probability below 1e-4.
    """
    rng = np.random.default_rng(3)
    p = []
    for _ in range(40):
        data = [calibrator(rng, name=f"c{k}", scatter=2.0) for k in range(3)]
        leave_out = _LeaveOut(data)
        p += [leave_out.agreement(k, [j for j in range(3) if j != k]) for k in range(3)]
    low = int((np.array(p) < 0.05).sum())
    # The three probabilities of a set share data; their counts spread by up to √3 more.
    assert low <= stats.binom.isf(1e-4, 40, 0.05) * 3


def test_calibrated_files_are_judged_each_by_itself(rng) -> None:
    data = [calibrator(rng, name="point"), calibrator(rng, (100.0, 80.0, 0.02), "double")]
    vetting = vet(data, calibrated=True, separation_mas=FIELD, null_draws=2000)
    point, double = vetting.calibrators
    assert point.kept
    assert not double.kept
    assert point.agreement is None
    assert point.limit is not None
    assert np.nanmax(point.limit.delta_mag) > 5.0
    header, first, *rest = vetting_table(vetting)
    assert first.split()[:3] == ["point", "keep", "-"]
    assert float(first.split()[3]) == pytest.approx(point.significance.probability, rel=0.05)
    assert any(line.startswith("double") and "DROP" in line for line in rest)
    assert any(double.reason in line for line in rest)
    assert header.split()[0] == "calibrator"
    assert len(vetting_picture(vetting).axes) == 2
    assert len(vetting_picture(replace(vetting, calibrators=one_without_limit(vetting))).axes) == 1


@pytest.mark.usefixtures("full_pictures")
def test_legends_of_the_picture_cover_nothing_and_stay_on_the_page(rng) -> None:
    vetting = vet([calibrator(rng)], calibrated=True, separation_mas=FIELD, null_draws=1500)
    (one,) = vetting.calibrators
    names = [f"some/long_name_of_calibrator_{k}.fits" for k in range(3)]
    alike = tuple(replace(one, path=name, agreement=0.1) for name in names)
    vetting = replace(vetting, calibrators=alike)
    figure = vetting_picture(vetting)
    figure.draw_without_rendering()
    assert len(figure.legends) == 2
    for legend in figure.legends:
        box = legend.get_window_extent()
        assert figure.bbox.x0 <= box.x0 < box.x1 <= figure.bbox.x1
        assert figure.bbox.y0 <= box.y0 < box.y1 <= figure.bbox.y1
        assert not any(box.overlaps(axes.get_tightbbox()) for axes in figure.axes)


def one_without_limit(vetting: Vetting) -> tuple[Vetted, ...]:
    return tuple(replace(vetted, limit=None) for vetted in vetting.calibrators)


def test_two_that_disagree_are_both_kept_and_doubted(rng, tmp_path: Path, capsys) -> None:
    paths = [tmp_path / "a.oifits", tmp_path / "b.oifits"]
    write_oifits(paths[0], calibrator(rng))
    write_oifits(paths[1], calibrator(rng, (0.0, 0.0, 0.0), scatter=20.0))
    words = ["vet", *map(str, paths), "--out", str(tmp_path / "out"), "--no-limits", "--json"]
    assert main([*words, "--separation", "50:400", "--charge-levels", "1000,1000,5000"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [Path(c["path"]).name for c in result["calibrators"]] == ["a.oifits", "b.oifits"]
    said = [text for c in result["calibrators"] for text in [c["reason"], *c["notes"]]]
    assert any("charge level is 5 times" in text for text in said)
    assert any("disagrees" in text or "companion" in text for text in said)
    assert (tmp_path / "out" / "vetting.png").stat().st_size > 1000


def test_a_search_with_two_that_disagree_says_so(rng) -> None:
    good, other, bad = (calibrator(rng, name=name) for name in ("good", "other", "bad"))
    bad = simulated(bad, [120.0, 60.0, 0.05], rng)
    sizes = ((0.0, 0.0),) * 2

    def said(*serving: Observables, vetting: Vetting | None = None) -> list[str]:
        return _two_that_disagree(
            Prepared(good, serving=serving, diameters_mas=sizes, vetting=vetting)
        )

    assert said(good, other) == []
    (words,) = said(good, bad)
    assert words.startswith("the calibrators good and bad disagree (p < 1e-300): ")
    assert said(good, bad, vetting=Vetting((), 0.003)) == []


def test_one_that_disagrees_with_a_dropped_one_is_not_doubted() -> None:
    kept, binary = Vetted("a.oifits", True, "", 0.0), Vetted("b.oifits", False, "companion", 0.0)
    assert notes(kept, Vetting((kept, binary), 0.003)) == [
        "disagrees with the calibrator that is dropped"
    ]
    other = replace(kept, path="b.oifits")
    assert "either may be wrong" in notes(kept, Vetting((kept, other), 0.003))[0]


def test_probabilities_too_small_for_a_number_are_said_to_be_less() -> None:
    one = Vetted("a.oifits", True, "", 0.0, diameter_mas=1.0, diameter_probability=0.0)
    dropped = _decided(one, True, 1e-3)
    assert dropped.reason == (
        "disagrees with the other calibrators (p < 1e-300); resolved: 1.00 mas (p < 1e-300)"
    )
    shown = vetting_table(Vetting((dropped, replace(one, path="b.oifits", agreement=0.02)), 1e-3))
    assert "< 1e-300" in shown[1]
    assert "0.02" in " ".join(shown[2:])
    assert (tail(0.0), tail(0.02), tail(1e-290)) == ("< 1e-300", "0.02", "1e-290")
    assert words.tail(0.0) == "<\u00a01\u00a0×\u00a010⁻³⁰⁰"
    assert words.tail(None) == words.NONE


@pytest.mark.slow
def test_calibrators_of_two_filters_are_judged_among_their_own(rng) -> None:
    """As each filter by itself: no calibrator of the other one is asked."""
    reds = [calibrator(rng, name=f"red{k}") for k in range(3)]
    blues = [noisy(epoch(F430M, source=f"blue{k}"), [0.0, 0.0, 0.0], rng) for k in range(2)]
    blues.append(noisy(epoch(F430M, source="bad"), [120.0, 60.0, 0.02], rng))
    options = {"separation_mas": (90.0, 180.0), "limits": False, "null_draws": 500}
    vetting = vet([reds[0], *blues, *reds[1:]], **options)
    assert [v.path for v in vetting.calibrators if not v.kept] == ["bad"]
    judged = {v.path: v.agreement for v in vetting.calibrators}
    apart: list[float | None] = [None] * 3
    assert _compare(_LeaveOut(reds), [0, 1, 2], apart, vetting.alpha) == set()
    assert [judged[f"red{k}"] for k in range(3)] == pytest.approx(apart, rel=1e-9)
    for unjudged in (vet([reds[0], blues[0], blues[2]], fewest=3), vet([reds[0], blues[2]])):
        assert all(v.kept and v.agreement is None for v in unjudged.calibrators)
        assert all(v.significance is None for v in unjudged.calibrators)


def test_one_raw_calibrator_is_kept_unjudged_and_none_is_refused(rng) -> None:
    (alone,) = vet([calibrator(rng)]).calibrators
    assert alone.kept
    assert alone.agreement is None
    assert alone.significance is None
    with pytest.raises(DataError, match="no calibrator"):
        vet([])


@pytest.mark.slow
def test_search_drops_the_bad_calibrator_unless_told_not_to(rng, tmp_path: Path, capsys) -> None:
    target = tmp_path / "target.oifits"
    write_oifits(target, calibrator(rng, (0.0, 0.0, 0.0)))
    paths = [tmp_path / f"cal{k}.oifits" for k in range(4)]
    for k, path in enumerate(paths):
        write_oifits(path, calibrator(rng, (120.0, 60.0, 0.02) if k == 1 else (0.0, 0.0, 0.0)))
    words = ["search", str(target), "--cal", *map(str, paths), "--separation", "50:400", "--json"]
    words += ["--null-draws", "0", "--no-posterior"]
    kept = []
    for k, more in enumerate([[], ["--keep-all"]]):
        assert main([*words, *more, "--out", str(tmp_path / str(k))]) == 0
        result = json.loads(capsys.readouterr().out)
        kept.append([c["kept"] for c in result["calibration"]["calibrators"]])
        dropped = [w for w in result["warnings"] if "dropped" in w]
        assert len(dropped) == (k == 0)
    assert kept == [[True, False, True, True], [True] * 4]


def of_a_drifting_night(
    name: str, hours: float, rng: np.random.Generator, contrast: float = 0.0, disc_mas: float = 0.3
) -> Observables:
    """A star of 0.3 mas seen by PIONIER, whose V² gain by 1.5 % an hour."""
    sheet = four_telescopes(5, channels=3, vis2_error=0.003, closure_error_deg=0.3)

    def source(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        wave = np.exp(-2j * np.pi * MAS * (3.0 * u - 5.0 * v))
        return (darkened_disc(disc_mas, 0.0, u, v) + contrast * wave) / (1.0 + contrast)

    data = observed(sheet, source, rng)
    table = data.vis2
    gain = 1.0 + 0.015 * (hours + 24.0 * (table.mjd - table.mjd.min()))
    value = np.concatenate([0.8 * gain * table.value, data.closure_phase.value])
    setups = tuple(replace(s, source=name) for s in data.setups)
    return replace(data.with_data(value), setups=setups)


@pytest.mark.slow
def test_a_night_that_drifts_takes_no_calibrator_along(rng) -> None:
    """Points that differ by the drift, less than the instrument's calibration errors, are kept.

    A binary and a large star are found among them.
    """
    hours = (-1.5, -0.5, 0.5, 1.5)
    good = [of_a_drifting_night(f"good{k}", t, rng) for k, t in enumerate(hours)]
    vetting = vet(good, limits=False, null_draws=2000)
    assert [v.kept for v in vetting.calibrators] == [True] * 4
    binary = of_a_drifting_night("binary", 0.7, rng, contrast=0.1)
    large = of_a_drifting_night("large", -0.7, rng, disc_mas=1.2)
    vetting = vet([*good[:3], binary, large], limits=False, null_draws=2000)
    assert [v.kept for v in vetting.calibrators] == [True] * 3 + [False] * 2
    assert "companion" in vetting.calibrators[3].reason
    assert "resolved" in vetting.calibrators[4].reason


@pytest.mark.parametrize(
    "name",
    [
        "canopus_matisse",
        "arcturus_iota",
        "alphacen_pionier_1",
        pytest.param("alphacol_amber", marks=pytest.mark.slow),
    ],
)
def test_resolved_single_stars_have_no_companion(name: str, data: Path) -> None:
    """α Cen A had one of 6.6 mag, Canopus of 2.3, Arcturus and α Col of 0.0: `search` has none."""
    star = read_oifits(data / "oifits" / f"{name}.fits")
    (found,) = vet([star], calibrated=True, limits=False, null_draws=1500).calibrators
    assert not found.shows_companion(0.003)
    assert found.reason.startswith("resolved: ")
