"""Where the light of a stage-3 product was under the envelope of the pipeline's fringe model.

`ami_analyze` puts its model at the centroid of an image: between a star and a bright companion, a
third of a pixel and more from the star. What the envelope lets through of either depends on that
place; the fringes' phases, which are relative to it, tell it.
"""

from __future__ import annotations

import numpy as np

from amibayes.oifits.products.recognise import Product
from amibayes.units import MAS, FloatArray

NEEDED = ("VISAMP", "VISPHI", "UCOORD", "VCOORD")

FIELD_MAS, STEP_MAS = 200.0, 8.0
"""Places that are tried: at a third of a fringe of the longest baseline from the best the phases
are still the right way round."""


def pointing_of(product: Product) -> FloatArray:
    """East and north (2,) in radians of the light's centre from that of the model.

    By the mean phases of the fringes, as an extraction has it; (0, 0) where there are none, and for
    `aminorm`: of a quotient, the centre of the calibrator's model would have to be known too, and
    most of a centre is common to both.
    """
    if product.kind == "aminorm-oi":
        return np.zeros(2)
    rows, waves = product.table("OI_VIS"), product.oifits.named("OI_WAVELENGTH")
    if rows is None or not set(NEEDED) <= set(rows.columns) or not waves:
        return np.zeros(2)
    amplitude, phase = (
        np.asarray(rows.columns[name], dtype=float).reshape(len(rows), -1)
        for name in ("VISAMP", "VISPHI")
    )
    fringe = amplitude * np.exp(1j * np.radians(phase))
    uv = np.stack([rows.columns["UCOORD"], rows.columns["VCOORD"]], axis=1).astype(float)
    uv = uv / float(np.ravel(waves[0].columns["EFF_WAVE"])[0])
    good = np.isfinite(fringe).any(axis=1) & np.isfinite(uv).all(axis=1)
    return place_of(np.nanmean(fringe[good], axis=1), uv[good])


def place_of(fringe: FloatArray, uv: FloatArray) -> FloatArray:
    """Place (2,) in radians whose phases are nearest to those of fringes (n,) at (u, v) (n, 2)."""
    axis = MAS * np.arange(-FIELD_MAS, FIELD_MAS + 1.0, STEP_MAS)
    tried = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    weight = np.abs(fringe)
    light = np.exp(2j * np.pi * tried @ uv.T) @ (weight * fringe)
    best = tried[light.real.argmax()] if len(fringe) else np.zeros(2)
    left = np.angle(fringe * np.exp(2j * np.pi * uv @ best))
    more = np.linalg.lstsq(-2.0 * np.pi * uv * weight[:, None], left * weight, rcond=None)[0]
    return np.asarray(best + more)
