"""The search with extra noise that is fitted beside the companion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.result import SearchResult, companions_of
from amibayes.companion_search.search import BETTER, search, with_global_check
from amibayes.companion_search.second_companion import TwoCompanions
from amibayes.data.observables import Observables
from amibayes.likelihood.averaged_noise import averaged_noise, errors_beside_noise
from amibayes.likelihood.extra_noise import (
    CONVERGED,
    MAX_ROUNDS,
    ExtraNoise,
    NoisePrior,
)
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise_fit import noise_beside
from amibayes.likelihood.student import averaged_student_noise


def search_with_noise(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
    *,
    per_file: bool = False,
    prior: NoisePrior | None = None,
    first: SearchResult | None = None,
) -> tuple[SearchResult, ExtraNoise]:
    """Search, and search again with the noise that the best of the models leaves.

    The noise is fitted at the best solutions of every search, that with the stated errors
    included, and the pair of noise and solution with the largest restricted likelihood is
    taken: a fit that explains the data by noise does not stand where another explains them by
    light.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    separation_mas : (inner, outer), optional
    per_file : bool
        Fit the noise of every file by itself.
    prior : NoisePrior, optional
    first : SearchResult, optional
        The search with the stated errors, if it is known.

    Returns
    -------
    result : SearchResult
        Of the data with the extra noise.
    noise : ExtraNoise
        None (zeros) where the stated errors explain the residuals.
    """
    result, noise = first or search(likelihood, separation_mas), ExtraNoise()
    tried = [(_score(result), result, noise)]
    while len(tried) <= MAX_ROUNDS:
        fitted, noisy = _best_noise(likelihood, result, per_file=per_file, prior=prior)
        if _same(noise, fitted):
            # The whole field once, with the noise that stands: what is better has its own noise.
            checked = with_global_check(result)
            if checked.modes[0].delta_chi2 <= result.modes[0].delta_chi2 + BETTER:
                return checked, noise
            result = checked
        else:
            noise, known = fitted, np.array([mode.theta for mode in result.modes])
            result = search(noisy, separation_mas, known=known, check=False)
        tried.append((_score(result), result, noise))
    # Noise and position chase each other: the most likely pair of those tried stands, each with
    # the calibration errors that are there for certain.
    floors = noise.floors
    _, result, noise = min((t for t in tried if t[2].floors == floors), key=lambda t: t[0])
    result = with_global_check(result)
    return replace(result, warnings=(*result.warnings, NOT_CONVERGED)), noise


def _best_noise(
    stated: Likelihood, result: SearchResult, *, per_file: bool, prior: NoisePrior | None
) -> tuple[ExtraNoise, Likelihood]:
    """The noise of that solution of a search which, each with its own noise, is most likely."""
    found = []
    for mode in result.modes[:MODES_TRIED]:
        theta = np.array(mode.theta)
        found.append((*noise_beside(stated, theta, per_file=per_file, prior=prior), theta))
    noise, noisy, _ = max(found, key=lambda f: float(f[1].log_prob(f[2])[0]))
    return noise, noisy


MODES_TRIED = 3
"""Solutions of a search at which the noise is fitted: with errors that are too small, an alias
may come first by chance."""

NOT_CONVERGED = (
    "position and extra noise did not converge: with the noise beside each best position another "
    "one is best; the most likely of the pairs tried is given"
)


def _score(result: SearchResult) -> float:
    """−2 ln L of a best fit."""
    return float(-2.0 * result.likelihood.log_prob(result.theta)[0])


def _same(a: ExtraNoise, b: ExtraNoise) -> bool:
    pairs = [(a.vis2, b.vis2), (a.closure_phase_rad, b.closure_phase_rad)]
    if a.files and b.files:
        for x, y in zip(a.files, b.files, strict=True):
            pairs += [(x.vis2, y.vis2), (x.closure_phase_rad, y.closure_phase_rad)]
    near = all(abs(x - y) <= CONVERGED * max(x, y) for x, y in pairs)
    return a.floors == b.floors and near and _same_shares(a, b)


def _same_shares(a: ExtraNoise, b: ExtraNoise) -> bool:
    """Shares of channels agree where they differ by little of what they are uncertain by."""
    if len(a.channels) != len(b.channels):
        return False
    each = list(zip(a.channels, b.channels, strict=True))
    pairs = [(x.vis2, y.vis2) for x, y in each]
    pairs += [(x.closure_phase, y.closure_phase) for x, y in each]
    return all(
        abs(x.value - y.value) <= max(SHARE_CONVERGED, SHARE_OF_ERROR * np.nan_to_num(y.error))
        and abs(np.log(x.offset / y.offset)) + abs(np.log(x.slope / y.slope)) <= GROWTH_CONVERGED
        and np.abs(np.diff(np.log1p([x.smooth, y.smooth]), axis=0)).max() <= GROWTH_CONVERGED
        and abs(sum(x.lasting) - sum(y.lasting)) <= LASTING_CONVERGED
        for x, y in pairs
    )


LASTING_CONVERGED = 0.05
"""Change of the share that exposures have in common: half of what a hundred of them tell."""

GROWTH_CONVERGED = 0.1
"""Change of ln of a floor's variance likewise: of twenty gains it is known to 0.3."""

