"""The comparison of models in the report: numbers, words and pictures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from commands import run
from helpers import niriss, simulated

from amibayes.companion_search.search import search
from amibayes.comparison.compare import ModelComparison, compare_sky_models
from amibayes.comparison.hypotheses import Hypothesis
from amibayes.comparison.summary import intervals, weighted_quantile
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.plots.models import (
    model_corner,
    model_images,
    model_odds,
    model_residuals,
    model_visibilities,
    sources_of,
)
from amibayes.plots.style import save
from amibayes.posterior.priors import Prior
from amibayes.report.models import models_json, models_lines, models_section

TRUTH = [0.03, 220.0, 0.6, 30.0]


@pytest.fixture(scope="module")
def found() -> ModelComparison:
    model = Hypothesis("disc").model(BinaryModel())
    base = Likelihood(simulated(niriss(), TRUTH, np.random.default_rng(1), model))
    return compare_sky_models(
        search(base, (60.0, 400.0)),
        Prior(60.0, 400.0, contrast_min=1e-4),
        np.random.default_rng(2),
        models=["star", "companion", "disc"],
        confusion_draws=3,
    )


def test_numbers_words_and_lines_agree(found: ModelComparison) -> None:
    content = json.loads(json.dumps(models_json(found, None)))
    assert [m["model"] for m in content["models"]] == ["star", "companion", "disc"]
    assert content["model_verdict"]["statement"] == found.verdict.statement == "disc"
    shares = [v for k, v in content["confusion"].items() if k.startswith("disc taken for")]
    assert sum(shares) == pytest.approx(1.0)
    section = models_section(content)
    assert section.text[0].startswith("A Gaussian disc, inclined: ".capitalize())
    assert [t.caption for t in section.tables][-1].endswith("disc")
    lines = models_lines(found)
    assert lines[0].startswith("models")
    assert "DISC" in lines[0]
    assert "disc -> " in lines[2]


def test_intervals_hold_the_truth(found: ModelComparison) -> None:
    """Within five of their own half widths."""
    known = intervals(found.models[2])
    names = [p.name for p in found.models[2].fit.model.likelihood.parameters]
    for name, truth in zip(names, TRUTH, strict=True):
        i = known[name]
        assert abs(i.median - truth) < 5.0 * 0.5 * (i.upper - i.lower)
    ratio, tilt = known["disc_axis_ratio"], known["disc_inclination_deg"]
    assert np.cos(np.radians(tilt.median)) == pytest.approx(ratio.median, abs=1e-6)


def test_weighted_quantile_against_repeated_values(rng) -> None:
    values, counts = rng.standard_normal(400), rng.integers(1, 5, 400)
    expected = np.quantile(np.repeat(values, counts), [0.16, 0.5, 0.84], method="hazen")
    found = weighted_quantile(values, counts / counts.sum(), (0.16, 0.5, 0.84))
    np.testing.assert_allclose(found, expected, atol=0.02)


def test_light_of_a_picture_is_the_flux(found: ModelComparison) -> None:
    east, north, light = sources_of(found.models[2])
    assert light.sum() == pytest.approx(found.models[2].theta[0])
    size = np.sqrt((light * (east**2 + north**2)).sum() / light.sum())
    width, ratio = found.models[2].theta[1] / np.sqrt(8.0 * np.log(2.0)), found.models[2].theta[2]
    assert size == pytest.approx(width * np.hypot(1.0, ratio), rel=1e-3)


def test_every_picture_is_drawn(found: ModelComparison, tmp_path: Path) -> None:
    for draw in (model_images, model_odds, model_visibilities, model_residuals, model_corner):
        save(draw(found), tmp_path / f"{draw.__name__}.png")
        assert (tmp_path / f"{draw.__name__}.png").stat().st_size > 10_000


def test_an_unknown_model_is_refused(target: Path, tmp_path: Path, capsys) -> None:
    assert run("search", target, "--models", "star,spiral", "--out", tmp_path / "out") == 2
    assert "spiral" in capsys.readouterr().err


@pytest.mark.slow
def test_search_compares_models(target: Path, tmp_path: Path) -> None:
    words = ["--models", "star,companion,ring", "--no-limits", "--no-posterior"]
    words += ["--null-draws", "0", "--prior", "ring_diameter=100:300"]
    assert run("search", target, *words, "--out", tmp_path / "out") == 0
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert content["model_verdict"]["statement"] == "companion"
    assert content["models"][2]["prior"]["ring_diameter_mas"] == "log-uniform, 100 to 300 mas"
    assert (tmp_path / "out" / "models_odds.png").exists()
