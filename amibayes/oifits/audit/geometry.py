"""Whether (u, v), stations and closure phases belong together."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from amibayes.data.closure import canonical
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.oifits.audit.finding import Finding, Findings, column, count, data_tables, listed
from amibayes.oifits.columns import coordinates
from amibayes.oifits.row_stations import station_fault
from amibayes.oifits.rows import channel_count
from amibayes.oifits.setups import channels_of, wavelength_table
from amibayes.oifits.tables import OIFits, OITable
from amibayes.oifits.uv_stations import common_factor
from amibayes.units import BoolArray, FloatArray, IntArray

SAME_UV = 0.02
"""(u, v) of one baseline in two tables agree to this part of its length …"""

TURN_PER_DAY = 2 * np.pi
"""… and to what the Earth's rotation changes between their dates."""

SIMULTANEOUS_D = 0.02
NON_CLOSING = 4.0
"""Mean χ² of sums over four triangles past which closure phases do not close (1 expected) …"""

ONE_NON_CLOSING = 36.0
"""… and χ² of a single one (6σ)."""


def stations_not_given(oifits: OIFits) -> Findings:
    """STA_INDEX that is absent, the same everywhere or repeated: (u, v) has to tell."""
    for table, _ in data_tables(oifits):
        fault = stations_fault(oifits, table)
        if fault:
            yield Finding(
                "error",
                "stations",
                table.label,
                fault.removeprefix(table.label).lstrip(": "),
                "baselines and triangles can be told apart by their (u, v) alone",
                "number the stations by (u, v), as is done here on reading",
                certain=True,
            )


def stations_fault(oifits: OIFits, table: OITable) -> str:
    """Why STA_INDEX does not tell the rows of a table apart, for any of its targets."""
    ids = column(table, "TARGET_ID")
    target = np.zeros(len(table)) if ids is None else ids[:, 0]
    parts = [np.flatnonzero(target == t) for t in np.unique(target)]
    try:
        return next((f for rows in parts if (f := station_fault(oifits, table, rows))), "")
    except DataError:
        return ""  # a column of another shape is a finding of its own


def repeated_stations(oifits: OIFits) -> Findings:
    """Baselines or triangles that name a station twice."""
    for table, _ in data_tables(oifits):
        stations = column(table, "STA_INDEX")
        if stations is None or stations_fault(oifits, table):
            continue
        twice = (np.diff(np.sort(stations, axis=1), axis=1) == 0).any(axis=1)
        if twice.any():
            yield Finding(
                "error",
                "station-twice",
                table.label,
                f"{count(int(twice.sum()), 'row')} name a station twice",
                "closure phases cannot be tied to baselines",
                "write the stations of each row",
            )


def uv_in_wavelengths(oifits: OIFits) -> Findings:
    """(u, v) that are no metres."""
    for table, kind in data_tables(oifits):
        try:
            channels = wavelength_table(oifits, table, channel_count(oifits, table))
            wavelength = channels_of(oifits, channels)[0]
            notes = coordinates(oifits, table, (*kind.u, *kind.v), wavelength)[1]
            what, certain = "; ".join(n for n in notes if "wavelengths" in n), True
        except DataError as error:
            what, certain = error.what if "is in wavelengths" in error.what else "", False
        if what:
            yield Finding(
                "error",
                "uv-in-wavelengths",
                table.label,
                what.replace(f"{table.label}: ", "").replace(": converted to metres", ""),
                "OIFITS has (u, v) in metres: other programs take these for metres",
                "multiply them by the wavelength",
                certain=certain,
            )


