"""Data sets that every program can read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits

from amibayes import (
    Exposure,
    Likelihood,
    Observables,
    Scene,
    load_instrument,
    point_source,
    simulate,
    write_oifits,
)
from benchmarks.search import simulated

TRUTH = (96.4, 114.9, 0.01)
"""East and north (mas) and flux ratio of the NIRISS companion."""

N_IMAGES, N_COPIES = 100, 10
"""Integrations that are simulated, and how often they are in the cube."""


def niriss() -> Observables:
    """A snapshot with a companion, its errors without correlations."""
    instrument = load_instrument("niriss", "F480M")
    low, high = instrument.bandpass.half_power_m
    sheet = point_source(
        instrument.mask.holes_m * [-1.0, 1.0],
        instrument.bandpass.pivot_m,
        high - low,
        vis2_error=0.003,
        closure_error_rad=0.003,
        covariance="diagonal",
        insname="NIRISS",
    )
    model = Likelihood(sheet).predict([TRUTH])[:, 0]
    model += sheet.covariance.draw(np.random.default_rng(1), 1)[:, 0]
    return sheet.with_data(model)


def write_all(folder: Path) -> dict[str, Path]:
    """Write a NIRISS snapshot, VLTI data and a cube of images; return their paths."""
    paths = {"niriss": folder / "niriss.oifits", "vlti": folder / "vlti.oifits"}
    write_oifits(paths["niriss"], niriss(), header={"TELESCOP": "JWST"}, overwrite=True)
    write_oifits(paths["vlti"], simulated(10), overwrite=True)
    instrument = load_instrument("niriss", "F480M")
    rng = np.random.default_rng(1)
    cube = simulate(Scene(), instrument, Exposure(19, N_IMAGES), rng, count_rate_e_s=1e6)
    paths["cube"] = folder / "cube.fits"
    primary = fits.PrimaryHDU(np.tile(cube.images.astype(np.float32), (N_COPIES, 1, 1)))
    primary.header.update({"INSTRUME": "NIRISS", "FILTER": "F480M", "PIXELSCL": 65.6})
    primary.writeto(paths["cube"], overwrite=True)
    return paths
