"""One statistic for the data, null draws, injected companions, limits and vetting.

It is made once from a search, with the noise that was fitted there. Its value for a data set
is the largest gain in likelihood over the template bank, for positive contrast, nuisance
directions projected out. What it takes for known of the errors is an `ErrorTreatment`;
simulated data sets are drawn and searched by the same one as the data are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from amibayes.companion_search.grid import Grid
from amibayes.companion_search.result import SearchResult, null_likelihood
from amibayes.companion_search.scan import scale_groups
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.detection.exposure_noise import ExposureNoise, exposure_noise
from amibayes.detection.null_draws import noise_of_rows, null_draws
from amibayes.detection.ratio import Ratio
from amibayes.detection.rotations import Rotations
from amibayes.detection.treatments import (
    ErrorTreatment,
    FreeScale,
    KnownErrors,
    Searched,
    StudentScores,
)
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.linear_response import companions_beside
from amibayes.likelihood.rotation_null import rotation_null
from amibayes.likelihood.student import SymmetricWhitening
from amibayes.parallel import Executor, Journal, Progress
from amibayes.support.arguments import checks_arguments
from amibayes.units import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Hits:
    """What the statistic makes of n data sets.

    Parameters
    ----------
    statistic : (n,) float array
    gain : (n,) float array
        The gain in χ² behind it.
    position : (n,) int array
        Where on the grid.
    """

    statistic: FloatArray
    gain: FloatArray
    position: IntArray


class Statistic(Protocol):
    """What decides whether data hold a companion: asked by the data and by all simulated ones."""

    @property
    def likelihood(self) -> Likelihood:
        """Of the data, with the noise that was fitted."""

    @property
    def single(self) -> FloatArray:
        """The fit without a companion, (n_nuisance,)."""

    @property
    def bank(self) -> TemplateBank:
        """Positions that are searched, and what a companion does there."""

    @property
    def residual(self) -> FloatArray:
        """Data less the fit (n_data,) of the data that it was made from."""

    @property
    def observed(self) -> FloatArray:
        """The same whitened, (n_independent,)."""

    @property
    def label(self) -> str:
        """What its values are called."""

    @property
    def exposures(self) -> ExposureNoise | None:
        """What exposures share of the noise; None where they are independent."""

    def hits(self, white: FloatArray) -> Hits:
        """Search data sets, whitened residuals (n_data, n) of the fit without a companion."""

    def evaluate(self, white: FloatArray) -> FloatArray:
        """Statistic of whitened residuals (n_data, n), (n,)."""

    def field(self, white: FloatArray) -> FloatArray:
        """Statistic of one data set (n_data,) at every position, (n_grid,)."""

    def signal_of(self, companions: FloatArray) -> FloatArray:
        """Whitened change of the data (n_data, n) by companions (n, 3)."""

    def change_by(self, companions: FloatArray) -> FloatArray:
        """Change of the data (n_data, n) by companions (n, 3), not whitened."""

    def simulated(self, n: int, rng: np.random.Generator, signal: FloatArray | None = None) -> Hits:
        """Draw n data sets with the noise of the data, and a signal in them, and search them."""

    def draw_null(
        self,
        n: int,
        rng: np.random.Generator,
        *,
        executor: Executor | None = None,
        progress: Progress | None = None,
        journal: Journal | None = None,
    ) -> FloatArray:
        """Statistic of n data sets of noise alone, (n,)."""

    def noise(self, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Noise of data sets (n_data, n) out of unit normals; ``rng`` for what else is drawn."""

    def hits_in(self, noise: FloatArray, signal: FloatArray) -> Hits:
        """Search data sets of noise and a signal each, (n_data, n)."""

    def scatter_posterior(
        self, n: int, rng: np.random.Generator, *, stated_probable: bool
    ) -> FloatArray:
        """Draw what scatter the noise may really have: (n_data, n) or (1, n) factors."""

    def gain_at(self, statistic: FloatArray) -> FloatArray:
        """Gain in χ², in units of the noise, that reaches values of the statistic, any shape."""

    def contrast_error(self, places: FloatArray) -> FloatArray:
        """Error of a faint companion's contrast at places (n, 2), mas, (n,)."""

    def local_survival(self, statistic: FloatArray) -> FloatArray:
        """Probability that noise alone reaches a statistic at one given position, any shape."""

    def with_noise_of(self, residuals: FloatArray) -> Self:
        """Make the same with the noise of other whitened residuals (n_data,)."""

    @property
    def null_rests_on_residuals(self) -> bool:
        """Whether `with_noise_of` other residuals changes the distribution of null draws."""

    @property
    def linear_noise(self) -> bool:
        """Whether `noise` is linear in the unit normals that it is made of."""


