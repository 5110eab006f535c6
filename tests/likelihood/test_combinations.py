"""Every combination of noise, files, model and companions works or says why not."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from itertools import product, starmap
from pathlib import Path

import numpy as np
import pytest
from helpers import NIRISS_HOLES
from scipy.optimize import nnls

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.robust import RobustFits, with_shared
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.covariance import Block, BlockCovariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.detection.statistic import make_statistic
from amibayes.errors import UsageError
from amibayes.likelihood.averaged_noise import averaged_noise
from amibayes.likelihood.channel_noise import ChannelShare, Correlation
from amibayes.likelihood.combinations import Combination, combination_of, refusal, require
from amibayes.likelihood.extra_noise import ExtraNoise, with_noise
from amibayes.likelihood.likelihood import Likelihood, joint_likelihood, single_likelihood
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.likelihood.student import averaged_student_noise, symmetric_whitening
from amibayes.models.parameters import Box

COVARIANCES = ("known", "estimated")
NOISES = ("stated", "extra", "averaged")
RESIDUALS = ("gaussian", "student")
SCOPES = ("common", "per file", "shared calibrators")
BANKS = ("tied", "per band", "motion")
CHANNELS = ("independent", "correlated")
COMPANIONS = (1, 2)
FIELD = (80.0, 200.0)
TRUTH = np.array([120.0, -60.0, 0.05])
HALF = ChannelShare(*[Correlation(0.5, 0.0, 0.5, 0.1)] * 2)
"""Half of the variance is common to the channels of an exposure."""


@cache
def data_of(covariance: str, scope: str, channels: str = "independent") -> Observables:
    """Two files of two bands and dates, errors understated twofold in one of them.

    Of one channel each, or of two that may share some of their noise.
    """
    rng = np.random.default_rng(3)
    parts = []
    for k, (wavelength, width) in enumerate([(4.3e-6, 0.2e-6), (4.8e-6, 0.3e-6)]):
        parted = np.array([0.0] if channels == "independent" else [-0.25, 0.25]) * width
        sheet = point_source(
            NIRISS_HOLES[:5],
            wavelength + parted,
            width / len(parted),
            vis2_error=0.005,
            closure_error_rad=0.005,
            insname=f"NIRISS{k}",
            mjd=60000.0 + 200.0 * k,
        )
        sheet = replace(sheet, setups=(replace(sheet.setups[0], source=f"{k}.oifits"),))
        likelihood = Likelihood(sheet)
        noise = likelihood.noise.draw(1, rng)[:, 0] * (1.0 + k)
        value = likelihood.predict(TRUTH)[:, 0] + noise
        vis2, closure = np.split(value, [sheet.n_vis2])
        parts.append(
            replace(
                sheet,
                vis2=replace(sheet.vis2, value=vis2),
                closure_phase=replace(sheet.closure_phase, value=closure),
            )
        )
    data = join(parts)
    if scope == "shared calibrators":
        data = replace(data, covariance=shared(data))
    if covariance == "estimated":
        data = replace(data, covariance_kind="estimated", freedom=Freedom(80.0, 60.0))
    return data


def shared(data: Observables) -> BlockCovariance:
    """The same, each V² correlated by 0.3 with that of the same baseline in the other file."""
    blocks = [b for b in data.covariance.blocks if b.index.min() >= data.n_vis2]
    variance, half = data.covariance.variance, data.n_vis2 // 2
    for k in range(half):
        at = np.array([k, k + half])
        sigma = np.sqrt(variance[at])
        blocks.append(Block(at, np.outer(sigma, sigma) * np.array([[1.0, 0.3], [0.3, 1.0]])))
    return BlockCovariance(data.covariance.size, blocks)


def likelihood_of(data: Observables, bank: str) -> Likelihood:
    contrast = "per-filter" if bank == "per band" else "tied"
    return joint_likelihood(Likelihood(data), contrast=contrast, motion=bank == "motion")


def theta_of(likelihood: Likelihood, companions: int = 1) -> np.ndarray:
    one = likelihood.model.at_rest(TRUTH[None])[0]
    other = likelihood.model.at_rest(np.array([[-100.0, 70.0, 0.001]]))[0]
    return np.concatenate([one, other][:companions])


@pytest.mark.parametrize("bank", BANKS)
@pytest.mark.parametrize("scope", SCOPES)
@pytest.mark.parametrize("covariance", COVARIANCES)
@pytest.mark.parametrize("channels", CHANNELS)
def test_every_combination_works_or_is_refused(channels, covariance, scope, bank) -> None:
    """Fit the noise, search one data set and null sets, and evaluate the posterior."""
    data = data_of(covariance, scope, channels)
    stated = likelihood_of(data, bank)
    per_file = scope != "common"
    for noise, residuals, companions in product(NOISES, RESIDUALS, COMPANIONS):
        asked = combination_of(
            stated, residuals=residuals, noise=noise, per_file=per_file, channels=channels
        )
        assert asked == Combination(covariance, noise, residuals, scope, bank, channels=channels)
        asked = replace(asked, companions=companions)
        if (why := refusal(asked)) is not None:
            assert (covariance, residuals) == ("estimated", "student")
            with pytest.raises(UsageError, match=why[0]):
                require(asked)
            continue
        if companions == 1:
            fitted, theta = fit(stated, asked, per_file=per_file)
        model = replace(stated.model, companions=companions)
        delivered = fitted.with_model(model)
        sets = np.array([theta_of(stated, companions)] * 2)
        sets[1, 0] += 2000.0 / (1.0 + abs(TRUTH[0]))
        value = delivered.log_prob(sets)
        assert np.isfinite(value).all()
        assert value[0] > value[1], asked
        gain_is_that_of_least_squares(fitted, theta, companions)
        data_and_nulls_have_a_statistic(stated, fitted, theta, asked)


@cache
def profile_of(covariance, scope, bank, residuals, free, channels) -> Likelihood:
    """The likelihood with the noise fitted at the truth, or with outliers' errors stretched."""
    stated, per_file = likelihood_of(data_of(covariance, scope, channels), bank), scope != "common"
    theta, shares = theta_of(stated), ExtraNoise(channels=shares_of(channels))
    if residuals == "student":
        work = RobustFits(with_shared(stated, shares), FIELD, free, per_file=per_file)
        return work.stretched(work.steps(theta, Box(*FIELD, 188.0))[0])
    noise = fit_noise(stated, theta, per_file=per_file) if free else shares
    return with_noise(stated, replace(noise, channels=shares.channels))


