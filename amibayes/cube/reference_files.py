"""Reference files that the header of ramps names: what turns them into counts as they were read.

The superbias is what was taken off every pixel; the coefficients of linearity are what the
signal was then put through. Both are looked for beside the ramps, and where the jwst package
keeps reference files (``CRDS_PATH``).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes.support.fits_errors import reporting_damage
from amibayes.units import FloatArray, read_only

BIAS_KEYWORD = "R_SUPERB"
"""Names the superbias, as ``crds://jwst_niriss_superbias_0182.fits``."""

LINEARITY_KEYWORD = "R_LINEAR"
"""Names the coefficients of linearity."""

NO_LIN_CORR = 1 << 20
"""Flag of pixels that the pipeline does not linearise, in the coefficients' DQ."""

ROUNDS = 2
"""Of Newton's method, each of which squares what is missing: of the 6 % of a full pixel it leaves
less than 1e-4 counts."""


@dataclass(frozen=True, eq=False)
class Linearity:
    """Polynomial that made a linear signal of what was read, bias taken off.

    Parameters
    ----------
    coefficients : (k, ny, nx) array
        Of the powers 0, 1, … of the signal in counts.
    """

    coefficients: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "coefficients")

    def undone(self, linear: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Signal (…, ny, nx) that was read, and the slope of the polynomial there.

        Parameters
        ----------
        linear : (…, ny, nx) array
            Counts as they were made linear.
        """
        read, slope = linear, np.ones_like(linear)
        for _ in range(ROUNDS):
            value, slope = self._value_and_slope(read)
            read = read - (value - linear) / slope
        return read, slope

    def _value_and_slope(self, read: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        factors = self.coefficients.astype(read.dtype)
        value, slope = np.zeros_like(read), np.zeros_like(read)
        for factor in factors[::-1]:
            slope = slope * read + value
            value = value * read + factor
        return value, slope


def as_read(
    linear: NDArray[Any], linearity: Linearity | None
) -> tuple[NDArray[Any], NDArray[Any] | float]:
    """`Linearity.undone`; of a signal that nothing is known of the signal itself."""
    return (linear, 1.0) if linearity is None else linearity.undone(linear)


def bias_of(header: Mapping[str, Any], source: str, shape: tuple[int, int]) -> FloatArray | None:
    """Counts (ny, nx) that were taken off; None where the file is not at hand, or of other pixels.

    Raises
    ------
    DataError
        Where the file is damaged.
    """
    path = _found(header, BIAS_KEYWORD, source)
    if path is None:
        return None
    with reporting_damage(path), fits.open(path, memmap=False) as hdus:
        bias = _part(hdus, "SCI", header, shape)
    return bias if bias is not None and np.isfinite(bias).any() else None


def linearity_of(
    header: Mapping[str, Any], source: str, shape: tuple[int, int]
) -> Linearity | None:
    """How a signal was made linear; None where the file is not at hand, or of other pixels.

    Pixels whose coefficients are not known were left as they are, as the pipeline does.

    Raises
    ------
    DataError
        Where the file is damaged.
    """
    path = _found(header, LINEARITY_KEYWORD, source)
    if path is None:
        return None
    with reporting_damage(path), fits.open(path, memmap=False) as hdus:
        found = _part(hdus, "COEFFS", header, shape)
        flags = _part(hdus, "DQ", header, shape) if "DQ" in hdus else None
    if found is None or found.ndim != 3 or len(found) < 2:
        return None
    left = ~np.isfinite(found).all(axis=0) | (found[1] == 0.0)
    if flags is not None:
        left |= (flags.astype(np.int64) & NO_LIN_CORR) != 0
    as_is = np.arange(len(found)) == 1
    return Linearity(np.where(left, as_is[:, None, None], found))


def _found(header: Mapping[str, Any], keyword: str, source: str) -> Path | None:
    """The file that a keyword names, where it is at hand."""
    name = str(header.get(keyword, "")).strip().rpartition("/")[2]
    instrument = str(header.get("INSTRUME", "")).strip().lower()
    kept = Path(os.environ.get("CRDS_PATH", Path.home() / "crds_cache"))
    for folder in (Path(source).parent, kept / "references" / "jwst" / instrument):
        if name and (folder / name).is_file():
            return folder / name
    return None


def _part(
    hdus: fits.HDUList, name: str, header: Mapping[str, Any], shape: tuple[int, int]
) -> FloatArray | None:
    """Pixels (…, ny, nx) of a subarray, of a file of that or of the whole detector."""
    first = [_corner(header, k) - _corner(hdus[0].header, k) for k in (2, 1)]
    hdu = hdus[name]
    if len(hdu.shape) < 2 or (hdu.shape[-2:] != shape and min(first) < 0):
        return None
    rows, columns = (slice(a, a + n) for a, n in zip(first, shape, strict=True))
    if hdu.shape[-2:] == shape:
        rows = columns = slice(None)
    part = np.asarray(hdu.section[..., rows, columns], dtype=float)
    return part if part.shape[-2:] == shape else None


def _corner(header: Mapping[str, Any], axis: int) -> int:
    """First pixel of a subarray along an axis, from 1."""
    value = header.get(f"SUBSTRT{axis}")
    return value if isinstance(value, int) else 1
