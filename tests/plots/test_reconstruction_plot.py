"""Numbers beside the colour bars of an image are apart from each other."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from helpers import niriss
from matplotlib.figure import Figure
from scenes import SCENES, observed

import amibayes as ab
from amibayes.plots.reconstruction import image_plot


@pytest.mark.parametrize("scale", [1.0, 4e5, 1e-5])
def test_numbers_of_colour_bars_do_not_overlap(scale: float) -> None:
    from dataclasses import replace

    data = observed(niriss(0.003, 0.1), SCENES["disc"](), np.random.default_rng(5))
    image = ab.reconstruct_image(data, weight=100.0, pixel_mas=60.0)
    figure = image_plot(replace(image, light=scale * image.light, p_fit=0.0))
    figure.canvas.draw()
    assert "the image does not fit the data" in title_of(figure)
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    assert len(bars) == 4
    for ax in bars:
        boxes = sorted(
            (t.get_window_extent() for t in ax.get_xticklabels() if t.get_text()),
            key=lambda box: box.x0,
        )
        assert len(boxes) >= 2
        assert all(right.x0 > left.x1 + 2.0 for left, right in pairwise(boxes))


def title_of(figure: Figure) -> str:
    return str(figure.get_suptitle())
