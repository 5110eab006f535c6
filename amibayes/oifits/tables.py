"""An OIFITS file as it is: every table kept, named and unchanged."""

from __future__ import annotations

import gzip
import io
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from amibayes.errors import DataError
from amibayes.support.arguments import checks_arguments
from amibayes.support.fits_errors import reporting_damage
from amibayes.support.notebook import Shown

USED = ("OI_TARGET", "OI_ARRAY", "OI_WAVELENGTH", "OI_VIS2", "OI_T3", "OI_CORR", "V2COV", "CPCOV")
"""Extensions that `observables_of` reads."""

OWN_KEY = "AMIBAYES"
"""First word of the hierarchical keywords that hold what OIFITS has no place for."""


@dataclass(frozen=True, eq=False)
class OITable:
    """One extension of an OIFITS file.

    Parameters
    ----------
    name : str
        EXTNAME in capitals.
    extver : int
    number : int
        Place in the file; the primary HDU is 0.
    header : astropy.io.fits.Header
    columns : mapping of str to array
        By column name in capitals; shapes and types of the file, read-only, native byte
        order, strings with their padding. Empty for an image.
    units : mapping of str to str
        TUNIT of each column, empty where there is none.
    image : array, optional
        Of an image extension.
    n_null : int
        Bytes of FLAG that are NULL, neither T nor F.
    """

    name: str
    extver: int
    number: int
    header: fits.Header
    columns: Mapping[str, NDArray[Any]]
    units: Mapping[str, str] = field(default_factory=dict)
    image: NDArray[Any] | None = None
    n_null: int = 0

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))) if self.columns else 0

    @property
    def label(self) -> str:
        """Name, version and place, as an error message gives them."""
        return f"{self.name} (extension {self.number})"

    def keyword(self, name: str) -> str:
        """Text of a header keyword without padding; empty where it is absent."""
        return plain(self.header.get(name, ""))


@dataclass(frozen=True, eq=False, repr=False)
class OIFits(Shown):
    """A whole OIFITS file.

    Parameters
    ----------
    path : str
    header : astropy.io.fits.Header
        Of the primary HDU.
    tables : tuple of OITable
        Every extension, in file order.
    trailing_bytes : int
        Bytes after the last complete HDU (0 in a correct file).
    """

    path: str
    header: fits.Header
    tables: tuple[OITable, ...]
    trailing_bytes: int = 0

    def named(self, name: str) -> tuple[OITable, ...]:
        """The extensions of that name, in file order."""
        return tuple(table for table in self.tables if table.name == name)

    @property
    def unused(self) -> tuple[OITable, ...]:
        """The extensions that `observables_of` does not read."""
        return tuple(table for table in self.tables if table.name not in USED)

    @property
    def version(self) -> int:
        """1 or 2, by OI_REVN of the data tables and CONTENT."""
        revisions = [t.header.get("OI_REVN", 1) for t in self.tables if t.name in USED[:5]]
        return 2 if self.header.get("CONTENT") == "OIFITS2" or 2 in revisions else 1

    def __repr__(self) -> str:
        names = ", ".join(f"{t.name} {t.extver}" for t in self.tables)
        return f"<OIFits {self.path}, version {self.version}: {names}>"


def plain(value: object) -> str:
    """Text without the blanks and NULs that pad it."""
    return str(value).strip(" \0\t\n")


@checks_arguments
def open_oifits(path: str | Path) -> OIFits:
    """Read every table of an OIFITS file, version 1 or 2, plain or gzipped.

    Parameters
    ----------
    path : str or path

    Returns
    -------
    OIFits

    Raises
    ------
    DataError
        Where the file is missing, empty, cut short, no FITS file or holds no OIFITS table.
    """
    raw = fits_bytes(Path(path))
    with reporting_damage(path):
        content = _content(str(path), raw)
    if not any(table.name.startswith("OI_") for table in content.tables):
        raise DataError(
            "holds no OIFITS table", source=path, remedy="give an OIFITS file, not an image"
        )
    return content


