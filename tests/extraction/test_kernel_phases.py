"""KPFITS, whose images look like a cube of a mask, are refused by what they hold."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.cli import main


def kpfits(path: Path) -> Path:
    """A file with the HDUs of Kammerer et al. (2022), as jwst-kpi writes them."""
    frames, kernels, baselines, holes, n = 3, 100, 204, 105, 24
    rng = np.random.default_rng(1)
    coordinate = [fits.Column(c, "D", array=np.zeros(holes)) for c in ("XXC", "YYC", "TRM")]
    plane = [fits.Column(c, "D", array=np.zeros(baselines)) for c in ("UUC", "VVC", "RED")]
    band = [fits.Column(c, "D", array=[4.8e-6]) for c in ("CWAVEL", "BWIDTH")]
    hdus = [fits.PrimaryHDU(rng.random((frames, 1, n, n)))]
    hdus[0].header.update({"INSTRUME": "NIRISS", "FILTER": "F480M", "PSCALE": 65.6, "DIAM": 6.559})
    hdus.append(fits.BinTableHDU.from_columns(coordinate, name="APERTURE"))
    hdus.append(fits.BinTableHDU.from_columns(plane, name="UV-PLANE"))
    images = {
        "KER-MAT": (kernels, baselines),
        "BLM-MAT": (baselines, holes - 1),
        "KP-DATA": (frames, 1, kernels),
        "KP-SIGM": (frames, 1, kernels),
        "KP-COV": (frames, 1, kernels, kernels),
        "DETPA": (frames,),
        "CVIS-DATA": (2, frames, 1, baselines),
    }
    hdus += [fits.ImageHDU(np.zeros(shape), name=name) for name, shape in images.items()]
    hdus.append(fits.BinTableHDU.from_columns(band, name="CWAVEL"))
    fits.HDUList(hdus).writeto(path)
    return path


@pytest.mark.parametrize("command", ["search", "limits"])
def test_kernel_phases_are_refused_in_one_line(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = kpfits(tmp_path / "star_kpfits.fits")
    assert main([command, str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 3
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "star_kpfits.fits: holds kernel phases (KPFITS): 100 sums over 204 baselines" in error
