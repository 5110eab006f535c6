"""Stations of baselines and triangles whose (u, v) alone tell them apart.

Files of some aperture-masking pipelines write the same station everywhere. The corners of a
triangle are then placed by its (u, v); two triangles that share a side share its corners, so
that the triangles of one exposure make up the projected array, up to its place.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from amibayes.data.measurements import DAY_S, SIMULTANEOUS_S
from amibayes.units import BoolArray, FloatArray, IntArray

TOLERANCE = 0.005
"""Two (u, v) are one within this part of the longest baseline: files round to centimetres, of
masks of some metres, and the Earth turns by 0.001 in the seconds between two tables' dates."""

MATCHED = 0.9
"""Part of the triangles' sides that have to be baselines for a common factor to be accepted."""

SAME_SHAPE = 0.1
"""Two exposures show one array where corners agree to this part of the shortest distance."""


@dataclass(frozen=True, eq=False)
class UVStations:
    """Stations found for the rows of a file.

    Parameters
    ----------
    baselines : (n, 2) int array
    triangles : (m, 3) int array
        Numbers from 0 on.
    n_stations : int
    factor : float
        By which the triangles' (u, v) have to be multiplied to be those of baselines.
    """

    baselines: IntArray
    triangles: IntArray
    n_stations: int
    factor: float


MAX_BASELINE_M = 1e9
"""Coordinates from here on are damage (the Earth is 1.3e7 m across), and their squares overflow."""


def stations_from_uv(
    baseline_m: FloatArray,
    triangle_m: FloatArray,
    baseline_mjd: FloatArray,
    triangle_mjd: FloatArray,
) -> UVStations:
    """Give stations to baselines and triangles by (u, v) and date.

    Parameters
    ----------
    baseline_m : (n, 2) float array
        u, v of each baseline, metres; NaN where unknown (such a row gets stations of its own).
    triangle_m : (m, 2, 2) float array
        u, v of the first two sides of each triangle.
    baseline_mjd, triangle_mjd : (n,), (m,) float array
    """
    factor = common_factor(baseline_m, triangle_m)
    sides = _sides(triangle_m) * factor
    lengths = np.linalg.norm(np.concatenate([baseline_m, sides.reshape(-1, 2)]), axis=1)
    tolerance = TOLERANCE * float(np.nanmax(lengths, initial=0.0))
    group = _times(np.concatenate([baseline_mjd, triangle_mjd]))
    n = len(baseline_m)
    known: list[FloatArray] = []
    first: list[int] = []
    alone: list[int] = []
    baselines = np.zeros((n, 2), dtype=np.intp)
    triangles = np.zeros((len(sides), 3), dtype=np.intp)
    total = 0
    for label in range(int(group.max(initial=-1)) + 1):
        rows, corners = np.flatnonzero(group[:n] == label), np.flatnonzero(group[n:] == label)
        arrays = _arrays(baseline_m[rows], sides[corners], tolerance)
        starts = []
        for places in arrays:
            start, order = _known_array(places, known, first)
            if start < 0:
                start, order = total, np.arange(len(places))
                known.append(places)
                first.append(total)
                total += len(places)
            starts.append(start + order)
        triangles[corners], total = _corners(sides[corners], arrays, starts, tolerance, total)
        ends = baseline_m[rows], arrays, starts, tolerance, total, alone
        baselines[rows], total = _ends(*ends)
    return UVStations(baselines, triangles, total, factor)


def common_factor(baseline_m: FloatArray, triangle_m: FloatArray) -> float:
    """By what the (u, v) of triangles have to be multiplied to be those of baselines.

    Some programs divide one of the two by another mean wavelength. 1 where they agree, or
    where no factor makes them agree.

    Parameters
    ----------
    baseline_m : (n, 2) float array
    triangle_m : (m, 2, 2) float array
    """
    baseline = baseline_m[_on_earth(baseline_m).all(axis=1)]
    side = _sides(triangle_m).reshape(-1, 2)
    side = side[_on_earth(side).all(axis=1)]
    if not len(baseline) or not len(side):
        return 1.0
    lengths = np.linalg.norm(baseline, axis=1), np.linalg.norm(side, axis=1)
    tree = cKDTree(np.concatenate([baseline, -baseline]))
    tolerance = TOLERANCE * lengths[0].max()

    def matched(factor: float) -> tuple[float, float]:
        """(part of the sides that are baselines, the factor that they imply)."""
        away, which = tree.query(side * factor)
        near = (away < 4 * tolerance) & (lengths[1] > 0)
        ratio = lengths[0][which[near] % len(baseline)] / lengths[1][near]
        return float((away < tolerance).mean()), float(np.median(ratio)) if near.any() else factor

    if matched(1.0)[0] >= MATCHED:
        return 1.0
    best, share = 1.0, MATCHED
    for measure in (np.max, np.median, np.mean):
        start = measure(lengths[0]) / max(measure(lengths[1]), 1e-300)
        refined = matched(start)[1]
        found = matched(refined)[0]
        if found >= share:
            best, share = refined, found
    return best


