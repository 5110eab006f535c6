"""Channels that err together are noticed; independent ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss, simulated
from interferometer import four_telescopes

from amibayes.companion_search.search import search
from amibayes.data.observables import join
from amibayes.detection.residuals import channel_correlation, chi2_of_kinds, file_residuals
from amibayes.likelihood.channel_noise import ChannelShare, Correlation, noise_with_channels
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.pipeline.warnings import search_warnings

TRUTH = [150.0, -80.0, 0.02]


@pytest.mark.parametrize(("share", "large"), [(0.0, 1.0), (0.6, 1.0), (0.6, 4.0)])
def test_common_errors_of_channels_are_measured(share, large, rng) -> None:
    """Six channels; variance ``share`` in common. 280 pairs: within 5/√280 of the truth.

    Where stated errors are four times too large a mean of channels is within them: 4/16.
    """
    sheet = niriss(channels=6)
    data = simulated(sheet, TRUTH, rng)
    clean = Likelihood(sheet).predict([TRUTH])[:, 0]
    noise = data.data - clean
    parts = []
    for table, error in zip((data.vis2, data.closure_phase), data.errors, strict=True):
        own, noise = noise[: len(table)], noise[len(table) :]
        common = rng.standard_normal(table.row.max() + 1)[table.row] * error
        parts.append(np.sqrt(1.0 - share) * own + np.sqrt(share) * common)
    values = clean + np.concatenate(parts)
    covariance = niriss(0.005 * large, 0.3 * large, channels=6).covariance
    data = replace(data.with_data(values), covariance=covariance)
    result = search(Likelihood(data), (50.0, 400.0))
    correlation, n_pairs = channel_correlation(result)
    assert n_pairs == 5 * 56
    assert correlation == pytest.approx(share, abs=0.3)
    said = search_warnings(data, result, ExtraNoise(), None, None)
    assert any("neighbouring channels" in text for text in said) == (share > 0 and large == 1.0)


def test_one_channel_says_nothing(rng) -> None:
    result = search(Likelihood(simulated(niriss(), TRUTH, rng)), (50.0, 400.0))
    assert channel_correlation(result) == (0.0, 0)


def test_chi2_of_files_adds_up_where_channels_share_errors(rng) -> None:
    """By stated errors alone files had a worst reduced χ² of 0.87 beside 0.25 of the whole fit."""
    parts = []
    for name in "ab":
        sheet = four_telescopes(3)
        data = replace(sheet, setups=tuple(replace(s, source=name) for s in sheet.setups))
        parts.append(simulated(data, [4.0, 5.0, 0.1], rng))
    data = join(parts)
    noise = noise_with_channels(data, [ChannelShare(*[Correlation(0.5, 0.0, 0.5, 0.1)] * 2)])
    result = search(Likelihood(data).with_noise(noise), (2.0, 12.0))
    files = file_residuals(result)
    share = result.ndof / result.likelihood.n_independent
    # 3 exposures in 3 channels: 6 baselines, and 3 independent closure phases of 4 triangles.
    total = sum(share * (54 * f.vis2 + 27 * f.closure_phase) for f in files)
    assert total == pytest.approx(result.chi2_binary, rel=1e-9)
    single = sum(share * (54 * f.single_vis2 + 27 * f.single_closure_phase) for f in files)
    assert single == pytest.approx(result.chi2_single, rel=1e-9)


@pytest.mark.parametrize("large", ["V2", "closure phases"])
def test_errors_that_are_far_too_large_are_those_of_one_kind(large: str, rng) -> None:
    """Four times too large for one kind, right for the other: χ² of both is a third too small."""
    size = {"V2": (0.08, 1.0), "closure phases": (0.02, 4.0)}[large]
    stated = four_telescopes(32, vis2_error=size[0], closure_error_deg=size[1])
    truth = four_telescopes(32, vis2_error=0.02, closure_error_deg=1.0)
    data = stated.with_data(simulated(truth, [4.0, 5.0, 0.1], rng).data)
    result = search(Likelihood(data), (2.0, 12.0))
    kinds = chi2_of_kinds(result)
    n = {"V2": len(data.vis2), "closure phases": data.covariance.rank - len(data.vis2)}
    left = result.likelihood.difference(result.theta)[:, 0] / np.concatenate(data.errors)
    assert kinds["V2"][0] == pytest.approx((left[: n["V2"]] ** 2).sum())
    assert sum(chi2 for chi2, _ in kinds.values()) == pytest.approx(result.chi2_binary)
    for kind, (chi2, dof) in kinds.items():
        expected = dof / (16.0 if kind == large else 1.0)
        assert dof == pytest.approx(n[kind], rel=0.02)
        assert chi2 == pytest.approx(expected, abs=5.0 * expected * np.sqrt(2.0 / dof))
    said = [w for w in search_warnings(data, result, ExtraNoise(), None, None) if " too large" in w]
    assert [f"errors of {kind}" in said[0] for kind in kinds] == [kind == large for kind in kinds]
    times = float(said[0].split(" times too large")[0].split()[-1])
    # 192 V² or 96 independent closure phases tell it to a fourteenth; five times that.
    assert times == pytest.approx(4.0, rel=0.35)
