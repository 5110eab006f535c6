"""ln L along the contrast: formed at a few points, and between them by their polynomial.

Over the few errors of the contrast that matter, ln L of a companion is almost a parabola. Points
at the extrema of a Chebyshev polynomial contain those of half its degree, so that what each
doubling changes is a measured error (Trefethen, "Approximation Theory and Approximation
Practice", chapters 2 and 5).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.polynomial.chebyshev import chebval, chebvander

from amibayes.units import BoolArray, FloatArray, IntArray

DEGREES = (8, 8, 16)
"""Degrees tried in turn, each where the one before leaves L that counts; then ln L is formed at
every box."""

TOLERANCE = 0.1
"""Largest change of ln L from half the degree, times the square root of L over the largest of its
cell: the error of the degree itself is far smaller, and what is faint matters less."""

RESOLVED = 0.5
"""Largest change of ln L anywhere: a peak between two points would make more."""

DEEP = 15.0
"""What is further below the largest ln L of a cell does not count."""

At = Callable[[IntArray, FloatArray], FloatArray]
"""ln L (n, k) of rows (n,) at contrasts (n, k)."""


@cache
def _points(degree: int) -> FloatArray:
    """Extrema of the Chebyshev polynomial of a degree, on 0 to 1, (degree + 1,)."""
    return np.asarray(0.5 - 0.5 * np.cos(np.pi * np.arange(degree + 1) / degree))


@cache
def _coefficients(degree: int) -> FloatArray:
    """Chebyshev coefficients of values at `_points`, (degree + 1, degree + 1)."""
    return np.asarray(np.linalg.inv(chebvander(2.0 * _points(degree) - 1.0, degree)))


def _between(value: FloatArray, place: FloatArray) -> FloatArray:
    """Polynomials through values (n, degree + 1), at places between 0 and 1 (n, k), (n, k)."""
    degree = value.shape[1] - 1
    coefficients = value @ _coefficients(degree).T
    return np.asarray(chebval(2.0 * place.T - 1.0, coefficients.T, tensor=False).T)


def _change(value: FloatArray) -> FloatArray:
    """What the points that half the degree lacks add, (n, degree/2), of values (n, degree + 1)."""
    new = np.broadcast_to(_points(value.shape[1] - 1)[1::2], (len(value), value.shape[1] // 2))
    return np.abs(_between(value[:, ::2], new) - value[:, 1::2])


def profile(
    at: At, low: FloatArray, high: FloatArray, boxes: FloatArray, n_nodes: int
) -> FloatArray:
    """ln L of cells and nodes of the nuisance parameters at boxes of the contrast.

    Parameters
    ----------
    at : callable
        Forms ln L; a row is a cell and a node, the nodes of a cell one after the other.
    low, high : (n_cells,) float array
        Range of contrast within which all boxes lie.
    boxes : (n_cells, n_boxes) float array
        Contrasts, from small to large.
    n_nodes : int

    Returns
    -------
    (n_cells, n_nodes, n_boxes) float array
    """
    n_cells = len(boxes)
    low, high, boxes = (np.repeat(x, n_nodes, axis=0) for x in (low, high, boxes))
    out, top = np.full(boxes.shape, -np.inf), np.full(n_cells, -np.inf)
    rows = np.arange(len(boxes))
    for degree in DEGREES:
        if not len(rows):
            break
        low, wide = low[:, None], np.maximum(high - low, 1e-12 * high)[:, None]
        value = at(rows, low + wide * _points(degree))
        place = (boxes[rows] - low) / wide
        inside = (place >= 0.0) & (place <= 1.0)
        out[rows] = np.where(inside, _between(value, np.clip(place, 0.0, 1.0)), out[rows])
        np.maximum.at(top, rows // n_nodes, value.max(axis=1))
        change = _change(value)
        left = _left(change, value[:, 1::2] - top[rows // n_nodes, None])
        rows = rows[left]
        best, slack = top[rows // n_nodes], 2.0 * change[left].max(axis=1, initial=0.0)
        counts = out[rows] > (best - DEEP - slack)[:, None]
        rows, counts = rows[counts.any(axis=1)], counts[counts.any(axis=1)]
        low, high = _ends(boxes[rows], counts)
    if len(rows):
        out[rows] = at(rows, boxes[rows])
    return out.reshape(n_cells, n_nodes, -1)


def _left(change: FloatArray, below: FloatArray) -> BoolArray:
    """Rows (n,) whose polynomial is not good enough, by the change of ln L at new points (n, k).

    There ln L is ``below`` (n, k) the largest of the cell: 0 or less.
    """
    weight = np.exp(0.5 * np.minimum(below, 0.0))
    return np.asarray(((change * weight > TOLERANCE) | (change > RESOLVED)).any(axis=1))


def _ends(boxes: FloatArray, counts: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Range (n,) of the boxes (n, n_boxes) that count, with one more at each end."""
    last, row = boxes.shape[1] - 1, np.arange(len(boxes))
    begin, end = counts.argmax(axis=1) - 1, last - counts[:, ::-1].argmax(axis=1) + 1
    return boxes[row, np.maximum(begin, 0)], boxes[row, np.minimum(end, last)]
