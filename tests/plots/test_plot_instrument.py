"""The instrument's picture: what is drawn is what the instrument is."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amibayes.instrument import load_instrument
from amibayes.plots.instrument import instrument_picture
from amibayes.plots.style import save


def test_picture_shows_holes_baselines_and_image(tmp_path: Path) -> None:
    instrument = load_instrument("niriss", filter="F430M")
    figure = instrument_picture(instrument)
    mask, uv, image, _bar = figure.axes
    assert [len(c.get_paths()) for c in mask.collections] == [7]
    drawn = np.concatenate([line.get_xydata() for line in uv.lines if line.get_marker() != "None"])
    expected = instrument.mask.uv_m / (instrument.bandpass.pivot_m * 1e6)
    np.testing.assert_allclose(drawn, np.concatenate([expected, -expected]))
    shown = image.images[0].get_array()
    assert shown is not None
    assert shown.shape == (80, 80)
    assert shown.max() == 1.0
    for axes in (mask, uv, image):
        assert "(" in axes.get_xlabel()
        assert "(" in axes.get_ylabel()
    save(figure, tmp_path / "instrument.png")
    assert (tmp_path / "instrument.png").stat().st_size > 10_000
