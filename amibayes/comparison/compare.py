"""The comparison of models of the sky: fits, noise, evidences, confusion, verdict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from amibayes.companion_search.field import resolution_mas
from amibayes.companion_search.result import SearchResult
from amibayes.comparison.best_fits import NoiseSetting, best_fits
from amibayes.comparison.confusion import HOPELESS, measure_confusion
from amibayes.comparison.fit_models import ModelFit
from amibayes.comparison.hypotheses import (
    hypotheses,
)
from amibayes.comparison.integral import Effort, integrate
from amibayes.comparison.verdict import Confusion, ModelVerdict, choose
from amibayes.data.observables import Observables
from amibayes.detection.verdict import joint_probability, parts_of_fit
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.parallel import Executor, Journal, Progress
from amibayes.posterior.priors import Prior, PriorSetting
from amibayes.posterior.sampler import Draws, draw_posterior
from amibayes.support.options import CONFUSION_DRAWS, DEFAULT_SKY_MODELS, SAMPLERS
from amibayes.units import FloatArray

DRAWS_VALUES, MIN_DRAWS = 4_000_000, 1024
"""Model values of the draws of an evidence, and their least number."""

HURRIED = Effort(prior=2048, modes=1024, repeats=0, centres=5, rounds=3)
"""Effort for a model whose odds are below 1e-6 whatever its evidence is."""

CONFUSION_VALUES, MIN_CONFUSION = 60_000, 20
"""Points × data sets of a confusion matrix, and the least number of data sets: with 20 a share
below 5 % can just be told."""


@dataclass(frozen=True, eq=False)
class Compared:
    """A model of the sky with its evidence and posterior.

    Parameters
    ----------
    fit : ModelFit
    draws : Draws
        Of the posterior, with weights.
    log_z, log_z_error : float
    method : str
    ndof : int
    p_fit : float
        Probability that data of the best fit are fitted no better, as in the verdict of a search
        (`amibayes.detection.verdict.joint_probability`).
    """

    fit: ModelFit
    draws: Draws
    log_z: float
    log_z_error: float
    method: str
    ndof: int
    p_fit: float

    @property
    def name(self) -> str:
        """Of the model."""
        return self.fit.hypothesis.name

    @property
    def chi2(self) -> float:
        """Of the best fit."""
        return float(self.fit.chi2[0])

    @property
    def names(self) -> tuple[str, ...]:
        """Of the parameters."""
        return self.fit.model.likelihood.parameters.names

    @property
    def theta(self) -> FloatArray:
        """Parameters of the best fit."""
        return self.fit.theta


@dataclass(frozen=True, eq=False)
class ModelComparison:
    """Models of the sky compared on one data set with one noise.

    Parameters
    ----------
    models : tuple of Compared
        In the order they were asked for.
    log_prior : (n_models,) float array
        Logarithm of their prior probabilities, all alike.
    noise : ExtraNoise
        Beyond the stated errors, as the best of all models leaves it.
    confusion : Confusion or None
    verdict : ModelVerdict
    """

    models: tuple[Compared, ...]
    log_prior: FloatArray
    noise: ExtraNoise
    confusion: Confusion | None
    verdict: ModelVerdict

    @property
    def probability(self) -> FloatArray:
        """Posterior probability of each model, (n_models,)."""
        log = np.array([m.log_z for m in self.models]) + self.log_prior
        return np.asarray(np.exp(log - logsumexp(log)))

    @property
    def best(self) -> Compared:
        """The most probable model."""
        return self.models[int(np.argmax(self.probability))]

    def __repr__(self) -> str:
        each = zip(self.models, self.probability, strict=True)
        listed = ", ".join(f"{m.name} {p:.3g}" for m, p in each)
        return f"<ModelComparison: {self.verdict.statement}; {listed}>"


def compare_sky_models(
    result: SearchResult,
    prior: Prior,
    rng: np.random.Generator,
    *,
    models: Sequence[str] = DEFAULT_SKY_MODELS,
    stated: Observables | None = None,
    noise: NoiseSetting | None = None,
    settings: Sequence[PriorSetting] = (),
    method: str = "direct",
    default_field: tuple[float, float] | None = None,
    confusion_draws: int | None = None,
    executor: Executor | None = None,
    journal: Journal | None = None,
    progress: Progress | None = None,
) -> ModelComparison:
    """Compare models of the sky by evidence, and measure how often they are confused.

    Parameters
    ----------
    result : SearchResult
        Of a companion: every model begins with its star, noise and solutions.
    prior : Prior
        Of companions and star.
    models : sequence of str
        Of `amibayes.support.options.SKY_MODELS`, or several joined by ``+``.
    stated : Observables, optional
        The data with the stated errors, to which noise is fitted at the best of all models.
    settings : sequence of PriorSetting
        Ranges of parameters of extended light.
    method : {"direct", "nested"}
        Importance sampling, or one of `amibayes.support.options.SAMPLERS`.
    default_field : (inner, outer), optional
        Separations of companions where the search went farther, unless one farther out fits best.
    confusion_draws : int, optional
        Data sets simulated of each model, 0 for none; by default fewer where data are many.
    executor, journal, progress : optional
        Of the confusion matrix; see `amibayes.comparison.confusion.measure_confusion`.

    """
    asked, streams = hypotheses(models), rng.spawn(4)
    setting = noise or NoiseSetting()
    fits, found = best_fits(asked, result, prior, stated, setting, settings, default_field, streams)
    compared = _all_compared(fits, found, streams[1], method)
    log_prior = np.full(len(fits), -np.log(len(fits)))
    wanted = _n_confusion(result.likelihood) if confusion_draws is None else confusion_draws
    confusion = None
    if wanted and len(fits) > 1:
        confusion = measure_confusion(
            fits, wanted, streams[2],
            log_prior=log_prior, executor=executor, journal=journal, progress=progress,
        )  # fmt: skip
    log_z = np.array([c.log_z for c in compared])
    small = is_degenerate(compared[int(np.argmax(log_z))])
    statement = choose(asked, log_z, log_prior, confusion, degenerate=small)
    return ModelComparison(compared, log_prior, found, confusion, statement)


def _n_confusion(likelihood: Likelihood) -> int:
    wanted = CONFUSION_VALUES // max(len(likelihood.samples), 1)
    return int(np.clip(wanted, MIN_CONFUSION, CONFUSION_DRAWS))


def _all_compared(
    fits: Sequence[ModelFit], noise: ExtraNoise, rng: np.random.Generator, method: str
) -> tuple[Compared, ...]:
    """Evidences of all models, with fewer draws for those that are out of the question."""
    children = rng.spawn(len(fits))
    bound = np.array([largest_log_prob(fit) for fit in fits])
    found: dict[int, Compared] = {}
    for k in np.argsort(-bound, kind="stable").tolist():
        best = max((c.log_z for c in found.values()), default=-np.inf)
        hopeless = bool(bound[k] < best - HOPELESS)
        found[k] = _compared(fits[k], noise, children[k], method, hopeless=hopeless)
    return tuple(found[k] for k in range(len(fits)))


def largest_log_prob(fit: ModelFit) -> float:
    """ln L of the best fit, which the evidence is below."""
    data = fit.model.likelihood.observables.data
    return float(fit.model.log_prob(fit.cube, data).max())


def _compared(
    fit: ModelFit,
    noise: ExtraNoise,
    rng: np.random.Generator,
    method: str,
    *,
    hopeless: bool = False,
) -> Compared:
    likelihood, model = fit.model.likelihood, fit.model
    if method in SAMPLERS and model.n_dim and not hopeless:
        draws, how = draw_posterior(likelihood, model.prior, rng, method), method
        draws = replace(draws, samples=model.brighter_first(draws.samples))
    else:
        n = int(np.clip(DRAWS_VALUES // len(likelihood.samples), MIN_DRAWS, Effort().modes))
        effort = HURRIED if hopeless else Effort(prior=2 * n, modes=n)
        draws = integrate(
            model, likelihood.observables.data, fit.cube, fit.chi2, rng, effort=effort
        )
        how = "importance"
    ndof = likelihood.n_independent - model.n_dim
    theta = model.theta(fit.cube[:1])[0]
    p_fit = joint_probability(parts_of_fit(likelihood, theta, ndof, noise))
    z, error = draws.diagnostics["log_z"], draws.diagnostics["log_z_error"]
    return Compared(fit, draws, float(z), float(error), how, ndof, p_fit)


def is_degenerate(model: Compared) -> bool:
    """Whether what a model puts around the star is smaller than λ/2B_max."""
    likelihood = model.fit.model.likelihood
    limit = 0.5 * resolution_mas(likelihood)
    sizes = [
        float(np.hypot(*model.theta[likelihood.parameters.place(k + 1)]))
        for k in range(likelihood.parameters.companions)
    ]
    sizes += [
        float(model.theta[k])
        for k, p in enumerate(likelihood.parameters)
        if p.unit == "mas" and p.role == "nuisance" and p.name != "diameter_mas"
    ]
    return bool(sizes) and max(sizes) < limit
