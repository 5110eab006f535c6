"""The container: images of one exposure, with what is known of every pixel."""

from __future__ import annotations

import difflib
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.errors import DataError, UsageError
from amibayes.scene.orientation import Orientation
from amibayes.support.arguments import checks_arguments, in_range
from amibayes.support.notebook import Rows, Shown
from amibayes.units import MAS, FloatArray

DQ_FLAGS = {
    name: 1 << bit
    for bit, name in enumerate(
        (
            "DO_NOT_USE", "SATURATED", "JUMP_DET", "DROPOUT", "OUTLIER", "PERSISTENCE",
            "AD_FLOOR", "CHARGELOSS", "UNRELIABLE_ERROR", "NON_SCIENCE", "DEAD", "HOT", "WARM",
            "LOW_QE", "RC", "TELEGRAPH", "NONLINEAR", "BAD_REF_PIXEL", "NO_FLAT_FIELD",
            "NO_GAIN_VALUE", "NO_LIN_CORR", "NO_SAT_CHECK", "UNRELIABLE_BIAS", "UNRELIABLE_DARK",
            "UNRELIABLE_SLOPE", "UNRELIABLE_FLAT", "OPEN", "ADJ_OPEN", "FLUX_ESTIMATED",
            "MSA_FAILED_OPEN", "OTHER_BAD_PIXEL", "REFERENCE_PIXEL",
        )
    )
}  # fmt: skip
"""Data quality flags by the names of the jwst package (`stcal.dqflags`), bit 0 first."""

DO_NOT_USE = DQ_FLAGS["DO_NOT_USE"]
"""Flag of a pixel that is not to be used."""

SATURATED = DQ_FLAGS["SATURATED"]
"""Flag of a pixel that reached full well in some group."""

JUMP_DET = DQ_FLAGS["JUMP_DET"]
"""Flag of a pixel whose ramp was cut at a cosmic ray."""

NEVER_USED = ("DO_NOT_USE", "NON_SCIENCE", "DEAD", "REFERENCE_PIXEL")
"""Flags of pixels that see no light; slopes that jumps or saturation only cut short are good."""


NO_LIGHT = "every pixel is flagged, not a number, or the same"
"""What is wrong with images and ramps that show nothing."""


MIN_PIXEL_RAD, MAX_PIXEL_RAD = 1e-12, 1e-3
"""Between 0.2 µas and 3 arcmin: pixel scales of other sizes are in other units than radians."""


def flag_bits(names: Collection[str]) -> int:
    """Bits of flags by name.

    Raises
    ------
    UsageError
        Naming the first that is not known.
    """
    for name in names:
        if name not in DQ_FLAGS:
            near = difflib.get_close_matches(name, DQ_FLAGS, n=1)
            raise UsageError(
                f"'{name}' is no data quality flag",
                remedy=f"did you mean {near[0]}?" if near else f"such as {', '.join(NEVER_USED)}",
            )
    return sum(DQ_FLAGS[name] for name in set(names))


