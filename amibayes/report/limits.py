"""What `amibayes limits` writes: ``limits.json``, ``limits.ecsv`` and the summary."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.table import Table

from amibayes import __version__
from amibayes.companion_search.field import resolution_mas
from amibayes.limits.limit import Limit
from amibayes.pipeline.limits import NAMES, LimitsReport, MeasuredLimit
from amibayes.report.common import Json, data_json, inputs_json, number, numbers
from amibayes.report.models import models_json
from amibayes.report.noise import migration_json
from amibayes.report.words import percent
from amibayes.support.atomic_files import atomic_path
from amibayes.support.terminal import row, with_warnings
from amibayes.units import contrast_to_delta_mag


def limits_json(limits: Limit) -> Json:
    """Build the content of ``limits`` in ``result.json``; null where no contrast will do."""
    out: Json = {
        "method": limits.method,
        "separation_mas": list(limits.separation_mas),
        "delta_mag": numbers(limits.delta_mag),
        "contrast": numbers(limits.contrast),
        "delta_mag_spread": [numbers(row) for row in contrast_to_delta_mag(limits.spread)],
    }
    facts = {k: numbers(v) if isinstance(v, np.ndarray) else v for k, v in limits.facts().items()}
    return out | facts


def limits_report_json(report: LimitsReport, request: str = "") -> Json:
    """Build the content of ``limits.json``: the main limit, all of them, and the map.

    Parameters
    ----------
    report : LimitsReport
    request : str
        Digest of all that the answer depends on.
    """
    main = report.main
    return {
        "amibayes": __version__,
        "seed": report.options.search.seed,
        "request": request,
        "inputs": inputs_json(report.targets, report.calibrators),
        "data": data_json(main.result, main.found.left_out),
        "noise": {
            "extra_vis2": main.noise.vis2,
            "extra_closure_phase_deg": float(np.degrees(main.noise.closure_phase_rad)),
            "charge_migration": migration_json(report.charge_migration, report.calibration),
        },
        "companion_detected": None if main.significance is None else main.significance.detected,
        **_curve(main, report),
        "curves": [_curve(limit, report) for limit in report.limits],
        "completeness_map": map_json(main.limit),
        **beside_json(report),
        "warnings": list(report.warnings),
    }


def beside_json(report: LimitsReport) -> Json:
    """Comparison of models and the limit beside a stated disc; empty where none were asked for."""
    if report.models is None:
        return {}
    beside = report.beside
    limit = None if beside is None else {"model": beside.model, **limits_json(beside.limit)}
    return models_json(report.models, None) | {"limits_beside": limit}


def _curve(measured: MeasuredLimit, report: LimitsReport) -> Json:
    limit, fringe = measured.limit, resolution_mas(measured.result.likelihood)
    out: Json = {
        "observables": list(measured.observables),
        "n_independent": measured.result.likelihood.n_independent,
        "lambda_over_b_mas": fringe,
        **limits_json(limit),
    }
    if report.options.masses is not None:
        out["mass"] = numbers(report.options.masses.mass_at(limit.delta_mag))
        out["mass_unit"] = report.options.masses.unit
        out["mass_table_delta_mag"] = report.options.masses.delta_mag[[0, -1]].tolist()
    return out


def map_json(limit: Limit) -> Json | None:
    """Completeness of every cell, with its Jeffreys interval; null for closed criteria."""
    cells = limit.cells()
    return cells and cells | {"completeness": [numbers(row) for row in cells["completeness"]]}


def limits_table(report: LimitsReport) -> Table:
    """Tabulate all curves; columns carry units, and the observables in their names."""
    main = report.main
    table = Table()
    table["separation"] = main.limit.separation_mas
    table["separation"].unit = "mas"
    table["separation_lambda_over_b"] = main.limit.separation_mas / resolution_mas(
        main.result.likelihood
    )
    for measured in report.limits:
        _add_columns(table, measured, report)
    table.meta = {
        "amibayes": __version__,
        "method": report.options.criterion,
        "seed": report.options.search.seed,
    }
    return table


def _add_columns(table: Table, measured: MeasuredLimit, report: LimitsReport) -> None:
    limit, name = measured.limit, "_".join(measured.observables)
    columns = {"delta_mag": limit.delta_mag}
    columns |= {
        f"delta_mag_{percent}": contrast_to_delta_mag(spread)
        for percent, spread in zip(("p16", "p50", "p84"), limit.spread.T, strict=True)
    }
    columns |= {key.replace("_50", "_c50"): values for key, values in limit.columns().items()}
    if limit.cells() is not None:
        table[f"by_detection_{name}"] = limit.by_detection
    for key, values in columns.items():
        table[f"{key}_{name}"] = values
        table[f"{key}_{name}"].unit = "mag"
        table[f"{key}_{name}"].description = _meaning(key, measured)
    if report.options.masses is not None:
        table[f"mass_{name}"] = report.options.masses.mass_at(limit.delta_mag)
        table[f"mass_{name}"].description = f"in {report.options.masses.unit}"


MEANINGS = {
    "delta_mag": "limit, mean over the position angle",
    "delta_mag_p16": "16 % point over the position angle of the limit",
    "delta_mag_p50": "50 % point over the position angle of the limit",
    "delta_mag_p84": "84 % point over the position angle of the limit",
    "delta_mag_error": "1 sigma of the limit",
    "delta_mag_c50": "recovered half of the time",
    "delta_mag_c50_error": "1 sigma of what is recovered half of the time",
}
"""What the columns of ``limits.ecsv`` hold, by the beginnings of their names."""


def _meaning(key: str, measured: MeasuredLimit) -> str:
    """Words for a column: what it holds, at which completeness, from which data."""
    share = measured.limit.facts()["completeness"]
    level = f", {percent(share)} recovered" if share and "c50" not in key else ""
    return f"{MEANINGS.get(key, key)}{level}, from {NAMES[measured.observables]}"


def write_limits_table(path: str | Path, report: LimitsReport) -> None:
    """Write the table as ECSV, whole or not at all."""
    with atomic_path(path) as temporary:
        limits_table(report).write(temporary, format="ascii.ecsv", overwrite=True)


def limits_summary(content: Json, folder: Path) -> list[str]:
    """Sum ``limits.json`` up in at most 20 lines."""
    data = content["data"]
    lines = [
        f"data        {data['n_vis2']} V2, {data['n_closure_phases']} "
        f"{data.get('phases', 'closure phase')}s, "
        f"{data['n_independent']} independent ({data['covariance']} covariance)",
        f"method      {content['method']}: {content['criterion']}",
        *_rate_lines(content),
        *(_curve_line(curve) for curve in content["curves"]),
        *_marked_lines(content),
        *_beside_lines(content),
    ]
    return with_warnings(lines, content["warnings"], row("written to", str(folder)), "limits.json")


def _beside_lines(content: Json) -> list[str]:
    """The statement among models, and the limit beside the disc that is stated."""
    if "limits_beside" not in content:
        return []
    line = f"models      {content['model_verdict']['statement']}"
    beside = content["limits_beside"]
    if beside is None:
        return [f"{line}: no limit beside a disc or a ring, of which none is stated"]
    known = [m for m in beside["delta_mag"] if m is not None]
    span = f"{min(known):.2f} to {max(known):.2f}" if known else "none in this field"
    return [f"{line}; delta mag of companions beside it {span}"]


def _rate_lines(content: Json) -> list[str]:
    if content["completeness"] is None:
        return []
    low, high = content["false_positive_interval"]
    return [
        f"limit       {percent(content['completeness'])} of companions recovered, "
        f"false-positive rate {content['false_positive_rate']:.2g} "
        f"(95 %: {low:.2g} to {high:.2g}); {content['n_trials']} companions injected"
    ]


def _curve_line(curve: Json) -> str:
    name = NAMES[tuple(curve["observables"])]
    usable = [
        (rho, mag)
        for rho, mag in zip(curve["separation_mas"], curve["delta_mag"], strict=True)
        if mag is not None
    ]
    if not usable:
        return f"{name:<11} no limit in this field"
    rho, mag = zip(*usable, strict=True)
    line = f"{name:<11} delta mag {min(mag):.2f} to {max(mag):.2f} at {rho[0]:.0f} to "
    line += f"{rho[-1]:.0f} mas"
    return line + _mass_words(curve, len(usable)) if "mass" in curve else line


def _mass_words(curve: Json, n_limits: int) -> str:
    """Masses of the limits, and how many of these lie outside the table of masses."""
    masses = [m for m in curve["mass"] if m is not None]
    words = f", mass {min(masses):.3g} to {max(masses):.3g} {curve['mass_unit']}" if masses else ""
    if beyond := n_limits - len(masses):
        low, high = curve["mass_table_delta_mag"]
        words += f"; {beyond} of {n_limits} outside the table of masses ({low:.4g} to {high:.4g})"
    return words


def _marked_lines(content: Json) -> list[str]:
    at = [
        rho
        for rho, how in zip(
            content["separation_mas"], content.get("criterion_at", []), strict=False
        )
        if how == "detection"
    ]
    if not at:
        return []
    return [
        f"aliases     at {len(at)} of {len(content['separation_mas'])} separations, from "
        f"{at[0]:.0f} mas, these baselines take positions for ones nearer in: there a companion "
        "counts wherever it is seen"
    ]


__all__ = [
    "limits_json",
    "limits_report_json",
    "limits_summary",
    "limits_table",
    "number",
    "write_limits_table",
]
