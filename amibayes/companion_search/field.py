"""The field of a search: what the data can see, and whether something stands outside."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.grid import Grid, make_grid
from amibayes.companion_search.modes import innermost_first
from amibayes.companion_search.optimise import fit_single, refine_at
from amibayes.companion_search.result import RIVAL, Mode, SearchResult
from amibayes.companion_search.seeds import MAX_COARSE_DATA, MODE_LIMIT, coarse_likelihood
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.errors import DataError
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise_fit import noise_beside
from amibayes.models.binary import BinaryModel
from amibayes.models.parameters import Box
from amibayes.units import MAS, FloatArray

SURELY_NOT_NOISE = 30.0
"""Δχ² that noise alone does not give anywhere in a field of a few thousand positions."""

DISC_CONTRAST = 0.03
"""Contrast below which a companion's disc is not tried unasked: as large as the star's it would
have a surface brightness of 3 % of it, and what looks resolved is rather light lost in the
channel's width."""

PERHAPS_NOT_NOISE = 20.0
"""Δχ² from which a companion may be stated."""

MAX_LOOKED_AT = 40_000
"""Positions of the look around the field."""

MAX_WORK, WORK_PER_POSITION = 300_000_000, 1000
"""Positions times points of the (u, v) plane of the look outside, and how many more points a
position is worth: some three seconds."""

COARSE_STEPS_PER_FRINGE = 4
"""Positions per λ/B_max of the look outside: half of the search's, which costs 20 % of a peak."""

MARGIN = 1.2
"""A field is widened to so many times the separation of what stands outside it."""

NOTABLY_BETTER = 0.1
"""Part of χ²'s gain by which a coarse look outside must exceed that inside."""


def default_separation(likelihood: Likelihood) -> tuple[float, float]:
    """Range of separations the data can see: λ/2B_max to λ/B_min, mas."""
    frequency = likelihood.samples.frequency
    with np.errstate(divide="ignore"):
        return float(0.5 / frequency.max() / MAS), float(1.0 / frequency.min() / MAS)


def refuse_no_length(likelihood: Likelihood) -> None:
    """Raise a `DataError` where baselines have no length, and there is no field."""
    if not np.isfinite(default_separation(likelihood)).all():
        raise DataError(
            "has baselines of zero or infinite length",
            source=likelihood.observables.source,
            remedy="check UCOORD and VCOORD",
        )


def resolution_mas(likelihood: Likelihood) -> float:
    """λ/B of the longest baseline in wavelengths, mas."""
    return float(1.0 / likelihood.samples.frequency.max() / MAS)


def box_of(grid: Grid, likelihood: Likelihood) -> Box:
    """Bounds of a fit inside the field of a grid."""
    return Box(grid.inner_mas, grid.outer_mas, resolution_mas(likelihood))


def look_inside(result: SearchResult) -> float | None:
    """Find where nearer the star than the field a companion would fit as well.

    What was found may then be an alias of that. Only a gain that noise alone does not give
    counts.

    Returns
    -------
    float or None
        Its separation in mas; None where nothing inside is as good.
    """
    nearest = default_separation(result.likelihood)[0]
    if nearest >= result.grid.inner_mas:
        return None
    inner = result.grid.inner_mas
    step = max(result.grid.step_mas, inner * float(np.sqrt(np.pi / MAX_LOOKED_AT)))
    within = make_grid(nearest, inner, step)
    if not len(within):
        return None
    bank = _bank(within, result)
    place, gain = _best_of(bank, result)
    # A peak falls between the positions of either grid, which costs it up to 5 %.
    as_good = 0.95 * float(result.bank_gain.max()) - MODE_LIMIT
    return float(np.hypot(*place)) if gain >= max(as_good, SURELY_NOT_NOISE) else None


EQUAL = 1.0
"""Δχ² of an alias outside the field that is as good by the geometry alone, and not told of."""


