"""How an extraction responds to light off the axis: its value at a place.

The response of a baseline to a point source is the ratio of the visibility that is
measured to the one that the source has. It is real and even to the accuracy that matters,
and its logarithm a polynomial of the even powers of the place.
"""

from __future__ import annotations

import numpy as np

from amibayes.units import FloatArray

EXPONENTS = np.array([(d - k, k) for d in (2, 4, 6) for k in range(d + 1)])
"""(n_coefficients, 2): powers of the two coordinates, of degree 2, 4 and 6."""


def even_powers(first: FloatArray, second: FloatArray) -> FloatArray:
    """Monomials (n_coefficients, n) of two coordinates (n,)."""
    a, b = (_powers(c) for c in (first, second))
    return np.asarray(a[EXPONENTS[:, 0]] * b[EXPONENTS[:, 1]])


def even_slopes(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of the monomials by either coordinate, (n_coefficients, n) each."""
    (a, b), (i, j) = (_powers(c) for c in (first, second)), EXPONENTS.T
    return (
        np.asarray(i[:, None] * a[np.maximum(i - 1, 0)] * b[j]),
        np.asarray(j[:, None] * a[i] * b[np.maximum(j - 1, 0)]),
    )


def _powers(coordinate: FloatArray) -> FloatArray:
    c = np.asarray(coordinate, dtype=float)
    return np.stack([c**k for k in range(int(EXPONENTS.max()) + 1)])
