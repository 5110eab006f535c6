"""Recovery: aliases where geometry puts them, and the search's own verdict on them."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.search import search
from amibayes.detection.statistic import BankStatistic, statistic_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.aliases import ambiguous, nearer_alias
from amibayes.limits.injection import recover
from amibayes.models.binary import BinaryModel
from amibayes.units import MAS, offset

LATTICE_MAS = 4.817e-6 / 1.14315 / MAS
"""The mask's holes lie on a lattice with columns 1.14315 m apart: the sky repeats, to the east."""


@pytest.fixture(scope="module")
def monochromatic() -> BankStatistic:
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1))
    likelihood = Likelihood(data, BinaryModel(1, smearing=False))
    return statistic_of(search(likelihood, (50.0, 600.0)), stated_errors=True)


def test_alias_stands_where_the_lattice_of_the_mask_puts_it(monochromatic) -> None:
    """Without the width of the band a companion and its alias predict the same to the last digit.

    A place 0.6 of the lattice's period to the east has its alias 0.4 to the west, nearer to
    the star; a place at 0.3 has it at 0.7, farther out.
    """
    fringe = resolution_mas(monochromatic.likelihood)
    places = np.array([[0.6 * LATTICE_MAS, 30.0], [0.3 * LATTICE_MAS, 30.0]])
    far, near = nearer_alias(monochromatic.bank, fringe, places)
    assert far > 0.997  # looked for on a lattice of λ/32B
    assert near < 0.9
    pair = np.array([[*places[0], 0.01], [places[0, 0] - LATTICE_MAS, 30.0, 0.01]])
    signals = monochromatic.signal_of(pair)
    # The last digits of the holes' coordinates are rounded.
    np.testing.assert_allclose(*signals.T, atol=2e-3 * np.abs(signals).max())


def test_alias_nearer_in_makes_a_companion_seen_but_not_found_at_its_place(monochromatic) -> None:
    theta = np.repeat([[0.6 * LATTICE_MAS, 30.0, 0.01], [0.3 * LATTICE_MAS, 30.0, 0.01]], 50, 0)
    rng = np.random.default_rng(3)
    found = recover(monochromatic, theta, 25.0, rng)
    assert found.detected.all()
    assert not found.located[:50].any()
    assert found.located[50:].all()


def test_opposite_place_counts_as_the_right_one_without_closure_phases() -> None:
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(1)).only(("vis2",))
    result = search(Likelihood(data), (50.0, 400.0))
    test = statistic_of(result, stated_errors=True)
    east, north = offset(200.0, np.random.default_rng(2).uniform(0.0, 360.0, 400))
    theta = np.column_stack([east, north, np.full(400, 0.02)])
    found = recover(test, theta, 25.0, np.random.default_rng(3))
    assert found.located.all()


@pytest.mark.parametrize(
    ("separation", "n"),
    [(200.0, 4), (480.0, 10), pytest.param(480.0, 200, marks=pytest.mark.slow)],
)
def test_the_search_itself_reports_what_recovery_says(separation: float, n: int) -> None:
    """Bright companions, noise and all, each searched in full: where is it reported?

    Places whose alias is as far from the star as they are go either way, by the noise: one
    in thirteen at 480 mas. The bound is 4.5 sigma of the count.
    """
    rng = np.random.default_rng(5)
    sheet = niriss()
    blank = search(Likelihood(simulated(sheet, [0.0, 0.0, 0.0], rng)), (50.0, 520.0))
    fringe = resolution_mas(blank.likelihood)
    east, north = offset(separation, rng.uniform(0.0, 360.0, n))
    theta = np.column_stack([east, north, np.full(n, 0.006)])
    nearer = nearer_alias(statistic_of(blank).bank, fringe, theta[:, :2])
    alike = 0
    for row, alias in zip(theta, nearer, strict=True):
        found = search(Likelihood(simulated(sheet, row, rng)), (50.0, 520.0))
        away = np.hypot(found.companion.east_mas - row[0], found.companion.north_mas - row[1])
        lost = ambiguous(np.array([alias]), np.array([found.delta_chi2]))[0]
        alike += bool(away < 0.5 * fringe) == (not lost)
    expected = 12.0 / 13.0
    assert alike >= n * expected - 4.5 * np.sqrt(n * expected * (1.0 - expected))


@pytest.mark.slow
def test_noise_does_not_move_a_companion_to_an_alias_farther_out() -> None:
    """Companions, noise and all, in the whole field: the limits count them as found at their place.

    The lattice of the mask gives each an alias beyond 390 mas, which the width of the band keeps
    about one standard deviation apart: by noise it fits better by more than 1 in 16 % of data.
    """
    rng = np.random.default_rng(8)
    sheet, n = niriss(), 100
    near = []
    for place in np.column_stack(offset(200.0, rng.uniform(0.0, 360.0, n))):
        found = search(Likelihood(simulated(sheet, [*place, 0.014], rng)), check=False)
        away = np.subtract((found.companion.east_mas, found.companion.north_mas), place)
        near.append(np.hypot(*away) < 0.5 * resolution_mas(found.likelihood))
    assert np.mean(near) > 0.95
