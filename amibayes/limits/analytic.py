"""Detection limits that need no injection: four criteria of the literature.

In whitened data with residuals r, χ² = r·r of the fit without a companion over ν degrees of
freedom, and the signal s(c) of a companion of contrast c at one position (what a free
diameter or background could do taken out of both), the limits at n sigma are the smallest c
with

=============== ==================================================================
absil           |r − s|² = X: the companion would worsen the fit of the data at
                hand (Absil et al. 2011)
candid          |r + s|² = X: a companion put into the data would improve it
                (Gallenne et al. 2015)
posterior       P(contrast > c | data) = Q(n), with contrasts from 0 to 1 taken as
                equally likely before (Ruffio et al. 2018)
closure-phase   |s| = 2n: of closure phases of that companion with noise drawn anew, a
                share 1 − Q(n) is fitted better by it than by no companion (pymask)
=============== ==================================================================

with X = χ² · χ²ᵥ⁻¹(2Q(n))/ν, the χ² that CANDID's nσ calls n sigma worse, and Q the upper
tail of the normal distribution. None of them is a false-alarm rate of a search over the
field, and absil, candid and posterior move with the noise of the data at hand.

For a faint companion s = c·t, and all four have closed forms in t·r and t·t, one vectorised
pass over the positions. Above `LINEAR` the signal is that of the full model.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import special, stats

from amibayes.companion_search.result import SearchResult
from amibayes.detection.statistic import Statistic, make_statistic
from amibayes.likelihood.combinations import combination_of, require
from amibayes.limits.rings import Rings, make_rings
from amibayes.support.arguments import checks_arguments, in_range
from amibayes.support.labelled import labelled
from amibayes.support.notebook import Rows, Shown
from amibayes.support.options import LIMITS_SEPARATIONS, AnalyticMethod
from amibayes.units import BoolArray, FloatArray, contrast_to_delta_mag

SIGMAS = 3.0

LINEAR = 0.01
"""Contrast up to which the linear signal is good to 0.02 mag."""

LADDER = np.concatenate([[0.0], np.geomspace(1e-3, 1.0, 61)])
"""Contrasts between which a limit of the full model is bracketed."""

HALVINGS = 40

COARSE, FINE, NEGLIGIBLE = 81, 161, 30.0
"""Nodes of the integrals over contrast, and how far in ln L from the best one nothing counts."""

SPREAD = (0.16, 0.5, 0.84)
"""Quantiles over the position angle."""

CRITERIA: dict[AnalyticMethod, str] = {
    "absil": "the companion would worsen the fit to the data by {0:g} sigma of CANDID's scale",
    "candid": "the companion, put into the data, would be fitted at {0:g} sigma of CANDID's scale",
    "posterior": "the contrast is below the limit with the probability of {0:g} sigma, one side",
    "closure-phase": "a share of {0:g} sigma, one side, of closure phases with the companion is "
    "fitted better by it than by no companion (delta chi2 {1:g})",
}


@dataclass(frozen=True, eq=False, repr=False)
class AnalyticLimit(Shown):
    """A limit by one of the closed criteria, at every position.

    Parameters
    ----------
    method : str
    sigmas : float
    separation_mas : (n,) float array
    contrast_at : (n, n_angles) float array
        NaN where a companion as bright as the star is not excluded.
    rings : Rings
        The positions.
    removed : bool
        A detected companion was taken out of the data first.
    """

    method: AnalyticMethod
    sigmas: float
    separation_mas: FloatArray
    contrast_at: FloatArray
    rings: Rings
    removed: bool = False

    def rows(self) -> Rows:
        """What an interpreter shows."""
        pairs = zip(self.separation_mas, self.delta_mag, strict=True)
        return [
            ("criterion", self.criterion),
            *((f"{rho:.4g} mas", f"{mag:.2f} mag") for rho, mag in pairs),
        ]

    @property
    def by_detection(self) -> BoolArray:
        """Where a companion counts wherever it is seen, (n,): nowhere."""
        return np.zeros(len(self.separation_mas), dtype=bool)

    def facts(self) -> dict[str, Any]:
        """What it means; see `amibayes.limits.limit.Limit`."""
        return {
            "criterion": self.criterion,
            "companion_removed": self.removed,
            "false_positive_rate": None,
            "completeness": None,
        }

    def columns(self) -> dict[str, FloatArray]:
        """No further ones."""
        return {}

    def cells(self) -> None:
        """None: there are no injections."""

    def to_xarray(self) -> Any:
        """The limit at every separation and over the position angle (extra ``xarray``).

        Returns
        -------
        xarray.Dataset
            Of separation_mas: ``contrast`` and ``delta_mag``, medians over the position angle;
            of (separation_mas, quantile): ``contrast_spread``.
        """
        along = ("separation_mas",)
        return labelled(
            {
                "contrast": (along, self.contrast),
                "delta_mag": (along, self.delta_mag),
                "contrast_spread": ((*along, "quantile"), self.spread),
            },
            {"separation_mas": self.separation_mas, "quantile": np.array(SPREAD)},
            {"method": self.method, "criterion": self.criterion},
        )

    @property
    def criterion(self) -> str:
        """What the limit means, in words."""
        return CRITERIA[self.method].format(self.sigmas, 4.0 * self.sigmas**2)

    @property
    def spread(self) -> FloatArray:
        """16, 50 and 84 % points over the position angle, (n, 3); NaN where not excluded."""
        faint = np.where(np.isnan(self.contrast_at), np.inf, self.contrast_at)
        points = np.quantile(faint, SPREAD, axis=1, method="lower").T
        return np.where(np.isfinite(points), points, np.nan)

    @property
    def contrast(self) -> FloatArray:
        """Median over the position angle, (n,)."""
        return np.asarray(self.spread[:, 1])

    @property
    def delta_mag(self) -> FloatArray:
        """The limit in magnitudes, (n,)."""
        return contrast_to_delta_mag(self.contrast)


@checks_arguments
def analytic_limit(
    result: SearchResult,
    method: AnalyticMethod,
    *,
    n_separations: int = LIMITS_SEPARATIONS,
    separation_mas: Sequence[float] | None = None,
    sigmas: float = SIGMAS,
    remove: bool = False,
) -> AnalyticLimit:
    """Compute a detection limit by a closed criterion.

    Parameters
    ----------
    result : SearchResult
        Its field, model and data are those of the limit. For ``closure-phase`` a search of
        closure phases only.
    method : {"absil", "candid", "posterior", "closure-phase"}
    n_separations : int
        Rings from the inner to the outer edge of the field.
    separation_mas : sequence of float, optional
        These rings instead.
    sigmas : float
    remove : bool
        Take the best fit's companion out of the data first, as one that is there hides
        behind the word residuals.

    Returns
    -------
    AnalyticLimit

    Raises
    ------
    UsageError
        Where bands have contrasts of their own, or the companion moves.
    """
    in_range("analytic_limit", "sigmas", sigmas, 0.0)
    likelihood = result.likelihood
    require(combination_of(likelihood, method="closed limits"), likelihood.observables.source)
    rings = make_rings(result, n_separations, separation_mas)
    problem = _Problem.of(result, method, sigmas, remove=remove)
    contrast, sigma = rings.sensitivity(problem.test.bank, problem.residuals)
    limit = _linear(problem, contrast.ravel(), sigma.ravel())
    bright = np.flatnonzero(~(limit <= LINEAR))
    if len(bright):
        limit[bright] = _exact(problem, rings.places[bright])
    at = limit.reshape(contrast.shape)
    return AnalyticLimit(method, sigmas, rings.separation_mas, at, rings, remove)


@dataclass(frozen=True, eq=False)
class _Problem:
    """One criterion on one data set."""

    test: Statistic
    method: AnalyticMethod
    sigmas: float
    residuals: FloatArray
    chi2: float
    worse: float

    @classmethod
    def of(
        cls, result: SearchResult, method: AnalyticMethod, sigmas: float, *, remove: bool
    ) -> _Problem:
        likelihood, single = result.likelihood, result.single_theta
        test = make_statistic(likelihood, result.grid, single, stated_errors=True)
        bank, residuals = test.bank, test.observed
        if remove:
            residuals = likelihood.residuals(result.theta)[:, 0]
        residuals = bank.project(residuals)
        chi2, dof = float(residuals @ residuals), bank.n_data - bank.n_nuisance
        worse = chi2 * float(stats.chi2.isf(2.0 * stats.norm.sf(sigmas), dof)) / dof
        return cls(test, method, sigmas, residuals, chi2, worse)

    def signal(self, contrast: FloatArray, places: FloatArray) -> FloatArray:
        """Whitened signal (n_data, n) of companions, what the nuisance could do taken out."""
        signal = self.test.signal_of(np.column_stack([places, contrast]))
        return self.test.bank.project(signal)


def _linear(problem: _Problem, contrast: FloatArray, sigma: FloatArray) -> FloatArray:
    """Limits of faint companions from the best contrast t·r/t·t and its error, (n,)."""
    if problem.method == "closure-phase":
        return 2.0 * problem.sigmas * sigma
    if problem.method == "posterior":
        log_tail = stats.norm.logsf(problem.sigmas) + special.log_ndtr(contrast / sigma)
        return np.asarray(contrast - sigma * special.ndtri_exp(log_tail))
    along = contrast if problem.method == "absil" else -contrast
    room = sigma**2 * (problem.worse - problem.chi2)
    return np.asarray(along + np.sqrt(along**2 + room))


def _exact(problem: _Problem, places: FloatArray) -> FloatArray:
    """Limits of bright companions (n,) by the full model; NaN where there is none below 1."""
    if problem.method == "posterior":
        return _exact_posterior(problem, places)
    excess = _excess(problem)
    above = np.array([excess(np.full(len(places), c), places) >= 0.0 for c in LADDER])
    first = above.argmax(axis=0)
    low, high = LADDER[np.maximum(first - 1, 0)], LADDER[first]
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        beyond = excess(middle, places) >= 0.0
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return np.where(above.any(axis=0), high, np.nan)


def _excess(problem: _Problem) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """How far a companion is beyond the criterion."""
    r = problem.residuals[:, None]
    goal = (2.0 * problem.sigmas) ** 2 if problem.method == "closure-phase" else problem.worse

    def excess(contrast: FloatArray, places: FloatArray) -> FloatArray:
        signal = problem.signal(contrast, places)
        seen = {"absil": r - signal, "candid": r + signal}.get(problem.method, signal)
        return np.asarray((seen**2).sum(axis=0) - goal)

    return excess


def _exact_posterior(problem: _Problem, places: FloatArray) -> FloatArray:
    """Quantile of the contrast's posterior between 0 and 1, by the trapezoidal rule.

    A coarse ladder finds the range of contrasts that counts at every place, a fine one
    integrates it.
    """
    coarse = np.linspace(0.0, 1.0, COARSE) ** 2
    log_like = _log_likelihood(problem, np.tile(coarse[:, None], len(places)), places)
    counts = log_like > log_like.max(axis=0) - NEGLIGIBLE
    first, last = counts.argmax(axis=0), COARSE - 1 - counts[::-1].argmax(axis=0)
    low, high = coarse[np.maximum(first - 1, 0)], coarse[np.minimum(last + 1, COARSE - 1)]
    nodes = np.linspace(low, high, FINE)
    log_like = _log_likelihood(problem, nodes, places)
    density = np.exp(log_like - log_like.max(axis=0))
    mass = np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(nodes, axis=0), axis=0)
    mass = np.vstack([np.zeros(len(places)), mass / mass[-1]])
    level = stats.norm.cdf(problem.sigmas)
    return np.array([np.interp(level, *pair) for pair in zip(mass.T, nodes.T, strict=True)])


def _log_likelihood(problem: _Problem, contrast: FloatArray, places: FloatArray) -> FloatArray:
    """Logarithm of the likelihood, but for a constant, of contrasts (k, n) at places (n, 2)."""
    r = problem.residuals[:, None]
    return np.array([-0.5 * ((r - problem.signal(c, places)) ** 2).sum(axis=0) for c in contrast])