SHARE_CONVERGED, SHARE_OF_ERROR = 0.02, 0.25
"""Change of a correlation at which search and noise agree: below what a hundred exposures tell, or
a quarter of what it is uncertain by."""


def noise_averaged(
    result: SearchResult,
    two: TwoCompanions | None,
    stated: Observables,
    *,
    extra_noise: bool = True,
    per_file: bool = False,
    noise: ExtraNoise | None = None,
    prior: NoisePrior | None = None,
) -> tuple[SearchResult, TwoCompanions | None]:
    """Give search and second companion a likelihood averaged over the unknown extra noise.

    Parameters
    ----------
    result : SearchResult
    two : TwoCompanions, optional
    stated : Observables
        The data that were searched, with the stated errors.
    extra_noise : bool
        Without it the stated errors count as right; residuals of a robust search have
        Student's t distribution all the same.
    per_file : bool
        The noise of every file is unknown by itself.
    noise : ExtraNoise, optional
        That the search found.
    prior : NoisePrior, optional
    """
    if not extra_noise and result.robustness is None:
        return result, two
    profile = result.likelihood
    fits = [(profile, result.theta), (single_likelihood(profile), result.single_theta)]
    fits += [(two.likelihood, two.theta)] if two else []
    if result.robustness is not None:
        mean = averaged_student_noise(
            profile.noise,
            result.robustness.stated,
            fits,
            covariance=result.robustness.covariance,
            free_scale=extra_noise,
            per_file=per_file,
        )
    else:
        mean = averaged_noise(
            profile.noise, _expected(stated.unflagged(), profile.observables), fits,
            per_file=per_file, noise=noise, prior=prior,
        )  # fmt: skip
    averaged = profile.with_noise(mean)
    if two is not None:
        two = replace(two, likelihood=averaged.with_model(two.likelihood.model))
    return replace(result, likelihood=averaged), two


def with_errors_of(result: SearchResult, averaged: SearchResult) -> SearchResult:
    """The search with errors of its best fit averaged over the amounts of extra noise.

    Noise that no χ² shows for certain is not fitted: of 41 companions of 3 % with true errors 1.4
    (closure phases) and 1.7 (V²) times the stated ones pulls are 1.3 to 1.5 rms with the errors of
    the fitted noise, and 1.1 to 1.3 with these.

    Parameters
    ----------
    result : SearchResult
        With the most likely noise.
    averaged : SearchResult
        From `noise_averaged`.
    """
    if result.robustness is not None or not np.isfinite(result.theta_covariance).any():
        return result
    covariance = errors_beside_noise(averaged.likelihood, result.theta)
    if covariance is None:
        return result
    first = companions_of(result.likelihood.parameters, result.theta, covariance)[0]
    return replace(result, theta_covariance=covariance, companion=first)


def _expected(stated: Observables, fitted: Observables) -> Observables:
    """Data with what the fit of the noise expected of them, on which floors of errors rest."""
    v, c = fitted.vis2, fitted.closure_phase
    vis2 = replace(stated.vis2, expected=v.expected, coherent_slope=v.coherent_slope)
    closure = replace(stated.closure_phase, coherent_slope=c.coherent_slope)
    return replace(stated, vis2=vis2, closure_phase=closure)
