"""The tables of OIFITS 1 and 2 as published: Pauls et al. 2005, Duvert et al. 2017.

Formats are FITS letters; a repeat of `CHANNELS` stands for the number of spectral channels.
"""

from __future__ import annotations

from dataclasses import dataclass

CHANNELS = 0


@dataclass(frozen=True)
class ColumnRule:
    """One column: FITS letter, repeat, unit, whether it may be absent, first version."""

    name: str
    letter: str
    repeat: int = 1
    unit: str = ""
    optional: bool = False
    since: int = 1

    def tform(self, n_channels: int) -> str:
        """TFORM of the column."""
        return f"{self.repeat or n_channels}{self.letter}"


@dataclass(frozen=True)
class TableRule:
    """One table: the revision it has in each version, its keywords and columns.

    ``keywords`` are mandatory; ``later_keywords`` are so from version 2 on; ``since`` is the
    first version that has the table.
    """

    revision: tuple[int, int]
    keywords: tuple[str, ...]
    columns: tuple[ColumnRule, ...]
    later_keywords: tuple[str, ...] = ()
    since: int = 1

    def keywords_of(self, version: int) -> tuple[str, ...]:
        """Mandatory keywords in a version."""
        return self.keywords + (self.later_keywords if version == 2 else ())

    def columns_of(self, version: int) -> tuple[ColumnRule, ...]:
        """Columns that a version knows."""
        return tuple(column for column in self.columns if column.since <= version)


PRIMARY_KEYWORDS = (
    "ORIGIN",
    "DATE",
    "DATE-OBS",
    "CONTENT",
    "TELESCOP",
    "INSTRUME",
    "OBSERVER",
    "OBJECT",
    "INSMODE",
)
"""Mandatory in the primary header from version 2 on."""


def _columns(text: str) -> tuple[ColumnRule, ...]:
    """Columns from lines of name, format, unit (``-`` for none) and remarks.

    A remark ``?`` marks an optional column, ``2`` one that version 2 introduced.
    """
    rules = []
    for line in text.strip().splitlines():
        name, form, unit, *remarks = line.split()
        repeat = CHANNELS if form[:-1] == "W" else int(form[:-1])
        rules.append(
            ColumnRule(
                name,
                form[-1],
                repeat,
                "" if unit == "-" else unit,
                "?" in remarks,
                2 if "2" in remarks else 1,
            )
        )
    return tuple(rules)


_TARGET = """
TARGET_ID 1I -
TARGET 16A -
RAEP0 1D deg
DECEP0 1D deg
EQUINOX 1E yr
RA_ERR 1D deg
DEC_ERR 1D deg
SYSVEL 1D m/s
VELTYP 8A -
VELDEF 8A -
PMRA 1D deg/yr
PMDEC 1D deg/yr
PMRA_ERR 1D deg/yr
PMDEC_ERR 1D deg/yr
PARALLAX 1E deg
PARA_ERR 1E deg
SPECTYP 16A -
CATEGORY 3A - ? 2
"""
_ARRAY = """
TEL_NAME 16A -
STA_NAME 16A -
STA_INDEX 1I -
DIAMETER 1E m
STAXYZ 3D m
FOV 1D arcsec 2
FOVTYPE 6A - 2
"""
_WAVELENGTH = """
EFF_WAVE 1E m
EFF_BAND 1E m
"""
_VIS = """
TARGET_ID 1I -
TIME 1D s
MJD 1D day
INT_TIME 1D s
VISAMP WD -
VISAMPERR WD -
CORRINDX_VISAMP 1J - ? 2
VISPHI WD deg
VISPHIERR WD deg
CORRINDX_VISPHI 1J - ? 2
UCOORD 1D m
VCOORD 1D m
STA_INDEX 2I -
FLAG WL -
"""
_VIS2 = """
TARGET_ID 1I -
TIME 1D s
MJD 1D day
INT_TIME 1D s
VIS2DATA WD -
VIS2ERR WD -
CORRINDX_VIS2DATA 1J - ? 2
UCOORD 1D m
VCOORD 1D m
STA_INDEX 2I -
FLAG WL -
"""
_T3 = """
TARGET_ID 1I -
TIME 1D s
MJD 1D day
INT_TIME 1D s
T3AMP WD -
T3AMPERR WD -
CORRINDX_T3AMP 1J - ? 2
T3PHI WD deg
T3PHIERR WD deg
CORRINDX_T3PHI 1J - ? 2
U1COORD 1D m
V1COORD 1D m
U2COORD 1D m
V2COORD 1D m
STA_INDEX 3I -
FLAG WL -
"""
_FLUX = """
TARGET_ID 1I -
MJD 1D day
INT_TIME 1D s
FLUXDATA WD -
FLUXERR WD -
CORRINDX_FLUXDATA 1J - ?
STA_INDEX 1I - ?
FLAG WL -
"""
_CORR = """
IINDX 1J -
JINDX 1J -
CORR 1D -
"""

TABLES = {
    "OI_TARGET": TableRule((1, 2), ("OI_REVN",), _columns(_TARGET)),
    "OI_ARRAY": TableRule(
        (1, 2),
        ("OI_REVN", "ARRNAME", "FRAME", "ARRAYX", "ARRAYY", "ARRAYZ"),
        _columns(_ARRAY),
    ),
    "OI_WAVELENGTH": TableRule((1, 2), ("OI_REVN", "INSNAME"), _columns(_WAVELENGTH)),
    "OI_VIS": TableRule((1, 2), ("OI_REVN", "DATE-OBS", "INSNAME"), _columns(_VIS), ("ARRNAME",)),
    "OI_VIS2": TableRule((1, 2), ("OI_REVN", "DATE-OBS", "INSNAME"), _columns(_VIS2), ("ARRNAME",)),
    "OI_T3": TableRule((1, 2), ("OI_REVN", "DATE-OBS", "INSNAME"), _columns(_T3), ("ARRNAME",)),
    "OI_FLUX": TableRule(
        (1, 1), ("OI_REVN", "DATE-OBS", "INSNAME", "CALSTAT"), _columns(_FLUX), since=2
    ),
    "OI_CORR": TableRule((1, 1), ("OI_REVN", "CORRNAME", "NDATA"), _columns(_CORR), since=2),
}
