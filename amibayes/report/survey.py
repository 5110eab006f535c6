"""What came of all targets: one table, one JSON, one picture."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from astropy.table import MaskedColumn, Table
from matplotlib.figure import Figure

from amibayes import __version__
from amibayes.plots.style import save
from amibayes.plots.survey import Found, LimitCurve, survey_plot
from amibayes.support.atomic_files import atomic_path, write_json
from amibayes.support.terminal import row, shortened

Json = dict[str, Any]
Status = Literal["done", "failed", "pending"]

JSON_NAME, TABLE_NAME, PICTURE_NAME = "summary.json", "summary.ecsv", "summary.png"

COLUMNS: tuple[tuple[str, str, str], ...] = (
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

UNITS = {name: unit for name, _, unit in COLUMNS if unit} | {
    "limit_delta_mag": "mag",
    "limit_delta_mag_best": "mag",
    "limit_delta_mag_worst": "mag",
}


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
    content : dict, optional
        Its result, where it is done.
    """

    name: str
    status: Status
    error: str = ""
    key: str = ""
    content: Json | None = None


def summary_json(command: str, seed: int, outcomes: Sequence[Outcome]) -> Json:
    """Build the content of ``summary.json``: the same for any number of workers."""
    return {
        "amibayes": __version__,
        "command": command,
        "seed": seed,
        "n_targets": len(outcomes),
        "n_done": sum(o.status == "done" for o in outcomes),
        "n_failed": sum(o.status == "failed" for o in outcomes),
        "targets": [_entry(o) for o in outcomes],
    }


def _entry(outcome: Outcome) -> Json:
    entry: Json = {
        "name": outcome.name,
        "status": outcome.status,
        "error": outcome.error or None,
        "key": outcome.key,
    }
    content = outcome.content
    if content is None:
        return entry
    inputs = content.get("inputs") or []
    entry["files"] = [Path(i["path"]).name for i in inputs if i["role"] == "target"]
    entry["calibrators"] = [Path(i["path"]).name for i in inputs if i["role"] != "target"]
    entry |= {name: _at(content, path) for name, path, _ in COLUMNS if _has(content, path)}
    entry |= _limit_numbers(content)
    if "companion_detected" in content:
        entry["detected"] = content["companion_detected"]
    entry["limits"] = _limits(content)
    entry["warnings"] = content.get("warnings") or []
    return entry


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
    if "delta_mag" in content:
        return {key: content[key] for key in CURVE}
    return content.get("limits")


CURVE = (
    "method",
    "observables",
    "separation_mas",
    "delta_mag",
    "false_positive_rate",
    "completeness",
)


def _limit_numbers(content: Json) -> Json:
    """Median, best and worst limit over the separations that have one."""
    curve = _curve(content)
    usable = np.empty(0) if curve is None else curve.delta_mag[np.isfinite(curve.delta_mag)]
    if not len(usable):
        return {}
    return {
        "limit_delta_mag": float(np.median(usable)),
        "limit_delta_mag_best": float(usable.max()),
        "limit_delta_mag_worst": float(usable.min()),
    }


def _curve(content: Json) -> LimitCurve | None:
    limits = _limits(content)
    if not limits:
        return None
    values = [math.nan if x is None else x for x in limits["delta_mag"]]
    return LimitCurve(np.array(limits["separation_mas"]), np.array(values, dtype=float))


def summary_table(content: Json) -> Table:
    """Lay the entries of ``summary.json`` out as a table; what a target lacks is masked."""
    entries = content["targets"]
    names = ["name", "status", "error"]
    found = {key for entry in entries for key in entry}
    names += [name for name, _, _ in COLUMNS if name in found]
    names += [name for name in UNITS if name.startswith("limit") and name in found]
    table = Table(meta={k: content[k] for k in ("amibayes", "command", "seed")})
    for name in names:
        values = [entry.get(name) for entry in entries]
        known = [v for v in values if v is not None]
        blank: Any = type(known[0])() if known else ""
        filled = [blank if v is None else v for v in values]
        mask = [v is None for v in values]
        table[name] = MaskedColumn(filled, mask=mask, unit=UNITS.get(name))
    return table


def summary_picture(outcomes: Sequence[Outcome]) -> Figure | None:
    """Draw all limits and detected companions; None where there is neither."""
    done = {o.name: o.content for o in outcomes if o.content is not None}
    drawn = {name: _curve(content) for name, content in done.items()}
    curves = {n: c for n, c in drawn.items() if c is not None and np.isfinite(c.delta_mag).any()}
    found = {n: _found(c) for n, c in done.items() if _at(c, "significance.detected")}
    return survey_plot(curves, found) if curves or found else None


def _found(content: Json) -> Found:
    fit, errors = content["fit"], content["fit"]["errors"]
    numbers = (*(fit[n] for n in _PLACE), *(errors[n] for n in _PLACE))
    return Found(*(math.nan if x is None else float(x) for x in numbers))


_PLACE = ("separation_mas", "delta_mag")


def write_summary(content: Json, folder: Path) -> None:
    """Write ``summary.json`` and ``summary.ecsv``, each whole or not at all."""
    with atomic_path(folder / TABLE_NAME) as temporary:
        summary_table(content).write(temporary, format="ascii.ecsv", overwrite=True)
    write_json(folder / JSON_NAME, content)


def write_picture(outcomes: Sequence[Outcome], folder: Path) -> None:
    """Draw ``summary.png``; where there is nothing to draw, no older one stays."""
    figure = summary_picture(outcomes)
    if figure is None:
        (folder / PICTURE_NAME).unlink(missing_ok=True)
    else:
        save(figure, folder / PICTURE_NAME)


def summary_lines(content: Json, folder: Path) -> list[str]:
    """List the targets, failed ones first, in at most 20 lines."""
    entries = sorted(content["targets"], key=lambda e: e["status"] != "failed")
    width = max(len(e["name"]) for e in entries)
    lines = [f"{e['name']:<{width}}  {_outcome(e)}" for e in entries]
    head = f"targets     {content['n_done']} of {content['n_targets']} done"
    head += f", {content['n_failed']} failed" if content["n_failed"] else ""
    last = [row("written to", str(folder))]
    return shortened([head, *lines], last, f"and {{}} more in {TABLE_NAME}")


def _outcome(entry: Json) -> str:
    if entry["status"] != "done":
        return f"FAILED: {entry['error']}" if entry["status"] == "failed" else "not yet done"
    parts = []
    if "detected" in entry:
        parts.append(_verdict(entry))
    if "limit_delta_mag" in entry:
        low, high = entry["limit_delta_mag_worst"], entry["limit_delta_mag_best"]
        parts.append(f"limits {low:.2f} to {high:.2f} mag")
    return ", ".join(parts) or "done"


def _verdict(entry: Json) -> str:
    verdict = {True: "DETECTED", False: "not detected", None: "not tested"}[entry["detected"]]
    if entry["detected"] is False or entry.get("separation_mas") is None:
        return verdict
    return (
        f"{verdict} at {entry['separation_mas']:.4g} mas, {entry['position_angle_deg']:.1f} deg, "
        f"{entry['delta_mag']:.2f} mag"
    )
