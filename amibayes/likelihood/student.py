"""Residuals with Student's t distribution: a few bad data must not make or hide a companion.

Every datum has a residual z in units of its error and loses weight as (ν + 1)/(ν + z²), ν = 4
(Lange, Little & Taylor 1989). Closure phases that share baselines are not independent; the
residual of a datum is its own row of the symmetric whitening of the data (Kessy, Lewin &
Strimmer 2018, ZCA-cor), which stands for that datum as closely as can be. A triangle keeps
its name, and for ν → ∞ the sum of squares is χ² exactly. The likelihood is raised to the power
at which normal residuals give intervals of the right size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property

import numpy as np
from scipy.sparse import csr_array, diags_array

from amibayes.data.covariance import Covariance
from amibayes.data.observables import Observables
from amibayes.likelihood.averaged_noise import AveragedNoise, differences_of
from amibayes.likelihood.chi2 import LOG_TWO_PI
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import FittedNoise, NoiseModel
from amibayes.likelihood.noise_terms import NoiseTerm, kinds_of, with_nodes
from amibayes.likelihood.residuals import groups_of
from amibayes.units import BoolArray, FloatArray

DEGREES = 4.0
"""Degrees of freedom ν of the residuals."""

SCALE_ROUNDS = 30

OUTLIER_WEIGHT = 0.25
"""A datum that keeps less than this share of its weight is called an outlier (3.5σ)."""


@dataclass(frozen=True)
class NormalMoments:
    """What the t distribution makes of normal residuals z of unit variance.

    Parameters
    ----------
    curvature : float
        Mean of ψ′, ψ(z) = z(ν + 1)/(ν + z²); also of zψ.
    weight : float
        Mean of the weight ψ/z.
    power : float
        The likelihood's power that makes curvature and scatter of its slope agree.
    efficiency : float
        Information that is left of that of a normal likelihood.
    """

    curvature: float
    weight: float
    power: float
    efficiency: float

    @property
    def score_variance(self) -> float:
        """Mean of (ψν/(ν + 1))²: of the scores, whose slope at 0 is 1."""
        return self.curvature / self.power * (DEGREES / (DEGREES + 1.0)) ** 2


@cache
def normal_moments(degrees: float = DEGREES) -> NormalMoments:
    """Integrate over the normal distribution."""
    z, mass = np.polynomial.hermite_e.hermegauss(150)
    mass = mass / mass.sum()
    weight = (degrees + 1.0) / (degrees + z * z)
    curvature, scatter = float(mass @ (weight * z * z)), float(mass @ (weight * z) ** 2)
    return NormalMoments(
        curvature, float(mass @ weight), curvature / scatter, curvature**2 / scatter
    )


@dataclass(frozen=True, eq=False)
class SymmetricWhitening:
    """One direction in whitened space for every datum.

    Parameters
    ----------
    rows : (n_data, rank) sparse array
        Their sum of squares is that of the whitened data.
    share : (n_data,) float array
        Independent data that each stands for: squared length of its row.
    vis2 : (n_data,) bool array
        Which are squared visibilities.
    """

    rows: csr_array
    share: FloatArray
    vis2: BoolArray

    @cached_property
    def groups(self) -> tuple[BoolArray, ...]:
        """Masks of the kinds of observable that there are."""
        return tuple(m for m in (self.vis2, ~self.vis2) if m.any())

    def residuals(self, white: FloatArray) -> FloatArray:
        """Residual of every datum, in its own errors, of whitened data (rank, n)."""
        return np.asarray((self.rows @ white) / np.sqrt(self.share)[:, None])

    def gather(self, standard: FloatArray) -> FloatArray:
        """Whitened data (rank, n) of which `residuals` are the residuals of the data."""
        return np.asarray(self.rows.T @ (standard * np.sqrt(self.share)[:, None]))


def symmetric_whitening(
    data: Observables, covariance: Covariance | None = None
) -> SymmetricWhitening:
    """Make the directions of unflagged data, of the covariance that they state or of another."""
    rows = (covariance or data.covariance).symmetric
    vis2 = np.arange(rows.shape[0]) < data.n_vis2
    return SymmetricWhitening(rows, np.asarray((rows**2).sum(axis=1)).ravel(), vis2)


@dataclass(frozen=True, eq=False)
class StudentNoise(FittedNoise):
    """Residuals with Student's t distribution, as a fit with weights sees them.

    Parameters
    ----------
    fit : NoiseModel
        Gaussian; the errors of data that fit nothing are stretched.
    base : NoiseModel
        Without the weights, which were found with a companion.
    symmetric : SymmetricWhitening
        Of ``base``.
    """

    base: NoiseModel
    symmetric: SymmetricWhitening

    def without_companion(self) -> StudentNoise:
        """All data at full weight: no companion may be tested by weights found with one."""
        return StudentNoise(self.base, self.base, self.symmetric)


def weights_of(standard: FloatArray) -> FloatArray:
    """Share of its weight that a datum of residual z keeps: 1 at z = 0, any shape."""
    return np.asarray(DEGREES / (DEGREES + standard**2))


def scales(frame: SymmetricWhitening, standard: FloatArray, n_fitted: float = 0.0) -> FloatArray:
    """Robust scale of residuals (n_data, n), common to all data, (n,).

    Solves Σ h zψ(z) = n E[zψ], which normal residuals of unit variance fulfil at 1, from the
    median of |z|.
    """
    moments = normal_moments()
    left = frame.share.sum() - n_fitted
    scale = np.maximum(1.4826 * np.median(np.abs(standard), axis=0), 1e-12)
    full = (DEGREES + 1.0) / DEGREES
    for _ in range(SCALE_ROUNDS):
        z = standard / scale
        mean = full * (frame.share @ (weights_of(z) * z * z)) / left
        scale = scale * np.sqrt(np.maximum(mean / moments.curvature, 1e-12))
    return np.asarray(scale)


def scores(
    frame: SymmetricWhitening, white: FloatArray, least: float = 0.0
) -> tuple[FloatArray, FloatArray]:
    """Whitened data (rank, n) whose residuals are bounded: what a robust search looks at.

    The slope of the t likelihood of the fit without a companion, by the data; its products
    with the templates are Rao's score statistics. Divided by the scale of each data set (n,),
    which is ``least`` or more, and comes with them.
    """
    standard = frame.residuals(white)
    scale = np.maximum(scales(frame, standard), least)
    standard = standard / scale
    return frame.gather(weights_of(standard) * standard), scale


def reweighted(observables: Observables, stretch: FloatArray) -> Observables:
    """Unflagged data whose errors (n_data,) are stretched, correlations as they are."""
    data = observables.unflagged()
    return replace(data, covariance=data.covariance.stretched(stretch))


@dataclass(frozen=True)
class Outlier:
    """A datum that lost most of its weight.

    Parameters
    ----------
    kind : {"vis2", "closure_phase"}
    stations : tuple of str
    wavelength_m, mjd : float
    source : str
        Its file.
    weight : float
        Share of its weight that it keeps.
    residual : float
        Data minus model, in its own (fitted) errors.
    """

    kind: str
    stations: tuple[str, ...]
    wavelength_m: float
    mjd: float
    source: str
    weight: float
    residual: float


@dataclass(frozen=True, eq=False)
class Robustness:
    """How Student's t distribution treated the data of a search.

    Parameters
    ----------
    base : Observables
        The data with their errors stretched by the fitted scale of each kind, and no weights.
    stated : Observables
        The data with the stated errors.
    covariance : Covariance
        Of these, with what their channels share.
    weights : (n_data,) float array
        Share of its weight that every datum keeps.
    residuals : (n_data,) float array
        In the errors of ``base``.
    """

    base: Observables
    stated: Observables
    covariance: Covariance
    weights: FloatArray
    residuals: FloatArray

    @property
    def outliers(self) -> tuple[Outlier, ...]:
        """Data that lost most of their weight, worst first."""
        data, n = self.stated, self.stated.n_vis2
        worst = np.argsort(self.weights, kind="stable")
        found = []
        for i in worst[self.weights[worst] < OUTLIER_WEIGHT]:
            kind, table = ("vis2", data.vis2) if i < n else ("closure_phase", data.closure_phase)
            k = int(i if i < n else i - n)
            setup = data.setups[table.setup[k]]
            found.append(
                Outlier(
                    kind,
                    tuple(setup.stations[s] for s in table.stations[k]),
                    float(table.wavelength_m[k]),
                    float(table.mjd[k]),
                    setup.source,
                    float(self.weights[i]),
                    float(self.residuals[i]),
                )
            )
        return tuple(found)


@dataclass(frozen=True, eq=False)
class StudentTerm(NoiseTerm):
    """Data with t distributed residuals that share one unknown scale of their errors.

    ``rows`` (n_data, rank) give every datum's residual in its stated error, of whitened data,
    and ``share`` the independent data that it stands for.
    """

    rows: csr_array = field(kw_only=True)

    def white(self, difference: FloatArray) -> FloatArray:
        """Residuals (n_data, n) of data minus model, in the stated errors."""
        return np.asarray(self.rows @ super().white(difference))

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return round(float(self.share.sum()))

    def log_likelihoods_of_white(self, white: FloatArray, node: FloatArray) -> FloatArray:
        """ln L (n_nodes, n) of residuals in their stated errors (n_data, n), scales exp(node)."""
        moments, square = normal_moments(), white**2
        power = 0.5 * moments.power * (DEGREES + 1.0)
        slopes = [self.share @ np.log1p(square / (DEGREES * np.exp(2.0 * u))) for u in node]
        norm = self.n_independent * (0.5 * LOG_TWO_PI + moments.efficiency * node)
        return np.asarray(-power * np.array(slopes) - norm[:, None] - 0.5 * self.log_det)


def student_terms(
    stated: Observables, covariance: Covariance | None = None, *, per_file: bool = False
) -> list[StudentTerm]:
    """One term for each kind of observable (and file), or one where the data correlate kinds.

    Every datum has a residual of its own, whatever correlates it with others, so that files
    which share calibrators have scales of their own all the same.
    """
    data = stated.unflagged()
    covariance = covariance or data.covariance
    symmetric = symmetric_whitening(data, covariance)
    terms = []
    for source, here in groups_of(data, per_file=per_file):
        for kind, which, typical in kinds_of(data, here):
            share = symmetric.share[which]
            rows = csr_array(diags_array(1.0 / np.sqrt(share)) @ symmetric.rows[which])
            used = abs(rows).sum(axis=0) > 0.0
            log_det = covariance.select(np.flatnonzero(which)).logdet()
            term = StudentTerm(
                kind, (covariance.whitening[used],), share, typical, log_det,
                source=source, rows=rows[:, used],
            )  # fmt: skip
            terms.append(term)
    return terms


def averaged_student_noise(
    fit: NoiseModel,
    stated: Observables,
    fits: Sequence[tuple[Likelihood, FloatArray]],
    *,
    covariance: Covariance | None = None,
    free_scale: bool = True,
    per_file: bool = False,
) -> AveragedNoise:
    """The t likelihood of residuals, averaged over their scale.

    Parameters
    ----------
    fit : NoiseModel
        Of the search, outliers stretched.
    stated : Observables
        With the stated errors.
    fits : sequence of (Likelihood, (n_dim,) float array)
        As in `amibayes.likelihood.averaged_noise.averaged_noise`.
    covariance : Covariance, optional
        Of the stated errors and what channels share; by default, what the data state.
    free_scale : bool
        Whether the scale of the errors is unknown; else it is the stated one.
    per_file : bool
        Whether every file has a scale of its own.
    """
    terms: list[NoiseTerm] = list(student_terms(stated, covariance, per_file=per_file))
    if free_scale:
        differences = differences_of(fits)
        terms = [with_nodes(t, differences) for t in terms]
    return AveragedNoise(fit, tuple(terms))
