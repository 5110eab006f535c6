"""How well a calibrated covariance is known, from those of the target and its calibrators."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array

from amibayes.calibration.transfer import Transfer
from amibayes.data.covariance import BlockCovariance
from amibayes.data.degrees_of_freedom import Freedom, squared_share, welch_satterthwaite
from amibayes.data.observables import Observables


def response_freedom(
    calibrators: Sequence[Observables], transfers: Sequence[Transfer]
) -> Freedom | None:
    """Freedom of the mean of calibrators: each has the mean share that its errors give it.

    A fitted scatter between calibrators is taken as known: it is pooled over all data of a
    kind, and integrated over already.
    """
    seen = np.array([t.seen for t in transfers])
    variance = np.array([t.variance for t in transfers])
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=seen)
    known = seen.any(axis=0)
    share = (weight[:, known] / weight[:, known].sum(axis=0)).mean(axis=1)
    freedoms = [c.freedom for c in calibrators]
    return welch_satterthwaite(zip((share**2).tolist(), freedoms, strict=True))


def calibrated_freedom(
    whole: BlockCovariance,
    by_target: csr_array,
    target: Freedom | None,
    by_response: csr_array,
    response: Freedom | None,
) -> Freedom | None:
    """Freedom of a calibrated covariance, the sum of the target's and the response's part."""
    parts = (by_target, target), (by_response, response)
    return welch_satterthwaite((squared_share(c, whole), f) for c, f in parts if f is not None)
