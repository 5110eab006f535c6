"""Counts of every pixel that were taken off ramps: the superbias that their header names."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.support.fits_errors import reporting_damage
from amibayes.units import FloatArray

KEYWORD = "R_SUPERB"
"""Of the reference file, as ``crds://jwst_niriss_superbias_0182.fits``."""


def bias_of(header: Mapping[str, Any], source: str, shape: tuple[int, int]) -> FloatArray | None:
    """Counts (ny, nx) that were taken off; None where the file is not at hand, or of other pixels.

    It is looked for beside the ramps, and where the jwst package keeps reference files
    (``CRDS_PATH``).

    Raises
    ------
    DataError
        Where the file is damaged.
    """
    name = str(header.get(KEYWORD, "")).strip().rpartition("/")[2]
    instrument = str(header.get("INSTRUME", "")).strip().lower()
    kept = Path(os.environ.get("CRDS_PATH", Path.home() / "crds_cache"))
    for folder in (Path(source).parent, kept / "references" / "jwst" / instrument):
        if name and (folder / name).is_file():
            return _read(folder / name, header, shape)
    return None


def _read(path: Path, header: Mapping[str, Any], shape: tuple[int, int]) -> FloatArray | None:
    """The pixels of a subarray, of a file of that or of the whole detector."""
    with reporting_damage(path), fits.open(path, memmap=False) as hdus:
        image = np.asarray(hdus["SCI"].data, dtype=float)
        first = [_corner(header, k) - _corner(hdus[0].header, k) for k in (2, 1)]
    if image.ndim != 2 or (image.shape != shape and min(first) < 0):
        return None
    if image.shape != shape:
        image = image[first[0] : first[0] + shape[0], first[1] : first[1] + shape[1]]
    return image if image.shape == shape and np.isfinite(image).any() else None


def _corner(header: Mapping[str, Any], axis: int) -> int:
    """First pixel of a subarray along an axis, from 1."""
    value = header.get(f"SUBSTRT{axis}")
    return value if isinstance(value, int) else 1
