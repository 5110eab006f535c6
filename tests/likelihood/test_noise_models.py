"""Noise models against textbook densities, and what a likelihood keeps when one is exchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.data.degrees_of_freedom import Freedom
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import EstimatedNoise, GaussianNoise, noise_of
from amibayes.models.binary import BinaryModel

TRUTH = np.array([150.0, -80.0, 0.02])


def test_gaussian_noise_is_scipys_normal_density(rng) -> None:
    data = simulated(niriss(covariance="diagonal"), TRUTH, rng)
    likelihood = Likelihood(data)
    residual = likelihood.difference([TRUTH, [120.0, -60.0, 0.03]])
    expected = stats.multivariate_normal(cov=data.covariance.dense()).logpdf(residual.T)
    np.testing.assert_allclose(noise_of(data).log_prob(residual), expected, rtol=1e-10)
    np.testing.assert_allclose(
        likelihood.log_prob([TRUTH, [120.0, -60.0, 0.03]]), expected, rtol=1e-10
    )


def test_estimated_noise_is_scipys_t_density_and_its_draws_have_its_covariance(rng) -> None:
    data = replace(niriss(covariance="diagonal"), freedom=Freedom(12.0, 10.0))
    noise = noise_of(data)
    residual = noise.draw(20_000, rng)
    shape = data.covariance.dense() * 10.0 / 12.0
    expected = stats.multivariate_t(shape=shape, df=12.0).logpdf(residual[:, :20].T)
    np.testing.assert_allclose(noise.log_prob(residual[:, :20]), expected, rtol=1e-9)
    white = noise.whiten(residual)
    # Kurtosis of t with 12 degrees makes the variance's error √(2.75/n).
    assert np.abs((white**2).mean(axis=1) - 1.0).max() < 5.0 * np.sqrt(2.75 / 20_000)


@pytest.mark.parametrize("freedom", [None, Freedom(20.0, 15.0)])
def test_gain_and_loss_are_each_others_inverse(freedom) -> None:
    noise = noise_of(replace(niriss(), freedom=freedom))
    gain = np.array([0.1, 3.0, 40.0])
    np.testing.assert_allclose(noise.log_loss(noise.delta_chi2(gain)), gain, rtol=1e-10)


def test_a_likelihood_with_other_noise_or_model_is_built_like_any_other(rng) -> None:
    data = simulated(niriss(), TRUTH, rng)
    likelihood = Likelihood(data)
    wider = GaussianNoise(niriss(0.02, 1.0).covariance)
    other = likelihood.with_noise(wider)
    assert other.chi2(TRUTH)[0] == pytest.approx(
        Likelihood(replace(data, covariance=wider.covariance)).chi2(TRUTH)[0]
    )
    estimated = EstimatedNoise(wider.covariance, Freedom(30.0, 25.0))
    kept = likelihood.with_noise(estimated).with_model(BinaryModel(2))
    assert kept.noise is estimated
    assert kept.degrees == 30.0
    assert kept.samples is likelihood.samples