def uv_against_stations(oifits: OIFits, parts: Sequence[Observables]) -> Findings:
    """(u, v) of triangles against those of the same baselines in OI_VIS2."""
    for part in parts:
        factor = _factor(part)
        agree, reverse, compared = _legs(part, factor)
        off = compared & ~agree & ~reverse
        where = listed(s.insname for s in part.setups)
        if factor != 1.0:
            yield Finding(
                "error",
                "uv-factor",
                where,
                f"(u, v) of baselines are {factor:.4f} times those of the same sides of triangles, "
                "as if one of them had been divided by another mean wavelength",
                "separations from V² and from closure phases differ by that factor",
                "multiply UCOORD, VCOORD or U1COORD … V2COORD by it, whichever is wrong",
            )
        if off.sum() > 0.01 * max(compared.sum(), 1):
            yield Finding(
                "error",
                "uv-stations",
                where,
                f"(u, v) of {count(int(off.sum()), 'side')} of triangles (of "
                f"{compared.sum()}) are not those of the same stations in OI_VIS2",
                "models are computed at wrong baselines",
                "check STA_INDEX and the order of U1COORD, U2COORD",
            )
        elif (agree & ~reverse).any() and (reverse & ~agree).any():
            yield Finding(
                "warning",
                "uv-direction",
                where,
                f"(u, v) of {count(int((reverse & ~agree).sum()), 'side')} of triangles run "
                "against those of the same stations in OI_VIS2, of others they do not",
                "the sign of those closure phases is in doubt",
                "check the order of the stations",
            )


def _factor(part: Observables) -> float:
    """By what the triangles' (u, v) have to be multiplied to be V²'s."""
    vis2, closure = unflagged_rows(part.vis2), unflagged_rows(part.closure_phase)
    sides = np.stack([closure.u_m, closure.v_m], axis=2).reshape(-1, 2, 2)
    return common_factor(np.concatenate([vis2.u_m, vis2.v_m], axis=1), sides)


def _legs(part: Observables, factor: float) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Where the two sides of each triangle agree with V²'s (u, v), or with its reverse."""
    vis2, closure = unflagged_rows(part.vis2), unflagged_rows(part.closure_phase)
    n = len(closure)
    agree, reverse, compared = (np.zeros((n, 2), dtype=bool) for _ in range(3))
    if not len(vis2) or not n:
        return agree, reverse, compared
    for side in range(2):
        pair = closure.stations[:, side : side + 2]
        uv = factor * np.stack([closure.u_m[:, side], closure.v_m[:, side]], axis=1)
        nearest, days = _same_baseline(closure, pair, uv, vis2)
        turned = (pair[:, 0] > pair[:, 1]) != (
            vis2.stations[nearest, 0] > vis2.stations[nearest, 1]
        )
        known = np.concatenate([vis2.u_m, vis2.v_m], axis=1)[nearest]
        known = known * np.where(turned, -1.0, 1.0)[:, None]
        length = np.linalg.norm(known, axis=1)
        allowed = length * (SAME_UV + TURN_PER_DAY * days) + 1e-6
        compared[:, side] = days < SIMULTANEOUS_D
        agree[:, side] = np.linalg.norm(uv - known, axis=1) < allowed
        reverse[:, side] = np.linalg.norm(uv + known, axis=1) < allowed
    return agree & compared, reverse & compared, compared


def unflagged_rows(m: Measurements) -> Measurements:
    """One unflagged entry of every row that has one."""
    m = m.select(~m.flag)
    _, first = np.unique(np.stack([m.setup, m.row]), axis=1, return_index=True)
    return m.select(np.sort(first))


def _same_baseline(
    closure: Measurements, pair: IntArray, uv: FloatArray, vis2: Measurements
) -> tuple[IntArray, FloatArray]:
    """V² row of the same setup and baseline nearest in time to each triangle, and how near.

    Of exposures with one date (of the night, or none) the one whose (u, v) is nearest.
    """
    wanted = np.column_stack([closure.setup, np.sort(pair, axis=1)])
    there = np.column_stack([vis2.setup, np.sort(vis2.stations, axis=1)])
    same = (wanted[:, None] == there[None]).all(axis=2)
    days = np.where(same, np.abs(closure.mjd[:, None] - vis2.mjd), np.inf)
    theirs = np.concatenate([vis2.u_m, vis2.v_m], axis=1)
    apart = [np.linalg.norm(uv[:, None] - sense * theirs, axis=2) for sense in (1.0, -1.0)]
    first = days <= days.min(axis=1, keepdims=True)
    nearest = np.where(first, np.minimum(*apart), np.inf).argmin(axis=1)
    return nearest, days[np.arange(len(nearest)), nearest]


