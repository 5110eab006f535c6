"""Bands of a data set: what may have a contrast of its own, and when it was seen."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup
from amibayes.errors import DataError
from amibayes.units import IntArray

GAP = 0.02
"""Setups are of one band where their channels overlap or stand nearer than this part of λ."""

LATEST_MJD = 1e6
"""Of the year 4596: Julian dates, which files hold by mistake, are later."""


@dataclass(frozen=True)
class Band:
    """Setups of one instrument that see the same part of the spectrum.

    Parameters
    ----------
    name : str
        First word of INSNAME and the middle of the band, such as ``NIRISS_4.82um``.
    wavelength_m : float
        Middle of the band.
    setups : tuple of int
        Which of the setups of the data.
    """

    name: str
    wavelength_m: float
    setups: tuple[int, ...]


def band_name(band: str) -> str:
    """Write a band, as ``NIRISS_4.82um``, for a reader: NIRISS 4.82 µm, in one piece."""
    return re.sub(r"_([\d.]+)um$", "\u00a0\\1\u00a0µm", band)


def bands_of(observables: Observables) -> tuple[Band, ...]:
    """Bands of the unflagged data, the shortest wavelength (the reference band) first."""
    data = observables.unflagged()
    used = np.unique(np.concatenate([data.vis2.setup, data.closure_phase.setup]))
    spans = {int(k): _span(data.setups[k]) for k in used}
    groups: list[list[int]] = []
    for k in sorted(spans, key=lambda k: (_instrument(data.setups[k]), *spans[k], k)):
        last = groups[-1] if groups else []
        same = last and _instrument(data.setups[k]) == _instrument(data.setups[last[0]])
        end = max((spans[j][1] for j in last), default=0.0)
        if same and spans[k][0] < end * (1.0 + GAP):
            last.append(k)
        else:
            groups.append([k])
    found = [_band(data.setups, spans, group) for group in groups]
    return tuple(sorted(found, key=lambda b: (b.wavelength_m, b.name)))


def _band(
    setups: tuple[Setup, ...], spans: dict[int, tuple[float, float]], group: list[int]
) -> Band:
    middle = 0.5 * (min(spans[k][0] for k in group) + max(spans[k][1] for k in group))
    name = f"{_instrument(setups[group[0]])}_{1e6 * middle:.3g}um"
    return Band(name, middle, tuple(group))


def _instrument(setup: Setup) -> str:
    """First word of INSNAME: what follows are modes and channels."""
    word = re.match(r"[^\W\d_]+", setup.insname)
    return word.group().upper() if word else "DATA"


def _span(setup: Setup) -> tuple[float, float]:
    half = 0.5 * np.nan_to_num(setup.band_m)
    wavelength = setup.wavelength_m
    return float(np.min(wavelength - half)), float(np.max(wavelength + half))


def band_numbers(observables: Observables, names: tuple[str, ...]) -> IntArray:
    """Place of each setup's band among ``names``, (n_setups,); −1 where it holds no data.

    Raises
    ------
    ValueError
        Where the data have other bands.
    """
    found = bands_of(observables)
    if not {b.name for b in found} <= set(names):
        raise ValueError(f"bands {[b.name for b in found]} and not {names}")
    numbers = np.full(len(observables.setups), -1, dtype=np.intp)
    for band in found:
        numbers[list(band.setups)] = names.index(band.name)
    return numbers


def reference_wavelength(observables: Observables) -> float:
    """Geometric mean wavelength of the unflagged data, metres."""
    data = observables.unflagged()
    wavelengths = np.concatenate([data.vis2.wavelength_m, data.closure_phase.wavelength_m])
    return float(np.exp(np.sort(np.log(wavelengths)).mean()))


def dates(observables: Observables) -> tuple[float, float, float]:
    """First, last and mean date (MJD) of the data.

    The mean is weighted by inverse variance within V² and within closure phases, whose variances
    have different units; each kind counts by its number of data.

    Raises
    ------
    DataError
        Where a date is missing, or is no MJD.
    """
    data = observables.unflagged()
    parts: tuple[Measurements, ...] = (data.vis2, data.closure_phase)
    mjd = np.concatenate([m.mjd for m in parts])
    undated = ~np.isfinite(mjd) | (mjd <= 0.0)
    if undated.any():
        setup = np.concatenate([m.setup for m in parts])[undated][0]
        raise DataError(
            "has data without a date, and a motion needs dates",
            source=data.setups[int(setup)].source or data.source,
            remedy="fill in the MJD column",
        )
    weight = 1.0 / data.covariance.variance
    for kind in (slice(0, data.n_vis2), slice(data.n_vis2, None)):
        weight[kind] /= weight[kind].mean() if weight[kind].size else 1.0
    if mjd.max() >= LATEST_MJD:
        raise DataError(
            f"has dates that are no MJD, such as {mjd.max():.1f}, and a motion needs dates",
            source=data.source,
            remedy="take 2400000.5 from Julian dates in the MJD column",
        )
    # Summed about the first date, so that the order of the data does not show.
    mean = mjd.min() + float(np.sum(np.sort(weight * (mjd - mjd.min()))) / np.sum(np.sort(weight)))
    return float(mjd.min()), float(mjd.max()), mean
