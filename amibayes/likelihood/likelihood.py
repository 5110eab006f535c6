"""One χ² for everything: residuals, likelihood and gradient of a model on a data set."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from amibayes.data.kernel_model import stands_alone
from amibayes.data.observables import Observables
from amibayes.errors import UsageError
from amibayes.likelihood.noise import NoiseModel, noise_of
from amibayes.models.bands import band_numbers, bands_of, dates
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Parameters
from amibayes.models.uv_points import YEAR_DAYS, UVPoints, uv_points_of
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Rows, Shown
from amibayes.support.options import ContrastSharing
from amibayes.units import MAS, ComplexArray, FloatArray

SMALL_DISC = 0.05
"""Diameter, in units of λ/B_max, below which all discs move the data in the same direction."""

NEVER_ZERO = 1e-30
"""Keeps the phase derivative finite at an exact null of the visibility."""


def _samples(observables: Observables, model: BinaryModel) -> UVPoints:
    """Points of the data, kept apart by what the model tells apart."""
    bands = band_numbers(observables, model.bands) if model.bands else None
    return uv_points_of(observables, bands, dated=model.moves, coloured=model.coloured)


def _told_apart(model: BinaryModel) -> tuple[object, ...]:
    """What of a model decides which points it tells apart."""
    return model.bands, model.moves, model.coloured


VALUES_AT_ONCE, LEAST_SETS = 25_000, 64
"""Model values (samples × parameter sets) that are worked on at once, whose arrays
fit a processor's cache and need no new memory; not fewer sets than repay the calls."""

MEMORY_KEPT = 32_000_000
"""Bytes. The C library gives freed arrays back to the system, which clears memory before it gives
it out again: more than half of the time of work on arrays that just fit a cache. That of Linux
keeps those up to the largest that it has seen freed (mallopt(3), M_MMAP_THRESHOLD, at most 32 MB),
so it is shown one, to which nothing is written."""
np.empty(MEMORY_KEPT, dtype=np.uint8)

FAINTEST = 0.005
"""Visibility below which that of a fit is not taken for the size of a fringe: calibration errors
alone are as large."""


