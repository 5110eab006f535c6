"""Data in the few combinations that templates span: the same searches, the same noise."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss
from scipy import stats

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.reduction import Reduction, reduction_of
from amibayes.companion_search.scan import scale_groups
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.statistic import make_statistic
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel


@pytest.fixture(scope="module")
def likelihood() -> Likelihood:
    """Many channels, a small field: thousands of data that see the same fringes."""
    return Likelihood(niriss(channels=40), BinaryModel(diameter_mas="free"))


@pytest.fixture(scope="module")
def banks(likelihood: Likelihood) -> tuple[TemplateBank, TemplateBank]:
    bank = TemplateBank(likelihood, make_grid(50.0, 160.0, 16.0), np.array([30.0]))
    label = scale_groups(likelihood.observables, 1).label
    return bank, bank.reduced(label)


def test_searches_are_the_same_in_few_numbers(banks, rng) -> None:
    full, few = banks
    assert few.n_rows < 0.2 * full.n_data
    assert few.n_data == full.n_data
    white = rng.standard_normal((full.n_data, 12))
    reduced = few.reduce(white)
    np.testing.assert_allclose((reduced**2).sum(axis=0), (white**2).sum(axis=0))
    for a, b in zip(white.T, reduced.T, strict=True):
        contrast, sigma = full.scan(a)
        found, error = few.scan(b)
        np.testing.assert_allclose(error, sigma, rtol=1e-6)
        np.testing.assert_allclose(found / error, contrast / sigma, atol=2e-3)
    places = rng.uniform(-110.0, 110.0, (2, 9))
    products = [b.templates_at(*places).T @ b.templates_at(*places) for b in banks]
    np.testing.assert_allclose(products[0], products[1], atol=1e-4)


def test_projected_data_are_the_same(banks, rng) -> None:
    full, few = banks
    white = rng.standard_normal((full.n_data, 5))
    one, other = few.reduce(full.project(white)), few.project(few.reduce(white))
    np.testing.assert_allclose(one, other, atol=1e-4)


def test_the_statistic_is_that_of_all_data(likelihood, banks, rng) -> None:
    test = make_statistic(likelihood, banks[0].grid, np.array([30.0]))
    assert test.bank.reduction is not None
    whole = type(test.treatment)(
        scale_groups(likelihood.observables, 1), np.ones(likelihood.n_independent)
    )
    white = rng.standard_normal((likelihood.n_independent, 6))
    found = whole.search(banks[0], white)
    hits = test.hits(white)
    np.testing.assert_allclose(hits.statistic, test.ratio(found.gain, found.chi2), rtol=2e-3)


def test_noise_drawn_in_few_numbers_is_that_of_the_data(banks) -> None:
    full, few = banks
    rng = np.random.default_rng(5)
    drawn = few.reduce(rng.standard_normal((full.n_data, 400)))
    direct = few.normals(400, rng)
    for a, b in zip(drawn[-2:], direct[-2:], strict=True):
        assert stats.ks_2samp(a, b).pvalue > 1e-4
    gains = [few.largest_gain(few.project(x).astype(np.float32))[0] for x in (drawn, direct)]
    assert stats.ks_2samp(*gains).pvalue > 1e-4


def test_rests_add_at_right_angles() -> None:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((500, 3)))[0]
    reduction = Reduction((np.arange(500),), (basis,))
    noise, signal = rng.standard_normal((500, 200)), 0.2 * rng.standard_normal((500, 200))
    added = reduction.added(reduction(noise), reduction(signal))
    np.testing.assert_allclose(added[:3], reduction(noise + signal)[:3])
    assert added[3].mean() == pytest.approx(reduction(noise + signal)[3].mean(), rel=5e-3)


def test_templates_that_span_all_data_are_left_as_they_are(rng) -> None:
    templates = rng.standard_normal((300, 5000))
    label, beside = np.zeros(300, dtype=int), np.empty((300, 0))
    assert reduction_of(lambda index: templates[:, index], 5000, beside, label) is None
