"""Whether the target says the same with and without each calibrator.

The target calibrated with one calibrator, and with the others, are no parts of the data: they
have the target's noise in common, which is in neither side of the comparison. What the two differ
by is what the calibrators differ by, and draws of these are its test.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from amibayes.calibration.leave_one_out import Comparison, LeftOut, leave_out
from amibayes.calibration.matching import Keys, keys_of
from amibayes.calibration.transfer import Diameter
from amibayes.companion_search.result import SearchResult
from amibayes.data.observables import Observables
from amibayes.detection.null_draws import pieces_of
from amibayes.detection.splits import ENOUGH, SIMULATIONS, Consistency, gain_of
from amibayes.likelihood.likelihood import Likelihood
from amibayes.units import FloatArray

OTHERS = "the other calibrators"


def compare_calibrators(
    result: SearchResult,
    calibrators: Sequence[tuple[Observables, Diameter]],
    rng: np.random.Generator,
    simulations: int = SIMULATIONS,
) -> tuple[Consistency, ...]:
    """Compare the target calibrated with each calibrator, and with the others; the worst first.

    Either way the noise of the target is the same: what the two differ by, to first order, is
    what the calibrators differ by. The test is the gain in χ² of that difference by a companion of
    its own, with the calibrators' errors and the scatter between the others; as that scatter is a
    fitted one, the gain counts relative to the χ² of the others about their mean. Two calibrators
    are one comparison, relative to the rest of what they differ by. The weights are not those of
    the fit, whose errors hold how far the calibrators lie apart.

    Parameters
    ----------
    result : SearchResult
        Of the calibrated target.
    calibrators : sequence of (Observables, (diameter, error))
        Those that the target was calibrated with, and their uniform discs in mas.
    rng : numpy.random.Generator
    simulations : int
        Draws of the calibrators.
    """
    keys, found = keys_of(result.likelihood.observables), []
    star = result.likelihood.parameters.nuisance
    names = _names([c.source for c, _ in calibrators])
    for k, name in enumerate(names[:1] if len(names) == 2 else names):
        apart = leave_out(k, calibrators, keys)
        if apart is None:
            continue
        templates = _templates(result.likelihood, result.theta, keys, apart)
        comparison = apart.against(templates, star)
        gain = _difference(comparison, apart.measured)
        ratio = gain / _scale(apart, comparison, apart.measured, gain)
        above = made = 0
        for n in pieces_of(simulations, apart.n_independent * (1 + apart.n_others)):
            drawn = apart.draw(n, rng)
            by_noise = _difference(comparison, drawn)
            above += int((by_noise >= ratio * _scale(apart, comparison, drawn, by_noise)).sum())
            made += n
            if above >= ENOUGH:
                break
        parts = name, (names[1] if len(names) == 2 else OTHERS)
        found.append(Consistency("calibrators", parts, float(gain[0]), (1 + above) / (1 + made)))
    return tuple(sorted(found, key=lambda one: (one.p, -one.delta_chi2)))


def _names(sources: Sequence[str]) -> list[str]:
    """File names, or numbers where these do not tell them apart."""
    names = [Path(source).name for source in sources]
    return [n if names.count(n) == 1 else f"calibrator {k + 1}" for k, n in enumerate(names)]


def _templates(likelihood: Likelihood, theta: FloatArray, keys: Keys, apart: LeftOut) -> FloatArray:
    """Change of the response with the effect of a unit change of each parameter, (p, n_keys).

    V² is divided by the response, closure phases have it taken off. Data of one key are averaged
    by their variances: the response is the same in all of them.
    """
    data = likelihood.observables
    n, slope = data.n_vis2, -keys.sign.astype(float)
    response = apart.response[keys.key[:n]]
    model = likelihood.predict(np.atleast_2d(theta))[:n, 0]
    slope[:n] = -model / np.where(response > 0.0, response, np.inf)
    weight = slope / data.covariance.variance
    whole = np.bincount(keys.key, weight * slope, len(keys))
    change = [np.bincount(keys.key, weight * j, len(keys)) for j in likelihood.slopes(theta).T]
    return np.where(apart.keys & (whole > 0.0), change / np.where(whole > 0.0, whole, 1.0), 0.0)


def _difference(comparison: Comparison, seen: Sequence[FloatArray]) -> FloatArray:
    """χ² (n,) of what the parameters differ by."""
    scale = np.sqrt(np.diag(comparison.covariance))
    scale = np.where(scale > 0.0, scale, 1.0)
    return gain_of(comparison.covariance, comparison.score(seen).T, scale)


def _scale(
    apart: LeftOut, comparison: Comparison, seen: Sequence[FloatArray], gain: FloatArray
) -> FloatArray:
    """Mean square (n,) of what scatters about the mean as the noise does."""
    if apart.n_others > 1:
        return comparison.scatter(seen) / (apart.n_independent * (apart.n_others - 1))
    left = max(apart.n_independent - len(comparison.covariance), 1)
    return np.asarray(np.maximum(comparison.whole(seen) - gain, 1e-300) / left)
