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


_VEGA_JY = ((2.768, 432.6), (3.828, 235.1), (4.285, 190.1), (4.816, 153.3))
"""µm, Jy of magnitude 0 in NIRISS's filters (the zero points of data/niriss.toml)."""

_G2V_OVER_VEGA = ((2.16, 0.0), (3.35, 0.019), (4.60, 0.010))
"""µm, magnitudes by which a G2V dwarf outshines an A0V one of equal Ks: from the mean
colours Ks−W1 = 0.061, W1−W2 = −0.050 (G2V) and 0.042, −0.041 (A0V), E. Mamajek's table of
dwarfs, version 2024.05.15 (Pecaut & Mamajek 2013, ApJS 208, 9)."""


def g2v() -> Tabulated:
    """Spectrum of a G2V dwarf over 2–5.6 µm: Vega's times the mean colours of its type.

    Colours of a photosphere with its CO band, not the band itself: it is right to 1–2 % in
    a filter, and smooth inside. (A blackbody of 5450 K is 3 and 5 % too bright in F430M and
    F480M for its brightness in F380M.)
    """
    wavelength_um = np.linspace(2.0, 5.6, 721)
    um, jansky = np.log(np.array(_VEGA_JY)).T
    slope = np.diff(jansky)[[0, -1]] / np.diff(um)[[0, -1]]
    ends = np.log(wavelength_um[[0, -1]])
    outer = jansky[[0, -1]] + slope * (ends - um[[0, -1]])
    vega = np.interp(np.log(wavelength_um), [ends[0], *um, ends[1]], [outer[0], *jansky, outer[1]])
    excess_mag = np.interp(wavelength_um, *np.array(_G2V_OVER_VEGA).T)
    flux = np.exp(vega) * 10.0 ** (0.4 * excess_mag) / wavelength_um**2
    return Tabulated("G2V", wavelength_um * 1e-6, flux)


def spectrum_named(name: str) -> Spectrum:
    """Make the spectrum that a file or an option calls for.

    Parameters
    ----------
    name : str
        ``"flat"``, ``"G2V"``, ``"blackbody 5450"`` (kelvin), or the path of a table.

    Raises
    ------
    UsageError, DataError
        Where it is none of these, or the table is wrong.
    """
    words = name.split()
    if name.lower() == "flat":
        return Flat()
    if name.lower() == "g2v":
        return g2v()
    if len(words) in (2, 3) and words[0].lower() == "blackbody":
        try:
            return Blackbody(float(words[1].rstrip("Kk")))
        except ValueError:
            raise UsageError(f"'{name}' has no temperature in kelvin") from None
    if Path(name).exists():
        return read_spectrum(name)
    raise UsageError(
        f"spectrum '{name}' is not known",
        remedy="give 'flat', 'G2V', 'blackbody 5450' or a file of wavelength (µm) and flux",
    )


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
