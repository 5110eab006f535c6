"""Joint fits: contrasts of bands, motion, noise of files, against truths they did not make."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest
from epochs import F430M, F480M, MJD, epoch, noisy
from helpers import niriss, simulated
from scipy import linalg, optimize, stats
from scipy.special import logsumexp

from amibayes.calibration import calibrate
from amibayes.companion_search import second_companion
from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.grid import Grid, make_grid, trial_rates
from amibayes.companion_search.optimise import fit_single, refine
from amibayes.companion_search.search import search
from amibayes.companion_search.second_companion import search_second
from amibayes.companion_search.seeds import peaks
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.covariance import dense_covariance, diagonal_covariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.detection.residuals import file_residuals
from amibayes.detection.rotations import Rotations
from amibayes.detection.statistic import make_statistic
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.averaged_noise import averaged_noise, files_share_errors
from amibayes.likelihood.extra_noise import ExtraNoise, FileNoise, add_noise
from amibayes.likelihood.likelihood import Likelihood, joint_likelihood, single_likelihood
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.likelihood.residuals import files_of
from amibayes.models.bands import band_numbers, bands_of, dates
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box
from amibayes.pipeline.warnings import search_warnings
from amibayes.posterior.ensemble import sample
from amibayes.posterior.evidence import log_evidence_importance
from amibayes.posterior.grid import affordable
from amibayes.posterior.laplace import log_evidence_laplace
from amibayes.posterior.priors import default_prior
from amibayes.units import MAS

FIELD = (60.0, 400.0)
PIONIER = np.array([[0.0, 0.0], [60.0, 20.0], [10.0, 110.0], [-40.0, 70.0]])


def two_filters(rng, contrasts=(0.01, 0.02), place=(120.0, -90.0)) -> Observables:
    sheets = epoch(F430M, source="a"), epoch(F480M, source="b")
    return join([noisy(s, [*place, c], rng) for s, c in zip(sheets, contrasts, strict=True)])


def three_epochs(rng, truth=(120.0, -90.0, 0.02), rate=(20.0, -12.0)) -> Observables:
    """A companion that is at ``truth`` at the first date and moves ``rate`` mas per year."""
    parts = []
    for k, mjd in enumerate(MJD):
        years = (mjd - MJD[0]) / 365.25
        place = np.array(truth[:2]) + years * np.array(rate)
        sheet = epoch(mjd=mjd, source=f"{k}.oifits", turn_deg=20.0 * k)
        parts.append(noisy(sheet, [*place, truth[2]], rng))
    return join(parts)


def free(data: Observables, **options) -> Likelihood:
    return joint_likelihood(Likelihood(data), **options)


def test_bands_are_of_one_instrument_and_one_part_of_the_spectrum() -> None:
    parts = [
        epoch(F480M, insname="NIRISS_F480M"),
        epoch(F430M),
        epoch(F480M, turn_deg=30.0, mjd=60001.0),
        epoch((1.6e-6, 0.05e-6), insname="PIONIER_Pnat(1.6)", stations=PIONIER),
        epoch((1.64e-6, 0.05e-6), insname="PIONIER_Pnat(1.64)", stations=PIONIER),
        epoch((1.6e-6, 0.05e-6), insname="MIRC_H", stations=PIONIER),
    ]
    bands = bands_of(join(parts))
    names = ["MIRC_1.6um", "PIONIER_1.62um", "NIRISS_4.29um", "NIRISS_4.82um"]
    assert [b.name for b in bands] == names
    assert [b.setups for b in bands] == [(5,), (3, 4), (1,), (0, 2)]
    np.testing.assert_array_equal(band_numbers(join(parts), tuple(names)), [3, 2, 3, 1, 1, 0])
    with pytest.raises(ValueError, match="bands"):
        band_numbers(join(parts), tuple(names[:2]))


def test_model_of_bands_and_motion_is_that_of_each_epoch_by_itself() -> None:
    """Every file's part of the joint prediction is the plain model at that file's own truth."""
    parts = [
        epoch(F430M, 60000.0, "a"),
        epoch(F480M, 60100.0, "b", turn_deg=30.0),
        epoch(F480M, 60365.25, "c"),
    ]
    likelihood = free(join(parts), motion=True, fastest_mas_yr=50.0)
    model = likelihood.model
    assert model.parameters.names == (
        *("east_mas", "north_mas", "contrast", "contrast[NIRISS_4.82um]"),
        *("east_rate_mas_yr", "north_rate_mas_yr"),
    )
    theta = np.array([100.0, 50.0, 0.1, 0.2, 15.0, -8.0])
    predicted = likelihood.predict(theta)[:, 0]
    for k, (part, contrast) in enumerate(zip(parts, [0.1, 0.2, 0.2], strict=True)):
        years = (part.vis2.mjd[0] - model.reference_mjd) / 365.25
        own = [100.0 + 15.0 * years, 50.0 - 8.0 * years, contrast]
        expected = Likelihood(part).predict([own])[:, 0]
        vis2, closure = np.arange(21) + 21 * k, 63 + np.arange(35) + 35 * k
        np.testing.assert_allclose(predicted[np.r_[vis2, closure]], expected, atol=1e-12)


def test_a_rate_at_its_edge_is_told_of_a_companion_that_is_stated(rng) -> None:
    """Of α Cen A, "no companion", the summary asked for a faster one."""
    data = three_epochs(rng)  # which moves by 23 mas a year
    result = search(free(data, motion=True, fastest_mas_yr=5.0), FIELD)
    for stated in (True, False):
        said = search_warnings(data, result, ExtraNoise(), None, None, stated=stated)
        assert any("raise --fastest" in text for text in said) is stated


def with_response(data: Observables, rng) -> Observables:
    """The same data through an extraction that lets light off the axis through unevenly.

    Near the axis it does not turn phases: the bank's derivatives leave that out.
    """
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 25)] * 2, indexing="ij")
    a, b, c, d = rng.normal(0.0, 0.1, (4, 7, 7, 1, 1))
    # Splines with cubes for coefficients have a slope in the middle: of 1/12 squared, a step's.
    turn = c * (x**3 - x / 144.0) + d * (y**3 - y / 144.0)
    response = np.exp(-0.3 * (x**2 + y**2) + a * x**2 + b * x * y + 1j * turn)
    response[np.arange(7), np.arange(7)] = np.abs(response[np.arange(7), np.arange(7)])
    lattice = OffAxisResponse(response, np.array([[-0.04, 0.01], [0.01, 0.04]]) / MAS, np.zeros(2))
    return replace(data, setups=tuple(replace(s, response=lattice) for s in data.setups))


@pytest.mark.parametrize("off_axis", [False, True])
def test_gradient_of_bands_and_motion_against_differences(off_axis, rng) -> None:
    data = join(
        [
            epoch(F430M, 60000.0, "a"),
            epoch(F480M, 60100.0, "b", turn_deg=30.0),
            epoch(F480M, 60365.0, "c"),
        ]
    )
    data = with_response(data, rng) if off_axis else data
    plain = Likelihood(data, BinaryModel(diameter_mas="free", background="free"))
    likelihood = joint_likelihood(plain, motion=True, fastest_mas_yr=50.0)
    theta = np.array([100.0, 50.0, 0.1, 0.2, 15.0, -8.0, 40.0, 0.1])
    step = np.array([1e-3, 1e-3, 1e-6, 1e-6, 1e-3, 1e-3, 1e-3, 1e-6])
    moved = np.vstack([theta + np.diag(step), theta - np.diag(step)])
    value = likelihood.predict(moved)
    numerical = (value[:, :8] - value[:, 8:]) / (2.0 * step)
    whitened = likelihood.observables.covariance.whiten(numerical)
    np.testing.assert_allclose(likelihood.jacobian(theta), whitened, rtol=1e-4, atol=1e-4)
    log_prob = likelihood.log_prob(moved)
    _, gradient = likelihood.log_prob_and_gradient(theta)
    slope = (log_prob[:8] - log_prob[8:]) / (2.0 * step)
    np.testing.assert_allclose(gradient[0], slope, rtol=1e-3, atol=1e-2)


@pytest.mark.parametrize("off_axis", [False, True])
@pytest.mark.parametrize("nuisance", [False, True])
def test_joint_bank_against_least_squares_at_its_own_derivatives(off_axis, nuisance, rng) -> None:
    """Gain and contrasts by scipy's non-negative least squares on the model's derivatives."""
    parts = [
        noisy(epoch(F430M, 60000.0, "a"), [120.0, -90.0, 0.01], rng),
        noisy(epoch(F480M, 60365.0, "b", turn_deg=30.0), [130.0, -80.0, 0.02], rng),
    ]
    data = with_response(join(parts), rng) if off_axis else join(parts)
    model = BinaryModel(background="free") if nuisance else BinaryModel()
    likelihood = joint_likelihood(Likelihood(data, model), motion=True, fastest_mas_yr=40.0)
    single, _ = fit_single(likelihood)
    bank = TemplateBank(likelihood, make_grid(100.0, 200.0, 50.0), single)
    residuals = single_likelihood(likelihood).residuals(single)[:, 0]
    survey, chi2 = bank.survey(residuals), (bank.project(residuals) ** 2).sum()
    rates, checked = trial_rates(likelihood), 0
    np.testing.assert_allclose(np.sort(rates, axis=0), -np.sort(-rates, axis=0)[::-1])
    for k in range(len(bank)):
        best, alike = 0.0, []
        for rate in rates:
            place = [bank.grid.east_mas[k], bank.grid.north_mas[k]]
            jacobian = likelihood.jacobian([*place, 0.0, 0.0, *rate, *single])
            design = bank.project(jacobian[:, 2:4])
            c, left = optimize.nnls(design, bank.project(residuals))
            gain = chi2 - left**2
            best = max(best, gain)
            if gain > survey.gain[k] * (1 - 1e-5):
                # Rates may gain the same to rounding: it is one of theirs.
                alike.append(np.allclose(survey.contrasts[k], c, rtol=1e-3, atol=1e-5))
                checked += 1
        assert any(alike) or not alike
        assert survey.gain[k] == pytest.approx(best, rel=1e-4)
        here = bank.matched_filter(residuals)(np.array(place))
        np.testing.assert_allclose(here[1], survey.gain[k], rtol=1e-6)
        np.testing.assert_allclose(here[0], survey.tail[k], rtol=1e-4, atol=1e-9)
    assert checked >= len(bank)
    gain, _ = bank.largest_gain(bank.project(residuals[:, None]).astype(np.float32))
    assert gain[0] == pytest.approx(survey.gain.max(), rel=1e-4)
    assert survey.gain.max() > 100.0


def pulls(likelihoods, truths) -> np.ndarray:
    """(fit − truth)/error of every free parameter; fits start beside the truth."""
    out = []
    for likelihood, truth in zip(likelihoods, truths, strict=True):
        box = Box(*FIELD, resolution_mas(likelihood))
        mode = refine(likelihood, np.asarray(truth) * 1.01, box, fit_single(likelihood)[1])
        theta = np.array(mode.theta)
        out.append((theta - truth) / np.sqrt(np.diag(likelihood.errors(theta))))
    return np.array(out)


def assert_unit_normal(pulls: np.ndarray) -> None:
    """Mean and scatter of n pulls of each parameter within 4.5 σ of 0 and 1."""
    n = len(pulls)
    assert np.abs(pulls.mean(axis=0)).max() < 4.5 / np.sqrt(n)
    assert np.abs(pulls.std(axis=0) - 1.0).max() < 4.5 / np.sqrt(2 * n)


MANY = pytest.mark.parametrize("n", [50, pytest.param(200, marks=pytest.mark.slow)])


@MANY
def test_contrasts_of_two_filters_are_recovered_with_fair_errors(n: int) -> None:
    rng = np.random.default_rng(21)
    truth = [120.0, -90.0, 0.01, 0.02]
    assert_unit_normal(pulls([free(two_filters(rng)) for _ in range(n)], [truth] * n))


@MANY
def test_motion_is_recovered_with_fair_errors(n: int) -> None:
    rng = np.random.default_rng(22)
    found = [free(three_epochs(rng), motion=True) for _ in range(n)]
    years = (found[0].model.reference_mjd - MJD[0]) / 365.25
    truth = [120.0 + 20.0 * years, -90.0 - 12.0 * years, 0.02, 20.0, -12.0]
    assert_unit_normal(pulls(found, [truth] * n))


def test_search_finds_bands_and_motion_from_scratch_and_predicts_the_place(rng) -> None:
    """A shift of half a fringe between the first date and the last: a fit at rest loses it."""
    rate = (60.0, -30.0)
    result = search(free(three_epochs(rng, rate=rate), motion=True), FIELD)
    for mjd in MJD:
        years = (mjd - MJD[0]) / 365.25
        expected = [120.0 + rate[0] * years, -90.0 + rate[1] * years]
        np.testing.assert_allclose(result.position_at(mjd), expected, atol=8.0)
    rates = result.theta[result.likelihood.parameters.rates]
    np.testing.assert_allclose(rates, rate, atol=5 * 2.0)
    rest = search(free(three_epochs(np.random.default_rng(20201211), rate=rate)), FIELD)
    assert rest.chi2_binary > result.chi2_binary + 100.0
    assert result.chi2_binary / result.ndof < 1.6
    both = search(free(two_filters(rng)), FIELD)
    (_, a), (_, b) = both.contrasts.values()
    assert [c for c, _ in both.contrasts.values()] == pytest.approx([0.01, 0.02], abs=5 * max(a, b))
    tied = search(free(two_filters(np.random.default_rng(20201211)), contrast="tied"), FIELD)
    assert tied.contrasts == {}
    assert tied.companion.contrast == pytest.approx(0.015, abs=0.002)


def test_one_band_at_rest_is_the_plain_model_to_the_bit(rng) -> None:
    data = noisy(epoch(), [120.0, -90.0, 0.02], rng)
    plain, joint = Likelihood(data), free(data)
    assert joint.model == plain.model
    theta = np.array([[110.0, -80.0, 0.02], [60.0, 20.0, 0.5]])
    np.testing.assert_array_equal(plain.log_prob(theta), joint.log_prob(theta))
    bank = TemplateBank(joint, make_grid(*FIELD, 25.0), np.empty(0))
    assert not bank.joint


def null_data(sheets, rng, n: int) -> np.ndarray:
    """Noise (n_data, n) of files: V² by itself, triangles of independent baseline phases."""
    vis2, closures = [], []
    for sheet in sheets:
        m, cp = sheet.vis2, sheet.closure_phase
        sigma2, sigma3 = sheet.errors[0][0], sheet.errors[1][0]
        pairs = {(i, j): k for k, (i, j) in enumerate(m.stations.tolist())}
        phase = rng.normal(0.0, sigma3 / np.sqrt(3.0), (len(m), n))
        vis2.append(rng.normal(0.0, sigma2, (len(m), n)))
        legs = cp.stations.tolist()
        closures.append(
            np.array(
                [phase[pairs[a, b]] + phase[pairs[b, c]] - phase[pairs[a, c]] for a, b, c in legs]
            )
        )
    return np.concatenate([*vis2, *closures])


NULLS = {
    "two filters": (
        [epoch(F430M, source="a"), epoch(F480M, source="b", closure_error_deg=1.0)],
        {},
    ),
    "motion": (
        [epoch(mjd=m, source=str(m), turn_deg=20.0 * k) for k, m in enumerate(MJD[:2])],
        {"motion": True},
    ),
}


@pytest.mark.parametrize("name", list(NULLS))
@pytest.mark.parametrize("stated_errors", [False, True])
def test_reported_probability_of_a_joint_null_is_uniform(name, stated_errors) -> None:
    """500 null sets of another maker: Kolmogorov-Smirnov p > 1e-4, P(p < 0.05) within 4 σ."""
    rng = np.random.default_rng(31)
    sheets, options = NULLS[name]
    likelihood = free(join(sheets), **options)
    grid = make_grid(*FIELD, 30.0)
    test = make_statistic(likelihood, grid, np.empty(0), stated_errors=stated_errors)
    assert test.bank.joint
    null = np.sort(test.draw_null(8000, rng))
    white = likelihood.observables.covariance.whiten(null_data(sheets, rng, 500))
    statistic = test.evaluate(white)
    p = (1 + len(null) - np.searchsorted(null, statistic)) / (1 + len(null))
    assert stats.kstest(p, "uniform").pvalue > 1e-4
    assert abs((p < 0.05).sum() - 25) < 4 * np.sqrt(500 * 0.05 * 0.95)


UNEQUAL = [(1.0, 3.0, 0.5), (1.0, 1.3, 1.0), (0.5, 1.5, 1.0)]


def unequal(scales: tuple[float, ...], n: int, rng: np.random.Generator) -> np.ndarray:
    """Reported probabilities of n null fits of files whose noise is not what they state."""
    sheets = [
        epoch((F430M, F480M)[k % 2], source=str(k), mjd=60000.0 + k, turn_deg=20.0 * k)
        for k in range(len(scales))
    ]
    out = np.empty(n)
    for i in range(n):
        parts = []
        for sheet, scale in zip(sheets, scales, strict=True):
            data = sheet.data + scale * null_data([sheet], rng, 1)[:, 0]
            vis2, closure = np.split(data, [sheet.n_vis2])
            moved = replace(sheet.vis2, value=vis2)
            turned = replace(sheet.closure_phase, value=closure)
            parts.append(replace(sheet, vis2=moved, closure_phase=turned))
        likelihood = free(join(parts))
        test = make_statistic(likelihood, make_grid(*FIELD, 60.0), np.empty(0))
        statistic, null = test.value, test.draw_null(400, rng)
        ties = rng.random() * (null == statistic).sum()
        out[i] = (1 + (null > statistic).sum() + ties) / 401
    return out


@pytest.mark.parametrize(
    ("scales", "n"),
    [(UNEQUAL[0], 100), *(pytest.param(s, 500, marks=pytest.mark.slow) for s in UNEQUAL)],
)
def test_probability_is_uniform_where_files_state_wrong_errors(scales, n) -> None:
    """Three files in two bands; 500 sets give P(p < 0.05) to 0.010, P(p < 0.01) to 0.0044."""
    found = unequal(scales, n, np.random.default_rng([41, UNEQUAL.index(scales), n]))
    rates = ", ".join(f"{(found < level).mean():.4f}" for level in (0.5, 0.1, 0.05, 0.01))
    ks = stats.kstest(found, "uniform").pvalue
    logging.getLogger("joint").info("%s: KS p %.3f, rates %s", scales, ks, rates)
    assert ks > 1e-4
    assert stats.binomtest(int((found < 0.05).sum()), n, 0.05).pvalue > 1e-4


def test_local_probability_of_two_bands_is_the_chance_at_one_place() -> None:
    """One place, 40 000 draws: the share above against the stated one, 4.5 σ."""
    rng = np.random.default_rng(32)
    likelihood = free(join(NULLS["two filters"][0]))
    grid = make_grid(150.0, 151.0, 150.5)
    for stated_errors in (False, True):
        test = make_statistic(likelihood, grid, np.empty(0), stated_errors=stated_errors)
        bank = test.bank
        white = rng.standard_normal((bank.n_data, 40_000))
        data = bank.project(white)
        first = next(iter(bank.pieces()))[2]
        _, gain = first.best([data.T @ unit for unit in first.unit])
        gain = test.ratio(gain[:, 0], (data**2).sum(axis=0))
        for at in (1.0, 4.0, 9.0):
            expected = float(test.local_survival(np.array(at)))
            error = np.sqrt(expected * (1.0 - expected) / 40_000)
            assert abs((gain > at).mean() - expected) < 4.5 * error


def test_noise_of_one_bad_file_is_found_in_that_file_alone(rng) -> None:
    """Three files of which one has errors four times too small."""
    truth, parts = [120.0, -90.0, 0.05], []
    for k in range(3):
        sheet = epoch(mjd=60000.0 + k, source=f"{k}", turn_deg=25.0 * k)
        extra = ExtraNoise(0.02, np.radians(1.2)) if k == 1 else ExtraNoise()
        data = noisy(add_noise(sheet, extra), truth, rng)
        parts.append(replace(data, covariance=sheet.covariance))
    result, noise = search_with_noise(free(join(parts)), FIELD, per_file=True)
    assert [f.source for f in noise.files] == ["0", "1", "2"]
    assert noise.files[0] == FileNoise("0")
    assert noise.files[2] == FileNoise("2")
    # 21 V² and 15 kernel phases give the noise to 15 and 18 %.
    assert noise.files[1].vis2 == pytest.approx(0.02, rel=0.6)
    assert noise.files[1].closure_phase_rad == pytest.approx(np.radians(1.2), rel=0.8)
    assert noise.vis2 == pytest.approx(noise.files[1].vis2 / np.sqrt(3.0))
    errors = np.sqrt(np.diag(result.theta_covariance))
    assert (np.abs(result.theta - truth) < 4.5 * errors).all()
    reduced = file_residuals(result)
    assert [f.n_vis2 for f in reduced] == [21] * 3
    assert all(0.3 < f.vis2 < 2.5 and 0.2 < f.closure_phase < 2.8 for f in reduced)
    assert all(f.single_vis2 > f.vis2 for f in reduced[::2])
    one = fit_noise(free(parts[1]), np.array(truth), per_file=True)
    assert one.files == ()


def test_unknown_noise_of_files_is_averaged_file_by_file(rng) -> None:
    """The joint likelihood is the product of those of the files, each with its own noise."""
    truth = [120.0, -90.0, 0.05]
    parts = [noisy(epoch(mjd=60000.0 + k, source=f"{k}"), truth, rng) for k in range(2)]
    parts[1] = replace(parts[1], covariance=diagonal_covariance(parts[1].covariance.variance / 9.0))
    thetas = np.array([truth, [110.0, -95.0, 0.04]])
    fits = [thetas[0], thetas[1]]
    joint = Likelihood(join(parts))
    whole = joint.with_noise(
        averaged_noise(joint.noise, join(parts), [(joint, f) for f in fits], per_file=True)
    )
    each = [Likelihood(p) for p in parts]
    alone = [
        one.with_noise(averaged_noise(one.noise, p, [(one, f) for f in fits]))
        for one, p in zip(each, parts, strict=True)
    ]
    total = sum(a.log_prob(thetas) for a in alone)
    np.testing.assert_allclose(whole.log_prob(thetas), total, rtol=1e-9)
    found = whole.noise.posterior(whole.difference(thetas[:1]))
    assert set(found) == {f"{k}:{s}" for k in ("vis2", "closure_phase_rad") for s in "01"}
    assert found["vis2:0"].probability_none > 0.5
    assert found["vis2:1"].probability_none < 0.01
    assert not files_share_errors(join(parts))
    stars = [noisy(epoch(source=f"c{k}", mjd=60000.5 + k), [0.0, 0.0, 0.0], rng) for k in range(2)]
    assert files_share_errors(calibrate(parts, stars).observables)


def test_reduced_chi2_of_files_adds_up_to_that_of_the_fit(rng) -> None:
    result = search(free(two_filters(rng)), FIELD)
    files = file_residuals(result)
    share = result.ndof / result.likelihood.n_independent
    total = sum(f.vis2 * 21 * share + f.closure_phase * 15 * share for f in files)
    assert total == pytest.approx(result.chi2_binary, rel=1e-9)
    single = sum(f.single_vis2 * 21 * share + f.single_closure_phase * 15 * share for f in files)
    assert single == pytest.approx(result.chi2_single, rel=1e-9)
    assert [f.source for f in files_of(result.likelihood.observables)] == ["a", "b"]


def test_mixed_instruments_in_one_fit(rng) -> None:
    """F430M, F480M and four telescopes in H, the contrast another in each; 5 σ."""
    place, truth = (
        [72.0, 30.0],
        {"PIONIER_1.64um": 0.02, "NIRISS_4.29um": 0.04, "NIRISS_4.82um": 0.06},
    )
    sheets = [
        epoch(([1.61e-6, 1.64e-6, 1.67e-6], 0.03e-6), insname="PIONIER_Pnat", stations=PIONIER,
              source="p", vis2_error=0.01, closure_error_deg=0.5),
        epoch(F430M, source="a"),
        epoch(F480M, source="b"),
    ]  # fmt: skip
    data = join([noisy(s, [*place, c], rng) for s, c in zip(sheets, truth.values(), strict=True)])
    result = search(free(data), (74.0, 82.0))
    assert tuple(result.contrasts) == tuple(truth)
    for band, (contrast, error) in result.contrasts.items():
        assert abs(contrast - truth[band]) < 5 * error
    assert np.hypot(*(np.subtract(result.modes[0].place, place))) < 0.1
    assert result.chi2_binary / result.ndof < 1.6


def test_order_of_files_does_not_matter_to_the_fit(rng) -> None:
    """The order of the columns differs, and nothing but the last digits of the result."""
    data = three_epochs(rng)
    parts = [data.select(f.vis2, f.closure_phase) for f in files_of(data)]
    results = [
        search(free(join([parts[i] for i in order]), motion=True), FIELD)
        for order in ([0, 1, 2], [2, 0, 1])
    ]
    np.testing.assert_allclose(results[0].theta, results[1].theta, rtol=1e-4)
    assert results[0].chi2_binary == pytest.approx(results[1].chi2_binary, rel=1e-8)
    assert results[0].likelihood.model == results[1].likelihood.model


def test_motion_needs_two_dates_and_all_of_them() -> None:
    with pytest.raises(UsageError, match="one date"):
        free(epoch(), motion=True)
    undated = epoch(mjd=0.0, source="undated.oifits")
    with pytest.raises(DataError, match=r"undated.oifits: has data without a date"):
        free(join([epoch(), undated]), motion=True)
    once = epoch()
    mjd = np.where(np.arange(once.n_vis2) == 3, np.nan, once.vis2.mjd)
    one = replace(once, vis2=replace(once.vis2, mjd=mjd))
    with pytest.raises(DataError, match="has data without a date"):
        dates(one)
    julian = epoch(mjd=2400000.5 + MJD[1], source="julian.oifits")
    with pytest.raises(DataError, match=r"no MJD, such as 2460200.5.*take 2400000.5 from"):
        dates(join([once, julian]))
    first, last, mean = dates(three_epochs(None))
    assert (first, last) == (MJD[0], MJD[2])
    assert mean == pytest.approx(np.mean(MJD))


@pytest.mark.slow
def test_posterior_of_bands_and_motion_agrees_with_the_errors_of_a_strong_companion(rng) -> None:
    """At high signal-to-noise the posterior is the Gaussian of the fit: 5 % and 0.15 σ."""
    parts = [
        noisy(epoch(F430M, 60000.0, "a"), [120.0, -90.0, 0.1], rng),
        noisy(epoch(F480M, 60200.0, "b", turn_deg=30.0), [125.0, -93.0, 0.2], rng),
        noisy(epoch(F480M, 60365.0, "c"), [129.0, -96.0, 0.2], rng),
    ]
    result = search(free(join(parts), motion=True), FIELD)
    likelihood = result.likelihood
    assert not affordable(likelihood, default_prior(likelihood, *FIELD))
    posterior = sample(result, default_prior(likelihood, *FIELD), rng)
    assert posterior.converged
    assert posterior.names == likelihood.parameters.names
    sigma = np.sqrt(np.diag(result.theta_covariance))
    shift = (posterior.samples.mean(axis=0) - result.theta) / sigma
    n = posterior.n_effective
    assert np.abs(shift).max() < 0.15 + 4.5 / np.sqrt(n)
    ratio = posterior.samples.std(axis=0) / sigma
    assert np.abs(ratio - 1.0).max() < 0.05 + 4.5 / np.sqrt(2 * n)


def test_evidence_of_two_bands_against_a_sum_over_a_lattice(rng) -> None:
    """Given the place the bands are independent: their contrasts are integrated one by one."""
    parts = [
        noisy(epoch(F430M, source="a"), [120.0, -90.0, 0.01], rng),
        noisy(epoch(F480M, source="b"), [120.0, -90.0, 0.02], rng),
    ]
    result = search(free(join(parts)), FIELD)
    prior = default_prior(result.likelihood, *FIELD)
    log_z, error = log_evidence_importance(
        result.likelihood, result.modes, result.modes, prior, np.random.default_rng(1)
    )
    sigma = np.sqrt(np.diag(result.theta_covariance))
    ln_c = np.linspace(np.log(1e-3), np.log(0.1), 250)
    axis = np.linspace(-6.0, 6.0, 25)
    east, north = np.meshgrid(result.theta[0] + sigma[0] * axis, result.theta[1] + sigma[1] * axis)
    cell = sigma[0] * sigma[1] * (axis[1] - axis[0]) ** 2
    total = np.zeros(east.size)
    for part in parts:
        likelihood = Likelihood(part)
        bright = np.exp(ln_c)
        theta = np.column_stack(
            [np.repeat(east, 250), np.repeat(north, 250), np.tile(bright, east.size)]
        )
        log_prob = np.concatenate([likelihood.log_prob(t) for t in np.array_split(theta, 20)])
        width = (ln_c[1] - ln_c[0]) / np.log(1.0 / 1e-5)
        total += logsumexp(log_prob.reshape(-1, 250), axis=1) + np.log(width)
    area = np.pi * (FIELD[1] ** 2 - FIELD[0] ** 2)
    exact = logsumexp(total) + np.log(cell / area)
    assert error < 0.05
    assert log_z == pytest.approx(exact, abs=4.5 * error + 0.01)
    laplace = log_evidence_laplace(result.likelihood, result.modes[:1], prior)
    assert laplace == pytest.approx(exact, abs=0.1)


def test_second_companion_with_contrasts_of_two_filters(rng) -> None:
    sheets = epoch(F430M, source="a"), epoch(F480M, source="b")
    two, parts = BinaryModel(companions=2), []
    for sheet, (c, d) in zip(sheets, [(0.05, 0.02), (0.04, 0.03)], strict=True):
        likelihood = Likelihood(sheet, two)
        theta = [120.0, -90.0, c, -60.0, 200.0, d]
        data = likelihood.predict(theta)[:, 0] + sheet.covariance.draw(rng, 1)[:, 0]
        vis2, closure = np.split(data, [21])
        moved = replace(sheet.vis2, value=vis2), replace(sheet.closure_phase, value=closure)
        parts.append(replace(sheet, vis2=moved[0], closure_phase=moved[1]))
    both = search_second(search(free(join(parts)), FIELD))
    names = both.likelihood.parameters.names
    assert names[4:] == ("east_mas_2", "north_mas_2", "contrast_2", "contrast_2[NIRISS_4.82um]")
    truth = [120.0, -90.0, 0.05, 0.04, -60.0, 200.0, 0.02, 0.03]
    errors = np.sqrt(np.diag(both.theta_covariance))
    assert np.abs((both.theta - truth) / errors).max() < 5.0


@pytest.mark.parametrize("model", [BinaryModel(), BinaryModel(background="free")])
def test_estimates_drawn_anew_search_all_bands(model, rng) -> None:
    """Against the bank of each null set's own estimate, bands correlated and all."""
    data = replace(join(NULLS["two filters"][0]), freedom=Freedom(90.0, 50.0))
    grid, nuisance = make_grid(*FIELD, 60.0), np.zeros(len(model.parameters.nuisance))
    test = make_statistic(joint_likelihood(Likelihood(data, model)), grid, nuisance)
    bank = test.bank
    noise = rng.standard_normal((bank.n_data, 3))
    assert isinstance(test.treatment, Rotations)
    drawn = test.treatment.noise_of(noise, np.random.default_rng(7))
    found = test.treatment.search_simulated(bank, drawn)
    means = test.treatment.null.draw(noise, np.random.default_rng(7))
    colour = np.linalg.pinv(data.covariance.whitening.toarray())
    own = test.treatment.null.residual
    for k in range(3):
        outer = np.outer(own, own) - np.outer(means[:, k], means[:, k])
        matrix = colour @ (np.eye(len(own)) + outer / 88.0) @ colour.T
        covariance = dense_covariance(matrix, linalg.orth(colour))
        alone = replace(data, covariance=covariance, freedom=None)
        other = make_statistic(
            joint_likelihood(Likelihood(alone, model)), grid, nuisance, stated_errors=True
        )
        expected = other.hits(covariance.whiten(colour @ means[:, k])[:, None])
        assert found.gain[k] == pytest.approx(expected.gain[0], rel=1e-3)
        assert found.position[k] == expected.position[0]


def test_a_second_companion_is_not_sought_at_the_place_of_the_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What stands there is the first one's error; at its mirror image there may be another."""
    theta = [120.0, -80.0, 0.05]
    result = search(Likelihood(simulated(niriss(), theta, np.random.default_rng(2))), (50.0, 400.0))
    asked: list[np.ndarray] = []

    def recorded(grid: Grid, gain: np.ndarray, fringe_mas: float) -> np.ndarray:
        asked.append(gain.copy())
        return peaks(grid, gain, fringe_mas)

    monkeypatch.setattr(second_companion, "peaks", recorded)
    bank = TemplateBank(result.likelihood, result.grid, result.single_theta)
    two = result.likelihood.with_model(BinaryModel(companions=2))
    second_companion._beside(result, bank, two, np.array(result.theta))
    left = bank.survey(result.likelihood.residuals(result.theta)[:, 0]).gain
    place, radius = result.companion, 0.25 * resolution_mas(two)
    away = result.grid.east_mas - place.east_mas, result.grid.north_mas - place.north_mas
    near = np.hypot(*away) < radius
    assert near.any()
    np.testing.assert_array_equal(asked[0], np.where(near, 0.0, left))
