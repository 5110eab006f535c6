"""Degrees of freedom of estimated covariances: carried everywhere, and worth what they say."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss, simulated
from noise_maker import PHASE, Recipe
from scipy import linalg, stats
from scipy.sparse import csr_array

from amibayes.calibration import calibrate
from amibayes.calibration.flagging import flag_by_rule
from amibayes.companion_search.search import search
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import dense_covariance
from amibayes.data.degrees_of_freedom import (
    Freedom,
    squared_share,
    stacked_freedom,
    welch_satterthwaite,
)
from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.shrinkage import _loss, shrunk_covariance
from amibayes.errors import DataError
from amibayes.likelihood.extra_noise import ExtraNoise, add_noise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import read_oifits, write_oifits
from amibayes.pipeline.warnings import search_warnings
from amibayes.posterior.grid import grid_posterior
from amibayes.posterior.priors import Prior
from amibayes.report.common import data_json
from amibayes.units import MAS

FIELD = (50.0, 400.0)
TRUTH = [110.0, -75.0, 0.01]
USUAL = Freedom(40.0, 24.0)


def estimated(
    freedom: Freedom | None = USUAL, seed: int = 1, contrast: float = TRUTH[2]
) -> Observables:
    data = simulated(niriss(), [*TRUTH[:2], contrast], np.random.default_rng(seed))
    matrix = dense_covariance(data.covariance.dense(), basis())
    return replace(
        data, covariance=matrix, covariance_kind="estimated", n_integrations=25, freedom=freedom
    )


def basis() -> np.ndarray:
    return linalg.block_diag(
        np.eye(21), kernel_basis(closure_matrix(niriss().closure_phase.stations)[0])
    )


def test_likelihood_is_scipys_multivariate_t(rng) -> None:
    data = estimated()
    likelihood = Likelihood(data)
    theta = np.array([TRUTH, [-200.0, 90.0, 0.05]])
    inner = basis().T @ data.covariance.dense() @ basis()
    left = basis().T @ (data.data[:, None] - likelihood.predict(theta))
    expected = stats.multivariate_t.logpdf(left.T, np.zeros(36), inner * 38.0 / 40.0, 40.0)
    np.testing.assert_allclose(likelihood.log_prob(theta), expected, rtol=1e-10)
    gaussian = Likelihood(replace(data, freedom=None)).log_prob(theta)
    nearly = Likelihood(replace(data, freedom=Freedom(1e9, 1e9))).log_prob(theta)
    np.testing.assert_allclose(nearly, gaussian, rtol=1e-5)


def test_gradient_is_the_slope_of_the_likelihood() -> None:
    likelihood = Likelihood(estimated(), BinaryModel(background="free"))
    theta = np.array([120.0, -60.0, 0.02, 0.01])
    value, gradient = likelihood.log_prob_and_gradient(theta)
    assert value[0] == pytest.approx(likelihood.log_prob(theta)[0], rel=1e-12)
    for k, step in enumerate([1e-3, 1e-3, 1e-7, 1e-7]):
        moved = theta + step * np.outer([1.0, -1.0], np.eye(4)[k])
        slope = np.diff(likelihood.log_prob(moved)[::-1])[0] / (2.0 * step)
        assert gradient[0, k] == pytest.approx(slope, rel=1e-5)


def test_gains_are_those_of_the_likelihood_everywhere() -> None:
    result = search(Likelihood(estimated()), FIELD)
    likelihood = result.likelihood
    none = likelihood.log_prob([[100.0, 0.0, 0.0]])[0]
    gain = 2.0 * (likelihood.log_prob(result.theta)[0] - none)
    assert result.delta_chi2 == pytest.approx(gain, rel=1e-9)
    assert result.modes[0].delta_chi2 == pytest.approx(gain, rel=1e-6)
    assert gain < result.chi2_single - result.chi2_binary
    assert result.bank_delta_chi2.max() == pytest.approx(gain, rel=0.15)
    evidence = grid_posterior(likelihood, Prior(*FIELD))
    assert evidence.log_z - evidence.log_z_none < 0.5 * gain


def test_errors_are_those_of_the_t_distribution() -> None:
    """Against the second moment of the likelihood along contrast, the only free parameter."""
    likelihood = Likelihood(estimated(Freedom(12.0, 8.0)))
    contrast = np.linspace(-0.02, 0.04, 4001)
    theta = np.column_stack([np.full((4001, 2), TRUTH[:2]), contrast])
    weight = np.exp(likelihood.log_prob(theta) - likelihood.log_prob([TRUTH])[0])
    mean = (weight * contrast).sum() / weight.sum()
    sigma = np.sqrt((weight * (contrast - mean) ** 2).sum() / weight.sum())
    at = theta[weight.argmax()]
    alone = 1.0 / np.sqrt(np.linalg.inv(likelihood.errors(at))[2, 2])
    # Three parameters were counted there, one is free here: 43 degrees and not 45.
    assert alone * np.sqrt(43.0 / 45.0) == pytest.approx(sigma, rel=0.01)


def test_part_of_the_data_keeps_its_freedom() -> None:
    data = estimated()
    assert data.only(("cp",)).freedom == data.freedom
    assert data.degrees_of_freedom == 40.0
    assert niriss().degrees_of_freedom == np.inf


def test_file_keeps_the_freedom(tmp_path: Path) -> None:
    data = estimated(Freedom(40.0 / 3.0, 24.0))
    write_oifits(tmp_path / "a.oifits", data)
    again = read_oifits(tmp_path / "a.oifits")
    assert again.freedom is not None
    assert again.freedom.degrees == pytest.approx(40.0 / 3.0, rel=1e-14)
    assert again.freedom.scatter == 24.0
    assert again.covariance_kind == "estimated"
    write_oifits(tmp_path / "b.oifits", estimated(None))
    assert read_oifits(tmp_path / "b.oifits").freedom is None
    assert read_oifits(tmp_path / "a.oifits", closure_covariance="diagonal").freedom is None


def measured(seed: int = 1) -> Observables:
    """Data with a scatter of 24 integrations that is not their covariance."""
    data = estimated(seed=seed)
    rows = np.random.default_rng([seed, 7]).standard_normal((24, 36))
    factor = np.asarray(np.linalg.cholesky(basis().T @ data.covariance.dense() @ basis()))
    spread = basis() @ factor @ rows.T
    return replace(data, scatter=csr_array(spread @ spread.T / 24.0))


def test_scatter_goes_where_the_data_go(tmp_path: Path) -> None:
    data = measured()
    assert data.scatter is not None
    whole = data.scatter.toarray()
    closures = data.only(("cp",)).scatter
    np.testing.assert_array_equal(closures.toarray(), whole[21:, 21:])
    write_oifits(tmp_path / "a.oifits", data)
    again = read_oifits(tmp_path / "a.oifits")
    assert again.scatter is not None
    assert not again.notes
    scale = np.sqrt(np.outer(whole.diagonal(), whole.diagonal()))
    np.testing.assert_allclose(again.scatter.toarray() / scale, whole / scale, atol=1e-12)
    both = join([data, replace(estimated(seed=2), freedom=None)])
    known = estimated().covariance.dense()
    assert both.scatter is not None
    first = np.r_[0:21, 42:77]
    np.testing.assert_allclose(both.scatter.toarray()[np.ix_(first, first)], whole)
    second = np.r_[21:42, 77:112]
    np.testing.assert_allclose(both.scatter.toarray()[np.ix_(second, second)], known)
    assert join([estimated(), estimated(seed=2)]).scatter is None
    fewer = flag_by_rule(data, ["station=H1"])
    used = np.concatenate([~fewer.vis2.flag, ~fewer.closure_phase.flag])
    np.testing.assert_array_equal(fewer.scatter.toarray(), whole[np.ix_(used, used)])


def test_scatter_takes_noise_and_calibration_as_the_covariance_does() -> None:
    """Where it is the covariance it stays so: known noise added, target and calibrator joined."""
    target, calibrator = (
        replace(d, scatter=csr_array(d.covariance.dense()))
        for d in (estimated(contrast=0.0), estimated(seed=2, contrast=0.0))
    )
    noisy = add_noise(target, ExtraNoise(0.01, 0.02))
    np.testing.assert_allclose(noisy.scatter.toarray(), noisy.covariance.dense(), rtol=1e-9)
    for others in ([], [estimated(seed=3, contrast=0.0)]):
        made = calibrate(target, [calibrator, *others], method="weighted", clip=None).observables
        whole = basis().T @ made.covariance.dense() @ basis()
        scatter = basis().T @ made.scatter.toarray() @ basis()
        np.testing.assert_allclose(scatter, whole, rtol=1e-6, atol=1e-12 * whole.max())


def test_one_datum_is_the_rule_of_welch(rng) -> None:
    a, b = rng.normal(0.0, 1.0, 12), rng.normal(0.0, 3.0, 30)
    parts = [a.var(ddof=1) / 12, b.var(ddof=1) / 30]
    whole = dense_covariance(np.array([[sum(parts)]]))
    shares = [squared_share(dense_covariance([[p]]).sparse, whole) for p in parts]
    found = welch_satterthwaite(
        zip(shares, [Freedom(11.0, 11.0), Freedom(29.0, 29.0)], strict=True)
    )
    assert found is not None
    expected = stats.ttest_ind(a, b, equal_var=False).df
    assert found.degrees == pytest.approx(expected, rel=1e-12)
    assert found.scatter == pytest.approx(expected, rel=1e-12)


def test_data_sets_laid_side_by_side_share_what_they_know() -> None:
    """Ten alike have about ten times the freedom; the rule is that of the sum of them all."""
    one = estimated()
    whole = join([one] * 10)
    assert whole.degrees_of_freedom == pytest.approx(400.0 * (1 + 360) / (10 * 37), rel=1e-12)
    assert join([niriss(), niriss()]).freedom is None
    part = whole.covariance.sparse.tolil()
    mask = np.arange(whole.covariance.size)
    first = np.flatnonzero((mask < 21) | ((mask >= 210) & (mask < 245)))
    alone = np.zeros((560, 560))
    alone[np.ix_(first, first)] = part.toarray()[np.ix_(first, first)]
    share = squared_share(csr_array(alone), whole.covariance)
    assert share == pytest.approx((36 + 36**2) / (360 + 360**2), rel=1e-9)
    assert stacked_freedom([(36, None), (36, None)]) is None


def test_noise_that_is_known_adds_freedom() -> None:
    data = estimated()
    assert add_noise(data, ExtraNoise(1e-9, 1e-9)).degrees_of_freedom == pytest.approx(40.0)
    assert add_noise(data, ExtraNoise(1.0, 1.0)).degrees_of_freedom > 1e5
    twice = add_noise(data, ExtraNoise(0.005, np.radians(0.3)))
    assert twice.degrees_of_freedom == pytest.approx(160.0)


def test_calibration_has_the_freedom_of_both() -> None:
    """Target and one calibrator alike: half the covariance each, twice the freedom."""
    target, first, second = (
        estimated(),
        estimated(seed=2, contrast=0),
        estimated(seed=3, contrast=0),
    )
    found = calibrate(target, [first]).observables
    assert found.freedom is not None
    assert found.freedom.degrees == pytest.approx(80.0, rel=0.03)
    assert found.freedom.scatter == pytest.approx(48.0, rel=0.03)
    known = calibrate(target, [replace(first, freedom=None)]).observables
    assert known.degrees_of_freedom == pytest.approx(160.0, rel=0.05)
    # 1/ν = (4/9 + 1/9·1/2)/40; the scatter between two can only make their share larger.
    both = calibrate(target, [first, second], method="weighted", clip=None).observables
    assert 75.0 < both.degrees_of_freedom < 90.0
    assert calibrate(niriss(), [first.only(("vis2",))]).observables.freedom is not None
    assert calibrate(niriss(), [replace(first, freedom=None)]).observables.freedom is None


def test_scatter_alone_needs_more_integrations_than_data() -> None:
    rng = np.random.default_rng(1)
    draws = rng.standard_normal((60, 36))
    found = shrunk_covariance(draws - draws.mean(axis=0), np.eye(36), np.eye(36), 21, "scatter")
    assert found.carried == Freedom(24.0, 59.0)
    assert np.trace(found.matrix) == pytest.approx((draws - draws.mean(0)).var(0).sum() * 60 / 22)
    few = draws[:38] - draws[:38].mean(axis=0)
    with pytest.raises(DataError, match="38 integrations"):
        shrunk_covariance(few, np.eye(36), np.eye(36), 21, "scatter")


EVEN = Recipe()
UNEVEN = Recipe(phase=PHASE * np.exp(np.random.default_rng(3).normal(0.0, 0.4, 21)), gain=0.003)


def inside(
    recipe: Recipe, n_integrations: int, trials: int, kind: str, rng: np.random.Generator
) -> tuple[int, int]:
    """How often 68 % intervals of the contrast hold it: by the t likelihood, and by a Gaussian."""
    sheet, expected = niriss(), EVEN.covariance()
    sigma = np.sqrt(Likelihood(sheet).errors(TRUTH)[2, 2] / n_integrations)
    contrast = TRUTH[2] + sigma * np.linspace(-10.0, 10.0, 401)
    theta = np.column_stack([np.full((401, 2), TRUTH[:2]), contrast])
    model = Likelihood(sheet).predict(theta)
    truth = Likelihood(sheet).predict([TRUTH])
    hits = np.zeros(2, dtype=int)
    for _ in range(trials):
        draws = recipe.draw(rng, n_integrations)
        mean = draws.mean(axis=1, keepdims=True)
        found = shrunk_covariance((draws - mean).T, expected, basis(), 21, kind)
        covariance = dense_covariance(found.matrix / n_integrations, basis())
        chi2 = (covariance.whiten(truth + mean - model) ** 2).sum(axis=0)
        data = replace(sheet, covariance=covariance, freedom=found.carried)
        deviance = np.array([Likelihood(data).deviance(chi2), chi2 * _plug_in(found, 36)])
        weight = np.exp(-0.5 * (deviance - deviance.min(axis=1, keepdims=True)))
        below = weight[:, :200].sum(axis=1) + 0.5 * weight[:, 200]
        hits += np.abs(below / weight.sum(axis=1) - 0.5) < 0.34
    return int(hits[0]), int(hits[1])


def _plug_in(found, p: int) -> float:
    """For the scatter alone: χ² with S/(N − 1) in place of the covariance of the t."""
    n = found.scatter_freedom + 1.0
    return (n - 1.0) / (n - p - 2.0) if found.prior_freedom == 0.0 else 1.0


def test_what_all_vis2_share_is_learned_from_fewer_integrations_than_data(rng) -> None:
    """Gains of the holes, which the expectation does not have, against the recipe's covariance.

    The variance of the mean V², which 40 times 20 integrations know to √(2/19/40) = 5 %.
    """
    recipe, along = Recipe(gain=0.003), np.r_[np.ones(21), np.zeros(35)]
    found = [
        shrunk_covariance((d - d.mean(axis=1, keepdims=True)).T, EVEN.covariance(), basis(), 21)
        for d in (recipe.draw(rng, 20) for _ in range(40))
    ]
    ratio = [along @ f.matrix @ along / (along @ recipe.covariance() @ along) for f in found]
    # Four times that, and some percent for the prior; without the shared change it is 0.38.
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize(
    ("name", "n_integrations"), [pytest.param("even", 200, marks=pytest.mark.slow), ("uneven", 20)]
)
def test_intervals_cover_at_few_integrations(name: str, n_integrations: int) -> None:
    """100 trials: binomial chance 1e-4; the uneven one has an expectation that is wrong."""
    rng = np.random.default_rng([8, n_integrations, name == "even"])
    hits, _ = inside(EVEN if name == "even" else UNEVEN, n_integrations, 100, "shrunk", rng)
    assert stats.binomtest(hits, 100, 0.68).pvalue > 1e-4, hits


@pytest.mark.parametrize(
    "n", [pytest.param(600, marks=pytest.mark.slow), pytest.param(2000, marks=pytest.mark.release)]
)
@pytest.mark.parametrize(
    ("name", "n_integrations"), [(name, n) for name in ("even", "uneven") for n in (20, 50, 200)]
)
def test_intervals_cover_in_many_trials(name: str, n_integrations: int, n: int) -> None:
    """Within the Monte Carlo error (1 %); a wrong expectation may cost 3 % beside it."""
    rng = np.random.default_rng([9, n_integrations, name == "even"])
    hits, _ = inside(EVEN if name == "even" else UNEVEN, n_integrations, n, "shrunk", rng)
    slack = 0.0 if name == "even" else 0.03
    logging.getLogger("coverage").info("%s, N = %d: %.3f", name, n_integrations, hits / n)
    assert abs(hits / n - 0.68) < slack + 4.0 * np.sqrt(0.68 * 0.32 / n), hits


def test_plug_in_scatter_does_not_cover() -> None:
    """Why: 60 integrations of 36 data, as they are, cover far less than 68 %."""
    hits = inside(EVEN, 60, 100, "scatter", np.random.default_rng(9))
    assert hits[1] < 0.55 * 100
    assert hits[0] < 0.68 * 100


def cautions(data: Observables) -> str:
    result = search(Likelihood(data), FIELD)
    return " ".join(search_warnings(data, result, ExtraNoise(), None, None))


def test_reader_is_warned_of_few_integrations_and_of_errors_too_large() -> None:
    data = estimated(Freedom(30.0, 24.0))
    assert "N/p = 0.7" in cautions(data)
    assert "approximate" not in cautions(replace(data, freedom=Freedom(200.0, 24.0)))
    assert "approximate" not in cautions(replace(data, freedom=Freedom(112.0, 109.0)))
    assert "times too large" not in cautions(data)
    exact = simulated(niriss(), TRUTH, None)
    assert "far more than ten times too large" in cautions(exact)


def test_reader_is_warned_of_bright_companions_in_sums_of_powers() -> None:
    for contrast in (0.01, 0.06):
        data = simulated(niriss(), [*TRUTH[:2], contrast], np.random.default_rng(3))
        n = len(data.setups[0].stations)
        for single in (True, False):
            flat = OffAxisResponse(
                np.ones((n, n, 9, 9)), np.eye(2) / MAS / 100.0, np.zeros(2), single
            )
            extracted = replace(data, setups=(replace(data.setups[0], response=flat),))
            warned = contrast > 0.03 and not single
            assert ("several samples" in cautions(extracted)) == warned


def test_result_states_what_the_covariance_rests_on() -> None:
    stated = data_json(search(Likelihood(estimated()), FIELD))
    assert stated["degrees_of_freedom"] == 40.0
    assert stated["n_over_p"] == pytest.approx(25 / 36)
    assert stated["scatter_share"] == pytest.approx(24 / 38)
    assert data_json(search(Likelihood(niriss()), FIELD))["n_over_p"] is None


def test_slopes_of_the_marginal_likelihood_are_differences() -> None:
    """By the freedom, the two scales and the variance that all V² share."""
    rng = np.random.default_rng(6)
    draws = rng.standard_normal((30, 8)) * np.geomspace(0.5, 2.0, 8)
    groups, shared = np.arange(8) < 5, np.where(np.arange(8) < 5, rng.uniform(0.5, 1.5, 8), 0.0)
    arguments = draws.T @ draws, 29, groups, shared
    at = np.array([2.0, 0.3, -0.4, -1.0])
    _, slope = _loss(at, *arguments)
    for k, step in enumerate(1e-5 * np.eye(4)):
        wide = _loss(at + step, *arguments)[0] - _loss(at - step, *arguments)[0]
        assert slope[k] == pytest.approx(wide / 2e-5, rel=1e-5)
