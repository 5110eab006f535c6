"""Whether the numbers can be meant: times, wavelengths, V², phases, errors, flags."""

from __future__ import annotations

import numpy as np

from amibayes.oifits.audit.finding import (
    DATA_TABLES,
    Finding,
    Findings,
    column,
    count,
    data_tables,
    radians,
    unflagged,
)
from amibayes.oifits.dates import mjd_of_date
from amibayes.oifits.rows import Kind, blank, times_of, unusable
from amibayes.oifits.scales import LENGTH, TIME, scale_of
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import FloatArray

FAR_OFF = 5.0
"""V² this many errors outside 0…1 are no chance among less than a million."""

NIGHT_S = 12 * 3600.0

ALL_WAVELENGTHS_M = (1e-7, 1e-3)


def value_and_error(table: OITable, kind: Kind) -> tuple[FloatArray, FloatArray] | None:
    """Values and errors, (rows, channels), in SI and radians; None where shapes do not fit."""
    if kind.is_angle:
        value, error = radians(table, kind.value), radians(table, kind.error)
    else:
        value, error = column(table, kind.value), column(table, kind.error)
    if value is None or error is None or value.shape != error.shape:
        return None
    return value, error


def wavelengths(oifits: OIFits) -> Findings:
    """EFF_WAVE that is no wavelength, EFF_BAND that is no width."""
    for table in oifits.named("OI_WAVELENGTH"):
        for name, limits in (("EFF_WAVE", ALL_WAVELENGTHS_M), ("EFF_BAND", (0.0, 1e-3))):
            values = column(table, name)
            if values is None:
                continue
            metres = values * scale_of(table.units[name], LENGTH, "m")[0]
            with np.errstate(invalid="ignore"):
                good = (metres > limits[0]) & (metres < limits[1])
            if not good.all():
                yield Finding(
                    "error" if name == "EFF_WAVE" else "warning",
                    "wavelength",
                    table.label,
                    f"{count(int((~good).sum()), 'channel')} with {name} that is not in "
                    f"({limits[0]:g}, {limits[1]:g}) m",
                    "baselines in wavelengths, or bandwidth smearing, will be wrong",
                    _in_metres(metres[~good]),
                )


def _in_metres(numbers: FloatArray) -> str:
    """What to do about wavelengths that are none in metres."""
    for unit, scale in (("micron", 1e-6), ("nm", 1e-9), ("ångström", 1e-10)):
        metres = numbers * scale
        if ((metres > 1e-9) & (metres < 3e-5)).all():
            return f"give metres: they look like {unit}, to be multiplied by {scale:g}"
    return "give metres"


def dates(oifits: OIFits) -> Findings:
    """MJD that is no date, or another than DATE-OBS."""
    for table in (t for t in oifits.tables if t.name in DATA_TABLES and len(t)):
        mjd, note = times_of(table)
        if note:
            yield Finding(
                "warning",
                "date",
                table.label,
                note.split(": ")[1],
                "programs that go by MJD mix up the exposures",
                "write the full date into MJD",
                certain=not note.endswith("no date"),
            )
        night = table.keyword("DATE-OBS")
        written = mjd_of_date(night)
        if np.isnan(written):
            if night:
                yield _wrong_date(table, f"DATE-OBS {night!r} is no date")
            continue
        apart = np.abs(mjd - written - 0.5)
        if np.isfinite(apart).all() and apart.min() > 2.0:
            yield _wrong_date(table, f"MJD {mjd.min():.1f} is not the night of {night}")


def integration_times(oifits: OIFits) -> Findings:
    """INT_TIME that is negative, not finite or longer than a night."""
    for table in (t for t in oifits.tables if t.name in DATA_TABLES and len(t)):
        seconds = column(table, "INT_TIME")
        if seconds is None:
            continue
        seconds = seconds * scale_of(table.units["INT_TIME"], TIME, "s")[0]
        bad = ~((seconds >= 0) & (seconds < NIGHT_S))
        if bad.any():
            yield Finding(
                "warning",
                "integration-time",
                table.label,
                f"{count(int(bad.sum()), 'row')} with INT_TIME that is negative, not finite or "
                f"over {NIGHT_S / 3600:.0f} h (up to {np.nanmax(seconds):.0f} s)",
                "weights and simultaneity that rest on it are wrong",
                "give the integration time of each row in seconds",
            )


