"""Apply the remedies that are certain, and change nothing else in the file."""

from __future__ import annotations

import gzip
import io
import re
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes.oifits.audit.finding import Finding, unit_in_use
from amibayes.oifits.audit.packages import amplitude_ratio
from amibayes.oifits.audit.structure import ANGLES, standard_unit
from amibayes.oifits.audit.values import value_and_error
from amibayes.oifits.columns import coordinates
from amibayes.oifits.dates import first_date
from amibayes.oifits.products import product_of, write_repaired
from amibayes.oifits.row_stations import stations_of_rows
from amibayes.oifits.rows import KINDS, channel_count, times_of, unusable
from amibayes.oifits.scales import ANGLE
from amibayes.oifits.setups import channels_of, wavelength_table
from amibayes.oifits.standard import PRIMARY_KEYWORDS, TABLES
from amibayes.oifits.tables import OIFits, OITable, fits_bytes, plain
from amibayes.support.atomic_files import atomic_path
from amibayes.units import DEGREE

COLUMN_KEYWORD = re.compile(r"T(TYPE|FORM|UNIT|DIM|NULL|SCAL|ZERO|DISP|BCOL)\d+")

Remedy = Callable[[Any, OIFits, list[OITable]], None]
"""Changes tables that have a finding, in the open file (HDUs by number), in place."""