def shares_of(channels: str) -> tuple[ChannelShare, ...]:
    return (HALF,) if channels == "correlated" else ()


def fit(stated: Likelihood, asked: Combination, *, per_file: bool):
    """The likelihood that goes with a combination, at the truth."""
    theta, free = theta_of(stated), asked.noise != "stated"
    profile = profile_of(
        asked.covariance, asked.scope, asked.bank, asked.residuals, free, asked.channels
    )
    if asked.noise != "averaged":
        return profile, theta
    fits = [(profile, theta), (single_likelihood(profile), np.empty(0))]
    shares = shares_of(asked.channels)
    if asked.residuals == "student":
        held = with_shared(stated, ExtraNoise(channels=shares)).noise.covariance
        noise = averaged_student_noise(
            profile.noise, stated.observables, fits, covariance=held, per_file=per_file
        )
    else:
        noise = averaged_noise(
            profile.noise,
            stated.observables,
            fits,
            per_file=per_file,
            noise=ExtraNoise(channels=tuple(shares)),
        )
    n_files = (
        2
        if per_file and not (asked.scope == "shared calibrators" and asked.residuals == "gaussian")
        else 1
    )
    assert len(noise.parameters) == 2 * n_files
    return profile.with_noise(noise), theta


def gain_is_that_of_least_squares(fitted: Likelihood, theta: np.ndarray, companions: int) -> None:
    """The bank's gain at one place: contrasts that are not below zero, by the model's slopes."""
    grid = make_grid(100.0, 160.0, 30.0)
    beside = theta if companions == 2 else None
    bank = TemplateBank(fitted, grid, np.empty(0), beside=beside)
    left = fitted.residuals(theta) if companions == 2 else single_likelihood(fitted).residuals([[]])
    gain, at = bank.survey(left[:, 0]).gain, 3
    one, parameters = fitted.model, fitted.parameters
    faint = one.at_rest(np.array([[grid.east_mas[at], grid.north_mas[at], 1e-9]]))
    slopes = fitted.jacobian(faint[0])[:, parameters.contrasts]
    known = np.empty((len(left), 0)) if beside is None else fitted.jacobian(beside)
    basis = np.linalg.qr(known)[0]
    slopes, data = (x - basis @ (basis.T @ x) for x in (slopes, left[:, 0]))
    expected = data @ data - nnls(slopes, data)[1] ** 2
    if one.moves:  # the bank takes the best of some rates, 0 among them
        assert gain[at] >= expected * (1.0 - 1e-4) - 1e-4
    else:
        assert gain[at] == pytest.approx(expected, rel=1e-4, abs=1e-4)


def data_and_nulls_have_a_statistic(
    stated: Likelihood, fitted: Likelihood, theta: np.ndarray, asked: Combination
) -> None:
    """One statistic of the data and of null sets, as the significance asks for it."""
    grid, beside = make_grid(100.0, 160.0, 30.0), theta if asked.companions == 2 else None
    whitening = None
    if asked.residuals == "student":
        fitted, whitening = stated, symmetric_whitening(stated.observables)
    test = make_statistic(fitted, grid, np.empty(0), beside=beside, whitening=whitening)
    null = test.draw_null(3, np.random.default_rng(1))
    assert np.isfinite([test.value, *null]).all(), asked
    if asked.companions == 1:
        assert test.value > null.max(), asked  # a companion of 5 % in data of errors of 0.5 %


@pytest.mark.parametrize("bank", BANKS)
def test_methods_for_one_contrast_at_rest_refuse_more(bank) -> None:
    likelihood = likelihood_of(data_of("known", "common"), bank)
    for method in ("closed limits", "grid posterior"):
        why = refusal(combination_of(likelihood, method=method))
        assert (why is None) == (bank == "tied")


def test_the_documentation_lists_every_refusal() -> None:
    """Each reason that any combination has stands in the page, and the page has no other."""
    methods = ("search", "closed limits", "grid posterior")
    every = starmap(
        Combination,
        product(COVARIANCES, NOISES, RESIDUALS, SCOPES, BANKS, COMPANIONS, methods, CHANNELS),
    )
    reasons = {why[0] for asked in every if (why := refusal(asked)) is not None}
    page = (Path(__file__).parents[2] / "docs" / "statistics.md").read_text(encoding="utf-8")
    section = page.partition("## What is refused")[2].partition("\n## ")[0]
    assert set(re.findall(r'- "([^"]+)":', " ".join(section.split()))) == reasons
