"""JWST stage-3 interferometry products: which kind a file is, told by what it holds.

Names of files may be anything; the kinds differ in their tables. ``psf-ami-oi`` is an
``ami-oi`` of a calibrator: the same tables, another place in the association.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amibayes.oifits.tables import OIFits, OITable, plain

ProductKind = Literal["ami-oi", "amimulti-oi", "aminorm-oi"]

DATA_MODEL = "AmiOIModel"
"""DATAMODL of every product of the jwst package in OIFITS form."""

IMPLANEIA = "CTRS_EQT"
"""Column of OI_ARRAY that ImPlaneIA writes, whose files of many integrations the pipeline's are
descended from; its averages are plain OIFITS."""

FITS_MODEL = "AmiLgFitModel"
"""DATAMODL of the images that `ami_analyze` fitted (``amilg``)."""

Header = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Product:
    """A stage-3 product.

    Parameters
    ----------
    oifits : OIFits
    kind : {"ami-oi", "amimulti-oi", "aminorm-oi"}
    n_integrations : int
        Of the exposure; 0 where the header does not say.
    """

    oifits: OIFits
    kind: ProductKind
    n_integrations: int

    @property
    def reference(self) -> bool:
        """Whether the file calls itself that of a calibrator (``psf-ami-oi``)."""
        header = self.oifits.header
        return bool(header.get("IS_PSF")) or "psf-ami-oi" in plain(header.get("FILENAME", ""))

    @property
    def name(self) -> str:
        """Kind as the pipeline calls it."""
        return "psf-ami-oi" if self.reference and self.kind == "ami-oi" else self.kind

    @property
    def label(self) -> str:
        """File and kind, for messages."""
        if by_implaneia(self):
            return f"{self.oifits.path}: integrations of ImPlaneIA"
        return f"{self.oifits.path}: jwst {self.name}"

    def table(self, name: str) -> OITable | None:
        """The only table of that name; None where there is none, or several."""
        found = self.oifits.named(name)
        return found[0] if len(found) == 1 else None


def is_product_header(header: Header, names: tuple[str, ...]) -> bool:
    """Whether a primary header and the names of the tables are those of a product.

    The quad amplitudes (OI_Q4) are in no other OIFITS file; a copy that lost its keywords is
    known by them.
    """
    if "OI_VIS2" not in names and "OI_T3" not in names:
        return False
    return plain(header.get("DATAMODL", "")) == DATA_MODEL or "OI_Q4" in names


def by_pipeline(oifits: OIFits) -> bool:
    """Whether a file is a product of the jwst package, by `is_product_header`."""
    return is_product_header(oifits.header, tuple(t.name for t in oifits.tables))


def product_of(oifits: OIFits) -> Product | None:
    """Find which product a file is; None for any other file."""
    jwst = by_pipeline(oifits)
    if not jwst and not any(IMPLANEIA in t.columns for t in oifits.named("OI_ARRAY")):
        return None
    for name in ("OI_VIS2", "OI_T3"):
        found = oifits.named(name)
        if len(found) != 1 or not len(found[0]):
            return None
    if not jwst:
        return Product(oifits, "amimulti-oi", 0) if _has_integrations(oifits) else None
    count = oifits.header.get("NINTS")
    return Product(oifits, _kind(oifits), count if isinstance(count, int) else 0)


def by_implaneia(product: Product) -> bool:
    """Whether integrations are ImPlaneIA's, whose T3AMP are no amplitudes of the triangles."""
    return not by_pipeline(product.oifits)


def is_normalized(header: Header, columns: Collection[str]) -> bool:
    """Whether `ami_normalize` was done: it says so, and keeps the pistons of both stars."""
    both = "PISTON_T" in columns and "PISTON_C" in columns
    return both or header.get("S_AMINOR") == "COMPLETE"


def _kind(oifits: OIFits) -> ProductKind:
    columns = {name for table in oifits.named("OI_ARRAY") for name in table.columns}
    if is_normalized(oifits.header, columns):
        return "aminorm-oi"
    return "amimulti-oi" if _has_integrations(oifits) else "ami-oi"


def _has_integrations(oifits: OIFits) -> bool:
    """Whether values run over integrations: more of them than wavelengths, or errors all 0."""
    (table,) = oifits.named("OI_VIS2")
    value, error = table.columns.get("VIS2DATA"), table.columns.get("VIS2ERR")
    channels = max((len(w) for w in oifits.named("OI_WAVELENGTH")), default=1)
    if value is None or not len(table):
        return False
    return value.size > channels * len(table) or (error is not None and not np.any(error != 0.0))


@dataclass(frozen=True)
class Exposure:
    """What tells one exposure from another.

    Parameters
    ----------
    start, end : float
        EXPSTART and EXPEND, MJD.
    target, detector : str
    """

    start: float
    end: float
    target: str
    detector: str


def exposure_of(header: Header) -> Exposure | None:
    """Read which exposure a JWST file, image cube or product, is of; None where it is not said."""
    times = [header.get(key) for key in ("EXPSTART", "EXPEND")]
    if not all(isinstance(t, int | float) and np.isfinite(t) and t > 0 for t in times):
        return None
    target = plain(header.get("TARGPROP") or header.get("TARGNAME") or "").casefold()
    # A tenth of a second: files of one exposure carry the very same numbers.
    start, end = (round(float(t), 6) for t in times)  # type: ignore[arg-type]
    return Exposure(start, end, target, plain(header.get("DETECTOR", "")))
