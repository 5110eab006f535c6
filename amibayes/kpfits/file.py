"""A KPFITS file as it stands: the HDUs of Kammerer et al. (2023), and their older layout.

``KP-DATA`` (frames, wavelengths, kernels) are the sums ``KER-MAT`` (kernels, points) of the phases
of a Fourier transform exp(−2πi(ux + vy)/λ) at the points ``UV-PLANE`` (UUC, VVC, metres) of an
image, x to the right and y upwards; ``DETPA`` is the position angle of y, east of north. Files
before that have no axis of wavelengths, covariances in ``KP-SIGM`` and angles in a table ``TEL``.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.time import Time

from amibayes.errors import DataError
from amibayes.support.fits_errors import reporting_damage
from amibayes.units import FloatArray, freeze

NEEDED = ("KER-MAT", "UV-PLANE")

DATES = ("EXPMID", "MJD-AVG", "MJD-MID", "MJD-OBS", "EXPSTART")
"""Keywords with the date of an exposure as MJD, the best one first."""

TARGETS = ("TARGPROP", "TARGNAME", "TARGET", "OBJECT")


@dataclass(frozen=True, eq=False)
class KernelFile:
    """What a KPFITS file holds.

    Parameters
    ----------
    path : str
    header : mapping
        Of the primary HDU.
    names : tuple of str
        EXTNAME of every HDU, in capitals.
    matrix : (n_kernels, n_points) float array
    u_m, v_m : (n_points,) float array
        Along x and y of the image.
    value : (n_frames, n_wavelengths, n_kernels) float array
        Radians.
    covariance : (n_frames, n_wavelengths, n_kernels, n_kernels) float array
        Radians squared.
    has_covariance : bool
        Whether the file has more than independent errors.
    wavelength_m, band_m : (n_wavelengths,) float array
        Band 0 where it is not given.
    position_angle_deg : (n_frames,) float array
        Of y, east of north; 0 where the file does not say.
    oriented : bool
        Whether it does.
    errors : (n_frames, n_wavelengths, n_kernels) float array, optional
        KP-SIGM, where the covariance is from another HDU.
    baselines : (n_points, n) float array, optional
        BLM-MAT: how phases of the pupil move those at the points, times their redundancy.
    redundancy : (n_points,) float array, optional
        RED of UV-PLANE.
    """

    path: str
    header: Mapping[str, Any]
    names: tuple[str, ...]
    matrix: FloatArray
    u_m: FloatArray
    v_m: FloatArray
    value: FloatArray
    covariance: FloatArray
    has_covariance: bool
    wavelength_m: FloatArray
    band_m: FloatArray
    position_angle_deg: FloatArray
    oriented: bool
    errors: FloatArray | None = None
    baselines: FloatArray | None = None
    redundancy: FloatArray | None = None

    def __post_init__(self) -> None:
        freeze(self)

    @property
    def instrument(self) -> str:
        """INSTRUME or, of Keck, CURRINST; with the filter, where there is one."""
        first = str(self.header.get("INSTRUME") or self.header.get("CURRINST") or "KPFITS").strip()
        band = str(self.header.get("FILTER") or "").strip()
        return f"{first}_{band}" if band else first

    @property
    def target(self) -> str:
        """Name of the star."""
        found = (str(self.header.get(key) or "").strip() for key in TARGETS)
        return next((name for name in found if name), "")

    @property
    def mjd(self) -> float:
        """Date of the exposure; NaN where the header does not say."""
        for key in DATES:
            if isinstance(self.header.get(key), int | float):
                return float(self.header[key])
        day = str(self.header.get("DATE-OBS") or "").strip()
        clock = str(self.header.get("TIME-OBS") or self.header.get("UTC") or "").strip()
        try:
            return float(Time(f"{day}T{clock}" if clock and "T" not in day else day).mjd)
        except ValueError:
            return float("nan")


def is_kpfits(names: Collection[str]) -> bool:
    """Whether a file with these names of HDUs (in capitals) holds kernel phases."""
    return any(name.startswith("KP-DATA") for name in names)


def open_kpfits(path: str | Path) -> KernelFile:
    """Read a KPFITS file.

    Raises
    ------
    DataError
        Where it cannot be read, lacks an HDU, or shapes or numbers do not fit.
    """
    with reporting_damage(path), fits.open(path, memmap=False) as hdus:
        there = {hdu.name.upper(): hdu for hdu in hdus[1:]}
        if "KP-DATA" not in there and is_kpfits(there):
            raise DataError(
                "holds kernel phases in XARA's own structure (KP-DATA1, ...), not in KPFITS",
                source=path,
                remedy="save them as KPFITS, with KP-COV or KP-SIGM",
            )
        missing = [name for name in ("KP-DATA", *NEEDED) if name not in there]
        if missing:
            raise DataError(
                f"holds kernel phases without {' and '.join(missing)}",
                source=path,
                remedy="write it again with all HDUs of KPFITS",
            )
        arrays = {name: np.array(hdu.data) for name, hdu in there.items() if hdu.data is not None}
        header = MappingProxyType(dict(hdus[0].header))
    return _assembled(str(path), header, tuple(there), arrays)


def _assembled(
    path: str, header: Mapping[str, Any], names: tuple[str, ...], arrays: dict[str, Any]
) -> KernelFile:
    value = _numbers(arrays, "KP-DATA", path)
    while value.ndim < 3:  # older files: (kernels,) or (frames, kernels)
        value = value[:, None] if value.ndim == 2 else value[None]
    matrix = _numbers(arrays, "KER-MAT", path)
    if value.ndim != 3 or matrix.ndim != 2 or value.shape[2] != matrix.shape[0]:
        raise _unfit(path, f"KP-DATA {value.shape} and KER-MAT {matrix.shape} do not fit")
    u, v = (_column(arrays, "UV-PLANE", name, path) for name in ("UUC", "VVC"))
    if len(u) != matrix.shape[1] or len(v) != len(u):
        raise _unfit(path, f"UV-PLANE has {len(u)} points, KER-MAT {matrix.shape[1]}")
    wavelength, band = _wavelengths(arrays, header, path)
    if len(wavelength) != value.shape[1]:
        raise _unfit(path, f"{len(wavelength)} wavelengths for {value.shape[1]} in KP-DATA")
    covariance, given, errors = _covariance(arrays, value.shape, path)
    angle = _angles(arrays, value.shape[0], path)
    for name, numbers in (("KP-DATA", value), ("KER-MAT", matrix), ("its covariance", covariance)):
        if not np.isfinite(numbers).all():
            raise _unfit(path, f"{name} has values that are not finite", "leave these frames out")
    blm = arrays.get("BLM-MAT")
    fitting = blm is not None and blm.ndim == 2 and len(blm) == len(u)
    return KernelFile(
        path, header, names, matrix, u, v, value, covariance, given, wavelength, band,
        np.zeros(len(value)) if angle is None else angle, angle is not None, errors,
        np.asarray(blm, dtype=float) if fitting else None, _redundancy(arrays["UV-PLANE"]),
    )  # fmt: skip


def _redundancy(plane: Any) -> FloatArray | None:
    """Number of times that each point is measured, where the file says."""
    names = [n for n in plane.dtype.names or () if n.upper() == "RED"]
    return np.asarray(plane[names[0]], dtype=float).ravel() if names else None


def _unfit(
    path: str, what: str, remedy: str = "write it again as KPFITS (frames, wavelengths, kernels)"
) -> DataError:
    return DataError(f"holds kernel phases that cannot be used: {what}", source=path, remedy=remedy)


def _numbers(arrays: dict[str, Any], name: str, path: str) -> FloatArray:
    found = arrays.get(name)
    if found is None or found.dtype.kind not in "iuf" or not found.size:
        raise _unfit(path, f"{name} has no numbers")
    return np.asarray(found, dtype=float)


def _column(arrays: dict[str, Any], table: str, name: str, path: str) -> FloatArray:
    found = arrays.get(table)
    names = found.dtype.names if found is not None else None
    match = [n for n in names or () if n.upper() == name]
    if found is None or not match or found[match[0]].dtype.kind not in "iuf":
        raise _unfit(path, f"{table} has no column {name}")
    return np.asarray(found[match[0]], dtype=float).ravel()


def _wavelengths(
    arrays: dict[str, Any], header: Mapping[str, Any], path: str
) -> tuple[FloatArray, FloatArray]:
    """Wavelengths and widths, metres; widths 0 where there are none."""
    if "CWAVEL" in arrays and arrays["CWAVEL"].dtype.names:
        wavelength = _column(arrays, "CWAVEL", "CWAVEL", path)
        names = {str(n).upper() for n in arrays["CWAVEL"].dtype.names}
        width = next((n for n in ("BWIDTH", "DWAVEL") if n in names), None)
        band = _column(arrays, "CWAVEL", width, path) if width else np.zeros_like(wavelength)
    elif "CWAVEL" in arrays:
        wavelength = np.asarray(arrays["CWAVEL"], dtype=float).ravel()
        band = np.zeros_like(wavelength)
    else:
        micron = header.get("ESO INS CWLEN", header.get("HIERARCH ESO INS CWLEN"))
        metres = header.get("CWAVEL") if micron is None else 1e-6 * float(micron)
        if not isinstance(metres, int | float):
            raise _unfit(path, "it does not state its wavelength", "add the table CWAVEL")
        wavelength, band = np.array([float(metres)]), np.zeros(1)
    if not (np.isfinite(wavelength).all() and (wavelength > 1e-7).all() and (wavelength < 1).all()):
        raise _unfit(path, f"CWAVEL {wavelength.ravel()[:3]} is not in metres", "give metres")
    return wavelength, np.nan_to_num(np.abs(band))


def _covariance(
    arrays: dict[str, Any], shape: tuple[int, ...], path: str
) -> tuple[FloatArray, bool, FloatArray | None]:
    """Covariances of all frames, whether correlations are stated, and KP-SIGM beside them.

    Empirical ones (``EKP-``) are preferred, as their writer meant.
    """
    sigma = next((n for n in ("EKP-SIGM", "KP-SIGM") if n in arrays), None)
    errors = None if sigma is None else _numbers(arrays, sigma, path)
    for name in ("EKP-COV", "KP-COV", *([sigma] if sigma else [])):
        if name not in arrays:
            continue
        found = _numbers(arrays, name, path)
        if found.size == np.prod(shape) * shape[2] and found.shape[-2:] == (shape[2], shape[2]):
            fitting = errors is not None and errors.size == np.prod(shape)
            whole = found.reshape(*shape, shape[2])
            return whole, True, errors.reshape(shape) if fitting and errors is not None else None
    if errors is None or errors.size != np.prod(shape):
        raise _unfit(path, "neither KP-COV nor KP-SIGM fits KP-DATA", "add KP-SIGM or KP-COV")
    return errors.reshape(shape)[..., None] ** 2 * np.eye(shape[2]), False, None


def _angles(arrays: dict[str, Any], n_frames: int, path: str) -> FloatArray | None:
    """Position angle of y in each frame, degrees; None where the file does not say."""
    if "DETPA" in arrays and arrays["DETPA"].dtype.names is None:
        found = np.asarray(arrays["DETPA"], dtype=float).ravel()
    elif "TEL" in arrays:
        names = {str(n).upper() for n in arrays["TEL"].dtype.names or ()}
        if not names & {"DETPA", "PA"}:
            return None
        found = _column(arrays, "TEL", "DETPA" if "DETPA" in names else "PA", path)
    else:
        return None
    if len(found) != n_frames:
        if len(found) == 0 or (np.ptp(found) > 0.0 and n_frames > 1):
            raise _unfit(path, f"{len(found)} position angles for {n_frames} frames")
        found = np.full(n_frames, found.mean())
    if not np.isfinite(found).all():
        raise _unfit(path, "DETPA has values that are not finite", "fill in the angles")
    return found
