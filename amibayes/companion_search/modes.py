"""Positions of a companion that fit: which of them differ, and which are aliases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amibayes.companion_search.optimise import refine
from amibayes.companion_search.result import Mode
from amibayes.companion_search.seeds import MODE_LIMIT
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.parameters import Box
from amibayes.units import FloatArray

AS_GOOD = 2.7
"""Δχ² within which one of two positions does not fit better.

Of two positions whose predictions are d standard deviations apart the wrong one gains -d² ± 2d:
more than 1.645² in 5 % of data at most, whatever d is.
"""


NEARLY_EQUAL = 0.5
"""Contrast from which on the fainter star may be the brighter one, within errors of the data that
a companion is found in: it costs a fit, whose χ² then decides."""


def with_exchanged(
    likelihood: Likelihood, modes: Sequence[Mode], box: Box, deviance_single: float
) -> list[Mode]:
    """Modes, and those in which the brightest companion and the star have changed places.

    A contrast is 1 at most: of two stars that are equal within the errors the one that is taken
    for the companion may be either, and the positions are opposite.
    """
    bright = next((m for m in modes if m.contrast > NEARLY_EQUAL), None)
    if bright is None or likelihood.parameters.companions != 1:
        return list(modes)
    start = _exchanged(likelihood, np.array(bright.theta))
    return [*modes, refine(likelihood, start, box, deviance_single)]


def _exchanged(likelihood: Likelihood, theta: FloatArray) -> FloatArray:
    """Parameters of the same two stars with the other one at the origin, as bright at most."""
    parameters = likelihood.parameters
    moved = theta.copy()
    for columns in (parameters.place(), parameters.rates):
        moved[columns] = -theta[columns]
    low, high = np.array(parameters.bounds(parameters.contrasts)).T
    # In one of several bands it may be 0.
    ratio = 1.0 / np.maximum(theta[parameters.contrasts], 1e-3)
    moved[parameters.contrasts] = np.clip(ratio, low, high)
    if "contrast_slope" in parameters.names:
        moved[parameters.index("contrast_slope")] *= -1.0
    sizes = ["diameter_mas", "companion_diameter_mas"]
    if all(name in parameters.names for name in sizes):
        first, second = (parameters.index(name) for name in sizes)
        moved[[first, second]] = theta[[second, first]]
    return moved


def distinct_modes(modes: Sequence[Mode], fringe_mas: float) -> tuple[Mode, ...]:
    """Modes within `MODE_LIMIT` of the best, each at least λ/4B from a better one."""
    kept: list[Mode] = []
    # Of fits that ended at one place, better by rounding alone, the first stands.
    for mode in sorted(modes, key=lambda m: -round(m.delta_chi2, 6)):
        near = [np.hypot(*np.subtract(mode.place, k.place)) < 0.25 * fringe_mas for k in kept]
        if not any(near) and (not kept or mode.delta_chi2 > kept[0].delta_chi2 - MODE_LIMIT):
            kept.append(mode)
    return tuple(kept)


def innermost_first(
    likelihood: Likelihood, modes: Sequence[Mode], single: FloatArray, fringe_mas: float
) -> tuple[tuple[Mode, ...], tuple[Mode, ...]]:
    """Put the innermost of the positions that the data cannot tell from the best one first.

    A mask on a regular lattice (NIRISS) repeats itself on the sky: far positions predict
    the same data as near ones but for the width of the band. Two modes are aliases where
    their predictions differ by less than 3σ over all data, and by less than half of the
    signal itself, and neither fits notably better, though they are more than λ/B_max apart.

    Parameters
    ----------
    likelihood : Likelihood
    modes : sequence of Mode
    single : (n_nuisance,) float array
        The fit without a companion.
    fringe_mas : float
        λ/B_max.

    Returns
    -------
    modes : tuple of Mode
    aliases : tuple of Mode
        Those that fit as well as the first one.
    """
    thetas = np.array([m.theta for m in modes])
    data = likelihood.noise.whiten(likelihood.predict(thetas))
    none = single_likelihood(likelihood).predict(np.atleast_2d(single))
    signal = data - likelihood.noise.whiten(none)
    apart = ((signal - signal[:, :1]) ** 2).sum(axis=0)
    alike = apart < np.minimum(9.0, 0.25 * (signal[:, 0] ** 2).sum())
    alike &= np.array([m.delta_chi2 for m in modes]) > modes[0].delta_chi2 - AS_GOOD
    places = thetas[:, likelihood.parameters.place()]
    distance = np.hypot(*(places - places[0]).T)
    alike &= distance > fringe_mas
    alike[0] = True
    group = [m for m, same in zip(modes, alike, strict=True) if same]
    first = min(group, key=lambda m: m.companion.separation_mas)
    rest = [m for m in modes if m is not first]
    return (first, *rest), tuple(m for m in group if m is not first)
