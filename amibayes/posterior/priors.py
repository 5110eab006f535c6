"""Priors, stated in full: of the position, of the contrast, of the nuisance parameters.

By default the position is uniform in area and the contrast log-uniform; with two
companions each has that prior, independently. Densities are in the coordinates in which
the posterior is sampled, (east, north, ln contrast) of each companion and then the nuisance.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import cast

import numpy as np

from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.companion import companion_parameters
from amibayes.models.parameters import Parameter, Parameters
from amibayes.support.arguments import checks_arguments
from amibayes.support.options import ContrastForm, PositionForm, choices
from amibayes.units import FloatArray, offset

STAR_SCALE_MAS = 1.0
"""Half of all stars that interferometers look at are smaller; giants of 20 mas stay possible."""

SYNTAX = "contrast=[FORM:]LOW:HIGH, contrast=FORM, position=area|separation or NAME=LOW:HIGH"


@checks_arguments
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
        Ranges of the free nuisance parameters, such as the diameter (mas) and the background, in
        the order of a parameter vector.
    contrast_form : {"log-uniform", "uniform"}
        Distribution of the contrast over its range.
    position_form : {"area", "separation"}
        Uniform in area, or uniform in separation and position angle.
    n_contrasts : int
        Contrasts of each companion, one per band: independent, each with that distribution.
    fastest_mas_yr : float
        Where companions move, their rates along east and north are uniform within so much of 0.
    shapes : tuple of (low, high)
        Ranges of what is free of each companion's disc and colour; uniform.
    half_cauchy : tuple of float
        Scale of the half-Cauchy distribution of each nuisance parameter over its range; 0 for a
        uniform one, which all are by default.
    log_uniform : tuple of int
        Which of the nuisance parameters, by their place among them, are log-uniform.
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
    shapes: tuple[tuple[float, float], ...] = ()
    half_cauchy: tuple[float, ...] = ()
    log_uniform: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        _check("separation", self.inner_mas, self.outer_mas, least=0.0)
        _check("contrast", self.contrast_min, self.contrast_max, least=1e-300)
        for k, (low, high) in enumerate(self.nuisance):
            _check(f"nuisance {k}", low, high, least=-np.inf)

    @property
    def description(self) -> str:
        """The forms in words."""
        place = {"area": "uniform in area", "separation": "uniform in separation and angle"}
        contrast = {"log-uniform": "log-uniform in contrast", "uniform": "uniform in contrast"}
        words = f"{place[self.position_form]}, {contrast[self.contrast_form]}"
        if self.n_contrasts > 1:
            words += f" ({self.n_contrasts} bands, independently)"
        words += ", uniform in rate" if self.fastest_mas_yr > 0.0 else ""
        scales = [s for s in self.half_cauchy if s > 0.0]
        return words + "".join(f", half-Cauchy of {s:g} mas in the star's diameter" for s in scales)

    def parameters(self, companions: int) -> Parameters:
        """Parameters of so many companions and the nuisance, in the order of a vector."""
        return _parameters(
            companions,
            self.n_contrasts,
            self.fastest_mas_yr,
            len(self.shapes),
            len(self.nuisance),
        )

    @property
    def ranges(self) -> tuple[Range, ...]:
        """Distributions of the nuisance parameters."""
        scales = self.half_cauchy or (0.0,) * len(self.nuisance)
        return tuple(
            Range(*r, s, k in self.log_uniform)
            for k, (r, s) in enumerate(zip(self.nuisance, scales, strict=True))
        )

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
        for k, one in self._bounded(parameters):
            density = density + one.log_density(x[:, k])
        return density

    def _bounded(self, parameters: Parameters) -> Iterator[tuple[int, Range]]:
        """Columns of shapes and nuisance parameters, and their distributions."""
        for k in range(1, parameters.companions + 1):
            columns = parameters.columns("shape", component=k)
            yield from zip(columns.tolist(), (Range(*s) for s in self.shapes), strict=True)
        yield from zip(parameters.nuisance.tolist(), self.ranges, strict=True)

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
        for k, one in self._bounded(parameters):
            theta[:, k] = one.quantile(cube[:, k])
        return theta

    def to_cube(self, theta: FloatArray) -> FloatArray:
        """Turn parameter sets (n, n_dim) into uniform numbers, the inverse of `from_cube`.

        What lies outside the prior goes to its edge.
        """
        cube = np.array(theta, dtype=float)
        parameters = self._parameters_of(theta.shape[1])
        for k in range(1, parameters.companions + 1):
            east, north = parameters.place(k)
            cube[:, east] = self.ring_cdf(np.hypot(theta[:, east], theta[:, north]))
            turn = np.arctan2(theta[:, east], theta[:, north]) / (2.0 * np.pi)
            cube[:, north] = turn % 1.0
        bright, rates = parameters.contrasts, parameters.rates
        cube[:, bright] = self.contrast_cdf(theta[:, bright])
        cube[:, rates] = 0.5 * (1.0 + theta[:, rates] / (self.fastest_mas_yr or 1.0))
        for k, one in self._bounded(parameters):
            cube[:, k] = one.cdf(theta[:, k])
        return np.asarray(np.clip(cube, 0.0, 1.0))

    def _contrast_at(self, probability: FloatArray) -> FloatArray:
        if self.contrast_form == "uniform":
            return self.contrast_min + (self.contrast_max - self.contrast_min) * probability
        return self.contrast_min * np.exp(self._log_range * probability)

    def draw(
        self, rng: np.random.Generator | np.random.RandomState, n: int, companions: int = 1
    ) -> FloatArray:
        """Draw parameter sets (n, n_dim), contrast as a flux ratio."""
        return self.from_cube(rng.random((n, len(self.parameters(companions)))))


@dataclass(frozen=True)
class Range:
    """Uniform or log-uniform between two limits, or the part of a half-Cauchy distribution there.

    Parameters
    ----------
    low, high : float
    scale : float
        Of the half-Cauchy distribution: half of it lies below; 0 for the uniform one.
    logarithmic : bool
        Uniform in the logarithm.
    """

    low: float
    high: float
    scale: float = 0.0
    logarithmic: bool = False

    def log_density(self, x: FloatArray) -> FloatArray:
        """Log-density at any values."""
        inside = (x >= self.low) & (x <= self.high)
        if self.logarithmic:
            safe = np.where(inside, x, self.low)
            return np.where(inside, -np.log(safe * np.log(self.high / self.low)), -np.inf)
        if not self.scale:
            return np.where(inside, -np.log(self.high - self.low), -np.inf)
        shape = -np.log1p((x / self.scale) ** 2) - np.log(self.scale * np.diff(self._angles)[0])
        return np.where(inside, shape, -np.inf)

    def quantile(self, probability: FloatArray) -> FloatArray:
        """Value below which a probability lies."""
        if self.logarithmic:
            return np.asarray(self.low * (self.high / self.low) ** probability)
        if not self.scale:
            return np.asarray(self.low + (self.high - self.low) * probability)
        first, last = self._angles
        return np.asarray(self.scale * np.tan(first + (last - first) * probability))

    def cdf(self, x: FloatArray) -> FloatArray:
        """Probability of a smaller value, the inverse of `quantile`."""
        x = np.clip(x, self.low, self.high)
        if self.logarithmic:
            return np.asarray(np.log(x / self.low) / np.log(self.high / self.low))
        if not self.scale:
            return np.asarray((x - self.low) / (self.high - self.low))
        first, last = self._angles
        return np.asarray((np.arctan(x / self.scale) - first) / (last - first))

    @property
    def _angles(self) -> FloatArray:
        return np.arctan(np.array([self.low, self.high]) / self.scale)


@lru_cache
def _parameters(
    companions: int, n_contrasts: int, fastest_mas_yr: float, n_shapes: int, n_nuisance: int
) -> Parameters:
    """Parameters by role; kept, since a chain asks at every step."""
    bands = tuple(str(b) for b in range(n_contrasts))
    found: list[Parameter] = []
    for k in range(1, companions + 1):
        found += companion_parameters(k, bands, fastest_mas_yr)
        found += [Parameter(f"shape {j} of {k}", "", "shape", k) for j in range(n_shapes)]
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
    names = [parameters[k].name for k in parameters.nuisance]
    return Prior(
        inner_mas,
        outer_mas,
        nuisance=tuple(parameters.bounds(parameters.nuisance)),
        n_contrasts=likelihood.model.n_contrasts,
        fastest_mas_yr=likelihood.model.fastest_mas_yr,
        shapes=tuple(parameters.bounds(parameters.columns("shape", component=1))),
        half_cauchy=tuple(STAR_SCALE_MAS if n == "diameter_mas" else 0.0 for n in names),
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


def edit_prior(
    prior: Prior,
    settings: Iterable[PriorSetting],
    nuisance: Iterable[str],
    others: Iterable[str] = (),
) -> Prior:
    """Change a prior as the settings say; names of its nuisance parameters, and of other models'.

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
            k = names.index(wish.name.removesuffix("_mas"))
            ranges[k] = wish.bounds
            scales = [s if i != k else 0.0 for i, s in enumerate(prior.half_cauchy)]
            prior = replace(prior, half_cauchy=tuple(scales))
        else:
            raise UsageError(
                f"{wish.name!r} is not a free parameter",
                source="--prior",
                remedy=f"free ones: {', '.join(['contrast', 'position', *names, *others])}",
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
            remedy="give a lower limit below the upper one" + (" and above 0" if least > 0 else ""),
        )
