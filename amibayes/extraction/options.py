"""What an extraction is asked to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from amibayes.errors import UsageError
from amibayes.support.options import (
    CLIP_INTEGRATIONS,
    EXTRACTION_METHODS,
    ExtractionCovariance,
    Geometry,
)

METHODS = EXTRACTION_METHODS


COLDEST_K = 100.0
"""A blackbody that is colder has no light in these filters."""

MAX_MIGRATION = 1e-5
"""Sides of pixels that move farther per electron would leave no pixel where it is."""


@dataclass(frozen=True)
class ExtractOptions:
    """What an extraction is asked to do.

    Parameters
    ----------
    method : {"fringes", "matched", "fft", "gauss", "square", "unique"}
        ``fringes`` fits the images; the others sample their Fourier transform.
    clip : float
        Integrations whose observables are outliers by more standard deviations are left out.
    outlier : float
        Pixels that differ from their own in other integrations by more are left out.
    window_px : float, optional
        Radius at which the window of the Fourier methods has fallen to a half; 0 for no
        window. By default 0.45 of the image's side. ``fringes`` takes none.
    covariance : {"shrunk", "scatter", "physical"}
        Scatter shrunk towards photon and read noise, or one of them alone.
    temperature_k : float, optional
        Blackbody that stands for the star's spectrum; as many photons at every wavelength
        unless given.
    geometry : {"fitted", "stated"}
        Pixel scale and rotation of the mask: fitted once for a cube where its image tells
        them, or as the header and the options say.
    keep_all : bool
        Leave no integration out that can be measured at all.
    charge_migration : "fit", "off", or float
        Charge that passes between pixels: fitted to the ramps of a visit, or of the
        instrument's file where there are none; left in; or this displacement of pixels'
        sides, pixels per electron.

    Raises
    ------
    UsageError
        Where a value makes no sense.
    """

    method: str = next(iter(EXTRACTION_METHODS))
    clip: float = CLIP_INTEGRATIONS
    outlier: float = 7.0
    window_px: float | None = None
    covariance: ExtractionCovariance = "shrunk"
    temperature_k: float | None = None
    geometry: Geometry = "fitted"
    keep_all: bool = False
    charge_migration: float | Literal["fit", "off"] = "fit"

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise UsageError(
                f"method '{self.method}' is not known", remedy=f"choose from {', '.join(METHODS)}"
            )
        for name in ("clip", "outlier"):
            if not getattr(self, name) > 0.0:
                raise UsageError(f"{name} is {getattr(self, name):g}; it must be above 0")
        if self.window_px is not None and not 0.0 <= self.window_px < math.inf:
            raise UsageError(
                f"window is {self.window_px:g} pixels; it must be at least 0, and finite"
            )
        if self.temperature_k is not None and not self.temperature_k >= COLDEST_K:
            raise UsageError(
                f"temperature is {self.temperature_k:g} K; it must be at least {COLDEST_K:g}"
            )

        self._check_migration()

    def _check_migration(self) -> None:
        value = self.charge_migration
        if value in ("fit", "off"):
            return
        if not isinstance(value, float) or not abs(value) <= MAX_MIGRATION:
            raise UsageError(
                f"charge migration is {value!r}",
                remedy=f"give fit, off, or pixels per electron up to {MAX_MIGRATION:g}",
            )

    def refuse_unused(self) -> None:
        """Refuse a window that the method would leave aside.

        Raises
        ------
        UsageError
            Where the method is ``fringes``.
        """
        if self.window_px is not None and self.method == "fringes":
            raise UsageError(
                "the method fringes has no window",
                remedy=f"leave the window out, or choose from {', '.join(list(METHODS)[1:])}",
            )

    def as_mapping(self) -> Mapping[str, Any]:
        """Every option with its value."""
        return asdict(self)
