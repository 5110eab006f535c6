"""An extraction in plain numbers, and what its file says of how it was made."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from amibayes import __version__
from amibayes.extraction.geometry import Geometry
from amibayes.extraction.operator import ExtractionOperator
from amibayes.extraction.table import Extraction
from amibayes.units import DEGREE


def described(extraction: Extraction) -> dict[str, Any]:
    """Give everything worth telling, ready for JSON."""
    frames, view = extraction.frames, extraction.operators[0].view
    used, n = frames.used, view.instrument.mask.n_baselines
    count = int(used.sum())
    own = np.sqrt(np.diag(extraction.covariance.matrix) / count)
    expected = np.sqrt(np.diag(extraction.physical) / count)
    shrunk = extraction.covariance
    prior = shrunk.prior_freedom
    return {
        "sources": list(extraction.sources),
        "instrument": view.instrument.name,
        "filter": view.instrument.bandpass.name,
        "method": extraction.options.method,
        "options": dict(extraction.options.as_mapping()),
        "n_integrations": len(frames),
        "n_used": count,
        "rejected": [
            {"path": path, "integration": number, "reason": reason}
            for path, number, reason in extraction.rejected
        ],
        "centre_px": [_from_middle(b) for b in extraction.operators],
        "geometry": [_geometry(b.geometry) for b in extraction.operators],
        "jitter_px": float(np.sqrt(frames.shift_px[used].var(axis=0).mean())),
        "flux": float(frames.flux[used].mean()),
        "bad_pixels": [b.reference.n_bad for b in extraction.operators],
        "outliers": float(frames.n_bad[used].mean()),
        "sigma_vis2": float(np.median(own[:n])),
        "sigma_vis2_physical": float(np.median(expected[:n])),
        "sigma_closure_phase_deg": float(np.degrees(np.median(own[n:]))),
        "sigma_closure_phase_physical_deg": float(np.degrees(np.median(expected[n:]))),
        "n_per_independent": count / extraction.observables.n_independent,
        "prior_degrees_of_freedom": prior if np.isfinite(prior) else None,
        "degrees_of_freedom": shrunk.freedom if np.isfinite(shrunk.freedom) else None,
        "variance_scale": {"vis2": shrunk.scale_vis2, "closure_phase": shrunk.scale_closure},
        "correlation_in_time": shrunk.correlation,
        "block": shrunk.block,
        "charge_migration": extraction.charge.as_json(),
        "notes": list(extraction.observables.notes),
    }


def _from_middle(operator: ExtractionOperator) -> list[float]:
    """Place (x, y) of the star from the middle of the image as given, before any cropping."""
    view = operator.view
    ny, nx = operator.reference.image.shape
    sides = zip((view.columns, view.rows), (nx, ny), view.centre_px, strict=True)
    return [0.5 * (part.start + part.stop - size) + at for part, size, at in sides]


def _geometry(found: Geometry) -> dict[str, Any]:
    """Scale of the stated pixel and rotation of the mask, or its map, with errors."""
    mask_map = found.mask_map
    return {
        "scale": found.scale,
        "rotation_deg": found.rotation_rad / DEGREE,
        "scale_error": found.scale_error if found.told else None,
        "rotation_error_deg": found.rotation_error_rad / DEGREE if found.told else None,
        "mask_map": None if mask_map is None else mask_map.matrix.tolist(),
        "mask_map_error": None if mask_map is None else mask_map.error.tolist(),
    }


def header_of(extraction: Extraction) -> dict[str, str | int | float | bool]:
    """Primary header keywords: version, method and options, enough to run it again."""
    header: dict[str, str | int | float | bool] = {
        "PROCSOFT": f"amibayes {__version__}",
        "HIERARCH AMIBAYES METHOD": extraction.options.method,
    }
    for name, value in extraction.options.as_mapping().items():
        if name != "method" and value is not None:
            header[f"HIERARCH AMIBAYES OPTION {name.upper()}"] = value
    for k, (source, operator) in enumerate(
        zip(extraction.sources, extraction.operators, strict=True), 1
    ):
        header[f"HIERARCH AMIBAYES SOURCE{k}"] = Path(source).name
        header[f"HIERARCH AMIBAYES PIXEL{k}"] = operator.view.instrument.pixel_scale_rad
        header[f"HIERARCH AMIBAYES SCALE{k}"] = operator.geometry.scale
        header[f"HIERARCH AMIBAYES ROTATION{k}"] = operator.geometry.rotation_rad / DEGREE
    header |= extraction.charge.in_header
    header["HIERARCH AMIBAYES CHARGE"] = float(extraction.operators[0].reference.image.max())
    return header
