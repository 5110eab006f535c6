"""Pictures beside the numbers of a search: what one that fails, or that is not drawn, leaves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from commands import run

from amibayes.errors import RunError
from amibayes.plots import pictures

QUICK = ("--separation", "60:300", "--null-draws", 0, "--no-posterior", "--no-limits")


def _spoil(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fail(*of: object) -> None:
        raise error

    monkeypatch.setattr(pictures, "_save_picture", fail)


def test_a_picture_that_fails_leaves_the_numbers(target, tmp_path, monkeypatch) -> None:
    _spoil(monkeypatch, TypeError("'Axes' object is not subscriptable"))
    assert run("search", target, *QUICK, "--workers", 1, "--out", tmp_path / "out") == 4
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    assert content["fit"]["contrast"] > 0.0


def test_a_full_disk_leaves_a_run_that_goes_on(target, tmp_path, monkeypatch) -> None:
    """The result is written last: where it is, nothing is left to do."""
    out = tmp_path / "out"
    with monkeypatch.context() as patched:
        _spoil(patched, RunError("cannot be written: No space left on device"))
        assert run("search", target, *QUICK, "--workers", 1, "--out", out) == 4
    assert not (out / "result.json").exists()
    assert run("search", target, *QUICK, "--workers", 1, "--out", out, "--resume") == 0
    assert (out / "result.json").exists()


def test_models_without_parameters_have_no_corner(star: Path, tmp_path: Path) -> None:
    """The star of this search is a point; pictures of an earlier run do not stay."""
    out = tmp_path / "out"
    words = ("search", star, *QUICK, "--diameter", 0, "--workers", 1, "--out", out)
    assert run(*words, "--models", "star,companion") == 0
    assert (out / "models_corner.png").exists()
    assert run(*words, "--models", "star", "--overwrite") == 0
    assert (out / "models_odds.png").exists()
    assert not (out / "models_corner.png").exists()
    assert run(*words, "--overwrite") == 0
    assert not list(out.glob("models_*.png"))


def test_a_star_whose_diameter_is_free_has_a_corner(star: Path, tmp_path: Path) -> None:
    """It is the one parameter of the most probable model."""
    words = ("--diameter", "free", "--models", "star,companion", "--workers", 1)
    assert run("search", star, *QUICK, *words, "--out", tmp_path / "out") == 0
    content = json.loads((tmp_path / "out" / "result.json").read_text())
    best = max(content["models"], key=lambda m: m["probability"])
    assert list(best["parameters"]) == ["diameter_mas"]
    assert (tmp_path / "out" / "models_corner.png").exists()
