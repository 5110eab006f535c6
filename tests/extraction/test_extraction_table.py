"""The important rows of the table of wrong models hold."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from astropy.io import fits
from conftest import script

from amibayes.extraction import ExtractOptions
from amibayes.extraction.reading import residual_share
from amibayes.instrument import load_instrument

# Calibrated V² and closure phase (degrees), rms: about twice what the table says. Photon
# noise of 1e8 photons is worth 8e-4 and 0.05.
BOUNDS = {
    "pixels 0.2 % larger": (1e-4, 1e-3),
    "mask turned by 0.1°": (1e-4, 1e-3),
    "stars of 3000 K and 10 000 K taken as flat": (2e-4, 1e-3),
    "1 % charge migration": (1.5e-3, 0.07),
    "20 bad pixels": (5e-4, 0.015),
    "images by poppy": (1e-4, 0.01),
}


@pytest.fixture(scope="module")
def table() -> ModuleType:
    return script("extraction_table")


@pytest.mark.parametrize(
    "case", [pytest.param(c, marks=pytest.mark.slow) if c != "20 bad pixels" else c for c in BOUNDS]
)
def test_wrong_models_calibrate_out(table: ModuleType, case: str) -> None:
    if "poppy" in case:
        pytest.importorskip("poppy")
    instrument = load_instrument("niriss", "F430M")
    both = table.cases(instrument)[case]()
    for method in ("fringes", "matched", "unique"):
        options = ExtractOptions(method=method, covariance="physical")  # type: ignore[arg-type]
        *_, vis2, closure = table.biases(instrument, both, options)
        assert vis2 < BOUNDS[case][0]
        assert closure < BOUNDS[case][1]


def test_geometry_as_stated_does_harm_that_the_fit_takes_back(table: ModuleType) -> None:
    instrument = load_instrument("niriss", "F430M")
    both = table.cases(instrument)["pixels 0.2 % larger"]()
    fitted = table.biases(instrument, both, ExtractOptions())
    stated = table.biases(instrument, both, ExtractOptions(geometry="stated"))
    assert (stated > 10.0 * fitted).all()


def test_share_that_fits_leave_of_an_image(tmp_path: Path) -> None:
    """Residuals of a tenth of the image everywhere; images that are all zero say nothing more."""
    image = np.arange(1.0, 10.0).reshape(3, 3)
    path = tmp_path / "amilg.fits"
    for ctrd, resid, said in (
        (image, 0.1 * image, ", whose fits leave 10.0 % of the image"),
        (image, None, ""),
    ):
        hdus = [fits.PrimaryHDU(), fits.ImageHDU(ctrd, name="CTRD")]
        hdus += [] if resid is None else [fits.ImageHDU(resid, name="RESID")]
        fits.HDUList(hdus).writeto(path, overwrite=True)
        assert residual_share(str(path)) == said
