"""Files of ImPlaneIA: the layout that the JWST pipeline's descend from, without its keywords."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from jwst_products import binary, integrations, product

import amibayes as ab
from amibayes.extraction.reading import read_observations
from amibayes.oifits.audit import audit

KEPT = ("TELESCOP", "INSTRUME")


def implaneia(path: Path, kind: str, visibility: np.ndarray) -> Path:
    """Its tables are those of the pipeline but for OI_Q4; T3AMP are other amplitudes."""
    hdus = product(kind, visibility)
    primary = fits.PrimaryHDU()
    primary.header.update({k: hdus[0].header[k] for k in KEPT if k in hdus[0].header})
    primary.header.update({"ORIGIN": "Sydney University", "CONTENT": "OIFITS2", "PA": 0.0})
    kept = [h for h in hdus[1:] if h.name != "OI_Q4"]
    for hdu in kept:
        if hdu.name == "OI_T3":
            hdu.data["T3AMP"] = np.random.default_rng(1).uniform(0.5, 2.0, hdu.data["T3AMP"].shape)
    fits.HDUList([primary, *kept]).writeto(path)
    return path


def test_integrations_are_no_channels(tmp_path: Path, rng: np.random.Generator) -> None:
    """Values and covariance are those of the same integrations in a product of the pipeline."""
    visibility = integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng)
    path = implaneia(tmp_path / "a.oifits", "amimulti-oi", visibility)
    product("amimulti-oi", visibility).writeto(tmp_path / "b.fits")
    (found,), (known,) = (read_observations(p) for p in (path, tmp_path / "b.fits"))
    assert (found.covariance_kind, found.n_integrations) == ("estimated", 20)
    # What the star lost by its pointing is taken out of one of them, in single precision.
    assert found.vis2.value == pytest.approx(known.vis2.value, rel=1e-6)
    change = np.abs(found.closure_phase.value - known.closure_phase.value)
    assert (change < 0.2 * known.errors[1]).all()
    assert any("integrations of ImPlaneIA" in note for note in found.notes)
    assert ab.read_oifits(path).n_independent == 36


def test_errors_of_an_average_are_said_to_be_the_scatter(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    path = implaneia(
        tmp_path / "a.oifits", "ami-oi", integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng)
    )
    codes = [f.code for f in audit(path).findings]
    assert codes.count("scatter-of-integrations") == 2
    with fits.open(tmp_path / "a.oifits") as hdus:
        hdus["OI_VIS2"].data["VIS2ERR"][4] = 0.0
        hdus["OI_T3"].data["T3PHIERR"][:] = 0.0
        hdus.writeto(tmp_path / "b.oifits")
    codes = [f.code for f in audit(tmp_path / "b.oifits").findings]
    assert codes.count("scatter-of-integrations") == 1
    (found,) = read_observations(path)
    assert found.covariance_kind == "assumed"
