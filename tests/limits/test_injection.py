"""Companions in images: the injected light is the simulator's, and as many are found as stated."""

from __future__ import annotations

import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes import (
    Cube,
    DataError,
    Detector,
    Exposure,
    Likelihood,
    Orientation,
    Scene,
    calibrate,
    extract,
    load_instrument,
    make_criterion,
    measure_star,
    search,
    simulate,
)
from amibayes.data.observables import Observables
from amibayes.limits.image_injection import _filled
from amibayes.limits.injection import at_its_place
from amibayes.scene.sources import Point
from amibayes.units import DEGREE, MAS, offset

SCRIPT = Path(__file__).resolve().parents[2] / "examples" / "injection_recovery.py"
QUIET = Detector(photon_noise=False, read_noise_e=0.0, flat_error=0.0, background_e_s=0.0)
RATE = 1.1e6


def exposure(
    seed: int, n: int, *companion: float, detector: Detector | None = None, roll_deg: float = 0.0
) -> Cube:
    """Images of a star, with a companion (east, north in mas, contrast) if one is given."""
    points = [Point()]
    if companion:
        points.append(Point(companion[2], companion[0] * MAS, companion[1] * MAS))
    return simulate(
        Scene(tuple(points)),
        load_instrument("niriss", "F480M"),
        Exposure(19, n),
        np.random.default_rng(seed),
        detector=detector or Detector(),
        orientation=Orientation(roll_deg * DEGREE),
        count_rate_e_s=RATE,
    )


def test_injected_light_is_that_of_the_simulator() -> None:
    """Same pointings, no noise: images with a companion differ from injected ones by 1e-3 of it.

    The measured flux and place of the star enter, and the extraction's few wavelengths.
    """
    companion = 120.0, -70.0, 0.01
    alone = exposure(3, 3, detector=QUIET, roll_deg=40.0)
    both = exposure(3, 3, *companion, detector=QUIET, roll_deg=40.0)
    injected = measure_star(alone).with_companion(*companion)
    truth = both.images - alone.images
    difference = injected.images - both.images
    assert np.abs(difference).max() < 5e-3 * truth.max()
    assert injected.images.sum() == pytest.approx(both.images.sum(), rel=2e-5)


def test_injected_light_brings_its_noise_and_its_errors() -> None:
    cube = exposure(4, 6)
    star = measure_star(cube)
    place = 100.0, 50.0, 0.2
    still, noisy = (
        star.with_companion(*place),
        star.with_companion(*place, np.random.default_rng(1)),
    )
    light = still.images - cube.images
    ramp_s = 19 * 0.07544
    bright = light > 0.2 * light.max()
    added = still.error**2 - cube.error**2
    # Photons over the time of the ramp; the slope fit's weights cost a few per cent.
    assert np.median(added[bright] / light[bright]) == pytest.approx(1.0 / ramp_s, rel=0.25)
    scatter = (noisy.images - still.images)[bright] / np.sqrt(added[bright])
    n = scatter.size
    assert abs((scatter**2).mean() - 1.0) < 4.5 * np.sqrt(2.0 / n)
    with pytest.raises(DataError, match="outside the images"):
        star.with_companion(5000.0, 0.0, 0.1)


@pytest.mark.parametrize("kinds", [("vis2", "cp"), ("cp",)])
def test_a_criterion_finds_what_is_bright_and_only_that(kinds: tuple[str, ...]) -> None:
    """Far above and far below the limit of 1e-3 nothing is left to chance."""
    rng = np.random.default_rng(3)
    data = simulated(niriss(), [0.0, 0.0, 0.0], rng)
    result = search(Likelihood(data.only(kinds)), (50.0, 400.0))
    criterion = make_criterion(result, rng, alpha=0.01, null_draws=1000)
    assert 0.0 < criterion.significance.alpha < 0.02
    bright, faint = ([100.0, 60.0, c] for c in (0.03, 1e-7))
    recovery = criterion.recover(np.array([bright] * 50 + [faint] * 400), rng)
    assert recovery.located[:50].all()
    # Noise alone passes at 1 %: more than 17 of 400 has a probability below 1e-5.
    assert recovery.detected[50:].sum() <= 17
    verdict = criterion.apply(simulated(niriss(), bright, rng), 100.0, 60.0)
    assert verdict.detected
    assert verdict.located
    elsewhere = criterion.apply(simulated(niriss(), bright, rng), -150.0, -60.0)
    assert elsewhere.detected
    assert not elsewhere.located
    assert verdict.statistic > criterion.significance.threshold()


