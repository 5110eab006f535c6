"""A library of calibrators: extracted stars of one instrument and filter in one file.

An HDF5 file with a group for each star, named after the digest of its data: the OIFITS file as it
was written, and what is known of the star and its exposure.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from amibayes.calibration.calibrate import mean_mjd
from amibayes.calibration.transfer import Diameter
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.oifits import read_oifits, write_oifits
from amibayes.support.atomic_files import atomic_path

FORMAT = "amibayes calibrator library 1"


@dataclass(frozen=True)
class StarFacts:
    """What is known of a calibrator and its exposure.

    Parameters
    ----------
    name : str
        Of its file.
    mjd : float
        Mean date.
    charge : float
        Charge level or brightness, in any one unit; NaN where it is not known.
    spectral_type : str
    wavefront : str
        What is known of the wavefront, such as the name of an OPD map.
    diameter_mas, diameter_error_mas : float
        Uniform disc.
    """

    name: str
    mjd: float
    charge: float = float("nan")
    spectral_type: str = ""
    wavefront: str = ""
    diameter_mas: float = 0.0
    diameter_error_mas: float = 0.0


@dataclass(frozen=True, eq=False)
class Library:
    """Calibrators of one instrument and filter.

    Parameters
    ----------
    path : Path
    stars : tuple of StarFacts
        By date.
    observables : tuple of Observables
    """

    path: Path
    stars: tuple[StarFacts, ...]
    observables: tuple[Observables, ...]

    @property
    def diameters_mas(self) -> list[Diameter]:
        """Uniform-disc diameter and error of each star."""
        return [(s.diameter_mas, s.diameter_error_mas) for s in self.stars]

    def without(self, others: Sequence[Observables]) -> Library:
        """Leave out the stars whose data are among others."""
        known = {_key(o) for o in others}
        keep = [k for k, o in enumerate(self.observables) if _key(o) not in known]
        stars = tuple(self.stars[k] for k in keep)
        return Library(self.path, stars, tuple(self.observables[k] for k in keep))


def add_to_library(
    path: str | Path, observables: Sequence[Observables], facts: Sequence[StarFacts] | None = None
) -> int:
    """Add calibrators to a library, which is made where there is none.

    Parameters
    ----------
    path : path
    observables : sequence of Observables
        Not yet calibrated. A star whose data are there already is not added twice.
    facts : sequence of StarFacts, optional
        By default name and date alone.

    Returns
    -------
    int
        How many were new.

    Raises
    ------
    DataError
        Where the file is no library, or of another instrument or filter.
    """
    path, new = Path(path), 0
    known = list(facts or [StarFacts(Path(o.source).name, mean_mjd(o)) for o in observables])
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs["format"] = FORMAT
        setup = _copied(path, file) if path.exists() else _setup(observables[0])
        file.attrs["setup"] = setup
        for one, star in zip(observables, known, strict=True):
            if _setup(one) != setup:
                raise DataError(
                    f"is of {_setup(one)}, and the library {path} of {setup}",
                    source=one.source,
                    remedy="keep one library for each instrument and filter",
                )
            new += _add(file, one, star)
    return new


def _copied(path: Path, file: h5py.File) -> str:
    """Copy the stars of a library; give its setup."""
    with _opened(path) as before:
        for key in before:
            before.copy(key, file)
        return str(before.attrs["setup"])


def _add(file: h5py.File, observables: Observables, star: StarFacts) -> bool:
    key = _key(observables)
    if key in file:
        return False
    group = file.create_group(key)
    group["oifits"] = np.frombuffer(_to_bytes(observables), dtype=np.uint8)
    for field in fields(star):
        group.attrs[field.name] = getattr(star, field.name)
    return True


def read_library(path: str | Path) -> Library:
    """Read a library; it is kept in memory as long as the file stays as it is.

    Raises
    ------
    DataError
        Where it cannot be read.
    """
    path = Path(path)
    try:
        state = path.stat()
    except OSError as error:
        raise DataError(f"cannot be read: {error.strerror}", source=path) from error
    return _read(path.resolve(), state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4)
def _read(path: Path, _mtime_ns: int, _size: int) -> Library:
    with _opened(path) as file:
        stars = [(_facts(group), group["oifits"][:].tobytes()) for group in file.values()]
    stars.sort(key=lambda star: (star[0].mjd, star[0].name))
    observables = tuple(_of_bytes(content, f"{path.name}: {star.name}") for star, content in stars)
    return Library(path, tuple(star for star, _ in stars), observables)


def _opened(path: Path) -> h5py.File:
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise DataError("is no library of calibrators", source=path) from error
    if file.attrs.get("format") != FORMAT:
        file.close()
        raise DataError("is no library of calibrators", source=path)
    return file


def _facts(group: h5py.Group) -> StarFacts:
    values = {f.name: group.attrs[f.name] for f in fields(StarFacts)}
    plain: dict[str, Any] = {k: v if isinstance(v, str) else float(v) for k, v in values.items()}
    return StarFacts(**plain)


def _setup(observables: Observables) -> str:
    """Instrument and channels, by which a library is one."""
    if not observables.setups:
        raise UsageError("a calibrator has no setup")
    found = {
        f"{s.insname.split('_')[0]} at "
        + ", ".join(f"{1e6 * w:.3f}" for w in s.wavelength_m)
        + " µm"
        for s in observables.setups
    }
    return "; ".join(sorted(found))


def _key(observables: Observables) -> str:
    return hashlib.sha256(np.ascontiguousarray(observables.data).tobytes()).hexdigest()[:20]


def _to_bytes(observables: Observables) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "star.oifits"
        write_oifits(path, observables)
        return path.read_bytes()


def _of_bytes(content: bytes, source: str) -> Observables:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "star.oifits"
        path.write_bytes(content)
        found = read_oifits(path)
    return replace(found, setups=tuple(replace(s, source=source) for s in found.setups))
