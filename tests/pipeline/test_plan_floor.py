"""The floor of a plan against drawn flat fields, drawn calibrators and injected companions."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import script_of_docs

from amibayes.cli import main
from amibayes.data.observables import Observables
from amibayes.errors import UsageError
from amibayes.instrument import load_instrument
from amibayes.optics import fringe_basis
from amibayes.pipeline import plan_floor
from amibayes.pipeline.migration_plan import envelope_fit
from amibayes.pipeline.plan_floor import (
    N_PIXELS,
    Floor,
    _observed,
    calibrated_covariance,
    converter_error,
    flat_error,
)
from amibayes.pipeline.planning import Plan, expected_observables, make_plan
from amibayes.simulation import Detector
from amibayes.simulation.budget import star_channels
from amibayes.simulation.detector import draw_maps
from amibayes.simulation.ramps import read_ramps
from amibayes.simulation.slopes import electron_variance, slope_weights


@pytest.fixture(scope="module")
def plan() -> Plan:
    instrument = load_instrument("niriss", "F430M").as_built()
    return make_plan(instrument, magnitude=6.0, photons=1e8)


@pytest.fixture(scope="module")
def photons(plan: Plan) -> Observables:
    return expected_observables(plan, Detector())


def test_flat_error_is_that_of_drawn_flat_fields(plan: Plan, rng) -> None:
    """60 flat fields at two places half a pixel apart, against errors averaged over pointings."""
    floor = Floor(flat=1e-3, dither_mas=200.0)  # three pixels: next to nothing is shared
    channels, found = star_channels(plan.instrument), []
    basis = fringe_basis(plan.instrument, channels, N_PIXELS)
    fit, image = envelope_fit(basis), np.asarray(basis.image()).ravel()
    for _ in range(60):
        seen = fit @ (image * (1.0 + 1e-3 * rng.standard_normal(image.size)))
        found.append(_observed(plan.instrument, seen))
    errors = np.array(found)
    errors[:, :21] -= 1.0
    expected = np.sqrt((errors[:, :21] ** 2).mean()), np.sqrt((errors[:, 21:] ** 2).mean())
    np.testing.assert_allclose(flat_error(plan, floor), expected, rtol=0.2)
    near = flat_error(plan, replace(floor, dither_mas=1.0))
    assert max(np.array(near) / expected) < 0.1


def test_converter_error_is_that_of_ramps_that_are_read_out(plan: Plan, rng) -> None:
    """Three detectors, target and calibrators drawn read by read, slopes by the simulator."""
    floor, n = Floor(dither_mas=65.6), 40
    detector = Detector(frame_time_s=plan.options.frame_time_s, adc_nonlinearity=1.0)
    found = []
    for _ in range(3):
        bias = draw_maps(detector, (n, n), rng).bias_dn
        changes = []
        for k, (x, y) in enumerate(rng.standard_normal((4, 2))):
            basis = fringe_basis(
                plan.instrument, star_channels(plan.instrument), n, centre_px=(x, y)
            )
            image = np.asarray(basis.image()).reshape(n, n)
            rate = plan.count_rate_e_s * (0.5 if k else 1.0)
            light = np.broadcast_to(rate * image, (3, n, n))
            pair = [
                slopes_of(light, replace(detector, adc_nonlinearity=on), plan.n_groups, bias, k)
                for on in (1.0, 0.0)
            ]
            fit = envelope_fit(basis) / rate
            one, other = (_observed(plan.instrument, fit @ s.ravel()) for s in pair)
            changes.append(one - other)
        found.append(changes[0] - np.mean(changes[1:], axis=0))
    left = np.array(found) / np.sqrt(4.0 / 3.0)
    expected = np.sqrt((left[:, :21] ** 2).mean()), np.sqrt((left[:, 21:] ** 2).mean())
    got = converter_error(plan, Detector(), floor, rng)
    # Numbers of three detectors, and of four: their ratio is known to 15 %.
    np.testing.assert_allclose(got, expected, rtol=0.6)
    assert converter_error(plan, Detector(), replace(floor, converter=0.0), rng) == (0.0, 0.0)
    same = converter_error(plan, Detector(), replace(floor, dither_mas=0.0, brightness=1.0), rng)
    assert max(same) < 1e-12


def slopes_of(light, detector: Detector, n_groups: int, bias, seed: int) -> np.ndarray:
    """Mean slope image of ramps with the same noise whatever the converter does."""
    rng = np.random.default_rng(seed)
    ramps = read_ramps(light, detector, n_groups, rng, bias)
    weight = slope_weights(
        electron_variance(light[0], detector), len(ramps.reads) - 1, detector
    ).reads
    return np.einsum("rnyx,ryx->yx", ramps.reads, weight) / len(light)


def test_calibration_learns_the_scatter_of_drawn_calibrators(photons: Observables, rng) -> None:
    """Without scatter a third of the noise and what cannot be excluded; with much, its share."""
    sigma = np.median(np.sqrt(np.diag(photons.covariance.dense()))[:21])
    variance = [
        np.diag(calibrated_covariance(photons, np.array([tau, 0.0]), 3, rng))[:21].mean()
        for tau in (0.0, 5.0 * sigma)
    ]
    assert 1.3 < variance[0] / sigma**2 < 2.5
    assert variance[1] / (5.0 * sigma) ** 2 == pytest.approx(4.0 / 3.0 + 1.0 / 25.0, rel=0.4)
    two = calibrated_covariance(photons, np.array([2.0 * sigma, 0.0]), 2, rng)
    assert np.diag(two)[:21].mean() / sigma**2 == pytest.approx(7.5, rel=0.1)


def test_plan_json_has_the_floor(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.setattr(plan_floor, "N_SEPARATIONS", 2)
    monkeypatch.setattr(plan_floor, "TRIALS", 10)
    words = ["plan", "--filter", "F480M", "--photons", "1e9", "--mag", "6", "--out", str(tmp_path)]
    floor = "flat=0,drift_nm=0,brightness=1,dither_mas=0,vis2=0.002,calibrators=2"
    # Calibrators of the same brightness at the same place share what the converter does.
    assert main([*words, "--separation", "150:160", "--floor", floor]) == 0
    found = json.loads((tmp_path / "plan.json").read_text(encoding="utf-8"))
    causes = {"flat": 0.0, "drift": 0.0, "migration": 0.0, "converter": 0.0, "scatter": 0.002}
    assert found["floor"]["vis2"] == pytest.approx(causes, abs=1e-12)
    assert found["floor"]["calibrated_sigma_vis2"] == pytest.approx(0.002 * 1.5**0.5, rel=0.1)
    assert found["floor"]["delta_mag"][0] < found["contrast_curve"]["delta_mag_3sigma"][0]
    assert "calibrated search, 95 %" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("floor", "fault"),
    [("flat", "NAME=VALUE"), ("wind=1", "NAME=VALUE"), ("flat=x", "not a number")],
)
def test_a_floor_that_makes_no_sense_is_refused(floor: str, fault: str, tmp_path, capsys) -> None:
    words = ["plan", "--filter", "F480M", "--photons", "1e9", "--mag", "6", "--out", str(tmp_path)]
    with pytest.raises(SystemExit, match="2"):
        main([*words, "--floor", floor])
    assert fault in capsys.readouterr().err
    with pytest.raises(UsageError, match="at least"):
        Floor(calibrators=0)


def test_errors_are_those_of_simulated_calibrated_images(monkeypatch) -> None:
    """A star and three calibrators of 10⁸ photons each, of fewer and smaller images."""
    script = script_of_docs("plan_floor")
    monkeypatch.setattr(script, "INTEGRATIONS", 8)
    monkeypatch.setattr(script, "N_PIXELS", 40)
    instrument = load_instrument("niriss", "F430M").as_built()
    plan = make_plan(instrument, magnitude=6.0, photons=1e8)
    found = script.observed(plan, Floor(), np.random.default_rng(1))
    photons = expected_observables(plan, Detector())
    tau = np.array([3e-4, 1.5e-4])  # of the flat field, mostly
    total = calibrated_covariance(photons, tau, 3, np.random.default_rng(2))
    expected = np.sqrt(np.diag(total))
    errors = found.without_shared_errors().errors
    assert np.median(errors[0]) == pytest.approx(np.median(expected[:21]), rel=0.4)
    assert np.median(errors[1]) == pytest.approx(np.median(expected[21:]), rel=0.4)


@pytest.mark.slow
def test_limit_is_that_of_a_simulated_calibrated_search(monkeypatch) -> None:
    """The mean of two realisations scatters by 0.15 mag: within 0.3 of the plan and twice that."""
    script = script_of_docs("plan_floor")
    monkeypatch.setattr(script, "REALISATIONS", 2)
    row = script.compared(1e8)
    assert abs(row.planned.mean() - np.nanmean(row.reached)) < 0.6