def look_outside(result: SearchResult) -> float | None:
    """Find where farther out than the field a companion would fit as well.

    As far as the channels allow, within `MAX_LOOKED_AT` and `MAX_WORK`. An alias of what was
    found is left out: it fits as well by the geometry alone. One of several thousand in Δχ² is
    told from it by the width of the channels, and may be where the companion is. Where there is
    an alias inside, that the sky repeats itself is said already.

    Returns
    -------
    float or None
        Its separation in mas; None where nothing outside is as good.
    """
    if result.delta_chi2 < PERHAPS_NOT_NOISE or result.aliases:
        return None
    likelihood, outer = result.likelihood, result.grid.outer_mas
    fringe = resolution_mas(likelihood)
    step = fringe / COARSE_STEPS_PER_FRINGE
    positions = min(MAX_LOOKED_AT, MAX_WORK / (len(likelihood.samples) + WORK_PER_POSITION))
    reach = np.hypot(outer, step * np.sqrt(positions / np.pi))
    beyond = make_grid(outer, float(min(outermost(likelihood), reach)), step)
    if not len(beyond):
        return None
    bank = _bank(beyond, result)
    place, gain = _best_of(bank, result)
    # Half a step of this grid beside a peak costs it up to 20 %.
    if gain < 0.8 * float(result.bank_gain.max()) - RIVAL:
        return None
    box, single = Box(outer, np.inf, fringe), result.single_theta
    alone = float(likelihood.deviance(np.array([result.chi2_single]))[0])
    found = _fit_from(place, bank, likelihood, single, box, alone)
    best = result.modes[0]
    modes = sorted((best, found), key=lambda m: -m.delta_chi2)
    aliases = innermost_first(likelihood, modes, single, fringe)[1]
    alike = bool(aliases) and abs(found.delta_chi2 - best.delta_chi2) < EQUAL
    if alike or found.delta_chi2 < best.delta_chi2 - RIVAL:
        return None
    return found.companion.separation_mas


def rival_outside(result: SearchResult) -> list[str]:
    """Warn where a companion outside the default field fits as well."""
    place = look_outside(result)
    if place is None:
        return []
    wider = f"{result.grid.inner_mas:.3g}:{MARGIN * place:.3g}"
    return [
        f"outside the field, near {place:.1f} mas, a companion fits as well: the position is not "
        f"certain (--separation {wider} searches there too)"
    ]


def _residuals(likelihood: Likelihood, single: FloatArray) -> FloatArray:
    """Whitened residuals of a star alone, (n_data,)."""
    return single_likelihood(likelihood).residuals(single)[:, 0]


def _fit_from(
    place: FloatArray,
    bank: TemplateBank,
    likelihood: Likelihood,
    single: FloatArray,
    box: Box,
    deviance_single: float,
) -> Mode:
    """Fit from a place (2,), mas, with the contrast that a bank's templates give there."""
    tail = bank.matched_filter(_residuals(likelihood, single))(place)[0]
    return refine_at(likelihood, place, tail, single, box, deviance_single)


def _bank(grid: Grid, result: SearchResult) -> TemplateBank:
    # A moving companion is looked for at rest there: a first look has no time for more.
    likelihood = result.likelihood
    still = likelihood.with_model(replace(likelihood.model, fastest_mas_yr=0.0))
    return TemplateBank(still, grid, result.single_theta)


def _best_of(bank: TemplateBank, result: SearchResult) -> tuple[FloatArray, float]:
    """Place (2,), mas, of the largest gain in χ² of a bank, and the gain."""
    gain = bank.survey(_residuals(result.likelihood, result.single_theta)).gain
    best = int(gain.argmax())
    return np.array([bank.grid.east_mas[best], bank.grid.north_mas[best]]), float(gain[best])


def resolves_stars(likelihood: Likelihood) -> bool:
    """Whether V² would notice a disc of 0.3 mas: by 1 % at the longest baseline, (πθB/λ)²/4."""
    z = np.pi * 0.3 * MAS * likelihood.samples.frequency.max()
    return likelihood.observables.n_vis2 > 0 and bool(z * z / 4.0 > 0.01)


def notices_disc(likelihood: Likelihood, diameter_mas: float) -> bool:
    """Whether V² with the stated errors would tell a star's disc from a point by Δχ² 1."""
    star = single_likelihood(likelihood.with_model(BinaryModel(1, diameter_mas)))
    point = single_likelihood(likelihood.with_model(BinaryModel(1)))
    change = star.predict(np.empty((1, 0))) - point.predict(np.empty((1, 0)))
    return bool((likelihood.noise.whiten(change) ** 2).sum() > 1.0)


