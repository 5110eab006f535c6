"""Plans: the paper's table to the last digit, and predicted errors against simulated ones."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))
from simulated_star import Star, still

from amibayes.cli import main
from amibayes.errors import UsageError
from amibayes.instrument import load_instrument
from amibayes.optics import fringe_basis, psf
from amibayes.pipeline.planning import PAPER, PlanOptions, expect, make_plan, visibility_covariance
from amibayes.simulation import Detector

TABLE_1 = {
    "F380M": (7, (11, 97, 960, 9590)),
    "F430M": (14, (8, 76, 750, 7495)),
    "F480M": (19, (7, 63, 622, 6214)),
}
"""Groups, and integrations for 1e7 … 1e10 photons (Soulain et al. 2020)."""

PHOTONS = (1e7, 1e8, 1e9, 1e10)


@pytest.mark.parametrize("name", TABLE_1)
def test_table_1_of_the_paper(name: str) -> None:
    instrument = load_instrument("niriss", name)
    plans = [make_plan(instrument, magnitude=6.0, photons=n, options=PAPER) for n in PHOTONS]
    assert {plan.n_groups for plan in plans} == {TABLE_1[name][0]}
    assert tuple(plan.n_integrations for plan in plans) == TABLE_1[name][1]
    for plan, wanted in zip(plans, PHOTONS, strict=True):
        assert wanted <= plan.total_photons * (1 + 1e-9) < 1.3 * wanted


def test_the_stated_frame_time_gives_another_table() -> None:
    matches, told = 0, 0
    for name, (groups, integrations) in TABLE_1.items():
        instrument = load_instrument("niriss", name)
        for photons, n in zip(PHOTONS, integrations, strict=True):
            stated = PlanOptions("paper", frame_time_s=0.07544)
            plan = make_plan(instrument, magnitude=6.0, photons=photons, options=stated)
            matches += (plan.n_groups, plan.n_integrations) == (groups, n)
            paper = make_plan(instrument, magnitude=6.0, photons=photons, options=PAPER)
            told += any("0.07544" in warning for warning in paper.warnings)
    assert matches <= 3
    assert told == 12 - matches


@pytest.mark.parametrize("name", TABLE_1)
def test_default_keeps_the_brightest_pixel_below_the_limit(name: str) -> None:
    instrument = load_instrument("niriss", name)
    plan = make_plan(instrument, magnitude=6.0, photons=1e8)
    channels = instrument.bandpass.channels(n=9)
    offsets = np.random.default_rng(1).uniform(-0.5, 0.5, (30, 2))
    peaks = [psf(instrument, channels, 8, centre_px=tuple(offset)).max() for offset in offsets]
    frame = plan.count_rate_e_s * plan.options.frame_time_s
    assert max(peaks) * frame * plan.n_groups < 30000.0
    assert plan.peaks.centred * frame * (plan.n_groups + 1) > 30000.0
    assert plan.groups["paper"] == TABLE_1[name][0]
    assert plan.groups["cornered"] > plan.groups["centred"] > plan.groups["paper"]


def test_brightness_and_time_scale_the_plan() -> None:
    instrument = load_instrument("niriss", "F430M")
    bright = make_plan(instrument, magnitude=6.0, photons=1e8)
    faint = make_plan(instrument, magnitude=8.5, photons=1e8)
    assert faint.count_rate_e_s == pytest.approx(bright.count_rate_e_s / 10.0)
    assert faint.n_groups == pytest.approx(10 * bright.n_groups, abs=10)
    given = make_plan(instrument, count_rate_e_s=bright.count_rate_e_s, photons=1e8)
    assert given.n_integrations == bright.n_integrations
    timed = make_plan(instrument, magnitude=6.0, time_s=bright.exposure_time_s * 1.0001)
    assert timed.n_integrations == bright.n_integrations


def test_warnings_say_what_is_in_the_way() -> None:
    instrument = load_instrument("niriss", "F430M")

    def warned(**request: float) -> str:
        options = PlanOptions(peak_limit_e=request.pop("limit", 30000.0))
        return " | ".join(make_plan(instrument, options=options, **request).warnings)

    assert "do not fit in one exposure" in warned(magnitude=6.0, photons=1e12)
    assert "charge migrates" in warned(magnitude=6.0, photons=1e7)
    assert "migrates" not in warned(magnitude=6.0, photons=1e7, limit=25000.0)
    assert "saturates" in warned(magnitude=6.0, photons=1e7, limit=90000.0)
    assert "a ramp has 800 at most" in warned(magnitude=15.0, photons=1e7)
    assert "a slope needs 2 groups" in warned(magnitude=3.0, photons=1e7)


@pytest.mark.parametrize(
    ("request_", "message"),
    [
        ({"magnitude": 6.0}, "either the photons or the time"),
        ({"photons": 1e7}, "either the magnitude or the count rate"),
        ({"magnitude": 6.0, "photons": -1.0}, "photons -1 is not a positive number"),
        ({"magnitude": 99.0, "photons": 1e7}, "not one of a star"),
        ({"magnitude": 0.0, "photons": 1e7}, "the star saturates: "),
        ({"magnitude": 6.0, "photons": 1e30}, "takes 9.6.*e\\+18 days"),
        ({"magnitude": 6.0, "time_s": 1e12}, "days"),
        ({"magnitude": 6.0, "time_s": 1e-3}, "do not hold one integration"),
        ({"magnitude": 6.0, "photons": 1.0}, "carry no closure phase"),
        ({"magnitude": 35.0, "photons": 1e8}, "days"),
    ],
)
def test_plans_that_cannot_be(request_: dict[str, float], message: str) -> None:
    instrument = load_instrument("niriss", "F430M")
    with pytest.raises(UsageError, match=message):
        make_plan(instrument, **request_)
    with pytest.raises(UsageError, match="choose from default, paper"):
        PlanOptions("ideal")


def test_predicted_errors_are_those_of_simulated_fringe_fits() -> None:
    n, groups = 600, 6
    detector = Detector(flat_error=0.0)
    star = Star(still(groups, n, 80), detector, rate_e_s=3e5)
    images = star.take()["images"].reshape(n, -1).astype(float)
    basis = fringe_basis(star.instrument, star.channels)
    weight = 1.0 / star.recorder.fit.weights.variance.ravel()
    columns = np.column_stack([basis.matrix, np.ones(len(weight))])
    normal = columns.T @ (columns * weight[:, None])
    fitted = np.linalg.solve(normal, columns.T @ (weight[:, None] * images.T))
    m = basis.n_baselines
    visibility = (fitted[1 : 1 + m] + 1j * fitted[1 + m : 1 + 2 * m]) / fitted[0]
    ij, jk, ik = star.instrument.mask.triangle_baselines.T
    closure = np.angle(visibility[ij] * visibility[jk] * visibility[ik].conj())
    plan = make_plan(star.instrument, count_rate_e_s=3e5, photons=1e9)
    expected = expect(replace(plan, n_groups=groups, n_integrations=1), detector=detector)
    # 35 closure phases, 15 of them independent, each rms known to 2.9 %
    assert closure.std(axis=1).mean() == pytest.approx(expected.closure_phase_rad, rel=0.03)
    vis2 = np.abs(visibility) ** 2
    assert vis2.std(axis=1).mean() == pytest.approx(expected.vis2, rel=0.03)


def test_photon_noise_curve_is_the_published_bound() -> None:
    # Closure phases of the fringe fit, photon noise alone, 1e7 photons, 50-400 mas
    bounds = {"F380M": (5.5, 7.2), "F430M": (5.3, 7.3), "F480M": (5.05, 7.4)}
    quiet = Detector(read_noise_e=0.0, dark_e_s=0.0, background_e_s=0.0)
    for name, (low, high) in bounds.items():
        plan = make_plan(load_instrument("niriss", name), magnitude=6.0, photons=1e7)
        expected = expect(plan, detector=quiet)
        to_1e7 = -1.25 * np.log10(plan.total_photons / 1e7)
        curve = expected.closure_curve.delta_mag + to_1e7
        assert curve.min() == pytest.approx(low, abs=0.2)
        assert curve.max() == pytest.approx(high, abs=0.2)
        # the paper's formula is that of uniform light over the holes: near, not below by much
        ratio = expected.closure_phase_rad / expected.closure_phase_photons_rad
        assert 0.85 < ratio < 1.05
        assert (expected.curve.delta_mag > expected.closure_curve.delta_mag).all()


def test_errors_fall_with_the_square_root_of_the_photons() -> None:
    instrument = load_instrument("niriss", "F480M")
    plans = [make_plan(instrument, magnitude=6.0, photons=n) for n in (1e8, 1e10)]
    few, many = (expect(plan) for plan in plans)
    depth = np.sqrt(plans[1].total_photons / plans[0].total_photons)
    assert few.closure_phase_rad / many.closure_phase_rad == pytest.approx(depth, rel=1e-6)
    assert few.vis2 / many.vis2 == pytest.approx(depth, rel=1e-6)
    gain = many.curve.delta_mag - few.curve.delta_mag
    np.testing.assert_allclose(gain, 2.5 * np.log10(depth), atol=1e-6)


def test_visibility_covariance_is_positive_and_symmetric() -> None:
    plan = make_plan(load_instrument("niriss", "F380M"), magnitude=6.0, photons=1e8)
    covariance = visibility_covariance(plan, Detector())
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6, atol=1e-18)
    assert np.linalg.eigvalsh(covariance).min() > 0.0


def test_command_writes_what_it_prints(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["plan", "--filter", "F430M", "--photons", "1e8", "--mag", "6", "--out", str(tmp_path)]
    words += ["--floor", "none"]
    assert main([*words, "--preset", "paper", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((tmp_path / "plan.json").read_text())
    assert (printed["filter"], printed["n_groups"], printed["n_integrations"]) == ("F430M", 14, 76)
    assert printed["total_photons"] == pytest.approx(1279391 * 14 * 0.0745 * 76)
    assert main(words) == 2
    assert "is there already" in capsys.readouterr().err
    assert main([*words, "--overwrite"]) == 0
    shown = capsys.readouterr().out.splitlines()
    assert len(shown) <= 20
    assert any("groups          16" in line and "paper 14" in line for line in shown)


def test_saturation_is_stated_with_a_charge_above_the_well() -> None:
    """In F277W a star of 6 mag fills less than a pixel in one group, and more in two."""
    with pytest.raises(UsageError, match="a slope needs 2 groups") as raised:
        make_plan(load_instrument("niriss", "F277W"), magnitude=6.0, photons=1e8)
    collected, well = map(int, re.findall(r"(\d+) (?:electrons|fill)", str(raised.value)))
    assert well < collected < 2 * well


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--filter", "F999", "--photons", "1e8", "--mag", "6"], "has no filter 'F999'"),
        (["--filter", "F430M", "--photons", "1e8", "--mag", "-3"], "the star saturates"),
        (["--filter", "F430M", "--photons", "0", "--mag", "6"], "not a positive number"),
        (["--filter", "F430M", "--mag", "6"], "required"),
        (["--filter", "F430M", "--mag", "6", "--photons", "1e30"], "days"),
        (["--filter", "F430M", "--mag", "27", "--time", "1e5"], "read noise drowns the star"),
    ],
)
def test_command_refuses_in_one_line(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = main(["plan", *words, "--out", str(tmp_path / "out")])
    except SystemExit as leaving:
        status = int(str(leaving.code))
    shown = capsys.readouterr()
    assert status == 2
    assert message in shown.err
    assert shown.err.count("\n") == 1
