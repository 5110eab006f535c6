"""The chance that noise alone, anywhere in the field, looks as good as what was found.

The statistic of the data and of every simulated null data set is one and the same: the
largest gain in χ² over the template bank, for positive contrast, nuisance directions
projected out. In whitened data a null set is a vector of independent unit normals, so ten
thousand searches are two matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from amibayes.inference.bank import TemplateBank
from amibayes.parallel import Executor, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.units import FloatArray

ALPHA = 0.0013
"""Default false-alarm probability below which a companion counts as detected (3σ, one side)."""

TAIL_FRACTION = 0.05
"""Share of the null draws above the threshold of the generalised Pareto fit."""

BOOTSTRAPS = 40

LEAST_PROBABILITY = 1e-30
"""Extrapolations below this are not told apart."""

DRAWS_AT_ONCE = 2048
"""Null data sets per matrix product: what keeps the product in cache."""


@dataclass(frozen=True, eq=False)
class Tail:
    """Extrapolation of the null distribution past its draws, by two families.

    Parameters
    ----------
    generalised_pareto, extreme_value : float
        Probability of the observed statistic by a generalised Pareto fit of the largest
        `TAIL_FRACTION` of the draws, and by a generalised extreme-value fit of all.
    log10_error : float
        Half the 68 % bootstrap interval of log10 of the Pareto probability, dex.
    """

    generalised_pareto: float
    extreme_value: float
    log10_error: float


@dataclass(frozen=True, eq=False)
class Significance:
    """Global false-alarm probability of a search.

    Parameters
    ----------
    statistic : float
        Largest gain in χ² over the bank, for the data.
    null : (n_draws,) float array
        The same for noise alone, sorted.
    probability : float
        (1 + number of draws at least as large) / (1 + number of draws).
    interval : (float, float)
        95 % Clopper–Pearson interval of the probability.
    tail : Tail or None
        Extrapolation, where the draws reach no further (fewer than 10 at least as large).
    alpha : float
        Detection means ``probability`` < ``alpha``.
    free_scale : bool
        The statistic is that of `profiled`: the size of the noise is not taken on trust.
    """

    statistic: float
    null: FloatArray
    probability: float
    interval: tuple[float, float]
    tail: Tail | None
    alpha: float
    free_scale: bool = False

    @property
    def n_draws(self) -> int:
        """Number of null data sets."""
        return len(self.null)

    @property
    def detected(self) -> bool | None:
        """Whether the false-alarm probability is below alpha; None where too few were drawn."""
        if 1.0 / (1.0 + self.n_draws) >= self.alpha:
            return None
        return self.probability < self.alpha

    def threshold(self, alpha: float | None = None) -> float:
        """Statistic that noise alone exceeds with probability alpha."""
        return float(np.quantile(self.null, 1.0 - (alpha or self.alpha)))


def profiled(gain: FloatArray, chi2: FloatArray, n_data: int) -> FloatArray:
    """Turn a gain in χ² into 2Δln L of a fit that scales the errors as well.

    With the scale of the noise free, 2Δln L = n ln(χ²/(χ² − gain)): residuals and errors of
    one data set grow together, and only their ratio counts.

    Parameters
    ----------
    gain : (n,) float array
    chi2 : (n,) float array
        Without the companion.
    n_data : int
        Number of independent data less the nuisance parameters.
    """
    return np.asarray(-n_data * np.log1p(-np.minimum(gain / chi2, 1.0 - 1e-15)))


def bank_statistic(bank: TemplateBank, white: FloatArray, *, free_scale: bool) -> FloatArray:
    """Statistic of whitened data sets (n_data, n), the observed one as well as null ones."""
    data = bank.project(white)
    gain, _ = bank.largest_gain(data.astype(np.float32))
    if not free_scale:
        return gain
    return profiled(gain, (data**2).sum(axis=0), bank.n_data - bank.n_nuisance)


def null_maxima(
    bank: TemplateBank,
    n_draws: int,
    rng: np.random.Generator,
    *,
    free_scale: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> FloatArray:
    """Statistic of ``n_draws`` null data sets, (n_draws,): the largest gain over the bank.

    Parameters
    ----------
    bank : TemplateBank
    n_draws : int
    rng : numpy.random.Generator
    free_scale : bool
        Use the statistic of `profiled`, for noise whose size was fitted.
    executor : Executor, optional
        Where it is computed; the result does not depend on it.
    progress : callable, optional
        Told (pieces done, pieces in all).

    Notes
    -----
    Products are done in single precision: a relative error of 1e-6 of the statistic,
    against a scatter between draws of tens of per cent.
    """
    sizes = [len(range(n_draws)[part]) for part in slices(n_draws, DRAWS_AT_ONCE)]
    pieces = list(zip(spawn(rng, len(sizes)), sizes, strict=True))
    work = partial(_null_piece, bank, free_scale)
    return np.concatenate(
        list(run_job(work, pieces, executor or SerialExecutor(), progress=progress))
    )


def _null_piece(
    bank: TemplateBank, free_scale: bool, piece: tuple[np.random.SeedSequence, int]
) -> FloatArray:
    seed, size = piece
    noise = np.random.default_rng(seed).standard_normal((bank.n_data, size), dtype=np.float32)
    return bank_statistic(bank, noise.astype(float), free_scale=free_scale)


def significance(
    bank: TemplateBank,
    statistic: float,
    n_draws: int,
    rng: np.random.Generator,
    alpha: float = ALPHA,
    *,
    free_scale: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Significance:
    """Simulate the null distribution of a search and place the observed statistic in it.

    Parameters
    ----------
    bank : TemplateBank
        Of the very search that was run.
    statistic : float
        Largest gain in χ² over that bank for the data.
    n_draws : int
        At least 1.
    rng : numpy.random.Generator
    alpha : float
    free_scale : bool
        The size of the noise was fitted: see `profiled`; the statistic has to be so too.
    executor, progress
        As in `null_maxima`.
    """
    null = np.sort(
        null_maxima(bank, n_draws, rng, free_scale=free_scale, executor=executor, progress=progress)
    )
    above = int((null >= statistic).sum())
    tail = _tail(null, statistic, rng) if above < 10 <= n_draws * TAIL_FRACTION else None
    return Significance(
        statistic,
        null,
        (1 + above) / (1 + n_draws),
        clopper_pearson(above, n_draws),
        tail,
        alpha,
        free_scale,
    )


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Exact binomial interval of a probability (Clopper & Pearson 1934)."""
    rest = 0.5 * (1.0 - level)
    low = stats.beta.ppf(rest, successes, trials - successes + 1) if successes else 0.0
    high = stats.beta.isf(rest, successes + 1, trials - successes) if successes < trials else 1.0
    return float(low), float(high)


