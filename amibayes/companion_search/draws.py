"""Many data sets searched at once: with one covariance, or each with one estimated anew.

A covariance that came from the scatter of N integrations is not the true one. A simulated
data set is therefore another rotation of the integrations (`amibayes.likelihood.rotation_null`),
a mean d and a scatter of its own, and is searched with the estimate that these make. Its
covariance is that of all rotations less ddᵀ, its inverse another product of rank one: what
a template makes of it follows from two scalar products.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.scan import RunningMaximum, best_positive
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.likelihood.rotation_null import RotationNull
from amibayes.units import FloatArray, IntArray, SingleArray

MIN_REMAINING_VARIANCE = 1e-6
"""Share of its covariance that a drawn mean leaves; less can only be a sum of estimates."""


@dataclass(frozen=True, eq=False)
class Searched:
    """What a search of n data sets over the bank found.

    Parameters
    ----------
    gain : (n,) float array
        Largest gain in χ², for positive contrast.
    position : (n,) int array
        Where on the grid.
    chi2 : (n,) float array
        Without a companion, nuisance directions taken out.
    """

    gain: FloatArray
    position: IntArray
    chi2: FloatArray


def search_many(bank: TemplateBank, white: FloatArray, *, own_scales: bool = False) -> Searched:
    """Search data sets (n_data, n), whitened by the bank's own covariance.

    With ``own_scales`` each group of data is weighed by its own scatter; see
    `amibayes.companion_search.scan`. The gain is then that share of χ² which the weighted
    data lose.
    """
    data = bank.project(white)
    chi2 = (data**2).sum(axis=0)
    if not (own_scales and bank.groups.several):
        gain, position = bank.largest_gain(data.astype(np.float32))
        return Searched(gain, position, chi2)
    rows, weight, total = weighted(bank, data)
    gain, position = bank.largest_gain(rows.astype(np.float32), weight.astype(np.float32))
    return Searched(gain * chi2 / total, position, chi2)


def weighted(bank: TemplateBank, data: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weigh data (n_data, n) without nuisance directions by the scatter of their groups.

    Returns
    -------
    rows : (n_data, n) float array
        To be multiplied by templates.
    weight : (n_groups, n) float array
    total : (n,) float array
        Weighted χ².
    """
    weight = 1.0 / bank.groups.variances(data)
    rows = weight[bank.groups.label] * data
    return bank.project(rows), weight, (rows * data).sum(axis=0)


def search_simulated(
    bank: TemplateBank,
    noise: FloatArray,
    rng: np.random.Generator,
    signal: FloatArray | None = None,
    *,
    own_scales: bool = False,
) -> Searched:
    """Search simulated data sets, each with a covariance estimated anew where it was estimated.

    Parameters
    ----------
    bank : TemplateBank
    noise : (n_data, n) float array
        Independent unit normals.
    rng : numpy.random.Generator
        For the estimates.
    signal : (n_data, n) float array, optional
        What is in the data beside noise, whitened by the bank's own covariance.
    own_scales : bool
        As in `search_many`; an estimated covariance has measured them.
    """
    if bank.estimate is None:
        white = noise if signal is None else noise + signal
        return search_many(bank, white, own_scales=own_scales)
    drawn = bank.project(bank.estimate.draw(noise, rng))
    data = drawn if signal is None else drawn + bank.project(signal)
    inverse = _Inverse.of(bank.estimate, drawn)
    weighted = inverse.solve(data)
    chi2 = (data * weighted).sum(axis=0)
    rows = weighted.T.astype(np.float32)
    highest = RunningMaximum(len(rows))
    for index, templates in bank.by_band():
        highest.look(index, inverse.scores(templates.astype(np.float32), rows))
    return Searched(np.asarray(highest.score, dtype=float) ** 2, highest.position, chi2)


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


def profiled(gain: FloatArray, chi2: FloatArray, n_data: float) -> FloatArray:
    """Turn a gain in χ² into 2Δln L of a fit that scales the errors as well.

    With the scale of the noise free, 2Δln L = n ln(χ²/(χ² − gain)): residuals and errors of
    one data set grow together, and only their ratio counts.

    Parameters
    ----------
    gain : (n,) float array
    chi2 : (n,) float array
        Without the companion.
    n_data : float
        Number of independent data less the nuisance parameters.
    """
    return np.asarray(-n_data * np.log1p(-np.minimum(gain / chi2, 1.0 - 1e-15)))


def likelihood_ratio(
    bank: TemplateBank, gain: FloatArray, chi2: FloatArray, *, free_scale: bool
) -> FloatArray:
    """2Δln L of gains in χ² (n,) from a χ² without a companion (n,).

    The gain itself where the covariance is known, that of the t distribution where it was
    estimated, and that of `profiled` where the scale of the errors is free.
    """
    if free_scale:
        return profiled(gain, chi2, bank.n_data - bank.n_nuisance)
    if bank.freedom is None:
        return gain
    degrees = bank.freedom.degrees
    return profiled(gain, chi2 + degrees - 2.0, bank.n_data + degrees)