def _on_earth(baseline_m: FloatArray) -> BoolArray:
    """Which coordinates are numbers, and of a baseline that could be (any shape)."""
    return np.abs(baseline_m) < MAX_BASELINE_M


def _sides(triangle_m: FloatArray) -> FloatArray:
    """The three sides of each triangle as they are walked round, (m, 3, 2)."""
    return np.concatenate([triangle_m, -triangle_m.sum(axis=1, keepdims=True)], axis=1)


def _times(mjd: FloatArray) -> IntArray:
    """Number the dates; what is nearer than `SIMULTANEOUS_S` to the one before goes with it."""
    when = np.nan_to_num(mjd)
    order = np.argsort(when, kind="stable")
    label = np.empty(len(when), dtype=np.intp)
    label[order] = np.cumsum(np.diff(when[order], prepend=when[order[:1]]) > SIMULTANEOUS_S / DAY_S)
    return label


def _arrays(baseline: FloatArray, sides: FloatArray, tolerance: float) -> list[FloatArray]:
    """Corners of the arrays that the triangles of one exposure make up, each (n_stations, 2)."""
    m = len(sides)
    usable = _on_earth(sides).all(axis=(1, 2))
    vectors = np.concatenate([sides[usable].reshape(-1, 2), baseline])
    vectors = vectors[_on_earth(vectors).all(axis=1)]
    name, sign = _same_vectors(vectors, tolerance)
    number = int(usable.sum())
    side, turned = name[: 3 * number].reshape(number, 3), sign[: 3 * number].reshape(number, 3)
    single = _single(side, name[3 * number :])
    if not m or not number:
        return []
    corner = np.cumsum(sides[usable], axis=1)  # corners 1, 2 and 0 again
    corner = np.concatenate([np.zeros((number, 1, 2)), corner[:, :2]], axis=1)
    return [_merged(places, tolerance) for places in _joined(corner, side, turned, single)]


def _same_vectors(vectors: FloatArray, tolerance: float) -> tuple[IntArray, IntArray]:
    """(number of each vector, the same for its opposite; which of the two directions it has)."""
    n = len(vectors)
    if not n:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    both = np.concatenate([vectors, -vectors])
    pairs = cKDTree(both).query_pairs(tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(2 * n, 2 * n))
    label = connected_components(graph, directed=False)[1]
    return np.minimum(label[:n], label[n:]), np.where(label[:n] <= label[n:], 1, -1)


def _single(side: IntArray, baselines: IntArray) -> set[int]:
    """Vectors that only one pair of stations has: those with the fewest rows in OI_VIS2."""
    if not len(baselines):
        return set(np.unique(side).tolist())
    names, count = np.unique(baselines, return_counts=True)
    once = set(names[count < 1.5 * count.min()].tolist())
    return once | (set(np.unique(side).tolist()) - set(names.tolist()))


def _joined(
    corner: FloatArray, side: IntArray, turned: IntArray, single: set[int]
) -> list[FloatArray]:
    """Move triangles to where they share the sides that are certain; corners by component."""
    holders: dict[int, list[tuple[int, int]]] = {}
    for t, names in enumerate(side.tolist()):
        for k, name in enumerate(names):
            if name in single:
                holders.setdefault(name, []).append((t, k))
    # Where a side begins when it is walked in the direction that all triangles share.
    begin = np.where(turned > 0, np.arange(3), (np.arange(3) + 1) % 3)
    placed = np.zeros(len(side), dtype=bool)
    components = []
    for seed in range(len(side)):
        if placed[seed] or not any(name in single for name in side[seed].tolist()):
            continue
        placed[seed] = True
        waiting, members = deque([seed]), [corner[seed]]
        places = {seed: corner[seed]}
        while waiting:
            t = waiting.popleft()
            for k, name in enumerate(side[t].tolist()):
                for other, leg in holders.get(name, ()):
                    if not placed[other]:
                        placed[other] = True
                        shift = places[t][begin[t, k]] - corner[other][begin[other, leg]]
                        places[other] = corner[other] + shift
                        members.append(places[other])
                        waiting.append(other)
        components.append(np.concatenate(members))
    return components


