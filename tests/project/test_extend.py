"""The page on extending amibayes is run as it is, and what it adds works like what there was."""

from __future__ import annotations

import copy
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from scipy import integrate, stats
from test_docs import python_of

from amibayes.extraction import reading
from amibayes.models.binary import BinaryModel
from amibayes.posterior.priors import Prior
from amibayes.posterior.sampler import ModelPrior
from amibayes.report.search_page import SECTIONS
from amibayes.support.options import EXTRACTION_METHODS, SAMPLERS, entry
from amibayes.units import MAS

TABLES = (EXTRACTION_METHODS, SAMPLERS, SECTIONS)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> SimpleNamespace:
    """Names that the page leaves; the tables are as before afterwards."""
    folder = tmp_path_factory.mktemp("extend")
    for name in ("examples", "docs"):
        (folder / name).symlink_to(ROOT / name)
    (folder / "page.py").write_text("\n".join(python_of(ROOT / "docs" / "howto" / "extend.md")))
    before = [copy.copy(table) for table in TABLES]
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(str(folder))
        patch.setattr(reading, "FORMATS", reading.FORMATS)
        yield SimpleNamespace(**runpy.run_path(str(folder / "page.py")))
    for table, content in zip(TABLES, before, strict=True):
        table.clear()
        table.update(content)
    for name in ("plain_fringes", "prior_draws"):
        sys.modules.pop(name, None)


def test_a_component_is_fitted_and_its_slopes_are_right(page: SimpleNamespace) -> None:
    likelihood, theta = page.likelihood, np.array([[110.0, -75.0, 0.02, 0.03]])
    assert likelihood.parameters.names == ("east_mas", "north_mas", "contrast", "halo")
    _, gradient = likelihood.log_prob_and_gradient(theta)
    for k, step in enumerate((1e-4, 1e-4, 1e-7, 1e-7)):
        ends = likelihood.log_prob(
            np.repeat(theta, 2, 0) + np.array([[-step], [step]]) * np.eye(4)[k]
        )
        assert gradient[0, k] == pytest.approx((ends[1] - ends[0]) / (2.0 * step), rel=1e-4)
    wave = page.Halo(100.0).source(likelihood.samples, np.ones((1, 1))).wave[:, 0]
    # A Gaussian of this width at half of its height has half its visibility at 2 ln 2/(pi FWHM).
    half = 2.0 * np.log(2.0) / (np.pi * 100.0 * MAS)
    expected = 0.5 ** ((likelihood.samples.frequency / half) ** 2)
    np.testing.assert_allclose(wave, expected, rtol=1e-12)
    assert page.found.companion.separation_mas > 94.0


def test_a_noise_model_is_what_the_likelihood_uses(page: SimpleNamespace) -> None:
    theta = page.found.theta[None]
    white = page.likelihood.residuals(theta)[:, 0]
    difference = (stats.norm.logpdf(white) - stats.t.logpdf(white, 4.0)).sum()
    assert page.loss == pytest.approx(difference, rel=1e-9)


def test_a_statistic_is_tested_by_its_own_null_draws(page: SimpleNamespace) -> None:
    found = page.chance
    assert found.n_draws == 200
    above = (found.null >= page.test.evaluate(page.test.observed[:, None])[0]).sum()
    assert found.probability == pytest.approx((1 + above) / 201)


def test_a_sampler_measures_an_evidence_that_is_known(page: SimpleNamespace) -> None:
    prior = Prior(60.0, 400.0, 1e-3, 1.0)
    flat = ModelPrior(prior, BinaryModel().parameters)
    found = entry("prior_draws:PriorDraws")().sample(
        lambda theta: -theta[:, 2], flat, np.random.default_rng(1)
    )
    known = integrate.quad(lambda ln_c: np.exp(-np.exp(ln_c)), np.log(1e-3), 0.0)[0] / np.log(1e3)
    error = found.diagnostics["log_z_error"]
    assert abs(found.diagnostics["log_z"] - np.log(known)) < 4.0 * error < 0.01
    assert found.n_effective > 100_000
    assert "prior" in SAMPLERS


def test_a_method_of_extraction_measures_a_star(page: SimpleNamespace) -> None:
    np.testing.assert_allclose(page.plain.vis2.value, 1.0, atol=0.02)
    assert np.abs(page.plain.closure_phase.value).max() < 0.01


def test_an_instrument_and_a_format_are_read(page: SimpleNamespace) -> None:
    assert page.mycam.mask.non_redundant
    np.testing.assert_array_equal(page.star.vis2.value, 1.0)


def test_a_section_is_in_the_report(page: SimpleNamespace) -> None:
    section = SECTIONS["bound"]({"fit": {"separation_mas": 100.0}})
    assert section is not None
    assert section.text == ("Its period would be some 1.0 years.",)


def test_the_page_has_every_drill() -> None:
    text = Path(ROOT / "docs" / "howto" / "extend.md").read_text(encoding="utf-8")
    for kind in (
        "source component", "noise model", "statistic", "sampler", "method of extraction",
        "instrument", "input format", "section of the report",
    ):  # fmt: skip
        assert f"{kind}\n\n" in text
