"""Spectra of sources: how many photons per unit of wavelength, on any scale.

Only the shape matters here; the brightness of a source is its magnitude, and the
zero point of that belongs to the instrument's filter.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from astropy import constants

from amibayes.errors import DataError, UsageError
from amibayes.units import FloatArray, read_only

_HC_OVER_K = float((constants.h * constants.c / constants.k_B).value)


class Spectrum(Protocol):
    """Anything that has a relative photon rate per unit of wavelength."""

    @property
    def name(self) -> str:
        """What to call it in a file."""

    def photon_density(self, wavelength_m: FloatArray) -> FloatArray:
        """Relative photons per unit of wavelength, the shape of ``wavelength_m``."""


@dataclass(frozen=True, eq=False)
class Flat:
    """As many photons in every unit of wavelength."""

    name: str = "flat"

    def photon_density(self, wavelength_m: FloatArray) -> FloatArray:
        """Return ones."""
        return np.ones_like(wavelength_m, dtype=float)


@dataclass(frozen=True, eq=False)
class Blackbody:
    """Planck's law, λ⁻⁴ / (e^{hc/λkT} − 1) photons per unit of wavelength.

    Parameters
    ----------
    temperature_k : float
        Temperature in kelvin, above zero.
    """

    temperature_k: float

    def __post_init__(self) -> None:
        if not 0.0 < self.temperature_k < np.inf:
            raise UsageError(f"a blackbody of {self.temperature_k:g} K has no spectrum")

    @property
    def name(self) -> str:
        """``blackbody 5450 K``."""
        return f"blackbody {self.temperature_k:g} K"

    def photon_density(self, wavelength_m: FloatArray) -> FloatArray:
        """Relative photons per unit of wavelength."""
        wavelength = np.asarray(wavelength_m, dtype=float)
        exponent = _HC_OVER_K / (wavelength * self.temperature_k)
        # e^{-x}/(1 − e^{-x}) does not overflow on the Wien side.
        return np.asarray((wavelength * 1e6) ** -4 * np.exp(-exponent) / -np.expm1(-exponent))


@dataclass(frozen=True, eq=False)
class Tabulated:
    """A spectrum given as energy flux F_λ on a table of wavelengths, linear between.

    Parameters
    ----------
    name : str
        What to call it.
    wavelength_m : (n,) array
        Rising wavelengths, metres.
    flux_density : (n,) array
        F_λ, energy per unit of wavelength, on any scale; not negative.
    """

    name: str
    wavelength_m: FloatArray
    flux_density: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "wavelength_m", "flux_density")
        if self.wavelength_m.shape != self.flux_density.shape or self.wavelength_m.size < 2:
            raise DataError(f"spectrum {self.name} needs two columns of two rows or more")
        if np.any(np.diff(self.wavelength_m) <= 0.0) or self.wavelength_m[0] <= 0.0:
            raise DataError(f"spectrum {self.name} has wavelengths that do not rise")
        if np.any(self.flux_density < 0.0) or not np.any(self.flux_density > 0.0):
            raise DataError(f"spectrum {self.name} has a flux that is negative or nowhere positive")

    def photon_density(self, wavelength_m: FloatArray) -> FloatArray:
        """Relative photons per unit of wavelength.

        Raises
        ------
        DataError
            Where a wavelength lies outside the table.
        """
        wavelength = np.asarray(wavelength_m, dtype=float)
        table = self.wavelength_m
        if wavelength.min() < table[0] or wavelength.max() > table[-1]:
            raise DataError(
                f"spectrum {self.name} covers {table[0] * 1e6:.3f}–{table[-1] * 1e6:.3f} µm, "
                f"not {wavelength.min() * 1e6:.3f}–{wavelength.max() * 1e6:.3f} µm"
            )
        return np.asarray(np.interp(wavelength, table, self.flux_density) * wavelength * 1e6)


def read_spectrum(path: str | Path) -> Tabulated:
    """Read a two-column text file: wavelength in µm, F_λ on any scale.

    Raises
    ------
    DataError
        Where the file cannot be read or does not hold a spectrum.
    """
    try:
        table = np.loadtxt(path, ndmin=2)
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror or error}", source=path) from error
    except ValueError as error:
        raise DataError(f"is not a table of numbers: {error}", source=path) from error
    if table.shape[1] < 2 or not np.all(np.isfinite(table)):
        raise DataError("needs two columns of finite numbers: µm and flux", source=path)
    return Tabulated(Path(path).name, table[:, 0] * 1e-6, table[:, 1])
