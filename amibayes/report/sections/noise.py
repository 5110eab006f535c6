"""The section of ``report.html`` on the noise: what was added to the errors, and outliers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from amibayes.report.page import Column, Section, Table
from amibayes.report.words import count, fixed, plain, tail
from amibayes.support.atomic_files import short_names

Json = dict[str, Any]

KINDS = {"extra_vis2": "V²", "extra_closure_phase_deg": "closure phase (°)"}

MAX_OUTLIERS = 20
"""Rows of the table; the rest is in result.json."""


def noise(content: Json) -> Section:
    """Show whether the stated errors explain the residuals, and the noise that was added."""
    found = content["noise"]
    tables = (*_posterior(found.get("posterior")), *_outliers(content.get("robust")))
    charge = _charge_migration(found.get("charge_migration"))
    text = (_added(found), *charge, *_robust(content.get("robust")))
    return Section("Noise", text, tables=tables)


def _added(found: Json) -> str:
    vis2, closure = found["extra_vis2"], found["extra_closure_phase_deg"]
    if not vis2 and not closure:
        return "The stated errors explain the residuals: no noise was added."
    kinds = "extra_vis2", "extra_closure_phase_deg"
    own = [f for f in found.get("files", ()) if any(f[kind] for kind in kinds)]
    names = short_names([f["path"] for f in own])
    amounts = [_amount(f, f" to {name}") for name, f in zip(names, own, strict=True)]
    return (
        f"The stated errors do not explain the residuals: noise of "
        f"{'; '.join(amounts or [_amount(found)])} was added in quadrature, and every χ² and error "
        "on this page includes it."
    )


def _amount(found: Json, to: str = "") -> str:
    vis2, closure = found["extra_vis2"], found["extra_closure_phase_deg"]
    return f"{plain(vis2, 2)} in V² and {plain(closure, 2)}° in closure phase{to}"


def _charge_migration(found: Json | None) -> tuple[str, ...]:
    """Say what was taken out of images, and where its strength is from."""
    if not found:
        return ()
    if found["source"] == "off":
        return ("Charge migration between pixels was not taken out of the images.",)
    origin = {"fit": "fitted to the ramps", "instrument": "of the instrument's file"}
    whence = origin.get(found["source"], found["source"])
    text = (
        f"Charge migration of {_per_e(found['value_per_e'], found['error_per_e'])} pixels per "
        f"electron ({whence}) was taken out of the images; what its error does to target and "
        "calibrators alike is in the covariance."
    )
    return (text + _explained(found) + _narrowed(found),)


def _per_e(value: float, error: float) -> str:
    return f"({fixed(1e7 * value, 2)} ± {fixed(1e7 * error, 2)}) · 10⁻⁷"


def _narrowed(found: Json) -> str:
    """Say what calibrators of different charge have made of the value."""
    value, error = found.get("narrowed_value_per_e"), found.get("narrowed_error_per_e")
    if value is None or error is None:
        return ""
    return (
        f" Calibrators whose charges differ tell it as well: {_per_e(value, error)} with both "
        "together, which target and calibrators were then corrected with."
    )


def _explained(found: Json) -> str:
    """Say whether migration explains how the ramps change; nothing where none were fitted."""
    p, bend = found.get("p_value"), found.get("p_value_bend")
    if p is None or bend is None:
        return ""
    text = (
        " Were it all that changes along the ramps, these would be as far from the fit with a "
        f"probability of {tail(p)} (changes of the current) and {tail(bend)} (other bends)."
    )
    return text if found["explained"] else f"{text} The ramps change in other ways too."


def _posterior(found: Json | None) -> tuple[Table, ...]:
    if not found:
        return ()
    rows = tuple(
        (
            KINDS[key],
            plain(q["median"]),
            f"{plain(q['lower'])} to {plain(q['upper'])}",
            f"{plain(q['lower_95'])} to {plain(q['upper_95'])}",
            tail(q["probability_errors_right"]),
        )
        for key, q in found.items()
    )
    columns = (
        Column("Extra noise in", "text"),
        Column("Median"),
        Column("68 %"),
        Column("95 %"),
        Column("Errors right"),
    )
    caption = (
        "Posterior of the extra noise, over which posterior and evidences are averaged; the last "
        "column is the probability that the stated errors are right"
    )
    return (Table(caption, columns, rows),)


def _robust(found: Json | None) -> tuple[str, ...]:
    if not found:
        return ()
    return (
        "Residuals were taken to follow Student's law with "
        f"{plain(found['degrees_of_freedom'])} degrees of freedom, by which outliers lose their "
        f"weight: {count(len(found['outliers']), 'datum', 'data')} lost most of it.",
    )


def _outliers(found: Json | None) -> tuple[Table, ...]:
    if not found or not found["outliers"]:
        return ()
    rows = tuple(
        (
            KINDS[f"extra_{o['kind']}{'_deg' * (o['kind'] != 'vis2')}"].split(" (")[0],
            "-".join(o["stations"]),
            fixed(o["wavelength_m"] * 1e6, 3),
            fixed(o["mjd"], 4),
            fixed(o["residual"], 1),
            plain(o["weight"], 2),
            Path(o["source"]).name,
        )
        for o in found["outliers"][:MAX_OUTLIERS]
    )
    columns = (
        Column("Outlier", "text"),
        Column("Stations", "text"),
        Column("λ (µm)"),
        Column("MJD"),
        Column("Residual (σ)"),
        Column("Weight kept"),
        Column("File", "code"),
    )
    left = len(found["outliers"]) - len(rows)
    more = f"; {left} more in result.json" if left else ""
    return (Table(f"Data that lost most of their weight{more}", columns, rows),)
