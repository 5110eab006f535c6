"""The search: template bank, nonlinear refinement, global cross-check, and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter

from amibayes.companion_search.grid import Grid, make_grid
from amibayes.companion_search.optimise import fit_single, global_check, refine
from amibayes.companion_search.result import Mode, SearchResult, companions_of
from amibayes.companion_search.scan import ScanResult
from amibayes.companion_search.template_bank import TemplateBank, rates_per_axis
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.parameters import Box
from amibayes.support.quantities import takes_quantities
from amibayes.units import MAS, FloatArray, IntArray

GRID_STEPS_PER_FRINGE = 8
"""Lattice points per λ/B_max."""

MIN_SEEDS, MAX_SEEDS = 5, 24
"""How many peaks of the map are refined."""

MODE_LIMIT = 25.0
"""Modes within this Δχ² of the best one are left standing."""

SURELY_NOT_NOISE = 30.0
"""Δχ² that noise alone does not give anywhere in a field of a few thousand positions."""

MAX_LOOKED_AT = 40_000
"""Positions of the look around the field."""

MAX_POSITIONS = 2_000_000
"""Positions of a search: more would take hours and all the memory."""

BRIGHT = 0.1
"""Above this contrast the templates are no longer linear enough to rank positions."""

BRIGHT_CONTRASTS = (0.15, 0.3, 0.6, 1.0)


def default_separation(likelihood: Likelihood) -> tuple[float, float]:
    """Range of separations the data can see: λ/2B_max to λ/B_min, mas."""
    frequency = likelihood.samples.frequency
    with np.errstate(divide="ignore"):
        return float(0.5 / frequency.max() / MAS), float(1.0 / frequency.min() / MAS)


def resolution_mas(likelihood: Likelihood) -> float:
    """λ/B of the longest baseline in wavelengths, mas."""
    return float(1.0 / likelihood.samples.frequency.max() / MAS)


def look_outside(result: SearchResult) -> float | None:
    """Find where outside the field a companion would fit much better.

    The scan reaches to where the width of the channels smears a companion out, or as far
    as `MAX_LOOKED_AT` positions go. It is coarse: half the field's sampling.

    Returns
    -------
    float or None
        Its separation in mas; None where nothing outside is better.
    """
    likelihood, grid = result.likelihood, result.grid
    data = likelihood.observables
    bands = [m.band_m / m.wavelength_m for m in (data.vis2, data.closure_phase)]
    reach = resolution_mas(likelihood) / max(float(np.concatenate(bands).min()), 1e-6)
    step = 2.0 * grid.step_mas
    area = MAX_LOOKED_AT / np.pi
    farthest = min(reach, float(np.hypot(grid.outer_mas, step * np.sqrt(area))))
    around = make_grid(grid.outer_mas, farthest, step)
    if not len(around):
        return None
    gain, place = _best_on(around, result)
    inside = float(result.bank_gain.max())
    return place if gain >= inside + max(MODE_LIMIT, 0.1 * inside) else None


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
    gain, place = _best_on(within, result)
    # A peak falls between the positions of either grid, which costs it up to 5 %.
    as_good = 0.95 * float(result.bank_gain.max()) - MODE_LIMIT
    return place if gain >= max(as_good, SURELY_NOT_NOISE) else None


def _best_on(grid: Grid, result: SearchResult) -> tuple[float, float]:
    """Largest gain in χ² at the positions of a grid, and the separation where it is, mas."""
    likelihood = result.likelihood
    # A moving companion is looked for at rest there: a first look has no time for more.
    still = likelihood.with_model(replace(likelihood.model, fastest_mas_yr=0.0))
    bank = TemplateBank(still, grid, result.single_theta)
    residuals = single_likelihood(likelihood).residuals(result.single_theta)[:, 0]
    gain = bank.survey(residuals).gain
    best = int(gain.argmax())
    return float(gain[best]), float(np.hypot(grid.east_mas[best], grid.north_mas[best]))


def resolves_stars(likelihood: Likelihood) -> bool:
    """Whether V² would notice a disc of 0.3 mas: by 1 % at the longest baseline, (πθB/λ)²/4."""
    z = np.pi * 0.3 * MAS * likelihood.samples.frequency.max()
    return likelihood.observables.n_vis2 > 0 and bool(z * z / 4.0 > 0.01)


@takes_quantities
def search(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
) -> SearchResult:
    """Find the companion that explains the data best.

    Parameters
    ----------
    likelihood : Likelihood
        With a model of one companion.
    separation_mas : (inner, outer), optional
        Annulus that is searched; by default `default_separation`.

    Returns
    -------
    SearchResult

    Raises
    ------
    DataError
        Where there are not more independent data than free parameters.
    UsageError
        Where the annulus holds no position.
    """
    _refuse_underdetermined(likelihood)
    inner, outer = separation_mas or default_separation(likelihood)
    box = Box(inner, outer, resolution_mas(likelihood))
    grid = _grid(likelihood, box)
    single, deviance_single = fit_single(likelihood)
    bank = TemplateBank(likelihood, grid, single)
    residuals = single_likelihood(likelihood).residuals(single)[:, 0]
    survey = bank.survey(residuals)
    seeds = _seeds(likelihood, grid, survey, single, box)
    found = [refine(likelihood, theta, box, deviance_single) for theta in seeds]
    check = global_check(likelihood, bank, box, single, deviance_single)
    every = distinct_modes([*found, check], box.fringe_mas)
    modes, aliases = innermost_first(likelihood, every, single)
    theta = np.array(modes[0].theta)
    covariance = _errors(likelihood, theta)
    return SearchResult(
        likelihood=likelihood,
        companion=companions_of(likelihood.parameters, theta, covariance)[0],
        theta=theta,
        theta_covariance=covariance,
        single_theta=single,
        chi2_single=float(residuals @ residuals),
        chi2_binary=float(likelihood.chi2(theta)[0]),
        ndof=likelihood.n_independent - len(likelihood.parameters),
        modes=modes,
        grid=grid,
        bank_contrast=survey.contrast,
        bank_sigma=survey.sigma,
        global_check=check,
        warnings=_doubts(modes, aliases, found, check),
        joint_gain=survey.gain if bank.joint else None,
    )


def _refuse_underdetermined(likelihood: Likelihood) -> None:
    if likelihood.n_independent <= len(likelihood.parameters):
        raise DataError(
            f"holds {likelihood.n_independent} independent data for "
            f"{len(likelihood.parameters)} parameters",
            source=likelihood.observables.source,
            remedy="free fewer parameters or give more data",
        )


def _grid(likelihood: Likelihood, box: Box) -> Grid:
    """Positions of the field, `GRID_STEPS_PER_FRINGE` per fringe."""
    step = box.fringe_mas / GRID_STEPS_PER_FRINGE
    finest = step / rates_per_axis(likelihood)
    _refuse_huge(box.inner_mas, box.outer_mas, finest, likelihood.observables.source)
    grid = make_grid(box.inner_mas, box.outer_mas, step)
    if not len(grid):
        raise UsageError(
            f"no position between {box.inner_mas:g} and {box.outer_mas:g} mas on a grid of "
            f"{grid.step_mas:.3g} mas",
            source="--separation",
            remedy="widen the range",
        )
    return grid


def _errors(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Covariance of the parameters; NaN without a companion, whose errors nothing could tell."""
    if not (theta[likelihood.parameters.contrasts] > 0.0).any():
        return np.full((len(theta),) * 2, np.nan)
    return likelihood.errors(theta)