def _merged(places: FloatArray, tolerance: float) -> FloatArray:
    """The different places among many, in the order of their first appearance."""
    # Rounded sides add up over a chain of triangles: three times what one may differ by.
    pairs = cKDTree(places).query_pairs(3 * tolerance, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(places), len(places)))
    label = connected_components(graph, directed=False)[1]
    _, first = np.unique(label, return_index=True)
    mean = np.array([places[label == label[i]].mean(axis=0) for i in np.sort(first)])
    return np.asarray(mean - mean.mean(axis=0))


def _known_array(
    places: FloatArray, known: list[FloatArray], first: list[int]
) -> tuple[int, IntArray]:
    """(first number, order) of an array that was met before; (−1, …) for a new one.

    It may have turned since, or be seen from another side: corners in the order met agree after
    a linear map. In another order they agree where nothing has moved much.
    """
    here = np.arange(len(places))
    for start, other in zip(first, known, strict=True):
        if len(other) != len(places):
            continue
        limit = SAME_SHAPE * _shortest(other)
        mapped = places @ np.linalg.lstsq(places, other, rcond=None)[0]
        if np.linalg.norm(mapped - other, axis=1).max() < limit:
            return start, here
        away, nearest = cKDTree(other).query(places)
        if away.max() < limit and len(np.unique(nearest)) == len(places):
            return start, nearest
    return -1, here


def _shortest(places: FloatArray) -> float:
    apart = np.linalg.norm(places[:, None] - places[None], axis=2)
    return float(apart[np.triu_indices(len(places), 1)].min(initial=np.inf))


def _corners(
    sides: FloatArray,
    arrays: list[FloatArray],
    starts: list[IntArray],
    tolerance: float,
    total: int,
) -> tuple[IntArray, int]:
    """Stations of each triangle, and how many stations there are now."""
    out = np.zeros((len(sides), 3), dtype=np.intp)
    again: dict[tuple[int, int, int], int] = {}
    for t, (first, second, _) in enumerate(sides):
        found = []
        for number, places in zip(starts, arrays, strict=True):
            near = _differ_by(places, first, tolerance), _differ_by(places, second, tolerance)
            i, j, k = np.nonzero(near[0][:, :, None] & near[1][None])
            corners = zip(i, j, k, strict=True)
            found += [(int(number[a]), int(number[b]), int(number[c])) for a, b, c in corners]
        if not found:
            found, total = [(total, total + 1, total + 2)], total + 3
        # Triangles of one shape at several places of the array: one after the other.
        turn = again.get(found[0], 0)
        again[found[0]] = turn + 1
        out[t] = found[turn % len(found)]
    return out, total


def _ends(
    baseline: FloatArray,
    arrays: list[FloatArray],
    starts: list[IntArray],
    tolerance: float,
    total: int,
    alone: list[int],
) -> tuple[IntArray, int]:
    """Stations of each baseline, and how many stations there are now.

    Baselines outside all triangles have stations of their own: those of the exposure before,
    in the order of the rows, where these are as many (``alone``, changed in place).
    """
    out = np.full((len(baseline), 2), -1, dtype=np.intp)
    again: dict[tuple[int, int], int] = {}
    for b, vector in enumerate(baseline):
        found = []
        for number, places in zip(starts, arrays, strict=True):
            i, j = np.nonzero(_differ_by(places, vector, tolerance))
            found += [(int(number[a]), int(number[c])) for a, c in zip(i, j, strict=True)]
        if found:
            turn = again.get(found[0], 0)
            again[found[0]] = turn + 1
            out[b] = found[turn % len(found)]
    rest = np.flatnonzero(out[:, 0] < 0)
    if len(rest) and len(rest) != len(alone):
        alone[:] = list(range(total, total + 2 * len(rest), 2))
        total += 2 * len(rest)
    out[rest] = np.array(alone, dtype=np.intp).reshape(-1, 1)[: len(rest)] + np.arange(2)
    return out, total


def _differ_by(places: FloatArray, vector: FloatArray, tolerance: float) -> BoolArray:
    """Pairs (from, to) of places that a vector joins, (n, n)."""
    apart = np.linalg.norm(places[None] - places[:, None] - vector, axis=2)
    with np.errstate(invalid="ignore"):
        return np.asarray(apart < 3 * tolerance) & ~np.eye(len(places), dtype=bool)
