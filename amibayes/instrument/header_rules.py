"""What headers of an instrument's images hold beside the common keywords."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from amibayes.errors import DataError
from amibayes.support.toml import Section

OR = " or "
"""Stands between the filters of an image that a header does not tell apart."""


@dataclass(frozen=True)
class HeaderRules:
    """How headers of an instrument's images are written.

    Parameters
    ----------
    instrume : str
        Value of INSTRUME; the name of the instrument's file where it is empty.
    arm_keyword, arm_value : str
        Tell instruments of one INSTRUME apart: the keyword's value contains the other.
    mask_keyword, mask_value : str
        Images were taken through the mask where the keyword holds the value; nothing is
        checked where either is empty.
    filter_keywords : tuple of str
        Where the filter is, before FILTER; the first that names one.
    filters : mapping of str to str
        The instrument's name of a filter by the header's; empty for a position that is none,
        several with "or" between them where the header does not tell which.
    upright : bool
        Whether images without an orientation in their header have north up.
    simulated : mapping
        Keywords that simulated images get.
    """

    instrume: str = ""
    arm_keyword: str = ""
    arm_value: str = ""
    mask_keyword: str = ""
    mask_value: str = ""
    filter_keywords: tuple[str, ...] = ()
    filters: Mapping[str, str] = field(default_factory=dict)
    upright: bool = True
    simulated: Mapping[str, str | float] = field(default_factory=dict)

    def describes(self, header: Mapping[str, Any], name: str) -> bool:
        """Whether a header is one of this instrument, whose file has that name.

        A header that does not say the arm is of the one that INSTRUME names.
        """
        if not self.shares_instrume(header, name):
            return False
        arm = str(header.get(self.arm_keyword) or "").casefold()
        if self.arm_keyword and not arm:
            return name == self.instrume.casefold()
        return self.arm_value.casefold() in arm

    def shares_instrume(self, header: Mapping[str, Any], name: str) -> bool:
        """Whether a header has the INSTRUME of this instrument, in whatever arm."""
        wanted = (self.instrume or name).casefold()
        return str(header.get("INSTRUME") or "").strip().casefold() == wanted

    def filter_of(self, header: Mapping[str, Any], source: str) -> str | None:
        """Give the name of the filter, None where the header has none.

        Raises
        ------
        DataError
            Where the header has the name of a pair of filters.
        """
        for key in (*self.filter_keywords, "FILTER"):
            word = str(header.get(key) or "").strip()
            found = self.filters.get(word, word)
            if OR in found:
                raise DataError(
                    f"its filter {word} is {found}", source=source, remedy="give --filter"
                )
            if found:
                return found
        return None


def rules_of(section: Section) -> HeaderRules:
    """Read a table ``[header]``."""
    tables = {
        name: MappingProxyType(section.section(name).scalars() if name in section else {})
        for name in ("simulated", "filters")
    }
    keywords = section.text("filter_keywords", "")
    found = HeaderRules(
        instrume=section.text("instrume", ""),
        arm_keyword=section.text("arm_keyword", ""),
        arm_value=section.text("arm_value", ""),
        mask_keyword=section.text("mask_keyword", ""),
        mask_value=section.text("mask_value", ""),
        filter_keywords=tuple(k.strip() for k in keywords.split(",") if k.strip()),
        filters=MappingProxyType({k: str(v) for k, v in tables["filters"].items()}),
        upright=section.flag("upright", True),
        simulated=tables["simulated"],
    )
    section.refuse_unknown(("source", "note"))
    return found
