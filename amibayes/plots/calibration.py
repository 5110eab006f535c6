"""Calibrators beside each other: every baseline, every triangle, those dropped marked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.plots.fit import longest_baseline_m
from amibayes.plots.style import BLACK, GREY, LIGHT_GREY, marker_of, new_figure, styled
from amibayes.units import FloatArray

ROOM_FOR_NAMES, EDGE_OF_NAME = 90, 9
"""Letters that fit beside each other under a picture; those that a marker takes the room of."""

MAX_KEYS = 100
"""Numbers of one kind and data set beyond which markers get smaller."""


@dataclass(frozen=True, eq=False)
class _Column:
    """Numbers of one kind of one data set, in one orientation of each baseline or triangle."""

    key: NDArray[np.str_]
    length_m: FloatArray
    value: FloatArray
    sigma: FloatArray


@styled()
def calibrator_plot(
    calibrators: Sequence[Observables],
    kept: Sequence[bool],
    names: Sequence[str],
    combined: Observables | None = None,
) -> Figure:
    """Draw V² and closure phases of every calibrator, baseline by baseline.

    Parameters
    ----------
    calibrators : sequence of Observables
    kept : sequence of bool
        False for those left out, which are drawn grey and open.
    names : sequence of str
    combined : Observables, optional
        What the calibrators were combined to: a line and its 1σ band.

    Returns
    -------
    matplotlib.figure.Figure
        Baselines and triangles are in order of their (longest) baseline. Closure phases
        of triangles whose stations are given in another order follow in sign.
    """
    kinds = [
        (_vis2, "V²", "Baseline, shortest to longest (m)"),
        (_closure, "Closure phase (°)", "Triangle, by its longest baseline (m)"),
    ]
    figure = new_figure(8.6)
    axes = np.atleast_1d(figure.subplots(2, 1))
    for ax, (column, label, axis) in zip(axes, kinds, strict=True):
        _draw_kind(ax, column, calibrators, kept, names, combined)
        ax.set_ylabel(label)
        ax.set_xlabel(axis)
    handles, texts = axes[0].get_legend_handles_labels()
    figure.legend(handles, texts, loc="outside lower center", ncols=columns_of(texts))
    return figure


def columns_of(texts: Sequence[str]) -> int:
    """As many columns as the names leave room for."""
    longest = max(map(len, texts), default=1)
    return max(1, min(3, len(texts), ROOM_FOR_NAMES // (longest + EDGE_OF_NAME)))


def _vis2(observables: Observables) -> _Column:
    data = observables.unflagged()
    key, _ = _keys(data, data.vis2)
    return _Column(key, longest_baseline_m(data.vis2), data.vis2.value, data.errors[0])


def _closure(observables: Observables) -> _Column:
    data = observables.unflagged()
    m = data.closure_phase
    key, sign = _keys(data, m)
    return _Column(
        key, longest_baseline_m(m), sign * np.degrees(m.value), np.degrees(data.errors[1])
    )


def _keys(data: Observables, m: Measurements) -> tuple[NDArray[np.str_], FloatArray]:
    """Stations of each entry in alphabetical order, and the sign that the order costs."""
    widest = max((len(s.stations) for s in data.setups), default=0)
    table = np.array([[*s.stations, *[""] * (widest - len(s.stations))] for s in data.setups])
    names = table[m.setup[:, None], m.stations]
    order = np.argsort(names, axis=1, kind="stable")
    names = np.take_along_axis(names, order, axis=1)
    key = names[:, 0]
    for column in names.T[1:]:
        key = np.char.add(np.char.add(key, "-"), column)
    # An odd permutation of three stations runs round the triangle the other way.
    cyclic = (order[:, 1] - order[:, 0]) % 3 == 1
    return key, np.where(cyclic, 1.0, -1.0)


def _draw_kind(
    ax: Axes,
    column: Callable[[Observables], _Column],
    calibrators: Sequence[Observables],
    kept: Sequence[bool],
    names: Sequence[str],
    combined: Observables | None,
) -> None:
    columns = [column(c) for c in calibrators]
    ax.use_sticky_edges = False
    slots, lengths = _slots(columns)
    if combined is not None:
        _draw_combined(ax, column(combined), slots)
    for i, (one, keep, name) in enumerate(zip(columns, kept, names, strict=True)):
        share = 0.8 / len(columns)
        shift = share * (i + 0.5) - 0.4
        colour, marker = marker_of(i)
        ax.errorbar(
            _place(one.key, slots) + shift + 0.7 * share * _spread(one.key),
            one.value,
            one.sigma,
            fmt=marker,
            color=colour if keep else GREY,
            fillstyle="full" if keep else "none",
            markersize=3.5 if len(one.key) <= MAX_KEYS else 2,
            elinewidth=0.9 if len(one.key) <= MAX_KEYS else 0.3,
            zorder=3 if keep else 2,
            label=name if keep else f"{name} (dropped)",
        )
    _number(ax, lengths)


def _spread(key: NDArray[np.str_]) -> FloatArray:
    """Offsets in (−½, ½) that lay the entries of one key out in their order."""
    _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)
    order = np.argsort(inverse, kind="stable")
    turn = np.empty(len(key))
    turn[order] = np.arange(len(key)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray((turn + 0.5) / counts[inverse] - 0.5)


def _slots(columns: Sequence[_Column]) -> tuple[NDArray[np.str_], FloatArray]:
    """All keys by length, and their lengths."""
    key = np.concatenate([c.key for c in columns])
    length = np.concatenate([c.length_m for c in columns])
    distinct, inverse = np.unique(key, return_inverse=True)
    mean = np.bincount(inverse, length) / np.bincount(inverse)
    order = np.argsort(mean, kind="stable")
    return distinct[order], mean[order]


def _place(key: NDArray[np.str_], slots: NDArray[np.str_]) -> FloatArray:
    """Number of each key's slot; NaN for a key that no calibrator has."""
    order = np.argsort(slots)
    found = np.searchsorted(slots[order], key).clip(max=max(len(slots) - 1, 0))
    place = order[found].astype(float)
    place[slots[order[found]] != key] = np.nan
    return np.asarray(place)


def _draw_combined(ax: Axes, column: _Column, slots: NDArray[np.str_]) -> None:
    place = _place(column.key, slots)
    box: dict[str, Any] = {"width": 0.9, "color": LIGHT_GREY, "zorder": 0}
    ax.bar(
        place, 2.0 * column.sigma, bottom=column.value - column.sigma, **box, label="combined, ±1σ"
    )
    ax.hlines(column.value, place - 0.45, place + 0.45, colors=BLACK, lw=1.2, zorder=1)


def _number(ax: Axes, lengths: FloatArray) -> None:
    """Write the length at every slot that has room for it."""
    step = max(1, -(-len(lengths) // 10))
    at = np.arange(0, len(lengths), step)
    ax.set_xticks(at, [f"{lengths[i]:.3g}" for i in at])
    ax.set_xticks(np.arange(len(lengths)), minor=True)
    ax.set_xlim(-0.7, len(lengths) - 0.3)
