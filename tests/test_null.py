"""The reported false-alarm probability of noise made elsewhere is uniform."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss
from noise_maker import Recipe
from scipy import linalg, stats

from amibayes.closure import closure_matrix, kernel_basis
from amibayes.covariance import dense_covariance
from amibayes.extraction.shrinkage import shrunk_covariance
from amibayes.freedom import Freedom
from amibayes.inference.bank import TemplateBank, make_grid
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.model import BinaryModel
from amibayes.inference.redraw import drawn_estimates, search_simulated
from amibayes.inference.significance import bank_statistic, null_maxima, significance
from amibayes.observables import Observables

FIELD = (50.0, 400.0)
GAINS = Recipe(gain=0.004)
UNEVEN = Recipe(
    phase=np.radians(0.17) * np.exp(np.random.default_rng(3).normal(0.0, 0.4, 21)), gain=0.002
)


def bank_of(data: Observables, step_mas: float) -> TemplateBank:
    return TemplateBank(Likelihood(data), make_grid(*FIELD, step_mas), np.empty(0))


def basis_of(data: Observables) -> np.ndarray:
    closures = kernel_basis(closure_matrix(data.closure_phase.stations)[0])
    return linalg.block_diag(np.eye(data.n_vis2), closures)


def probabilities(
    kind: str, n: int, rng: np.random.Generator, *, free_scale: bool, step_mas: float = 23.5
) -> np.ndarray:
    """Reported probabilities of n null data sets whose covariance is known."""
    sheet = niriss(covariance="diagonal" if kind == "diagonal" else "assumed")
    if kind == "given":
        matrix = dense_covariance(GAINS.covariance(), basis_of(sheet))
        sheet = replace(sheet, covariance=matrix, covariance_kind="given")
    if kind == "kernel":
        sheet = sheet.only(("cp",))
    noise = {"diagonal": Recipe(), "given": GAINS}.get(kind, Recipe()).draw(rng, n)
    if kind == "diagonal":
        noise[21:] = rng.normal(0.0, np.radians(0.3), (35, n))
    bank = bank_of(sheet, step_mas)
    white = sheet.covariance.whiten(noise[-sheet.covariance.size :])
    found = bank_statistic(bank, white, free_scale=free_scale)
    null = np.sort(null_maxima(bank, 20_000, rng, free_scale=free_scale))
    return (1 + len(null) - np.searchsorted(null, found)) / (1 + len(null))


def estimated(
    n: int,
    rng: np.random.Generator,
    recipe: Recipe,
    n_integrations: int,
    kinds: tuple[str, ...],
    step_mas: float = 31.0,
    draws: int = 1000,
) -> np.ndarray:
    """Reported probabilities (n, 2), each with its own covariance; errors on trust or not.

    The expected noise of the extraction is that of even baselines and steady holes.
    """
    sheet = niriss().only(kinds)
    basis, used = basis_of(sheet), np.arange(56)[-sheet.covariance.size :]
    expected = Recipe().covariance()[np.ix_(used, used)]
    out = np.empty((n, 2))
    for k in range(n):
        sample = recipe.draw(rng, n_integrations)[used]
        mean = sample.mean(axis=1)
        found = shrunk_covariance((sample - mean[:, None]).T, expected, basis, sheet.n_vis2)
        covariance = dense_covariance(found.matrix / n_integrations, basis)
        bank = bank_of(replace(sheet, covariance=covariance, freedom=found.carried), step_mas)
        for j, free in enumerate((False, True)):
            statistic = bank_statistic(bank, covariance.whiten(mean)[:, None], free_scale=free)
            weight = significance(bank, float(statistic[0]), draws, rng, 0.05, free_scale=free)
            out[k, j] = weight.probability
    return out


def check(p: np.ndarray, least: float, low: float = 0.01) -> None:
    """Kolmogorov–Smirnov, and the rate below ``low`` against binomial chance."""
    assert stats.kstest(p, "uniform").pvalue > least
    hits = int((p < low).sum())
    assert stats.binomtest(hits, len(p), low).pvalue > least, hits


KNOWN = ["kernel", "assumed", "diagonal", "given"]


@pytest.mark.parametrize("free_scale", [False, True])
@pytest.mark.parametrize("kind", KNOWN)
def test_probability_is_uniform_in_400_null_sets(kind: str, free_scale: bool) -> None:
    rng = np.random.default_rng([1, KNOWN.index(kind), free_scale])
    check(probabilities(kind, 400, rng, free_scale=free_scale, step_mas=31.0), 1e-4, 0.05)


def test_probability_is_uniform_with_estimated_covariance() -> None:
    """100 sets of 50 integrations, 15 kernel phases of uneven baselines."""
    p = estimated(100, np.random.default_rng(2), UNEVEN, 50, ("cp",), step_mas=47.0, draws=400)
    for column in p.T:
        check(column, 1e-4, 0.1)


@pytest.mark.slow
@pytest.mark.parametrize("free_scale", [False, True])
@pytest.mark.parametrize("kind", KNOWN)
def test_probability_is_uniform_in_2000_null_sets(kind: str, free_scale: bool) -> None:
    rng = np.random.default_rng([3, KNOWN.index(kind), free_scale])
    check(probabilities(kind, 2000, rng, free_scale=free_scale), 0.01)


@pytest.mark.slow
def test_probability_is_uniform_where_the_expected_noise_is_right() -> None:
    """1000 null sets of N = 0.6 p integrations whose noise is as physics expects."""
    rng = np.random.default_rng(4)
    p = estimated(1000, rng, Recipe(), 20, ("vis2", "cp"), step_mas=60.0, draws=400)
    for column in p.T:
        check(column, 0.01)


@pytest.mark.slow
def test_false_alarms_stay_rare_where_the_expected_noise_is_wrong() -> None:
    """2000 null sets of N = 3.3 p integrations, baselines uneven by 0.4 in ln σ, expected even.

    Measured with 1000: P(p < 0.5), 0.1, 0.05, 0.01 = 0.58, 0.11, 0.059, 0.016. The wrong
    expectation keeps a fifth of the weight, so the probability is not uniform, but its tail
    is right within a factor of two.
    """
    rng = np.random.default_rng(5)
    p = estimated(2000, rng, UNEVEN, 50, ("cp",), step_mas=60.0, draws=400)
    for column in p.T:
        for level, factor in ((0.05, 1.5), (0.01, 2.0)):
            hits = int((column < level).sum())
            allowed = stats.binomtest(hits, 2000, factor * level, alternative="greater")
            assert allowed.pvalue > 1e-4, (level, hits)


@pytest.mark.parametrize("freedom", [Freedom(60.0, 30.0), Freedom(30.0, 26.0), Freedom(25.0, 44.0)])
def test_simulated_data_have_the_distribution_of_the_likelihood(freedom: Freedom) -> None:
    """χ² ν/((ν − 2) p) of data and estimate is F(p, ν), whether there was a prior or not.

    With a scatter of m = ν + p − 1 and no prior it is Hotelling's theorem.
    """
    rng = np.random.default_rng(5)
    p = 20
    factors, estimates = drawn_estimates(4000, p, freedom, rng)
    data = factors @ rng.standard_normal((4000, p, 1))
    chi2 = (data.swapaxes(1, 2) @ np.linalg.solve(estimates, data)).ravel()
    nu = freedom.degrees
    law = stats.f(p, nu)
    assert stats.kstest(chi2 * nu / ((nu - 2.0) * p), law.cdf).pvalue > 1e-4


def test_each_data_set_is_searched_with_its_own_covariance() -> None:
    """Against a bank made of each estimate, nuisance directions and all."""
    rng = np.random.default_rng(6)
    sheet = replace(niriss(), freedom=Freedom(70.0, 40.0))
    model = BinaryModel(background="free")
    grid = make_grid(*FIELD, 31.0)
    bank = TemplateBank(Likelihood(sheet, model), grid, np.array([0.05]))
    size, n = bank.n_data, 4
    noise, signal = rng.standard_normal((2, size, n))
    found = search_simulated(bank, noise, np.random.default_rng(7), signal)
    factors, estimates = drawn_estimates(n, size, Freedom(70.0, 40.0), np.random.default_rng(7))
    for k in range(n):
        white = signal[:, k] + factors[k] @ noise[:, k]
        # The whitening rows of the sheet are V², then closures: its own factor undoes them.
        colour = np.linalg.pinv(sheet.covariance.whitening.toarray())
        matrix = colour @ estimates[k] @ colour.T
        own = replace(sheet, covariance=dense_covariance(matrix, basis_of(sheet)), freedom=None)
        other = TemplateBank(Likelihood(own, model), grid, np.array([0.05]))
        data = other.project(own.covariance.whiten(colour @ white))
        gain, where = other.largest_gain(data.astype(np.float32)[:, None])
        assert found.gain[k] == pytest.approx(gain[0], rel=1e-3)
        assert found.chi2[k] == pytest.approx((data**2).sum(), rel=1e-6)
        assert found.position[k] == where[0]
