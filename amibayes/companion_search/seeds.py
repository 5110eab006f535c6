"""Where local fits begin: peaks of the linear map, and of the exact one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import maximum_filter

from amibayes.calibration.binning import bin_channels
from amibayes.companion_search.descent import descend
from amibayes.companion_search.exact_map import LADDER, exact_map, likely_places
from amibayes.companion_search.grid import Grid, make_grid
from amibayes.companion_search.optimise import refine, starting_points, with_large_discs
from amibayes.companion_search.result import Mode, mode_of
from amibayes.companion_search.scan import ScanResult
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.parameters import Box
from amibayes.units import FloatArray, IntArray

MIN_SEEDS, MAX_SEEDS = 5, 24
"""How many peaks of the linear map are refined."""

MODE_LIMIT = 25.0
"""Δχ² within which modes are kept beside the best one: five standard deviations."""

NOT_FAINT = 0.05
"""Contrast above which the templates rank positions wrongly: c² is some of c·σ then."""

STRONG = 100.0
"""Δχ² above which c² counts even for faint companions, and a poor map may hide the best."""

MIN_BRIGHT_STEPS, MAX_BRIGHT_STEPS = 5, 7
"""Positions of the exact map per λ/B_max: from half of a step away a local fit arrives. Strong
data need the finer ones, which cost twice as much."""

EXACT_WORK = 4e7
"""Model values (points, positions, contrasts) of an exact map: some two seconds."""

STAGED = 0.5
"""Times that work above which V² alone says first where the exact map is worth it: a thirtieth of
the field is, and none of 63 simulated binaries of 10 to 100 % was lost by that."""

PEAKS_PER_CONTRAST, MAX_BRIGHT_SEEDS = 8, 12
"""Peaks of the exact map that are fitted: at each contrast, and in all for each star."""

TRIAL_DISCS = (0.0, 0.35, 0.7)
"""Diameters of the star, in units of λ/B_max, at which the exact map is made where it is free;
from halfway between them a local fit arrives."""

ALIASES = 0.05
"""Part of the best gain within which peaks of a map are fitted: of a mask on a lattice (NIRISS) far
positions predict nearly the same data, a bright companion's linear map ranks them wrongly by some
per cent, and a free disc of a companion makes up for much of what is left."""

MAX_COARSE_DATA = 2000
"""Data above which local fits begin with channels averaged."""

FITTED_ALONE = 3
"""Modes that are fitted to the end with NLopt: Δχ² of the others is right to some 0.1."""

ROUGHNESS, COARSENESS = 0.1, 0.02
"""Part of the best gain by which fits may stand in another order than complete ones: fits that
may not have arrived, and fits with channels averaged."""


def linear_seeds(
    likelihood: Likelihood, grid: Grid, survey: ScanResult, single: FloatArray, box: Box
) -> FloatArray:
    """Peaks of the linear map as starting points, (n, n_dim)."""
    at = peaks(grid, survey.gain, box.fringe_mas)
    places = np.column_stack([grid.east_mas[at], grid.north_mas[at]])
    return starting_points(likelihood, places, survey.bounded(at), single, box)


def may_be_bright(survey: ScanResult, at: IntArray) -> bool:
    """Whether what the linear map shows at its peaks may be a companion it cannot rank."""
    bright = survey.contrasts[at].max(initial=0.0) > NOT_FAINT
    return bool(bright or survey.gain.max(initial=0.0) > STRONG)


def trial_stars(likelihood: Likelihood, single: FloatArray, box: Box) -> list[FloatArray]:
    """Nuisance parameters at which the exact map is made: of the star alone, and other discs.

    Where the companion is bright and the star's disc free, the star alone is of no use: its
    disc takes the place of the companion.
    """
    found, names = [single], likelihood.parameters.names
    if "diameter_mas" in names:
        k = list(likelihood.parameters.nuisance).index(names.index("diameter_mas"))
        for size in TRIAL_DISCS:
            found.append(single.copy())
            found[-1][k] = size * box.fringe_mas
    return found


def bright_seeds(likelihood: Likelihood, nuisance: FloatArray, box: Box) -> FloatArray:
    """Peaks of the exact map at each of its contrasts, (n, n_dim), each place once."""
    area = np.pi * (box.outer_mas**2 - box.inner_mas**2) / box.fringe_mas**2
    affordable = np.sqrt(EXACT_WORK / (area * len(likelihood.samples) * len(LADDER)))
    steps = np.clip(affordable, MIN_BRIGHT_STEPS, MAX_BRIGHT_STEPS)
    grid = make_grid(box.inner_mas, box.outer_mas, box.fringe_mas / float(steps))
    work = len(grid) * len(likelihood.samples) * len(LADDER)
    among = likely_places(likelihood, grid, nuisance) if work > STAGED * EXACT_WORK else None
    found = exact_map(likelihood, grid, nuisance, among=among)
    tops: list[tuple[float, int, float]] = []
    for chi2, contrast in zip(found.chi2, LADDER, strict=True):
        gain = chi2.max(initial=0.0) - chi2
        at = peaks(grid, gain, box.fringe_mas, PEAKS_PER_CONTRAST, PEAKS_PER_CONTRAST)
        tops += [(float(chi2[i]), int(i), contrast) for i in at]
    kept: list[tuple[int, float]] = []
    for _, i, contrast in sorted(tops):
        away = [
            np.hypot(grid.columns[i] - grid.columns[j], grid.rows[i] - grid.rows[j])
            for j, _ in kept
        ]
        if not away or min(away) * grid.step_mas > 0.25 * box.fringe_mas:
            kept.append((i, contrast))
    kept = kept[:MAX_BRIGHT_SEEDS]
    index = np.array([i for i, _ in kept], dtype=np.intp)
    bright = np.array([c for _, c in kept])
    places = np.column_stack([grid.east_mas[index], grid.north_mas[index]])
    three = np.column_stack([places, bright])
    parameters, alike = likelihood.parameters, likelihood.model.at_rest(three)
    tail = alike[:, np.concatenate([parameters.contrasts, parameters.rates])]
    return starting_points(likelihood, places, tail, nuisance, box)


def refine_all(
    likelihood: Likelihood,
    coarse: Likelihood,
    seeds: FloatArray,
    box: Box,
    deviance_single: float,
) -> list[Mode]:
    """Local fits from seeds (n, n_dim): all of them together, the best to the end.

    Large data are first fitted with their channels averaged, as `coarse_likelihood` has it.
    """
    if not len(seeds):
        return []
    base = float(coarse.deviance(coarse.chi2(_without(coarse, seeds[:1])))[0])
    tried = _descended(coarse, seeds, box, base)
    kept = _best_distinct(tried, box.fringe_mas, MIN_SEEDS, ROUGHNESS)
    starts = np.array([m.theta for m in kept])
    starts = np.vstack([starts, with_large_discs(likelihood, starts[:MIN_SEEDS], box)])
    if coarse is not likelihood:
        fitted = [refine(coarse, start, box, base) for start in starts]
        kept = _best_distinct(fitted, box.fringe_mas, 1, COARSENESS)
        starts = np.array([m.theta for m in kept])
        return [refine(likelihood, start, box, deviance_single) for start in starts]
    found = _descended(likelihood, starts, box, deviance_single)
    found.sort(key=lambda m: -m.delta_chi2)
    first = [np.array(m.theta) for m in found[:FITTED_ALONE]]
    best = [refine(likelihood, theta, box, deviance_single) for theta in first]
    return best + found[FITTED_ALONE:]


def _descended(
    likelihood: Likelihood, seeds: FloatArray, box: Box, deviance_single: float
) -> list[Mode]:
    """Fits from all seeds (n, n_dim) at once."""
    found, chi2 = descend(likelihood, seeds, box)
    gain = deviance_single - likelihood.deviance(chi2)
    return [mode_of(likelihood.parameters, *fit) for fit in zip(found, gain.tolist(), strict=True)]


def _without(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Parameter sets (n, n_dim) whose companions have no light."""
    dark = theta.copy()
    dark[:, likelihood.parameters.contrasts] = 0.0
    return dark