def _wrong_date(table: OITable, what: str) -> Finding:
    return Finding(
        "warning",
        "date",
        table.label,
        what,
        "epochs and calibrators are matched by date",
        "correct the date",
    )


def unusable_unflagged(oifits: OIFits) -> Findings:
    """Values or errors that cannot be meant and are not flagged."""
    for table, kind in data_tables(oifits):
        pair = value_and_error(table, kind)
        if pair is None:
            continue
        value, error = pair
        used = unflagged(table, value.shape)
        with np.errstate(over="ignore", invalid="ignore"):
            bad = unusable(kind, value, np.where(error > 0, error**2, np.nan)) & used
        if not used.any():
            yield Finding(
                "error",
                "all-flagged",
                table.label,
                "every value is flagged",
                "nothing can be fitted",
                "check FLAG",
            )
        elif bad.any():
            yield Finding(
                "error",
                "unusable-unflagged",
                table.label,
                f"{count(int(bad.sum()), 'value')} of {kind.value} not finite, or with an error "
                "that is not finite, not positive or impossible, and not flagged",
                "a fit stops, or gives them infinite weight",
                "flag them",
                certain=True,
            )


def blank_phases(oifits: OIFits) -> Findings:
    """Closure phases that are 0 throughout a table."""
    for table, kind in data_tables(oifits):
        value = column(table, kind.value)
        if value is not None and blank(kind, value):
            yield Finding(
                "error",
                "blank-phases",
                table.label,
                f"every closure phase is exactly 0 ({count(value.size, 'value')})",
                "none was measured, and a fit takes them for a star without a companion",
                "flag them, or leave the table out",
            )


def vis2_range(oifits: OIFits) -> Findings:
    """V² above 1 or below 0 beyond their errors."""
    for table, kind in data_tables(oifits):
        pair = value_and_error(table, kind)
        if kind.is_angle or pair is None:
            continue
        value, error = pair
        used = unflagged(table, value.shape) & np.isfinite(value) & (error > 0)
        with np.errstate(invalid="ignore"):
            above = used & (value - 1 > FAR_OFF * error)
            below = used & (value < -FAR_OFF * error)
        if above.any():
            yield Finding(
                "error" if np.nanmax(value[above]) > 10 else "warning",
                "vis2-above-one",
                table.label,
                f"{count(int(above.sum()), 'value')} of V² more than {FAR_OFF:g}σ above 1 "
                f"(up to {value[above].max():.4g})",
                "V² of a source is at most 1: not calibrated, a resolved or variable calibrator, "
                "or errors that are too small",
                "check the calibration; use closure phases alone if in doubt",
            )
        if below.any():
            yield Finding(
                "warning",
                "vis2-negative",
                table.label,
                f"{count(int(below.sum()), 'value')} of V² more than {FAR_OFF:g}σ below 0",
                "the bias was overcorrected, or errors are too small",
                "check the bias correction",
            )


def phase_range(oifits: OIFits) -> Findings:
    """Closure phases beyond a turn."""
    for table, kind in data_tables(oifits):
        phase = radians(table, kind.value) if kind.is_angle else None
        if phase is None:
            continue
        used = unflagged(table, phase.shape) & np.isfinite(phase)
        beyond = used & (np.abs(phase) > 2 * np.pi * (1 + 1e-9))
        if beyond.any():
            yield Finding(
                "error",
                "phase-range",
                table.label,
                f"{count(int(beyond.sum()), 'closure phase')} beyond ±360° "
                f"(up to {np.degrees(np.abs(phase[beyond]).max()):.0f}°)",
                "these are no degrees",
                "check the unit of T3PHI",
            )


CHECKS = (
    wavelengths,
    dates,
    integration_times,
    unusable_unflagged,
    blank_phases,
    vis2_range,
    phase_range,
)
