"""What a search gives back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from astropy import units
from astropy.table import QTable

from amibayes.companion_search.grid import Grid
from amibayes.data.tables import UNITS, pretty, quantity_table
from amibayes.likelihood.chi2 import candid_n_sigma
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.student import Robustness, StudentNoise, SymmetricWhitening
from amibayes.models.parameters import Parameters
from amibayes.models.uv_points import YEAR_DAYS
from amibayes.support.arguments import checks_arguments, one_of
from amibayes.support.labelled import labelled
from amibayes.support.notebook import html_table
from amibayes.units import (
    FloatArray,
    contrast_to_delta_mag,
    position_angle_deg,
    separation,
)

if TYPE_CHECKING:  # a quarter of a second that a search does not need
    from astropy.coordinates import SkyCoord

RIVAL = 9.0
"""Δχ² within which another position is a rival: three standard deviations."""


@checks_arguments
@dataclass(frozen=True)
class Companion:
    """A companion's parameters with 1σ errors.

    Errors come from the inverse Hessian of χ²; NaN where there is none.
    """

    east_mas: float
    north_mas: float
    contrast: float
    east_error_mas: float = float("nan")
    north_error_mas: float = float("nan")
    contrast_error: float = float("nan")
    separation_error_mas: float = float("nan")
    position_angle_error_deg: float = float("nan")

    @property
    def separation_mas(self) -> float:
        """Angular separation, mas."""
        return float(separation(self.east_mas, self.north_mas))

    @property
    def position_angle_deg(self) -> float:
        """Position angle, degrees east of north in [0, 360)."""
        return float(position_angle_deg(self.east_mas, self.north_mas))

    @property
    def delta_mag(self) -> float:
        """Magnitude difference to the primary."""
        return float(contrast_to_delta_mag(self.contrast))

    def coordinates(self, star: SkyCoord) -> SkyCoord:
        """Position on the sky, from that of the star (at the epoch of the data)."""
        return star.directional_offset_by(
            self.position_angle_deg * units.deg, self.separation_mas * units.mas
        )

    def _rows(self) -> list[tuple[str, str, str]]:
        errors = {
            "separation_mas": self.separation_error_mas,
            "position_angle_deg": self.position_angle_error_deg,
            "contrast": self.contrast_error,
            "delta_mag": self.delta_mag_error,
            "east_mas": self.east_error_mas,
            "north_mas": self.north_error_mas,
        }
        return [
            (pretty(name), f"{getattr(self, name):.5g}", f"{error:.2g}")
            for name, error in errors.items()
        ]

    def _repr_html_(self) -> str:
        """Show the companion in a notebook."""
        return html_table("Companion", ("", "value", "1σ"), self._rows())

    @property
    def delta_mag_error(self) -> float:
        """1σ error of the magnitude difference."""
        return (
            2.5 / np.log(10.0) * self.contrast_error / self.contrast
            if self.contrast > 0
            else np.nan
        )


@dataclass(frozen=True)
class Mode:
    """A local maximum of the likelihood: its parameters, and 2Δln L over no companion.

    The gain is that in χ² where the covariance is known.
    """

    theta: tuple[float, ...]
    delta_chi2: float
    companions: tuple[Companion, ...]

    @property
    def companion(self) -> Companion:
        """The mode's first companion, without errors."""
        return self.companions[0]

    @property
    def place(self) -> tuple[float, float]:
        """East and north of the first companion, mas."""
        return self.companion.east_mas, self.companion.north_mas

    @property
    def separation_mas(self) -> float:
        """Angular separation of the first companion, mas."""
        return self.companion.separation_mas

    @property
    def position_angle_deg(self) -> float:
        """Position angle of the first companion, degrees east of north in [0, 360)."""
        return self.companion.position_angle_deg

    @property
    def contrast(self) -> float:
        """Flux ratio of the first companion to the star."""
        return self.companion.contrast

    @property
    def delta_mag(self) -> float:
        """Magnitude difference of the first companion to the star."""
        return self.companion.delta_mag

    def __repr__(self) -> str:
        """One line for a notebook."""
        return (
            f"<Mode: {self.separation_mas:.2f} mas, PA {self.position_angle_deg:.2f}°, contrast "
            f"{self.contrast:.3g}, Δχ² {self.delta_chi2:.1f}>"
        )


OPPOSITE_MAS = 1e-2
"""Distance from the opposite place up to which two fits are mirror images: their rounding."""


def is_opposite(mode: Mode, place: FloatArray, within_mas: float = OPPOSITE_MAS) -> bool:
    """Whether a mode is the mirror image of a place, mas."""
    return bool(np.hypot(*np.add(mode.place, place)) < within_mas)


SKY = ("north_mas", "east_mas")
"""Axes of a map."""