def _tail(null: FloatArray, statistic: float, rng: np.random.Generator) -> Tail:
    pareto = _pareto_survival(null, statistic)
    resampled: NDArray[np.float64] = np.array(
        [
            _pareto_survival(np.sort(rng.choice(null, len(null))), statistic)
            for _ in range(BOOTSTRAPS)
        ]
    )
    shape, location, scale = stats.genextreme.fit(null, 0.0, loc=null.mean(), scale=null.std())
    logs = np.log10(np.maximum(resampled, LEAST_PROBABILITY))
    low, high = np.quantile(logs, [0.16, 0.84])
    extreme = float(stats.genextreme.sf(statistic, shape, location, scale))
    return Tail(pareto, extreme, float(0.5 * (high - low)))


def _pareto_survival(null: FloatArray, statistic: float) -> float:
    """P(null ≥ statistic) by a generalised Pareto law over a high threshold.

    Moments (Hosking & Wallis 1987) rather than maximum likelihood: they are explicit, and
    stable near the exponential tail that the maximum of a χ² field has.
    """
    excess = null[int(len(null) * (1.0 - TAIL_FRACTION)) :]
    threshold = excess[0]
    mean, variance = (excess - threshold).mean(), (excess - threshold).var(ddof=1)
    shape = 0.5 * (1.0 - mean * mean / variance)
    scale = 0.5 * mean * (1.0 + mean * mean / variance)
    return float(TAIL_FRACTION * stats.genpareto.sf(statistic - threshold, shape, scale=scale))
