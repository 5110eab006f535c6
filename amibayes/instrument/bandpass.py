"""The filter: its throughput, and the few wavelengths that stand for it.

An image through a filter is a sum over wavelengths of smooth functions of 1/λ, weighted
by throughput × photon spectrum. Gauss quadrature with exactly that weight (Golub & Welsch
1969, on the discrete measure of the table) needs far fewer wavelengths than even steps:
n of them integrate polynomials in 1/λ of degree 2n − 1 without error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh_tridiagonal

from amibayes.errors import DataError
from amibayes.scene.spectrum import Flat, Spectrum
from amibayes.units import FloatArray, read_only

_FINE = 2001
"""Points on which table and spectrum are multiplied before the quadrature."""


@dataclass(frozen=True, eq=False)
class Channels:
    """Wavelengths and their share of the detected photons.

    Parameters
    ----------
    wavelength_m : (n,) array
        Wavelengths, metres.
    weight : (n,) array
        Fraction of the detected photons; sums to 1.
    """

    wavelength_m: FloatArray
    weight: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "wavelength_m", "weight")

    def __len__(self) -> int:
        return len(self.wavelength_m)

    @property
    def mean_m(self) -> float:
        """Mean wavelength of the detected photons, metres."""
        return float(self.weight @ self.wavelength_m)

    @classmethod
    def monochromatic(cls, wavelength_m: float) -> Channels:
        """One wavelength."""
        return cls(np.array([wavelength_m]), np.ones(1))


@dataclass(frozen=True, eq=False)
class Bandpass:
    """A filter as the detector sees it.

    Parameters
    ----------
    name : str
        What it is called.
    wavelength_m : (n,) array
        Rising wavelengths, metres.
    throughput : (n,) array
        Detected photons per photon that enters the telescope, linear between the rows.
    vega_flux_jy : float or None
        Flux density of magnitude 0, jansky; ``None`` where it is not known.
    """

    name: str
    wavelength_m: FloatArray
    throughput: FloatArray
    vega_flux_jy: float | None = None

    def __post_init__(self) -> None:
        read_only(self, "wavelength_m", "throughput")
        wavelength, throughput = self.wavelength_m, self.throughput
        if wavelength.ndim != 1 or wavelength.shape != throughput.shape or wavelength.size < 2:
            raise DataError(f"filter {self.name} needs 2 wavelengths or more, each a throughput")
        if wavelength[0] <= 0.0 or np.any(np.diff(wavelength) <= 0.0):
            raise DataError(f"filter {self.name} has wavelengths that do not rise")
        if np.any(throughput < 0.0) or np.any(throughput > 1.0) or not np.any(throughput > 0.0):
            raise DataError(f"filter {self.name} has a throughput outside 0 to 1, or none at all")

    def _fine(self) -> tuple[FloatArray, FloatArray]:
        grid = np.linspace(self.wavelength_m[0], self.wavelength_m[-1], _FINE)
        wavelength = np.union1d(grid, self.wavelength_m)
        return wavelength, np.interp(wavelength, self.wavelength_m, self.throughput)

    @property
    def pivot_m(self) -> float:
        """Pivot wavelength, √(∫T λ dλ / ∫T dλ/λ), metres."""
        wavelength, throughput = self._fine()
        top = np.trapezoid(throughput * wavelength, wavelength)
        return float(np.sqrt(top / np.trapezoid(throughput / wavelength, wavelength)))

    @property
    def effective_width_m(self) -> float:
        """Width of the box as high as the filter's peak that passes as much, metres."""
        wavelength, throughput = self._fine()
        return float(np.trapezoid(throughput, wavelength) / throughput.max())

    @property
    def half_power_m(self) -> tuple[float, float]:
        """First and last wavelength at half the peak throughput, metres."""
        level = 0.5 * self.throughput.max()
        above = np.flatnonzero(self.throughput >= level)
        return self._crossing(above[0], -1, level), self._crossing(above[-1], +1, level)

    def _crossing(self, inside: np.intp, step: int, level: float) -> float:
        outside = int(inside) + step
        if not 0 <= outside < self.throughput.size:
            return float(self.wavelength_m[inside])
        ends = np.array([outside, inside])
        return float(np.interp(level, self.throughput[ends], self.wavelength_m[ends]))

    def photon_integral(self, spectrum: Spectrum) -> float:
        """∫ T(λ) n(λ) dλ of a spectrum's relative photon density n, in its own scale × m."""
        wavelength, throughput = self._fine()
        return float(np.trapezoid(throughput * spectrum.photon_density(wavelength), wavelength))

    def channels(self, spectrum: Spectrum | None = None, n: int | None = None) -> Channels:
        """Wavelengths and weights that stand for the filter.

        Parameters
        ----------
        spectrum : Spectrum, optional
            Of the source; as many photons everywhere unless given.
        n : int, optional
            How many wavelengths; enough for 1e-9 in V² over an 80 × 80 image of any NIRISS
            filter unless given (9 for the medium filters, 22 for F277W; a test holds it).

        Returns
        -------
        Channels
            Gauss nodes in 1/λ, rising in λ, for throughput × photon density.
        """
        wavelength, throughput = self._fine()
        photons = throughput * (spectrum or Flat()).photon_density(wavelength)
        cell = np.gradient(wavelength)
        cell[[0, -1]] *= 0.5
        low, high = self.half_power_m
        enough = 5 + int(np.ceil(120.0 * (high - low) / (high + low)))
        nodes, weight = _gauss(1.0 / wavelength, photons * cell, n or enough)
        return Channels(1.0 / nodes[::-1], weight[::-1])


def _gauss(points: FloatArray, mass: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Nodes (rising) and weights (sum 1) of Gauss quadrature for a discrete measure.

    Lanczos on the diagonal matrix of the points, orthogonalised against all former
    vectors: the Jacobi matrix that results has the nodes as eigenvalues.
    """
    used = mass > 0.0
    centre, scale = 0.5 * (points.max() + points.min()), 0.5 * np.ptp(points)
    x = (points[used] - centre) / scale
    n = min(n, x.size)
    basis = np.zeros((n + 1, x.size))
    diagonal, beside = np.zeros(n), np.zeros(n)
    basis[0] = np.sqrt(mass[used] / mass[used].sum())
    for k in range(n):
        ahead = x * basis[k]
        diagonal[k] = basis[k] @ ahead
        for _ in range(2):
            ahead -= basis[: k + 1].T @ (basis[: k + 1] @ ahead)
        beside[k] = np.linalg.norm(ahead)
        basis[k + 1] = ahead / beside[k] if beside[k] > 0.0 else 0.0
    nodes, vectors = eigh_tridiagonal(diagonal, beside[: n - 1])
    return centre + scale * nodes, vectors[0] ** 2
