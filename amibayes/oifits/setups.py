"""Targets, stations and channels of a file: what a row of data refers to by number or name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.data.setup import Setup
from amibayes.errors import DataError
from amibayes.oifits.columns import column, integers, numbers, rest_of, same
from amibayes.oifits.scales import ANGLE, LENGTH, scale_of
from amibayes.oifits.tables import OWN_KEY, OIFits, OITable, plain
from amibayes.units import DEGREE, FloatArray, IntArray

DATA_TABLES = ("OI_VIS2", "OI_T3")


@dataclass(frozen=True, eq=False)
class Target:
    """A line of OI_TARGET."""

    name: str
    right_ascension_deg: float = 0.0
    declination_deg: float = 0.0


@dataclass(frozen=True, eq=False)
class Stations:
    """A table OI_ARRAY, and the stations that only the data tables know."""

    names: tuple[str, ...]
    index: IntArray
    xyz_m: FloatArray | None
    diameter_m: FloatArray | None

    def position(self, index: IntArray) -> IntArray:
        """Places in ``names`` of stations given by STA_INDEX."""
        order = np.argsort(self.index, kind="stable")
        return np.asarray(order[np.searchsorted(self.index[order], index)])


def targets_of(oifits: OIFits) -> dict[int, Target]:
    """Targets by TARGET_ID; a file without OI_TARGET has none."""
    found: dict[int, Target] = {}
    for table in oifits.named("OI_TARGET"):
        ids = integers(oifits, table, "TARGET_ID", 1)[:, 0]
        names = [plain(name) for name in column(oifits, table, "TARGET")]
        ra, dec = (_degrees(table, name) for name in ("RAEP0", "DECEP0"))
        for i, (number, name) in enumerate(zip(ids, names, strict=True)):
            found.setdefault(int(number), Target(name or f"target {number}", ra[i], dec[i]))
    return found


def names_of_targets(oifits: OIFits) -> list[str]:
    """Names of the targets that have V² or closure phases, as `observables_of` knows them."""
    known = targets_of(oifits) if oifits.named("OI_TARGET") else {}
    names = []
    for table in oifits.tables:
        if table.name in DATA_TABLES and len(table):
            try:
                ids = integers(oifits, table, "TARGET_ID", 1)[:, 0]
            except DataError:
                continue
            names += [
                known[i].name if i in known else f"target {i}" for i in np.unique(ids).tolist()
            ]
    return list(dict.fromkeys(names))


def _degrees(table: OITable, name: str) -> list[float]:
    values = table.columns.get(name)
    if values is None or values.dtype.kind not in "fiu" or values.ndim != 1:
        return [0.0] * len(table)
    scale, _ = scale_of(table.units[name], ANGLE, "deg")
    # Degrees are the standard's unit: they pass unchanged, bit for bit.
    degrees = values.astype(float) * (1.0 if scale == DEGREE else scale / DEGREE)
    return [float(x) if np.isfinite(x) else 0.0 for x in degrees]


def array_table(oifits: OIFits, table: OITable) -> OITable | None:
    """The OI_ARRAY that a data table refers to; the only one, where it names none."""
    arrays = oifits.named("OI_ARRAY")
    name = table.keyword("ARRNAME")
    if not name:
        return arrays[0] if len(arrays) == 1 else None
    return next((a for a in arrays if same(a.keyword("ARRNAME"), name)), None)


def stations_of(oifits: OIFits, array: OITable | None, used: IntArray) -> Stations:
    """Stations of an array, completed by those of the data tables that it does not list."""
    if array is None:
        return Stations(tuple(f"station {i}" for i in used), used, None, None)
    count = len(array)
    listed = _listed_index(oifits, array, used)
    unlisted = used[~np.isin(used, listed)]
    names = [*_station_names(array, listed), *(f"station {i}" for i in unlisted)]
    xyz = _padded(array, "STAXYZ", (count, 3), len(unlisted))
    diameter = _padded(array, "DIAMETER", (count,), len(unlisted))
    return Stations(tuple(names), np.concatenate([listed, unlisted]), xyz, diameter)


def _listed_index(oifits: OIFits, array: OITable, used: IntArray) -> IntArray:
    if "STA_INDEX" in array.columns:
        return integers(oifits, array, "STA_INDEX", 1)[:, 0]
    # Without STA_INDEX the rows are numbered from 1, or from 0 where the data say so.
    return np.arange(len(array)) + int(not (used == 0).any())


def _station_names(array: OITable, index: IntArray) -> list[str]:
    names = [""] * len(array)
    for candidate in ("STA_NAME", "TEL_NAME"):
        given = array.columns.get(candidate)
        if given is not None and given.dtype.kind == "U":
            names = [name or plain(new) for name, new in zip(names, given, strict=True)]
    names = [name or f"station {i}" for name, i in zip(names, index, strict=True)]
    return [
        name if names.count(name) == 1 else f"{name}#{i}"
        for name, i in zip(names, index, strict=True)
    ]


def _padded(table: OITable, name: str, shape: tuple[int, ...], extra: int) -> FloatArray | None:
    values = table.columns.get(name)
    if values is None or values.dtype.kind not in "fiu" or values.size != np.prod(shape):
        return None
    scale, _ = scale_of(table.units[name], LENGTH, "m")
    metres = values.reshape(shape).astype(float) * scale
    metres = metres + rest_of(table, name, metres.shape)
    if not np.nan_to_num(metres).any():
        return None  # zero throughout is how files say that they do not know
    return np.concatenate([metres, np.full((extra, *shape[1:]), np.nan)])


def wavelength_table(oifits: OIFits, table: OITable, n_channels: int) -> OITable:
    """The OI_WAVELENGTH that a data table refers to.

    Raises
    ------
    DataError
        Where there is none of its INSNAME with its number of channels.
    """
    everyone = oifits.named("OI_WAVELENGTH")
    name = table.keyword("INSNAME")
    alike = [w for w in everyone if same(w.keyword("INSNAME"), name)]
    if not alike and not name and len(everyone) == 1:
        alike = list(everyone)
    if not alike:
        raise DataError(
            f"{table.label} refers to the wavelengths of {name or 'no instrument'!r}, "
            "and no OI_WAVELENGTH has that INSNAME",
            source=oifits.path,
            remedy="write the file again with its OI_WAVELENGTH",
        )
    fitting = [w for w in alike if len(w) == n_channels]
    if not fitting:
        raise DataError(
            f"{table.label} has {n_channels} channel(s) in a row, "
            f"its OI_WAVELENGTH {name!r} has {len(alike[0])}",
            source=oifits.path,
            remedy="write the file again with matching tables",
        )
    return next((w for w in fitting if w.extver == table.extver), fitting[0])


def channels_of(oifits: OIFits, table: OITable) -> tuple[FloatArray, FloatArray]:
    """(wavelength, width) of each channel in metres; a width that is none counts as 0.

    Raises
    ------
    DataError
        Where the wavelengths are no wavelengths of light.
    """
    wavelength = _metres(oifits, table, "EFF_WAVE")
    band = np.zeros(len(table))
    if "EFF_BAND" in table.columns:
        band = np.abs(_metres(oifits, table, "EFF_BAND"))
    usable = wavelength[np.isfinite(wavelength) & (wavelength > 0)]
    if not len(usable) or usable.max() > 1e-2:
        swapped = _looks_swapped(table.columns["EFF_WAVE"])
        raise DataError(
            f"{table.label}: EFF_WAVE is no wavelength in metres"
            + (": its bytes are in the reverse of FITS's order" if swapped else ""),
            source=oifits.path,
            remedy="write the file with a FITS library"
            if swapped
            else "give the unit of EFF_WAVE in its TUNIT",
        )
    with np.errstate(invalid="ignore"):
        return wavelength, np.where(band <= wavelength, band, 0.0)


def _looks_swapped(values: NDArray[Any]) -> bool:
    """Whether numbers would be wavelengths of light if their bytes were turned round."""
    turned = values.byteswap()
    with np.errstate(invalid="ignore"):
        return bool(((turned > 1e-7) & (turned < 1e-3)).all())


def notes_of_bands(oifits: OIFits, table: OITable) -> tuple[str, ...]:
    """Say what was made of widths of channels that are none."""
    if "EFF_BAND" not in table.columns:
        return (f"{table.label} has no EFF_BAND: channels are taken as narrow",)
    wavelength, band = (_metres(oifits, table, name) for name in ("EFF_WAVE", "EFF_BAND"))
    with np.errstate(invalid="ignore"):
        impossible, negative = ~(np.abs(band) <= wavelength), band < 0
    impossible &= wavelength > 0
    found = []
    if impossible.any():
        found.append(
            f"{table.label}: EFF_BAND of {impossible.sum()} channel(s) is no width: they are "
            "taken as narrow"
        )
    if (negative & ~impossible).any():
        found.append(f"{table.label}: EFF_BAND is negative: its size is used")
    return tuple(found)


def _metres(oifits: OIFits, table: OITable, name: str) -> FloatArray:
    values = numbers(oifits, table, name)
    if values.shape != (len(table),):
        raise DataError(f"{table.label}: {name} is not one number a row", source=oifits.path)
    metres = values * scale_of(table.units[name], LENGTH, "m")[0]
    return np.asarray(metres + rest_of(table, name, metres.shape))


def setup_name(table: OITable, keyword: str) -> str:
    """INSNAME or ARRNAME as it was before the writer had to tell two of one name apart."""
    return table.keyword(f"{OWN_KEY} {keyword}") or (
        "" if f"{OWN_KEY} {keyword}" in table.header else table.keyword(keyword)
    )


def make_setup(
    oifits: OIFits,
    wavelengths: OITable,
    array: OITable | None,
    stations: Stations,
    target: Target,
) -> Setup:
    """Put one instrument configuration together."""
    wavelength, band = channels_of(oifits, wavelengths)
    return Setup(
        insname=setup_name(wavelengths, "INSNAME"),
        arrname="" if array is None else setup_name(array, "ARRNAME"),
        target=target.name,
        stations=stations.names,
        station_index=stations.index,
        wavelength_m=wavelength,
        band_m=band,
        station_xyz_m=stations.xyz_m,
        station_diameter_m=stations.diameter_m,
        source=oifits.path,
        right_ascension_deg=target.right_ascension_deg,
        declination_deg=target.declination_deg,
        array_frame="" if array is None else array.keyword("FRAME").replace("SKY", ""),
        array_centre_m=(0.0, 0.0, 0.0) if array is None else centre_m(array),
    )


def centre_m(array: OITable) -> tuple[float, float, float]:
    """Centre of an array in its frame; 0 along an axis that it does not state in numbers."""
    values = [array.header.get(f"ARRAY{axis}", 0.0) for axis in "XYZ"]
    x, y, z = (float(v) if isinstance(v, int | float) else 0.0 for v in values)
    return x, y, z
