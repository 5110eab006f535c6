"""A row for each target of a survey: what came of it, and what the statistics need of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.table import MaskedColumn, Table

from amibayes.detection.verdict import REFUSED
from amibayes.survey.completeness import Crossings, DetectionProbability, from_counts
from amibayes.units import delta_mag_to_contrast

Json = dict[str, Any]
Status = Literal["done", "failed", "pending"]

COLUMNS: tuple[tuple[str, str, str], ...] = (
    ("verdict", "verdict.statement", ""),
    ("detected", "significance.detected", ""),
    ("false_alarm_probability", "significance.false_alarm_probability", ""),
    ("delta_chi2", "significance.delta_chi2", ""),
    ("candid_n_sigma", "significance.candid_n_sigma", ""),
    ("separation_mas", "fit.separation_mas", "mas"),
    ("separation_error_mas", "fit.errors.separation_mas", "mas"),
    ("position_angle_deg", "fit.position_angle_deg", "deg"),
    ("position_angle_error_deg", "fit.errors.position_angle_deg", "deg"),
    ("delta_mag", "fit.delta_mag", "mag"),
    ("delta_mag_error", "fit.errors.delta_mag", "mag"),
    ("contrast", "fit.contrast", ""),
    ("contrast_error", "fit.errors.contrast", ""),
    ("diameter_mas", "fit.diameter_mas", "mas"),
    ("chi2r_single", "fit.chi2r_single", ""),
    ("chi2r_binary", "fit.chi2r_binary", ""),
)
"""Columns of the table: name, where the result of a target has it, unit."""

TOGETHER = ("false_discovery_rate", "survey_wide_false_alarm")
"""Columns that depend on the other targets, after the false-alarm probability."""

FACTS = {
    "distance_pc": "pc",
    "primary_magnitude": "mag",
    "magnitude": "mag",
    "spectral_type": "",
}
"""Columns of the survey's table that are known of a star, and their units."""

UNITS = (
    {name: unit for name, _, unit in COLUMNS if unit}
    | {
        "limit_delta_mag": "mag",
        "limit_delta_mag_best": "mag",
        "limit_delta_mag_worst": "mag",
    }
    | {name: unit for name, unit in FACTS.items() if unit}
)

CURVE = (
    "method",
    "observables",
    "separation_mas",
    "delta_mag",
    "false_positive_rate",
    "completeness",
)

STEEPNESS = 6.0
"""Slope of the logistic function of ln contrast where only one probability of it is known: that
of a statistic with Gaussian scatter at a threshold of some 5σ."""


@dataclass(frozen=True)
class Outcome:
    """What came of one target.

    Parameters
    ----------
    name : str
        Also of its folder.
    status : {"done", "failed", "pending"}
    error : str
        One line, where it failed.
    key : str
        Digest of files and options: the same key is the same job.
    row : dict
        Its numbers, where it is done; see `row_of`.
    facts : mapping
        What the survey's table has of the star: ``distance_pc``, ``primary_magnitude``,
        ``mass_table``.
    detection : DetectionProbability, optional
        Where limits by injection were measured.
    chosen : str
        Calibrators that were chosen from a pool, and how near they are.
    """

    name: str
    status: Status
    error: str = ""
    key: str = ""
    row: Json = field(default_factory=dict)
    facts: Mapping[str, Any] = field(default_factory=dict)
    detection: DetectionProbability | None = None
    chosen: str = ""

    def entry(self) -> Json:
        """Give its entry in ``survey.json``."""
        head: Json = {"name": self.name, "status": self.status, "error": self.error or None}
        facts = {name: self.facts[name] for name in FACTS if name in self.facts}
        chosen = {"chosen_calibrators": self.chosen} if self.chosen else {}
        return head | {"key": self.key} | facts | chosen | self.row


