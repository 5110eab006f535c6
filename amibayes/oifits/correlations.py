"""Correlations that a file gives: OI_CORR, and the V2COV and CPCOV images of fouriever."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from amibayes.data.assumed_covariance import kernel_blocks
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import Block, BlockCovariance, diagonal_covariance
from amibayes.data.measurements import Measurements, exposure_labels
from amibayes.errors import DataError
from amibayes.oifits.columns import integers, numbers, placed, rest_of, same
from amibayes.oifits.tables import OIFits, OITable
from amibayes.units import DEGREE, BoolArray, FloatArray, IntArray

MAX_MISFIT = 0.5
"""Median departure of ln(variance ratio) past which a covariance is not that of the errors."""

OPPOSITE = -0.05
"""Mean correlation, times the sign that shared baselines give it, below which it is wrong."""

REMEDY = "correct the correlations, or read the file with independent errors"


@dataclass(frozen=True, eq=False)
class Pairs:
    """Covariances of pairs of data, each pair once.

    Parameters
    ----------
    first, second : (n,) int array
        Places in the data vector.
    covariance : (n,) float array
    """

    first: IntArray
    second: IntArray
    covariance: FloatArray


def joined(parts: Sequence[Pairs]) -> Pairs:
    """All pairs of several tables."""
    empty = np.empty(0, dtype=np.intp)
    return Pairs(
        np.concatenate([empty, *(p.first for p in parts)]),
        np.concatenate([empty, *(p.second for p in parts)]),
        np.concatenate([np.empty(0), *(p.covariance for p in parts)]),
    )


def oi_corr_pairs(oifits: OIFits, table: OITable, index: IntArray, variance: FloatArray) -> Pairs:
    """Covariances that one OI_CORR gives.

    Parameters
    ----------
    index : (n,) int array
        1-based index of each datum in this table, 0 for none.
    variance : (n,) float array

    Raises
    ------
    DataError
        Where the table is inconsistent.
    """
    first, second, correlation, rest = _listed(oifits, table)
    numbered = np.flatnonzero(index > 0)
    numbered = numbered[np.argsort(index[numbered])]
    if len(np.unique(index[numbered])) != len(numbered):
        raise DataError(
            f"{table.label}: two data have the same place in the correlation matrix",
            source=oifits.path,
            remedy=REMEDY,
        )
    a, b = (placed(wanted, index[numbered], numbered) for wanted in (first, second))
    ours = (a >= 0) & (b >= 0) & (correlation != 0)
    a, b, correlation, rest = a[ours], b[ours], correlation[ours], rest[ours]
    return Pairs(a, b, pair_covariance(correlation, variance[a], variance[b]) + rest)


def pair_covariance(
    correlation: FloatArray, first_variance: FloatArray, second_variance: FloatArray
) -> FloatArray:
    """CORR σᵢσⱼ, in the one order of operations that reading and writing share."""
    return np.asarray(correlation * (np.sqrt(first_variance) * np.sqrt(second_variance)))


def _listed(oifits: OIFits, table: OITable) -> tuple[IntArray, IntArray, FloatArray, FloatArray]:
    first, second = (integers(oifits, table, c, 1)[:, 0] for c in ("IINDX", "JINDX"))
    correlation = numbers(oifits, table, "CORR").reshape(-1)
    rest = rest_of(table, "CORR", correlation.shape)
    off = first != second
    first, second, correlation, rest = first[off], second[off], correlation[off], rest[off]
    low, high = np.minimum(first, second), np.maximum(first, second)
    fault = ""
    if len(low) and low.min() < 1:
        fault = "an index below 1"
    elif not (np.abs(correlation) <= 1 + 1e-9).all():
        fault = "a correlation that is not between -1 and 1"
    if fault:
        raise DataError(f"{table.label} has {fault}", source=oifits.path, remedy=REMEDY)
    order = np.lexsort((high, low))
    low, high, correlation, rest = low[order], high[order], correlation[order], rest[order]
    again = (np.diff(low) == 0) & (np.diff(high) == 0)
    if (again & (np.diff(correlation) != 0)).any():
        raise DataError(
            f"{table.label} gives two values for one correlation",
            source=oifits.path,
            remedy=REMEDY,
        )
    keep = np.concatenate([[True], ~again])[: len(low)]
    return low[keep], high[keep], correlation[keep], rest[keep]


def image_pairs(
    oifits: OIFits, table: OITable, entries: IntArray, variance: FloatArray, n_channels: int
) -> tuple[Pairs, FloatArray, str]:
    """Covariances of fouriever's V2COV or CPCOV: one matrix per exposure.

    The rows of the data tables come exposure by exposure, and inside a matrix the channels
    run fastest (or, where that is what fits the errors, the baselines); closure phases are in
    radians (or degrees). Both are found by comparing the diagonal with the errors.

    Parameters
    ----------
    entries : (n,) int array
        Places in the data vector of every row and channel of the instrument, in file order.
    variance : (n,) float array
        Squared errors of ``entries``.
    n_channels : int

    Returns
    -------
    pairs : Pairs
    variance : (n,) float array
        The diagonal, for ``entries``.
    note : str

    Raises
    ------
    DataError
        Where the shape does not fit the data, or the diagonal fits the errors in no order.
    """
    stack = _stack_of(oifits, table, len(entries), n_channels)
    name, grid, scale = _order_and_unit(oifits, table, stack, variance, n_channels)
    diagonal = np.empty(len(entries))
    diagonal[grid] = np.diagonal(stack, axis1=1, axis2=2) * scale
    i, j = np.triu_indices(stack.shape[1], 1)
    pairs = Pairs(
        entries[grid[:, i]].ravel(), entries[grid[:, j]].ravel(), (stack[:, i, j] * scale).ravel()
    )
    used = pairs.covariance != 0
    return (
        Pairs(pairs.first[used], pairs.second[used], pairs.covariance[used]),
        diagonal,
        f"{table.label}: covariances taken ({name})",
    )


def _stack_of(oifits: OIFits, table: OITable, n_data: int, n_channels: int) -> FloatArray:
    """The matrices, (n_exposures, size, size), where they are for the data."""
    image = table.image
    if image is None or image.ndim not in (2, 3) or image.shape[-1] != image.shape[-2]:
        raise DataError(f"{table.label} is no stack of matrices", source=oifits.path, remedy=REMEDY)
    stack = np.asarray(image, dtype=float).reshape(-1, *image.shape[-2:])
    held = stack.shape[0] * stack.shape[1]
    if held != n_data or stack.shape[1] % n_channels:
        raise DataError(
            f"{table.label} is for {held} data, the tables hold {n_data}",
            source=oifits.path,
            remedy=REMEDY,
        )
    return stack


def _order_and_unit(
    oifits: OIFits, table: OITable, stack: FloatArray, variance: FloatArray, n_channels: int
) -> tuple[str, IntArray, float]:
    """Name, (exposures, size) places of the data and scale to radians² that fit the errors best."""
    shape = stack.shape[:2]
    cells = np.arange(shape[0] * shape[1]).reshape(shape[0], -1, n_channels)
    diagonal = np.diagonal(stack, axis1=1, axis2=2)
    orders = ("channels fastest", cells), ("baselines fastest", cells.swapaxes(1, 2))
    units = [("radians", 1.0), ("degrees", DEGREE**2)][: 1 + (table.name == "CPCOV")]
    trials = [
        (f"{order}, {unit}" if len(units) > 1 else order, grid.reshape(shape), scale)
        for order, grid in orders
        for unit, scale in units
    ]
    misfit = [_misfit(diagonal * scale, variance[grid]) for _, grid, scale in trials]
    best = int(np.argmin(misfit))
    if not misfit[best] < MAX_MISFIT:
        raise DataError(
            f"the diagonal of {table.label} does not fit the errors of the data",
            source=oifits.path,
            remedy=REMEDY,
        )
    return trials[best]


def _misfit(diagonal: FloatArray, variance: FloatArray) -> float:
    """Median departure of the logarithm of the ratio from 0."""
    with np.errstate(all="ignore"):
        ratio = np.log(diagonal / variance)
    usable = np.isfinite(ratio)
    return float(np.median(np.abs(ratio[usable]))) if usable.any() else np.inf


def image_table(oifits: OIFits, name: str, insname: str) -> OITable | None:
    """The V2COV or CPCOV of an instrument."""
    found = [t for t in oifits.named(name) if t.image is not None]
    alike = [t for t in found if same(t.keyword("INSNAME"), insname)]
    unnamed = [t for t in found if not t.keyword("INSNAME")]
    return next(iter(alike or unnamed), None)


def consistent_pairs(
    pairs: Pairs, variance: FloatArray, closure_phase: Measurements
) -> tuple[Pairs, str]:
    """Set the correlations between closure phases aside where they cannot be right.

    Two triangles of one exposure that share a baseline are correlated with the sign that
    the baseline has in both. Correlations that on average have the opposite sign, in one
    exposure at least, belong to another order of the triangles (fouriever's example of
    AX Cir: half of its exposures); with them, some combination would have no noise.

    Returns
    -------
    pairs : Pairs
    note : str
        Empty where they were kept.
    """
    shift = len(variance) - len(closure_phase)
    inner = (pairs.first >= shift) & (pairs.second >= shift)
    i, j = pairs.first[inner] - shift, pairs.second[inner] - shift
    exposure = exposure_labels(closure_phase)
    same_set = (exposure[i] == exposure[j]) & (closure_phase.channel[i] == closure_phase.channel[j])
    sign = np.where(same_set, shared_baseline_sign(closure_phase, i, j), 0.0)
    scale = np.sqrt(variance[i + shift] * variance[j + shift])
    tied = sign != 0
    total = np.bincount(exposure[i[tied]], (sign * pairs.covariance[inner] / scale)[tied])
    count = np.bincount(exposure[i[tied]])
    wrong = int((total < OPPOSITE * count).sum())
    if not wrong:
        return pairs, ""
    kept = Pairs(pairs.first[~inner], pairs.second[~inner], pairs.covariance[~inner])
    return kept, (
        f"the correlations given between closure phases contradict the baselines that the "
        f"triangles share in {wrong} of {(count > 0).sum()} exposures: set aside, correlated "
        "through shared baselines instead"
    )


def shared_baseline_sign(closure_phase: Measurements, i: IntArray, j: IntArray) -> FloatArray:
    """Sign of the correlation that a shared baseline gives two closure phases; 0 for none."""
    a, b, c = closure_phase.stations.T
    legs = np.stack([np.stack(leg, axis=1) for leg in ((a, b), (b, c), (c, a))], axis=1)
    one, other = legs[i][:, :, None], legs[j][:, None]
    along = (one == other).all(axis=3).sum(axis=(1, 2))
    against = (one == other[..., ::-1]).all(axis=3).sum(axis=(1, 2))
    return np.asarray(np.sign(along - against), dtype=float)


def given_covariance(
    variance: FloatArray,
    pairs: Pairs,
    closure_phase: Measurements,
    *,
    covered: BoolArray,
    independent: BoolArray,
) -> BlockCovariance:
    """Covariance of unflagged data, some of whose correlations are given.

    Parameters
    ----------
    variance : (n,) float array
        V² first, then closure phases.
    pairs : Pairs
    closure_phase : Measurements
        Unflagged; the last entries of the data vector.
    covered : (n,) bool array
        Where the absence of a correlation means that there is none. A closure set that is
        neither covered nor in a pair gets the covariance of independent baseline phases.
    independent : (n,) bool array
        Closure phases without kernel basis: every triangle counts as independent.

    Raises
    ------
    DataError
        Where the matrix is not positive definite on the kernel basis.
    """
    n, shift = len(variance), len(variance) - len(closure_phase)
    sets = [entries + shift for entries in closure_phase.sets]
    sets = [s for s in sets if not independent[s].all()]
    paired = np.zeros(n, dtype=bool)
    paired[pairs.first] = paired[pairs.second] = True
    assumed = [s for s in sets if not (paired[s] | covered[s]).any()]
    given = [s for s in sets if (paired[s] | covered[s]).any()]
    blocks = _assumed_blocks(closure_phase, variance, assumed, shift)
    single = np.ones(n, dtype=bool)
    single[[i for s in assumed for i in s]] = False
    blocks += _given_blocks(variance, pairs, closure_phase, given, single)
    if not pairs.first.size and not sets:
        return diagonal_covariance(variance)
    return BlockCovariance(n, blocks)


def _assumed_blocks(
    closure_phase: Measurements, variance: FloatArray, sets: list[IntArray], shift: int
) -> list[Block]:
    if not sets:
        return []
    chosen = np.sort(np.concatenate(sets))
    few = closure_phase.select(chosen - shift)
    return [
        Block(chosen[block.index], block.matrix, block.basis)
        for block in kernel_blocks(few, np.sqrt(variance[chosen]))
    ]


def _given_blocks(
    variance: FloatArray,
    pairs: Pairs,
    closure_phase: Measurements,
    sets: list[IntArray],
    available: BoolArray,
) -> list[Block]:
    """One block per group of entries tied by a correlation or by shared baselines."""
    n = len(variance)
    chained = [(s[:-1], s[1:]) for s in sets]
    first = np.concatenate([pairs.first, *(a for a, _ in chained)])
    second = np.concatenate([pairs.second, *(b for _, b in chained)])
    links = coo_array((np.ones(len(first)), (first, second)), shape=(n, n))
    label = connected_components(links, directed=False)[1]
    members = _groups(label, np.flatnonzero(available))
    inside = np.empty(n, dtype=np.intp)
    matrices = {}
    for key, entries in members.items():
        inside[entries] = np.arange(len(entries))
        matrices[key] = np.diag(variance[entries])
    for key, which in _groups(label[pairs.first], np.arange(len(pairs.first))).items():
        i, j = inside[pairs.first[which]], inside[pairs.second[which]]
        matrices[key][i, j] = matrices[key][j, i] = pairs.covariance[which]
    bases = _bases(closure_phase, sets, label, members, inside, n)
    return [Block(members[key], matrices[key], bases.get(key)) for key in members]


def _groups(label: IntArray, entries: IntArray) -> dict[int, IntArray]:
    """Entries by label, in order."""
    if not len(entries):
        return {}
    by_label = entries[np.argsort(label[entries], kind="stable")]
    cuts = np.flatnonzero(np.diff(label[by_label])) + 1
    return {int(label[part[0]]): part for part in np.split(by_label, cuts)}


def _bases(
    closure_phase: Measurements,
    sets: list[IntArray],
    label: IntArray,
    members: dict[int, IntArray],
    inside: IntArray,
    n: int,
) -> dict[int, FloatArray]:
    """Basis of each group: kernel basis of its closure sets, everything else as it is."""
    shift = n - len(closure_phase)
    parts: dict[int, list[tuple[IntArray, FloatArray]]] = {}
    kernels: dict[bytes, FloatArray] = {}
    for entries in sets:
        triangles = closure_phase.stations[entries - shift]
        key = triangles.tobytes()
        if key not in kernels:
            kernels[key] = kernel_basis(closure_matrix(triangles)[0])
        parts.setdefault(int(label[entries[0]]), []).append((inside[entries], kernels[key]))
    return {group: _basis(len(members[group]), own) for group, own in parts.items()}


def _basis(size: int, parts: list[tuple[IntArray, FloatArray]]) -> FloatArray:
    in_sets = np.concatenate([place for place, _ in parts])
    others = np.setdiff1d(np.arange(size), in_sets)
    basis = np.zeros((size, len(others) + sum(kernel.shape[1] for _, kernel in parts)))
    basis[others, np.arange(len(others))] = 1.0
    column = len(others)
    for place, kernel in parts:
        basis[place, column : column + kernel.shape[1]] = kernel
        column += kernel.shape[1]
    return basis
