"""Expected errors of faint integrations, against closed forms and against drawn photons."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from conftest import script

from amibayes.extraction.fourier.low_flux import _pairs, _triples
from amibayes.extraction.fourier.sampling import OneEach
from amibayes.instrument import load_instrument

faint = script("extraction_faint")

MASK = load_instrument("niriss", "F430M").mask


def bare_sampling() -> OneEach:
    """Pixels that are the numbers: flux, 21 real parts, 21 imaginary parts."""
    return OneEach.of(np.eye(43, 44), MASK, MASK.uv_m)


@pytest.mark.parametrize("relative", [0.01, 1.0, 10.0])
def test_independent_fringes_have_the_closed_form(relative: float) -> None:
    """Var Im(T/T̄) = ½[(1 + ν)³ − 1] and Var V² = 2ν + ν², ν noise power over signal power."""
    rng = np.random.default_rng(1)
    samples = np.exp(2j * np.pi * rng.random(21))
    variance = np.full(43, relative / 2.0)
    variance[0] = 0.0
    found = bare_sampling().expected_covariance(1.0, samples, variance, np.zeros(43))
    variances = np.diag(found)
    np.testing.assert_allclose(variances[:21], 2.0 * relative + relative**2, rtol=1e-12)
    np.testing.assert_allclose(variances[21:], 0.5 * ((1.0 + relative) ** 3 - 1.0), rtol=1e-12)
    # Triangles that share a baseline have its noise in common, and nothing else.
    shared = found[21:, 21:][~np.eye(35, dtype=bool)]
    expected = np.unique(np.round(np.abs(shared) / relative, 9))
    np.testing.assert_allclose(expected, [0.0, 0.5])


@pytest.mark.parametrize("third", [0.0, 0.002, -0.002])
def test_noise_of_the_flux_moves_all_v2_together(third: float) -> None:
    """Cov = P P′ Var (1 + x)² for a flux of 1 + x; closure phases do not know of it.

    P are V², and x has a variance of σ² and a third cumulant:
    Var (2x + x²) is 4σ² + 4κ₃ + 2σ⁴ but for a fourth.
    """
    rng = np.random.default_rng(2)
    samples = rng.uniform(0.2, 1.0, 21) * np.exp(2j * np.pi * rng.random(21))
    variance, skewness = np.zeros(43), np.zeros(43)
    variance[0], skewness[0] = 0.02, third
    found = bare_sampling().expected_covariance(1.0, samples, variance, skewness)
    power = np.abs(samples) ** 2
    expected = np.outer(power, power) * (4.0 * 0.02 + 4.0 * third + 2.0 * 0.02**2)
    np.testing.assert_allclose(found[:21, :21], expected, rtol=1e-5)
    np.testing.assert_allclose(found[21:], 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "method", ["fringes", *(pytest.param(m, marks=pytest.mark.slow) for m in ("matched", "unique"))]
)
@pytest.mark.parametrize(("photons", "read_noise"), [(300.0, 0.0), (8000.0, 21.0)])
def test_drawn_photons_scatter_as_expected(
    method: str, photons: float, read_noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    if read_noise > 0.0:
        monkeypatch.setattr(faint, "DRAWS", 1500)
    full, first = faint.ratios(method, photons, read_noise, np.random.default_rng(11))
    for part in (faint.VIS2, faint.CLOSURE):
        # A variance of 3000 draws to 2.6 %, more where the third order has long tails, and the
        # mean of 21 or 35 of them to 1 %. What is left out of photons is 4 % at 300 of them;
        # nothing at 8000, for which 1.4 % of half as many draws will do.
        assert np.mean(full[part]) == pytest.approx(1.0, abs=0.08)
        assert np.mean(first[part]) > (1.05 if read_noise == 0.0 else 1.12)


def test_noise_of_real_parts_alone_is_that_of_draws() -> None:
    """Noise that is not round, of a third of the signal: variances of 60 000 bispectra."""
    rng = np.random.default_rng(3)
    samples = np.exp(2j * np.pi * rng.random(21))
    variance = np.r_[0.0, np.full(21, 0.1), np.full(21, 0.02)]
    found = bare_sampling().expected_covariance(1.0, samples, variance, np.zeros(43))
    noise = rng.standard_normal((60_000, 42)) * np.sqrt(variance[1:])
    drawn = samples + noise[:, :21] + 1j * noise[:, 21:]
    ij, jk, ik = MASK.triangle_baselines.T
    product = drawn[:, ij] * drawn[:, jk] * drawn[:, ik].conj()
    closure = (product / (samples[ij] * samples[jk] * samples[ik].conj())).imag
    # A variance to 0.6 %, more for what is not Gaussian; the covariance of two to 1 % of it.
    expected = np.cov(closure.T)
    np.testing.assert_allclose(found[21:, 21:], expected, atol=0.06 * expected.max())


def test_pairs_and_triples_of_legs_are_those_of_all_their_orders(rng: np.random.Generator) -> None:
    """Sums written out over the legs of 4 triangles with those of 5: the latter is a permanent."""
    means = rng.standard_normal((3, 4, 3, 5)) + 1j * rng.standard_normal((3, 4, 3, 5))
    orders = list(permutations(range(3)))
    three = sum(np.prod([means[p, :, q] for p, q in enumerate(order)], axis=0) for order in orders)
    np.testing.assert_allclose(_triples(means), three)
    two = sum(
        means[p, :, q] * means[p + more, :, other]
        for p in range(3)
        for more in range(1, 3 - p)
        for q, other in permutations(range(3), 2)
    )
    np.testing.assert_allclose(_pairs(means), two)
