"""The posterior: its width, its coverage, its resumption and its honesty."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import emcee
import numpy as np
import pytest
from helpers import niriss, simulated
from scipy.integrate import cumulative_simpson

from amibayes.companion_search.search import search
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.ensemble import sample
from amibayes.posterior.priors import Prior, Range, default_prior

FIELD = (50.0, 400.0)


@pytest.fixture(scope="module")
def found():
    data = simulated(niriss(), [150.0, -80.0, 0.03], np.random.default_rng(8))
    return search(Likelihood(data), FIELD)


def run(found, seed: int = 3, **options):
    prior = default_prior(found.likelihood, *FIELD)
    return sample(found, prior, np.random.default_rng(seed), **options)


def test_strong_companion_has_the_gaussian_of_its_fisher_matrix(found) -> None:
    """Width within 5 sigma of the samples' own error, centre within a third of a sigma.

    At a signal of 80 sigma the posterior is Gaussian to a per cent.
    """
    posterior = run(found)
    assert posterior.converged
    assert posterior.split_rhat < 1.02
    assert posterior.n_steps > 50 * posterior.autocorrelation_time
    n = posterior.n_effective
    for name in ("east_mas", "north_mas", "contrast", "separation_mas", "position_angle_deg"):
        median, low, high = posterior.interval(name, 0.6827)
        stem = name.removesuffix("_mas").removesuffix("_deg")
        error = getattr(found.companion, name.replace(stem, f"{stem}_error"))
        assert abs(median - getattr(found.companion, name)) < error * (0.1 + 5 * 1.25 / np.sqrt(n))
        assert 0.5 * (high - low) == pytest.approx(error, rel=0.03 + 5 * 1.2 / np.sqrt(n))


def test_chain_is_readable_by_emcee_and_goes_on_after_a_kill(found, tmp_path: Path) -> None:
    whole = run(found, path=tmp_path / "whole.h5")
    backend = emcee.backends.HDFBackend(tmp_path / "whole.h5", name="mcmc", read_only=True)
    assert backend.get_chain().shape == (whole.n_steps, 32, 3)

    class KilledError(Exception):
        pass

    def kill(done: int, expected: int) -> None:
        raise KilledError

    with pytest.raises(KilledError):
        run(found, path=tmp_path / "cut.h5", progress=kill)
    again = run(found, path=tmp_path / "cut.h5", resume=True)
    np.testing.assert_array_equal(again.samples, whole.samples)
    other = run(found, seed=4, path=tmp_path / "cut.h5", resume=True)
    assert not np.array_equal(other.samples[: len(whole.samples)], whole.samples)


def test_chain_that_cannot_be_continued_is_named(found, tmp_path: Path) -> None:
    (tmp_path / "bad.h5").write_text("not a chain")
    with pytest.raises(DataError, match=r"bad\.h5: is not a chain"):
        run(found, path=tmp_path / "bad.h5", resume=True)


def test_short_chain_is_said_not_to_have_converged(found) -> None:
    posterior = run(found, max_steps=500)
    assert not posterior.converged
    assert "NOT converged" in repr(posterior)


def test_position_angle_across_north_is_one_interval() -> None:
    data = simulated(niriss(), [0.5, 200.0, 0.03], np.random.default_rng(8))
    posterior = run(search(Likelihood(data), FIELD))
    median, low, high = posterior.interval("position_angle_deg")
    assert 0.0 <= median < 360.0
    assert low < median < high
    assert high - low < 3.0


def test_posterior_of_noise_fills_the_prior_at_faint_contrast() -> None:
    data = simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(8))
    posterior = run(search(Likelihood(data), FIELD))
    _, _, upper = posterior.interval("delta_mag", 0.95)
    assert upper > 11.0
    assert posterior.column("separation_mas").max() <= 400.0
    assert posterior.column("separation_mas").min() >= 50.0


def test_strong_aliases_are_weighed_and_the_reported_one_is_sampled() -> None:
    data = simulated(niriss(), [150.0, -80.0, 0.01], np.random.default_rng(1))
    found = search(Likelihood(data))
    assert len(found.modes) > 1
    prior = default_prior(found.likelihood, found.grid.inner_mas, found.grid.outer_mas)
    posterior = sample(found, prior, np.random.default_rng(3))
    assert posterior.converged
    assert posterior.column("separation_mas").std() < 10.0
    assert posterior.mode_probability.sum() == pytest.approx(1.0)
    assert posterior.mode_probability[0] < 0.9


def test_prior_is_normalised(rng) -> None:
    """Its integral over a box around it is 1 (Monte Carlo, 5 sigma)."""
    prior = Prior(50.0, 400.0, 1e-4, 0.5, nuisance=((0.0, 2.0),))
    n = 200_000
    x = np.column_stack(
        [rng.uniform(-400, 400, (n, 2)), rng.uniform(-12, 0, n), rng.uniform(-1, 3, n)]
    )
    box = 800.0**2 * 12.0 * 4.0
    density = np.exp(prior.log_density(x)) * box
    assert abs(density.mean() - 1.0) < 5.0 * density.std() / np.sqrt(n)


def test_convergence_is_reported_by_parameter(found) -> None:
    posterior = run(found)
    lines = posterior.convergence()
    assert set(lines) == set(posterior.names)
    assert max(x["split_rhat"] for x in lines.values()) == posterior.split_rhat
    longest = max(x["autocorrelation_time"] for x in lines.values())
    assert longest == posterior.autocorrelation_time
    fewest = min(x["n_effective"] for x in lines.values())
    assert int(fewest) == posterior.n_effective


def test_inference_data_is_the_chain_after_burn_in(found) -> None:
    arviz = pytest.importorskip("arviz", exc_type=ImportError)
    posterior = run(found)
    data = posterior.to_inference_data()
    east = np.asarray(data["posterior"]["east_mas"])
    np.testing.assert_array_equal(east.T, posterior.chain[posterior.n_burn :, :, 0])
    assert data["sample_stats"]["lp"].shape == east.shape
    rhat = float(np.asarray(arviz.rhat(data)["east_mas"]))
    assert 0.99 < rhat < 1.05


def test_inference_data_without_arviz_says_what_to_install(found, monkeypatch) -> None:
    posterior = run(found)
    monkeypatch.setitem(sys.modules, "arviz", None)
    with pytest.raises(UsageError, match=r"pip install 'amibayes\[arviz\]'"):
        posterior.to_inference_data()


RANGES = {
    "uniform": (Range(-0.5, 2.0), lambda x: np.ones_like(x)),
    "half-Cauchy": (Range(0.3, 4.0, 0.7), lambda x: 1.0 / (1.0 + (x / 0.7) ** 2)),
    "logarithmic": (Range(0.2, 9.0, logarithmic=True), lambda x: 1.0 / x),
}


@pytest.mark.parametrize("name", RANGES)
def test_laws_of_ranges_are_integrals_of_their_densities(name: str) -> None:
    law, shape = RANGES[name]
    x = np.linspace(law.low, law.high, 20_001)
    total = cumulative_simpson(shape(x), x=x, initial=0.0)
    np.testing.assert_allclose(law.cdf(x), total / total[-1], atol=1e-8)
    np.testing.assert_allclose(law.log_density(x), np.log(shape(x) / total[-1]), atol=1e-8)
    np.testing.assert_allclose(law.quantile(law.cdf(x)), x, rtol=1e-9)
    beyond = np.array([law.low - 0.1, law.high + 0.1])
    np.testing.assert_array_equal(law.cdf(beyond), [0.0, 1.0])
    assert np.isneginf(law.log_density(beyond)).all()


def test_a_prior_is_described_by_all_that_it_has() -> None:
    plain = Prior(50.0, 400.0, 1e-4, 0.5)
    assert plain.description == "uniform in area, log-uniform in contrast"
    other = replace(plain, position_form="separation", contrast_form="uniform")
    assert other.description == "uniform in separation and angle, uniform in contrast"
    more = replace(
        plain,
        n_contrasts=3,
        fastest_mas_yr=20.0,
        nuisance=((0.0, 4.0), (0.0, 1.0)),
        half_cauchy=(0.7, 0.0),
    )
    assert more.description == (
        "uniform in area, log-uniform in contrast (3 bands, independently), uniform in rate, "
        "half-Cauchy of 0.7 mas in the star's diameter"
    )
    assert [r.scale for r in more.ranges] == [0.7, 0.0]
