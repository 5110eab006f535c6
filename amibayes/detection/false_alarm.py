"""The chance that noise alone, anywhere in the field, looks as good as what was found.

The statistic of the data and of every simulated null data set is one and the same object
(`amibayes.detection.statistic`). In whitened data a null set is a vector of independent unit
normals, so ten thousand searches are two matrix products.

The template bank is linear in the contrast. Beside two stars of nearly equal brightness a star
alone leaves residuals of hundreds of errors, closure phases of 180° among them, and none of the
bank's templates need look like them: their share of the residuals may be no more than what noise
as large has. The model of the best fit does look like them, and noise as large hardly ever does:
`beside_bright`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.scan import scale_groups
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.exposure_noise import ExposureNoise
from amibayes.detection.randomised import Randomised
from amibayes.detection.statistic import BankStatistic, Statistic
from amibayes.detection.tails import (
    MIN_PROBABILITY,
    TAIL_FRACTION,
    Tail,
    clopper_pearson,
    extreme_value_survival,
    pareto_survival,
    tail_of,
)
from amibayes.detection.treatments import FreeScale
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.parallel import Executor, Journal, Progress
from amibayes.support.arguments import checks_arguments, in_range
from amibayes.support.notebook import Rows, Shown, ranged
from amibayes.support.options import ALPHA
from amibayes.units import FloatArray

MIN_ABOVE = 10
"""Draws that have to reach a statistic for their share to be its probability."""


@dataclass(frozen=True, eq=False, repr=False)
class Significance(Shown):
    """Global false-alarm probability of a search.

    Parameters
    ----------
    statistic : float
        Largest gain in χ² over the bank, for the data.
    null : (n_draws,) float array
        The same for noise alone, sorted.
    probability : float
        (1 + number of draws at least as large) / (1 + number of draws); by randomised
        residuals, where that is the larger one.
    interval : (float, float)
        95 % Clopper–Pearson interval of the probability.
    tail : Tail or None
        Extrapolation, where the draws reach no further (fewer than 10 at least as large).
    alpha : float
        Detection means that the upper end of the interval is below ``alpha``.
    test : Statistic, optional
        What was evaluated and drawn.
    field : (n_grid,) float array, optional
        The statistic of the data at every position of the bank.
    randomised : Randomised, optional
        The check that owes nothing to the model of the noise.
    bright : float, optional
        The probability, where it is the bound of `beside_bright`.
    """

    statistic: float
    null: FloatArray
    probability: float
    interval: tuple[float, float]
    tail: Tail | None
    alpha: float
    test: Statistic | None = None
    field: FloatArray | None = None
    randomised: Randomised | None = None
    bright: float | None = None

    def rows(self) -> Rows:
        """What an interpreter shows."""
        few = f"cannot be told below {self.alpha:.3g} with so few draws"
        return [
            ("statistic", f"{self.statistic:.4g}"),
            ("false-alarm probability", ranged(self.probability, self.interval)),
            ("null draws", f"{self.n_draws}, {self.n_above} of them as large"),
            ("extrapolated", "no" if self.tail is None else "by a generalised Pareto law"),
            ("detected", few if self.detected is None else str(self.detected)),
        ]

    @property
    def exposures(self) -> ExposureNoise | None:
        """What exposures share of the noise, in null draws too."""
        return None if self.test is None else self.test.exposures

    @property
    def n_draws(self) -> int:
        """Number of null data sets."""
        return len(self.null)

    @property
    def parametric(self) -> float:
        """(1 + number of null draws at least as large) / (1 + number of null draws)."""
        return (1 + self.n_above) / (1 + self.n_draws)

    @property
    def n_above(self) -> int:
        """Number of null draws at least as large as the statistic."""
        return int((self.null >= self.statistic).sum())

    @property
    def detected(self) -> bool | None:
        """Whether the false-alarm probability is below alpha, with confidence.

        The upper end of its interval counts; None where so few were drawn that it could not
        be below.
        """
        if not reachable(self.alpha, self.n_draws):
            return None
        return self.interval[1] < self.alpha

    def beside(self, check: Randomised) -> Significance:
        """State the larger of this probability and that by randomised residuals."""
        if check.probability is None or check.interval is None:
            return replace(self, randomised=check)
        if check.probability <= self.probability:
            return replace(self, randomised=check)
        return replace(
            self,
            probability=check.probability,
            interval=check.interval,
            tail=None,
            randomised=check,
        )

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


@checks_arguments
def significance(
    test: Statistic,
    n_draws: int,
    rng: np.random.Generator,
    alpha: float = ALPHA,
    *,
    observed: float | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Significance:
    """Simulate the null distribution of a search and place the observed statistic in it.

    Parameters
    ----------
    test : Statistic
        Of the very search that was run; see `amibayes.detection.statistic.statistic_of`.
    n_draws : int
        At least 1.
    rng : numpy.random.Generator
    alpha : float
    observed : float, optional
        The observed statistic; by default that of the data of ``test``.
    executor, progress, journal
        As in `amibayes.detection.statistic.BankStatistic.draw_null`.
    """
    in_range("significance", "n_draws", n_draws, 1)
    in_range("significance", "alpha", alpha, 0.0, 1.0)
    if observed is None:
        observed = float(test.evaluate(test.observed[:, None])[0])
    drawn = test.draw_null(n_draws, rng, executor=executor, progress=progress, journal=journal)
    null = np.sort(drawn)
    above = int((null >= observed).sum())
    extrapolate = above < MIN_ABOVE <= n_draws * TAIL_FRACTION
    return Significance(
        observed,
        null,
        (1 + above) / (1 + n_draws),
        clopper_pearson(above, n_draws),
        tail_of(null, observed, rng) if extrapolate else None,
        alpha,
        test,
    )


def reachable(alpha: float, n_draws: int) -> bool:
    """Whether so many draws, none of them above, would put the probability below alpha."""
    return n_draws > 0 and clopper_pearson(0, n_draws)[1] < alpha


def draws_needed(alpha: float) -> int:
    """Smallest number of draws from which a probability below alpha can be told."""
    n = int(np.ceil(np.log(0.025) / np.log1p(-alpha)))
    return n if reachable(alpha, n) else n + 1


BRIGHT = 0.1
"""Contrast from which data are not linear in it."""

EXPLAINED, IN_ALL_GROUPS = 0.9, 0.6
"""Least share of the squared residuals of the star alone that the companion explains: in units of
the errors, and with each group of data scaled to unit scatter (some may hold little but noise)."""

EXPLAINED_BESIDE_NOISE = 0.99
"""The same share of all data where noise was added to the stated errors. With the noise the best
fit leaves what its errors are: then 1 % of the residuals of the star alone, a tenth in amplitude,
which the model does not explain and noise is taken for."""

PLACES, CONTRASTS, NUISANCE = 16, 32, 8
"""Models that are counted: places at each position of the bank (a quarter of its step apart),
contrasts, and values of each other parameter."""

LEAST = 1e-10
"""Least probability that is stated: no model of noise is known further."""

BETWEEN = np.radians(8.0)
"""Largest angle between any model, as whitened data, and the nearest one that is counted: a
quarter of λ/8B turns fringes by 11°, half of that to either side."""


def beside_bright(tested: Significance, result: SearchResult, noise: ExtraNoise) -> Significance:
    """State the probability of a bright companion where that of the template bank is larger.

    Parameters
    ----------
    tested : Significance
    result : SearchResult
    noise : ExtraNoise
        What residuals show beside the stated errors. Where it is any, the companion has to explain
        more of the residuals, `EXPLAINED_BESIDE_NOISE`; else ``tested`` is given back.

    Notes
    -----
    Both probabilities are asked, so that the smaller one counts twice.
    """
    if tested.detected is not False:
        return tested
    most = (1.0 - EXPLAINED_BESIDE_NOISE) * result.chi2_single
    if noise.exceeds_stated and result.chi2_binary > most:
        return tested
    bound = bright_probability(result, tested.test)
    if bound is None or 2.0 * bound >= tested.probability:
        return tested
    p = max(2.0 * bound, LEAST)
    return replace(tested, probability=p, interval=(0.0, p), tail=None, bright=p)


def bright_probability(result: SearchResult, test: Statistic | None) -> float | None:
    """Upper bound of the probability that noise alone looks like the companion of the best fit.

    None where the companion is faint, explains less than `EXPLAINED`, or the errors are no
    free scales of groups of data. ``test`` is that of the search.

    Notes
    -----
    Noise of a free scale has no preferred direction among the data. The probability that it lies
    within an angle of a given model is that of the template bank's statistic at one position; the
    number of models within `BETWEEN` of each other bounds that of any of them.
    """
    left = result.chi2_binary > (1.0 - EXPLAINED) * result.chi2_single
    if left or result.companion.contrast < BRIGHT:
        return None
    if not isinstance(test, BankStatistic) or not isinstance(test.treatment, FreeScale):
        return None
    bank = TemplateBank(test.likelihood, test.bank.grid, test.single)
    share = _share(result, test, bank, test.treatment.least)
    if share < IN_ALL_GROUPS:
        return None
    angle = np.arccos(np.sqrt(min(share, 1.0))) + BETWEEN
    statistic = -test.ratio.count * np.log1p(-(np.cos(angle) ** 2))
    local = float(test.ratio.local_survival(np.array(statistic)))
    places = len(bank.grid) * len(bank.rates_mas_yr) * PLACES
    models = places * CONTRASTS**bank.n_contrasts * NUISANCE**bank.n_nuisance
    return float(min(1.0, models * local))


def _share(result: SearchResult, test: BankStatistic, bank: TemplateBank, least: float) -> float:
    """Share of the squared residuals that the companion's change of the data has along them.

    Groups of data are weighted by their scatter beside the star alone, as the statistic does.
    """
    left = test.likelihood.residuals(np.atleast_2d(result.theta))[:, 0]
    alone = bank.project(test.observed)
    change = bank.project(test.observed - left)
    data, rows = test.likelihood.observables, test.likelihood.noise.rows
    groups = scale_groups(data, bank.n_nuisance, rows)
    scale = FreeScale.measured(groups, bank, test.observed, least).scale
    first, second = alone / scale, change / scale
    along = float(first @ second)
    size = float(first @ first) * float(second @ second)
    return along**2 / size if along > 0.0 and size > 0.0 else 0.0
