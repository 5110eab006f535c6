"""Stars without a companion that fit as well as one with: told from companions, by direct code."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import interferometer
import numpy as np
import pytest
from brute_force import coverage
from interferometer import darkened_disc

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables
from amibayes.detection.alternatives import (
    Alternative,
    ChromaticStar,
    _chromatic_star,
    _extended_light,
    alternative,
    symmetric_chi2,
)
from amibayes.detection.verdict import Verdict, without_companion
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.extended import Extended
from amibayes.pipeline.false_alarm import with_what_fits
from amibayes.units import MAS

Visibility = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
MODEL = BinaryModel(diameter_mas="free", smearing=False)


def observed(source: Visibility, seed: int, name: str = "pionier") -> Observables:
    """Data of a source with errors of 0.01 in V² and 0.5° in closure phase."""
    sheet = coverage(name, 0.01, np.radians(0.5))
    return interferometer.observed(sheet, source, np.random.default_rng(seed))


def chromatic(u: np.ndarray, v: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """A star 6 % larger in a molecular band."""
    band = np.exp(-0.5 * ((wavelength - 1.7e-6) / 0.05e-6) ** 2)
    x = 3.5 * (1.0 + 0.06 * band)
    return darkened_disc(1.0, 0.0, x * u, x * v) + 0j


def oval(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
    """A flattened star, seen past its first null."""
    along, across = 0.8 * u + 0.6 * v, 0.6 * (0.8 * v - 0.6 * u)
    return darkened_disc(4.5, 0.0, along, across) + 0j


def halo(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
    """A star with an inclined Gaussian disc of a tenth of its light."""
    across = (np.pi * MAS * 2.5) ** 2 * (u**2 + 0.3 * v**2) / (4.0 * np.log(2.0))
    return (darkened_disc(0.5, 0.0, u, v) + 0.1 * np.exp(-across)) / 1.1 + 0j


def binary(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
    """A star and a companion of 3 %."""
    shift = np.exp(-2j * np.pi * MAS * (4.0 * u - 3.0 * v))
    return (darkened_disc(0.5, 0.0, u, v) + 0.03 * shift) / 1.03


def faint(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
    """A star and a companion of 0.4 %."""
    shift = np.exp(-2j * np.pi * MAS * (4.0 * u - 3.0 * v))
    return (darkened_disc(0.5, 0.0, u, v) + 0.004 * shift) / 1.004


@pytest.mark.parametrize("seed", [2, 3, 4])
def test_a_disc_of_a_tenth_of_the_light_is_found_in_any_noise(seed: int) -> None:
    """No worse than the disc that it is; fits ended at one ten times as bright as the star."""
    result = search(Likelihood(observed(halo, seed), MODEL), (0.7, 10.0))
    disc = Extended("gaussian", "halo", smearing=False)
    wide = result.likelihood.with_model(replace(MODEL, companions=0, surroundings=(disc,)))
    truth = wide.chi2(np.array([[0.5, 0.1, 2.5, np.sqrt(0.3), 90.0]]))[0]
    assert _extended_light(result.likelihood, result).chi2 - 4.0 < truth


@pytest.mark.parametrize(
    ("source", "kind"),
    [
        (chromatic, "chromatic star"),
        (oval, "elongated star"),
        (halo, "extended light"),
        (binary, None),
    ],
)
def test_what_it_is_fits_as_well_as_a_companion(source: Visibility, kind: str | None) -> None:
    """The grey star is refused by each; only the binary needs its companion."""
    result = search(Likelihood(observed(source, 1), MODEL), (0.7, 10.0))
    n = result.likelihood.n_independent
    assert result.chi2_single > n + 3.0 * np.sqrt(2.0 * n)
    found = alternative(result)
    assert (None if found is None else found.kind) == kind
    if found is not None:
        assert abs(found.chi2 - n) < 4.0 * np.sqrt(2.0 * n)  # it is the true kind of source
    if found is not None and kind == "extended light":
        size, share, percent = map(float, re.findall(r"[\d.]+(?= mas| λ/B| %)", found.words))
        assert size == pytest.approx(2.5, rel=0.15)
        assert share * resolution_mas(result.likelihood) == pytest.approx(size, rel=0.06)
        assert percent == pytest.approx(10.0, rel=0.1)


@pytest.mark.parametrize(("source", "kind"), [(halo, "extended light"), (faint, None)])
@pytest.mark.parametrize("too_large", [3.0, pytest.param(1.0, marks=pytest.mark.slow)])
def test_errors_that_are_too_large_change_no_comparison(
    source: Visibility, kind: str | None, too_large: float
) -> None:
    """Of sources whose χ² differ by some tens in errors of the right size."""
    data = observed(source, 2)
    stated = replace(data, covariance=data.covariance.scaled(np.full(len(data.data), too_large)))
    found = alternative(search(Likelihood(stated, MODEL), (0.7, 10.0)))
    assert (None if found is None else found.kind) == kind


def swelling(u: np.ndarray, v: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
    """A source twice as large at one end of the band as at the other: no single star."""
    x = 1.2 * (1.0 + (wavelength - wavelength.min()) / np.ptp(wavelength))
    return darkened_disc(1.0, 0.0, x * u, x * v) + 0j


@pytest.mark.parametrize(("source", "plausible"), [(chromatic, True), (swelling, False)])
def test_a_star_that_changes_more_than_any_is_no_reason_for_no_companion(
    source: Visibility, plausible: bool
) -> None:
    result = search(Likelihood(observed(source, 1), MODEL), (0.7, 10.0))
    found = alternative(result)
    assert found is not None
    assert (found.kind, found.plausible) == ("chromatic star", plausible)
    first = Verdict("companion", "", 0.5)
    stated = without_companion(first, found, result).statement
    assert stated == ("no companion" if plausible else "model rejected")


def test_a_star_past_nulls_is_found_wherever_its_search_ends() -> None:
    """8 mas where the star beside the best "companion" has 4; as likely as the truth, or more."""

    def giant(u: np.ndarray, v: np.ndarray, wavelength: np.ndarray) -> np.ndarray:
        return chromatic(2.3 * u, 2.3 * v, wavelength)

    data = observed(giant, 3)
    likelihood = Likelihood(data, MODEL)
    result = search(likelihood, check=False)
    assert result.nuisance("diameter_mas") < 5.0
    found = _chromatic_star(likelihood, result)
    assert found is not None
    wavelengths = np.unique(data.vis2.wavelength_m)
    coloured = Likelihood(data, replace(MODEL, companions=0, contrast_slope="free"))
    truth = 8.05 * (1.0 + 0.06 * np.exp(-0.5 * ((wavelengths - 1.7e-6) / 0.05e-6) ** 2))
    left = ChromaticStar(coloured, wavelengths, 0.0, 0.0).difference(truth[:, None])
    assert found.chi2 < float((coloured.noise.whiten(left) ** 2).sum())
    low, high = map(float, re.findall(r"[\d.]+(?= mas| to)", found.words))
    assert [low, high] == pytest.approx([truth.min(), truth.max()], abs=0.15)


def test_slopes_of_a_chromatic_star_are_differences() -> None:
    likelihood = Likelihood(observed(chromatic, 1), replace(MODEL, contrast_slope="free"))
    wavelengths = np.asarray(likelihood.samples.wavelength_m)
    nodes = np.linspace(wavelengths.min(), wavelengths.max(), 4)
    star = ChromaticStar(likelihood, nodes, 0.2, 0.05)
    at = np.array([2.0, 2.1, 1.9, 2.3])
    step = 1e-4 * np.eye(len(at))
    up, down = (star.difference(at[:, None] + sign * step) for sign in (1.0, -1.0))
    np.testing.assert_allclose(star.slopes(at), (up - down) / 2e-4, atol=1e-4)


def test_closure_phases_of_a_symmetric_source_leave_their_noise() -> None:
    """χ² of independent closure phases, also where the source's are 180°; more for a binary."""
    flips = [symmetric_chi2(Likelihood(observed(chromatic, k), MODEL)) for k in range(20)]
    likelihood = Likelihood(observed(chromatic, 0), MODEL)
    closure = np.arange(likelihood.observables.n_vis2, len(likelihood.observables.data))
    rank = likelihood.noise.covariance.select(closure).rank
    assert abs(np.mean(flips) - rank) < 4.0 * np.sqrt(2.0 * rank / 20)
    assert symmetric_chi2(Likelihood(observed(binary, 0), MODEL)) > 2.0 * rank


def test_one_kind_of_data_has_no_alternative() -> None:
    data = observed(halo, 1)
    result = search(Likelihood(data.only("vis2"), MODEL), (0.7, 10.0))
    assert result.delta_chi2 > 40.0
    assert alternative(result) is None


@pytest.mark.parametrize("left", [0.7, 0.8])
def test_what_fits_far_better_than_a_model_that_is_rejected_is_named(left: float) -> None:
    rejected = Verdict("model rejected", "it does not fit", 0.0)
    other = Alternative("chromatic star", 100.0 * left, "a star that changes")
    said = with_what_fits(rejected, other, SimpleNamespace(chi2_binary=100.0))  # type: ignore[arg-type]
    better = "; a star that changes, fits better (χ² 70, with a companion 100)"
    assert said == replace(rejected, because="it does not fit" + (better if left < 0.75 else ""))
