"""The verdict of simulated stars, binaries, discs, rings and triple stars."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import interferometer
import numpy as np
import pytest
from epochs import epoch
from helpers import niriss, simulated
from interferometer import four_telescopes
from scipy.special import j0, j1
from scipy.stats import binom, chi2

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables, join
from amibayes.detection.false_alarm import Significance
from amibayes.detection.note import note_of
from amibayes.detection.splits import Consistency
from amibayes.detection.statistic import statistic_of
from amibayes.detection.verdict import (
    SMALL,
    WITHIN,
    Verdict,
    change_by_companion,
    joint_probability,
    parts_of_fit,
    star_alone,
    verdict,
    within_calibration,
)
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise_fit import noise_beside
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.false_alarm import false_alarm, verdict_of
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions, noise_prior
from amibayes.units import MAS, offset

Visibility = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Complex visibility at spatial frequencies along east and north, cycles per mas."""

OPTIONS = SearchOptions(separation_mas=(60.0, 300.0), alpha=0.01, null_draws=2000)


def star(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.ones_like(u, dtype=complex)


def points(*companions: tuple[float, float, float]) -> Visibility:
    """A star with companions: east and north (mas), flux ratio."""

    def visibility(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        light = star(u, v)
        for east, north, c in companions:
            light = light + c * np.exp(-2j * np.pi * (u * east + v * north))
        return light / (1.0 + sum(c for *_, c in companions))

    return visibility


def ring(radius: float, flux: float, east: float = 0.0) -> Visibility:
    """A thin ring about the star, its middle off by ``east`` (mas), inclined by 45 degrees."""

    def visibility(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x = 2.0 * np.pi * radius * np.hypot(u, v * np.sqrt(0.5))
        return (1.0 + flux * j0(x) * np.exp(-2j * np.pi * u * east)) / (1.0 + flux)

    return visibility


def disc(diameter: float, spot: float = 0.0) -> Visibility:
    """A uniform disc, with a spot of some flux at a third of its radius."""

    def visibility(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        x = np.maximum(np.pi * diameter * np.hypot(u, v), 1e-9)
        bright = spot * np.exp(-2j * np.pi * u * diameter / 6.0)
        return (2.0 * j1(x) / x + bright) / (1.0 + spot)

    return visibility


def observed(sheet: Observables, source: Visibility, rng: np.random.Generator) -> Observables:
    """The sheet's observables of a source, with noise."""
    return interferometer.observed(sheet, lambda u, v, _: source(MAS * u, MAS * v), rng)


def searched(
    data: Observables, rng: np.random.Generator
) -> tuple[SearchResult, Verdict, tuple[Consistency, ...]]:
    """The fit and the verdict as the main job gives them."""
    found = search_field(data, OPTIONS)
    tested = false_alarm(found.result, OPTIONS, rng)
    return found.result, *verdict_of(found, tested, OPTIONS, rng)


def told(data: Observables, rng: np.random.Generator) -> tuple[Verdict, tuple[Consistency, ...]]:
    """The verdict alone."""
    return searched(data, rng)[1:]


def anywhere(rng: np.random.Generator, near: float = 80.0, far: float = 280.0) -> list[float]:
    return [float(x) for x in offset(rng.uniform(near, far), rng.uniform(0.0, 360.0))]


KINDS: dict[str, Callable[[np.random.Generator], Visibility]] = {
    "star": lambda rng: star,
    "binary": lambda rng: points((*anywhere(rng), 10.0 ** rng.uniform(-2.0, -0.7))),
    "triple": lambda rng: points((*anywhere(rng), 0.1), (*anywhere(rng), 0.07)),
    "ring": lambda rng: ring(rng.uniform(120.0, 250.0), rng.uniform(0.3, 0.8), 30.0),
    "disc": lambda rng: disc(rng.uniform(150.0, 260.0)),
    "spotted disc": lambda rng: disc(rng.uniform(150.0, 260.0), 0.2),
}

EXPECTED = {
    "star": {"no companion"},
    "binary": {"companion"},
    "triple": {"model rejected"},
    "ring": {"model rejected"},
}
"""A disc by itself is a star with a diameter;
noise within its prior may hide spots."""


@pytest.mark.parametrize("kind", EXPECTED)
def test_one_of_each_kind_is_told_for_what_it_is(kind: str) -> None:
    rng = np.random.default_rng([7, list(KINDS).index(kind)])
    data = observed(niriss(), KINDS[kind](rng), rng)
    found, _ = told(data, rng)
    assert found.statement in EXPECTED[kind], found
    assert 0.0 <= found.p_model <= 1.0
    assert found.because


@pytest.mark.parametrize(
    ("place", "diameter", "note"),
    [
        ((120.0, 90.0), 55.0, ""),
        ((60.0, 45.0), 0.0, "nearer than λ/2B, 94.1 mas"),
        ((120.0, 90.0), 80.0, "larger than any star"),
        ((60.0, 45.0), 200.0, "inside the star's disc of 200 mas"),
    ],
)
def test_what_else_may_look_like_the_companion_is_stated(
    place: tuple[float, float], diameter: float, note: str
) -> None:
    model = BinaryModel(diameter_mas="free")
    data = simulated(niriss(), [*place, 0.1, diameter], None, model)
    result = search(Likelihood(data, model), (60.0, 300.0))
    warned = note_of(result)
    assert note in warned
    assert bool(warned) == bool(note)
    certain = Significance(100.0, np.arange(1000.0) / 100.0, 1e-3, (0.0, 4e-3), None, 0.01)
    stated = verdict(result, certain, replace(certain, probability=1.0), ())
    assert stated.statement == "companion"
    assert stated.note == warned
    assert stated.because.endswith(warned)


@pytest.mark.parametrize(
    ("contrast", "expected"),
    [(0.0, "no companion"), pytest.param(0.9, "model rejected", marks=pytest.mark.slow)],
)
def test_no_star_alone_is_stated_that_does_not_fit(
    contrast: float, expected: str, rng: np.random.Generator
) -> None:
    """That noise of any size may look like a bright companion says nothing for the star alone.

    Whatever the null draws say: beside a star of equal brightness it needs far more noise than is
    plausible.
    """
    sheet = four_telescopes(2, 6, vis2_error=0.005, closure_error_deg=0.5)
    data = observed(sheet, points((3.0, 4.0, contrast)), rng)
    options = replace(OPTIONS, separation_mas=(1.5, 8.0))
    result = search_field(data, options).result
    tested = Significance(9.0, np.arange(20.0), 0.5, (0.4, 0.6), None, 0.01)
    assert verdict(result, tested, tested, []).statement == "no companion"
    alone = star_alone(result, data, noise_prior(data, options), per_file=True)
    said = verdict(result, tested, tested, [], alone=alone)
    assert said.statement == expected
    assert ("a star alone does not fit: χ² of " in said.because) is (contrast > 0.0)
    assert said.because.endswith("with a probability of 0.5")


@pytest.mark.parametrize(("upper", "said"), [(0.008, False), (0.02, True)])
def test_a_small_probability_that_few_draws_tell_is_said_not_to_be_sure(
    upper: float, said: bool, rng: np.random.Generator
) -> None:
    """Detection asks for an interval below α = 0.01, and this one may reach past it."""
    result = search(Likelihood(simulated(niriss(), [0.0, 150.0, 0.02], rng)), (60.0, 300.0))
    tested = Significance(20.0, np.arange(1000.0), 0.004, (0.001, upper), None, 0.01)
    nothing = Significance(1.0, np.arange(20.0), 0.9, (0.8, 1.0), None, 0.01)
    found = verdict(result, tested, nothing, ())
    assert (found.statement == "no companion") is said
    more = "0.004, which is not below 0.01 with 95 % confidence: more null draws may tell"
    assert found.because.endswith(more) is said


@pytest.mark.parametrize("error", [200.0, np.inf, np.nan])
def test_a_companion_without_a_place_is_said_to_have_none(
    error: float, rng: np.random.Generator
) -> None:
    result = search(Likelihood(simulated(niriss(), [0.0, 150.0, 0.02], rng)), (60.0, 300.0))
    tested = Significance(100.0, np.arange(1000.0), 1e-3, (0.0, 4e-3), None, 0.01)
    nothing = Significance(1.0, np.arange(20.0), 0.9, (0.8, 1.0), None, 0.01)
    unsure = replace(result, companion=replace(result.companion, separation_error_mas=error))
    known, open_ = (verdict(r, tested, nothing, ()) for r in (result, unsure))
    assert known.statement == open_.statement == "companion"
    assert open_.because == f"{known.because}; its place is undetermined"


@pytest.mark.slow
def test_two_files_with_a_companion_at_other_places_are_inconsistent() -> None:
    """At PA 0 in one file, at PA 90 in the other: no companion of both."""
    rng, parts = np.random.default_rng(2), []
    for name, companion in (("a", (0.0, 150.0, 0.03)), ("b", (150.0, 0.0, 0.03))):
        data = observed(niriss(), points(companion), rng)
        parts.append(replace(data, setups=(replace(data.setups[0], source=name),)))
    found, splits = told(join(parts), rng)
    assert found.statement == "inconsistent data", found
    assert {"files"} <= {s.split for s in splits}


@pytest.mark.parametrize(("fastest", "words"), [(0.0, "; a motion (--m"), (50.0, "; --fastest")])
def test_files_of_other_nights_that_disagree_may_be_a_motion(fastest: float, words: str) -> None:
    """Where each file is a night, and one linear motion explains nothing where it is free."""
    nights = [epoch(mjd=60000.0), epoch(mjd=60100.0, source="b.oifits")]
    model = BinaryModel(fastest_mas_yr=fastest, reference_mjd=60050.0)
    result = search(Likelihood(join(nights), model), (100.0, 200.0))
    tested = Significance(9.0, np.arange(20.0), 1e-4, (0.0, 1e-3), None, 0.01)
    nothing = Significance(1.0, np.arange(20.0), 0.9, (0.8, 1.0), None, 0.01)
    splits = [
        Consistency("files", ("a.oifits", "b.oifits"), 50.0, 1e-5),
        Consistency("epochs", ("MJD 60000.000", "MJD 60100.000"), 50.0, 1e-5),
    ]
    found = verdict(result, tested, nothing, splits)
    assert found.because.startswith("MJD 60000.000 and MJD 60100.000 disagree")
    assert words in found.because


@pytest.mark.parametrize(
    ("insname", "second", "within"),
    [
        ("PIONIER_Pnat", 0.003, True),
        ("PIONIER_Pnat", 0.1, False),
        ("NIRISS", 0.003, False),
    ],
)
def test_structure_counts_where_it_exceeds_the_calibration_errors_of_the_table(
    insname: str, second: float, within: bool
) -> None:
    """3 % of V² and half a degree: what a component of some 1 % of light changes."""
    rng = np.random.default_rng(4)
    data = observed(niriss(), points((0.0, 150.0, 0.05), (120.0, -90.0, second)), rng)
    data = replace(data, setups=(replace(data.setups[0], insname=insname),))
    test = statistic_of(search_field(data, OPTIONS).result, beside=True)
    change = test.change_by(test.strongest)[:, 0]
    assert within_calibration(test.likelihood.observables, change) is within
    assert test.strongest[0, 2] < 2.0 * second or second < 0.01


@pytest.mark.parametrize(
    ("contrast", "noted"), [(0.008, True), pytest.param(0.1, False, marks=pytest.mark.slow)]
)
def test_a_companion_within_the_calibration_errors_is_noted(contrast: float, noted: bool) -> None:
    """Of PIONIER, 3 % of V² and half a degree, in 24 exposures with errors of 1 % and 0.3°."""
    sheet = four_telescopes(24, vis2_error=0.01, closure_error_deg=0.3)
    model, theta = BinaryModel(diameter_mas=0.5), np.array([5.0, -4.0, contrast])
    data = simulated(sheet, theta, np.random.default_rng(5), model)
    options = SearchOptions(separation_mas=(2.0, 12.0), diameter=0.5, null_draws=2000, alpha=0.01)
    found = search_field(data, options)
    size = np.abs(change_by_companion(found.result)[: data.n_vis2])
    assert size.max() == pytest.approx(4.0 * contrast, rel=0.4)  # 2c on either side of the star's
    tested = false_alarm(found.result, options, np.random.default_rng(6))
    said, _ = verdict_of(found, tested, options, np.random.default_rng(7))
    assert said.statement == "companion"
    assert (said.note == SMALL) is noted


@pytest.mark.parametrize(
    ("excess", "low", "high"), [(1.0, 0.2, 1.0), (1.1, 0.05, 0.4), (1.6, 0.0, 1e-3)]
)
def test_noise_of_another_shape_may_change_chi2_by_a_tenth(
    excess: float, low: float, high: float
) -> None:
    """4200 V²: a χ² too large by 10 % is 4.6 standard deviations, and no noise is known so well."""
    one = niriss().only(("vis2",))
    data = join([one] * 200)
    z = np.random.default_rng(5).standard_normal(len(data.vis2))
    z *= np.sqrt(excess * len(z)) / np.linalg.norm(z)
    noisy = replace(data.vis2, value=1.0 + z * np.sqrt(data.covariance.variance))
    likelihood = Likelihood(replace(data, vis2=noisy), BinaryModel())
    fit = likelihood, np.zeros(3), len(z)
    assert low <= joint_probability(parts_of_fit(*fit, ExtraNoise())) <= high
    exact = chi2.sf(excess * len(z), len(z))
    assert joint_probability(parts_of_fit(*fit)) == pytest.approx(exact, rel=1e-6)


def test_channels_that_are_independent_do_not_refuse_a_star() -> None:
    """One triangle in six channels tells little of what channels share; 200 stars."""
    sheet, rng = four_telescopes(1, 6), np.random.default_rng(4)
    few = [(m.stations < 3).all(axis=1) for m in (sheet.vis2, sheet.closure_phase)]
    sheet, p = sheet.select(*few), []
    point = Likelihood(sheet, BinaryModel(companions=0)).predict(np.empty((1, 0)))[:, 0]
    for errors in sheet.covariance.draw(rng, 200).T:
        star = Likelihood(sheet.with_data(point + errors), BinaryModel(companions=0))
        noise, noisy = noise_beside(star, np.empty(0))
        p.append(joint_probability(parts_of_fit(noisy, np.empty(0), len(errors), noise)))
    assert binom.sf((np.array(p) < 0.01).sum() - 1, 200, 0.01) > 1e-4
    assert binom.sf((np.array(p) < 0.05).sum() - 1, 200, 0.05) > 1e-4
    assert np.median(p) < 0.95


@pytest.mark.release
def test_confusion_of_forty_of_each_kind() -> None:
    """Shares with bounds of 4.5 binomial σ about what was measured over 200 of each."""
    table: dict[str, dict[str, int]] = {}
    for number, (kind, make) in enumerate(KINDS.items()):
        for k in range(40):
            rng = np.random.default_rng([3, number, k])
            statement = told(observed(niriss(), make(rng), rng), rng)[0].statement
            counts = table.setdefault(kind, {})
            counts[statement] = counts.get(statement, 0) + 1
        logging.getLogger("verdict").info("%s: %s", kind, table[kind])
    assert table["star"].get("companion", 0) <= 4
    assert table["star"]["no companion"] >= 34
    assert table["binary"]["companion"] >= 33
    for kind in ("triple", "ring", "spotted disc"):
        assert table[kind].get("companion", 0) <= 4
        assert kind == "spotted disc" or table[kind].get("no companion", 0) <= 4


@pytest.mark.parametrize(("p", "said"), [(0.004, True), (0.006, False)])
def test_structure_within_the_calibration_errors_is_told(p: float, said: bool, rng) -> None:
    """At a rate of 1 % of two tests: of the fit, and of what it leaves."""
    result = search(Likelihood(simulated(niriss(), [150.0, -80.0, 0.02], rng)), (120.0, 200.0))
    tested = Significance(30.0, np.arange(2000.0), 5e-4, (0.0, 2e-3), None, 0.01)
    left = Significance(12.0, np.arange(2000.0), p, (0.5 * p, 2.0 * p), None, 0.01)
    found = verdict(result, tested, left, (), structured=False)
    assert found.statement == "companion"
    assert (WITHIN in found.because) == said
    assert WITHIN not in verdict(result, tested, replace(left, probability=0.5), ()).because


@pytest.mark.parametrize("extra_noise", [True, False])
@pytest.mark.parametrize("p", [1.5e-3, 1e-6])
def test_a_misfit_that_no_noise_was_fitted_to_rejects_no_star(p: float, extra_noise: bool) -> None:
    """Noise is fitted where χ² has a probability below 0.001: α may be larger.

    A few V² with errors that are too small gave probabilities between the two.
    """
    rng = np.random.default_rng(3)
    data = observed(niriss(), star, rng)
    misfit = data.data.copy()
    noise = misfit[: data.n_vis2] - 1.0
    noise *= 0.005 * np.sqrt(chi2.isf(p, data.n_vis2) / (noise**2).sum())
    misfit[: data.n_vis2] = 1.0 + noise
    options = replace(OPTIONS, extra_noise=extra_noise, diameter=0.0)
    found = search_field(data.with_data(misfit), options)
    tested = Significance(9.0, np.arange(20.0), 0.5, (0.4, 0.6), None, options.alpha)
    said = verdict_of(found, tested, options, rng)[0]
    assert said.statement == ("no companion" if extra_noise else "model rejected"), said


def test_the_star_that_is_alone_has_the_noise_that_it_leaves(rng: np.random.Generator) -> None:
    """A halo of 10 % around a star of 0.8 mas is noise to a star alone, and light to a companion.

    With the noise beside the best companion, which has the halo, the star's disc has to make it.
    """

    def visibility(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        return disc(0.8)(u, v) / 1.1

    data = observed(four_telescopes(10, 6, vis2_error=0.015), visibility, rng)
    options = replace(OPTIONS, separation_mas=None, alpha=0.0013, null_draws=3000)
    found = search_field(data, options)
    tested = false_alarm(found.result, options, rng)
    said = verdict_of(found, tested, options, rng)[0]
    assert said.statement == "no companion"
    taken, error = found.result.star_alone()["diameter_mas"]
    assert taken - 0.8 > 10.0 * error
    value, error = said.star["diameter_mas"]
    assert abs(value - 0.8) < 4.0 * error