@pytest.mark.slow
def test_the_example_finds_more_the_brighter_they_are(capsys) -> None:
    shares = runpy.run_path(str(SCRIPT))["main"]()
    assert len(capsys.readouterr().out.strip().split("\n")) == 3
    by_data = [row[1] for row in shares]
    assert by_data[0] < 0.6 < by_data[2]
    assert shares[2][1:] == (pytest.approx(1.0, abs=0.01), 1.0)


def fresh(seed: int, companion: tuple[float, ...]) -> Observables:
    """Target with a companion and calibrator, simulated, extracted, calibrated."""
    target = extract(exposure(2 * seed, 20, *companion))
    return calibrate(target, [extract(exposure(2 * seed + 1, 20))]).observables


@pytest.mark.slow
@pytest.mark.parametrize("way", ["simulated", "injected"])
def test_images_and_observables_agree_on_how_many_are_found(way: str) -> None:
    """40 fresh exposures at about half completeness: within the binomial error of the count.

    The stated covariance of one exposure differs from the next, which moves the expected share;
    it is averaged over the first ten.
    """
    n, contrast, rng = 40, 0.0012, np.random.default_rng(8)
    angles = rng.uniform(0.0, 360.0, n)
    found, expected = 0, []
    for k, angle in enumerate(angles):
        east, north = (float(x) for x in offset(150.0, angle))
        seed = 1000 + k
        if way == "simulated":
            data = fresh(seed, (east, north, contrast))
        else:
            images = measure_star(exposure(2 * seed, 20)).with_companion(east, north, contrast, rng)
            calibrator = extract(exposure(2 * seed + 1, 20))
            data = calibrate(extract(images), [calibrator]).observables
        if k < 10:
            criterion = make_criterion(search(Likelihood(data), (50.0, 400.0)), rng)
            ring = np.column_stack(
                [*offset(150.0, rng.uniform(0, 360, 500)), np.full(500, contrast)]
            )
            expected.append(criterion.recover(ring, rng).located.mean())
        found += criterion.apply(data, east, north).located
    p = np.mean(expected)
    assert 0.2 < p < 0.8
    spread = np.sqrt(n * p * (1 - p) + (n * np.std(expected)) ** 2 / 10)
    assert abs(found - n * p) < 4.0 * spread


def test_places_are_the_same_within_half_a_fringe() -> None:
    places = np.array([[100.0, 0.0], [-30.0, 40.0], [10.0, 10.0]])
    moved = places + np.array([[3.0, 4.0], [12.0, 0.0], [0.0, -9.9]])
    assert at_its_place(moved, places, 20.0).tolist() == [True, False, True]


def test_integrations_that_cannot_be_measured_are_those_in_the_middle() -> None:
    """Medians of those that can be: one that is far off moves nothing."""
    used = np.array([True, True, True, False, False])
    flux = np.array([1.0, 2.0, 90.0, np.nan, 7.0])
    shift = np.array([[0.1, 0.2], [0.3, -0.2], [9.0, 0.0], [np.nan, np.nan], [5.0, 5.0]])
    frames = SimpleNamespace(used=used, flux=flux, shift_px=shift, reason=["dark"])
    found = _filled(frames, "")  # type: ignore[arg-type]
    np.testing.assert_array_equal(found[0], [1.0, 2.0, 90.0, 2.0, 2.0])
    np.testing.assert_array_equal(found[1], [*shift[:3], [0.3, 0.0], [0.3, 0.0]])
    frames.used = np.zeros(5, dtype=bool)
    with pytest.raises(DataError, match="no integration can be used: dark"):
        _filled(frames, "")  # type: ignore[arg-type]