def outermost(likelihood: Likelihood) -> float:
    """Separation, mas, at which the narrowest channel smears a companion out: R·λ/B_max.

    Of images no farther than the response of the extraction is known.
    """
    data = likelihood.observables
    widths = [m.band_m / m.wavelength_m for m in (data.vis2, data.closure_phase) if len(m)]
    smeared = resolution_mas(likelihood) / max(float(np.concatenate(widths).min()), 1e-6)
    known = [s.response.reach() / MAS for s in data.setups if s.response is not None]
    return min([smeared, *known])


def choose_field(
    likelihood: Likelihood, prior: NoisePrior | None = None
) -> tuple[tuple[float, float], float | None]:
    """Choose the range of separations where none is asked for.

    `default_separation`, unless a coarse look as far as the channels allow, within
    `MAX_WORK`, shows something notably better outside: that is inside then, or what is nearer to
    the star and fits as well. The look comes before any noise is fitted to what a star alone
    leaves, which would hide a companion; what it shows has to hold with the noise that is fitted
    beside it, since errors that channels share look like wide companions.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    prior : NoisePrior, optional
        Of extra noise.

    Returns
    -------
    (inner, outer) : tuple of float
        mas.
    place : float or None
        Separation of what was found outside the default field.
    """
    inner, outer = default_separation(likelihood)
    fringe = resolution_mas(likelihood)
    if not np.isfinite([inner, outer]).all():
        return (inner, outer), None
    if likelihood.n_independent <= len(likelihood.parameters):
        return (inner, outer), None
    # A moving companion is looked for at rest, alike in all bands: a first look.
    still = likelihood.with_model(replace(likelihood.model, fastest_mas_yr=0.0, bands=()))
    still, farthest = _affordable(still, Box(inner, outermost(likelihood), fringe))
    if farthest <= outer:
        return (inner, outer), None
    step = fringe / COARSE_STEPS_PER_FRINGE
    within, beyond = make_grid(inner, outer, step), make_grid(outer, farthest, step)
    single = fit_single(still)[0]
    place, gain = _notable(still, within, beyond, single)
    box = Box(inner, farthest, fringe)
    if place is None or not _holds(still, within, single, place, box, prior):
        return (inner, outer), None
    near = make_grid(NEARER * inner, inner, NEARER * step)
    gains = _gains(still, near, single)
    separation = float(np.hypot(*place))
    widened = MARGIN * separation
    if gains.max(initial=0.0) > min(gain - MODE_LIMIT, (1.0 - NOTABLY_BETTER) * gain):
        # What is nearer to the star than two baselines can tell has aliases far out.
        best = int(gains.argmax())
        nearer = np.array([near.east_mas[best], near.north_mas[best]])
        if gains[best] > gain - MODE_LIMIT:
            return (NEARER * inner, outer), float(np.hypot(*nearer))
        # Gains of faint companions do not tell bright ones apart, however large they are.
        bank, box = TemplateBank(still, near, single), Box(NEARER * inner, farthest, fringe)
        fits = [_fit_from(at, bank, still, single, box, 0.0) for at in (nearer, place)]
        if fits[0].delta_chi2 > fits[1].delta_chi2 - MODE_LIMIT:
            return (NEARER * inner, widened), fits[0].companion.separation_mas
    return (inner, widened), separation


def wider_fields(result: SearchResult) -> list[tuple[float, float]]:
    """Fields around that of a search, mas, where a bright companion outside may explain a misfit.

    First one that begins nearer to the star, then those that reach farther.

    The looks outside are made with the templates of a faint companion. One half as bright as the
    star changes V² otherwise: it is found by searches alone, and a fit inside that is far off
    asks for these. A fit on the inner edge asks for the first one, however good it is. None where
    the fit is no worse than errors that are somewhat too small make it, or where the data are too
    many to search again.
    """
    likelihood, grid = result.likelihood, result.grid
    n, alone = likelihood.n_independent, result.chi2_single
    nearer = NEARER * grid.inner_mas, grid.outer_mas
    if n > MAX_COARSE_DATA or min(result.chi2_binary, 0.2 * alone) < FAR_OFF * n:
        return [nearer] if on_inner_edge(result) else []
    fringe = resolution_mas(likelihood)
    farthest = _affordable(likelihood, Box(grid.inner_mas, outermost(likelihood), fringe))[1]
    edges = (min(times * grid.outer_mas, farthest) for times in WIDER)
    wider = [(grid.inner_mas, edge) for edge in dict.fromkeys(edges) if edge > grid.outer_mas]
    return [nearer, *wider]


