"""Whether it is the standard: tables, keywords, columns, units, references.

Pauls et al. 2005 for version 1, Duvert et al. 2017 for version 2.
"""

from __future__ import annotations

import re
from collections import Counter

import numpy as np

from amibayes.oifits.audit.finding import (
    DATA_TABLES,
    Finding,
    Findings,
    column,
    listed,
    unit_in_use,
)
from amibayes.oifits.columns import same
from amibayes.oifits.rows import KINDS
from amibayes.oifits.scales import ANGLE
from amibayes.oifits.setups import centre_m
from amibayes.oifits.standard import PRIMARY_KEYWORDS, TABLES, ColumnRule
from amibayes.oifits.tables import OIFits, OITable, plain

NEEDED = {"TARGET_ID", "TARGET", "STA_INDEX", "EFF_WAVE", "MJD", "FLAG", "UCOORD", "VCOORD"}
NEEDED |= {"U1COORD", "V1COORD", "U2COORD", "V2COORD", "IINDX", "JINDX", "CORR"}
NEEDED |= {"VIS2DATA", "VIS2ERR", "T3PHI", "T3PHIERR", "VISAMP", "VISPHI"}
"""Columns without which numbers have no meaning; others are the standard's formalities."""

ANGLES = ("T3PHI", "T3PHIERR", "VISPHI", "VISPHIERR")

READERS = "programs that follow the standard may not read it, or read it wrongly"


def trailing_bytes(oifits: OIFits) -> Findings:
    """Bytes after the last table."""
    if oifits.trailing_bytes:
        yield Finding(
            "warning",
            "trailing-bytes",
            "file",
            f"{oifits.trailing_bytes} bytes follow the last table",
            "something was appended to the file, or a table was lost",
            "write the file again without them",
            certain=True,
        )


def missing_tables(oifits: OIFits) -> Findings:
    """Tables that every file has to have."""
    needed = ["OI_TARGET", "OI_WAVELENGTH", *(["OI_ARRAY"] if oifits.version == 2 else [])]
    absent = [name for name in needed if not oifits.named(name)]
    if not any(oifits.named(name) for name in DATA_TABLES):
        absent.append("a table of data")
    if absent:
        yield Finding(
            "error",
            "table-missing",
            "file",
            f"has no {listed(absent)}",
            READERS,
            "write the file again with the program that made it",
        )


def primary_keywords(oifits: OIFits) -> Findings:
    """Mandatory keywords of the primary header (version 2)."""
    if oifits.version == 1:
        return
    absent = [k for k in PRIMARY_KEYWORDS if not plain(oifits.header.get(k, ""))]
    if oifits.header.get("CONTENT", "OIFITS2") != "OIFITS2":
        absent.append("CONTENT")
    if absent:
        yield Finding(
            "warning",
            "primary-keyword",
            "primary header",
            f"version 2 wants {listed(absent, 9)}",
            READERS,
            "set them (UNKNOWN where nothing is known)",
            certain=True,
        )


def table_keywords(oifits: OIFits) -> Findings:
    """Mandatory keywords of each table, and its revision."""
    for table in oifits.tables:
        rule = TABLES.get(table.name)
        if rule is None or rule.since > oifits.version:
            continue
        names = rule.keywords_of(oifits.version)
        absent = [k for k in names if not table.keyword(k)]
        if absent:
            yield Finding(
                "error" if {"INSNAME", "CORRNAME"} & set(absent) else "warning",
                "table-keyword",
                table.label,
                f"lacks {listed(absent)}",
                READERS,
                "set them",
            )
        revision = table.header.get("OI_REVN")
        expected = rule.revision[oifits.version - 1]
        if revision is not None and revision != expected:
            yield Finding(
                "warning",
                "revision",
                table.label,
                f"OI_REVN is {revision}, version {oifits.version} has {expected}",
                "tables of different versions are mixed",
                "write all tables in one version",
            )


