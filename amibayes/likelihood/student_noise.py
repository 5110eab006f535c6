"""Student-t residuals with the scale of the errors averaged: for posteriors and evidences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array

from amibayes.data.observables import Observables
from amibayes.likelihood.averaged_noise import (
    AveragedNoise,
    NoiseTerm,
    differences_of,
    kinds_of,
    with_nodes,
)
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import LOG_TWO_PI, NoiseModel
from amibayes.likelihood.student import DEGREES, normal_moments, symmetric_whitening
from amibayes.units import FloatArray


@dataclass(frozen=True, eq=False)
class StudentTerm(NoiseTerm):
    """Data with t distributed residuals that share one unknown scale of their errors.

    ``whitening`` gives every datum's residual in its stated error, ``share`` the independent
    data that it stands for.
    """

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return round(float(self.share.sum()))

    def log_likelihoods(self, difference: FloatArray, node: FloatArray) -> FloatArray:
        """ln L (n_nodes, n) of data minus model (n_data, n) for scales exp(node)."""
        moments, square = normal_moments(), np.asarray(self.whitening @ difference) ** 2
        power = 0.5 * moments.power * (DEGREES + 1.0)
        slopes = [self.share @ np.log1p(square / (DEGREES * np.exp(2.0 * u))) for u in node]
        norm = self.n_independent * (0.5 * LOG_TWO_PI + moments.efficiency * node)
        return np.asarray(-power * np.array(slopes) - norm[:, None] - 0.5 * self.log_det)


def student_terms(stated: Observables) -> list[StudentTerm]:
    """One term for each kind of observable, or one where the file correlates them."""
    data = stated.unflagged()
    frame = symmetric_whitening(data)
    white = data.covariance.whitening
    terms = []
    for kind, which, typical in kinds_of(data):
        share = frame.share[which]
        rows = diags_array(1.0 / np.sqrt(share)) @ frame.rows[which] @ white
        part = data.covariance.select(np.flatnonzero(which))
        terms.append(StudentTerm(kind, csr_array(rows), share, typical, part.logdet()))
    return terms


def averaged_student_noise(
    fit: NoiseModel,
    stated: Observables,
    fits: Sequence[tuple[Likelihood, FloatArray]],
    *,
    free_scale: bool = True,
) -> AveragedNoise:
    """The t likelihood of residuals, averaged over their scale.

    Parameters
    ----------
    fit : NoiseModel
        Of the search, outliers stretched.
    stated : Observables
        With the stated errors.
    fits : sequence of (Likelihood, (n_dim,) float array)
        As in `amibayes.likelihood.averaged_noise.averaged_noise`.
    free_scale : bool
        Whether the scale of the errors is unknown; else it is the stated one.
    """
    terms: list[NoiseTerm] = list(student_terms(stated))
    if free_scale:
        differences = differences_of(fits)
        terms = [with_nodes(t, differences) for t in terms]
    return AveragedNoise(fit, tuple(terms))
