"""Observables of an ideal point source on any array, which simulations start from."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.measurements import Measurements
from amibayes.data.observables import CovarianceKind, Observables
from amibayes.data.setup import Setup
from amibayes.support.arguments import checks_arguments
from amibayes.units import FloatArray


@checks_arguments
def point_source(
    stations_m: ArrayLike,
    wavelength_m: ArrayLike,
    band_m: ArrayLike,
    *,
    vis2_error: float,
    closure_error_rad: float,
    covariance: CovarianceKind = "assumed",
    insname: str = "SYNTHETIC",
    mjd: float = 60000.0,
) -> Observables:
    """Noiseless observables, V² = 1 and closure phase = 0, of a snapshot.

    Parameters
    ----------
    stations_m : (n_stations, 2) array
        East and north coordinates of holes or telescopes, projected on the sky, in metres.
        The baseline of stations i < j is the vector from i to j.
    wavelength_m, band_m : (n_channels,) array
        Effective wavelength and width of the channels.
    vis2_error, closure_error_rad : float
        1σ errors of every number.
    covariance : {"assumed", "diagonal"}
        Closures of independent baseline phases, or independent.
    insname : str
        Name of the instrument.
    mjd : float
        Date.

    Returns
    -------
    Observables
        n(n−1)/2 squared visibilities and n(n−1)(n−2)/6 closure phases per channel.
    """
    stations = np.asarray(stations_m, dtype=float)
    wavelength = np.atleast_1d(np.asarray(wavelength_m, dtype=float))
    band = np.broadcast_to(np.asarray(band_m, dtype=float), wavelength.shape)
    n = len(stations)
    pairs = np.array(list(combinations(range(n), 2)), dtype=np.intp)
    triangles = np.array(list(combinations(range(n), 3)), dtype=np.intp).reshape(-1, 3)
    vis2 = _rows(stations, pairs, np.array([[0, 1]]), wavelength, band, mjd, 1.0)
    closure = _rows(stations, triangles, np.array([[0, 1], [1, 2]]), wavelength, band, mjd, 0.0)
    names = tuple(f"H{k + 1}" for k in range(n))
    xyz = np.column_stack([stations, np.zeros(n)])
    setup = Setup(insname, insname, "POINT", names, np.arange(1, n + 1), wavelength, band, xyz)
    errors = np.full(len(vis2), vis2_error), np.full(len(closure), closure_error_rad)
    return Observables(
        vis2,
        closure,
        covariance_of_errors(errors[0], closure, errors[1], covariance),
        covariance,
        (setup,),
    )


def _rows(
    stations: FloatArray,
    members: np.ndarray,
    legs: np.ndarray,
    wavelength: FloatArray,
    band: FloatArray,
    mjd: float,
    value: float,
) -> Measurements:
    n_rows, n_channels = len(members), len(wavelength)
    n = n_rows * n_channels
    row = np.repeat(np.arange(n_rows), n_channels)
    channel = np.tile(np.arange(n_channels), n_rows)
    vector = stations[members[:, legs[:, 1]]] - stations[members[:, legs[:, 0]]]
    zeros = np.zeros(n, dtype=np.intp)
    return Measurements(
        value=np.full(n, value),
        u_m=vector[row, :, 0],
        v_m=vector[row, :, 1],
        wavelength_m=wavelength[channel],
        band_m=band[channel],
        mjd=np.full(n, mjd),
        integration_s=np.ones(n),
        stations=members[row],
        setup=zeros,
        row=row,
        channel=channel,
        flag=np.zeros(n, dtype=bool),
    )
