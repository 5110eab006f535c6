"""The search against brute force: many fits of the same model by another optimiser.

Coverages of PIONIER, GRAVITY, MIRC with four and six telescopes, and NIRISS; contrasts from 0.001
to 1, separations to the edge of the field, stars resolved or not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers import niriss
from scipy import optimize

from amibayes.companion_search.field import default_separation, resolution_mas
from amibayes.companion_search.search import search
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.binary import BinaryModel

AT = np.array([[0.0, 0.0], [52.0, 18.0], [10.0, 112.0], [-44.0, 66.0]])
UT = np.array([[0.0, 0.0], [25.0, 51.0], [55.0, 86.0], [113.0, 64.0]])
CHARA = np.array([[0, 0], [-8, 34], [125, 306], [70, 270], [-176, 216], [-69, 200]], dtype=float)

SMALL = 1e-3
"""A worse fit by less comes from where two optimisers stop."""


def exposures(
    stations: np.ndarray, wavelengths: np.ndarray, turns: tuple[float, ...], errors: tuple
) -> Observables:
    """Several exposures of an array that the sky turns over, narrow channels, no noise."""
    band = float(np.diff(wavelengths).mean())
    parts = []
    for k, turn in enumerate(turns):
        c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
        turned = stations @ np.array([[c, -s], [s, c]]) * (1.0 - 0.04 * k)
        parts.append(
            point_source(
                turned, wavelengths, band, vis2_error=errors[0], closure_error_rad=errors[1]
            )
        )
    return join(parts)


def coverage(name: str, vis2_error: float, closure_error_rad: float) -> Observables:
    """One of the five coverages."""
    errors = vis2_error, closure_error_rad
    if name == "niriss":
        return niriss(vis2_error, float(np.degrees(closure_error_rad)))
    stations, wavelengths, turns = {
        "pionier": (AT, np.linspace(1.53e-6, 1.77e-6, 4), (0.0, 20.0, 45.0)),
        "gravity": (UT, np.linspace(2.0e-6, 2.4e-6, 8), (0.0, 25.0)),
        "mirc4t": (CHARA[[0, 2, 4, 5]], np.linspace(1.5e-6, 1.75e-6, 6), (0.0, 30.0)),
        "mirc6t": (CHARA, np.linspace(1.5e-6, 1.75e-6, 4), (0.0,)),
    }[name]
    return exposures(stations, wavelengths, turns, errors)


@dataclass(frozen=True)
class Case:
    """Noisy data of one binary."""

    likelihood: Likelihood
    truth: np.ndarray


def case(name: str, seed: int) -> Case:
    """A binary drawn at random: log-uniform contrast, uniform in area, star resolved or not."""
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    errors = 10.0 ** rng.uniform(-2.7, -1.3), 10.0 ** rng.uniform(-2.7, -1.3)
    sheet = coverage(name, *errors)
    free = Likelihood(sheet, BinaryModel(diameter_mas="free"))
    inner, outer = default_separation(free)
    rho = np.sqrt(rng.uniform(inner**2, outer**2))
    angle, contrast = rng.uniform(0.0, 2.0 * np.pi), 10.0 ** rng.uniform(-3.0, 0.0)
    resolved = name != "niriss" and rng.random() < 0.5
    diameter = resolved * rng.uniform(0.2, 1.0) * resolution_mas(free)
    truth = np.array([rho * np.sin(angle), rho * np.cos(angle), contrast, diameter])
    data = free.predict([truth])[:, 0] + sheet.covariance.draw(rng, 1)[:, 0]
    model = free.model if name != "niriss" else BinaryModel()
    vis2, closure = np.split(data, [sheet.n_vis2])
    noisy = replace(
        sheet,
        vis2=replace(sheet.vis2, value=vis2),
        closure_phase=replace(sheet.closure_phase, value=closure),
    )
    return Case(Likelihood(noisy, model), truth)


def brute_force(case: Case, starts: int, rng: np.random.Generator) -> float:
    """Least χ² of fits by Levenberg and Marquardt from the truth and from many other points."""
    likelihood = case.likelihood
    inner, outer = default_separation(likelihood)
    n = len(likelihood.parameters)
    rho = np.sqrt(rng.uniform(inner**2, outer**2, 40 * starts))
    angle = rng.uniform(0.0, 2.0 * np.pi, len(rho))
    tried = np.zeros((len(rho), n))
    tried[:, :2] = np.column_stack([rho * np.sin(angle), rho * np.cos(angle)])
    tried[:, 2] = 10.0 ** rng.uniform(-3.0, 0.0, len(rho))
    tried[:, 3:] = rng.choice([0.0, 0.4, 0.8, case.truth[3]], len(rho))[:, None]
    order = np.argsort(likelihood.chi2(tried))[:starts]
    points = np.vstack([case.truth[:n], tried[order]])
    fits = [_fit(likelihood, x, inner, outer) for x in points]
    return min(fits)


def _fit(likelihood: Likelihood, start: np.ndarray, inner: float, outer: float) -> float:
    low = np.array([-outer, -outer, 0.0, 0.0])[: len(start)]
    high = np.array([outer, outer, 1.0, likelihood.parameters[-1].upper])[: len(start)]
    found = optimize.least_squares(
        lambda x: likelihood.residuals(x)[:, 0],
        np.clip(start, low + 1e-9, high - 1e-9),
        jac=lambda x: -likelihood.jacobian(x),
        bounds=(low, high),
        x_scale="jac",
        max_nfev=60,
    )
    # A point outside the annulus is not one that the search was asked for.
    inside = inner <= np.hypot(*found.x[:2]) <= outer
    return float(2.0 * found.cost) if inside else np.inf


def excess(case: Case, starts: int, seed: int) -> float:
    """By how much the search's χ² is above that of brute force."""
    result = search(case.likelihood)
    best = brute_force(case, starts, np.random.default_rng(seed))
    single = single_likelihood(case.likelihood).chi2(result.single_theta[None])[0]
    return float(result.chi2_binary - min(best, single))


COVERAGES = ("pionier", "gravity", "mirc4t", "mirc6t", "niriss")


@pytest.mark.parametrize("name", COVERAGES)
@pytest.mark.parametrize("seed", range(3))
def test_no_fit_is_better_than_the_search_by_more_than_1(name: str, seed: int) -> None:
    assert excess(case(name, seed), 6, seed) < 1.0


@pytest.mark.parametrize(
    "n", [pytest.param(10, marks=pytest.mark.slow), pytest.param(60, marks=pytest.mark.release)]
)
@pytest.mark.parametrize("name", COVERAGES)
def test_no_fit_of_many_is_better_than_the_search_by_more_than_1(name: str, n: int) -> None:
    """10 or 60 binaries of each coverage, each with as many starts."""
    found = [excess(case(name, seed), n, seed) for seed in range(100, 100 + n)]
    assert max(found) < 1.0


def test_bright_companion_of_a_resolved_star_whose_size_alone_is_far_off() -> None:
    """Contrast 0.68, star of 2.1 mas, which alone would be fitted with 7.1 mas."""
    assert excess(case("pionier", 107), 4, 107) < 1.0