@dataclass(frozen=True, eq=False)
class SearchResult:
    """What a search found.

    Parameters
    ----------
    companion : Companion
        Joint best fit with errors.
    theta : (n_dim,) float array
        The best parameter vector, in the order of ``likelihood.parameters``.
    theta_covariance : (n_dim, n_dim) float array
    single_theta : (n_nuisance,) float array
        The best fit without a companion.
    chi2_single, chi2_binary : float
    ndof : int
        Independent data minus free parameters of the binary fit.
    modes : tuple of Mode
        Distinct solutions within Δχ² 25, best first.
    grid : Grid
    bank_contrast, bank_sigma : (n_grid,) float array
        Best linear contrast and its error at every position, the same in every band.
    global_check : Mode, optional
        What the independent global optimiser found; None where it was not asked.
    warnings : tuple of str
    robustness : Robustness, optional
        How a robust search treated the data; ``likelihood`` has outliers' errors stretched.
    aliases : tuple of Mode
        Those of ``modes`` that these baselines cannot tell from the first one.
    joint_gain : (n_grid,) float array, optional
        Gain in χ² at every position where bands have contrasts of their own or the companion
        moves; otherwise it follows from the two above.
    """

    likelihood: Likelihood
    companion: Companion
    theta: FloatArray
    theta_covariance: FloatArray
    single_theta: FloatArray
    chi2_single: float
    chi2_binary: float
    ndof: int
    modes: tuple[Mode, ...]
    grid: Grid
    bank_contrast: FloatArray
    bank_sigma: FloatArray
    global_check: Mode | None
    warnings: tuple[str, ...] = ()
    robustness: Robustness | None = None
    joint_gain: FloatArray | None = None
    aliases: tuple[Mode, ...] = ()

    @property
    def rivals(self) -> tuple[Mode, ...]:
        """Other positions, no aliases of the first mode, that fit nearly as well as it."""
        others = [m for m in self.modes[1:] if m not in self.aliases]
        return tuple(m for m in others if m.delta_chi2 > self.modes[0].delta_chi2 - RIVAL)

    @property
    def delta_chi2(self) -> float:
        """2Δln L of the companion: χ² without minus χ² with it where the covariance is known."""
        single, binary = self.likelihood.deviance([self.chi2_single, self.chi2_binary])
        return float(single - binary)

    @property
    def candid_n_sigma(self) -> float:
        """CANDID's nσ of the best fit."""
        return float(candid_n_sigma(self.chi2_single, self.chi2_binary, self.ndof))

    @property
    def bank_delta_chi2(self) -> FloatArray:
        """2Δln L at every position of the grid, for positive contrast."""
        gain = self.bank_gain
        if not np.isfinite(self.likelihood.degrees):
            return gain
        left = np.maximum(self.chi2_single - gain, 0.0)
        deviance = self.likelihood.deviance
        return np.asarray(deviance(self.chi2_single) - deviance(left))

    @property
    def bank_gain(self) -> FloatArray:
        """Gain in χ² at every position of the grid, for positive contrast."""
        if self.joint_gain is not None:
            return self.joint_gain
        return np.where(self.bank_contrast > 0, (self.bank_contrast / self.bank_sigma) ** 2, 0.0)

    @property
    def contrasts(self) -> dict[str, tuple[float, float]]:
        """Contrast and its 1σ error of every band with its own; empty where all share one."""
        model = self.likelihood.model
        sigma = np.sqrt(np.diag(self.theta_covariance))
        columns = zip(model.bands, self.likelihood.parameters.contrasts, strict=False)
        return {band: (float(self.theta[k]), float(sigma[k])) for band, k in columns}

    def position_at(self, mjd: float) -> tuple[float, float]:
        """East and north of the companion, mas, predicted for a date."""
        model, parameters = self.likelihood.model, self.likelihood.parameters
        east, north = self.theta[parameters.place()]
        if model.moves:
            moved = self.theta[parameters.rates] * (mjd - model.reference_mjd) / YEAR_DAYS
            east, north = east + moved[0], north + moved[1]
        return float(east), float(north)

    def nuisance(self, name: str) -> float:
        """Value in the best fit, free or fixed, of a field of the model such as the diameter."""
        parameters, model = self.likelihood.parameters, self.likelihood.model
        if name in parameters.names:
            return float(self.theta[parameters.index(name)])
        one_of("SearchResult.nuisance", "name", name, (*parameters.names, *vars(model)))
        return float(getattr(model, name))

    def star_alone(self) -> dict[str, tuple[float, float]]:
        """Each free parameter of the fit without a companion: its value and error.

        The noise is that beside the best companion; `Verdict.star` has that beside the star.
        """
        return stated_parameters(single_likelihood(self.likelihood), self.single_theta)

    def to_table(self) -> QTable:
        """Every distinct solution, best first, as an astropy table with units."""
        names = ("separation_mas", "position_angle_deg", "contrast", "delta_mag")
        found = [mode.companion for mode in self.modes]
        columns = {name: [getattr(c, name) for c in found] for name in names}
        gains = {"delta_chi2": [mode.delta_chi2 for mode in self.modes]}
        return quantity_table(columns | gains, UNITS)

    def to_xarray(self) -> Any:
        """Maps over the field and all distinct solutions as labelled arrays (extra ``xarray``).

        Returns
        -------
        xarray.Dataset
            Of (north_mas, east_mas): ``delta_chi2_map``, ``contrast_map`` and
            ``contrast_error_map``, NaN outside the field. Of mode: ``separation_mas`` and others
            by the names of ``result.json``, best first.
        """
        axis = np.arange(-self.grid.half_width, self.grid.half_width + 1) * self.grid.step_mas
        maps = {
            "delta_chi2_map": self.bank_delta_chi2,
            "contrast_map": self.bank_contrast,
            "contrast_error_map": self.bank_sigma,
        }
        names = ("separation_mas", "position_angle_deg", "contrast", "delta_mag", "delta_chi2")
        modes = {n: (("mode",), np.array([getattr(m, n) for m in self.modes])) for n in names}
        images = {name: (SKY, self.grid.image(values)) for name, values in maps.items()}
        coordinates = {"north_mas": axis, "east_mas": axis, "mode": np.arange(len(self.modes))}
        facts = {"source": self.likelihood.observables.source, "ndof": self.ndof}
        chi2 = {"chi2_single": self.chi2_single, "chi2_binary": self.chi2_binary}
        return labelled({**images, **modes}, coordinates, facts | chi2)

    def _repr_html_(self) -> str:
        """Show the best fit in a notebook."""
        more = [
            ("Δχ²", f"{self.delta_chi2:.1f}", ""),
            ("CANDID nσ", f"{self.candid_n_sigma:.1f}", ""),
            ("modes", str(len(self.modes)), ""),
            *(("warning", text, "") for text in self.warnings),
        ]
        rows = [*self.companion._rows(), *more]
        return html_table("Best fit of the search", ("", "value", "1σ"), rows)

    def __repr__(self) -> str:
        """One line for a notebook."""
        c = self.companion
        return (
            f"<SearchResult: {c.separation_mas:.2f} mas, PA {c.position_angle_deg:.2f}°, contrast "
            f"{c.contrast:.3g}, Δχ² {self.delta_chi2:.1f}, {len(self.modes)} modes>"
        )