@dataclass(frozen=True, eq=False)
class FourTriangles:
    """Sums of closure phases over four triangles in one closure set.

    ``sign`` (n_sums, n_triangles) holds −1, 0, +1; ``phase`` and ``variance`` are those of the
    triangles, ``name`` what to call them.
    """

    name: list[str]
    sign: FloatArray
    phase: FloatArray
    variance: FloatArray

    def chi2(self, turned: Collection[str] = ()) -> FloatArray:
        """χ² of each sum, with some triangles turned round."""
        side = np.array([-1.0 if name in turned else 1.0 for name in self.name])
        left = self.sign @ (side * self.phase)
        left = np.angle(np.exp(1j * left))
        return np.asarray(left**2 / (np.abs(self.sign) @ self.variance))


def closures_that_do_not_close(oifits: OIFits, parts: Sequence[Observables]) -> Findings:
    """Sums of closure phases over four triangles, which vanish whatever the source is.

    φ(abc) − φ(abd) + φ(acd) − φ(bcd) = 0 holds for every object, so what is left is noise.
    """
    for part in parts:
        sums = four_triangles(part)
        chi2 = np.concatenate([np.empty(0), *(s.chi2() for s in sums)])
        if len(chi2) < 5 or _closes(chi2):
            continue
        turned = _turned(sums)
        clause = f"; with {listed(turned)} turned round they would close"
        yield Finding(
            "error",
            "non-closing",
            listed(s.insname for s in part.setups),
            f"sums over four triangles, which are zero for any source, have χ² of "
            f"{chi2.mean():.3g} in the mean and up to {chi2.max():.3g} ({len(chi2)} sums)"
            f"{clause if turned else ''}",
            "the order of the stations or the sign of some closure phases is wrong, or errors "
            "are too small",
            f"check STA_INDEX{'' if turned else ' and the errors'} of OI_T3",
        )


def four_triangles(part: Observables) -> list[FourTriangles]:
    """The sums of every closure set that has all four triangles of some four stations."""
    closure = part.closure_phase.select(~part.closure_phase.flag)
    sigma = part.errors[1][~part.closure_phase.flag]
    found = []
    for entries in closure.sets:
        few = closure.select(entries)
        ordered, sign = canonical(few.stations)
        place = {tuple(t): i for i, t in enumerate(ordered.tolist())}
        rows = []
        for four in combinations(np.unique(ordered).tolist(), 4):
            corners = [four[:k] + four[k + 1 :] for k in range(4)]
            if all(t in place for t in corners):
                which = [place[t] for t in corners]
                rows.append(np.zeros(len(few)))
                rows[-1][which] = np.array([-1, 1, -1, 1]) * sign[which]
        if rows:
            stations = part.setups[int(few.setup[0])].stations
            names = ["-".join(stations[s] for s in t) for t in few.stations]
            found.append(
                FourTriangles(names, np.array(rows), few.value, np.asarray(sigma[entries] ** 2))
            )
    return found


def _closes(chi2: FloatArray) -> bool:
    """Whether sums are noise: in the mean, and each of them."""
    return bool(chi2.mean() < NON_CLOSING and chi2.max() < ONE_NON_CLOSING)


def _turned(sums: list[FourTriangles]) -> list[str]:
    """Few triangles that, turned round, make the sums close; none where that does not help."""
    names = sorted({name for s in sums for name in s.name})
    chosen: list[str] = []
    while len(chosen) < len(names) // 3 + 1:
        trials = {
            n: np.concatenate([s.chi2([*chosen, n]) for s in sums])
            for n in names
            if n not in chosen
        }
        best = min(trials, key=lambda n: float(trials[n].sum()))
        chosen.append(best)
        if _closes(trials[best]):
            return chosen
    return []


CHECKS = (stations_not_given, repeated_stations, uv_in_wavelengths)
DATA_CHECKS = (
    uv_against_stations,
    closures_that_do_not_close,
)
