"""The (u, v, λ) points at which a data set needs complex visibilities, each once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from amibayes.data.observables import Observables
from amibayes.models.off_axis import OffAxis, off_axis_of
from amibayes.models.response_waves import ResponseWaves, response_waves
from amibayes.models.uv_sums import phase_sums
from amibayes.units import MAS, FloatArray, IntArray

YEAR_DAYS = 365.25

SAME_POINT = 1e-9
"""Points nearer than this fraction of the longest baseline are one (float32 files differ more)."""


@dataclass(frozen=True, eq=False)
class UVPoints:
    """Distinct points of the (u, v) plane and how the data are built from them.

    Parameters
    ----------
    u, v : (n,) float array
        Spatial frequencies, cycles per radian.
    relative_band : (n,) float array
        Δλ/λ of the channel; 0 where ``off_axis`` has the smearing, and of kernel phases.
    squares : (n_vis2, n) sparse array
        V² = squares · |V|²; one entry 1 in each row.
    legs : (n_closure, n) sparse array
        Closure phase = legs · phase; entries are ±1, those of kernel phases any number.
    off_axis : OffAxis, optional
        Response of the extraction to light off the axis; 1 where there is none.
    bands : (n,) int array, optional
        Number of each point's band, where bands are told apart.
    mjd : (n,) float array, optional
        Date of each point, where dates are told apart.
    wavelength_m : (n,) float array, optional
        Wavelength of each point, where wavelengths are told apart.
    """

    u: FloatArray
    v: FloatArray
    relative_band: FloatArray
    squares: csr_array
    legs: csr_array
    off_axis: OffAxis | None = None
    bands: IntArray | None = None
    mjd: FloatArray | None = None
    wavelength_m: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.u)

    @property
    def frequency(self) -> FloatArray:
        """Length of the spatial frequency, cycles per radian."""
        return np.asarray(np.hypot(self.u, self.v))

    @cached_property
    def from_squares(self) -> csr_array:
        """Transpose of ``squares``, (n, n_vis2)."""
        return self.squares.T.tocsr()

    @cached_property
    def from_legs(self) -> csr_array:
        """Transpose of ``legs``, (n, n_closure)."""
        return self.legs.T.tocsr()

    @cached_property
    def response_waves(self) -> ResponseWaves | None:
        """The response off the axis for extended light, out to λ/2B of the shortest baseline."""
        if self.off_axis is None:
            return None
        return response_waves(self.off_axis, 0.5 / float(self.frequency.min()) / MAS)

    @property
    def band(self) -> IntArray:
        """Number of each point's band, 0 where they are not told apart, (n,)."""
        return np.zeros(len(self), dtype=np.intp) if self.bands is None else self.bands

    def years(self, reference_mjd: float) -> FloatArray:
        """Julian years of each point since a date, (n,)."""
        if self.mjd is None:
            raise ValueError("these samples do not know their dates")
        return np.asarray((self.mjd - reference_mjd) / YEAR_DAYS)

    def log_colour(self, reference_wavelength_m: float) -> FloatArray:
        """ln(λ/λ₀) of each point, (n,); λ₀ the geometric mean of the points unless given."""
        if self.wavelength_m is None:
            raise ValueError("these samples do not know their wavelengths")
        log = np.log(self.wavelength_m)
        zero = np.log(reference_wavelength_m) if reference_wavelength_m else log.mean()
        return np.asarray(log - zero)


def uv_points_of(
    observables: Observables,
    band_of_setup: IntArray | None = None,
    *,
    dated: bool = False,
    coloured: bool = False,
) -> UVPoints:
    """Collect the points of unflagged observables; opposite points are conjugate, hence one.

    Parameters
    ----------
    observables : Observables
    band_of_setup : (n_setups,) int array, optional
        Keeps equal points of different bands apart.
    dated : bool
        Keep equal points of different dates apart.
    coloured : bool
        Keep equal points of different wavelengths apart.
    """
    data = observables.unflagged()
    v2, cp = data.vis2, data.closure_phase
    sums = phase_sums(data)

    def column(name: str) -> NDArray[Any]:
        return np.concatenate([getattr(v2, name), getattr(cp, name)[sums.owner]])

    wavelength, band, setup, mjd = (column(n) for n in ("wavelength_m", "band_m", "setup", "mjd"))
    u = np.concatenate([v2.u_m[:, 0], sums.u_m]) / wavelength
    v = np.concatenate([v2.v_m[:, 0], sums.v_m]) / wavelength
    bands = None if band_of_setup is None else band_of_setup[setup]
    labels = ([] if bands is None else [bands]) + ([mjd] if dated else [])
    labels += [wavelength] if coloured else []
    extracted = np.array([s.response is not None for s in data.setups])[setup]
    if extracted.any():
        labels += [setup, mjd]  # each exposure has a response, and a centre, of its own
    # A transform of an image has one spatial frequency for the whole band: it smears nothing.
    sharp = extracted | np.array([s.kernel is not None for s in data.setups])[setup]
    width = np.where(sharp, 0.0, band / wavelength)
    first, index, sign = _distinct(u, v, width, labels)
    n, n2, n3 = len(first), len(v2), len(cp)
    weight = sums.weight * sign[n2 + sums.column]
    legs = csr_array((weight, (sums.row, index[n2 + sums.column])), shape=(n3, n))
    orientation = sign[first]
    uv = np.stack([u[first], v[first]], axis=1) * orientation[:, None]
    return UVPoints(
        uv[:, 0],
        uv[:, 1],
        width[first],
        csr_array((np.ones(n2), (np.arange(n2), index[:n2])), shape=(n2, n)),
        legs,
        off_axis_of(data, first, orientation, uv, np.column_stack([setup, mjd])[first]),
        None if bands is None else bands[first],
        mjd[first] if dated else None,
        wavelength[first] if coloured else None,
    )


def _distinct(
    u: FloatArray, v: FloatArray, band: FloatArray, labels: Sequence[NDArray[Any]]
) -> tuple[IntArray, IntArray, FloatArray]:
    scale = SAME_POINT * np.hypot(u, v).max(initial=1e-300)
    grid = np.stack([np.rint(u / scale), np.rint(v / scale)], axis=1)
    lead = np.where(grid[:, 0] != 0, grid[:, 0], grid[:, 1])
    sign = np.where(lead < 0, -1.0, 1.0)
    key = np.column_stack([grid * sign[:, None], np.rint(band * 1e9), *labels])
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    return first, index.ravel(), sign