def null_likelihood(result: SearchResult) -> tuple[Likelihood, SymmetricWhitening | None]:
    """Likelihood of a test of no companion, and the symmetric whitening of robust residuals."""
    noise = result.likelihood.noise.without_companion()
    symmetric = noise.symmetric if isinstance(noise, StudentNoise) else None
    return result.likelihood.with_noise(noise), symmetric


def stated_parameters(likelihood: Likelihood, theta: FloatArray) -> dict[str, tuple[float, float]]:
    """Value and error of each free parameter of a fit (n_dim,); infinite where no data tell it."""
    if not len(theta):
        return {}
    errors = np.sqrt(np.diag(likelihood.errors(theta)))
    errors[errors == 0.0] = np.inf
    both = zip(theta.tolist(), errors.tolist(), strict=True)
    return dict(zip(likelihood.parameters.names, both, strict=True))


def mode_of(parameters: Parameters, theta: FloatArray, delta_chi2: float) -> Mode:
    """Make a mode of a parameter vector (n_dim,)."""
    return Mode(tuple(float(x) for x in theta), delta_chi2, companions_of(parameters, theta))


def companions_of(
    parameters: Parameters, theta: FloatArray, covariance: FloatArray | None = None
) -> tuple[Companion, ...]:
    """Companions of a parameter vector, their contrasts those of the reference band.

    Parameters
    ----------
    parameters : Parameters
    theta : (n_dim,) float array
    covariance : (n_dim, n_dim) float array, optional
        From which the errors are carried over.
    """
    found = []
    for k in range(1, parameters.companions + 1):
        columns = np.append(parameters.place(k), parameters.columns("flux", component=k)[0])
        values = [float(x) for x in theta[columns]]
        errors = () if covariance is None else _errors(values, covariance[np.ix_(columns, columns)])
        found.append(Companion(*values, *errors))
    return tuple(found)


def _errors(values: Sequence[float], covariance: FloatArray) -> tuple[float, ...]:
    """Errors of a `Companion` in its order, from those of east, north, contrast (3, 3)."""
    east, north, _ = values
    matrix = covariance[:2, :2]
    rho = float(np.hypot(east, north)) or np.nan  # on the star neither has a slope
    outward = np.array([east, north]) / rho
    around = np.array([north, -east]) / rho**2
    sigma = np.sqrt(np.diag(covariance))
    return (
        *(float(s) for s in sigma),
        float(np.sqrt(outward @ matrix @ outward)),
        float(np.degrees(np.sqrt(around @ matrix @ around))),
    )
