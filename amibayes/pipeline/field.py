"""The search stage: the field, widened where something around it fits better."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from amibayes.companion_search.field import (
    DISC_CONTRAST,
    EXPLAINED,
    SURELY_NOT_NOISE,
    box_of,
    choose_field,
    default_separation,
    look_inside,
    notices_disc,
    on_inner_edge,
    on_outer_edge,
    outermost,
    refuse_no_length,
    resolution_mas,
    rival_outside,
    wider_fields,
)
from amibayes.companion_search.optimise import SHAPE_START, refine, with_disc
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.robust import search_robust
from amibayes.companion_search.search import farthest_searched, search, with_global_check
from amibayes.companion_search.seeds import MAX_COARSE_DATA
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import Observables
from amibayes.detection.outlying_rows import (
    OutlyingRow,
    may_be_left_out,
    model_is_wrong,
    outlying_rows,
    without_rows,
)
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood, joint_likelihood, single_likelihood
from amibayes.likelihood.noise_fit import noise_beside
from amibayes.pipeline.options import SearchOptions, is_past_null, model_of, noise_prior

SURELY_A_DISC = 25.0
"""2Δln L that one more parameter does not gain by chance, even where channels err together."""


@dataclass(frozen=True, eq=False)
class FieldSearch:
    """What the search of the field found.

    Parameters
    ----------
    result : SearchResult
    noise : ExtraNoise
        The most likely, beyond the stated errors.
    warnings : tuple of str
        On the edges of the field, and of rows that were left out.
    observables : Observables
        Of all kinds, with the rows that were left out flagged.
    left_out : tuple of OutlyingRow
        Rows that the fit to all others is far from explaining.
    """

    result: SearchResult
    noise: ExtraNoise
    warnings: tuple[str, ...]
    observables: Observables
    left_out: tuple[OutlyingRow, ...] = ()


MAX_LEFT_OUT = 4
"""Rows that are left out in all: each costs a search."""


def search_field(observables: Observables, options: SearchOptions) -> FieldSearch:
    """Search the field; the default one is widened where something around it fits better.

    A few rows that the best fit to all others is far from explaining are left out, one by one.
    Where that does not end it, or one is explained in the end, the model is wrong: all are kept.
    """
    whole = found = _search_field(observables, options)
    if options.keep_outliers or options.robust:
        return whole
    left_out: tuple[OutlyingRow, ...] = ()
    used = observables.only(options.observables)
    while True:
        likelihood, theta = found.result.likelihood, found.result.theta
        outlying = outlying_rows(used, likelihood, theta, options.systematics)
        more = [row for row in outlying if row not in left_out]
        if not more:
            break
        if model_is_wrong(used, likelihood, theta, outlying):
            return whole
        left_out = (*left_out, more[0])
        if len(left_out) > MAX_LEFT_OUT or not may_be_left_out(used, left_out):
            return whole
        found = _search_field(without_rows(observables, left_out), options)
    if not left_out or set(outlying) != set(left_out):
        return whole
    return replace(
        found, left_out=outlying, warnings=(*(row.left_out() for row in outlying), *found.warnings)
    )


def _search_field(observables: Observables, options: SearchOptions) -> FieldSearch:
    """Search all of the data."""
    likelihood = Likelihood(observables.only(options.observables))
    if options.separation_mas is None:
        refuse_no_length(likelihood)
    likelihood = joint_likelihood(
        likelihood.with_model(model_of(likelihood, options)),
        contrast=options.contrast,
        motion=options.motion,
        fastest_mas_yr=options.fastest_mas_yr,
    )
    field, warnings = options.separation_mas, list[str]()
    if field is None:
        field, warnings = _chosen_field(likelihood, options)
    first = search(likelihood, field, check=False)
    if options.diameter is None:
        likelihood, first = _without_disc(likelihood, first)
        likelihood, first = _with_disc_of_star(likelihood, first)
    first = _with_its_disc(likelihood, first, options)
    if options.separation_mas is None:
        first, wider = _in_wider_field(likelihood, first, options)
        first, past = _past_the_edge(likelihood, first, options)
        warnings = past or wider or warnings
    first = _with_small_star(first) if options.limb_darkening is None else first
    result, noise = _searched(first, options)
    warnings += _beyond(result) if options.separation_mas else rival_outside(result)
    return FieldSearch(result, noise, tuple(warnings), observables)


def _chosen_field(
    likelihood: Likelihood, options: SearchOptions
) -> tuple[tuple[float, float], list[str]]:
    """The field where none is asked for, and warnings: no wider than one that is searched."""
    field, place = choose_field(likelihood, noise_prior(likelihood.observables, options))
    if place is None:
        return field, []
    better = "outside the default one, a companion fits better than anywhere inside"
    # It was seen at rest: with all rates of a motion so wide a field may be too large.
    farthest = farthest_searched(likelihood, *field)
    if place > farthest:
        told = f"near {place:.1f} mas, {better}, at rest: with a motion that is too far to search"
        return default_separation(likelihood), [f"the field was not widened: {told}"]
    field = field[0], farthest
    told = f"the field was widened to {field[0]:.3g}:{field[1]:.4g} mas: near {place:.1f} mas"
    return field, [f"{told}, {better}"]


def _with_small_star(first: SearchResult) -> SearchResult:
    """The search without limb darkening, where the star beside its companion is not past its null.

    As a star alone two bright ones are; that of a small one makes its diameter undetermined.
    """
    model, names = first.likelihood.model, first.likelihood.parameters.names
    if model.limb_darkening != "free" or first.chi2_binary > EXPLAINED * first.chi2_single:
        return first
    if is_past_null(first.likelihood, first.nuisance("diameter_mas")):
        return first
    uniform = first.likelihood.with_model(replace(model, limb_darkening=0.0))
    known = np.delete([mode.theta for mode in first.modes], names.index("limb_darkening"), axis=1)
    return search(uniform, (first.grid.inner_mas, first.grid.outer_mas), known=known, check=False)


def _with_its_disc(
    likelihood: Likelihood,
    first: SearchResult,
    options: SearchOptions,
    narrower: SearchResult | None = None,
) -> SearchResult:
    """The search with a free disc of the companion, where data show one and none was asked for."""
    if options.companion_diameter is not None:
        return first
    if shows_disc(likelihood, first):
        first = _search_for_disc(likelihood, first)
    # In the field of a narrower search discs of a few sizes have been tried.
    within = narrower is not None and narrower.grid.holds(first.companion.separation_mas)
    return first if within else _with_disc_elsewhere(likelihood, first)


def _with_disc_elsewhere(likelihood: Likelihood, near: SearchResult) -> SearchResult:
    """The search with a free disc of the companion, where one fits that is not near the best point.

    A companion as large as λ/B leaves so little of the fringes of a point that the best point
    may be anywhere: discs of a few sizes are searched for where what was found does not fit.
    """
    n, grid = likelihood.n_independent, near.grid
    if not likelihood.observables.n_vis2 or likelihood.model.companion_diameter_mas != 0.0:
        return near
    if n > MAX_COARSE_DATA or near.chi2_binary < NO_POINT * n:
        return near
    found = []
    for size in TRIAL_DISCS:
        diameter = size * resolution_mas(likelihood)
        fixed = likelihood.with_model(replace(likelihood.model, companion_diameter_mas=diameter))
        trial = search(fixed, (grid.inner_mas, grid.outer_mas), check=False)
        found.append(_search_for_disc(likelihood, trial, size))
    disc = min(found, key=lambda result: result.chi2_binary)
    gain = n * np.log(near.chi2_binary / disc.chi2_binary)
    return disc if gain > SURELY_A_DISC and disc.companion.contrast > DISC_CONTRAST else near


NO_POINT = 2.0
"""χ² per datum from which discs are searched for: stated errors too small by 1.4 give as much."""

TRIAL_DISCS = (0.7, 1.0, 1.5)
"""Their diameters in units of λ/B_max: smaller ones are found from where the best point is."""


def _in_wider_field(
    likelihood: Likelihood, first: SearchResult, options: SearchOptions
) -> tuple[SearchResult, list[str]]:
    """The search in a wider field, with a warning, where a companion there explains the data."""
    fields, outer = wider_fields(first), first.grid.outer_mas
    if not fields:
        return first, []
    capped = [(inner, farthest_searched(likelihood, inner, edge)) for inner, edge in fields]
    fields = [(inner, edge) for inner, edge in dict.fromkeys(capped) if edge >= outer]
    score, edge = _score(first, options), first.grid.inner_mas if on_inner_edge(first) else 0.0
    for field in fields:
        # With its disc, as the first one has: a point in its place may fit worse than that.
        found = _with_its_disc(likelihood, search(likelihood, field, check=False), options, first)
        place, gain = found.companion.separation_mas, score - _score(found, options)
        # The edge alone stopped a fit that is better still inside, by however little.
        least, why = 0.0, "the best in the default one is on its inner edge"
        if place >= edge:
            least, why = SURELY_NOT_NOISE, "none in the default one fits"
        if found.chi2_binary < EXPLAINED * first.chi2_binary or (
            found.chi2_binary < first.chi2_binary and gain > least
        ):
            return found, [
                f"the field was widened to {field[0]:.3g}:{field[1]:.4g} mas: {why}, and a "
                f"companion at {place:.1f} mas does {'far ' if least else ''}better"
            ]
    return first, []


def _past_the_edge(
    likelihood: Likelihood, first: SearchResult, options: SearchOptions
) -> tuple[SearchResult, list[str]]:
    """The search in a field a little wider, with a warning, where the fit ended on the edge."""
    grid = first.grid
    edge = min(PAST_EDGE * grid.outer_mas, outermost(likelihood))
    edge = farthest_searched(likelihood, grid.inner_mas, edge)
    wide = edge > grid.outer_mas + grid.step_mas
    if not wide or first.delta_chi2 < SURELY_NOT_NOISE or not on_outer_edge(first):
        return first, []
    found = search(likelihood, (grid.inner_mas, edge), check=False)
    found = _with_its_disc(likelihood, found, options)
    if found.chi2_binary > first.chi2_binary:
        return first, []
    place = found.companion.separation_mas
    return found, [
        f"the field was widened to {grid.inner_mas:.3g}:{edge:.4g} mas: in the default one the fit "
        f"ended on the edge, and a companion at {place:.1f} mas does better"
    ]


PAST_EDGE = 1.25
"""Outer edge of such a field, in units of that of the first."""


def _score(result: SearchResult, options: SearchOptions) -> float:
    """−2 ln L of a search with stated errors, with the noise that its best fit leaves."""
    likelihood, apart = result.likelihood, options.file_noise is not False
    prior = noise_prior(likelihood.observables, options)
    _, noisy = noise_beside(likelihood, result.theta, per_file=apart, prior=prior)
    return float(-2.0 * noisy.log_prob(result.theta)[0])


def _without_disc(likelihood: Likelihood, free: SearchResult) -> tuple[Likelihood, SearchResult]:
    """Leave the star's disc out where the data can neither notice nor need one.

    Its prior then says more of it than the data do, and a direction left free for it would cost
    contrasts and limits what no disc of a likely size can. A disc that fits better than its
    prior holds against it stays, and so does one that explains the data without a companion.
    """
    if "diameter_mas" not in free.likelihood.parameters.names or notices_disc(
        likelihood, LIKELY_DISC_MAS
    ):
        return likelihood, free
    point = likelihood.with_model(replace(likelihood.model, diameter_mas=0.0))
    found = search(point, (free.grid.inner_mas, free.grid.outer_mas), check=False)
    names = single_likelihood(free.likelihood).parameters.names
    alone = float(free.single_theta[names.index("diameter_mas")])
    fits = (free.chi2_binary, free.nuisance("diameter_mas")), (free.chi2_single, alone)
    # −2 ln of the half-Cauchy prior, and 1 for a fit that is better by a standard deviation.
    least = min(chi2 + 2.0 * np.log1p(diameter**2) + 1.0 for chi2, diameter in fits)
    return (likelihood, free) if found.chi2_binary > least else (point, found)


def _with_disc_of_star(
    likelihood: Likelihood, point: SearchResult
) -> tuple[Likelihood, SearchResult]:
    """Take a disc of the star in where closure phases alone need one, beside a sure companion.

    They tell nothing of a star alone, but how far it is resolved decides how much a companion
    turns them: that of two bright, resolved stars would be rejected, and the contrast beside a
    point is too large. A disc that they do not show is free too where it decides the contrast.
    """
    if likelihood.observables.n_vis2 or point.delta_chi2 < SURELY_NOT_NOISE:
        return likelihood, point
    disc = likelihood.with_model(replace(likelihood.model, diameter_mas="free"))
    found = search(disc, (point.grid.inner_mas, point.grid.outer_mas), check=False)
    sure = _surely_better(likelihood.n_independent, point.chi2_binary, found.chi2_binary)
    return (disc, found) if sure or _disc_decides(likelihood, point) else (likelihood, point)


def _disc_decides(likelihood: Likelihood, point: SearchResult) -> bool:
    """Whether the contrast beside a disc differs from that beside a point by its error."""
    model = replace(likelihood.model, diameter_mas=USUAL_DISC_MAS)
    box = box_of(point.grid, likelihood)
    fit = refine(likelihood.with_model(model), np.array(point.theta), box, 0.0)
    change = abs(fit.companion.contrast - point.companion.contrast)
    return bool(change > point.companion.contrast_error)


USUAL_DISC_MAS = 1.0
"""Half of all stars are larger by the prior, half-Cauchy with 1 mas."""


def _surely_better(n: int, point: float, disc: float) -> bool:
    """Whether a disc lowers χ² for certain, with the stated errors and with their scale free."""
    return bool(min(point - disc, n * np.log(point / disc)) > SURELY_A_DISC)


LIKELY_DISC_MAS = 4.0
"""Five of six stars are smaller by the prior, half-Cauchy with 1 mas."""


def shows_disc(likelihood: Likelihood, result: SearchResult) -> bool:
    """Whether the data show that the companion is a disc, by a fit with the stated errors.

    With their scale free as well, so that errors that are too small make no disc.
    """
    sure = result.delta_chi2 > SURELY_NOT_NOISE and result.companion.contrast > DISC_CONTRAST
    if not sure or likelihood.model.companion_diameter_mas != 0.0:
        return False
    disc = likelihood.with_model(replace(likelihood.model, companion_diameter_mas="free"))
    grid = result.grid
    box = box_of(grid, likelihood)
    point = refine(likelihood, result.theta, box, 0.0)
    larger = refine(disc, with_disc(disc, np.array(point.theta), box), box, 0.0)
    fits = (likelihood, point), (disc, larger)
    chi2 = (float(model.chi2(np.array(fit.theta))[0]) for model, fit in fits)
    return _surely_better(likelihood.n_independent, *chi2)


def _search_for_disc(
    likelihood: Likelihood, point: SearchResult, size: float = SHAPE_START
) -> SearchResult:
    """Search again with a free disc of the companion, from what was found for a point.

    Or for a disc of a given ``size``, in units of λ/B_max.
    """
    free = replace(likelihood.model, companion_diameter_mas="free")
    disc, grid = likelihood.with_model(free), point.grid
    box = box_of(grid, likelihood)
    known = np.array([with_disc(disc, np.array(m.theta), box, size) for m in point.modes])
    return search(disc, (grid.inner_mas, grid.outer_mas), known=known, check=False)


def _searched(first: SearchResult, options: SearchOptions) -> tuple[SearchResult, ExtraNoise]:
    """Search the field of a search with stated errors with the noise that was asked for.

    The global check is one of the search that stands.
    """
    apart = options.file_noise is not False
    likelihood, field = first.likelihood, (first.grid.inner_mas, first.grid.outer_mas)
    prior = noise_prior(likelihood.observables, options)
    if options.robust:
        free = options.extra_noise
        return search_robust(likelihood, field, free_scale=free, per_file=apart, prior=prior)
    if options.extra_noise or options.channel_noise or prior.floors:
        return search_with_noise(likelihood, field, per_file=apart, prior=prior, first=first)
    return with_global_check(first), ExtraNoise()


def _beyond(result: SearchResult) -> list[str]:
    """Warn where a field that was asked for seems to leave the companion out."""
    found, grid = [], result.grid
    if (place := look_inside(result)) is not None:
        found.append(
            f"the field begins at {grid.inner_mas:.4g} mas: near {place:.1f} mas, nearer the "
            "star, a companion fits as well or better, and this may be an alias of it"
        )
    rho = result.companion.separation_mas
    at_the_edge = rho > grid.outer_mas - 0.25 * grid.step_mas
    if on_inner_edge(result) or (at_the_edge and result.delta_chi2 > SURELY_NOT_NOISE):
        found.append(
            f"the best fit lies at {rho:.4g} mas, on the edge of the field that was asked for: "
            "the companion may be outside it"
        )
    return found
