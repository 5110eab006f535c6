"""What a survey writes: ``survey.json``, ``survey.ecsv``, and words for the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amibayes.detection.verdict import REFUSED
from amibayes.support.atomic_files import atomic_path, write_json
from amibayes.support.terminal import row, shortened
from amibayes.survey.rows import table_of

Json = dict[str, Any]

JSON_NAME, TABLE_NAME, PAGE_NAME = "survey.json", "survey.ecsv", "survey.html"


def write_survey(content: Json, folder: Path) -> None:
    """Write ``survey.json`` and ``survey.ecsv``, each whole or not at all."""
    meta = {k: content[k] for k in ("amibayes", "command", "seed")}
    with atomic_path(folder / TABLE_NAME) as temporary:
        table_of(content["targets"], meta).write(temporary, format="ascii.ecsv", overwrite=True)
    write_json(folder / JSON_NAME, content)


def survey_lines(content: Json, folder: Path) -> list[str]:
    """List the targets, failed ones first, in at most 20 lines."""
    entries = sorted(content["targets"], key=lambda e: e["status"] != "failed")
    width = max(len(e["name"]) for e in entries)
    lines = [f"{e['name']:<{width}}  {_outcome(e)}" for e in entries]
    head = f"targets     {content['n_done']} of {content['n_targets']} done"
    head += f", {content['n_failed']} failed" if content["n_failed"] else ""
    last = [row("written to", str(folder))]
    return shortened([head, *_together(content), *lines], last, f"and {{}} more in {TABLE_NAME}")


def _together(content: Json) -> list[str]:
    lines = []
    if alarms := content.get("false_alarms"):
        lines.append(
            row(
                "companions",
                f"{len(alarms['discovered'])} listed at a false-discovery rate of "
                f"{alarms['false_discovery_level']:g}; survey-wide false-alarm probability of the "
                f"best {alarms['survey_wide_probability']:.2g}",
            )
        )
    if frequency := content.get("companion_frequency"):
        low, high = frequency["interval_68"]
        (inner, outer), (_, faint) = frequency["separation_mas"], frequency["delta_mag"]
        lines.append(
            row(
                "frequency",
                f"{frequency['median']:.3g} ({low:.3g} to {high:.3g}, 68 %) of stars with a "
                f"companion at {inner:.3g} to {outer:.3g} mas, to {faint:.3g} mag",
            )
        )
    return lines


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
    if entry.get("verdict") in REFUSED:
        return str(entry["verdict"])
    verdict = {True: "DETECTED", False: "not detected", None: "not tested"}[entry["detected"]]
    if entry["detected"] is False or entry.get("separation_mas") is None:
        return verdict
    return (
        f"{verdict} at {entry['separation_mas']:.4g} mas, {entry['position_angle_deg']:.1f} deg, "
        f"{entry['delta_mag']:.2f} mag"
    )