@dataclass(frozen=True, eq=False)
class BankStatistic:
    """The largest gain in likelihood over a template bank.

    Parameters
    ----------
    likelihood : Likelihood
        With the noise that was fitted.
    single : (n_nuisance,) float array
        The fit without a companion.
    bank : TemplateBank
    treatment : ErrorTreatment
    ratio : Ratio
        What is made of a gain in χ².
    residual : (n_data,) float array
        Data less the fit, V² then closure phases in radians.
    exposures : ExposureNoise, optional
        What exposures share of the noise; by default they are independent.
    """

    likelihood: Likelihood
    single: FloatArray
    bank: TemplateBank
    treatment: ErrorTreatment
    ratio: Ratio
    residual: FloatArray
    exposures: ExposureNoise | None = None

    @property
    def observed(self) -> FloatArray:
        """Whitened residuals (n_independent,) of the data."""
        return self.likelihood.noise.whiten(self.residual)

    @property
    def label(self) -> str:
        """What its values are called."""
        return "Δχ²" if np.isinf(self.ratio.count) else "2Δln L, scale of the noise free"

    def hits(self, white: FloatArray) -> Hits:
        """Search data sets, whitened residuals (n_data, n) of the fit without a companion."""
        return self._hits(self.treatment.search(self.bank, self.bank.reduce(white)))

    def evaluate(self, white: FloatArray) -> FloatArray:
        """Statistic of whitened residuals (n_data, n), (n,)."""
        return self.hits(white).statistic

    @property
    def value(self) -> float:
        """The statistic of the data."""
        return float(self.evaluate(self.observed[:, None])[0])

    def field(self, white: FloatArray) -> FloatArray:
        """Statistic of one data set (n_data,) everywhere, (n_grid,); its maximum is `value`."""
        return self.ratio(*self.treatment.field(self.bank, self.bank.reduce(white)))

    def simulated(self, n: int, rng: np.random.Generator, signal: FloatArray | None = None) -> Hits:
        """Draw n data sets with the noise of the data, and search them; see `hits_in`."""
        return self.hits_in(self.noise(self.bank.normals(n, rng), rng), signal)

    def noise(self, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Noise of data sets (n_data, n) out of unit normals; ``rng`` for what else is drawn."""
        return noise_of_rows(self.treatment, self.exposures, normals, rng)

    def hits_in(self, noise: FloatArray, signal: FloatArray | None = None) -> Hits:
        """Search data sets of `noise` (n_data, n) and of a whitened signal each."""
        return self._hits(self.treatment.search_simulated(self.bank, noise, signal))

    def scatter_posterior(
        self, n: int, rng: np.random.Generator, *, stated_probable: bool
    ) -> FloatArray:
        """Draw what scatter the noise may have: (n_data, n) or (1, n) factors."""
        return self.treatment.scatter_posterior(n, rng, stated_probable=stated_probable)

    def _hits(self, found: Searched) -> Hits:
        return Hits(self.ratio(found.gain, found.chi2), found.gain, found.position)

    def signal_of(self, companions: FloatArray) -> FloatArray:
        """Whitened change of the data (n_rows, n) by companions on top of the fit without one.

        ``companions`` (n, 3): east_mas, north_mas, contrast (the same in every band, at rest).
        """
        return self.bank.reduce(self.likelihood.noise.whiten(self.change_by(companions)))

    def change_by(self, companions: FloatArray) -> FloatArray:
        """Change of the data (n_data, n) by companions (n, 3), not whitened; see `signal_of`."""
        likelihood, single = self.likelihood, self.single
        seen = likelihood.observe(companions_beside(likelihood, single, companions))
        alone = single_likelihood(likelihood).predict(np.atleast_2d(single))
        return likelihood.wrapped(seen - alone)

    @property
    def strongest(self) -> FloatArray:
        """East and north, mas, and contrast of what the data show most of, (1, 3)."""
        at, grid = int(self.field(self.observed).argmax()), self.bank.grid
        contrast = self.bank.scan(self.bank.reduce(self.observed))[0][at]
        return np.array([[grid.east_mas[at], grid.north_mas[at], max(contrast, 0.0)]])

    def draw_null(
        self,
        n: int,
        rng: np.random.Generator,
        *,
        executor: Executor | None = None,
        progress: Progress | None = None,
        journal: Journal | None = None,
    ) -> FloatArray:
        """Statistic of ``n`` null data sets, (n,).

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator
        executor, progress, journal : optional, see `amibayes.parallel.run_job`
        """
        return null_draws(
            self.bank, self.treatment, self.ratio, n, rng, exposures=self.exposures,
            executor=executor, progress=progress, journal=journal,
        )  # fmt: skip

    def gain_at(self, statistic: FloatArray) -> FloatArray:
        """Gain in χ², in units of the noise, that reaches values of the statistic, any shape."""
        return self.ratio.gain_at(statistic)

    def contrast_error(self, places: FloatArray) -> FloatArray:
        """Error of a faint companion's contrast at places (n, 2), mas, (n,)."""
        return self.treatment.contrast_error(self.bank, places)

    def local_survival(self, statistic: FloatArray) -> FloatArray:
        """Probability that noise alone reaches a statistic at one given position, any shape."""
        return self.ratio.local_survival(statistic, self.bank.n_contrasts)

    def with_noise_of(self, residuals: FloatArray) -> Self:
        """Make the same with the noise of other whitened residuals (n_data,)."""
        measured = self.treatment.with_noise_of(self.bank, self.bank.reduce(residuals))
        return replace(self, treatment=measured)

    @property
    def null_rests_on_residuals(self) -> bool:
        """Whether `with_noise_of` other residuals changes the distribution of null draws."""
        return self.treatment.null_rests_on_residuals

    @property
    def linear_noise(self) -> bool:
        """Whether `noise` is linear in the unit normals that it is made of."""
        return self.treatment.linear_noise


@checks_arguments
def statistic_of(
    result: SearchResult,
    *,
    stated_errors: bool = False,
    beside: bool = False,
    companion_known: bool = False,
) -> BankStatistic:
    """Make the statistic of a search, with the noise that was fitted.

    Parameters
    ----------
    result : SearchResult
    stated_errors : bool
        The size of the errors is known. By default it is not: whether noise was added depends
        on the data, and a false companion can hide that it should have been. A statistic that
        does not know the scale needs no such decision.
    beside : bool
        For a second companion: all that the first one can do by moving or brightening is
        projected out, of the data and of the null sets.
    companion_known : bool
        What exposures share is what they do beside the companion that was found. A test whether
        there is one may not say so: it takes for drift all that is common to exposures.
    """
    likelihood, whitening = null_likelihood(result)
    exposures = None
    if whitening is None and not stated_errors:
        found = result.theta if companion_known else None
        exposures = exposure_noise(likelihood, result.single_theta, beside=found)
    if exposures is not None:
        likelihood = likelihood.with_noise(exposures.noise)
    made = make_statistic(
        likelihood, result.grid, result.single_theta,
        stated_errors=stated_errors, whitening=whitening, beside=result.theta if beside else None,
    )  # fmt: skip
    if exposures is None:
        return made
    return replace(made, exposures=exposures.of_bank(made.bank))


def make_statistic(
    likelihood: Likelihood,
    grid: Grid,
    single: FloatArray,
    *,
    stated_errors: bool = False,
    whitening: SymmetricWhitening | None = None,
    beside: FloatArray | None = None,
) -> BankStatistic:
    """Make the statistic of data and a field.

    Parameters
    ----------
    likelihood : Likelihood
    grid : Grid
    single : (n_nuisance,) float array
        The fit without a companion.
    stated_errors : bool
        As for `statistic_of`.
    whitening : SymmetricWhitening, optional
        Residuals follow Student's t, by these directions of the data.
    beside : (n_dim,) float array, optional
        Parameters with a companion that is there already.
    """
    bank = TemplateBank(likelihood, grid, single, beside=beside)
    fit = (single_likelihood(likelihood), single) if beside is None else (likelihood, beside)
    residual = fit[0].difference(np.atleast_2d(fit[1]))[:, 0]
    observed = likelihood.noise.whiten(residual)
    bank, treatment = _treatment(likelihood, bank, observed, stated_errors, whitening)
    ratio = _ratio(likelihood, bank, known=stated_errors and whitening is None)
    return BankStatistic(likelihood, single, bank, treatment, ratio, residual)


def _treatment(
    likelihood: Likelihood,
    bank: TemplateBank,
    observed: FloatArray,
    stated_errors: bool,
    whitening: SymmetricWhitening | None,
) -> tuple[TemplateBank, ErrorTreatment]:
    """What is known of the errors, and the bank that searches in few numbers where it can."""
    least = 1.0 if likelihood.noise.floor else 0.0
    if whitening is not None:
        return bank, StudentScores(whitening, least)
    null = rotation_null(likelihood.noise, bank.project(observed))
    if null is not None:
        return bank, Rotations(null)
    if stated_errors:
        return bank, KnownErrors()
    groups = scale_groups(likelihood.observables, bank.n_nuisance, likelihood.noise.rows)
    reduced = bank.reduced(groups.label)
    if reduced.reduction is not None:
        groups = replace(groups, label=reduced.reduction.label, count=groups.degrees / groups.share)
    return reduced, FreeScale.measured(groups, reduced, reduced.reduce(observed), least)


def _ratio(likelihood: Likelihood, bank: TemplateBank, *, known: bool) -> Ratio:
    n_free = bank.n_data - bank.n_nuisance
    if not known:
        return Ratio.scale_free(n_free)
    if not np.isfinite(likelihood.degrees):
        return Ratio.known(n_free)
    return Ratio.student(n_free, bank.n_data, likelihood.degrees)
