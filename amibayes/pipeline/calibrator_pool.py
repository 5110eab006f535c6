"""Calibrators out of a pool: those nearest to a target in time, brightness and spectral type."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.errors import DataError
from amibayes.pipeline.batch import read_targets

DAYS, MAGNITUDES, SUBTYPES = 1.0, 0.75, 10.0
"""Differences that count alike: a night, in which thermal and wavefront drifts go on; a factor of
two in charge, with which pixels spill; a spectral class (G to K), over which the effective
wavelength of a filter shifts."""

CLASSES = "OBAFGKMLTY"

DATES = ("EXPMID", "MJD-AVG", "MJD-OBS", "MJD-BEG")
"""Keywords of images with the date, the best first."""


@dataclass(frozen=True)
class PoolStar:
    """A star as far as it matters for the choice; None for what is not known.

    Parameters
    ----------
    files : tuple of str
    mjd, magnitude : float, optional
    subtype : float, optional
        On the scale of `subtype_of`.
    setup : str, optional
        Instrument and wavelength; stars of different setups do not calibrate each other.
    """

    files: tuple[str, ...]
    mjd: float | None = None
    magnitude: float | None = None
    subtype: float | None = None
    setup: str | None = None


@dataclass(frozen=True)
class Chosen:
    """A calibrator that was chosen, and how far it is from the target; None where unknown."""

    star: PoolStar
    days: float | None
    magnitudes: float | None
    subtypes: float | None

    @property
    def distance(self) -> float:
        """Root of the sum of squares, in units of the differences that count alike."""
        parts = zip(
            (self.days, self.magnitudes, self.subtypes), (DAYS, MAGNITUDES, SUBTYPES), strict=True
        )
        return math.sqrt(sum((value / scale) ** 2 for value, scale in parts if value is not None))

    def words(self) -> str:
        """Name it, with how far it is."""
        parts = [
            f"{value:.3g} {unit}"
            for value, unit in (
                (self.days, "d"),
                (self.magnitudes, "mag"),
                (self.subtypes, "subtypes"),
            )
            if value is not None
        ]
        name = Path(self.star.files[0]).name
        return f"{name} ({', '.join(parts)})" if parts else name


def nearest(pool: Sequence[PoolStar], target: PoolStar, number: int) -> tuple[Chosen, ...]:
    """Choose the calibrators of a target, the nearest first.

    Parameters
    ----------
    pool : sequence of PoolStar
    target : PoolStar
        Never its own calibrator, if the pool has it.
    number : int

    Raises
    ------
    DataError
        Where the pool has none of the target's setup.
    """
    own = {str(Path(f).resolve()) for f in target.files}
    fitting = [
        Chosen(
            star,
            _apart(star.mjd, target.mjd),
            _apart(star.magnitude, target.magnitude),
            _apart(star.subtype, target.subtype),
        )
        for star in pool
        if None in (star.setup, target.setup) or star.setup == target.setup
        if own.isdisjoint(str(Path(f).resolve()) for f in star.files)
    ]
    if not fitting:
        raise DataError(
            f"the pool has no calibrator of {target.setup}",
            source=target.files[0],
            remedy="add some, or name calibrators in column 'cal'",
        )
    return tuple(sorted(fitting, key=lambda c: (c.distance, c.star.files))[:number])


def _apart(one: float | None, other: float | None) -> float | None:
    return None if one is None or other is None else abs(one - other)


@lru_cache(maxsize=4)
def read_pool(path: str) -> tuple[PoolStar, ...]:
    """Read a pool: a table like that of the targets, with a calibrator in each row.

    Parameters
    ----------
    path : str
        Columns ``target`` (its files), and if known ``mjd``, ``magnitude`` and
        ``spectral_type``; the date is read from the files otherwise.

    Raises
    ------
    DataError
    """
    return tuple(star_of(row.files(row.target), row.facts) for row in read_targets(path))


def star_of(files: Sequence[str], facts: dict[str, Any]) -> PoolStar:
    """Describe a star by what a table has of it, and by its first file."""
    date, setup = _of_file(files[0])
    mjd = facts.get("mjd", date)
    kind = facts.get("spectral_type")
    return PoolStar(
        tuple(files),
        None if mjd is None else float(mjd),
        None if facts.get("magnitude") is None else float(facts["magnitude"]),
        None if kind is None else subtype_of(str(kind)),
        setup,
    )


def subtype_of(text: str) -> float | None:
    """Place a spectral type on a scale of tenths of a class: A0 is 20, K3.5III 53.5."""
    found = re.match(rf"\s*([{CLASSES}])\s*(\d(?:\.\d+)?)?", text)
    if found is None:
        return None
    return 10.0 * CLASSES.index(found[1]) + float(found[2] or 5.0)


def _of_file(path: str) -> tuple[float | None, str | None]:
    """Date and setup of a file; None for what it does not state, or where it cannot be read."""
    try:
        with fits.open(path, memmap=True) as hdus:
            tables = {h.name: h for h in hdus if h.name in ("OI_VIS2", "OI_T3", "OI_WAVELENGTH")}
            if tables:
                return _date_of(tables), _setup_of(tables)
            header = hdus[0].header
            date = next((float(header[k]) for k in DATES if k in header), None)
            names = [str(header[k]) for k in ("INSTRUME", "FILTER") if k in header]
            return date, " ".join(names) or None
    # What is wrong with a target's file is reported when it is read; the pool goes without.
    except (OSError, ValueError, TypeError):
        return None, None


def _date_of(tables: dict[str, Any]) -> float | None:
    dates = [tables[n].data["MJD"] for n in ("OI_VIS2", "OI_T3") if n in tables]
    return float(np.mean(np.concatenate(dates))) if dates else None


def _setup_of(tables: dict[str, Any]) -> str | None:
    if "OI_WAVELENGTH" not in tables:
        return None
    table = tables["OI_WAVELENGTH"]
    middle = 1e6 * float(np.mean(table.data["EFF_WAVE"]))
    return f"{str(table.header.get('INSNAME', '')).split('_')[0]} {middle:.2f} µm"