def columns(oifits: OIFits) -> Findings:
    """Mandatory columns, their formats and units."""
    for table in oifits.tables:
        rule = TABLES.get(table.name)
        if rule is None or rule.since > oifits.version or not len(table):
            continue
        rules = rule.columns_of(oifits.version)
        absent = [r.name for r in rules if not r.optional and r.name not in table.columns]
        certain = [name for name in absent if _is_known(oifits, table, name)]
        for names in (certain, [name for name in absent if name not in certain]):
            if names:
                yield Finding(
                    "error" if NEEDED & set(names) else "warning",
                    "column-missing",
                    table.label,
                    f"has no column {listed(names)}",
                    READERS,
                    "add what it can only hold"
                    if names is certain
                    else "write the file again with the program that made it",
                    certain=names is certain,
                )
        present = [r for r in rules if r.name in table.columns]
        yield from _formats(oifits, table, present)
        yield from _units(table, present)


def _is_known(oifits: OIFits, table: OITable, name: str) -> bool:
    """Whether there is one thing that a column of V² or closure phases can hold."""
    if table.name not in KINDS:
        return False
    targets = [column(t, "TARGET_ID") for t in oifits.named("OI_TARGET")]
    single = len(targets) == 1 and targets[0] is not None and targets[0].size == 1
    return name == "FLAG" or (name == "TARGET_ID" and single)


def _formats(oifits: OIFits, table: OITable, rules: list[ColumnRule]) -> Findings:
    forms = {plain(v).upper(): k for k, v in table.header.items() if k.startswith("TTYPE")}
    wrong = []
    for rule in rules:
        form = plain(table.header.get(f"TFORM{forms[rule.name][5:]}", ""))
        wanted = rule.repeat or _channels(oifits, table)
        parts = re.fullmatch(r"(\d*)([A-Z])", form)  # others are arrays of any length, or damage
        repeat, letter = (int(parts[1] or 1), parts[2]) if parts else (0, form)
        if letter != rule.letter or (letter != "A" and wanted is not None and repeat != wanted):
            wrong.append(f"{rule.name} {form} (for {wanted or 'W'}{rule.letter})")
    if wrong:
        yield Finding(
            "warning",
            "column-format",
            table.label,
            f"columns of another format: {listed(wrong)}",
            READERS,
            "write them in the format of the standard",
        )


def _channels(oifits: OIFits, table: OITable) -> int | None:
    """Number of channels that a table's OI_WAVELENGTH has."""
    name = table.keyword("INSNAME")
    found = {len(w) for w in oifits.named("OI_WAVELENGTH") if same(w.keyword("INSNAME"), name)}
    return found.pop() if len(found) == 1 else None


def standard_unit(unit: str) -> str:
    """A unit in small letters and the standard's spelling."""
    spelling = {"d": "day", "days": "day", "year": "yr", "years": "yr", "sec": "s", "seconds": "s"}
    spelling |= {"second": "s", "degrees": "deg", "degree": "deg", "meters": "m", "meter": "m"}
    return "/".join(spelling.get(part.strip(), part.strip()) for part in unit.lower().split("/"))


def _units(table: OITable, rules: list[ColumnRule]) -> Findings:
    """Units that are absent, spelled in another way, or other units."""
    spelled: list[str] = []
    other: list[str] = []
    angles: list[str] = []
    for rule in rules:
        unit = unit_in_use(table, rule.name)
        if (
            not rule.unit
            or table.units[rule.name] == rule.unit
            or (rule.unit, unit) == ("day", "d")
        ):
            continue
        text = f"{rule.name} {unit or 'none'} (for {rule.unit})"
        if not unit or standard_unit(unit) == rule.unit:
            spelled.append(text)
        elif rule.name in ANGLES and unit.lower() in ANGLE:
            angles.append(text)
        else:
            other.append(text)
    if spelled:
        yield Finding(
            "warning",
            "unit-spelling",
            table.label,
            f"units absent or spelled otherwise: {listed(spelled)}",
            "a program that compares the text does not know them",
            "write them as the standard does",
            certain=True,
        )
    for found, certain in ((angles, True), (other, False)):
        if found:
            yield Finding(
                "error",
                "unit",
                table.label,
                f"other units than the standard's: {listed(found)}",
                "most programs do not look at the unit and read the numbers wrongly",
                "convert the numbers",
                certain=certain,
            )


def null_flags(oifits: OIFits) -> Findings:
    """Bytes of FLAG that are neither T nor F."""
    for table in oifits.tables:
        if table.n_null:
            yield Finding(
                "warning",
                "flag-null",
                table.label,
                f"{table.n_null} value(s) of FLAG are NULL, neither T nor F",
                "some programs take them for flags, others for none",
                "write F (they are taken for no flags here)",
                certain=True,
            )