def on_inner_edge(result: SearchResult) -> bool:
    """Whether what noise alone does not give lies on the inner edge of the field."""
    edge = result.grid.inner_mas + 0.25 * result.grid.step_mas
    return result.delta_chi2 > SURELY_NOT_NOISE and result.companion.separation_mas < edge


def on_outer_edge(result: SearchResult) -> bool:
    """Whether the fit ended at the outer edge of the field: it is better still outside."""
    left = result.grid.outer_mas - result.companion.separation_mas
    return left < AT_EDGE * resolution_mas(result.likelihood)


AT_EDGE = 1e-3
"""Distance from an edge, in units of λ/B_max, of a fit that ended there: far below any error."""

NEARER = 0.3
"""Inner edge of the first of these fields, in units of that of the search: λ/7B, below which
contrast and separation of any companion are one number."""


FAR_OFF = 2.0
"""χ² per datum of the best companion inside, and a fifth of that of the star alone, from which on
fields beyond are searched."""

WIDER = (2.5, 6.0)
"""Outer edges of these fields, in units of that of the first: six times as many positions each."""

EXPLAINED = 0.3
"""Part of χ² that a companion in a wider field may leave of what that inside does: one of
unknown noise takes no such share of it."""


def _notable(
    likelihood: Likelihood, within: Grid, beyond: Grid, single: FloatArray
) -> tuple[FloatArray | None, float]:
    """Place (2,), mas, outside the field that is notably better than all inside, and its gain."""
    inside, outside = (_gains(likelihood, grid, single) for grid in (within, beyond))
    if not len(inside) or not len(outside):
        return None, 0.0
    best = int(outside.argmax())
    left = single_likelihood(likelihood).chi2(single[None])[0] - outside[best]
    # Errors that are too small make the gains of noise too large in proportion.
    least = MODE_LIMIT * max(left / likelihood.n_independent, 1.0)
    if outside[best] < inside.max() + max(least, NOTABLY_BETTER * inside.max()):
        return None, 0.0
    return np.array([beyond.east_mas[best], beyond.north_mas[best]]), float(outside[best])


def _holds(
    likelihood: Likelihood,
    within: Grid,
    single: FloatArray,
    place: FloatArray,
    box: Box,
    prior: NoisePrior | None,
) -> bool:
    """Whether a companion outside still fits notably better with the noise fitted beside it."""
    bank = TemplateBank(likelihood, within, single)
    theta = np.array(_fit_from(place, bank, likelihood, single, box, 0.0).theta)
    _, noisy = noise_beside(likelihood, theta, prior=prior)
    alone, chi2 = fit_single(noisy)
    gain = chi2 - float(noisy.deviance(noisy.chi2(theta))[0])
    return bool(gain > _gains(noisy, within, alone).max(initial=0.0) + MODE_LIMIT)


def _affordable(likelihood: Likelihood, box: Box) -> tuple[Likelihood, float]:
    """Data and outer edge, mas, of a look within `MAX_WORK`: large data have channels averaged."""
    step, reach = box.fringe_mas / COARSE_STEPS_PER_FRINGE, 0.0
    for n in (min(MAX_COARSE_DATA, len(likelihood.samples)), len(likelihood.samples)):
        # Points of more than this do not stay in the processor's cache.
        points = (n + WORK_PER_POSITION) * max(n / MAX_COARSE_DATA, 1.0)
        reach = min(box.outer_mas, step * np.sqrt(MAX_WORK / points / np.pi))
        coarse = coarse_likelihood(likelihood, replace(box, outer_mas=reach))
        if len(coarse.samples) <= 2 * n:
            return coarse, float(reach)
    return likelihood, float(reach)


def _gains(likelihood: Likelihood, grid: Grid, single: FloatArray) -> FloatArray:
    """Gain in χ² of a faint companion at every position of a grid, (n,)."""
    if not len(grid):
        return np.empty(0)
    return TemplateBank(likelihood, grid, single).survey(_residuals(likelihood, single)).gain
