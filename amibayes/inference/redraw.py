"""Many data sets searched at once: with one covariance, or each with one estimated anew.

A covariance that came from the scatter of N integrations is not the true one. A simulated
data set therefore gets a true covariance of its own, as far from the expected one as the
prior of the estimate allows, a scatter drawn with it, and is searched with the estimate
that they make together. Its templates are never formed: t·C⁻¹t of every template and data
set is one more matrix product, of the products of t's elements with the entries of C⁻¹.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.freedom import Freedom
from amibayes.inference.bank import TemplateBank
from amibayes.inference.positive import best_positive
from amibayes.units import FloatArray

IntArray = NDArray[np.intp]

MOST_ENTRIES = 6000
"""Entries of an inverse covariance (half of it) past which several data sets share one."""

SMALL = 8
"""Triangular matrices of this size or less are inverted as they are."""

ELEMENTS_AT_ONCE = 3_000_000
"""Elements of the covariances that are held at once."""


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


def search_many(bank: TemplateBank, white: FloatArray) -> Searched:
    """Search data sets (n_data, n), whitened by the bank's own covariance."""
    data = bank.project(white)
    gain, position = bank.largest_gain(data.astype(np.float32))
    return Searched(gain, position, (data**2).sum(axis=0))


def search_simulated(
    bank: TemplateBank,
    noise: FloatArray,
    rng: np.random.Generator,
    signal: FloatArray | None = None,
) -> Searched:
    """Search simulated data sets, each with a covariance estimated anew where it was estimated.

    Parameters
    ----------
    bank : TemplateBank
    noise : (n_data, n) float array
        Independent unit normals.
    rng : numpy.random.Generator
        For the covariances.
    signal : (n_data, n) float array, optional
        What is in the data beside noise, whitened by the bank's own covariance.
    """
    if bank.freedom is None:
        return search_many(bank, noise if signal is None else noise + signal)
    size, n = noise.shape
    sharing = max(1, size * (size + 1) // 2 // MOST_ENTRIES)
    step = sharing * max(1, ELEMENTS_AT_ONCE // size**2)
    parts = []
    for k in range(0, n, step):
        part = noise[:, k : k + step]
        whose = np.arange(part.shape[1]) // sharing
        factors, estimates = drawn_estimates(int(whose[-1]) + 1, size, bank.freedom, rng)
        data = (factors[whose] @ part.T[:, :, None])[:, :, 0].T
        data = data if signal is None else data + signal[:, k : k + step]
        inverse = _without_nuisance(np.asarray(np.linalg.inv(estimates)), bank.nuisance_basis)
        parts.append(_search_each(bank, data, inverse, whose))
    names = ("gain", "position", "chi2")
    return Searched(*(np.concatenate([getattr(p, name) for p in parts]) for name in names))


def drawn_estimates(
    n: int, size: int, freedom: Freedom, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """True covariances and their estimates, in units of the bank's own covariance.

    The true one has the inverse-Wishart distribution that was the prior of the estimate
    (it is the unit matrix where there was none), the scatter a Wishart distribution, and
    the estimate is the posterior mean of the two.

    Returns
    -------
    factors : (n, size, size) float array
        L of each true covariance LLᵀ.
    estimates : (n, size, size) float array
    """
    prior = max(0.0, freedom.degrees - 2.0 - freedom.scatter)
    factors = np.broadcast_to(np.eye(size), (n, size, size))
    if prior > 0.0:
        drawn = _wishart_factors(n, size, prior + size + 1.0, rng)
        factors = lower_inverse(drawn).swapaxes(1, 2) * np.sqrt(prior)
    scatter = factors @ _wishart_factors(n, size, freedom.scatter, rng)
    total = prior * np.eye(size) + scatter @ scatter.swapaxes(1, 2)
    return np.asarray(factors), np.asarray(total / (freedom.degrees - 2.0))


def _wishart_factors(n: int, size: int, degrees: float, rng: np.random.Generator) -> FloatArray:
    """Factors (n, size, k) of Wishart matrices; by Bartlett's decomposition where it exists."""
    if degrees <= size:
        return rng.standard_normal((n, size, max(1, round(degrees))))
    factor = np.zeros((n, size, size))
    row, column = np.tril_indices(size, -1)
    factor[:, row, column] = rng.standard_normal((n, len(row)))
    diagonal = np.arange(size)
    factor[:, diagonal, diagonal] = np.sqrt(rng.chisquare(degrees - diagonal, (n, size)))
    return factor


def lower_inverse(factor: FloatArray) -> FloatArray:
    """Inverses of lower triangular matrices (n, size, size): by halves, twice as fast as `inv`."""
    size = factor.shape[1]
    if size <= SMALL:
        return np.asarray(np.linalg.inv(factor))
    half = size // 2
    above, below = lower_inverse(factor[:, :half, :half]), lower_inverse(factor[:, half:, half:])
    inverse = np.zeros_like(factor)
    inverse[:, :half, :half] = above
    inverse[:, half:, half:] = below
    inverse[:, half:, :half] = -(below @ factor[:, half:, :half] @ above)
    return inverse


def _without_nuisance(inverse: FloatArray, basis: FloatArray) -> FloatArray:
    """Inverse covariances (n, p, p) that do not see the directions of a basis (p, k)."""
    if not basis.size:
        return inverse
    seen = inverse @ basis
    inner = basis.T @ seen
    return np.asarray(inverse - seen @ np.linalg.solve(inner, seen.swapaxes(1, 2)))


def _search_each(
    bank: TemplateBank, data: FloatArray, inverse: FloatArray, whose: IntArray
) -> Searched:
    """Search data sets (p, n) with the inverse covariances (m, p, p) that ``whose`` names."""
    weighted = (inverse[whose] @ data.T[:, :, None])[:, :, 0]
    chi2 = np.einsum("np,pn->n", weighted, data)
    first, second = np.triu_indices(len(data))
    entries = inverse[:, first, second] * np.where(first == second, 1.0, 2.0)
    entries, weighted = entries.astype(np.float32), weighted.astype(np.float32)
    each = np.arange(data.shape[1])
    best, where = np.zeros(len(each), dtype=np.float32), np.zeros(len(each), dtype=np.intp)
    pairs = first, second
    for index, templates in bank.by_band():
        score = _scores(templates.astype(np.float32), weighted, entries, whose, pairs)
        top = score.argmax(axis=1)
        value = score[each, top]
        better = value > best
        best[better], where[better] = value[better], index[top[better]]
    return Searched(np.asarray(best, dtype=float) ** 2, where, chi2)


def _scores(
    templates: NDArray[np.float32],
    weighted: NDArray[Any],
    entries: NDArray[Any],
    whose: IntArray,
    pairs: tuple[IntArray, IntArray],
) -> NDArray[np.float32]:
    """Root of the gain in χ² of data sets (n) by templates (n_bands, p, m), (n, m)."""
    first, second = pairs
    norms = [np.sqrt(np.maximum(entries @ (t[first] * t[second]), 1e-12)) for t in templates]
    match = [weighted @ t / norm[whose] for t, norm in zip(templates, norms, strict=True)]
    if len(match) == 1:
        return np.asarray(match[0])
    shared = {}
    for b in range(len(match)):
        for a in range(b):
            t, s = templates[a], templates[b]
            product = entries @ (0.5 * (t[first] * s[second] + t[second] * s[first]))
            shared[a, b] = (product / (norms[a] * norms[b]))[whose]
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


def twice_log_ratio(
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
