"""Parts that agree give uniform probabilities, parts that do not are found out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import niriss, simulated
from interferometer import common_errors, four_telescopes
from scipy import stats

from amibayes.companion_search.optimise import refine
from amibayes.data.blocks import Block, BlockCovariance
from amibayes.data.observables import Observables, join
from amibayes.data.systematics import Systematics
from amibayes.detection.consistency import (
    _apart,
    _apart_by_noise,
    _kinds,
    _Part,
    _share_errors,
    by_night,
    compare,
)
from amibayes.likelihood.channel_noise import ChannelShare, Correlation, noise_with_channels
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box

TRUTH = [150.0, -80.0, 0.02]
BOX = Box(50.0, 400.0, 188.0)


def at(data: Observables, mjd: float, source: str) -> Observables:
    """The same data of another date and file."""
    dated = [replace(t, mjd=np.full(len(t), mjd)) for t in (data.vis2, data.closure_phase)]
    setups = tuple(replace(s, source=source) for s in data.setups)
    return replace(data, vis2=dated[0], closure_phase=dated[1], setups=setups)


def fitted(data: Observables, model: BinaryModel | None = None, theta=None):
    likelihood = Likelihood(data, model)
    start = np.array(TRUTH if theta is None else theta)
    return likelihood, np.array(refine(likelihood, start, BOX, 0.0).theta)


def test_probability_is_uniform_where_the_parts_agree(rng) -> None:
    """80 binaries of 2 %, V² against closure phases, errors understated twofold: KS p > 1e-4."""
    sheet, found = niriss(), []
    for _ in range(80):
        noise = 2.0 * sheet.covariance.draw(rng, 1)[:, 0]
        clean = simulated(sheet, TRUTH, None)
        vis2, closure = np.split(clean.data + noise, [21])
        data = replace(
            clean,
            vis2=replace(clean.vis2, value=vis2),
            closure_phase=replace(clean.closure_phase, value=closure),
        )
        likelihood, theta = fitted(data)
        found.append(compare(likelihood, theta, "observables", _kinds(data), rng, 199).p)
    p = np.array(found)
    assert stats.kstest(p, "uniform").pvalue > 1e-4
    assert stats.binomtest(int((p < 0.05).sum()), 80, 0.05).pvalue > 1e-4


def test_probability_is_uniform_for_few_data(rng) -> None:
    """One exposure of four telescopes: 6 V² and 3 independent closure phases; KS p > 1e-4."""
    sheet, truth, found = four_telescopes(1, 1), np.array([5.0, -4.0, 0.2]), []
    clean = simulated(sheet, truth, None).data
    for noise in 0.1 * sheet.covariance.draw(rng, 150).T:
        data = sheet.with_data(clean + noise)
        likelihood = Likelihood(data)
        theta = np.array(refine(likelihood, truth, Box(2, 15, 3.1), 0.0).theta)
        found.append(compare(likelihood, theta, "observables", _kinds(data), rng, 400).p)
    assert stats.kstest(found, "uniform").pvalue > 1e-4
    assert stats.binomtest(int((np.array(found) < 0.05).sum()), 150, 0.05).pvalue > 1e-4


def test_star_and_background_may_differ_between_parts(rng) -> None:
    """A disc that V² of one night calibrates wrongly is no other companion."""
    model = BinaryModel(diameter_mas="free")
    sheet = four_telescopes(4)
    truth = [5.0, -4.0, 0.05]
    nights = [
        at(simulated(sheet, [*truth, d], rng, model), 60000.0 + k, "ab"[k])
        for k, d in enumerate((1.0, 1.1))
    ]
    data = join(nights)
    likelihood = Likelihood(data, model)
    theta = np.array(refine(likelihood, np.array([*truth, 1.05]), Box(2, 15, 3.1), 0.0).theta)
    found = compare(likelihood, theta, "epochs", by_night(data), rng)
    assert found.p > 1e-3
    assert len(found.parts) == 2


def test_a_companion_that_moved_between_nights_is_found_out(rng) -> None:
    sheet = niriss()
    first = at(simulated(sheet, TRUTH, rng), 60000.0, "a")
    there = at(simulated(sheet, [150.0, -40.0, 0.02], rng), 60030.0, "b")
    data = join([first, there])
    likelihood, theta = fitted(data)
    found = compare(likelihood, theta, "epochs", by_night(data), rng)
    assert found.p < 1e-3
    assert found.delta_chi2 > 30.0
    assert found.parts == ("MJD 60000.000", "MJD 60030.000")


def test_delta_chi2_is_that_of_fits_of_the_parts(rng) -> None:
    """Against nonlinear fits of each kind of data by itself; the Taylor series is cut at 1 %."""
    data = simulated(niriss(), [150.0, -80.0, 0.02], rng)
    likelihood, theta = fitted(data)
    found = compare(likelihood, theta, "observables", _kinds(data), rng)
    apart = 0.0
    for kind in ("vis2", "cp"):
        part, own = fitted(data.only((kind,)))
        apart += float(part.chi2(own)[0])
    assert found.delta_chi2 == pytest.approx(likelihood.chi2(theta)[0] - apart, rel=0.2, abs=0.1)


def test_slopes_by_noise_are_those_of_noise_that_is_drawn(rng) -> None:
    """Gains of two nights whose channels share noise: 2000 data sets against 2000 slopes, KS."""
    sheet = four_telescopes(4)
    nights = [at(simulated(sheet, [5.0, -4.0, 0.05], rng), 60000.0 + k, "ab"[k]) for k in (0, 1)]
    data = join(nights)
    masks = list(by_night(data).values())
    share = ChannelShare(Correlation(0.4, 0.3, 0.58, 0.1), Correlation(0.3, 0.2, 0.44, 0.1))
    parts = []
    for mask in masks:
        one = data.select(mask[: data.n_vis2], mask[data.n_vis2 :])
        own = Likelihood(one).with_noise(noise_with_channels(one, [share]))
        parts.append(_Part.of(own, np.array([5.0, -4.0, 0.05]), mask))
    noise = np.empty((len(data.data), 2000))
    for part in parts:
        noise[part.mask] = part.likelihood.noise.draw(2000, rng)
    drawn, quick = _apart(parts, noise), _apart_by_noise(parts, 2000, rng)
    for by_data, by_slopes in zip(drawn, quick, strict=True):
        assert stats.ks_2samp(by_data, by_slopes).pvalue > 1e-4
    # Three parameters that two parts have for themselves, and together.
    assert stats.kstest(quick[1], stats.chi2(3).cdf).pvalue > 1e-4


@pytest.mark.parametrize("size", [1.0, pytest.param(0.3, marks=pytest.mark.slow)])
def test_gains_within_their_floor_make_no_disagreement(
    size: float, rng: np.random.Generator
) -> None:
    """V² against closure phases, 60 binaries of 10 %: no more p below 0.05 than stated.

    Channels of an exposure share a gain and an offset, as large as the floor or 0.3 of it.
    """
    model, truth = BinaryModel(diameter_mas=0.5), [5.0, -4.0, 0.1]
    sheet, floors = four_telescopes(4, 6), (Systematics("", 0.05, np.radians(1.0)),)
    floors = tuple(replace(f, source=sheet.setups[0].source) for f in floors)
    clean = Likelihood(sheet, model).predict(np.array([truth]))[:, 0]
    found = []
    for _ in range(60):
        gains = np.sqrt(0.5) * size * common_errors(sheet, 0.05, np.radians(1.0), rng)
        gains[: sheet.n_vis2] *= clean[: sheet.n_vis2]
        data = sheet.with_data(clean + gains + sheet.covariance.draw(rng, 1)[:, 0])
        noise = noise_with_channels(data, (), floors)
        likelihood = Likelihood(data, model).with_noise(noise)
        theta = np.array(refine(likelihood, np.array(truth), Box(2, 15, 3.1), 0.0).theta)
        extra, parts = ExtraNoise(floors=floors), _kinds(data)
        found.append(compare(likelihood, theta, "observables", parts, rng, 400, None, extra).p)
    below = int((np.array(found) < 0.05).sum())
    assert stats.binom.sf(below - 1, 60, 0.05) > 1e-4


def test_kinds_that_share_errors_are_drawn_together(rng: np.random.Generator) -> None:
    """A stated covariance may have V² and closure phases share errors."""
    sheet = niriss()
    assert not _share_errors(Likelihood(sheet), list(_kinds(sheet).values()))
    whole, n = np.diag(sheet.covariance.variance), sheet.n_vis2
    sigma = np.sqrt(np.diag(whole))
    whole[0, n] = whole[n, 0] = 0.3 * sigma[0] * sigma[n]
    block = Block(np.arange(len(whole)), whole)
    shared = replace(sheet, covariance=BlockCovariance(len(whole), [block]))
    likelihood = Likelihood(shared)
    assert _share_errors(likelihood, list(_kinds(shared).values()))
    found = compare(likelihood, np.array(TRUTH), "observables", _kinds(shared), rng, 200)
    assert 0.0 < found.p <= 1.0


@pytest.mark.parametrize("unexplained", [0, 3])
def test_the_rest_of_noise_is_what_no_parameter_explains(
    unexplained: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the companion of all data takes is no part of it; without a rest nothing is told."""
    parts = [SimpleNamespace(unexplained=unexplained, slopes_of_noise=lambda n, rng: None)]
    parts[0].likelihood = SimpleNamespace(noise=SimpleNamespace(floor=False))
    n = 20_000
    each, together = np.full(n, 9.0), np.linspace(1.0, 11.0, n)
    monkeypatch.setattr("amibayes.detection.consistency._gains", lambda *_: (each, together))
    ratio, gain = _apart_by_noise(parts, n, np.random.default_rng(1))  # type: ignore[arg-type]
    np.testing.assert_array_equal(gain, np.maximum(9.0 - together, 0.0))
    if not unexplained:
        np.testing.assert_array_equal(ratio, 0.0)
        return
    rest = gain[gain > 0.0] / ratio[gain > 0.0]
    assert rest.mean() == pytest.approx(unexplained, abs=0.1)
    assert rest.var() == pytest.approx(2.0 * unexplained, abs=0.3)
