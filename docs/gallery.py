"""Every picture that the commands draw, of the example data and of the tutorial's images.

python docs/gallery.py [FOLDER]
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

import amibayes as ab
from amibayes.extraction import extract_all
from amibayes.files import write_json
from amibayes.job import SearchOptions
from amibayes.pictures import save_pictures
from amibayes.plots.extraction import (
    correlations,
    fit_images,
    frame_plot,
    observables_plot,
    power_plot,
)
from amibayes.plots.instrument import instrument_picture
from amibayes.plots.style import save
from amibayes.report import result_json

EXAMPLES = Path(__file__).resolve().parent.parent / "examples" / "data"


def search_pictures(folder: Path) -> None:
    """The main job on the example data: one search, all of its pictures."""
    report = ab.search_companion(
        [EXAMPLES / "target.oifits"],
        sorted(EXAMPLES.glob("cal*.oifits")),
        SearchOptions(null_draws=10_000),
    )
    save_pictures(report, folder)
    write_json(folder / "result.json", in_repository(result_json(report)))


def in_repository(result: dict[str, Any]) -> dict[str, Any]:
    """Name the inputs as somebody would who stands in the folder of the sources."""
    root = str(EXAMPLES.parent.parent) + "/"
    return json.loads(json.dumps(result).replace(root, ""))


def extraction_pictures(folder: Path) -> None:
    """What `amibayes extract` shows of a simulated cube."""
    niriss = ab.load_instrument("niriss", "F480M")
    cube = ab.simulate(
        ab.Scene(), niriss, ab.Exposure(19, 60), np.random.default_rng(1), count_rate_e_s=1.1e6
    )
    (extraction,) = extract_all(cube)
    for draw in (frame_plot, power_plot, fit_images, observables_plot, correlations):
        save(draw(extraction), folder / f"{draw.__name__}.png")
    save(instrument_picture(niriss), folder / "instrument.png")


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    search_pictures(folder)
    extraction_pictures(folder)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "gallery"))
