"""Positions of a companion that fit: which of them differ, and which are aliases."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from amibayes.companion_search.result import Mode
from amibayes.companion_search.seeds import MODE_LIMIT
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.units import FloatArray

AS_GOOD = 1.0
"""Δχ² within which one of two positions does not fit better: one standard deviation."""


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
