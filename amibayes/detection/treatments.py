"""What a significance test takes for known of the errors, and how it then searches data sets.

A treatment searches whitened data sets over a template bank, and draws and searches null sets
in the same way. `KnownErrors` takes the covariance as it is; `FreeScale` lets every group of
data (kinds and files) scatter by its own amount; `StudentScores` bounds every residual first;
`amibayes.detection.rotations.Rotations` estimates the covariance of every set anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import ClassVar, Protocol, Self

import numpy as np
from scipy import special, stats

from amibayes.companion_search.scan import NO_SCATTER, GroupWeights, ScaleGroups, weighted_gain
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.likelihood.noise_terms import MAX_INFLATION, PRIOR_STATED_ERRORS_CORRECT
from amibayes.likelihood.student import SymmetricWhitening, normal_moments, scores
from amibayes.units import FloatArray, IntArray


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


class Places(Protocol):
    """What a field is made of: a template bank, or a few places."""

    @property
    def n_data(self) -> int:
        """Number of independent data."""

    @property
    def n_nuisance(self) -> int:
        """Number of nuisance directions."""

    def __len__(self) -> int:
        """Number of places."""

    def project(self, data: FloatArray) -> FloatArray:
        """Take the nuisance directions out of whitened data (n_rows, …)."""

    def gains(self, residuals: FloatArray) -> FloatArray:
        """Largest gain in χ² of whitened residuals (n_rows,) everywhere, for positive contrasts."""

    def by_band(self) -> Iterator[tuple[IntArray, FloatArray]]:
        """Yield positions (m,) and templates of unit norm of each band (n_bands, n_rows, m)."""


class ErrorTreatment(Protocol):
    """How data sets are searched, and how null sets are made."""

    linear_noise: ClassVar[bool] = True
    """Whether noise is linear in the unit normals that it is made of."""

    def search(self, bank: TemplateBank, white: FloatArray) -> Searched:
        """Search data sets (n_data, n), whitened by the bank's own covariance."""

    def field(self, bank: Places, white: FloatArray) -> tuple[FloatArray, float]:
        """Gain in χ² of one data set (n_data,) at every position, and its χ²."""

    def search_simulated(
        self, bank: TemplateBank, noise: FloatArray, signal: FloatArray | None = None
    ) -> Searched:
        """Search simulated data sets.

        Parameters
        ----------
        bank : TemplateBank
        noise : (n_data, n) float array
            From `noise_of`.
        signal : (n_data, n) float array, optional
            What is in the data beside noise, whitened.
        """
        return self.search(bank, noise if signal is None else bank.added(noise, signal))

    def noise_of(self, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Make noise of whitened data sets (n_data, n) out of unit normals: these as they are.

        ``rng`` is for what else is drawn.
        """
        return normals

    def scatter_posterior(
        self, n: int, rng: np.random.Generator, *, stated_probable: bool
    ) -> FloatArray:
        """Draw what scatter the noise may really have, in units of that of `noise_of`.

        Parameters
        ----------
        n : int
        rng : numpy.random.Generator
        stated_probable : bool
            The errors are as stated, with the prior probability that the likelihood gives to it.

        Returns
        -------
        (n_data, n) or (1, n) float array
            Ones where the scatter is known, or drawn with the noise.
        """
        return np.ones((1, n))

    def with_noise_of(self, bank: TemplateBank, residuals: FloatArray) -> Self:
        """Make the same with the noise of other whitened residuals (n_data,).

        Nothing is taken from them where the noise is known, or was fitted with the search.
        """
        return self

    @property
    def null_rests_on_residuals(self) -> bool:
        """Whether null draws have another distribution where the residuals are others."""
        return False

    @property
    def of_nulls(self) -> Self:
        """The same for null sets, with numbers rounded that hardly matter."""
        return self

    def contrast_error(self, bank: TemplateBank, places: FloatArray) -> FloatArray:
        """Error of a faint companion's contrast at places (n, 2), mas, under its noise, (n,)."""


@dataclass(frozen=True)
class KnownErrors(ErrorTreatment):
    """The covariance is what is stated, or was fitted."""

    def search(self, bank: TemplateBank, white: FloatArray) -> Searched:
        """Search data sets; see `ErrorTreatment`."""
        data = bank.project(white)
        gain, position = bank.largest_gain(data.astype(np.float32))
        return Searched(gain, position, (data**2).sum(axis=0))

    def field(self, bank: Places, white: FloatArray) -> tuple[FloatArray, float]:
        """Gain everywhere; see `ErrorTreatment`."""
        data = bank.project(white)
        return bank.gains(data), float(data @ data)

    def contrast_error(self, bank: TemplateBank, places: FloatArray) -> FloatArray:
        """Error of the contrast at places; see `ErrorTreatment`."""
        return bank.scan_at(np.zeros(bank.n_rows), *places.T)[1]


LATTICE = 0.05
"""Step of ln scale at which null sets are drawn, so that targets of equal errors share them. A
probability changes by about as large a part as a scale (measured at 0.01): at most by 2.5 %, a
quarter of what ten thousand draws leave uncertain, and scales themselves are known to 15 %."""


@dataclass(frozen=True, eq=False)
class FreeScale(ErrorTreatment):
    """Every group of data scatters by its own amount, which each data set tells by itself.

    Parameters
    ----------
    groups : ScaleGroups
    scale : (n_data,) float array
        Standard deviation of the noise of null sets: as measured in the data.
    least : float
        Least variance, in units of the covariance's: 1 where that holds a floor of
        systematic errors, which the scatter of few data need not show.
    """

    groups: ScaleGroups
    scale: FloatArray
    least: float = 0.0

    @classmethod
    def measured(
        cls,
        groups: ScaleGroups,
        bank: TemplateBank,
        residuals: FloatArray,
        least: float,
    ) -> Self:
        """Measure the scatter of the groups in whitened residuals (n_data,)."""
        variance = np.maximum(groups.variances(bank.project(residuals)[:, None])[:, 0], least)
        return cls(groups, np.sqrt(variance)[groups.label], least)

    def _total(self, bank: Places, chi2: FloatArray) -> FloatArray:
        """χ² of data sets, not below what the least variance makes of their number."""
        return np.maximum(chi2, max(self.least * (bank.n_data - bank.n_nuisance), NO_SCATTER))

    @property
    def null_rests_on_residuals(self) -> bool:
        """One common scale drops out of the ratio; those of several groups do not."""
        return self.groups.several

    @property
    def of_nulls(self) -> Self:
        """The same with scales on a lattice, and relative ones where a common one drops out."""
        relative = self.scale / (1.0 if self.least else self.scale[0])
        return replace(self, scale=np.exp(LATTICE * np.rint(np.log(relative) / LATTICE)))

    def search(self, bank: TemplateBank, white: FloatArray) -> Searched:
        """Search data sets, each group's data weighted by its own scatter.

        The gain is that share of χ² which the weighted data lose.
        """
        if not self.groups.several:
            found = KnownErrors().search(bank, white)
            return replace(found, chi2=self._total(bank, found.chi2))
        data = bank.project(white)
        chi2 = (data**2).sum(axis=0)
        rows, weight, total = self._weighted(bank, data)
        own = GroupWeights(self.groups, weight.astype(np.float32))
        gain, position = bank.largest_gain(rows.astype(np.float32), own)
        return Searched(gain * chi2 / self._total(bank, total), position, chi2)

    def field(self, bank: Places, white: FloatArray) -> tuple[FloatArray, float]:
        """Gain everywhere in weighted χ² of one data set (n_data,), and its weighted χ²."""
        if not self.groups.several:
            gain, chi2 = KnownErrors().field(bank, white)
            return gain, float(self._total(bank, np.array(chi2)))
        rows, weight, total = self._weighted(bank, bank.project(white)[:, None])
        gain = np.zeros(len(bank))
        for index, units in bank.by_band():
            match = [rows.T @ unit for unit in units]
            found = weighted_gain(GroupWeights(self.groups, weight), units, match)[0]
            gain[index] = np.maximum(gain[index], found)
        return gain, float(self._total(bank, total)[0])

    def _weighted(
        self, bank: Places, data: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Weigh data (n_data, n) by the scatter of their groups: (n_data, n), (n_groups, n), χ²."""
        weight = 1.0 / np.maximum(self.groups.variances(data), max(self.least, NO_SCATTER))
        rows = weight[self.groups.label] * data
        return bank.project(rows), weight, (rows * data).sum(axis=0)

    def noise_of(self, normals: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Noise that scatters as the data do."""
        return normals * self.scale[:, None]

    def scatter_posterior(
        self, n: int, rng: np.random.Generator, *, stated_probable: bool
    ) -> FloatArray:
        """Draw the scatter of the groups from its posterior; see `ErrorTreatment`.

        Each group's variance has Jeffreys' prior or, with the probability that the noise prior
        gives to it, is as stated.
        """
        out = np.empty((len(self.groups.label), n))
        for group, degrees in enumerate(self.groups.degrees.tolist()):
            here = self.groups.label == group
            measured = float(self.scale[here][0])
            drawn = drawn_scale(measured, degrees, n, rng, stated_probable=stated_probable)
            out[here] = np.maximum(drawn, np.sqrt(self.least)) / measured
        return out

    def with_noise_of(self, bank: TemplateBank, residuals: FloatArray) -> Self:
        """Measure the scatter in other residuals."""
        return self.measured(self.groups, bank, residuals, self.least)

    def contrast_error(self, bank: TemplateBank, places: FloatArray) -> FloatArray:
        """Error of the contrast at places with the groups' own scatter; see `ErrorTreatment`."""
        sigma = KnownErrors().contrast_error(bank, places)
        if not self.groups.several:
            return np.asarray(sigma * self.scale[0])
        square = [
            (bank.templates_at(*part.T) ** 2 / self.scale[:, None] ** 2).sum(axis=0)
            for part in np.array_split(places, 1 + len(places) // PLACES_AT_ONCE)
        ]
        return np.asarray(sigma / np.sqrt(np.concatenate(square)))


def drawn_scale(
    measured: float, degrees: float, n: int, rng: np.random.Generator, *, stated_probable: bool
) -> FloatArray:
    """Draw standard deviations (n,) of normal data, in units of the stated ones.

    Parameters
    ----------
    measured : float
        Root mean square of the data.
    degrees : float
        Their degrees of freedom ν.
    n : int
    rng : numpy.random.Generator
    stated_probable : bool
        The variance v is 1 with probability `PRIOR_STATED_ERRORS_CORRECT`, else ln v is uniform
        within twice ln `MAX_INFLATION` of 0; or the latter alone.

    Notes
    -----
    v is ν·measured²/χ²_ν under Jeffreys' prior, whose share of the evidence is
    Γ(ν/2)(ν·measured²/2)^(−ν/2) per unit of ln v. One draw from each n-th of the distribution.
    """
    sum_of_squares, half = degrees * measured**2, 0.5 * degrees
    share = 0.0
    if stated_probable:
        odds = PRIOR_STATED_ERRORS_CORRECT / (1.0 - PRIOR_STATED_ERRORS_CORRECT)
        log_free = special.gammaln(half) - half * np.log(0.5 * sum_of_squares)
        log_free -= np.log(4.0 * np.log(MAX_INFLATION))
        share = float(special.expit(np.log(odds) - 0.5 * sum_of_squares - log_free))
    level = (rng.permutation(n) + rng.uniform(size=n)) / n
    free = np.maximum(level - share, 0.0) / max(1.0 - share, 1e-300)
    variance = sum_of_squares / stats.chi2.isf(np.clip(free, 1e-12, 1.0 - 1e-12), degrees)
    return np.asarray(np.where(level < share, 1.0, np.sqrt(variance)))


PLACES_AT_ONCE = 512
"""Places whose templates are held in memory together."""


@dataclass(frozen=True, eq=False)
class StudentScores(ErrorTreatment):
    """Residuals follow Student's t: each is bounded, so that no outlier can dominate.

    What goes through the bank are the scores of `amibayes.likelihood.student.scores`, divided
    by the robust scale of each data set.

    Parameters
    ----------
    whitening : SymmetricWhitening
    least : float
        Least scale, in units of the errors: 1 where these hold a floor of systematic errors.
    """

    whitening: SymmetricWhitening
    least: float = 0.0

    def _scores(self, bank: Places, white: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Scores (n_data, n), and what their sum of squares (n,) is at least.

        That is what normal residuals of the least scale would give.
        """
        found, scale = scores(self.whitening, bank.project(white), self.least)
        one = normal_moments().score_variance * (bank.n_data - bank.n_nuisance)
        return found, one * (self.least / scale) ** 2

    def search(self, bank: TemplateBank, white: FloatArray) -> Searched:
        """Search data sets; see `ErrorTreatment`."""
        rows, least = self._scores(bank, white)
        found = KnownErrors().search(bank, rows)
        return replace(found, chi2=np.maximum(found.chi2, least))

    def field(self, bank: Places, white: FloatArray) -> tuple[FloatArray, float]:
        """Gain everywhere; see `ErrorTreatment`."""
        rows, least = self._scores(bank, white[:, None])
        gain, chi2 = KnownErrors().field(bank, rows[:, 0])
        return gain, max(chi2, float(least[0]))

    def contrast_error(self, bank: TemplateBank, places: FloatArray) -> FloatArray:
        """Error of the contrast at places; see `ErrorTreatment`."""
        return KnownErrors().contrast_error(bank, places)