def _refuse_huge(inner: float, outer: float, step: float, source: str) -> None:
    if not np.isfinite([inner, outer, step]).all():
        raise DataError(
            "has baselines of zero or infinite length",
            source=source,
            remedy="check UCOORD and VCOORD",
        )
    with np.errstate(all="ignore"):  # a damaged baseline may be of any length
        positions = np.pi * float(np.diff((np.array([inner, outer]) / step) ** 2)[0])
    if not positions <= MAX_POSITIONS:
        raise UsageError(
            f"{positions:.2g} positions between {inner:.4g} and {outer:.4g} mas",
            source="--separation",
            remedy=f"narrow the range: at most {MAX_POSITIONS:.0e} are searched",
        )


def _seeds(
    likelihood: Likelihood,
    grid: Grid,
    survey: ScanResult,
    single: FloatArray,
    box: Box,
) -> FloatArray:
    """Starting points (n, n_dim): peaks of the linear map, and of the exact one if bright."""
    best = peaks(grid, survey.gain, box.fringe_mas)
    rest = np.broadcast_to(single, (len(best), len(single)))
    places = grid.east_mas[best], grid.north_mas[best]
    seeds = np.column_stack([*places, survey.bounded(best), rest])
    if survey.contrasts[best].max(initial=0.0) < BRIGHT:
        return seeds
    chi2, brightness = _exact_map(likelihood, grid, single)
    best = peaks(grid, chi2.max() - chi2, box.fringe_mas)
    return np.vstack([seeds, _thetas(likelihood, grid, best, brightness[best], single)])


def _thetas(
    likelihood: Likelihood, grid: Grid, at: IntArray, contrast: FloatArray, single: FloatArray
) -> FloatArray:
    """Parameter sets (n, n_dim) of companions at rest, of one contrast in every band."""
    rest = np.broadcast_to(single, (len(at), len(single)))
    three = np.column_stack([grid.east_mas[at], grid.north_mas[at], np.clip(contrast, 0.0, 1.0)])
    return np.hstack([likelihood.model.at_rest(three), rest])


