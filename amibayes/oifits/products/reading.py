"""OIFITS files as `Observables`, whoever wrote them; stage-3 products are repaired and averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.oifits.products.fringe_fit import correlated
from amibayes.oifits.products.integrations import averaged
from amibayes.oifits.products.mask_map import map_of
from amibayes.oifits.products.recognise import (
    DATA_MODEL,
    Product,
    by_pipeline,
    product_of,
)
from amibayes.oifits.products.repairs import Repair, repaired
from amibayes.oifits.reader import observables_of
from amibayes.oifits.tables import OIFits, open_oifits, plain
from amibayes.oifits.writer import write_oifits
from amibayes.scene.orientation import SAME_ORIENTATION_RAD
from amibayes.support.arguments import checks_arguments
from amibayes.support.options import ClosureCovariance
from amibayes.units import FloatArray

NO_MAP = (
    "does not tell with which map of the mask the pipeline fitted the fringes: position angles may "
    "be off by 0.4 deg, separations by 0.7 %"
)

CORRELATED = "errors correlated as a fit of the fringes makes them"

USED = ("OI_VIS", "OI_Q4", "ASDF")
"""Tables that need not be said to be set aside: used for repairs, or derived from others."""


@checks_arguments
def read_oifits(
    path: str | Path,
    *,
    insname: str | None = None,
    target: str | None = None,
    closure_covariance: ClosureCovariance = "assumed",
) -> Observables:
    """Read the squared visibilities and closure phases of an OIFITS file.

    Products of the jwst package are repaired on the way (`amibayes.oifits.products`).

    Parameters
    ----------
    path : str or path
        Version 1 or 2, plain or gzipped.
    insname : str, optional
        Only the data of this instrument table; all are joined otherwise.
    target : str, optional
        Which target, where the file holds data of several.
    closure_covariance : {"assumed", "diagonal"}
        What errors without correlations mean: independent baseline phases, which triangles
        share, or independent closure phases. "diagonal" also sets aside correlations that
        the file gives.

    Returns
    -------
    Observables

    Raises
    ------
    DataError
        Where the file cannot be read or holds no usable V² or closure phase.
    """
    oifits = open_oifits(path)
    options = {"insname": insname, "target": target, "closure_covariance": closure_covariance}
    # None for anything but a stage-3 product of jwst.
    found = read_product(oifits, **options)
    return observables_of(oifits, **options) if found is None else found  # type: ignore[arg-type]


def read_products(products: Sequence[Product], **options: Any) -> list[Observables]:
    """Read products: integrations of one star's exposures together, averages one by one.

    Parameters
    ----------
    products : sequence of Product
    **options
        Those of `observables_of`.

    Raises
    ------
    DataError
        Where a file has no errors, or nothing that can be used.
    """
    found: list[Observables] = []
    groups: list[list[Product]] = []
    for product in products:
        if product.kind == "amimulti-oi":
            _place(groups, product)
        else:
            found.append(_average(product, options))
    return found + [_integrations(group, options) for group in groups]


def read_product(oifits: OIFits, **options: Any) -> Observables | None:
    """Read a file if it is a product; None for any other.

    Raises
    ------
    DataError
        Where it cannot be read, or lacks V² or closure phases.
    """
    product = product_of(oifits)
    if product is None and by_pipeline(oifits):
        raise _incomplete(oifits.path)
    return None if product is None else read_products([product], **options)[0]


def _incomplete(path: str | Path) -> DataError:
    return DataError(
        "is a product of the jwst package without one OI_VIS2 and one OI_T3 with rows",
        source=path,
        remedy="give the file as the pipeline wrote it",
    )


KEPT = ("ORIGIN", "TELESCOP", "INSTRUME", "FILTER", "OBJECT", "OBSERVER", "DATE-OBS", "INSMODE")
"""Keywords of a product that are true of its repaired copy; DATAMODL is not."""


def write_repaired(product: Product, path: str | Path) -> None:
    """Write what is read of a product as a standard OIFITS 2 file, correlations in OI_CORR.

    Raises
    ------
    DataError
        Where nothing can be read.
    RunError
        Where the file cannot be written.
    """
    header = product.oifits.header
    kept = {key: header[key] for key in KEPT if plain(header.get(key, ""))}
    write_oifits(path, read_products([product])[0], header=kept, overwrite=True)


def open_products(paths: Sequence[str | Path]) -> list[Product]:
    """Open files that are known to be products.

    Raises
    ------
    DataError
        Where one cannot be read, or lacks V² or closure phases.
    """
    found = []
    for path in paths:
        product = product_of(open_oifits(path))
        if product is None:
            raise _incomplete(path)
        found.append(product)
    return found


def _place(groups: list[list[Product]], product: Product) -> None:
    """Put a product with exposures of the same star, filter and orientation."""
    for group in groups:
        if _alike(group[0], product):
            group.append(product)
            return
    groups.append([product])


def _alike(one: Product, other: Product) -> bool:
    names = ("TARGPROP", "TARGNAME", "INSTRUME", "FILTER")
    a, b = (
        tuple(plain(p.oifits.header.get(k, "")).casefold() for k in names) for p in (one, other)
    )
    first, second = _uv(one), _uv(other)
    if a != b or not any(a[:2]) or first.shape != second.shape:
        return False
    length = np.hypot(*first.T).max(initial=0.0)
    return bool(np.abs(first - second).max(initial=0.0) <= SAME_ORIENTATION_RAD * length)


def _uv(product: Product) -> FloatArray:
    table = product.table("OI_VIS2")
    if table is None or not {"UCOORD", "VCOORD"} <= set(table.columns):
        return np.empty((0, 2))
    return np.column_stack([table.columns["UCOORD"], table.columns["VCOORD"]]).astype(float)


def _average(product: Product, options: dict[str, Any]) -> Observables:
    """An average of the pipeline with errors put right; closure phases correlated as assumed."""
    _refuse_without_errors(product)
    oifits, done = repaired(product)
    found = observables_of(oifits, **options)
    found = replace(found, n_integrations=product.n_integrations or None)
    if options.get("closure_covariance") == "diagonal":
        return _noted(found, [product], done, "")
    return _noted(correlated(found, product), [product], done, CORRELATED)


def _refuse_without_errors(product: Product) -> None:
    errors = [t.columns.get("VISAMPERR") for t in product.oifits.named("OI_VIS")]
    errors += [t.columns.get("VIS2ERR") for t in product.oifits.named("OI_VIS2")]
    known = [np.isfinite(e).any() for e in errors if e is not None]
    if not any(known):
        one = product.n_integrations == 1
        raise DataError(
            f"{'has one integration' if one else 'has errors that are no numbers'}: "
            "nothing tells its errors",
            source=product.oifits.path,
            remedy="give an exposure of several integrations",
        )


def _integrations(group: list[Product], options: dict[str, Any]) -> Observables:
    pairs = [repaired(product) for product in group]
    corrected = [replace(p, oifits=oifits) for p, (oifits, _) in zip(group, pairs, strict=True)]
    found = averaged(corrected, **options)
    what = (
        f"{found.n_integrations} integrations: values and joint covariance from them "
        "(errors of the file are 0)"
    )
    return _noted(found, group, pairs[0][1], what)


def _noted(
    found: Observables, group: Sequence[Product], done: Sequence[Repair], first: str
) -> Observables:
    """Add one line on what was put right, and what cannot be."""
    kept = [n for n in found.notes if not any(n.startswith(f"{name} ") for name in USED)]
    said = list(dict.fromkeys([*([first] if first else []), *(r.what for r in done)]))
    also = f" and {len(group) - 1} more" if len(group) > 1 else ""
    notes = [
        f"{group[0].label}{also}: {'; '.join(said)}",
        *(n for p in group for n in _notes(p)),
    ]
    return replace(found, notes=(*notes, *kept))


def _notes(product: Product) -> list[str]:
    """What a reader of the result has to know of a file."""
    found = []
    header = product.oifits.header
    if header.get("ROLL_REF") == 0.0 and header.get("V3I_YANG"):
        found.append(
            f"{product.oifits.path}: ROLL_REF is exactly 0, where the pipeline leaves V3I_YANG out "
            f"too: position angles may be off by {header['V3I_YANG']:.3f} deg"
        )
    known = map_of(product)
    if known is None and header.get("DATAMODL") == DATA_MODEL:
        found.append(f"{product.oifits.path}: {NO_MAP}")
    elif known is not None and not known.changes:
        found.append(f"{product.oifits.path}: {known.uncertainty}")
    if product.kind == "aminorm-oi":
        found.append(
            f"{product.oifits.path}: calibrated by the pipeline, with one calibrator and without "
            "correlations; the ami-oi or amimulti-oi of target and calibrators (--cal) tell more"
        )
    return found
