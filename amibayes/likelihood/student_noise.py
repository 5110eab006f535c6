"""Student-t residuals with the scale of the errors averaged: for posteriors and evidences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array, diags_array

from amibayes.data.observables import Observables
from amibayes.likelihood.averaged_noise import AveragedNoise, differences_of
from amibayes.likelihood.chi2 import LOG_TWO_PI
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import NoiseModel
from amibayes.likelihood.noise_terms import NoiseTerm, kinds_of, with_nodes
from amibayes.likelihood.residuals import groups_of
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


def student_terms(stated: Observables, *, per_file: bool = False) -> list[StudentTerm]:
    """One term for each kind of observable (and file), or one where the data correlate kinds.

    Every datum has a residual of its own, whatever correlates it with others, so that files
    which share calibrators have scales of their own all the same.
    """
    data = stated.unflagged()
    symmetric = symmetric_whitening(data)
    white = data.covariance.whitening
    terms = []
    for source, here in groups_of(data, per_file=per_file):
        for kind, which, typical in kinds_of(data, here):
            share = symmetric.share[which]
            rows = diags_array(1.0 / np.sqrt(share)) @ symmetric.rows[which] @ white
            log_det = data.covariance.select(np.flatnonzero(which)).logdet()
            terms.append(StudentTerm(kind, csr_array(rows), share, typical, log_det, source=source))
    return terms


def averaged_student_noise(
    fit: NoiseModel,
    stated: Observables,
    fits: Sequence[tuple[Likelihood, FloatArray]],
    *,
    free_scale: bool = True,
    per_file: bool = False,
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
    per_file : bool
        Whether every file has a scale of its own.
    """
    terms: list[NoiseTerm] = list(student_terms(stated, per_file=per_file))
    if free_scale:
        differences = differences_of(fits)
        terms = [with_nodes(t, differences) for t in terms]
    return AveragedNoise(fit, tuple(terms))