def _exact_map(
    likelihood: Likelihood, grid: Grid, single: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Least χ² over a few bright contrasts, and that contrast, at every position."""
    everywhere = np.arange(len(grid))
    pieces = np.array_split(everywhere, 1 + len(grid) * len(likelihood.samples) // 1_000_000)
    chi2 = np.array(
        [
            np.concatenate(
                [
                    likelihood.chi2(_thetas(likelihood, grid, p, np.full(len(p), c), single))
                    for p in pieces
                ]
            )
            for c in BRIGHT_CONTRASTS
        ]
    )
    return chi2.min(axis=0), np.array(BRIGHT_CONTRASTS)[chi2.argmin(axis=0)]


def peaks(grid: Grid, gain: FloatArray, fringe_mas: float) -> IntArray:
    """Positions of the highest distinct local maxima of a map, best first.

    At least `MIN_SEEDS` (if there are as many), further ones while within
    `MODE_LIMIT` of the best, at most `MAX_SEEDS`.
    """
    image = grid.image(gain)
    lowest = np.where(np.isnan(image), -np.inf, image)
    top = (lowest == maximum_filter(lowest, size=3, mode="constant", cval=-np.inf)) & (lowest > 0)
    on_grid = top[grid.rows + grid.half_width, grid.columns + grid.half_width]
    candidates = np.flatnonzero(on_grid)
    candidates = candidates[np.argsort(-gain[candidates], kind="stable")]
    chosen: list[int] = []
    for i in candidates:
        enough = len(chosen) >= MIN_SEEDS and gain[i] < gain[candidates[0]] - MODE_LIMIT
        if enough or len(chosen) == MAX_SEEDS:
            break
        away = np.hypot(grid.columns[chosen] - grid.columns[i], grid.rows[chosen] - grid.rows[i])
        if not (away * grid.step_mas < 0.5 * fringe_mas).any():
            chosen.append(int(i))
    return np.array(chosen, dtype=np.intp)


def distinct_modes(modes: Sequence[Mode], fringe_mas: float) -> tuple[Mode, ...]:
    """Modes within `MODE_LIMIT` of the best, each at least λ/4B from a better one."""
    kept: list[Mode] = []
    for mode in sorted(modes, key=lambda m: -m.delta_chi2):
        near = [np.hypot(*np.subtract(mode.place, k.place)) < 0.25 * fringe_mas for k in kept]
        if not any(near) and (not kept or mode.delta_chi2 > kept[0].delta_chi2 - MODE_LIMIT):
            kept.append(mode)
    return tuple(kept)


def innermost_first(
    likelihood: Likelihood, modes: Sequence[Mode], single: FloatArray
) -> tuple[tuple[Mode, ...], tuple[Mode, ...]]:
    """Put the innermost of the positions that the data cannot tell from the best one first.

    A mask on a regular lattice (NIRISS) repeats itself on the sky: far positions predict
    the same data as near ones but for the width of the band. Two modes are aliases where
    their predictions differ by less than 3σ over all data, and by less than half of the
    signal itself, though they are more than λ/B_max apart.

    Returns
    -------
    modes : tuple of Mode
    aliases : tuple of Mode
        Those the first one cannot be told from.
    """
    thetas = np.array([m.theta for m in modes])
    data = likelihood.noise.whiten(likelihood.predict(thetas))
    none = single_likelihood(likelihood).predict(np.atleast_2d(single))
    signal = data - likelihood.noise.whiten(none)
    apart = ((signal - signal[:, :1]) ** 2).sum(axis=0)
    alike = apart < np.minimum(9.0, 0.25 * (signal[:, 0] ** 2).sum())
    places = thetas[:, likelihood.parameters.place()]
    distance = np.hypot(*(places - places[0]).T)
    alike &= distance > resolution_mas(likelihood)
    alike[0] = True
    group = [m for m, same in zip(modes, alike, strict=True) if same]
    first = min(group, key=lambda m: m.companion.separation_mas)
    rest = [m for m in modes if m is not first]
    return (first, *rest), tuple(m for m in group if m is not first)


def _doubts(
    modes: Sequence[Mode], aliases: Sequence[Mode], found: Sequence[Mode], check: Mode
) -> tuple[str, ...]:
    doubts = []
    best_found = max((m.delta_chi2 for m in found), default=0.0)
    if check.delta_chi2 > best_found + 0.1:
        doubts.append(
            f"the global optimiser found a better solution than the grid "
            f"(Δχ² {check.delta_chi2:.2f} against {best_found:.2f}); it was adopted"
        )
    if aliases:
        opposite = [m for m in aliases if np.hypot(*np.add(m.place, modes[0].place)) < 1e-2]
        far = [f"{m.companion.separation_mas:.0f}" for m in aliases if m not in opposite]
        if opposite:
            doubts.append("without closure phases a position cannot be told from its opposite")
        if far:
            name = "alias" if len(far) == 1 else "aliases"
            doubts.append(
                f"these baselines cannot tell the position from its {name} at {', '.join(far)} "
                "mas: the innermost is reported"
            )
    rivals = [m for m in modes[1:] if m not in aliases and m.delta_chi2 > modes[0].delta_chi2 - 9]
    if rivals:
        others = "position fits" if len(rivals) == 1 else "positions fit"
        doubts.append(f"{len(rivals)} other {others} within Δχ² 9: it is not unique")
    return tuple(doubts)
