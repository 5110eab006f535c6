"""The search stage: the field, widened where something around it fits better."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.robust import search_robust
from amibayes.companion_search.search import (
    SURELY_NOT_NOISE,
    look_inside,
    look_outside,
    resolves_stars,
    search,
)
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import Observables
from amibayes.data.systematics import systematics_of
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior
from amibayes.likelihood.joint import joint_likelihood
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.options import SearchOptions

MAX_FIELDS = 3
"""How often the default field is searched, widened each time: a companion further out than
that is outside of what the data sample well."""


@dataclass(frozen=True, eq=False)
class FieldSearch:
    """What the search of the field found.

    Parameters
    ----------
    result : SearchResult
    noise : ExtraNoise
        The most likely, beyond the stated errors.
    warnings : tuple of str
        On the edges of the field.
    """

    result: SearchResult
    noise: ExtraNoise
    warnings: tuple[str, ...]


def search_field(observables: Observables, options: SearchOptions) -> FieldSearch:
    """Search the field; the default one is widened where something around it fits better."""
    likelihood = Likelihood(observables.only(options.observables))
    likelihood = joint_likelihood(
        likelihood.with_model(_model(likelihood, options)),
        contrast=options.contrast,
        motion=options.motion,
        fastest_mas_yr=options.fastest_mas_yr,
    )
    field, warnings = options.separation_mas, list[str]()
    for _ in range(MAX_FIELDS):
        result, noise = _searched(likelihood, field, options)
        place = None if options.separation_mas else look_outside(result)
        if place is None:
            break
        field = (result.grid.inner_mas, 1.5 * place)
        warnings = [
            f"the field was widened to {field[1]:.1f} mas: near {place:.1f} mas, outside the "
            "default one, a companion fits better than anywhere inside"
        ]
    if options.separation_mas:
        warnings = _beyond(result)
    return FieldSearch(result, noise, tuple(warnings))


def _searched(
    likelihood: Likelihood, field: tuple[float, float] | None, options: SearchOptions
) -> tuple[SearchResult, ExtraNoise]:
    """Search one field with the noise that was asked for."""
    apart = options.file_noise is not False
    if options.robust:
        return search_robust(likelihood, field, free_scale=options.extra_noise, per_file=apart)
    prior = noise_prior(likelihood.observables, options)
    if options.extra_noise or options.channel_noise or prior.floors:
        return search_with_noise(likelihood, field, per_file=apart, prior=prior)
    return search(likelihood, field), ExtraNoise()


def noise_prior(observables: Observables, options: SearchOptions) -> NoisePrior:
    """Prior of extra noise; of width 0 where the stated errors count as right."""
    vis2, degrees = options.noise_prior if options.extra_noise else (0.0, 0.0)
    floors = systematics_of(observables, options.systematics)
    return NoisePrior(vis2, float(np.radians(degrees)), options.channel_noise, floors)


def _beyond(result: SearchResult) -> list[str]:
    """Warn where a field that was asked for seems to leave the companion out."""
    found, grid = [], result.grid
    if (place := look_inside(result)) is not None:
        found.append(
            f"the field begins at {grid.inner_mas:.4g} mas: near {place:.1f} mas, nearer the "
            "star, a companion fits as well or better, and this may be an alias of it"
        )
    rho = result.companion.separation_mas
    if result.delta_chi2 > SURELY_NOT_NOISE and (
        rho < grid.inner_mas + 0.25 * grid.step_mas or rho > grid.outer_mas - 0.25 * grid.step_mas
    ):
        found.append(
            f"the best fit lies at {rho:.4g} mas, on the edge of the field that was asked for: "
            "the companion may be outside it"
        )
    return found


def _model(likelihood: Likelihood, options: SearchOptions) -> BinaryModel:
    diameter = options.diameter
    if diameter is None:
        diameter = "free" if resolves_stars(likelihood) else 0.0
    return BinaryModel(1, diameter, options.background, options.smearing)