def references(oifits: OIFits) -> Findings:
    """INSNAME, ARRNAME, CORRNAME, TARGET_ID and STA_INDEX that lead nowhere."""
    for table in oifits.tables:
        if table.name not in DATA_TABLES:
            continue
        lost = []
        for keyword, home in (
            ("INSNAME", "OI_WAVELENGTH"),
            ("ARRNAME", "OI_ARRAY"),
            ("CORRNAME", "OI_CORR"),
        ):
            name = table.keyword(keyword)
            known = [t.keyword(keyword) for t in oifits.named(home)]
            if name and not any(same(name, k) for k in known):
                lost.append(f"{keyword} {name!r}")
        lost += _lost_numbers(oifits, table)
        if lost:
            yield Finding(
                "error",
                "reference",
                table.label,
                f"refers to {listed(lost)}, which the file does not have",
                "the data cannot be tied to their target, stations or wavelengths",
                "write the file again with the tables it refers to",
            )


def _lost_numbers(oifits: OIFits, table: OITable) -> list[str]:
    lost = []
    targets = [column(t, "TARGET_ID") for t in oifits.named("OI_TARGET")]
    used = column(table, "TARGET_ID")
    if used is not None and targets and all(t is not None for t in targets):
        known = np.concatenate([t for t in targets if t is not None])
        lost += [f"TARGET_ID {i:.0f}" for i in np.unique(used[~np.isin(used, known)])]
    arrays = [
        a for a in oifits.named("OI_ARRAY") if same(a.keyword("ARRNAME"), table.keyword("ARRNAME"))
    ]
    stations, used = (
        (column(arrays[0], "STA_INDEX") if arrays else None),
        column(table, "STA_INDEX"),
    )
    if stations is not None and used is not None:
        lost += [f"station {i:.0f}" for i in np.unique(used[~np.isin(used, stations)])]
    return lost


def repeated_names(oifits: OIFits) -> Findings:
    """Names and numbers that have to be unique."""
    repeated = []
    for keyword, home in (
        ("INSNAME", "OI_WAVELENGTH"),
        ("ARRNAME", "OI_ARRAY"),
        ("CORRNAME", "OI_CORR"),
    ):
        names = Counter(t.keyword(keyword).casefold() for t in oifits.named(home))
        repeated += [f"{keyword} {name!r}" for name, n in names.items() if n > 1]
    for name, key in (("OI_TARGET", "TARGET_ID"), ("OI_ARRAY", "STA_INDEX")):
        for table in oifits.named(name):
            values = column(table, key)
            if values is not None and len(np.unique(values)) < values.size:
                repeated.append(f"{key} in {table.label}")
    if repeated:
        yield Finding(
            "error",
            "repeated",
            "file",
            f"not unique: {listed(repeated)}",
            "what refers to them is ambiguous",
            "give each its own name or number",
        )


def numbers_below_one(oifits: OIFits) -> Findings:
    """TARGET_ID and STA_INDEX start at 1."""
    low = []
    for name, key in (("OI_TARGET", "TARGET_ID"), ("OI_ARRAY", "STA_INDEX")):
        for table in oifits.named(name):
            values = column(table, key)
            if values is not None and values.min() < 1:
                low.append(f"{key} {values.min():.0f} in {table.label}")
    if low:
        yield Finding(
            "warning",
            "number-below-one",
            "file",
            f"numbers below 1: {listed(low)}",
            "the standard counts from 1, and some programs take 0 for absent",
            "number from 1",
        )


def array_centre(oifits: OIFits) -> Findings:
    """A geocentric array whose centre is not on the Earth."""
    for table in oifits.named("OI_ARRAY"):
        centre = np.linalg.norm(centre_m(table))
        if table.keyword("FRAME") == "GEOCENTRIC" and not 6.3e6 < centre < 6.5e6:
            yield Finding(
                "warning",
                "array-centre",
                table.label,
                f"FRAME is GEOCENTRIC and the centre is {centre / 1e3:.0f} km from "
                "that of the Earth",
                "what needs the place of the observatory (hour angles, altitudes) is wrong",
                "set ARRAYX, ARRAYY, ARRAYZ",
            )


CHECKS = (
    array_centre,
    trailing_bytes,
    missing_tables,
    primary_keywords,
    table_keywords,
    columns,
    null_flags,
    references,
    repeated_names,
    numbers_below_one,
)
