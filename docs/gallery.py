"""Every picture that the commands draw, of the example data and of a simulated cube.

python docs/gallery.py [FOLDER]
"""

from __future__ import annotations

import os
import sys
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
)
from amibayes.plots.instrument import instrument_picture
from amibayes.plots.style import save

ROOT = Path(__file__).resolve().parent.parent
DATA = Path("examples") / "data"


def search_pictures(folder: Path) -> None:
    """The main job on the example data, as the first page runs it: pictures and report."""
    os.chdir(ROOT)
    words = ["search", str(DATA / "target.oifits"), "--cal", *map(str, sorted(DATA.glob("cal*")))]
    status = amibayes_command([*words, "--out", str(folder), "--overwrite", "--quiet"])
    assert status == 0


def extraction_pictures(folder: Path) -> None:
    """What `amibayes.plots` shows of an extraction and of an instrument."""
    niriss = ab.load_instrument("niriss", "F480M")
    cube = ab.simulate(
        ab.Scene(), niriss, ab.Exposure(19, 60), np.random.default_rng(1), count_rate_e_s=1.1e6
    )
    (extraction,) = extract_all(cube)
    for draw in (frame_plot, power_plot, fit_images, observables_plot, correlations):
        save(draw(extraction), folder / f"{draw.__name__}.png")
    save(instrument_picture(niriss), folder / "instrument.png")


def main(folder: Path) -> None:
    """Make all of them."""
    search_pictures(folder)
    extraction_pictures(folder)
    report = folder.parent / "report" / "example_report.html"
    report.parent.mkdir(exist_ok=True)
    report.write_bytes((folder / "report.html").read_bytes())


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "gallery").resolve())
