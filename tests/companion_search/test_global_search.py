"""The search against brute force: many fits of the same model by another optimiser.

Coverages of PIONIER, GRAVITY, MIRC with four and six telescopes, and NIRISS; contrasts from 0.001
to 1, separations to the edge of the field and to where channels smear a companion out, star and
companion resolved or not. `docs/global_search.py` does the same with 300 binaries.
"""

from __future__ import annotations

import numpy as np
import pytest
from brute_force import COVERAGES, Case, case, compared

from amibayes.companion_search.exact_map import LADDER


def excess(drawn: Case, starts: int, seed: int) -> float:
    """By how much the search's χ² is above that of brute force."""
    return compared(drawn, starts, np.random.default_rng(seed)).excess


@pytest.mark.parametrize("name", COVERAGES)
@pytest.mark.parametrize("seed", [0, *(pytest.param(s, marks=pytest.mark.slow) for s in (1, 2))])
def test_no_fit_is_better_than_the_search_by_more_than_1(name: str, seed: int) -> None:
    assert excess(case(name, seed, disc=seed == 1), 40, seed) < 1.0


@pytest.mark.slow
@pytest.mark.parametrize("disc", [False, True])
@pytest.mark.parametrize("smeared", [False, True])
@pytest.mark.parametrize("name", COVERAGES)
def test_no_fit_of_many_is_better_than_the_search_by_more_than_1(
    name: str, smeared: bool, disc: bool
) -> None:
    for seed in range(100, 104):
        assert excess(case(name, seed, smeared=smeared, disc=disc), 200, seed) < 1.0, seed


def test_bright_companion_of_a_resolved_star_whose_size_alone_is_far_off() -> None:
    """Contrast 0.68, star of 2.1 mas, which alone would be fitted with 7.1 mas."""
    assert excess(case("pionier", 107), 40, 107) < 1.0


@pytest.mark.parametrize("seed", [1054, 1055])
def test_bright_companion_among_many_places_that_look_alike(seed: int) -> None:
    """NIRISS to 3 arcsec: forty places are nearly aliases, and disc and smearing look alike."""
    assert excess(case("niriss", seed, smeared=True, disc=True), 40, seed) < 1.0


def test_contrasts_of_the_exact_map_rise_in_steps_that_a_fit_closes() -> None:
    """Of ln c/(1 + c), by which data change; up to nearly equal stars."""
    steps = np.diff(np.log(np.array(LADDER) / (1.0 + np.array(LADDER))))
    assert (steps > 0.0).all()
    assert steps.max() < 1.0
    assert 0.9 < LADDER[-1] < 1.0
