"""Calendar dates and modified Julian days."""

from __future__ import annotations

from datetime import date

import numpy as np

from amibayes.units import FloatArray

DAY_ZERO = date(1858, 11, 17).toordinal()


def mjd_of_date(text: str) -> float:
    """MJD of midnight of ``YYYY-MM-DD`` (what follows a T does not count); NaN for no date."""
    try:
        return float(date.fromisoformat(text.split("T")[0]).toordinal() - DAY_ZERO)
    except ValueError:
        return float("nan")


def first_date(mjd: FloatArray) -> str:
    """``YYYY-MM-DD`` of the earliest finite MJD; of day 0 where there is none."""
    known = mjd[np.isfinite(mjd)]
    day = int(np.floor(known.min())) if len(known) else 0
    limits = date.min.toordinal(), date.max.toordinal()
    return date.fromordinal(int(np.clip(day + DAY_ZERO, *limits))).isoformat()
