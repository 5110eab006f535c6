"""Numbers that fill an interval evenly, however many of them are taken."""

from __future__ import annotations

import numpy as np

from amibayes.units import FloatArray

GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


def evenly(n: int) -> FloatArray:
    """Give multiples of the golden ratio, modulo 1, (n,): from 0 on, below 1.

    Any run of them leaves gaps of at most three sizes (the theorem of Steinhaus).
    """
    return np.asarray(np.arange(n) * GOLDEN % 1.0)
