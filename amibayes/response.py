"""How an extraction responds to light off the axis: its value at a place.

The response of a baseline to a point source is the ratio of the visibility that is
measured to the one that the source has. The image of a point is symmetric, so that the
logarithm of the ratio's modulus is even in the place and its phase odd: both are
polynomials. A baseline taken the other way round has the conjugate.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from amibayes.units import FloatArray

ComplexArray = NDArray[np.complex128]

EXPONENTS = np.array([(d - k, k) for d in (2, 4, 6, 1, 3, 5) for k in range(d + 1)])
"""(n_coefficients, 2): powers of the two coordinates; even degrees, then odd ones."""

IS_PHASE = np.asarray(EXPONENTS.sum(axis=1) % 2 == 1)
"""Which coefficients are of the phase."""

MODULUS, PHASE = slice(0, int((~IS_PHASE).sum())), slice(int((~IS_PHASE).sum()), len(EXPONENTS))
"""Where the coefficients of either stand."""

REVERSED = np.where(IS_PHASE, -1.0, 1.0)
"""Times the coefficients: those of the baseline taken the other way round."""


def monomials_at(first: FloatArray, second: FloatArray) -> FloatArray:
    """Monomials (n_coefficients, n) of two coordinates (n,)."""
    (a, b), (i, j) = (_powers(c) for c in (first, second)), EXPONENTS.T
    return np.asarray(a[i] * b[j])


def slopes_at(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Derivatives of `monomials_at` by either coordinate, (n_coefficients, n) each."""
    (a, b), (i, j) = (_powers(c) for c in (first, second)), EXPONENTS.T
    return (
        np.asarray(i[:, None] * a[np.maximum(i - 1, 0)] * b[j]),
        np.asarray(j[:, None] * a[i] * b[np.maximum(j - 1, 0)]),
    )


def _powers(coordinate: FloatArray) -> FloatArray:
    """All powers of a coordinate (n,) up to the highest, (n_powers, n)."""
    powers = np.ones((int(EXPONENTS.max()) + 1, len(coordinate)))
    powers[1:] = coordinate
    return np.asarray(np.multiply.accumulate(powers, axis=0))
