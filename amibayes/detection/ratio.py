"""The statistic that a significance test makes of a gain in χ², and its local probability."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from amibayes.companion_search.scan import NO_SCATTER
from amibayes.units import FloatArray


@dataclass(frozen=True)
class Ratio:
    """The statistic of a gain in χ²: the gain itself, or twice the logarithm of a likelihood ratio.

    With the scale of the errors free, 2Δln L = n ln(χ²/(χ² − gain)): residuals and errors of one
    data set grow together, and only their ratio counts. Data whose covariance was estimated
    follow a t distribution, n + ν takes the place of n, and χ² has ν − 2 added.

    Parameters
    ----------
    n_free : int
        Independent data less the nuisance parameters.
    count : float
        n of the formula; infinite where the gain itself is the statistic.
    added : float
        What χ² has added.
    degrees : float
        Degrees of freedom of the covariance that count beside the n_free of the data; infinite
        where it is known.
    """

    n_free: int
    count: float = np.inf
    added: float = 0.0
    degrees: float = np.inf

    @classmethod
    def known(cls, n_free: int) -> Ratio:
        """The gain itself: errors are known."""
        return cls(n_free)

    @classmethod
    def scale_free(cls, n_free: int) -> Ratio:
        """2Δln L of fits that scale the errors as well."""
        return cls(n_free, n_free, 0.0, 0.0)

    @classmethod
    def student(cls, n_free: int, n_data: int, degrees: float) -> Ratio:
        """2Δln L of data with a covariance of ``degrees`` degrees of freedom."""
        return cls(n_free, n_data + degrees, degrees - 2.0, degrees)

    def __call__(self, gain: FloatArray, chi2: FloatArray | float) -> FloatArray:
        """Statistic of gains in χ² (n,) from a χ² without a companion (n,)."""
        if not np.isfinite(self.count):
            return gain
        share = np.minimum(gain / np.maximum(chi2 + self.added, NO_SCATTER), 1.0 - 1e-15)
        return np.asarray(-self.count * np.log1p(-share))

    def gain_at(self, statistic: FloatArray) -> FloatArray:
        """Gain in χ² of a statistic, any shape, if what is left of χ² is its expectation."""
        if not np.isfinite(self.count):
            return statistic
        return np.asarray((self.n_free + self.added) * np.expm1(statistic / self.count))

    def local_survival(self, statistic: FloatArray, n_contrasts: int = 1) -> FloatArray:
        """Probability that noise alone reaches the statistic at one given position, any shape.

        One side of a normal deviate, or of Student's t with the scale free or the covariance
        estimated: exact for one linear parameter. Of several bands each contrast is positive
        half of the time (exact where they are independent); of a motion it is at one rate.
        """
        x = np.asarray(statistic, dtype=float)
        k = np.arange(1, n_contrasts + 1)
        each = [self._beyond(x, int(number)) for number in k]
        return np.tensordot(stats.binom.pmf(k, n_contrasts, 0.5), each, axes=1)

    def _beyond(self, x: FloatArray, dof: int) -> FloatArray:
        """Probability that the gain by ``dof`` parameters, of either sign, exceeds x."""
        if not np.isfinite(self.count):
            return np.asarray(stats.chi2.sf(x, dof))
        rest = self.n_free + self.degrees - dof
        return np.asarray(stats.f.sf(np.expm1(x / self.count) * rest / dof, dof, rest))
