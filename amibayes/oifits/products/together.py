"""Which files may be given together: no exposure twice, and nothing calibrated twice."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from amibayes.errors import UsageError
from amibayes.oifits.products.recognise import exposure_of, is_normalized, is_product_header

UNCALIBRATED = re.compile(r"_RAW(_|$)|_REDUCED$|_(SCI|CAL)_VIS$")
"""Categories of ESO's pipelines that hold the transfer function: TARGET_OIDATA_RAW of PIONIER,
TARGET_RAW_INT of MATISSE, SCIENCE_REDUCED of AMBER, SINGLE_SCI_VIS of GRAVITY."""


@dataclass(frozen=True)
class Contents:
    """What a file holds, as far as its headers tell.

    Parameters
    ----------
    path : str
    header : mapping
        Of the primary HDU.
    names : tuple of str
        EXTNAME of every HDU, in capitals.
    shapes : tuple of (int, ...)
        Shape of every HDU that is an image; empty for others.
    columns : frozenset of str
        Names of the columns of all tables, in capitals.
    """

    path: str
    header: Mapping[str, Any]
    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]
    columns: frozenset[str] = frozenset()

    @property
    def has_oifits(self) -> bool:
        """Whether there is a table of OIFITS."""
        return any(name.startswith("OI_") for name in self.names)

    @property
    def is_ramp(self) -> bool:
        """Whether it is ramps, whose slopes may be in another file."""
        return str(self.header.get("FILENAME") or self.path).endswith("_ramp.fits")

    @property
    def integrations(self) -> tuple[int, int] | None:
        """First and last integration of the exposure, where the header numbers them."""
        ends = (self.header.get("INTSTART"), self.header.get("INTEND"))
        return (ends[0], ends[1]) if all(type(end) is int for end in ends) else None  # type: ignore[return-value]

    @property
    def is_product(self) -> bool:
        """Whether it is a stage-3 product."""
        return is_product_header(self.header, self.names)

    @property
    def is_normalized(self) -> bool:
        """Whether the pipeline has calibrated it."""
        return self.is_product and is_normalized(self.header, self.columns)

    @property
    def uncalibrated_by(self) -> str:
        """What says that nobody has calibrated it; empty where nothing does."""
        if self.is_product and not self.is_normalized:
            return "jwst"
        category = str(self.header.get("ESO PRO CATG", ""))
        return f"ESO PRO CATG {category}" if UNCALIBRATED.search(category) else ""


def refuse_twice(files: Sequence[Contents]) -> None:
    """Refuse a product, ramps or integrations together with another file of their exposure.

    Raises
    ------
    UsageError
        Naming both.
    """
    for k, one in enumerate(files):
        exposure = exposure_of(one.header)
        for other in files[k + 1 :]:
            if exposure is None or _segments(one, other):
                continue
            if exposure_of(other.header) == exposure:
                raise UsageError(
                    f"is of the same exposure as {one.path}",
                    source=other.path,
                    remedy="give one of them: the ramps or images, else amimulti-oi, else ami-oi",
                )


def _segments(one: Contents, other: Contents) -> bool:
    """Whether two files of an exposure may be segments of it: no integration is in both.

    Ramps beside slopes are none, unless their numbers of integrations say so.
    """
    if one.is_product or other.is_product:
        return False
    if one.integrations is None or other.integrations is None:
        return one.is_ramp == other.is_ramp
    (first, last), (begin, end) = one.integrations, other.integrations
    return last < begin or end < first


def refuse_calibrating_again(targets: Sequence[Contents], calibrators: Sequence[Contents]) -> None:
    """Refuse calibrators for what the pipeline has calibrated already.

    Raises
    ------
    UsageError
        Naming the file.
    """
    normalized = [f for f in (*targets, *calibrators) if f.is_normalized]
    if normalized and calibrators:
        raise UsageError(
            "is calibrated already (jwst aminorm-oi)",
            source=normalized[0].path,
            remedy="give it without --cal, or the ami-oi or amimulti-oi of target and calibrators",
        )


def uncalibrated(targets: Sequence[Contents], calibrators: Sequence[Contents]) -> tuple[str, ...]:
    """Name what nobody has calibrated, by the headers of pipelines."""
    if calibrators:
        return ()
    raw: dict[str, list[str]] = {}
    for file in targets:
        if file.uncalibrated_by:
            raw.setdefault(file.uncalibrated_by, []).append(file.path)
    return tuple(
        f"{', '.join(paths)}: not calibrated ({by}); give its calibrators with --cal"
        for by, paths in raw.items()
    )
