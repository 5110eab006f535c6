"""Apply the remedies that are certain, and change nothing else in the file."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.oifits.audit.finding import Finding
from amibayes.oifits.audit.packages import amplitude_ratio
from amibayes.oifits.audit.structure import standard_unit
from amibayes.oifits.audit.values import value_and_error
from amibayes.oifits.dates import first_date
from amibayes.oifits.rows import KINDS, unusable
from amibayes.oifits.scales import ANGLE
from amibayes.oifits.standard import PRIMARY_KEYWORDS, TABLES
from amibayes.oifits.tables import OIFits, OITable, plain
from amibayes.support.atomic_files import atomic_path
from amibayes.units import DEGREE

Remedy = Callable[[Any, OIFits], None]


def repair(oifits: OIFits, findings: list[Finding], path: str | Path) -> list[Finding]:
    """Write a copy of a file in which every finding whose remedy is certain is mended.

    Parameters
    ----------
    path : path
        Of the copy.

    Returns
    -------
    list of Finding
        Those that were mended.
    """
    mended = [f for f in findings if f.certain]
    raw = Path(oifits.path).read_bytes()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with fits.open(io.BytesIO(raw), memmap=False) as hdus:
            for code in dict.fromkeys(f.code for f in mended):
                REMEDIES[code](hdus, oifits)
            with atomic_path(path) as temporary:
                hdus.writeto(temporary, overwrite=True, output_verify="silentfix")
    return mended


def _no_trailing_bytes(hdus: Any, oifits: OIFits) -> None:
    """Writing the tables again leaves what follows them behind."""


def _primary_keywords(hdus: Any, oifits: OIFits) -> None:
    header = hdus[0].header
    header["CONTENT"] = "OIFITS2"
    for name in PRIMARY_KEYWORDS:
        if not plain(header.get(name, "")):
            header[name] = _night(oifits) if name in ("DATE", "DATE-OBS") else "UNKNOWN"


def _night(oifits: OIFits) -> str:
    dates = [t.columns["MJD"] for t in oifits.tables if "MJD" in t.columns and len(t)]
    known = np.concatenate([np.ravel(d) for d in dates]) if dates else np.empty(0)
    return first_date(known[known != 0])


def _unit_spelling(hdus: Any, oifits: OIFits) -> None:
    for table in oifits.tables:
        rules = TABLES[table.name].columns_of(oifits.version) if table.name in TABLES else ()
        for rule in rules:
            unit = table.units.get(rule.name)
            if rule.unit and unit is not None and (not unit or standard_unit(unit) == rule.unit):
                _column(hdus, table, rule.name).unit = rule.unit


def _angles_in_degrees(hdus: Any, oifits: OIFits) -> None:
    for table in oifits.tables:
        for name in ("T3PHI", "T3PHIERR", "VISPHI", "VISPHIERR"):
            scale = ANGLE.get(table.units.get(name, "").lower(), DEGREE)
            if scale != DEGREE:
                hdus[table.number].data[_column(hdus, table, name).name] *= scale / DEGREE
                _column(hdus, table, name).unit = "deg"


def _flag_unusable(hdus: Any, oifits: OIFits) -> None:
    for table in oifits.tables:
        kind = KINDS.get(table.name)
        pair = value_and_error(table, kind) if kind and len(table) else None
        if kind is None or pair is None or "FLAG" not in table.columns:
            continue
        value, error = pair
        with np.errstate(over="ignore", invalid="ignore"):
            bad = unusable(kind, value, np.where(error > 0, error**2, np.nan))
        flag = hdus[table.number].data[_column(hdus, table, "FLAG").name]
        flag |= bad.reshape(flag.shape)


def _vis2_errors(hdus: Any, oifits: OIFits) -> None:
    for table in oifits.named("OI_VIS2"):
        ratio = amplitude_ratio(oifits, table)
        if ratio is not None:
            n = round(float(np.median(ratio)) ** 2)
            hdus[table.number].data[_column(hdus, table, "VIS2ERR").name] *= np.sqrt(n)


def _column(hdus: Any, table: OITable, name: str) -> Any:
    """The column of a name in whatever case the file writes it."""
    columns = hdus[table.number].columns
    return next(c for c in columns if plain(c.name).upper() == name)


REMEDIES: dict[str, Remedy] = {
    "trailing-bytes": _no_trailing_bytes,
    "primary-keyword": _primary_keywords,
    "unit-spelling": _unit_spelling,
    "unit": _angles_in_degrees,
    "unusable-unflagged": _flag_unusable,
    "vis2-error-divided-twice": _vis2_errors,
}
"""By code of the finding; `Finding.certain` is true only for these."""