def row_of(content: Json) -> Json:
    """Take from a target's result what its row has."""
    inputs = content.get("inputs") or []
    row: Json = {
        "files": [Path(i["path"]).name for i in inputs if i["role"] == "target"],
        "calibrators": [Path(i["path"]).name for i in inputs if i["role"] != "target"],
    }
    row |= {name: _at(content, path) for name, path, _ in COLUMNS if _has(content, path)}
    if isinstance(field_mas := _at(content, "data.separation_mas"), list):
        row["field_mas"] = field_mas
    row |= _limit_numbers(content)
    if "companion_detected" in content:
        row["detected"] = content["companion_detected"]
    if row.get("verdict") in REFUSED:
        row["detected"] = None
    row["modes"] = [
        {k: mode[k] for k in ("separation_mas", "position_angle_deg")}
        for mode in content.get("modes") or []
    ]
    limits = _limits(content)
    row["limits"] = limits and {key: limits[key] for key in CURVE if key in limits}
    row["alpha"] = _alpha(content)
    row["warnings"] = content.get("warnings") or []
    return row


def _alpha(content: Json) -> float | None:
    alpha = _at(content, "significance.alpha")
    return alpha if alpha is not None else content.get("false_positive_rate")


def detection_of(content: Json) -> DetectionProbability | None:
    """Probability of detection from the injections of a result; None where it has none."""
    limits = _limits(content)
    if not limits or limits.get("method") != "injection":
        return None
    cells = content.get("completeness_map") or limits.get("completeness_map")
    if cells:
        located = [w != "detection" for w in limits["criterion_at"]]
        recovered = np.where(np.array(located)[:, None], cells["located"], cells["detected"])
        counts = np.array(cells["trials"]), recovered
        return from_counts(cells["separation_mas"], np.array(cells["contrast"]), *counts)
    return _by_crossings(limits)


def _by_crossings(limits: Json) -> DetectionProbability:
    """Use the contrasts of half and of nearly full completeness, where counts are not kept."""
    logit = math.log(limits["completeness"] / (1.0 - limits["completeness"]))
    rings: list[Crossings | None] = []
    for full, half in zip(limits["delta_mag"], limits["delta_mag_50"], strict=True):
        if half is None:
            rings.append(None)
            continue
        middle = float(np.log(delta_mag_to_contrast(half)))
        slope = STEEPNESS
        if full is not None and full < half:
            slope = logit / (float(np.log(delta_mag_to_contrast(full))) - middle)
        rings.append(Crossings(middle, slope))
    return DetectionProbability(np.array(limits["separation_mas"], dtype=float), tuple(rings))


def _has(content: Json, path: str) -> bool:
    """Whether a result knows of this number at all; a stage that was left out is null."""
    return path.split(".")[0] in content


def _at(content: Json, path: str) -> Any:
    found: Any = content
    for part in path.split("."):
        found = found.get(part) if isinstance(found, Mapping) else None
    return found


def _limits(content: Json) -> Json | None:
    """The limits of a search, or the main curve of ``limits``."""
    return content if "delta_mag" in content else content.get("limits")


def _limit_numbers(content: Json) -> Json:
    """Median, best and worst limit over the separations that have one."""
    limits = _limits(content) or {}
    usable = [x for x in limits.get("delta_mag", ()) if x is not None]
    if not usable:
        return {}
    return {
        "limit_delta_mag": float(np.median(usable)),
        "limit_delta_mag_best": float(max(usable)),
        "limit_delta_mag_worst": float(min(usable)),
    }


def table_of(entries: Sequence[Json], meta: Json) -> Table:
    """Lay entries out as a table; what a target lacks is masked."""
    found = {key for entry in entries for key in entry}
    names = ["name", "status", "error", *FACTS, "chosen_calibrators"]
    for name, _, _ in COLUMNS:
        names += [name, *(TOGETHER if name == "false_alarm_probability" else ())]
    names += [name for name in UNITS if name.startswith("limit")]
    table = Table(meta=meta)
    for name in names:
        if name not in found:
            continue
        values = [entry.get(name) for entry in entries]
        known = [v for v in values if v is not None]
        blank: Any = type(known[0])() if known else ""
        filled = [blank if v is None else v for v in values]
        mask = [v is None for v in values]
        table[name] = MaskedColumn(filled, mask=mask, unit=UNITS.get(name))
    return table


__all__ = ["Outcome", "Status", "detection_of", "row_of", "table_of"]
