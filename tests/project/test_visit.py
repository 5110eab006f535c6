"""The page on a visit of JWST: its commands run on a simulated visit in exactly its files."""

from __future__ import annotations

import base64
import json
import re
import shlex
from pathlib import Path
from types import ModuleType

import pytest
from conftest import script

from amibayes.cli import main

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "jwst_visit.md"

QUICK = {
    "extract": [],
    "vet": [],
    "search": ["--null-draws", "50", "--no-posterior", "--no-limits", "--separation", "130:170"],
    "limits": ["--separation", "130:170"],
}

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNk+A8AAQUBAScY42YAAAAASUVORK5CYII="
)
"""The smallest PNG."""


def commands() -> list[list[str]]:
    """Words of every command of the page's blocks of bash, amibayes left out."""
    blocks = re.findall(r"^```bash\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    return [shlex.split(line)[1:] for block in blocks for line in block.splitlines()]


def expanded(words: list[str], folder: Path) -> list[str]:
    """Words with files in place of patterns, as a shell gives them."""
    found = []
    for word in words:
        files = sorted(str(p) for p in folder.glob(word)) if "*" in word else []
        found += files or [word]
    return found


@pytest.fixture(scope="module")
def visit() -> ModuleType:
    return script("jwst_visit")


@pytest.fixture(scope="module")
def folder(visit: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("visit")
    visit.write_visit(folder, n_pixels=40, n_integrations=6, n_groups=5)
    return folder


def not_drawn(figure: object, path: str | Path, **options: object) -> None:
    """One pixel in the place of a picture, whose content other tests look at."""
    Path(path).write_bytes(PIXEL)


def marked() -> list[object]:
    """The page's commands; all but a look at images and a search of ramps are dear."""
    found = []
    for words in commands():
        name = f"{words[0]}-{words[-1]}"
        marks = [] if name in ("extract-look", "search-ramps") else [pytest.mark.slow]
        found.append(pytest.param(words, id=name, marks=marks))
    return found


@pytest.mark.parametrize("words", marked())
def test_the_commands_of_the_page_run(
    words: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", not_drawn)
    given = expanded(words, folder)
    assert not any("*" in word for word in given)
    assert main([*given, *QUICK[words[0]], "--quiet"]) == 0


def test_raw_ramps_are_refused_with_the_step_that_comes_next(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (raw,) = folder.glob("*_uncal.fits")
    assert main(["search", str(raw), "--out", str(folder / "raw")]) == 3
    assert "calwebb_detector1" in capsys.readouterr().err


def test_ramps_and_slopes_of_an_exposure_are_refused(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    both = sorted(map(str, folder.glob("*02001_*_nis_[cr]*.fits")))
    assert len(both) == 2
    assert main(["search", *both, "--out", str(folder / "both")]) == 2
    assert "is of the same exposure as" in capsys.readouterr().err


@pytest.mark.slow
def test_the_visit_gives_its_companion(visit: ModuleType, tmp_path: Path) -> None:
    visit.write_visit(tmp_path, n_pixels=64, n_integrations=20)
    for kind in ("calints", "ramp"):
        target, cals = (
            sorted(map(str, tmp_path.glob(f"jw09999{o}001_*_{kind}.fits")))
            for o in ("001", "00[23]")
        )
        words = ["search", *target, "--cal", *cals, "--out", str(tmp_path / kind), "--quiet"]
        assert main([*words, "--null-draws", "3000", "--no-posterior", "--no-limits"]) == 0
        result = json.loads((tmp_path / kind / "result.json").read_text())
        fit = result["fit"]
        assert result["verdict"]["statement"] == "companion"
        assert abs(fit["separation_mas"] - 150.0) < 5.0 * fit["errors"]["separation_mas"]
        assert abs(fit["delta_mag"] - 5.0) < 5.0 * fit["errors"]["delta_mag"]