def repair(oifits: OIFits, findings: list[Finding], path: str | Path) -> list[Finding]:
    """Write a copy of a file in which every finding whose remedy is certain is fixed.

    Tables without such a finding are copied byte by byte; a copy called ``.gz`` is packed.

    Parameters
    ----------
    path : path
        Of the copy.

    Returns
    -------
    list of Finding
        Those that were fixed.
    """
    fixed = [f for f in findings if f.certain]
    product = product_of(oifits)
    if product is not None and fixed:
        write_repaired(product, path)
        return fixed
    raw = fits_bytes(Path(oifits.path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with fits.open(io.BytesIO(raw), memmap=False) as hdus:
            spans = [(hdu.fileinfo()["hdrLoc"], hdu.fileinfo()) for hdu in hdus]
            whole = [raw[start : info["datLoc"] + info["datSpan"]] for start, info in spans]
            touched = {0} if any(f.where == "primary header" for f in fixed) else set()
            for code in dict.fromkeys(f.code for f in fixed):
                where = {f.where for f in fixed if f.code == code}
                tables = [t for t in oifits.tables if t.label in where]
                touched |= {t.number for t in tables}
                REMEDIES[code](hdus, oifits, tables)
            touched |= set(range(len(whole), len(hdus)))
            parts = [_bytes(h) if i in touched else whole[i] for i, h in enumerate(hdus)]
    content = b"".join(parts)
    if Path(path).suffix == ".gz":
        content = gzip.compress(content, mtime=0)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return fixed


def _bytes(hdu: Any) -> bytes:
    """An HDU as it stands in a file."""
    stream = io.BytesIO()
    primary = isinstance(hdu, fits.PrimaryHDU)
    whole = fits.HDUList([hdu] if primary else [fits.PrimaryHDU(), hdu])
    whole.writeto(stream, output_verify="silentfix")
    return stream.getvalue()[0 if primary else 2880 :]


def _no_trailing_bytes(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    """Writing the tables again leaves what follows them behind."""


def _primary_keywords(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    header = hdus[0].header
    header["CONTENT"] = "OIFITS2"
    for name in PRIMARY_KEYWORDS:
        if not plain(header.get(name, "")):
            header[name] = _night(oifits) if name in ("DATE", "DATE-OBS") else "UNKNOWN"


def _night(oifits: OIFits) -> str:
    dates = [t.columns["MJD"] for t in oifits.tables if "MJD" in t.columns and len(t)]
    known = np.concatenate([np.ravel(d) for d in dates]) if dates else np.empty(0)
    return first_date(known[known != 0])


def _unit_spelling(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        rules = TABLES[table.name].columns_of(oifits.version) if table.name in TABLES else ()
        for rule in rules:
            if rule.unit and rule.name in table.units:
                unit = unit_in_use(table, rule.name)
                if not unit or standard_unit(unit) == rule.unit:
                    _column(hdus, table, rule.name).unit = rule.unit


def _angles_in_degrees(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        for name in ANGLES:
            scale = ANGLE.get(unit_in_use(table, name).lower(), DEGREE)
            if name in table.columns and scale != DEGREE:
                hdus[table.number].data[_column(hdus, table, name).name] *= scale / DEGREE
                _column(hdus, table, name).unit = "deg"


def _flag_unusable(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        kind = KINDS.get(table.name)
        pair = value_and_error(table, kind) if kind and len(table) else None
        if kind is None or pair is None or "FLAG" not in table.columns:
            continue
        value, error = pair
        with np.errstate(over="ignore", invalid="ignore"):
            bad = unusable(kind, value, np.where(error > 0, error**2, np.nan))
        flag = hdus[table.number].data[_column(hdus, table, "FLAG").name]
        flag |= bad.reshape(flag.shape)


def _vis2_errors(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        ratio = amplitude_ratio(oifits, table)
        if ratio is not None:
            n = round(float(np.median(ratio)) ** 2)
            hdus[table.number].data[_column(hdus, table, "VIS2ERR").name] *= np.sqrt(n)


def _null_flags(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        old = _column(hdus, table, "FLAG")
        values = np.array(hdus[table.number].data[old.name])  # NULL reads as false
        _put(hdus, table, "FLAG", old.format, values, "")


def _columns_known(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        n, width = len(table), channel_count(oifits, table)
        if "FLAG" not in table.columns:
            _add(hdus, table, "FLAG", f"{width}L", np.zeros((n, width), bool))
        targets = [t.columns["TARGET_ID"] for t in oifits.named("OI_TARGET")]
        if "TARGET_ID" not in table.columns and len(targets) == 1:
            _add(hdus, table, "TARGET_ID", "1I", np.full(n, targets[0][0]))


def _full_dates(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        _put(hdus, table, "MJD", "1D", times_of(table)[0], "day")


def _coordinates_in_metres(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    for table in tables:
        kind = KINDS[table.name]
        channels = wavelength_table(oifits, table, channel_count(oifits, table))
        names = (*kind.u, *kind.v)
        metres, _ = coordinates(oifits, table, names, channels_of(oifits, channels)[0])
        for i, name in enumerate(names):
            _put(hdus, table, name, "1D", metres[:, i], "m")


def _stations_by_uv(hdus: Any, oifits: OIFits, tables: list[OITable]) -> None:
    """Number the stations of V² and closure phases, and list them in an OI_ARRAY of their own."""
    every = [t for t in oifits.tables if t.name in KINDS and len(t)]
    position = {t.number: np.zeros((len(t), 1 + len(KINDS[t.name].u)), int) for t in every}
    count: dict[int, int] = {}
    for target in np.unique(np.concatenate([_targets(t) for t in every])):
        chosen = {t.number: np.flatnonzero(_targets(t) == target) for t in every}
        for number, found in stations_of_rows(oifits, every, chosen).items():
            position[number][chosen[number]] = found.position[chosen[number]] + 1
            count[number] = max(count.get(number, 0), len(found.stations.names))
    for table in tables:
        values = position[table.number]
        _put(hdus, table, "STA_INDEX", f"{values.shape[1]}I", values, "")
    for name in dict.fromkeys(t.keyword("ARRNAME") for t in tables):
        members = [t for t in tables if t.keyword("ARRNAME") == name]
        new = f"{name or 'ARRAY'}_UV"
        for table in members:
            hdus[table.number].header["ARRNAME"] = new
        hdus.append(_array(new, max(count[t.number] for t in members), oifits.version))


def _targets(table: OITable) -> NDArray[Any]:
    return np.ravel(table.columns.get("TARGET_ID", np.ones(len(table), int)))


def _array(name: str, n: int, version: int) -> Any:
    """An OI_ARRAY of stations of which nothing but their number is known."""
    values = {
        "TEL_NAME": [f"station {i}" for i in range(1, n + 1)],
        "STA_NAME": [f"station {i}" for i in range(1, n + 1)],
        "STA_INDEX": np.arange(1, n + 1),
        "FOVTYPE": ["FWHM"] * n,
    }
    columns = [
        fits.Column(
            rule.name,
            rule.tform(1),
            unit=rule.unit or None,
            array=values.get(rule.name, np.zeros((n, rule.repeat) if rule.repeat > 1 else n)),
        )
        for rule in TABLES["OI_ARRAY"].columns_of(version)
    ]
    table = fits.BinTableHDU.from_columns(columns, name="OI_ARRAY")
    table.header["OI_REVN"] = version
    table.header["ARRNAME"] = name
    table.header["FRAME"] = "SKY"
    for axis in "XYZ":
        table.header[f"ARRAY{axis}"] = 0.0
    return table


def _put(hdus: Any, table: OITable, name: str, form: str, values: Any, unit: str) -> None:
    """Write a column anew, whatever type it had."""
    columns = list(hdus[table.number].columns)
    names = [plain(c.name).upper() for c in columns]
    place = names.index(name) if name in names else len(names)
    columns[place : place + 1] = [fits.Column(name, form, unit=unit or None, array=values)]
    _replace(hdus, table, columns)


def _add(hdus: Any, table: OITable, name: str, form: str, values: Any) -> None:
    _replace(hdus, table, [*hdus[table.number].columns, fits.Column(name, form, array=values)])


def _replace(hdus: Any, table: OITable, columns: list[Any]) -> None:
    """A table with other columns and the keywords that it had."""
    old = hdus[table.number].header
    new = fits.BinTableHDU.from_columns(fits.ColDefs(columns))
    for card in old.cards:
        if card.keyword not in new.header and not COLUMN_KEYWORD.fullmatch(card.keyword):
            new.header.append(card)
    hdus[table.number] = new


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
    "flag-null": _null_flags,
    "column-missing": _columns_known,
    "date": _full_dates,
    "uv-in-wavelengths": _coordinates_in_metres,
    "stations": _stations_by_uv,
}
"""By code of the finding; `Finding.certain` is true only for these."""