@checks_arguments
@dataclass(frozen=True, eq=False, repr=False)
class Cube(Shown):
    """Images of one exposure.

    Parameters
    ----------
    images : (n_int, ny, nx) array
        One image per integration, +y up and +x right, in ``unit``. Single precision stays
        single precision, as do the errors.
    pixel_scale_rad : float
        Side of a pixel.
    instrument, filter : str
        Such as ``NIRISS``, ``F430M``.
    orientation : Orientation
        How the image lies on the sky.
    error : (n_int, ny, nx) array, optional
        Standard deviation of each pixel, in ``unit``.
    dq : (n_int, ny, nx) uint32 array, optional
        JWST data quality flags; nothing flagged where it is left out.
    unit : str
        ``electron/s`` or ``DN/s``; other words are kept as they came.
    integration_time_s : float, optional
        Time of one integration.
    mjd : (n_int,) array, optional
        Modified Julian Date (UTC) at the middle of each integration.
    header : mapping
        Header keywords as they were read, or are to be written.
    source : str
        The file, for messages.
    pixels_known : bool
        Whether the pixel scale is known (a WCS, or the user) and not only usual: what the
        fringes say of their size is then the mask's.
    bad_flags : tuple of str
        Names of the data quality flags of pixels that are not used.
    notes : tuple of str
        What a reader of the result has to know of the headers.

    Raises
    ------
    DataError
        Where shapes disagree, or no pixel holds light.
    """

    images: FloatArray
    pixel_scale_rad: float
    instrument: str
    filter: str
    orientation: Orientation = field(default_factory=Orientation)
    error: FloatArray | None = None
    dq: NDArray[np.uint32] | None = None
    unit: str = "electron/s"
    integration_time_s: float | None = None
    mjd: FloatArray | None = None
    header: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    source: str = "cube"
    pixels_known: bool = False
    notes: tuple[str, ...] = ()
    bad_flags: tuple[str, ...] = NEVER_USED

    def rows(self) -> Rows:
        """What an interpreter shows."""
        n, ny, nx = self.images.shape
        mjd = self.mjd is not None and len(self.mjd)
        return [
            ("source", self.source),
            ("images", f"{n} of {ny} × {nx} pixels of {self.pixel_scale_rad / MAS:.4g} mas"),
            ("instrument", f"{self.instrument} {self.filter}"),
            ("unit", self.unit),
            ("errors", "none" if self.error is None else "of every pixel"),
            ("begins", f"MJD {self.mjd[0]:.5f}" if mjd else "at an unknown date"),  # type: ignore[index]
            *(("note", note) for note in self.notes),
        ]

    def __post_init__(self) -> None:
        self._hold("images", _real(self.images))
        if self.images.ndim != 3:
            raise DataError(f"has {self.images.ndim} axes, not 3", source=self.source)
        nothing = np.broadcast_to(np.uint32(0), self.images.shape)
        dq = nothing if self.dq is None else self.dq
        self._hold("dq", np.asarray(dq, dtype=np.uint32))
        if self.error is not None:
            self._hold("error", _real(self.error))
        for name in ("error", "dq"):
            self._check_shape(name, self.images.shape)
        in_range("Cube", "pixel_scale_rad", self.pixel_scale_rad, MIN_PIXEL_RAD, MAX_PIXEL_RAD)
        if self.mjd is not None:
            self._hold("mjd", np.asarray(self.mjd, dtype=float))
            self._check_shape("mjd", self.images.shape[:1])

    def _hold(self, name: str, array: NDArray[Any]) -> None:
        view = array.view()
        view.flags.writeable = False
        object.__setattr__(self, name, view)

    def _check_shape(self, name: str, shape: tuple[int, ...]) -> None:
        array = getattr(self, name)
        if array is not None and array.shape != shape:
            raise DataError(
                f"{name} has the shape {array.shape}, the images {self.images.shape}",
                source=self.source,
            )

    @property
    def n_integrations(self) -> int:
        """Number of images."""
        return int(self.images.shape[0])

    @property
    def bad(self) -> NDArray[np.bool_]:
        """(n_int, ny, nx): flagged as not to be used, or without a finite value or error."""
        assert self.dq is not None
        bad = ~np.isfinite(self.images)
        # One flag spread over all pixels, as where none are given, is looked at once.
        if (self.dq if any(self.dq.strides) else self.dq[:1, :1, :1]).any():
            bad |= (self.dq & np.uint32(flag_bits(self.bad_flags))) > 0
        if self.error is not None:
            bad |= ~(np.isfinite(self.error) & (self.error > 0.0))
        return bad

    @property
    def variance(self) -> FloatArray | None:
        """(n_int, ny, nx): square of the error, where there is one."""
        return None if self.error is None else self.error**2


def _real(values: NDArray[Any]) -> NDArray[Any]:
    """Floating-point numbers in the machine's order of bytes."""
    array = np.asarray(values)
    single = array.dtype.kind == "f" and array.dtype.itemsize == 4
    return np.asarray(array, dtype=np.float32 if single else float)
