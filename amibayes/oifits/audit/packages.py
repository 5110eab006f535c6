"""Errors that are known mistakes of other packages, recognised by their numbers.

The `ami` steps of the JWST pipeline (read in its source, October 2024 to 2025, jwst 1.17 on):
VIS2ERR is 2·VISAMP·VISAMPERR divided by √N_int although VISAMPERR is a standard error of the
mean already; T3PHIERR and VISPHIERR are the scatter across the mean phasor, in amplitude, and
were not divided by that amplitude to make an angle; and `ami_normalize` exchanges the errors
of target and calibrator when it divides V².
"""

from __future__ import annotations

import numpy as np

from amibayes.oifits.audit.finding import Finding, Findings, column, data_tables, radians, unflagged
from amibayes.oifits.audit.values import value_and_error
from amibayes.oifits.columns import same
from amibayes.oifits.products import IMPLANEIA
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import FloatArray

EXACT = 1e-3
"""Numbers that follow from each other agree to this (single precision and rounding)."""


def is_normalized(oifits: OIFits) -> bool:
    """Whether `ami_normalize` wrote the file: it keeps the pistons of target and calibrator."""
    return any({"PISTON_T", "PISTON_C"} <= set(t.columns) for t in oifits.named("OI_ARRAY"))


def amplitude_ratio(oifits: OIFits, table: OITable) -> FloatArray | None:
    """2·VISAMP·VISAMPERR / VIS2ERR of every usable V², where OI_VIS has the same rows."""
    partner = next(
        (
            t
            for t in oifits.named("OI_VIS")
            if same(t.keyword("INSNAME"), table.keyword("INSNAME")) and len(t) == len(table)
        ),
        None,
    )
    if partner is None:
        return None
    amplitude, sigma = column(partner, "VISAMP"), column(partner, "VISAMPERR")
    error = column(table, "VIS2ERR")
    if amplitude is None or sigma is None or error is None or amplitude.shape != error.shape:
        return None
    if not _same_baselines(table, partner):
        return None
    used = unflagged(table, error.shape) & (sigma > 0) & (error > 0) & (amplitude > 0)
    return (2 * amplitude * sigma)[used] / error[used] if used.any() else None


def _same_baselines(table: OITable, partner: OITable) -> bool:
    ours, others = column(table, "STA_INDEX"), column(partner, "STA_INDEX")
    return ours is not None and others is not None and np.array_equal(ours, others)


def vis2_errors_divided_twice(oifits: OIFits) -> Findings:
    """VIS2ERR too small by √N_int: the ratio is one number, and its square is an integer."""
    for table, kind in data_tables(oifits):
        ratio = None if kind.is_angle else amplitude_ratio(oifits, table)
        if ratio is None or len(ratio) < 5 or np.ptp(ratio) > EXACT * ratio.max():
            continue
        n = round(float(np.median(ratio)) ** 2)
        if n >= 2 and abs(np.median(ratio) - np.sqrt(n)) < EXACT * np.sqrt(n):
            yield Finding(
                "error",
                "vis2-error-divided-twice",
                table.label,
                f"VIS2ERR is 2·VISAMP·VISAMPERR divided by √{n}",
                f"the error of the mean over {n} integrations was divided by √{n} again (jwst ami)",
                f"multiply VIS2ERR by √{n}",
                certain=True,
            )


def exchanged_errors(oifits: OIFits) -> Findings:
    """V² errors of a normalized file that do not follow from those of the amplitudes."""
    if not is_normalized(oifits):
        return
    for table, kind in data_tables(oifits):
        ratio = None if kind.is_angle else amplitude_ratio(oifits, table)
        if ratio is not None and len(ratio) >= 5 and np.ptp(ratio) > 20 * EXACT * ratio.max():
            yield Finding(
                "error",
                "exchanged-errors",
                table.label,
                "VIS2ERR does not follow from VISAMPERR "
                f"(2·VISAMP·VISAMPERR/VIS2ERR from {ratio.min():.3g} to {ratio.max():.3g})",
                "the errors of target and calibrator were exchanged when V² was divided "
                "(jwst ami_normalize)",
                "calibrate the uncalibrated files again (amibayes calibrate)",
            )


def phase_errors_times_amplitude(oifits: OIFits) -> Findings:
    """T3PHIERR that is a scatter of amplitude, not of angle.

    For noise that is alike along and across the phasor, σ(phase) = σ(amplitude)/amplitude. A
    file that was not divided has σ(phase) = σ(amplitude) instead: the two are told apart by
    how the ratio of the errors runs with the amplitude over the triangles.
    """
    for table, kind in data_tables(oifits):
        pair = value_and_error(table, kind) if kind.is_angle else None
        amplitude, sigma = column(table, "T3AMP"), column(table, "T3AMPERR")
        across = radians(table, "T3PHIERR")
        if pair is None or amplitude is None or sigma is None or across is None:
            continue
        if amplitude.shape != across.shape or sigma.shape != across.shape:
            continue
        used = unflagged(table, across.shape) & (sigma > 0) & (across > 0) & (amplitude > 0)
        if used.sum() < 10 or np.std(np.log(amplitude[used])) < 0.1:
            continue
        undivided = np.log(across[used] / sigma[used])
        divided = undivided + np.log(amplitude[used])
        spread = [float(np.median(np.abs(x))) for x in (undivided, divided)]
        if spread[0] < 0.25 and spread[0] < spread[1] / 2:
            yield Finding(
                "warning",
                "phase-error-times-amplitude",
                table.label,
                "T3PHIERR in radians equals T3AMPERR, whatever the amplitude "
                f"(median departure {100 * spread[0]:.0f} %)",
                "the scatter across the phasor was not divided by its amplitude, so that the "
                "errors are too small (jwst ami 1.17 on)",
                "divide T3PHIERR by T3AMP",
            )


def scatter_of_integrations(oifits: OIFits) -> Findings:
    """Averages of ImPlaneIA, whose errors are standard deviations over the integrations."""
    if not any(IMPLANEIA in t.columns for t in oifits.named("OI_ARRAY")):
        return
    for table, kind in data_tables(oifits):
        pair = value_and_error(table, kind)
        if pair is not None and (pair[1] > 0.0).any():
            yield Finding(
                "warning",
                "scatter-of-integrations",
                table.label,
                "written by ImPlaneIA, whose errors are the scatter of the integrations",
                "the mean of N integrations is known better by √N, and N is not in the file",
                "give the file of its integrations instead, whose covariance is measured",
            )


CHECKS = (
    scatter_of_integrations,
    vis2_errors_divided_twice,
    exchanged_errors,
    phase_errors_times_amplitude,
)
