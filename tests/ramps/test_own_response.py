"""What single pixels do of their own, in ramps whose every pixel was bent by test code."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_fit import MOVING, TRUE, N, ramp_file

from amibayes.ramps.correction import MigrationFree
from amibayes.ramps.curvature import Curvature, curvature_of
from amibayes.ramps.fit import MigrationFit, fit_migration
from amibayes.ramps.own_response import own_response
from amibayes.units import FloatArray

SPREAD = 1.2e-6
"""Far more than linear ramps have: 60 integrations then tell it of tens of pixels."""
STILL = replace(MOVING, boundary_shift_x=0.0, boundary_shift_y=0.0)


def bends(seed: int) -> FloatArray:
    return SPREAD * np.random.default_rng([7, seed]).standard_normal((N, N))


def bent_file(seed: int, own: FloatArray, n_int: int = 60, n_groups: int = 6):  # type: ignore[no-untyped-def]
    """A current of F (1 + c Q): the charge itself is q + c q² / 2."""
    file = ramp_file(seed, n_int, n_groups, MOVING)
    reads = file.hdus["SCI"].section
    reads += 0.5 * own * reads**2
    return file


def bent(seed: int, own: FloatArray) -> Curvature:
    found = curvature_of(bent_file(seed, own))
    assert found is not None
    return found


@cache
def fitted(seed: int) -> MigrationFit:
    """Two exposures of one detector, dithered by what they jitter."""
    return fit_migration([bent(2 * seed, bends(seed)), bent(2 * seed + 1, bends(seed))])


def test_the_spread_comes_back() -> None:
    found = [fitted(k).own for k in range(4)]
    off = [(own.spread - SPREAD) / own.spread_error for own in found if own is not None]
    assert len(off) == 4
    assert np.abs(off).max() < 4.5
    assert all(fitted(k).pixels_differ for k in range(4))
    assert all(own is not None and own.spread_error < 0.25 * SPREAD for own in found)


def test_values_of_single_pixels_scatter_by_their_errors() -> None:
    pulls = []
    for k in range(4):
        own = fitted(k).own
        assert own is not None
        told = own.error < 0.8 * own.spread
        assert 10 < told.sum() < N * N
        pulls.append(((own.value - bends(k)) / own.error)[told])
    # A hundred numbers: rms to 7 %.
    rms = np.sqrt((np.concatenate(pulls) ** 2).mean())
    assert rms == pytest.approx(1.0, abs=0.35)


def test_coefficients_of_migration_know_of_them() -> None:
    off, narrow = [], []
    for k in range(4):
        fit = fitted(k)
        off.append((fit.migration.value[:2] - TRUE) / fit.migration.error[:2])
        plain = fit_migration(
            [replace(e, change=e.change - _bent_by(e, bends(k))) for e in fit.exposures]
        )
        assert not plain.pixels_differ
        narrow.append(plain.migration.error[0] / fit.migration.error[0])
    assert np.abs(off).max() < 4.5
    assert max(narrow) < 0.8


def _bent_by(exposure: Curvature, own: FloatArray) -> FloatArray:
    return np.asarray(own * exposure.gains[-1])


def test_slopes_are_nearer_to_those_of_even_pixels() -> None:
    own = bends(0)
    fit = fitted(0)
    even = ramp_file(0, 60, 6, MOVING).read().images.mean(axis=0)
    file = bent_file(0, own)
    plain = file.read().images.mean(axis=0)
    free = MigrationFree(file, replace(fit.migration, value=0.0 * fit.migration.value), 1.0,
                         own=fit.own).read().images.mean(axis=0)  # fmt: skip
    before, after = (np.sqrt(((image - even) ** 2).mean()) for image in (plain, free))
    assert after < 0.7 * before


def test_a_jump_that_was_not_flagged_is_no_linearity() -> None:
    """Three cosmic rays in faint pixels of sixty integrations of even ones."""
    file = ramp_file(77, 60, 6, MOVING)
    reads = file.hdus["SCI"].section
    for integration, row, column in ((3, 1, 2), (17, 30, 5), (40, 8, N - 2)):
        reads[integration, 3:, row, column] += 20_000.0
    found = curvature_of(file)
    assert found is not None
    fit = fit_migration([found])
    assert not fit.pixels_differ
    np.testing.assert_allclose(fit.migration.mean[0], TRUE, atol=5.0 * fit.migration.mean[1])


def test_even_pixels_are_left_alone() -> None:
    fits = [
        fit_migration([c for c in [curvature_of(ramp_file(50 + k, 20, 6, MOVING))] if c])
        for k in range(8)
    ]
    assert not any(f.pixels_differ for f in fits)
    assert all(f.own is not None and f.own.spread < 3.5 * f.own.spread_error for f in fits)


def test_numbers_of_a_known_spread() -> None:
    """One exposure of pixels of equal errors: the scatter less the noise, by hand."""
    rng = np.random.default_rng(3)
    gain, sigma = np.full((60, 60), 2e9), np.full((60, 60), 300.0)
    change = gain * SPREAD * rng.standard_normal((60, 60)) + sigma * rng.standard_normal((60, 60))
    found = own_response([change], [gain], [sigma])
    by_hand = np.sqrt(
        (change / gain).var() + (change / gain).mean() ** 2 - (sigma / gain)[0, 0] ** 2
    )
    assert found.spread == pytest.approx(by_hand, rel=1e-3)
    assert found.spread_error == pytest.approx(SPREAD / np.sqrt(2 * 3600), rel=0.3)
    lost = own_response([change], [gain], [np.full((60, 60), np.inf)])
    assert lost.spread == 0.0
    assert lost.p_value == 1.0
