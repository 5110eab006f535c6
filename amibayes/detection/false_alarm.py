"""The chance that noise alone, anywhere in the field, looks as good as what was found.

The statistic of the data and of every simulated null data set is one and the same: the
largest gain in χ² over the template bank, for positive contrast, nuisance directions
projected out. In whitened data a null set is a vector of independent unit normals, so ten
thousand searches are two matrix products. Where the covariance was estimated, a null set
is another rotation of the integrations, with an estimate of its own (see
`amibayes.companion_search.draws`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import stats

from amibayes.companion_search.draws import (
    Searched,
    likelihood_ratio,
    search_many,
    search_simulated,
    weighted,
)
from amibayes.companion_search.scan import weighted_gain
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.tails import (
    MIN_PROBABILITY,
    TAIL_FRACTION,
    Tail,
    extreme_value_survival,
    pareto_survival,
    tail_of,
)
from amibayes.likelihood.student import SymmetricWhitening, scores
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.support.options import ALPHA
from amibayes.units import FloatArray

MIN_ABOVE = 10
"""Draws that have to reach a statistic for their share to be its probability."""

DRAWS_AT_ONCE = 2048
"""Null data sets per matrix product: what keeps the product in cache."""


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
    field : (n_grid,) float array, optional
        The statistic of the data at every position of the bank.
    n_free : int
        Number of independent data less the nuisance parameters.
    degrees : float
        Degrees of freedom of the t distribution of the data; infinite for a Gaussian.
    n_contrasts : int
        Number of bands with a contrast of their own.
    """

    statistic: float
    null: FloatArray
    probability: float
    interval: tuple[float, float]
    tail: Tail | None
    alpha: float
    free_scale: bool = False
    field: FloatArray | None = None
    n_free: int = 0
    degrees: float = np.inf
    n_contrasts: int = 1

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

    @property
    def reach(self) -> float:
        """Statistic beyond which fewer than `MIN_ABOVE` draws count: past it, extrapolation."""
        return float(self.null[-min(MIN_ABOVE, self.n_draws)])

    def survival(self, statistic: FloatArray) -> FloatArray:
        """Global false-alarm probability of any values of the statistic, same shape.

        The share of the draws as far as they `reach`; past that the generalised Pareto law,
        joined without a step.
        """
        x, n = np.asarray(statistic, dtype=float), self.n_draws
        counted = (1.0 + n - np.searchsorted(self.null, x, side="left")) / (1.0 + n)
        if n * TAIL_FRACTION < MIN_ABOVE:
            return np.asarray(counted)
        at_reach = (1.0 + min(MIN_ABOVE, n)) / (1.0 + n)
        law = pareto_survival(self.null, np.maximum(x, self.reach))
        law *= at_reach / pareto_survival(self.null, np.array(self.reach))
        return np.where(x > self.reach, np.maximum(law, MIN_PROBABILITY), counted)

    def local_survival(self, statistic: FloatArray) -> FloatArray:
        """Probability that noise alone reaches the statistic at one given position.

        One side of a normal deviate (Δχ²), or of Student's t with the scale free or the
        covariance estimated: exact for one linear parameter, so it needs no draws. The
        covariance's own error is that of the t distribution of the data. Of several bands each
        contrast is positive half of the time (exact where they are independent); of a motion it
        is at one rate.
        """
        x = np.asarray(statistic, dtype=float)
        count = self.n_free if self.free_scale else self.n_free + self.degrees
        if self.n_contrasts > 1:
            k = np.arange(1, self.n_contrasts + 1)
            each = [_beyond(x, int(number), count) for number in k]
            return np.tensordot(stats.binom.pmf(k, self.n_contrasts, 0.5), each, axes=1)
        if not np.isfinite(count):
            return np.asarray(stats.norm.sf(np.sqrt(x)))
        return np.asarray(stats.t.sf(np.sqrt((count - 1) * np.expm1(x / count)), count - 1))

    def tail_curves(self) -> dict[str, tuple[FloatArray, FloatArray]]:
        """Both fitted laws, for a picture: statistic and probability to exceed it."""
        if self.tail is None:
            return {}
        begin = float(np.quantile(self.null, 1.0 - TAIL_FRACTION))
        x = np.linspace(begin, max(self.statistic, 1.5 * float(self.null[-1])), 300)
        return {
            "generalised Pareto law of the largest draws": (x, pareto_survival(self.null, x)),
            "extreme-value law of blocks' maxima": (x, extreme_value_survival(self.null, x)),
        }


def _beyond(x: FloatArray, dof: int, count: float) -> FloatArray:
    """Probability that the gain by ``dof`` parameters, of either sign, exceeds x."""
    if not np.isfinite(count):
        return np.asarray(stats.chi2.sf(x, dof))
    ratio = np.expm1(x / count) * (count - dof) / dof
    return np.asarray(stats.f.sf(ratio, dof, count - dof))


def bank_statistic(
    bank: TemplateBank,
    white: FloatArray,
    *,
    free_scale: bool,
    frame: SymmetricWhitening | None = None,
) -> FloatArray:
    """Statistic of data sets (n_data, n) whitened by the covariance of the bank.

    With a ``frame`` that of `amibayes.likelihood.student.scores`: outliers count no more than
    their bounded score, in the data and in the null sets.
    """
    own = free_scale and frame is None
    found = search_many(bank, bounded(bank, white, frame), own_scales=own)
    return likelihood_ratio(bank, found.gain, found.chi2, free_scale=free_scale)


def bounded(bank: TemplateBank, white: FloatArray, frame: SymmetricWhitening | None) -> FloatArray:
    """Scores of whitened data (n_data, n) that no outlier can dominate; the data without frame."""
    return white if frame is None else scores(frame, bank.project(white))


