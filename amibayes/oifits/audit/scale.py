"""Numbers in another unit than the file says, recognised by other numbers of the same file."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from importlib import resources

import numpy as np

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup
from amibayes.oifits.audit.finding import (
    Finding,
    Findings,
    column,
    count,
    data_tables,
    unflagged,
)
from amibayes.oifits.audit.geometry import SAME_UV, SIMULTANEOUS_D, unflagged_rows
from amibayes.oifits.audit.values import value_and_error
from amibayes.oifits.columns import same
from amibayes.oifits.products import IMPLANEIA
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import BoolArray, FloatArray, IntArray

MIN_PHASES = 10
PILE_RAD = 0.3
"""Phases this near to ±π and none beyond: a pile there is the end of the circle …"""

MIN_PILE = 5

SCATTER = 0.04
"""Scatter in units of the errors below which T3PHI is in radians: 1/57 = 0.017, while channels
that err together leave 0.25 of public files at least (AMBER)."""

NO_NOISE = 0.003
"""… and down to which there is noise at all: images of contests have none."""

SAME_SCALE = 1.0 + SAME_UV
"""(u, v) agree with station positions to this factor: with 2e-4 in public files …"""

MAX_LEFT = 0.05
"""… and are a map of them but for this part: 0.014 in public files."""

MIN_PLANE = 0.1
"""Breadth of an array, of its length, from which the map of stations to (u, v) has two axes."""


def phases_that_are_radians(oifits: OIFits) -> Findings:
    """Numbers given as degrees that look like radians.

    Three signs: wrapped phases that fill ±π, or pile up there, and end; errors that are 57 times
    too small for those of V² (independent baselines: σ(CP) = √3 σ(V²)/2V²) with phases inside
    ±π; and phases inside ±π that scatter 57 times less than errors in degrees say.
    """
    for table, kind in data_tables(oifits):
        if not kind.is_angle or table.units.get(kind.value, "").lower().startswith("rad"):
            continue
        number, error = column(table, kind.value), column(table, kind.error)
        if number is None or error is None or number.shape != error.shape:
            continue
        used = unflagged(table, number.shape) & np.isfinite(number) & (error > 0)
        phases = np.abs(number[used])
        if len(phases) < MIN_PHASES or phases.max() > np.pi * (1 + 1e-6):
            continue
        ends = _ends_at_pi(phases)
        ratio = _error_ratio(oifits, table, np.radians(np.median(error[used])))
        scatter = _scatter(number, error, used)
        product = any(IMPLANEIA in t.columns for t in oifits.named("OI_ARRAY"))
        # Radians taken for degrees are 1/57 = 0.017 of what V² lets expect, within a factor of
        # 2; V² whose errors are those of a flux calibration (MATISSE) give ratios down to 0.04.
        if ends or (ratio is not None and ratio < 0.035):
            sign = "fill ±π and end there" if ends else "have errors 57 times too small for V²"
            yield _radians(table, sign, "T3PHI and T3PHIERR", certain=ends)
        elif NO_NOISE < scatter < SCATTER and not product:
            sign = f"scatter by {scatter:.2g} of their errors, as radians beside degrees do (0.017)"
            yield _radians(table, sign, "T3PHI", certain=False)


def _radians(table: OITable, sign: str, which: str, *, certain: bool) -> Finding:
    return Finding(
        "error" if certain else "warning",
        "phase-in-radians",
        table.label,
        f"closure phases given as degrees {sign}",
        "they look like radians: read as degrees they would be 57 times too small",
        f"convert {which} to degrees"
        + (", or set their TUNIT to rad" if which != "T3PHI" else " (errors are in degrees)"),
    )


def _ends_at_pi(phases: FloatArray) -> bool:
    """Whether |phases|, none beyond π, are those of a circle that ends there."""
    fills = phases.max() > 3.0 and phases.max() < 1.9 * np.sqrt((phases**2).mean())
    last = (phases > np.pi - PILE_RAD).sum()
    before = ((phases > np.pi - 2 * PILE_RAD) & (phases <= np.pi - PILE_RAD)).sum()
    return bool(fills or (last >= MIN_PILE and last > 3 * before))


def _scatter(number: FloatArray, error: FloatArray, used: BoolArray) -> float:
    """Scatter of phases in units of their errors: of all, or of second differences of channels."""
    whitened = np.where(used, number, np.nan) / np.where(used, error, np.nan)
    spread = [whitened]
    if number.shape[1] > 2:
        with np.errstate(invalid="ignore"):
            bend = np.diff(np.where(used, number, np.nan), n=2, axis=1) / np.sqrt(6.0)
            spread.append(bend / np.where(used, error, np.nan)[:, 1:-1])
    known = [np.abs(x[np.isfinite(x)]) for x in spread]
    # The median of |x| of a normal law is 0.674 of its σ.
    return min(float(np.median(x)) / 0.674 for x in known if len(x) >= MIN_PHASES)


def _error_ratio(oifits: OIFits, table: OITable, error: float) -> float | None:
    """Closure-phase error in units of what the V² errors of the same instrument let expect."""
    ratios = []
    for other, kind in data_tables(oifits):
        pair = None if kind.is_angle else value_and_error(other, kind)
        if pair is not None and other.keyword("INSNAME") == table.keyword("INSNAME"):
            value, sigma = pair
            used = unflagged(other, value.shape) & (value > 5 * sigma) & (sigma > 0)
            ratios.append((sigma / (2 * np.where(used, value, 1)))[used])
    pooled = np.concatenate(ratios) if ratios else np.empty(0)
    return float(error / (np.sqrt(3) * np.median(pooled))) if len(pooled) else None


def amplitudes_for_squares(oifits: OIFits) -> Findings:
    """Amplitudes |V| in VIS2DATA: equal to VISAMP, or their products to T3AMP."""
    for table, kind in data_tables(oifits):
        if kind.is_angle:
            continue
        for what, power, log_vis2 in _amplitudes(oifits, table):
            # log of the other column is Σ log V² of its baselines, not half of it.
            wrong, right = (np.abs(power - f * log_vis2) for f in (1.0, 0.5))
            if len(power) >= 4 and np.median(wrong) < 0.1 * np.median(np.abs(log_vis2)):
                yield Finding(
                    "error",
                    "amplitude-for-vis2",
                    table.label,
                    f"VIS2DATA equals {what} to {100 * np.median(wrong):.1g} % in the median, its "
                    f"square root to {100 * np.median(right):.2g} %",
                    "they look like visibility amplitudes: taken for V² they make the star "
                    "smaller and companions fainter",
                    "square VIS2DATA, and multiply VIS2ERR by 2·VIS2DATA",
                )
                break


def _amplitudes(oifits: OIFits, table: OITable) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    """(column, log of it, Σ log VIS2DATA of its baselines), of the same instrument and rows."""
    vis2 = _positive(table, "VIS2DATA")
    if vis2 is None:
        return
    for other in (*oifits.named("OI_VIS"), *oifits.named("OI_T3")):
        name = "VISAMP" if other.name == "OI_VIS" else "T3AMP"
        amplitude = _positive(other, name) if len(other) else None
        alike = same(other.keyword("INSNAME"), table.keyword("INSNAME"))
        if amplitude is None or not alike or amplitude.shape[1] != vis2.shape[1]:
            continue
        rows = _rows_of_sides(table, other)
        if rows is None:
            continue
        total = np.log(vis2)[rows].sum(axis=1)
        total[(rows < 0).any(axis=1)] = np.nan
        known = np.isfinite(total) & np.isfinite(amplitude)
        what = name if name == "VISAMP" else "T3AMP of its triangles"
        yield what, np.log(amplitude[known]), total[known]


def _positive(table: OITable, name: str) -> FloatArray | None:
    """Unflagged positive values below 1, others NaN."""
    values = column(table, name)
    if values is None:
        return None
    with np.errstate(invalid="ignore"):
        return np.where(
            unflagged(table, values.shape) & (values > 0) & (values < 1), values, np.nan
        )


def _rows_of_sides(table: OITable, other: OITable) -> IntArray | None:
    """Rows of V² of the baselines of another table, (rows, 1 or 3); −1 where there is none."""
    names = ("STA_INDEX", "TARGET_ID", "MJD")
    ours, theirs = ([column(t, n) for n in names] for t in (table, other))
    if any(x is None for x in (*ours, *theirs)):
        return None
    stations, target, mjd = (np.asarray(x) for x in ours)
    ends, whose, when = (np.asarray(x) for x in theirs)
    if stations.shape[1] != 2 or ends.shape[1] not in (2, 3):
        return None
    sides = [(0, 1)] if ends.shape[1] == 2 else [(0, 1), (1, 2), (0, 2)]
    found = np.full((len(ends), len(sides)), -1, dtype=np.intp)
    for k, side in enumerate(sides):
        pair = np.sort(ends[:, side], axis=1)
        is_pair = (np.sort(stations, axis=1) == pair[:, None]).all(axis=2)
        apart = np.abs(when[:, :1] - mjd[:, 0])
        apart = np.where(is_pair & (whose[:, :1] == target[:, 0]), apart, np.inf)
        nearest = apart.argmin(axis=1)
        near = apart[np.arange(len(ends)), nearest] < SIMULTANEOUS_D
        found[:, k] = np.where(near, nearest, -1)
    return found


def uv_of_another_scale(oifits: OIFits, parts: Sequence[Observables]) -> Findings:
    """(u, v) that are those of the stations times one factor, or of no baseline of the array."""
    told = set()
    for part in parts:
        rows = unflagged_rows(part.vis2 if len(part.vis2) else part.closure_phase)
        for number, setup in enumerate(part.setups):
            ours = rows.select(rows.setup == number)
            finding = _uv_fault(oifits, ours, setup) if len(ours) else None
            if finding is not None and (finding.code, setup.insname) not in told:
                told.add((finding.code, setup.insname))
                yield finding


def _uv_fault(oifits: OIFits, rows: Measurements, setup: Setup) -> Finding | None:
    factor = common_scale(rows, setup)
    if np.isfinite(factor) and not 1 / SAME_SCALE < factor < SAME_SCALE:
        what = f"{factor:.4g} times those of the station positions{_unit_of(factor, setup)}"
        remedy = f"multiply them by {1 / factor:.4g}, or correct STAXYZ"
    elif setup.station_xyz_m is not None:
        return _longer_than_the_array(rows, setup)
    else:
        what, remedy = _outside_array(oifits, rows, setup), "write them in metres"
    return (
        Finding(
            "error",
            "uv-scale",
            setup.insname,
            f"(u, v) are {what}",
            "separations and diameters will be wrong by that factor",
            remedy,
        )
        if what
        else None
    )


def _longer_than_the_array(rows: Measurements, setup: Setup) -> Finding | None:
    """Projected baselines that are longer than the distance of their stations."""
    ends = np.asarray(setup.station_xyz_m)[rows.stations[:, :2]]
    apart = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    length = rows.baseline_m
    long = length > apart * (1 + SAME_UV) + 1e-3
    if not long.mean() > 0.01:
        return None
    return Finding(
        "error",
        "uv-length",
        setup.insname,
        f"{count(int(long.sum()), 'baseline')} of {len(long)} longer than the "
        f"distance of the stations (up to {(length / apart)[long].max():.3g} times)",
        "(u, v) are not in metres, or STA_INDEX or STAXYZ is wrong",
        "check the unit of UCOORD and the station numbers",
    )


def common_scale(rows: Measurements, setup: Setup) -> float:
    """By what (u, v) are longer than station positions make them; NaN where that is not told.

    The plane of an array seen from a star is shortened in one direction, never in the one that
    is perpendicular to the line of sight: the larger singular value of the map from stations to
    (u, v) is 1, whatever the star, the time and the axes of the positions.
    """
    if setup.station_xyz_m is None:
        return np.nan
    found = []
    for exposure in np.unique(np.round(rows.mjd / SIMULTANEOUS_D)):
        own = rows.select(np.round(rows.mjd / SIMULTANEOUS_D) == exposure)
        ends = setup.station_xyz_m[own.stations[:, :2]]
        baseline = ends[:, 1] - ends[:, 0]
        uv = np.column_stack([own.u_m[:, 0], own.v_m[:, 0]])
        if not np.isfinite(baseline).all():
            continue
        _, length, axes = np.linalg.svd(baseline, full_matrices=False)
        n_axes = int((length > MIN_PLANE * length[0]).sum())
        if length[0] == 0.0 or not 2 <= n_axes < len(own):
            continue
        place = baseline @ axes[:n_axes].T
        mapped = np.linalg.lstsq(place, uv, rcond=None)[0]
        left = np.abs(place @ mapped - uv).max() / np.abs(uv).max()
        if left < MAX_LEFT:
            found.append(np.linalg.svd(mapped, compute_uv=False)[0])
    return float(np.median(found)) if found else np.nan


def _unit_of(factor: float, setup: Setup) -> str:
    """Which unit a factor is, in brackets; empty where it is none that is known."""
    waves = 1.0 / (np.array([setup.wavelength_m.max(), setup.wavelength_m.min()]) * 1e6)
    for name, low, high in (
        ("divided by the wavelength in micron: Mλ", waves[0], waves[1]),
        ("centimetres", 100.0, 100.0),
        ("millimetres", 1000.0, 1000.0),
        ("kilometres", 1e-3, 1e-3),
        ("feet", 1 / 0.3048, 1 / 0.3048),
    ):
        if low / (1 + MAX_LEFT) < factor < high * (1 + MAX_LEFT):
            return f" ({name})"
    return ""


@cache
def lengths() -> dict[str, tuple[float, float]]:
    """Shortest and longest projected baselines in metres, by the beginning of a name."""
    text = (resources.files("amibayes.oifits.audit") / "baselines.toml").read_text("utf-8")
    return {name: (low, high) for name, (low, high) in tomllib.loads(text).items()}


def _outside_array(oifits: OIFits, rows: Measurements, setup: Setup) -> str:
    """What (u, v) are where none is a baseline of the array that names tell; else nothing."""
    names = [setup.insname, *(t.keyword("ARRNAME") for t in oifits.named("OI_ARRAY"))]
    names += [str(oifits.header.get(key, "")) for key in ("INSTRUME", "TELESCOP")]
    known = (a for n in names for a in lengths() if n.upper().startswith(a))
    array = next(known, None)
    if array is None:
        return ""
    low, high = lengths()[array]
    length = rows.baseline_m
    if low <= length.max() and length.min() <= high:
        return ""
    span = f"{length.min():.3g} to {length.max():.3g} m"
    return f"{span}, and those of {array} {low:g} to {high:g} m"


CHECKS: tuple[Callable[[OIFits], Findings], ...] = (
    phases_that_are_radians,
    amplitudes_for_squares,
)
DATA_CHECKS: tuple[Callable[[OIFits, Sequence[Observables]], Findings], ...] = (
    uv_of_another_scale,
)
