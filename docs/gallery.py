"""Every picture that the commands draw, of the example data and of a simulated cube.

python docs/gallery.py [FOLDER]
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from pathlib import Path

import numpy as np

import amibayes as ab
from amibayes.cli import main as amibayes_command
from amibayes.extraction import extract_all
from amibayes.plots.extraction import (
    correlations,
    fit_images,
    frame_plot,
    observables_plot,
    power_plot,
    time_plot,
)
from amibayes.plots.instrument import instrument_picture
from amibayes.plots.style import save
from amibayes.simulation.program import example

ROOT = Path(__file__).resolve().parent.parent
DATA = Path("examples") / "data"


def search_pictures(folder: Path) -> None:
    """The main job on the example data, as the first page runs it: pictures and report."""
    target, *cals = (str(DATA / f"{name}.oifits") for name in ("target", "cal1", "cal2", "cal3"))
    run("search", target, "--cal", *cals, "--out", folder)


def run(*words: object) -> None:
    """A command, from the root of the sources."""
    os.chdir(ROOT)
    assert amibayes_command([*map(str, words), "--overwrite", "--quiet"]) == 0


def other_commands(folder: Path) -> None:
    """Vetting, limits of several observables, a joint fit and a survey, where they are quick."""
    target, *cals = (str(DATA / f"{name}.oifits") for name in ("target", "cal1", "cal2", "cal3"))
    few = ("--null-draws", 4000)
    with tempfile.TemporaryDirectory() as made:
        out = Path(made)
        run("vet", *cals, "--out", out / "vet")
        run("limits", target, "--cal", *cals, "--trials", 60, *few, "--out", out / "limits")
        table = out / "targets.csv"
        stars = {"binary": [target, *cals], "alone": cals}
        rows = [",".join([row[0], " ".join(row[1:]), name]) for name, row in stars.items()]
        text = "\n".join(["target,cal,name", *rows])
        table.write_text(text.replace(str(DATA), str(ROOT / DATA)), encoding="utf-8")
        run("search", "--batch", table, "--no-posterior", *few, "--out", out / "survey")
        joint_pictures(out)
        for path, name in MORE.items():
            shutil.copyfile(out / path, folder / name)


MORE = {
    "vet/vetting.png": "vetting.png",
    "limits/limits.png": "limits_of_observables.png",
    "survey/survey.png": "survey.png",
    "joint/files.png": "files.png",
}
"""Pictures of the other commands, and what they are called in the gallery."""


def joint_pictures(out: Path) -> None:
    """Two filters of one scene, each with its calibrators."""
    scene = out / "scene.toml"
    scene.write_text(example(), encoding="utf-8")
    for name in ("F430M", "F480M"):
        words = ("--filter", name, "--photons", 2e7, "--seed", int(name[1:4]))
        run("simulate", scene, *words, "--out", out / name)
        run("extract", *sorted((out / name).glob("*.fits")), "--out", out / name)
    targets, cals = (sorted(out.glob(f"F*/{kind}*.oifits")) for kind in ("target", "calibrator"))
    quick = ("--no-posterior", "--no-limits", "--null-draws", 1000)
    run("search", *targets, "--cal", *cals, *quick, "--out", out / "joint")


def extraction_pictures(folder: Path) -> None:
    """What `amibayes.plots` shows of an extraction and of an instrument."""
    niriss = ab.load_instrument("niriss", "F480M")
    cube = ab.simulate(
        ab.Scene(), niriss, ab.Exposure(19, 60), np.random.default_rng(1), count_rate_e_s=1.1e6
    )
    (extraction,) = extract_all(cube)
    for draw in (frame_plot, power_plot, fit_images, observables_plot, correlations, time_plot):
        save(draw(extraction), folder / f"{draw.__name__}.png")
    save(instrument_picture(niriss), folder / "instrument.png")


def main(folder: Path) -> None:
    """Make all of them."""
    search_pictures(folder)
    other_commands(folder)
    extraction_pictures(folder)
    report = folder.parent / "report" / "example_report.html"
    report.parent.mkdir(exist_ok=True)
    report.write_bytes((folder / "report.html").read_bytes())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "gallery").resolve())
