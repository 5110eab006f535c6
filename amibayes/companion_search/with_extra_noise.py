"""The search with extra noise that is fitted beside the companion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy import optimize

from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.companion_search.second_companion import TwoCompanions
from amibayes.data.covariance import (
    Covariance,
)
from amibayes.data.observables import Observables
from amibayes.likelihood.averaged_noise import averaged_noise
from amibayes.likelihood.chi2 import chi2_survival
from amibayes.likelihood.extra_noise import (
    MAX_ROUNDS,
    SETTLED,
    UNLIKELY,
    ExtraNoise,
    FileNoise,
    _with_noise,
    add_noise,
    mean_of_files,
)
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.residuals import files_of
from amibayes.likelihood.student_noise import averaged_student_noise
from amibayes.units import FloatArray


def fit_noise(likelihood: Likelihood, theta: FloatArray, *, per_file: bool = False) -> ExtraNoise:
    """Find the extra noise that makes the residuals of a fit most likely.

    Each kind of observable is judged by itself: it gets extra noise only where its χ² has a
    probability below `UNLIKELY`. The likelihood is the restricted one: the parameters of
    the fit take their share of the degrees of freedom.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    theta : (n_dim,) float array
        The fit.
    per_file : bool
        Judge the files apart.
    """
    data, difference = likelihood.observables, likelihood.difference(theta)[:, 0]
    vis2 = np.arange(data.covariance.size) < data.n_vis2
    share = 1.0 - len(theta) / likelihood.n_independent
    parts = files_of(data)
    if not per_file or len(parts) < 2:
        return ExtraNoise(
            _one_kind(data, difference, vis2, share, "vis2"),
            _one_kind(data, difference, ~vis2, share, "closure_phase_rad"),
        )
    files = tuple(
        FileNoise(
            part.source,
            _one_kind(data, difference, part.of_kind("vis2"), share, "vis2"),
            _one_kind(data, difference, part.of_kind("cp"), share, "closure_phase_rad"),
        )
        for part in parts
    )
    return mean_of_files(data, files)


def _one_kind(
    data: Observables, difference: FloatArray, which: NDArray[np.bool_], share: float, name: str
) -> float:
    """Extra noise of one kind of observable from its residuals."""
    if not which.any():
        return 0.0
    n = data.n_vis2
    part = data.select(which[:n], which[n:])
    residual = difference[which]
    chi2, dof = _chi2(part.covariance, residual), share * part.covariance.rank
    if chi2_survival(chi2, dof, data.degrees_of_freedom) > UNLIKELY:
        return 0.0
    typical = float(np.sqrt(np.median(part.covariance.variance)))
    largest = typical * np.sqrt(chi2 / dof)

    def loss(log_sigma: float) -> float:
        sigma = float(np.exp(log_sigma))
        extra = ExtraNoise(vis2=sigma) if name == "vis2" else ExtraNoise(closure_phase_rad=sigma)
        noisy = _with_noise(part, extra).covariance
        return _chi2(noisy, residual) + share * noisy.logdet()

    bounds = float(np.log(1e-2 * typical)), float(np.log(10.0 * largest))
    best = optimize.minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    return float(np.exp(best.x))


def _chi2(covariance: Covariance, residual: FloatArray) -> float:
    return float((covariance.whiten(residual) ** 2).sum())


def search_with_noise(
    likelihood: Likelihood,
    separation_mas: tuple[float, float] | None = None,
    *,
    per_file: bool = False,
) -> tuple[SearchResult, ExtraNoise]:
    """Search, and search again with the extra noise that the residuals ask for.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    separation_mas : (inner, outer), optional
    per_file : bool
        Judge the noise of every file by itself.

    Returns
    -------
    result : SearchResult
        Of the data with the extra noise.
    noise : ExtraNoise
        None (zeros) where the stated errors explain the residuals.
    """
    result, noise = search(likelihood, separation_mas), ExtraNoise()
    tried = [(_score(result), result, noise)]
    settled = False
    while not settled and len(tried) <= MAX_ROUNDS:
        before, noise = noise, fit_noise(likelihood, result.theta, per_file=per_file)
        settled = _same(before, noise)
        if not settled:
            noisy = Likelihood(add_noise(likelihood.observables, noise), likelihood.model)
            result = search(noisy, separation_mas)
            tried.append((_score(result), result, noise))
    if settled:
        return tried[-1][1], tried[-1][2]
    # Noise and position chase each other: the most likely pair of those tried stands.
    _, result, noise = min(tried, key=lambda t: t[0])
    return replace(result, warnings=(*result.warnings, UNSETTLED)), noise


UNSETTLED = (
    "companion and extra noise do not settle: the data fit neither, and the most likely of the "
    "pairs tried is given"
)


def _score(result: SearchResult) -> float:
    """−2 ln L of a best fit."""
    return float(-2.0 * result.likelihood.log_prob(result.theta)[0])


def _same(a: ExtraNoise, b: ExtraNoise) -> bool:
    pairs = [(a.vis2, b.vis2), (a.closure_phase_rad, b.closure_phase_rad)]
    if a.files and b.files:
        for x, y in zip(a.files, b.files, strict=True):
            pairs += [(x.vis2, y.vis2), (x.closure_phase_rad, y.closure_phase_rad)]
    return all(abs(x - y) <= SETTLED * max(x, y) for x, y in pairs)


def noise_averaged(
    result: SearchResult,
    two: TwoCompanions | None,
    stated: Observables,
    *,
    extra_noise: bool = True,
    per_file: bool = False,
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
    """
    if not extra_noise and result.robustness is None:
        return result, two
    profile = result.likelihood
    fits = [(profile, result.theta), (single_likelihood(profile), result.single_theta)]
    fits += [(two.likelihood, two.theta)] if two else []
    if result.robustness is not None:
        noise = averaged_student_noise(
            profile.noise,
            result.robustness.stated,
            fits,
            free_scale=extra_noise,
            per_file=per_file,
        )
    else:
        noise = averaged_noise(profile.noise, stated, fits, per_file=per_file)
    averaged = profile.with_noise(noise)
    if two is not None:
        two = replace(two, likelihood=averaged.with_model(two.likelihood.model))
    return replace(result, likelihood=averaged), two