def fits_bytes(path: Path) -> bytes:
    """The bytes of a FITS file, unpacked where it is gzipped.

    Raises
    ------
    DataError
        Where there are none, or they are of no FITS file.
    """
    if path.is_dir():
        raise DataError("is a folder", source=path, remedy="give the OIFITS file in it")
    try:
        raw = path.read_bytes()
        if raw[:2] == b"\x1f\x8b":
            raw = gzip.decompress(raw)
    except FileNotFoundError as error:
        raise DataError("does not exist", source=path, remedy="check the path") from error
    except (OSError, EOFError, zlib.error) as error:
        reason = getattr(error, "strerror", None) or "its compression is damaged"
        raise DataError(
            f"cannot be read: {reason}", source=path, remedy="check the file and its permissions"
        ) from error
    if not raw:
        raise DataError("is empty", source=path, remedy="copy or download it again")
    if not raw.startswith(b"SIMPLE  ="):
        raise DataError("is not a FITS file", source=path, remedy="give an OIFITS file")
    return raw


def _content(path: str, raw: bytes) -> OIFits:
    """Open what was read; a header or a table that goes past the end of the file is refused."""
    cut = DataError("is cut short", source=path, remedy="copy or download it again")
    try:
        hdus = fits.open(io.BytesIO(raw), memmap=False, character_as_bytes=True)
        len(hdus)
    except OSError as error:
        raise cut from error
    with hdus:
        if not hasattr(hdus[-1], "fileinfo"):  # the stand-in for a header that cannot be read
            raise DataError(
                f"is damaged: extension {len(hdus) - 1} has no readable header",
                source=path,
                remedy="copy or download it again",
            )
        info = hdus[-1].fileinfo()
        end = info["datLoc"] + info["datSpan"]
        rest = raw[end : end + 9]
        if end > len(raw) or (rest and b"XTENSION=".startswith(rest)):
            raise cut
        tables = tuple(_table(hdu, number) for number, hdu in enumerate(hdus[1:], 1))
        return OIFits(path, _parsed(hdus[0].header), tables, len(raw) - end)


def _parsed(header: fits.Header) -> fits.Header:
    """A copy of which every card was read: astropy would find a damaged one only when asked."""
    copy = header.copy()
    for card in copy.cards:
        _ = card.value
    return copy


def _table(hdu: Any, number: int) -> OITable:
    name = plain(hdu.header.get("EXTNAME", "")).upper()
    extver = int(hdu.header.get("EXTVER", 1))
    if isinstance(hdu, fits.BinTableHDU | fits.TableHDU):
        columns: dict[str, NDArray[Any]] = {}
        units: dict[str, str] = {}
        n_null = 0
        for i, column in enumerate(hdu.columns):
            key = plain(column.name).upper()
            if key not in columns:
                columns[key] = _native(hdu.data.field(i))
                units[key] = plain(column.unit or "")
                if key == "FLAG" and column.format.endswith("L"):
                    # What astropy gives has lost the difference of NULL and F.
                    n_null = int((np.asarray(hdu.data.view(np.ndarray)[column.name]) == 0).sum())
        return OITable(
            name,
            extver,
            number,
            _parsed(hdu.header),
            MappingProxyType(columns),
            MappingProxyType(units),
            n_null=n_null,
        )
    # An HDU of a kind that is no standard one has no data that could be read.
    content = getattr(hdu, "data", None)
    image = None if content is None else _native(content)
    return OITable(name, extver, number, _parsed(hdu.header), MappingProxyType({}), {}, image)


def _native(values: Any) -> NDArray[Any]:
    """A read-only copy in the machine's byte order; bytes become text.

    Arrays of variable length become one where every row has the same number of values.
    """
    rows = values if getattr(values, "dtype", np.dtype(float)).hasobject else ()
    if len({np.shape(row) for row in rows}) == 1:
        values = np.stack(list(rows))
    array = np.array(values)
    if array.dtype.kind == "S":
        array = np.char.decode(array, "latin-1")
    if array.dtype.kind != "O":
        array = array.astype(array.dtype.newbyteorder("="))
    array.flags.writeable = False
    return array
