"""Instrument configurations, and which of them are two polarisations of one combiner."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.data.kernel_model import KernelModel
from amibayes.data.measurements import DAY_S, SIMULTANEOUS_S, Measurements
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.units import FloatArray, IntArray, freeze


@dataclass(frozen=True, eq=False)
class Setup:
    """One instrument configuration: its name, stations and spectral channels.

    Parameters
    ----------
    insname, arrname, target : str
        Names as OIFITS gives them (stripped).
    stations : tuple of str
        Station names; `Measurements.stations` indexes them.
    station_index : (n_stations,) int array
        The numbers that OIFITS uses for them (STA_INDEX).
    wavelength_m, band_m : (n_channels,) float array
        Effective wavelength and width of each channel, in metres.
    station_xyz_m : (n_stations, 3) float array, optional
        Positions (holes of a mask, telescopes of an array) in metres.
    station_diameter_m : (n_stations,) float array, optional
    source : str
        The file the data come from.
    right_ascension_deg, declination_deg : float
        Of the target (0 where unknown).
    response : OffAxisResponse, optional
        What the extraction lets through of light off the axis.
    array_frame : str
        FRAME of OI_ARRAY: "GEOCENTRIC" coordinates have their origin in ``array_centre_m``;
        empty on the sky, or where unknown.
    array_centre_m : tuple of float
        ARRAYX, ARRAYY, ARRAYZ.
    kernel : KernelModel, optional
        Of kernel phases: the sums of phases over a pupil that they are.
    """

    insname: str
    arrname: str
    target: str
    stations: tuple[str, ...]
    station_index: IntArray
    wavelength_m: FloatArray
    band_m: FloatArray
    station_xyz_m: FloatArray | None = None
    station_diameter_m: FloatArray | None = None
    source: str = ""
    right_ascension_deg: float = 0.0
    declination_deg: float = 0.0
    response: OffAxisResponse | None = None
    array_frame: str = ""
    array_centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kernel: KernelModel | None = None

    def __post_init__(self) -> None:
        freeze(self)


_POLARISATION = re.compile(r"[_ -]?(?:P|POL)[12]$", re.IGNORECASE)


def without_polarisation(insname: str) -> str:
    """INSNAME of both polarisations: ``GRAVITY_SC`` of ``GRAVITY_SC_P1``."""
    return _POLARISATION.sub("", insname.strip(" \0\t\n"))


def combiners(setups: Sequence[Setup]) -> IntArray:
    """Number the combiner of each setup: one of setups that differ in the polarisation alone."""
    first: dict[tuple[object, ...], int] = {}
    alike: Counter[tuple[object, ...]] = Counter()
    found = []
    for setup in setups:
        known = setup.source, setup.target, setup.stations, setup.wavelength_m.tobytes()
        own, name = (*known, setup.insname), without_polarisation(setup.insname)
        # Another setup of the very same name is another combiner, or another night of it.
        found.append(first.setdefault((*known, name, alike[own]), len(first)))
        alike[own] += 1
    return np.array(found, dtype=np.intp)


def rows_of_exposures(setups: Sequence[Setup], m: Measurements) -> IntArray:
    """Number the rows of tables, (n,): of both polarisations of an exposure as one.

    These are of one combiner, the same stations in the same order, and one time.
    """
    pairs, first, row = np.unique(
        np.stack([m.setup, m.row]), axis=1, return_index=True, return_inverse=True
    )
    row, home = row.ravel(), combiners(setups)
    if len(np.unique(home)) == len(home):
        return np.asarray(row)
    setup, mjd, stations = pairs[0], m.mjd[first], m.stations[first]
    key = np.column_stack([home[setup], stations])
    label, begin, seen = np.empty(len(first), dtype=np.intp), 0, set[int]()
    for k in np.lexsort((setup, pairs[1], mjd, *key.T)).tolist():
        late = DAY_S * (mjd[k] - mjd[begin]) > SIMULTANEOUS_S
        if not seen or setup[k] in seen or late or (key[k] != key[begin]).any():
            begin, seen = k, set()
        label[k] = begin
        seen.add(int(setup[k]))
    least = np.full(len(first), len(first))
    np.minimum.at(least, label, np.arange(len(first)))
    return np.asarray(least[label][row])
