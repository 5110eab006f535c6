"""What the sky may be: a star with a companion, with extended light, or with both."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.background import Background
from amibayes.models.binary import BinaryModel
from amibayes.models.extended import Extended
from amibayes.models.parameters import Parameter
from amibayes.models.source import Component
from amibayes.posterior.evidence import HALO_BACKGROUND
from amibayes.posterior.priors import Prior, PriorSetting
from amibayes.support.options import SKY_MODELS
from amibayes.units import IntArray

EXTENDED: dict[str, Extended] = {
    "disc": Extended("gaussian", "disc"),
    "uniform-disc": Extended("uniform", "uniform_disc"),
    "ring": Extended("ring", "ring", smoothed=True),
    "crescent": Extended("ring", "crescent", smoothed=True, crescent=True),
}
"""Light around the star, by the name of the model. A new kind is one more line here and one in
`amibayes.support.options.SKY_MODELS`."""

COMPANIONS = {"companion": 1, "two": 2}

SMALLEST_SCALE = 0.25
"""Least size of extended light, in units of λ/B_max: smaller and brighter light has the same V² to
1e-3 of what it takes off. The largest is λ/B_min, where every baseline resolves it."""

MORE_GENERAL = {"ring": "crescent"}
"""Kinds of light that are a special case of another."""

FAMILIES = {
    "star": "star",
    "point": "one or two companions",
    "extended": "extended light",
    "both": "companions and extended light",
}
"""Kinds of models: what a verdict may name where models of one kind cannot be told apart. None of
several models is called as one of them: shares of the confusion matrix go by these names."""


@dataclass(frozen=True)
class Hypothesis:
    """A model of the sky by its name.

    Parameters
    ----------
    name : str
        Of `SKY_MODELS`, or several of them joined by ``+``.
    """

    name: str

    @property
    def parts(self) -> tuple[str, ...]:
        """Names of what is on the sky beside the star."""
        return tuple(part for part in self.name.split("+") if part != "star")

    @property
    def companions(self) -> int:
        """Number of companions."""
        return sum(COMPANIONS.get(part, 0) for part in self.parts)

    @property
    def surroundings(self) -> tuple[str, ...]:
        """Names of the extended parts."""
        return tuple(part for part in self.parts if part in EXTENDED)

    @property
    def halo(self) -> bool:
        """Whether there is over-resolved light."""
        return "halo" in self.parts

    @property
    def family(self) -> str:
        """One of `FAMILIES`."""
        around = bool(self.surroundings) or self.halo
        if self.companions:
            return "both" if around else "point"
        return "extended" if around else "star"

    def within(self, other: Hypothesis) -> bool:
        """Whether another model holds this one, with more on the sky or in more detail."""
        if self.name == other.name or self.companions > other.companions:
            return False
        around = [p for p in self.surroundings if p not in other.surroundings]
        held = all(MORE_GENERAL.get(p) in other.surroundings for p in around)
        return held and (other.halo or not self.halo)

    def model(self, base: BinaryModel) -> BinaryModel:
        """The model, with the star of ``base`` and companions of its kind.

        The flux of extended light goes with wavelength as that of companions does.
        """
        around = tuple(
            replace(
                EXTENDED[p],
                smearing=base.smearing,
                slope=base.contrast_slope,
                reference_wavelength_m=base.reference_wavelength_m,
            )
            for p in self.surroundings
        )
        return replace(
            base,
            companions=self.companions,
            background="free" if self.halo else base.background,
            surroundings=(*base.surroundings, *around),
        )

    def likelihood(self, base: Likelihood) -> Likelihood:
        """The likelihood of the model with the data and noise of another."""
        return base.with_model(self.model(base.model))


def hypotheses(names: Iterable[str]) -> tuple[Hypothesis, ...]:
    """Make models of names, each once.

    Raises
    ------
    UsageError
        Where a name is not known, or two names are of one model, which would count twice.
    """
    found = tuple(Hypothesis(name) for name in dict.fromkeys(names))
    seen: dict[frozenset[str], str] = {}
    for one in found:
        words = one.name.split("+")
        if any(p not in SKY_MODELS for p in words) or len(set(words)) < len(words):
            raise UsageError(
                f"{one.name!r} is no model of the sky",
                source="--models",
                remedy=f"choose from {', '.join(SKY_MODELS)}, or join some as ring+companion",
            )
        if {"companion", "two"} <= set(one.parts):
            raise UsageError("two already has both companions", source="--models")
        other = seen.setdefault(frozenset(one.parts), one.name)
        if other != one.name:
            raise UsageError(
                f"{other} and {one.name} are one model", source="--models", remedy="name it once"
            )
    return found


def extended_parameters(models: Iterable[str]) -> dict[str, Parameter]:
    """Parameters of extended light in some models, by their names without unit."""
    asked = hypotheses(models)
    parts: list[Component] = [EXTENDED[p] for one in asked for p in one.surroundings]
    parts += [Background("free") for one in asked if one.halo]
    return {p.name.removesuffix("_mas"): p for part in parts for p in part.parameters}


def split_settings(
    settings: Iterable[PriorSetting], models: Iterable[str], *, background: bool
) -> tuple[tuple[PriorSetting, ...], tuple[PriorSetting, ...]]:
    """Split settings of priors into those of companions and star, and of extended light.

    With a free ``background``, over-resolved light is there in every model, and is the star's.

    Raises
    ------
    UsageError
        Where a range is one that a parameter of extended light cannot have.
    """
    known = extended_parameters(models)
    if background:
        known.pop("background", None)
    mine = tuple(s for s in settings if s.name.removesuffix("_mas") in known)
    for one in mine:
        p = known[one.name.removesuffix("_mas")]
        low, high = one.bounds or (p.lower, p.upper)
        logarithmic = p.unit == "mas" or p.name.endswith("_flux")
        if low < p.lower or high > p.upper or (logarithmic and not low > 0.0):
            least = "above 0" if logarithmic else f"{p.lower:g}"
            most = f" to {p.upper:g}" if np.isfinite(p.upper) else ""
            raise UsageError(
                f"the range of {one.name}, {low:g} to {high:g}, is impossible",
                source="--prior",
                remedy=f"it goes from {least}{most}",
            )
    return tuple(s for s in settings if s not in mine), mine


def prior_of(
    likelihood: Likelihood, base: Prior, star: Sequence[str], settings: Iterable[PriorSetting] = ()
) -> Prior:
    """Prior of a model's parameters.

    Parameters
    ----------
    likelihood : Likelihood
        Of the model.
    base : Prior
        Of companions and star; extended light has the least flux of a companion.
    star : sequence of str
        Names of the nuisance parameters that ``base`` has ranges of.
    settings : iterable of PriorSetting
        Ranges of parameters of extended light, by name.

    Notes
    -----
    Flux and size of extended light are log-uniform, all else is uniform: axis ratios as for
    discs that are turned at random, angles, width and modulation.
    """
    known = dict(zip(star, zip(base.nuisance, base.ranges, strict=True), strict=True))
    wishes = {w.name: w.bounds for w in settings if w.bounds}
    parameters = single_likelihood(likelihood).parameters
    smallest = SMALLEST_SCALE * resolution_mas(likelihood)
    ranges, scales, logarithmic = [], [], []
    for k, p in enumerate(parameters):
        low, high, scale = p.lower, p.upper, 0.0
        if p.name in known:
            (low, high), one = known[p.name]
            scale = one.scale
        elif p.name == "background":
            high = HALO_BACKGROUND
        elif p.unit == "mas":
            low = smallest
            logarithmic.append(k)
        elif p.name.endswith("_flux"):
            low = base.contrast_min
            logarithmic.append(k)
        given = wishes.get(p.name) or wishes.get(p.name.removesuffix("_mas"))
        low, high = (low, high) if p.name in known else given or (low, high)
        ranges.append((float(low), float(high)))
        scales.append(scale)
    return replace(
        base, nuisance=tuple(ranges), half_cauchy=tuple(scales), log_uniform=tuple(logarithmic)
    )


def periodic(likelihood: Likelihood) -> IntArray:
    """Columns that come back to where they began, in the unit cube: angles of a whole turn."""
    parameters = likelihood.parameters
    places = [parameters.place(k + 1)[1] for k in range(parameters.companions)]
    angles = [k for k, p in enumerate(parameters) if p.unit == "deg"]
    return np.array([*places, *angles], dtype=np.intp)


def groups(likelihood: Likelihood) -> list[tuple[IntArray, int]]:
    """Columns of each source beside the star, and which of them is its flux."""
    parameters = likelihood.parameters
    found = []
    for k in range(1, parameters.companions + 1):
        found.append((parameters.companion(k), int(parameters.columns("flux", component=k)[0])))
    for part in likelihood.model.surroundings:
        names = [p.name for p in part.parameters]
        if isinstance(part, Extended):
            columns = np.array([parameters.index(n) for n in names], dtype=np.intp)
            found.append((columns, parameters.index(f"{part.name}_flux")))
    return found