def statistic_field(
    bank: TemplateBank,
    white: FloatArray,
    *,
    free_scale: bool,
    frame: SymmetricWhitening | None = None,
) -> FloatArray:
    """Statistic of one whitened data set (n_data,) at every position, (n_grid,).

    Its maximum is that of `bank_statistic`.
    """
    data = bank.project(bounded(bank, white[:, None], frame))
    if free_scale and frame is None and bank.groups.several:
        gain, chi2 = _weighted_field(bank, data)
    else:
        gain, chi2 = bank.survey(data[:, 0]).gain, float((data**2).sum())
    return likelihood_ratio(bank, gain, np.full(len(gain), chi2), free_scale=free_scale)


def _weighted_field(bank: TemplateBank, data: FloatArray) -> tuple[FloatArray, float]:
    """Gain in weighted χ² of one data set (n_data, 1) everywhere, and its weighted χ²."""
    rows, weight, total = weighted(bank, data)
    gain = np.zeros(len(bank))
    for index, units in bank.by_band():
        match = [rows.T @ unit for unit in units]
        found = weighted_gain(bank.groups, units, match, weight)[0]
        gain[index] = np.maximum(gain[index], found)
    return gain, float(total[0])


def null_maxima(
    bank: TemplateBank,
    n_draws: int,
    rng: np.random.Generator,
    *,
    free_scale: bool = False,
    frame: SymmetricWhitening | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> FloatArray:
    """Statistic of ``n_draws`` null data sets, (n_draws,): the largest gain over the bank.

    Parameters
    ----------
    bank : TemplateBank
    n_draws : int
    rng : numpy.random.Generator
    free_scale : bool
        Use the statistic of `profiled`, for noise whose size was fitted, in each group of data
        by itself; see `amibayes.companion_search.scan`.
    frame : SymmetricWhitening, optional
        Use the robust statistic; see `bank_statistic`.
    executor : Executor, optional
        Where it is computed; the result does not depend on it.
    progress : callable, optional
        Told (pieces done, pieces in all).
    journal : Journal, optional
        Keeps finished pieces.

    Notes
    -----
    Products are done in single precision: a relative error of 1e-6 of the statistic,
    against a scatter between draws of tens of per cent.
    """
    sizes = [len(range(n_draws)[part]) for part in slices(n_draws, DRAWS_AT_ONCE)]
    pieces = list(zip(spawn(rng, len(sizes)), sizes, strict=True))
    work = partial(_null_piece, bank, free_scale, frame)
    executor = executor or SerialExecutor()
    done = run_job(work, pieces, executor, journal=journal, progress=progress)
    return np.concatenate([piece["statistic"] for piece in done])


def _null_piece(
    bank: TemplateBank,
    free_scale: bool,
    frame: SymmetricWhitening | None,
    piece: tuple[np.random.SeedSequence, int],
) -> dict[str, FloatArray]:
    seed, size = piece
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal((bank.n_data, size), dtype=np.float32).astype(float)
    own = free_scale and frame is None
    noise = noise * bank.scale[:, :1] if own and bank.estimate is None else noise
    found = search_drawn(bank, noise, rng, frame, own_scales=own)
    return {"statistic": likelihood_ratio(bank, found.gain, found.chi2, free_scale=free_scale)}


def search_drawn(
    bank: TemplateBank,
    noise: FloatArray,
    rng: np.random.Generator,
    frame: SymmetricWhitening | None = None,
    signal: FloatArray | None = None,
    *,
    own_scales: bool = False,
) -> Searched:
    """Search simulated data sets as the observed one is searched, robustly or not.

    Parameters
    ----------
    bank : TemplateBank
    noise : (n_data, n) float array
        Independent unit normals.
    rng : numpy.random.Generator
        For what is estimated from every data set.
    frame : SymmetricWhitening, optional
        Of the robust statistic.
    signal : (n_data, n) float array, optional
        What is in the data beside noise, whitened.
    own_scales : bool
        As in `amibayes.companion_search.draws.search_many`, for the statistic free of scales.
    """
    if frame is None:
        return search_simulated(bank, noise, rng, signal, own_scales=own_scales)
    white = noise if signal is None else noise + signal
    return search_many(bank, bounded(bank, white, frame))


def significance(
    bank: TemplateBank,
    statistic: float,
    n_draws: int,
    rng: np.random.Generator,
    alpha: float = ALPHA,
    *,
    free_scale: bool = False,
    frame: SymmetricWhitening | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
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
    frame, executor, progress, journal
        As in `null_maxima`.
    """
    null = np.sort(
        null_maxima(
            bank,
            n_draws,
            rng,
            free_scale=free_scale,
            frame=frame,
            executor=executor,
            progress=progress,
            journal=journal,
        )
    )
    above = int((null >= statistic).sum())
    extrapolate = above < MIN_ABOVE <= n_draws * TAIL_FRACTION
    tail = tail_of(null, statistic, rng) if extrapolate else None
    return Significance(
        statistic,
        null,
        (1 + above) / (1 + n_draws),
        clopper_pearson(above, n_draws),
        tail,
        alpha,
        free_scale,
        n_free=bank.n_data - bank.n_nuisance,
        degrees=np.inf if bank.freedom is None else bank.freedom.degrees,
        n_contrasts=bank.n_contrasts,
    )


def clopper_pearson(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Exact binomial interval of a probability (Clopper & Pearson 1934)."""
    rest = 0.5 * (1.0 - level)
    low = stats.beta.ppf(rest, successes, trials - successes + 1) if successes else 0.0
    high = stats.beta.isf(rest, successes + 1, trials - successes) if successes < trials else 1.0
    return float(low), float(high)
