"""The content of ``noise`` in ``result.json``: extra noise, and what images were freed of."""

from __future__ import annotations

import numpy as np

from amibayes.calibration import Calibration
from amibayes.extraction.charge import CubeMigration
from amibayes.pipeline.report_types import SearchReport
from amibayes.report.common import (
    NOISE_KEYS,
    Json,
    channel_correlation_json,
    in_errors_json,
    noise_interval,
    systematics_json,
)
from amibayes.report.joint import noise_files_json
from amibayes.support.terminal import row


def noise_json(report: SearchReport) -> Json:
    """Extra noise, the most likely and its posterior, and charge migration."""
    found = report.noise_posterior or {}
    posterior = {
        key: noise_interval(found[name], unit)
        for name, (key, unit) in NOISE_KEYS.items()
        if name in found
    }
    return {
        "extra_vis2": report.noise.vis2,
        "extra_closure_phase_deg": float(np.degrees(report.noise.closure_phase_rad)),
        "channel_correlation": channel_correlation_json(report.noise),
        "systematics": systematics_json(report.noise),
        **in_errors_json(report.noise, report.observables.only(report.options.observables)),
        "posterior": posterior or None,
        "charge_migration": migration_json(report.charge_migration, report.calibration),
        **noise_files_json(report),
    }


def migration_json(charge: CubeMigration | None, calibration: Calibration | None) -> Json | None:
    """What was taken out of images, and what calibrators of other charge made of its value.

    Parameters
    ----------
    charge : CubeMigration, optional
        None without image cubes, and files that were made of them.
    calibration : Calibration, optional
    """
    if charge is None:
        return None
    found = charge.as_json()
    told = None if calibration is None else calibration.told
    steps = {} if charge.migration is None else charge.migration.steps
    number = None if told is None else told.number(steps)
    value, error = (None, None) if number is None else number
    narrowed = None if value is None else found["value_per_e"] + value
    return found | {"narrowed_value_per_e": narrowed, "narrowed_error_per_e": error}


def migration_lines(found: Json | None) -> list[str]:
    """Line of a summary on what was taken out of images; none where there were none."""
    if found is None:
        return []
    if found["source"] == "off":
        return [row("migration", "charge migration not taken out")]
    origin = {"fit": "fitted to ramps", "instrument": "of the instrument's file"}
    text = (
        f"{_per_e(found['value_per_e'], found['error_per_e'])} pixels per electron taken out, "
        f"{origin.get(found['source'], found['source'])}"
    )
    if "p_value" in found:
        text += f", p = {found['p_value']:.2g}"
    if found["narrowed_value_per_e"] is not None:
        narrowed = _per_e(found["narrowed_value_per_e"], found["narrowed_error_per_e"])
        text += f"; {narrowed} with what calibrators tell"
    return [row("migration", text)]


def _per_e(value: float, error: float) -> str:
    return f"{1e7 * value:.2f} ± {1e7 * error:.2f} e-7"
