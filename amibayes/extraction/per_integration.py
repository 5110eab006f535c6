"""The observables of every single integration, for whoever wants to see them change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.data.covariance import BlockCovariance
from amibayes.data.observables import Measurements, Observables, join
from amibayes.errors import DataError
from amibayes.extraction.extract import Extraction
from amibayes.units import FloatArray


def series(extraction: Extraction) -> tuple[FloatArray, FloatArray]:
    """V² (n, n_baselines) and closure phase (n, n_triangles) of the integrations in use."""
    mean = extraction.average
    n = len(mean.vis2)
    closure = mean.closure_phase + mean.deviation[:, n:]
    return mean.vis2 + mean.deviation[:, :n], closure


def integrations(extraction: Extraction) -> Observables:
    """Every integration in use as an epoch of its own, with the covariance of one.

    Raises
    ------
    DataError
        Where there is only one.
    """
    used = np.flatnonzero(extraction.frames.used)
    if len(used) < 2:
        raise DataError(
            "holds one integration only", source=extraction.sources[0], remedy="leave it as it is"
        )
    vis2, closure = series(extraction)
    mean = extraction.observables
    covariance = mean.covariance
    assert isinstance(covariance, BlockCovariance)
    n = len(used)
    blocks = [replace(b, matrix=b.matrix * n) for b in covariance.blocks]
    whole = BlockCovariance(covariance.size, blocks)
    # The scatter is that of these very data: what it does not tell of the covariance they do
    # not tell again, and a t likelihood of all of them would be too narrow.
    one = replace(mean, covariance=whole, covariance_kind="given", freedom=None, scatter=None)
    time = extraction.frames.mjd[used]
    parts = []
    for k in range(n):
        mjd = time[k] if np.isfinite(time[k]) else mean.vis2.mjd[0]
        parts.append(
            replace(
                one,
                vis2=_at(mean.vis2, vis2[k], mjd, n),
                closure_phase=_at(mean.closure_phase, closure[k], mjd, n),
            )
        )
    return join(parts)


def _at(table: Measurements, value: FloatArray, mjd: float, n: int) -> Measurements:
    return replace(
        table,
        value=value,
        mjd=np.full(len(value), mjd),
        integration_s=table.integration_s / n,
    )