def _best_distinct(
    modes: Sequence[Mode], fringe_mas: float, least: int, uncertain: float
) -> list[Mode]:
    """Modes that a complete fit may make the best, or one worth reporting, each place once."""
    kept: list[Mode] = []
    for mode in sorted(modes, key=lambda m: -m.delta_chi2):
        best = max([mode, *kept[:1]], key=lambda m: m.delta_chi2).delta_chi2
        far = mode.delta_chi2 < best - max(2.0 * MODE_LIMIT, uncertain * best)
        if len(kept) >= least and (far or len(kept) == MAX_SEEDS):
            break
        near = [np.hypot(*np.subtract(mode.place, k.place)) < 0.1 * fringe_mas for k in kept]
        if not any(near):
            kept.append(mode)
    return kept


def coarse_likelihood(likelihood: Likelihood, box: Box) -> Likelihood:
    """The likelihood with channels averaged, where data are many and a companion allows it.

    Averages are narrow enough that a companion at the edge of the field is not smeared.
    """
    data = likelihood.observables
    size = int(np.ceil(likelihood.n_independent / MAX_COARSE_DATA))
    widths = [m.band_m / m.wavelength_m for m in (data.vis2, data.closure_phase) if len(m)]
    widest = max(float(np.max(w)) for w in widths)
    size = min(size, int(0.7 * box.fringe_mas / box.outer_mas / max(widest, 1e-9)))
    if size < 2 or data.freedom is not None:
        return likelihood
    return Likelihood(bin_channels(data, size), likelihood.model)


def peaks(
    grid: Grid,
    gain: FloatArray,
    fringe_mas: float,
    least: int = MIN_SEEDS,
    most: int = MAX_SEEDS,
) -> IntArray:
    """Positions of the highest distinct local maxima of a map, best first.

    At least ``least`` (if there are as many), further ones while within `MODE_LIMIT` or
    `ALIASES` of the best, at most ``most``.
    """
    image = grid.image(gain)
    lowest = np.where(np.isnan(image), -np.inf, image)
    top = (lowest == maximum_filter(lowest, size=3, mode="constant", cval=-np.inf)) & (lowest > 0)
    on_grid = top[grid.rows + grid.half_width, grid.columns + grid.half_width]
    candidates = np.flatnonzero(on_grid)
    candidates = candidates[np.argsort(-gain[candidates], kind="stable")]
    chosen: list[int] = []
    best = float(gain[candidates[0]]) if len(candidates) else 0.0
    lowest_gain = best - max(MODE_LIMIT, ALIASES * best)
    for i in candidates:
        enough = len(chosen) >= least and gain[i] < lowest_gain
        if enough or len(chosen) == most:
            break
        away = np.hypot(grid.columns[chosen] - grid.columns[i], grid.rows[chosen] - grid.rows[i])
        if not (away * grid.step_mas < 0.5 * fringe_mas).any():
            chosen.append(int(i))
    return np.array(chosen, dtype=np.intp)
