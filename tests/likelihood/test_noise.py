"""Extra noise: found where it is, absent where it is not, and no companion made of it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import join
from amibayes.detection.ratio import Ratio
from amibayes.detection.statistic import make_statistic, statistic_of
from amibayes.likelihood.channel_noise import Correlation
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior, add_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.linear_response import linear_response
from amibayes.likelihood.noise_fit import _Fit, fit_noise
from amibayes.models.binary import LinearResponse

FIELD = (50.0, 400.0)
EXTRA = ExtraNoise(0.02, np.radians(1.0))


def understated(theta, rng, extra=EXTRA, sheet=None):
    """Data with more noise than their errors say."""
    sheet = sheet or niriss()
    noisy = simulated(add_noise(sheet, extra), theta, rng)
    return replace(noisy, covariance=sheet.covariance)


@pytest.mark.parametrize("kind", ["assumed", "diagonal"])
def test_noise_is_added_as_baseline_noise(kind: str) -> None:
    sheet = niriss(covariance=kind)
    added = add_noise(sheet, EXTRA).covariance
    change = added.dense() - sheet.covariance.dense()
    np.testing.assert_allclose(np.diag(change)[:21], 0.02**2)
    np.testing.assert_allclose(np.diag(change)[21:], np.radians(1.0) ** 2)
    assert added.rank == sheet.covariance.rank
    if kind == "assumed":
        ratio = sheet.covariance.dense()[21:, 21:] / sheet.covariance.dense()[21, 21]
        np.testing.assert_allclose(change[21:, 21:] / change[21, 21], ratio, atol=1e-12)
    assert add_noise(sheet, ExtraNoise()) is sheet


def test_extra_noise_is_recovered() -> None:
    """40 epochs at once: σ to 1/√(2n) of n = 840 V² and 600 kernel phases; 5 sigma."""
    rng = np.random.default_rng(3)
    theta = [110.0, -75.0, 0.05]
    epochs = [understated(theta, rng, sheet=_at(niriss(), 60000.0 + k)) for k in range(40)]
    found = fit_noise(Likelihood(join(epochs)), np.array(theta))
    assert found.vis2 == pytest.approx(0.02, rel=5 * 1.1 / np.sqrt(2 * 840))
    assert found.closure_phase_rad == pytest.approx(
        EXTRA.closure_phase_rad, rel=5 * 1.2 / np.sqrt(1200)
    )


def _at(data, mjd):
    def moved(m):
        return replace(m, mjd=np.full(len(m), mjd))

    return replace(data, vis2=moved(data.vis2), closure_phase=moved(data.closure_phase))


@pytest.mark.parametrize(("n", "most"), [(80, 3), pytest.param(300, 5, marks=pytest.mark.slow)])
def test_honest_errors_get_no_extra_noise(n: int, most: int) -> None:
    """Two tests at 1e-3 each: more than 3 of 80 or 5 of 300 data sets would be a 4e-5 accident."""
    rng = np.random.default_rng(4)
    theta = [110.0, -75.0, 0.05]
    hits = sum(
        fit_noise(Likelihood(simulated(niriss(), theta, rng)), np.array(theta)).any
        for _ in range(n)
    )
    assert hits <= most


def test_a_prior_of_no_extra_noise_leaves_none(rng) -> None:
    """However much the data scatter."""
    theta = np.array([120.0, -70.0, 0.02])
    likelihood = Likelihood(understated(theta, rng))
    assert fit_noise(likelihood, theta).vis2 > 0.01
    none = fit_noise(likelihood, theta, prior=NoisePrior(0.0, 0.0))
    assert none.vis2 == none.closure_phase_rad == 0.0


@pytest.mark.slow
def test_search_of_noisy_data_has_a_reduced_chi2_of_one_and_fair_errors() -> None:
    """Pulls of 40 companions in data whose errors are four times too small; 5 sigma."""
    rng = np.random.default_rng(5)
    theta, n = np.array([110.0, -75.0, 0.15]), 40
    pulls, reduced = np.empty((n, 3)), np.empty(n)
    for k in range(n):
        result, noise = search_with_noise(Likelihood(understated(theta, rng)), FIELD)
        pulls[k] = (result.theta - theta) / np.sqrt(np.diag(result.theta_covariance))
        reduced[k] = result.chi2_binary / result.ndof
        assert noise.any
    assert reduced.mean() == pytest.approx(1.0, abs=0.1)
    # The noise is known to 1/√(2·15) only, which widens the pulls by a few per cent.
    assert np.abs(pulls.std(axis=0) - 1.05).max() < 5 / np.sqrt(2 * n)


@pytest.mark.parametrize(
    ("factor", "n"),
    [
        *(pytest.param(f, 60, marks=pytest.mark.slow) for f in (1.5, 4.0)),
        *(pytest.param(f, 300, marks=pytest.mark.release) for f in (1.0, 1.5, 4.0)),
    ],
)
def test_false_alarms_stay_at_their_rate_whatever_the_errors_say(factor: float, n: int) -> None:
    """Null data whose noise is ``factor`` times the stated errors: the reported p is uniform.

    P(p < 0.1) and P(p < 0.02) of n searches against binomial chance, 1e-4 each. Trusting
    the errors would call half of the data with a factor of 1.5 and nearly all with 4 unlikely.
    """
    rng = np.random.default_rng(6)
    extra = ExtraNoise(*(np.sqrt(factor**2 - 1.0) * np.array([0.005, np.radians(0.3)])))
    p = []
    for _ in range(n):
        data = understated([0.0, 0.0, 0.0], rng, extra)
        result, _ = search_with_noise(Likelihood(data), FIELD)
        test = statistic_of(result)
        p.append((1 + (test.draw_null(1000, rng) >= test.value).sum()) / 1001)
    for level in (0.1, 0.02):
        hits = int((np.array(p) < level).sum())
        assert stats.binomtest(hits, n, level, alternative="greater").pvalue > 1e-4


def test_profiled_statistic_does_not_depend_on_the_scale(rng) -> None:
    data = niriss().only(("cp",))
    grid = make_grid(50.0, 400.0, 30.0)
    free, known = (
        make_statistic(Likelihood(data), grid, np.empty(0), stated_errors=s) for s in (False, True)
    )
    white = rng.standard_normal((free.bank.n_data, 5))
    first = free.evaluate(white)
    np.testing.assert_allclose(free.evaluate(7 * white), first, rtol=1e-5)
    gain = known.evaluate(white)
    expected = -15 * np.log(1 - gain / (white**2).sum(axis=0))
    np.testing.assert_allclose(first, expected, rtol=1e-6)
    np.testing.assert_allclose(Ratio.scale_free(36)(np.array([1e-6]), 36.0), 1e-6, rtol=1e-5)


def test_files_have_one_noise_unless_told_otherwise() -> None:
    """Noise in one of two files: of both together, its variance is half of that."""
    rng = np.random.default_rng(5)
    theta = [110.0, -75.0, 0.05]
    parts = []
    for k, extra in enumerate([ExtraNoise(0.04), ExtraNoise()]):
        named = replace(niriss(), setups=(replace(niriss().setups[0], source=f"{k}.oifits"),))
        parts += [
            understated(theta, rng, extra, _at(named, 60000.0 + 2 * j + k)) for j in range(10)
        ]
    stated = Likelihood(join(parts))
    common = fit_noise(stated, np.array(theta))
    assert not common.files
    # 420 V² of one amount: 3.5 % of σ, and more where it is in half of them; 5 sigma.
    assert common.vis2 == pytest.approx(0.04 / np.sqrt(2.0), rel=0.35)
    own = fit_noise(stated, np.array(theta), per_file=True)
    assert [f.vis2 for f in own.files] == [pytest.approx(0.04, rel=0.25), 0.0]


@pytest.mark.parametrize("zero", ["none", "some", "all"])
def test_response_to_a_companion_of_lopsided_light_is_the_derivative(zero: str) -> None:
    """dV² = 2 Re(V₀* dV) and dφ = Im(V₀* dV)/|V₀|², with V₀ of any phases."""
    likelihood = Likelihood(niriss(channels=2))
    samples, rng = likelihood.samples, np.random.default_rng(3)
    n = len(samples)
    star, scale, disc = rng.uniform(0.5, 1.0, (3, n))
    across = 0.2 * rng.standard_normal(n)
    across[: {"none": 0, "some": n // 2, "all": n}[zero]] = 0.0
    response = LinearResponse(star, scale, disc, across)
    model = SimpleNamespace(linear_response=lambda samples, nuisance: response)
    stub = SimpleNamespace(model=model, samples=samples, noise=likelihood.noise)
    found = linear_response(stub, np.zeros(0))  # type: ignore[arg-type]
    wave = disc * np.exp(1j * rng.uniform(0.0, 2.0 * np.pi, n))
    v0 = star + 1j * across
    turned = np.conj(v0) * scale * (wave - v0)
    data = [samples.squares @ (2.0 * turned.real), samples.legs @ (turned.imag / np.abs(v0) ** 2)]
    expected = likelihood.noise.covariance.whitening @ np.concatenate(data)
    template = np.zeros(len(expected))
    template[found.even.rows] += found.even.matrix @ wave.real - found.offset
    template[found.odd.rows] -= found.odd.matrix @ wave.imag
    np.testing.assert_allclose(template, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (Correlation(), False),
        (Correlation(error=0.1), True),
        (Correlation(value=0.2), True),
        (Correlation(lasting=(0.0, 0.3)), True),
    ],
)
def test_shares_of_channels_are_told_where_they_are_measured(
    share: Correlation, monkeypatch: pytest.MonkeyPatch, *, told: bool
) -> None:
    """Also none at all, with its error; of one kind of observable or both."""
    likelihood = Likelihood(niriss())
    theta = np.array([150.0, -80.0, 0.01])
    for other in (share, Correlation()):
        shares = iter([share, other])
        monkeypatch.setattr(_Fit, "of_kind", lambda *_, s=shares: (0.0, next(s)))
        found = fit_noise(likelihood, theta).channels
        assert [(c.vis2, c.closure_phase) for c in found] == [(share, other)] * told
