"""The comparison of models in the report: numbers, words and pictures."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

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
from amibayes.models.parameters import parameter_words
from amibayes.plots.models import (
    PIXELS,
    _percent,
    image_of,
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
from amibayes.report.statement import sky_of, statement_of

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
    assert section.text[0].startswith("A Gaussian disc, inclined: ")
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


def test_a_disc_has_no_rings(found: ModelComparison) -> None:
    """Its quadrature has, where its circles are farther apart than the beam."""
    disc = found.models[2]
    image = image_of(disc, 400.0, 20.0)
    middle = PIXELS // 2
    for ray in (image[middle, middle:], image[middle:, middle], np.diag(image)[middle:]):
        assert (np.diff(ray) < 0.0).all()


def test_light_outside_of_the_field_and_without_a_shape_is_told() -> None:
    """Over-resolved light is written down; light outside of the field has one of its own."""
    model = Hypothesis("halo").model(BinaryModel())
    base = Likelihood(simulated(niriss(), [0.05], np.random.default_rng(1), model))
    found = compare_sky_models(
        search(base, (300.0, 400.0)),
        Prior(300.0, 400.0, contrast_min=1e-4),
        np.random.default_rng(2),
        models=["star", "companion", "halo"],
        confusion_draws=0,
    )
    assert found.best.name == "halo"
    panels = {ax.get_title().partition(":")[0]: ax for ax in model_images(found).axes}
    texts = {name: ax.texts[0].get_text() for name, ax in panels.items() if ax.texts}
    halo = 100.0 * found.best.theta[0]
    assert texts["star"] == "nothing around"
    assert texts["halo"] == f"+ {halo:.1f} % over-resolved"
    assert texts["companion"].startswith("field of ±")
    assert panels["companion"].images[0].get_array().max() > 0.5 * found.models[1].theta[2]


def test_notes_and_legends_cover_nothing(found: ModelComparison, tmp_path: Path) -> None:
    """Notes end inside their panels; the legend stands above the data."""
    figure = model_images(found)
    save(figure, tmp_path / "images.png")
    for ax in figure.axes:
        assert ax.title.get_window_extent().y1 <= figure.bbox.y1
        for text in ax.texts:
            inside, panel = text.get_window_extent(), ax.get_window_extent()
            assert panel.x0 <= inside.x0
            assert inside.x1 <= panel.x1
    figure = model_visibilities(found)
    save(figure, tmp_path / "visibilities.png")
    legend, panel = figure.axes[0].get_legend(), figure.axes[0].get_window_extent()
    assert legend.get_window_extent().y0 >= panel.y1


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.9996, "> 99.9 %"), (0.9993, "99.9 %"), (0.997, "99.7 %"), (0.9949, "99 %"),
     (0.61, "61 %"), (0.0123, "1.2 %"), (1e-4, "< 0.1 %")],
)  # fmt: skip
def test_percents_of_the_odds(share: float, words: str) -> None:
    assert _percent(share) == words


def test_every_parameter_has_its_prior_in_words(found: ModelComparison) -> None:
    for model in models_json(found, None)["models"]:
        assert set(model["parameters"]) <= set(model["prior"])
    companion, disc = (models_json(found, None)["models"][k]["prior"] for k in (1, 2))
    assert companion["east_mas"] == "that of the position: uniform in area, 60 to 400 mas"
    assert disc["disc_inclination_deg"] == (
        "that of its cosine, the axis ratio: uniform, 0.05 to 1"
    )


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


def _content(verdict: str, model: str, *, agrees: bool | None, leads: bool) -> dict[str, Any]:
    """As much of result.json as the statement needs."""
    errors = {"separation_mas": 0.1, "position_angle_deg": 1.0, "delta_mag": 0.1}
    return {
        "verdict": {"statement": verdict, "because": "noise never does that", "note": ""},
        "model_verdict": {
            "statement": model, "summary": f"a {model} explains the data better", "leads": leads,
            "agrees": agrees, "fits": True,
        },
        "fit": {"separation_mas": 1.07, "position_angle_deg": 20.0, "delta_mag": 2.0,
                "east_mas": 0.4, "north_mas": 1.0, "contrast": 0.1, "errors": errors},
        "data": {"separation_mas": [1.0, 7.0]},
        "significance": {"detected": verdict == "companion", "false_alarm_probability": None,
                         "n_null_draws": 0},
        "modes": [{}], "limits": None, "posterior": None,
    }  # fmt: skip


def test_the_comparison_heads_the_page_where_it_contradicts_the_verdict() -> None:
    content = _content("companion", "crescent", agrees=False, leads=True)
    said = statement_of(content)
    assert (said.kind, said.label) == ("found", "A crescent")
    assert said.headline == "A crescent explains the data better (see Companion or disc)."
    assert said.sentences[0].startswith("With one companion and nothing else the best fit is at")
    assert [mark.kind for mark in sky_of(content).marks] == ["candidate"]
    rejected = statement_of(_content("model rejected", "ring", agrees=False, leads=True))
    assert rejected.label == "A ring"
    assert rejected.sentences[0] == (
        "A star with at most one companion is rejected: noise never does that."
    )
    content["model_verdict"]["fits"] = False
    assert statement_of(content).kind == "open"


def test_the_verdict_heads_the_page_where_the_comparison_agrees() -> None:
    content = _content("companion", "companion", agrees=True, leads=False)
    said = statement_of(content)
    assert said.label == "Companion detected"
    assert "A companion explains the data better (see Companion or disc)." in said.sentences
    assert [mark.kind for mark in sky_of(content).marks] == ["companion"]


def test_names_of_parameters_in_words() -> None:
    assert parameter_words("east_mas_2") == "east of companion 2 (mas)"
    assert parameter_words("position_angle_deg_2") == "position angle of companion 2 (°)"
    assert parameter_words("ring_diameter_mas") == "ring diameter (mas)"
    assert parameter_words("contrast[NIRISS_4.82um]") == "contrast, NIRISS\u00a04.82\u00a0µm"
    assert parameter_words("disc_flux") == "disc flux"
