"""What is wrong in stage-3 products of the jwst package, all of it measured on genuine files.

`amibayes.oifits.products` repairs what can be, whenever such a file is read; ``audit --fix``
writes the repaired data as a standard file.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.errors import DataError
from amibayes.oifits.audit.finding import Finding, Findings, listed
from amibayes.oifits.products import Product, Repair, read_products, repaired
from amibayes.oifits.tables import plain

WHY = {
    "product-vis2-error": (
        "error",
        "they are divided by the root of the number of integrations once too often, and "
        "ami_normalize exchanges those of target and calibrator",
    ),
    "product-closure-error": (
        "error",
        "the scatter across the phasor was not divided by its length: errors are too small",
    ),
    "product-phase-error": (
        "warning",
        "the scatter across the phasor was not divided by its length: errors are too small",
    ),
    "product-phase-range": (
        "error",
        "phases were averaged, or subtracted, and not wrapped: a fit sees wrong residuals",
    ),
    "product-date": ("warning", "MJD is midnight and TIME is 0: the time of day is lost"),
    "product-integration-time": ("warning", "INT_TIME is that of one integration"),
    "product-band": (
        "warning",
        "EFF_BAND is 5.6 % narrower than the filter: bandwidth smearing is underestimated",
    ),
    "product-mask-map": (
        "error",
        "(u, v) are of the mask as drawn, the fringes of one that is larger and turned: positions "
        "are off by what is stated",
    ),
    "product-stations": (
        "warning",
        "STAXYZ is in the axes of the mask, (u, v) are on the sky: they do not belong together",
    ),
}
"""Severity of what is repaired, and why it matters."""

REMEDY = "amibayes repairs it; audit --fix writes a copy"


def findings_of(product: Product) -> list[Finding]:
    """List everything that is wrong with a product; ``certain`` where a copy can be written."""
    found = [_of_repair(repair) for repair in repaired(product)[1]]
    found += [*_integrations(product), *_normalized(product), *_roll(product)]
    found += [*_tables(product), *_array(product), *_target(product)]
    fixable = _readable(product)
    return [replace(f, certain=f.certain and fixable) for f in found]


def _readable(product: Product) -> bool:
    try:
        read_products([product])
    except DataError:
        return False
    return True


def _of_repair(repair: Repair) -> Finding:
    severity, why = WHY[repair.code]
    return Finding(
        "error" if severity == "error" else "warning",
        repair.code,
        repair.table,
        f"jwst: {repair.what}, to be right",
        why,
        REMEDY,
        certain=True,
    )


def _integrations(product: Product) -> Findings:
    if not _has_errors(product):
        yield Finding(
            "error",
            "product-no-errors",
            "file",
            f"jwst {product.name} of one integration: errors are 0 or no numbers",
            "one integration tells no errors, and weights made of them are wrong",
            "use an exposure of several integrations",
        )
    elif product.kind == "amimulti-oi":
        yield Finding(
            "error",
            "product-integrations",
            "OI_VIS2, OI_T3",
            f"jwst amimulti-oi: {product.n_integrations or 'several'} integrations stand where "
            "spectral channels belong, with errors of 0",
            "readers take integrations for channels, and 0 for infinite weight",
            REMEDY,
            certain=True,
        )


def _has_errors(product: Product) -> bool:
    """Whether errors are given, or integrations that tell them."""
    (table,) = product.oifits.named("OI_VIS2")
    if product.kind == "amimulti-oi":
        return table.columns["VIS2DATA"].size > len(table)
    error = table.columns.get("VIS2ERR")
    return error is not None and bool(np.isfinite(error).any())


def _normalized(product: Product) -> Findings:
    if product.kind != "aminorm-oi":
        return
    yield Finding(
        "error",
        "product-partly-calibrated",
        "OI_T3, OI_VIS, OI_Q4",
        "jwst aminorm-oi: only VIS2DATA, VISAMP and T3PHI are calibrated; T3AMP, VISPHI and Q4PHI "
        "are those of the target, Q4AMP is a logarithm of a ratio",
        "these columns are not what their names say",
        "use V² and closure phases only",
    )
    yield Finding(
        "warning",
        "product-one-calibrator",
        "file",
        "jwst aminorm-oi: calibrated with one calibrator; others of the association were dropped",
        "the scatter between calibrators is not in the errors; it must not be calibrated again",
        "calibrate ami-oi or amimulti-oi with all calibrators (amibayes search --cal)",
    )


def _roll(product: Product) -> Findings:
    header = product.oifits.header
    if header.get("ROLL_REF") == 0.0 and header.get("V3I_YANG"):
        yield Finding(
            "warning",
            "product-roll-zero",
            "primary header",
            f"jwst: ROLL_REF is exactly 0; the pipeline then leaves V3I_YANG = "
            f"{header['V3I_YANG']:.4f} out of (u, v)",
            "position angles are off by that angle",
            "turn position angles, or process it with a roll that is not exactly 0",
        )


def _tables(product: Product) -> Findings:
    tables = product.oifits.tables
    names = [t.name for t in tables]
    other = [name for name in names if name in ("OI_Q4", "ASDF")]
    if other:
        yield Finding(
            "warning",
            "product-table",
            listed(other),
            "jwst: tables that are not in the standard",
            "programs that refuse unknown tables refuse the file",
            REMEDY,
            certain=True,
        )
    data = [k for k, name in enumerate(names) if name in ("OI_VIS", "OI_VIS2", "OI_T3")]
    if "OI_WAVELENGTH" in names and data and names.index("OI_WAVELENGTH") > min(data):
        yield Finding(
            "warning",
            "product-table-order",
            "OI_WAVELENGTH",
            "jwst: comes after the data that refer to it",
            "programs that read in order do not find the wavelengths",
            REMEDY,
            certain=True,
        )
    flat = [t.label for t in tables if _flag_is_scalar(product, t.name)]
    if flat:
        yield Finding(
            "warning",
            "product-flag",
            listed(flat),
            "jwst: one FLAG a row for several values",
            "FLAG does not have the shape of the data",
            REMEDY,
            certain=True,
        )


def _flag_is_scalar(product: Product, name: str) -> bool:
    value = {"OI_VIS2": "VIS2DATA", "OI_T3": "T3PHI", "OI_VIS": "VISAMP"}.get(name)
    table = product.table(name)
    if value is None or table is None or "FLAG" not in table.columns:
        return False
    return bool(table.columns["FLAG"].size < table.columns[value].size)


def _array(product: Product) -> Findings:
    table = product.table("OI_ARRAY")
    if table is None:
        return
    faults = []
    diameter, kind = table.columns.get("DIAMETER"), table.columns.get("FOVTYPE")
    if diameter is not None and not np.any(diameter):
        faults.append("DIAMETER is 0")
    if kind is not None and "FOV" in table.columns and {plain(k) for k in kind} == {"RADIUS"}:
        faults.append("FOV is the full width, and FOVTYPE says RADIUS")
    if faults:
        yield Finding(
            "warning",
            "product-array",
            table.label,
            f"jwst: {'; '.join(faults)}",
            "field of view and size of the holes are read wrongly",
            REMEDY,
            certain=True,
        )


def _target(product: Product) -> Findings:
    """Proper motions, which APT gives in arcsec a year, copied without conversion to degrees."""
    table, header = product.table("OI_TARGET"), product.oifits.header
    if table is None:
        return
    for name, keyword in (("PMRA", "MU_RA"), ("PMDEC", "MU_DEC")):
        values, stated = table.columns.get(name), header.get(keyword)
        if values is not None and stated and np.allclose(values, stated):
            yield Finding(
                "warning",
                "product-proper-motion",
                table.label,
                f"jwst: {name} = {float(values[0]):g} is in arcsec/yr, not deg/yr",
                "programs that move the target use 3600 times the motion",
                REMEDY,
                certain=True,
            )
            return
