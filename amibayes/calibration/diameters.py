"""Diameters of calibrators as a user gives them, and calibrators freed of their discs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from amibayes.calibration.transfer import Diameter
from amibayes.data.observables import Observables
from amibayes.data.shared_errors import SharedErrors
from amibayes.data.tables import BYTE_ORDER_MARK
from amibayes.errors import DataError, UsageError
from amibayes.scene.disc import uniform_disc
from amibayes.units import FloatArray

OPTION = "--calibrator-diameters"


def diameters_of(
    given: str | Path | None, calibrators: Sequence[Observables]
) -> list[Diameter] | None:
    """Uniform-disc diameter and error (mas) of each calibrator.

    Parameters
    ----------
    given : str or path, optional
        ``0.31:0.02,0.4`` in the order of the calibrators; or a table (ECSV, CSV, FITS) with
        columns name, diameter_mas and, if known, error_mas, whose name is that of the file or
        of its target; or one of the JSDC, of which the band of the data is taken.

    Raises
    ------
    UsageError, DataError
        Where it is neither, or does not have every calibrator.
    """
    if given is None:
        return None
    if Path(given).is_file():
        return _from_table(str(given), calibrators)
    try:
        found = [_pair(*(float(x) for x in word.split(":"))) for word in str(given).split(",")]
    except (TypeError, ValueError):
        raise UsageError(
            f"{given!r} is neither a table nor a list of diameters",
            source=OPTION,
            remedy="give mas, as 0.31:0.02,0.4",
        ) from None
    if len(found) != len(calibrators):
        raise UsageError(
            f"{len(found)} diameters for {len(calibrators)} calibrators",
            source=OPTION,
            remedy="give one for each, in the order of --cal",
        )
    return [_usable(*pair, OPTION) for pair in found]


def _pair(diameter: float, error: float = 0.0) -> Diameter:
    return diameter, error


def _from_table(path: str, calibrators: Sequence[Observables]) -> list[Diameter]:
    from astropy.table import Table

    try:
        table = Table.read(path)
        columns = {column.lstrip(BYTE_ORDER_MARK).casefold(): column for column in table.colnames}
        names = [_plain_name(str(name)) for name in table[columns["name"]]]
        sizes = {key: _in_mas(table[columns[key]]) for key in columns if _is_size(key)}
        own = "diameter_mas" in sizes
        if not own and not any(key.startswith("udd") for key in sizes):
            raise KeyError("diameter_mas")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "is no table of diameters",
            source=path,
            remedy="give columns name, diameter_mas and, if known, error_mas, or those of the JSDC",
        ) from error
    out = []
    for calibrator in calibrators:
        file = Path(calibrator.source)
        known = {file.name, file.stem, str(file), calibrator.setups[0].target}
        rows = [i for i, name in enumerate(names) if name in {_plain_name(k) for k in known}]
        if not rows:
            raise DataError(
                f"has no line for {calibrator.source} ({calibrator.setups[0].target})",
                source=path,
                remedy="name the file or its target",
            )
        size = "diameter_mas" if own else _band_of(calibrator, sizes)
        sigma = sizes.get("error_mas" if own else "e_ldd", np.zeros(len(names)))
        found = {(float(sizes[size][i]), float(np.nan_to_num(sigma[i]))) for i in rows}
        if len(found) > 1:
            raise DataError(
                f"has several diameters of {calibrator.source} ({calibrator.setups[0].target})",
                source=path,
                remedy="leave one line for each",
            )
        out.append(_usable(*found.pop(), path))
    return out


def _in_mas(column: Any) -> FloatArray:
    """Angles (n,) of a column, mas whatever its unit; NaN where there is none."""
    values: FloatArray = np.asarray(np.ma.filled(np.ma.asarray(column, dtype=float), np.nan))
    return values if column.unit is None else values * float(column.unit.to("mas"))


def _usable(diameter: float, error: float, source: str) -> Diameter:
    if not (np.isfinite(diameter) and np.isfinite(error) and min(diameter, error) >= 0.0):
        raise DataError(
            f"has a diameter of {diameter:g} mas with an error of {error:g} mas",
            source=source,
            remedy="give numbers of zero or more",
        )
    return diameter, error


JSDC_BANDS_UM = {
    "uddb": 0.44, "uddv": 0.55, "uddr": 0.66, "uddi": 0.8, "uddj": 1.25, "uddh": 1.65,
    "uddk": 2.2, "uddl": 3.5, "uddm": 4.8, "uddn": 10.0,
}  # fmt: skip
"""Columns of the JMMC Stellar Diameters Catalogue (Bourges et al. 2017, VizieR II/346) with
uniform-disc diameters in mas, and the wavelengths of their bands."""


def _is_size(key: str) -> bool:
    return key in ("diameter_mas", "error_mas", "e_ldd", *JSDC_BANDS_UM)


def _plain_name(name: str) -> str:
    """A name as catalogues and headers both have it: HD_12345 is HD 12345."""
    return name.strip().casefold().replace(" ", "").replace("_", "")


def _band_of(calibrator: Observables, sizes: Mapping[str, FloatArray]) -> str:
    """Column of the band nearest to a calibrator's wavelengths."""
    wavelength = 1e6 * float(np.median(np.concatenate([s.wavelength_m for s in calibrator.setups])))
    known = {key: um for key, um in JSDC_BANDS_UM.items() if key in sizes}
    return min(known, key=lambda key: abs(np.log(known[key] / wavelength)))


def without_disc(
    calibrator: Observables, diameter_mas: float, error_mas: float = 0.0
) -> Observables:
    """The squared visibilities of a calibrator over those of its disc: a point remains.

    Parameters
    ----------
    diameter_mas : float
        Uniform disc.
    error_mas : float
        Of the diameter, which makes all V² err together.
    """
    if diameter_mas == 0.0:
        return calibrator
    m = calibrator.vis2
    amplitude, slope = uniform_disc(m.frequency, diameter_mas)
    factor = 1.0 / amplitude**2
    every = np.concatenate([factor[~m.flag], np.ones(calibrator.n_closure_phases)])
    scatter = calibrator.scatter
    point = replace(
        calibrator,
        vis2=replace(m, value=np.where(m.flag, m.value, m.value * factor)),
        covariance=calibrator.covariance.scaled(every),
        scatter=None if scatter is None else (scatter * every[:, None] * every[None]).tocsr(),
        shared=None if calibrator.shared is None else calibrator.shared.scaled(every),
    )
    return _with_error(point, -2.0 * error_mas * (slope / amplitude)[~m.flag])


def _with_error(point: Observables, relative: FloatArray) -> Observables:
    """Data whose V² err together by these parts (n_vis2,) of them."""
    if not relative.any():
        return point
    changes = np.zeros((len(point.data), 1))
    changes[: point.n_vis2, 0] = relative * point.data[: point.n_vis2]
    return point.with_shared_errors(SharedErrors((f"diameter of {point.source}",), changes))
