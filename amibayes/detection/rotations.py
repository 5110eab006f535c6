"""Data sets whose covariance was estimated: every simulated one is searched with its own estimate.

A covariance that came from the scatter of N integrations is not the true one. A simulated
data set is therefore another rotation of the integrations (`amibayes.likelihood.rotation_null`),
a mean d and a scatter of its own, and is searched with the estimate that these make. Its
covariance is that of all rotations less ddᵀ, its inverse another product of rank one: what
a template makes of it follows from two scalar products.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.scan import RunningMaximum, best_positive
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.companion_search.templates import highest_of
from amibayes.detection.treatments import ErrorTreatment, KnownErrors, Places, Searched
from amibayes.likelihood.rotation_null import RotationNull
from amibayes.units import FloatArray, SingleArray

MIN_REMAINING_VARIANCE = 1e-6
"""Share of its covariance that a drawn mean leaves; less can only be a sum of estimates."""


@dataclass(frozen=True, eq=False)
class Rotations(ErrorTreatment):
    """The covariance rests on integrations: null sets are other rotations of them.

    Parameters
    ----------
    null : RotationNull
        With the residuals of the data, which were noise too.
    """

    null: RotationNull
    null_rests_on_residuals = True
    linear_noise = False

    def search(self, bank: TemplateBank, white: FloatArray) -> Searched:
        """Search data sets (n_data, n) that the bank's own estimate whitened."""
        return KnownErrors().search(bank, white)

    def field(self, bank: Places, white: FloatArray) -> tuple[FloatArray, float]:
        """Gain in χ² of one data set (n_data,) at every position, and its χ²."""
        return KnownErrors().field(bank, white)

    def noise_of(self, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Means of other rotations, made of unit normals (n_data, n) and of what is no datum."""
        return self.null.draw(normals, rng)

    def search_simulated(
        self, bank: TemplateBank, noise: FloatArray, signal: FloatArray | None = None
    ) -> Searched:
        """Search simulated data sets, each with the covariance that goes with its mean.

        Parameters
        ----------
        bank : TemplateBank
        noise : (n_data, n) float array
            From `noise_of`.
        signal : (n_data, n) float array, optional
            What is in the data beside noise, whitened by the bank's own covariance.
        """
        drawn = bank.project(noise)
        data = drawn if signal is None else drawn + bank.project(signal)
        inverse = _Inverse.of(self.null, drawn)
        weighted = inverse.solve(data)
        chi2 = (data * weighted).sum(axis=0)
        rows = weighted.T.astype(np.float32)
        highest = RunningMaximum(len(rows))
        for index, templates in bank.by_band():
            score, top = highest_of(inverse.scores(templates.astype(np.float32), rows))
            highest.update(score, index[top])
        return Searched(np.asarray(highest.score, dtype=float) ** 2, highest.position, chi2)

    def with_noise_of(self, bank: TemplateBank, residuals: FloatArray) -> Rotations:
        """Make the same beside other residuals (n_data,)."""
        return Rotations(replace(self.null, residual=bank.project(residuals)))

    def contrast_error(self, bank: TemplateBank, places: FloatArray) -> FloatArray:
        """Error of a faint companion's contrast at places (n, 2), mas, (n,)."""
        return KnownErrors().contrast_error(bank, places)


@dataclass(frozen=True, eq=False)
class _Inverse:
    """Inverse covariances 1 − r rᵀ/s + w_i y_i y_iᵀ of data sets i, in whitened data.

    Parameters
    ----------
    common : (n_data,) float array
        r, the residuals of the data.
    size : float
        s.
    own : (n_data, n) float array
        y of each data set.
    weight : (n,) float array
    """

    common: FloatArray
    size: float
    own: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, estimate: RotationNull, drawn: FloatArray) -> _Inverse:
        """Of the estimates that go with drawn means (n_data, n), by Sherman and Morrison."""
        common, prior = estimate.residual, estimate.degrees - 2.0
        size = prior + float(common @ common)
        own = drawn - np.outer(common, common @ drawn / size)
        left = np.maximum(prior - (drawn * own).sum(axis=0), MIN_REMAINING_VARIANCE * prior)
        return cls(common, size, own, 1.0 / left)

    def solve(self, data: FloatArray) -> FloatArray:
        """Times data (n_data, n), each data set its own."""
        shared = data - np.outer(self.common, self.common @ data / self.size)
        return np.asarray(shared + self.own * (self.weight * (self.own * data).sum(axis=0)))

    def scores(self, templates: SingleArray, rows: SingleArray) -> SingleArray:
        """Root of the gain in χ² of data sets by templates (n_bands, n_data, m), (n, m).

        Parameters
        ----------
        templates : (n_bands, n_data, m) array
            Of unit norm.
        rows : (n, n_data) array
            Data sets times their inverse covariance.
        """
        own, weight = self.own.T.astype(np.float32), self.weight.astype(np.float32)[:, None]
        past = [self.common.astype(np.float32) @ t / np.float32(self.size**0.5) for t in templates]
        along = [own @ t for t in templates]
        square = [1.0 - p**2 + weight * a**2 for p, a in zip(past, along, strict=True)]
        norms = [np.sqrt(np.maximum(s, np.float32(1e-12))) for s in square]
        match = [rows @ t / norm for t, norm in zip(templates, norms, strict=True)]
        if len(match) == 1:
            return np.asarray(match[0])
        shared = {}
        for b in range(len(match)):
            for a in range(b):
                product = (templates[a] * templates[b]).sum(axis=0) - past[a] * past[b]
                product = product + weight * along[a] * along[b]
                shared[a, b] = product / (norms[a] * norms[b])
        return np.asarray(np.sqrt(np.maximum(best_positive(match, shared)[1], 0.0)))
