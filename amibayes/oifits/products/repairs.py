"""What is wrong in stage-3 products of the jwst package, put right before they are used.

Measured on products of jwst 3.0.0 against their own integrations; the same holds in the
source of 1.17 on.

- VIS2ERR is divided by √N once too often, and `ami_normalize` exchanges those of target and
  calibrator. 2·VIS2DATA·VISAMPERR/VISAMP is a standard error to 2 %, whatever N.
- T3PHIERR and VISPHIERR are the scatter across the mean phasor, not divided by its length;
  `ami_normalize` adds those of target and calibrator as they are.
- T3PHI may lie outside ±180°: linear averages, and differences that were not wrapped.
- MJD is midnight and TIME 0; INT_TIME is that of one integration.
- EFF_BAND is 5.6 % narrower than the filter at half its height.
- STAXYZ is in the mask's frame, not turned to the sky; CTRS_EQT is.
- (u, v) are of the mask as drawn, not of the one that the fringes were fitted with.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from amibayes.data.closure import closure_matrix
from amibayes.errors import DataError, UsageError
from amibayes.instrument import load_instrument
from amibayes.oifits.products.mask_map import ProductMap, map_of, mapped_columns
from amibayes.oifits.products.recognise import Product
from amibayes.oifits.tables import OIFits, OITable, plain
from amibayes.units import FloatArray, IntArray

NARROW = 0.944
"""EFF_BAND over the width at half height, measured for F480M: for filters that are not known."""

CLIPPED = (
    (1.0 / 1000, 1.0 / 200, 1.0 / 60, 1.0 / 30, 1.0 / 20, 1.0 / 15, 1.0 / 10),
    (0.035, 0.033, 0.029, 0.022, 0.017, 0.011, 0.003),
)
"""Variance of a mean of normal numbers that were clipped at 3σ about the mean of all, in units of
that of the mean of all, by one over how many they are (20 000 draws; fewer than 10 lose none)."""

DATA = ("OI_VIS", "OI_VIS2", "OI_T3", "OI_Q4")


@dataclass(frozen=True)
class Repair:
    """One thing that was put right.

    Parameters
    ----------
    code : str
        That of the audit's finding.
    table : str
    what : str
        What was done, for a reader.
    """

    code: str
    table: str
    what: str


def repaired(product: Product) -> tuple[OIFits, list[Repair]]:
    """Put right what can be: errors, phases, times, width of the band, stations.

    Of ``amimulti-oi``, whose errors are 0, only what is not an error.

    Returns
    -------
    OIFits
        The tables as they should have been written.
    list of Repair
    """
    done: list[Repair] = []
    found = map_of(product)
    tables = tuple(_repaired_table(product, table, done, found) for table in product.oifits.tables)
    return replace(product.oifits, tables=tables), done


def _repaired_table(
    product: Product, table: OITable, done: list[Repair], found: ProductMap | None
) -> OITable:
    new: dict[str, Any] = {}
    if table.name in DATA and found is not None and found.changes:
        new |= _mapped(found, table, done)
    if table.name in DATA and len(table):
        new |= _times(product, table, done)
    if table.name in ERRORS and product.kind != "amimulti-oi":
        new |= ERRORS[table.name](product, table, done)
    if table.name == "OI_T3" and "T3PHI" in table.columns:
        new |= _wrapped(table, done)
    if table.name == "OI_WAVELENGTH" and "EFF_BAND" in table.columns:
        new |= _band(product, table, done)
    if table.name == "OI_ARRAY":
        new |= _stations(product, table, done, found)
    return with_columns(table, new)


def with_columns(table: OITable, new: Mapping[str, Any]) -> OITable:
    """Return the table with some columns replaced."""
    if not new:
        return table
    columns = dict(table.columns) | {name: _frozen(values) for name, values in new.items()}
    units = dict(table.units) | {name: table.units.get(name, "") for name in new}
    return replace(table, columns=MappingProxyType(columns), units=MappingProxyType(units))


def _frozen(values: Any) -> Any:
    array = np.array(values)
    array.flags.writeable = False
    return array


def _times(product: Product, table: OITable, done: list[Repair]) -> dict[str, Any]:
    new: dict[str, Any] = {}
    middle = product.oifits.header.get("EXPMID")
    mjd, seconds = table.columns.get("MJD"), table.columns.get("TIME")
    if isinstance(middle, int | float) and mjd is not None and np.any(mjd != middle):
        new |= {"MJD": np.full(len(table), float(middle))}
        if seconds is not None:
            new["TIME"] = np.zeros(len(table))
        done.append(Repair("product-date", table.name, "MJD taken from EXPMID"))
    whole = _exposure_time(product)
    if whole is not None and "INT_TIME" in table.columns:
        if np.any(table.columns["INT_TIME"] != whole):
            what = "INT_TIME made that of the whole exposure"
            done.append(Repair("product-integration-time", table.name, what))
        new["INT_TIME"] = np.full(len(table), whole)
    return new


def _exposure_time(product: Product) -> float | None:
    """Seconds of all integrations together."""
    header = product.oifits.header
    whole, one = header.get("EFFEXPTM"), header.get("EFFINTTM")
    if isinstance(whole, int | float) and whole > 0:
        return float(whole)
    known = isinstance(one, int | float) and one > 0 and product.n_integrations > 0
    return float(one) * product.n_integrations if known else None


def relative_amplitude_error(product: Product, rows: OITable) -> FloatArray | None:
    """VISAMPERR/VISAMP of the rows of OI_VIS2 (n, 1); None where OI_VIS has others."""
    partner = product.table("OI_VIS")
    names = ("VISAMP", "VISAMPERR", "STA_INDEX")
    if partner is None or not all(n in partner.columns for n in names):
        return None
    ours, theirs = rows.columns.get("STA_INDEX"), partner.columns["STA_INDEX"]
    if ours is None or not np.array_equal(ours, theirs):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = partner.columns["VISAMPERR"] / partner.columns["VISAMP"]
    return np.asarray(ratio, dtype=float).reshape(len(rows), -1)


def vis2_error(product: Product, table: OITable) -> FloatArray:
    """Give 2·VIS2DATA·VISAMPERR/VISAMP, in the shape of VIS2DATA.

    Raises
    ------
    DataError
        Where OI_VIS does not hold the amplitudes of the same rows.
    """
    ratio = relative_amplitude_error(product, table)
    value = np.asarray(table.columns["VIS2DATA"], dtype=float)
    if ratio is None or ratio.size != value.size:
        raise DataError(
            "its VIS2ERR are wrong (jwst), and it has no amplitudes (OI_VIS) to make them from",
            source=product.oifits.path,
            remedy="give the file as the pipeline wrote it",
        )
    return np.asarray(2.0 * np.abs(value) * ratio.reshape(value.shape))


def _vis2(product: Product, table: OITable, done: list[Repair]) -> dict[str, Any]:
    sigma, stated = vis2_error(product, table), table.columns["VIS2ERR"]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = sigma / stated
    ratio = ratio[np.isfinite(ratio)]
    if not len(ratio):
        return {"VIS2ERR": sigma}
    change = f"VIS2ERR times {np.median(ratio):.3g} (2 VIS2DATA VISAMPERR/VISAMP)"
    done.append(Repair("product-vis2-error", table.name, change))
    return {"VIS2ERR": sigma}


def _divided(error: str, amplitude: str, code: str) -> Any:
    def repair(product: Product, table: OITable, done: list[Repair]) -> dict[str, Any]:
        if not {error, amplitude} <= set(table.columns):
            return {}
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = table.columns[error] / np.abs(table.columns[amplitude])
        if np.isfinite(sigma).any():
            done.append(Repair(code, table.name, f"{error} divided by {amplitude}"))
        return {error: sigma}

    return repair


def _closure(product: Product, table: OITable, done: list[Repair]) -> dict[str, Any]:
    """T3PHIERR over T3AMP; of calibrated products, from the errors of amplitudes.

    `ami_normalize` adds two scatters in quadrature, each times its own triple amplitude, and
    keeps that of the target alone: with unlike visibilities no division mends it.
    """
    if not {"T3PHIERR", "T3AMP"} <= set(table.columns):
        return {}
    sigma = _from_amplitudes(product, table) if product.kind == "aminorm-oi" else None
    what = "T3PHIERR made of VISAMPERR/VISAMP of three baselines"
    if sigma is None:
        what = "T3PHIERR divided by T3AMP"
        with np.errstate(divide="ignore", invalid="ignore"):
            sigma = table.columns["T3PHIERR"] / np.abs(table.columns["T3AMP"])
    clipped = _clipping(product, table)
    if clipped is not None:
        sigma = np.hypot(sigma, clipped)
        what += ", and what clipped phases of single baselines add to it"
    if np.isfinite(sigma).any():
        done.append(Repair("product-closure-error", table.name, what))
    return {"T3PHIERR": sigma}


def _sides(product: Product, table: OITable) -> tuple[FloatArray, IntArray] | None:
    """Which baselines (n, m) triangles have, and their rows (m,) in OI_VIS; None without these."""
    rows, triangles = product.table("OI_VIS"), table.columns.get("STA_INDEX")
    if rows is None or triangles is None or "STA_INDEX" not in rows.columns:
        return None
    matrix, baselines = closure_matrix(np.asarray(triangles))
    pairs = np.sort(rows.columns["STA_INDEX"], axis=1)
    same = (baselines[:, None] == pairs).all(axis=2)
    return (np.abs(matrix), same.argmax(axis=1)) if same.any(axis=1).all() else None


def _clipping(product: Product, table: OITable) -> FloatArray | None:
    """What clipping adds to errors of closure phases, degrees, in the shape of T3PHIERR.

    They are those of averaged phases of baselines, each without the integrations that differ on
    it by three standard deviations. A tilt of an image, which closes, is then left out of one side
    and not of another. Of a calibrated product the calibrator's is taken for the target's.
    """
    sides, rows = _sides(product, table), product.table("OI_VIS")
    if sides is None or rows is None or not {"VISAMP", "VISPHIERR"} <= set(rows.columns):
        return None
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.ravel(rows.columns["VISPHIERR"]) / np.abs(np.ravel(rows.columns["VISAMP"]))
    if len(error) != len(rows) or not np.isfinite(error).all():
        return None
    # From the many to the few: np.interp wants places that rise.
    share = np.interp(1.0 / max(product.n_integrations, 2), *CLIPPED)
    share *= 2.0 if product.kind == "aminorm-oi" else 1.0
    found = np.sqrt(share * sides[0] @ error[sides[1]] ** 2)
    return np.asarray(found.reshape(np.shape(table.columns["T3PHIERR"])))


def _from_amplitudes(product: Product, table: OITable) -> FloatArray | None:
    """Errors of closure phases, degrees, in the shape of T3PHIERR; None without OI_VIS.

    VISAMPERR/VISAMP, in which both stars have their part, is the error of a phase where noise is
    alike along a visibility and across it. Jitter makes it more along: what is stated lies
    between that error times the smaller and times the larger of both triple amplitudes, and
    where these are alike tells how much less there is across.
    """
    found, rows = _sides(product, table), product.table("OI_VIS")
    relative = None if rows is None else relative_amplitude_error(product, rows)
    if rows is None or found is None or relative is None:
        return None
    sides, row = found
    amplitude = np.abs(np.asarray(rows.columns["VISAMP"], dtype=float)).reshape(len(rows), -1)
    ours = np.abs(np.asarray(table.columns["T3AMP"], dtype=float)).ravel()
    theirs = ours / np.exp(sides @ np.log(amplitude[row, 0]))
    stated = np.radians(np.asarray(table.columns["T3PHIERR"], dtype=float)).ravel()
    variance = sides @ relative[row, 0] ** 2
    least, most = (
        np.nansum(stated**2) / np.nansum(side(ours, theirs) ** 2 * variance)
        for side in (np.maximum, np.minimum)
    )
    scale = np.clip(1.0, least, most) if np.isfinite(least + most) else 1.0
    sigma = np.degrees(np.sqrt(scale * variance))
    return np.asarray(sigma.reshape(np.shape(table.columns["T3PHIERR"])))


ERRORS = {
    "OI_VIS2": _vis2,
    "OI_T3": _closure,
    "OI_VIS": _divided("VISPHIERR", "VISAMP", "product-phase-error"),
}
"""What makes the errors of each table right."""


def _wrapped(table: OITable, done: list[Repair]) -> dict[str, Any]:
    phase = np.asarray(table.columns["T3PHI"], dtype=float)
    wrapped = (phase + 180.0) % 360.0 - 180.0
    outside = int((np.abs(phase) > 180.0).sum())
    if not outside:
        return {}
    done.append(Repair("product-phase-range", table.name, f"{outside} T3PHI wrapped to ±180 deg"))
    return {"T3PHI": np.where(np.abs(phase) > 180.0, wrapped, phase)}


def band_width(product: Product) -> tuple[float | None, str]:
    """Width at half height of the filter (m) that the header names, and its name."""
    name = plain(product.oifits.header.get("FILTER", ""))
    instrument = plain(product.oifits.header.get("INSTRUME", "")) or "niriss"
    try:
        low, high = load_instrument(instrument, name).bandpass.half_power_m
    except (UsageError, DataError):
        return None, name
    return high - low, name


def _band(product: Product, table: OITable, done: list[Repair]) -> dict[str, Any]:
    stated = np.asarray(table.columns["EFF_BAND"], dtype=float)
    width, name = band_width(product)
    new = stated / NARROW if width is None else np.full(stated.shape, width)
    change = f"EFF_BAND {stated.mean() * 1e6:.3f} made {new.mean() * 1e6:.3f} um"
    done.append(Repair("product-band", table.name, f"{change}, {name or 'the filter'} at half"))
    return {"EFF_BAND": new}


def _mapped(found: ProductMap, table: OITable, done: list[Repair]) -> dict[str, Any]:
    new = mapped_columns(found, table)
    if new:
        change = (
            f"(u, v) made those of the mask that the fringes were fitted with ({found.known_from})"
        )
        turned = f"angles were {found.angle_deg:+.2f} deg off, {found.uncertainty}"
        done.append(Repair("product-mask-map", table.name, f"{change}: {turned}"))
    return new


def _stations(
    product: Product, table: OITable, done: list[Repair], found: ProductMap | None
) -> dict[str, Any]:
    """Places of the holes on the sky, from CTRS_EQT, where they give the file's (u, v)."""
    turned, rows = table.columns.get("CTRS_EQT"), product.table("OI_VIS2")
    index = table.columns.get("STA_INDEX")
    if turned is None or index is None or rows is None or turned.shape != (len(table), 2):
        return {}
    # CTRS_EQT has the axes (north, east), pointing the other way.
    sky = -np.asarray(turned, dtype=float)[:, ::-1]
    place = {int(k): xy for k, xy in zip(index, sky, strict=True)}
    pairs = rows.columns.get("STA_INDEX")
    if pairs is None or not set(np.ravel(pairs).tolist()) <= set(place):
        return {}
    uv = np.array([place[int(b)] - place[int(a)] for a, b in pairs])
    stated = np.column_stack([rows.columns["UCOORD"], rows.columns["VCOORD"]])
    if np.abs(uv - stated).max() > 1e-3 * np.abs(stated).max():
        return {}
    done.append(Repair("product-stations", table.name, "STAXYZ turned to the sky (CTRS_EQT)"))
    sky = sky if found is None else sky @ found.on_sky.T
    return {"STAXYZ": np.column_stack([sky, np.zeros(len(sky))])}