@checks_arguments
class Likelihood(Shown):
    """Likelihood of a model, vectorised over parameter sets: data, model and noise.

    Parameters
    ----------
    observables : Observables
        Values and layout; their covariance is where ``noise`` comes from by default.
    model : BinaryModel, optional
    noise : NoiseModel, optional
        By default what the observables state: Gaussian, or the t distribution of an
        estimated covariance.
    samples : UVPoints, optional
        Points of the data, where they are known already.

    Notes
    -----
    Parameters are those of `BinaryModel.parameters`: east and north offset in mas,
    contrast as a flux ratio, uniform-disc diameter in mas, background flux.
    """

    def __init__(
        self,
        observables: Observables,
        model: BinaryModel | None = None,
        noise: NoiseModel | None = None,
        samples: UVPoints | None = None,
    ) -> None:
        self.observables = observables.unflagged()
        self.model = model or BinaryModel()
        self.noise = noise_of(self.observables) if noise is None else noise
        self.samples = _samples(self.observables, self.model) if samples is None else samples
        self._n2 = len(self.observables.vis2)
        alone = stands_alone(self.observables.closure_phase.stations)
        self._turn = np.where(alone, 0.0, 2.0 * np.pi)[:, None]

    def rows(self) -> Rows:
        """What an interpreter shows."""
        data, noise = self.observables, type(self.noise).__name__
        kinds = f"{data.n_vis2} V², {data.n_closure_phases} closure phases"
        degrees = f", t of {self.degrees:.3g} degrees" if np.isfinite(self.degrees) else ""
        return [
            ("data", f"{kinds}, {self.n_independent} independent numbers"),
            ("noise", f"{noise}, {data.covariance_kind} covariance{degrees}"),
            ("parameters", ", ".join(self.parameters.names) or "none"),
            ("model", repr(self.model)),
            ("source", data.source),
        ]

    @property
    def parameters(self) -> Parameters:
        """The free parameters, with the ranges that the data leave them."""
        return self.model.parameters.within(float(self.samples.frequency.min(initial=np.inf)))

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return self.noise.n_independent

    def with_model(self, model: BinaryModel) -> Likelihood:
        """Make the likelihood of another model with the same data and noise."""
        alike = _told_apart(model) == _told_apart(self.model)
        return Likelihood(self.observables, model, self.noise, self.samples if alike else None)

    def with_noise(self, noise: NoiseModel) -> Likelihood:
        """Make the likelihood of the same data and model with other noise."""
        return Likelihood(self.observables, self.model, noise, self.samples)

    @property
    def degrees(self) -> float:
        """Degrees of freedom of the distribution of the data; infinite for a Gaussian."""
        return self.noise.degrees

    @property
    def log_norm(self) -> float:
        """Logarithm of the likelihood of data without residuals, with the one covariance."""
        return self.noise.log_norm

    def deviance(self, chi2: ArrayLike) -> FloatArray:
        """−2 ln L of χ² (any shape), 0 without residuals: χ² itself where L is Gaussian."""
        return self.noise.deviance(np.asarray(chi2, dtype=float))

    def predict(self, theta: ArrayLike) -> FloatArray:
        """Model of the data: V², then closure phases in radians, (n_data, n)."""
        return self.observe(self.model.visibility(self.samples, self._sets(theta)))

    def expecting(self, theta: FloatArray) -> Likelihood:
        """The same with V² of a fit (n_dim,) as what is expected of the data.

        Noise that is made for these data afterwards has gains in proportion to them, and
        coherent errors that are largest in closure phases of faint fringes.
        """
        data, points = self.observables, self.samples
        visibility = self.model.visibility(points, self._sets(theta))
        size2 = np.maximum(np.abs(visibility[:, 0]) ** 2, FAINTEST**2)
        vis2 = replace(
            data.vis2,
            expected=self.observe(visibility)[: self._n2, 0],
            coherent_slope=np.sqrt(points.squares @ (4.0 * size2)),
        )
        has_phases = self._n2 < len(data.data)
        slopes = np.sqrt(points.legs.power(2) @ (1.0 / size2)) if has_phases else None
        closure = replace(data.closure_phase, coherent_slope=slopes)
        return Likelihood(
            replace(data, vis2=vis2, closure_phase=closure), self.model, self.noise, points
        )

    def residuals(self, theta: ArrayLike) -> FloatArray:
        """Whitened residuals data − model, (n_independent, n)."""
        return self.noise.whiten(self.difference(theta))

    def difference(self, theta: ArrayLike) -> FloatArray:
        """Data − model, closure phases the short way round, (n_data, n)."""
        return self.difference_from(self.predict(theta))

    def chi2(self, theta: ArrayLike) -> FloatArray:
        """χ² of parameter sets (n, n_dim), (n,)."""
        return np.asarray((self.residuals(theta) ** 2).sum(axis=0))

    def chi2_of(self, visibility: ComplexArray) -> FloatArray:
        """χ² of complex visibilities (n_samples, n) of any model, (n,)."""
        return self.chi2_of_model(self.observe(visibility))

    def chi2_of_model(self, model: FloatArray) -> FloatArray:
        """χ² of a model of the data (n_data, n), closure phases in radians, (n,)."""
        white = self.noise.whiten(self.difference_from(model))
        return np.asarray(np.einsum("dn,dn->n", white, white))

    def log_prob(self, theta: ArrayLike) -> FloatArray:
        """Log-likelihood of parameter sets (n, n_dim), (n,)."""
        parts = self.in_parts(self._sets(theta))
        return np.concatenate([self.noise.log_prob(self.difference(part)) for part in parts])

    def in_parts(self, sets: FloatArray) -> list[FloatArray]:
        """Cut parameter sets (n, n_dim) into as many as are worked on at once."""
        at_once = max(LEAST_SETS, VALUES_AT_ONCE // max(len(self.samples), 1))
        return np.split(sets, range(at_once, len(sets), at_once))

    def log_prob_and_gradient(self, theta: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Log-likelihood with the one covariance (n,), and its gradient (n, n_dim)."""
        value, slopes = self.model.gradient(self.samples, self._sets(theta))
        difference = self.difference_from(self.observe(value))
        weighted = self.noise.solve(difference)
        chi2 = (difference * weighted).sum(axis=0)
        # Reverse mode: fold the data's weights back onto the samples once, so that the
        # gradient costs one product per parameter and no Jacobian of the data.
        pull = 2.0 * (self.samples.from_squares @ weighted[: self._n2]) * value.conj()
        pull -= 1j * (self.samples.from_legs @ weighted[self._n2 :]) / (value + NEVER_ZERO)
        gradient = np.einsum("sn,psn->np", pull, slopes).real / self.noise.inflation(chi2)[:, None]
        return self.log_norm - 0.5 * self.deviance(chi2), np.asarray(gradient)

    def slopes(self, theta: ArrayLike) -> FloatArray:
        """Derivatives of the model of the data at one parameter set, (n_data, n_dim)."""
        return self.model_and_slopes(theta)[1][:, :, 0]

    def model_and_slopes(self, theta: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Model of the data (n_data, n), and its derivatives (n_data, n_dim, n)."""
        value, slopes = self.model.gradient(self.samples, self._sets(theta))
        n_dim, n_samples, n = slopes.shape
        by_phase = (slopes / (value + NEVER_ZERO)).imag
        by_vis2 = 2.0 * (slopes * value.conj()).real
        flat = [x.transpose(1, 0, 2).reshape(n_samples, -1) for x in (by_vis2, by_phase)]
        data = np.concatenate([self.samples.squares @ flat[0], self.samples.legs @ flat[1]])
        return self.observe(value), data.reshape(len(data), n_dim, n)

    def residuals_and_slopes(self, theta: ArrayLike) -> FloatArray:
        """Whitened residuals of parameter sets (n, n_dim), and derivatives of the whitened model.

        (n_independent, 1 + n_dim, n), residuals first.
        """
        model, slopes = self.model_and_slopes(theta)
        both = np.concatenate([self.difference_from(model)[:, None], slopes], axis=1)
        white = self.noise.whiten(both.reshape(len(both), -1))
        return np.asarray(white.reshape(-1, *both.shape[1:]))

    def jacobian(self, theta: ArrayLike) -> FloatArray:
        """Whitened derivatives of the model at one parameter set, (n_independent, n_dim)."""
        return self.noise.whiten(self.slopes(theta))

    def errors(self, theta: ArrayLike) -> FloatArray:
        """Covariance (n_dim, n_dim) of the parameters from the inverse of the Fisher matrix.

        With an estimated covariance that of the t distribution which parameters of a linear
        model have: (ν − 2 + χ²)/(ν + n − n_dim − 2) times as large.
        """
        jacobian = self.jacobian(self.sized(np.atleast_1d(theta)))
        scale = np.linalg.norm(jacobian, axis=0)
        scale[scale == 0.0] = 1.0
        fisher = (jacobian / scale).T @ (jacobian / scale)
        inverse = np.linalg.pinv(fisher, hermitian=True) / np.outer(scale, scale)
        if not np.isfinite(self.degrees):
            return np.asarray(inverse)
        rest = self.degrees - 2.0 + self.n_independent - len(scale)
        return np.asarray(inverse * (self.degrees - 2.0 + self.chi2(theta)[0]) / rest)

    def sized(self, theta: ArrayLike) -> FloatArray:
        """The parameter set (n_dim,) with discs too small to be seen as large as their error.

        Data move with the square of a small disc, whose derivative vanishes with it: its
        error σ is where that square is 1σ from 0.
        """
        sized = np.array(theta, dtype=float).ravel()
        discs = self.parameters.discs
        small = SMALL_DISC / float(self.samples.frequency.max(initial=1e-300)) / MAS
        unseen = discs[sized[discs] < small]
        if not len(unseen):
            return sized
        trial = sized.copy()
        trial[unseen] = small
        length = np.linalg.norm(self.jacobian(trial)[:, unseen], axis=0)
        seen = np.sqrt(2.0 * small / np.maximum(length, 1e-300))
        upper = np.array(self.parameters.bounds(unseen))[:, 1]
        sized[unseen] = np.maximum(sized[unseen], np.minimum(seen, upper))
        return sized

    def _sets(self, theta: ArrayLike) -> FloatArray:
        sets = np.atleast_2d(np.asarray(theta, dtype=float))
        names = self.model.parameters.names
        if sets.shape[1] != len(names):
            raise UsageError(
                f"theta has {sets.shape[1]} columns, not {len(names)}",
                source="Likelihood",
                remedy=f"its parameters are {', '.join(names)}",
            )
        return sets

    def observe(self, visibility: ComplexArray) -> FloatArray:
        """Data (n_data, n) of complex visibilities (n_samples, n) of any model."""
        # Every second number of a complex array takes twice the time of a row of numbers.
        real, imaginary = np.array(visibility.real), np.array(visibility.imag)
        phase = np.arctan2(imaginary, real) if self.samples.legs.shape[0] else None
        real *= real
        imaginary *= imaginary
        real += imaginary
        power = self.samples.squares @ real
        if phase is None:
            return np.asarray(power)
        return np.concatenate([power, self.samples.legs @ phase])

    def difference_from(self, model: FloatArray) -> FloatArray:
        """Data minus model (n_data, n), whatever that is of; closure phases the short way."""
        return self.wrapped(self.observables.data[:, None] - model)

    def wrapped(self, change: FloatArray) -> FloatArray:
        """Differences of data (n_data,) or (n_data, n), closure phases the short way; in place.

        Kernel phases are real sums and have no period.
        """
        closure = change[self._n2 :]
        turn = self._turn if closure.ndim > 1 else self._turn[:, 0]
        turns = closure * (0.5 / np.pi)
        np.rint(turns, out=turns)
        turns *= turn
        closure -= turns
        return change


def single_likelihood(likelihood: Likelihood) -> Likelihood:
    """Make the likelihood without a companion, other parameters as they are."""
    return likelihood.with_model(replace(likelihood.model, companions=0))


@checks_arguments
def joint_likelihood(
    likelihood: Likelihood,
    *,
    contrast: ContrastSharing | None = None,
    motion: bool = False,
    fastest_mas_yr: float | None = None,
) -> Likelihood:
    """Free the contrasts of bands, and the motion, in the model of a likelihood.

    Parameters
    ----------
    likelihood : Likelihood
    contrast : {"tied", "per-filter"}, optional
        One contrast for all bands, or one for each (the default where there are several: a
        companion need not have its star's colour).
    motion : bool
        The companion moves linearly; its place is that at the weighted mean date of the data.
    fastest_mas_yr : float, optional
        Largest rate along east and along north; by default λ/B_max over the span of the data.

    Raises
    ------
    UsageError
        Where all data are of one date and a motion is asked for.
    DataError
        Where a date is missing and a motion is asked for.
    """
    bands = bands_of(likelihood.observables) if contrast != "tied" else ()
    names = tuple(b.name for b in bands) if len(bands) > 1 else ()
    model = replace(likelihood.model, bands=names)
    if motion:
        first, last, mean = dates(likelihood.observables)
        if last <= first:
            raise UsageError(
                "all data are of one date", source="--motion", remedy="leave the motion out"
            )
        fringe = 1.0 / likelihood.samples.frequency.max() / MAS
        fastest = fastest_mas_yr or fringe * YEAR_DAYS / (last - first)
        model = replace(model, fastest_mas_yr=float(fastest), reference_mjd=mean)
    return likelihood.with_model(model)
