"""Priors, stated in full: of the position, of the contrast, of the nuisance parameters.

By default the position is uniform in area and the contrast log-uniform; with two
companions each has that prior, independently. Densities are in the coordinates in which
the posterior is sampled, (east, north, ln contrast) of each companion and then the nuisance.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import cast

import numpy as np

from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.companion import companion_parameters
from amibayes.models.parameters import Parameter, Parameters
from amibayes.support.options import ContrastForm, PositionForm, choices
from amibayes.support.quantities import takes_quantities
from amibayes.units import FloatArray, offset

SYNTAX = "contrast=[FORM:]LOW:HIGH, contrast=FORM, position=area|separation or NAME=LOW:HIGH"


@takes_quantities
@dataclass(frozen=True)
class Prior:
    """Prior of the companions and the nuisance parameters.

    Parameters
    ----------
    inner_mas, outer_mas : float
        Range of separations.
    contrast_min, contrast_max : float
        Range of the contrast (flux ratio).
    nuisance : tuple of (low, high)
        Uniform ranges of the free nuisance parameters, such as the diameter (mas) and the
        background, in the order of a parameter vector.
    contrast_form : {"log-uniform", "uniform"}
        Distribution of the contrast over its range.
    position_form : {"area", "separation"}
        Uniform in area, or uniform in separation and position angle.
    n_contrasts : int
        Contrasts of each companion, one per band: independent, each with that distribution.
    fastest_mas_yr : float
        Where companions move, their rates along east and north are uniform within so much of 0.
    """

    inner_mas: float
    outer_mas: float
    contrast_min: float = 1e-5
    contrast_max: float = 1.0
    nuisance: tuple[tuple[float, float], ...] = ()
    contrast_form: ContrastForm = "log-uniform"
    position_form: PositionForm = "area"
    n_contrasts: int = 1
    fastest_mas_yr: float = 0.0

    def __post_init__(self) -> None:
        _check("separation", self.inner_mas, self.outer_mas, least=0.0)
        _check("contrast", self.contrast_min, self.contrast_max, least=1e-300)
        for k, (low, high) in enumerate(self.nuisance):
            _check(f"nuisance {k}", low, high, least=-np.inf)
        if self.contrast_form not in choices(ContrastForm):
            raise UsageError(f"{self.contrast_form!r} is no distribution of the contrast")
        if self.position_form not in choices(PositionForm):
            raise UsageError(f"{self.position_form!r} is no distribution of the position")

    @property
    def description(self) -> str:
        """The forms in words."""
        place = {"area": "uniform in area", "separation": "uniform in separation and angle"}
        contrast = {"log-uniform": "log-uniform in contrast", "uniform": "uniform in contrast"}
        words = f"{place[self.position_form]}, {contrast[self.contrast_form]}"
        if self.n_contrasts > 1:
            words += f" ({self.n_contrasts} bands, independently)"
        return words + (", uniform in rate" if self.fastest_mas_yr > 0.0 else "")

    def parameters(self, companions: int) -> Parameters:
        """Parameters of so many companions and the nuisance, in the order of a vector."""
        return _parameters(companions, self.n_contrasts, self.fastest_mas_yr, len(self.nuisance))

    def _parameters_of(self, n_dim: int) -> Parameters:
        """Parameters of vectors of a length."""
        one = len(self.parameters(1).companion())
        return self.parameters((n_dim - len(self.nuisance)) // one)

    def contrast_cdf(self, contrast: FloatArray) -> FloatArray:
        """Probability of a fainter companion, any shape."""
        c = np.clip(contrast, self.contrast_min, self.contrast_max)
        if self.contrast_form == "uniform":
            return np.asarray((c - self.contrast_min) / (self.contrast_max - self.contrast_min))
        return np.asarray(np.log(c / self.contrast_min) / self._log_range)

    def ring_cdf(self, separation_mas: FloatArray) -> FloatArray:
        """Probability of a smaller separation, any shape."""
        rho = np.clip(separation_mas, self.inner_mas, self.outer_mas)
        power = 2 if self.position_form == "area" else 1
        low, high = self.inner_mas**power, self.outer_mas**power
        return np.asarray((rho**power - low) / (high - low))

    @property
    def _log_range(self) -> float:
        return float(np.log(self.contrast_max / self.contrast_min))

    def log_density(self, x: FloatArray) -> FloatArray:
        """Log-density of (east_mas, north_mas, ln contrast)…, nuisance…, (n, n_dim) → (n,).

        Further contrasts (ln) and rates of a companion follow its first contrast.
        """
        parameters = self._parameters_of(x.shape[1])
        density = np.zeros(len(x))
        for k in range(1, parameters.companions + 1):
            first, *others = parameters.columns("flux", component=k)
            density = density + self._log_companion(x[:, [*parameters.place(k), first]])
            density = density + self._log_further(x[:, others])
            density = density + self._log_rates(x[:, parameters.columns("rate", component=k)])
        for k, (low, high) in zip(parameters.nuisance, self.nuisance, strict=True):
            inside = (x[:, k] >= low) & (x[:, k] <= high)
            density = np.where(inside, density - np.log(high - low), -np.inf)
        return density

    def _log_companion(self, x: FloatArray) -> FloatArray:
        rho, ln_c = np.hypot(x[:, 0], x[:, 1]), x[:, 2]
        inside = (rho >= self.inner_mas) & (rho <= self.outer_mas)
        inside &= (ln_c >= np.log(self.contrast_min)) & (ln_c <= np.log(self.contrast_max))
        safe = np.where(inside, rho, self.outer_mas)
        if self.position_form == "area":
            place = np.log(np.pi * (self.outer_mas**2 - self.inner_mas**2))
        else:
            place = np.log(2.0 * np.pi * (self.outer_mas - self.inner_mas) * safe)
        return np.where(inside, self._log_bright(ln_c) - place, -np.inf)

    def _log_bright(self, ln_c: FloatArray) -> FloatArray | float:
        """Log-density in ln contrast, inside the range."""
        if self.contrast_form == "log-uniform":
            return float(-np.log(self._log_range))
        return np.asarray(ln_c - np.log(self.contrast_max - self.contrast_min))

    def _log_further(self, ln_contrast: FloatArray) -> FloatArray:
        """Log-density of the contrasts of further bands, (n, n_contrasts − 1) → (n,)."""
        density = np.zeros(len(ln_contrast))
        low, high = np.log(self.contrast_min), np.log(self.contrast_max)
        for column in ln_contrast.T:
            inside = (column >= low) & (column <= high)
            density = np.where(inside, density + self._log_bright(column), -np.inf)
        return density

    def _log_rates(self, rates: FloatArray) -> FloatArray:
        """Log-density of rates, (n, 2) or (n, 0) → (n,)."""
        density = np.zeros(len(rates))
        for column in rates.T:
            inside = np.abs(column) <= self.fastest_mas_yr
            density = np.where(inside, density - np.log(2.0 * self.fastest_mas_yr), -np.inf)
        return density

    def from_cube(self, cube: FloatArray) -> FloatArray:
        """Turn uniform numbers (n, n_dim) into parameter sets with contrast as a flux ratio."""
        theta = np.array(cube, dtype=float)
        parameters = self._parameters_of(cube.shape[1])
        power = 2 if self.position_form == "area" else 1
        low, high = self.inner_mas**power, self.outer_mas**power
        for k in range(1, parameters.companions + 1):
            east, north = parameters.place(k)
            rho = (low + (high - low) * cube[:, east]) ** (1.0 / power)
            theta[:, east], theta[:, north] = offset(rho, 360.0 * cube[:, north])
        bright, rates = parameters.contrasts, parameters.rates
        theta[:, bright] = self._contrast_at(cube[:, bright])
        theta[:, rates] = self.fastest_mas_yr * (2.0 * cube[:, rates] - 1.0)
        for k, (least, most) in zip(parameters.nuisance, self.nuisance, strict=True):
            theta[:, k] = least + (most - least) * cube[:, k]
        return theta

    def _contrast_at(self, probability: FloatArray) -> FloatArray:
        if self.contrast_form == "uniform":
            return self.contrast_min + (self.contrast_max - self.contrast_min) * probability
        return self.contrast_min * np.exp(self._log_range * probability)

    def draw(self, rng: np.random.Generator, n: int, companions: int = 1) -> FloatArray:
        """Draw parameter sets (n, n_dim), contrast as a flux ratio."""
        return self.from_cube(rng.random((n, len(self.parameters(companions)))))


@lru_cache
def _parameters(
    companions: int, n_contrasts: int, fastest_mas_yr: float, n_nuisance: int
) -> Parameters:
    """Parameters by role; kept, since a chain asks at every step."""
    bands = tuple(str(b) for b in range(n_contrasts))
    found = [
        p for k in range(companions) for p in companion_parameters(k + 1, bands, fastest_mas_yr)
    ]
    found += [Parameter(f"nuisance {k}", "", "nuisance", 0) for k in range(n_nuisance)]
    return Parameters(tuple(found))


@dataclass(frozen=True)
class PriorSetting:
    """One wish about the prior: of what, which distribution, which range."""

    name: str
    form: str | None = None
    bounds: tuple[float, float] | None = None


def default_prior(likelihood: Likelihood, inner_mas: float, outer_mas: float) -> Prior:
    """The prior of the field that was searched."""
    parameters = likelihood.parameters
    return Prior(
        inner_mas,
        outer_mas,
        nuisance=tuple(parameters.bounds(parameters.nuisance)),
        n_contrasts=likelihood.model.n_contrasts,
        fastest_mas_yr=likelihood.model.fastest_mas_yr,
    )


def parse_setting(text: str) -> PriorSetting:
    """Parse ``NAME=[FORM:]LOW:HIGH`` or ``NAME=FORM``.

    Raises
    ------
    UsageError
    """
    name, equals, rest = text.partition("=")
    words = rest.split(":")
    forms = {"contrast": choices(ContrastForm), "position": choices(PositionForm)}
    form = words.pop(0) if words[0] in forms.get(name, ()) else None
    bounds = _numbers(words)
    empty = bounds is None and (form is None or words)
    if not (name and equals) or empty or (name == "position" and bounds):
        raise UsageError(f"{text!r} is no prior", remedy=f"write {SYNTAX}")
    if bounds is not None:
        _check(name, *bounds, least=1e-300 if name == "contrast" else 0.0)
    return PriorSetting(name, form, bounds)


def edit_prior(prior: Prior, settings: Iterable[PriorSetting], nuisance: Iterable[str]) -> Prior:
    """Change a prior as the settings say; ``nuisance`` names its nuisance parameters.

    Raises
    ------
    UsageError
        Where a setting speaks of a parameter that is not free.
    """
    names = [n.removesuffix("_mas") for n in nuisance]
    ranges = list(prior.nuisance)
    for wish in settings:
        if wish.name == "contrast":
            low, high = wish.bounds or (prior.contrast_min, prior.contrast_max)
            form = cast(ContrastForm, wish.form or prior.contrast_form)
            prior = replace(prior, contrast_min=low, contrast_max=high, contrast_form=form)
        elif wish.name == "position":
            prior = replace(prior, position_form=cast(PositionForm, wish.form))
        elif wish.name.removesuffix("_mas") in names and wish.bounds:
            ranges[names.index(wish.name.removesuffix("_mas"))] = wish.bounds
        else:
            raise UsageError(
                f"{wish.name!r} is not a free parameter",
                source="--prior",
                remedy=f"free ones: {', '.join(['contrast', 'position', *names])}",
            )
    return replace(prior, nuisance=tuple(ranges))


def _numbers(words: list[str]) -> tuple[float, float] | None:
    try:
        low, high = (float(word) for word in words)
    except ValueError:
        return None
    return low, high


def _check(name: str, low: float, high: float, least: float) -> None:
    if not (least <= low < high < np.inf):
        raise UsageError(
            f"the range of the {name}, {low:g} to {high:g}, is empty or impossible",
            remedy="give LOW:HIGH with LOW below HIGH" + (" and above 0" if least > 0 else ""),
        )
