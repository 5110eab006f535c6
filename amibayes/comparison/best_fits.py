"""The best fits of all models of the sky, and the noise that the best of them leaves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.comparison.fit_models import ModelFit, fit_model
from amibayes.comparison.hypotheses import MORE_GENERAL, Hypothesis, prior_of
from amibayes.comparison.unit_cube import CubeModel
from amibayes.data.observables import Observables
from amibayes.likelihood.averaged_noise import averaged_noise
from amibayes.likelihood.extra_noise import ExtraNoise, NoisePrior
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.likelihood.noise_fit import noise_beside
from amibayes.posterior.priors import Prior, PriorSetting
from amibayes.units import FloatArray


@dataclass(frozen=True)
class NoiseSetting:
    """How the noise of a search was made: what the comparison makes its own from.

    Parameters
    ----------
    found : ExtraNoise
        Of the search.
    prior : NoisePrior, optional
        None: the noise of the search stands as it is.
    per_file : bool
    """

    found: ExtraNoise = field(default_factory=ExtraNoise)
    prior: NoisePrior | None = None
    per_file: bool = False


def best_fits(
    asked: Sequence[Hypothesis],
    result: SearchResult,
    prior: Prior,
    stated: Observables | None,
    setting: NoiseSetting,
    settings: Sequence[PriorSetting],
    default_field: tuple[float, float] | None,
    streams: Sequence[np.random.Generator],
) -> tuple[list[ModelFit], ExtraNoise]:
    """Best fits with the noise, and in the field, that the best of the models leaves.

    The search's noise may be what one companion leaves of two: models are fitted with the stated
    errors too, and again with the noise of the likeliest pair, until that does not change.
    """
    modes = {"companion": np.array([m.theta for m in result.modes])}
    fits = tried = _fits(asked, result.likelihood, prior, settings, modes, streams[0])
    if stated is not None and setting.prior is not None and setting.found.any:
        clean = Likelihood(stated, result.likelihood.model)
        tried = [*fits, *_fits(asked, clean, prior, settings, modes, streams[0])]
    likely = _best_noise(tried, result.likelihood, stated, setting)
    narrow = default_field is not None and likely.of.family != "point"
    if narrow and default_field is not None:
        # Companions were looked for far out because one inside does not explain the data; where
        # other light does, that was not called for.
        prior = replace(prior, inner_mas=default_field[0], outer_mas=default_field[1])
    again = likely.likelihood is not result.likelihood or narrow
    for _ in range(MAX_ROUNDS if again else 0):
        known = _known(tried)
        fits = tried = _fits(asked, likely.likelihood, prior, settings, known, streams[3])
        before, likely = likely, _best_noise(fits, likely.likelihood, stated, setting)
        if likely.log_prob <= before.log_prob + BETTER:
            likely = before
            break
    return _averaged(fits, stated, setting, likely.noise), likely.noise


MAX_ROUNDS, BETTER = 3, 1.0
"""How often models are fitted with the noise that the best of them leaves, and the gain in ln L of
the likeliest pair from which on that is done again."""


def _known(fits: Sequence[ModelFit]) -> dict[str, FloatArray]:
    """Parameters of the fits of each model, by its name."""
    found: dict[str, list[FloatArray]] = {}
    for fit in fits:
        found.setdefault(fit.hypothesis.name, []).append(fit.model.theta(fit.cube))
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _fits(
    asked: Sequence[Hypothesis],
    base: Likelihood,
    prior: Prior,
    settings: Sequence[PriorSetting],
    known: Mapping[str, FloatArray],
    rng: np.random.Generator,
) -> list[ModelFit]:
    """Best fits of all models, simpler ones first, in the order that was asked for."""
    star = single_likelihood(base).parameters.names
    done: dict[str, ModelFit] = {}

    def fitted(name: str) -> ModelFit:
        if name not in done:
            one = Hypothesis(name)
            likelihood = one.likelihood(base)
            model = CubeModel(one, likelihood, prior_of(likelihood, prior, star, settings))
            parts = [fitted(simpler) for simpler in _simpler(one)]
            done[name] = fit_model(model, parts, rng, known.get(name))
        return done[name]

    return [fitted(one.name) for one in asked]


def _simpler(one: Hypothesis) -> list[str]:
    """Names of the models with one source less, or with that source in less detail."""
    parts = one.parts
    if not parts:
        return []
    if parts == ("two",):
        return ["companion"]
    found = ["+".join(p for p in parts if p != left) or "star" for left in parts]
    special = {general: p for p, general in MORE_GENERAL.items()}
    for part in parts:
        if part in special:
            found.append("+".join(special.get(p, p) if p == part else p for p in parts))
    return list(dict.fromkeys(found))


@dataclass(frozen=True, eq=False)
class _Likely:
    """The likeliest pair of a model's fit and a noise.

    Parameters
    ----------
    noise : ExtraNoise
    likelihood : Likelihood
        With that noise: the one that was given where it has it.
    of : Hypothesis
    log_prob : float
    """

    noise: ExtraNoise
    likelihood: Likelihood
    of: Hypothesis
    log_prob: float = 0.0


def _best_noise(
    fits: list[ModelFit], base: Likelihood, stated: Observables | None, setting: NoiseSetting
) -> _Likely:
    """Fit the noise at the best fit of every model, and take that of the most likely pair."""
    if stated is None or setting.prior is None:
        best = min(fits, key=lambda fit: float(fit.chi2[0]))
        return _Likely(setting.found, base, best.hypothesis)
    clean = Likelihood(stated, base.model)
    tried = []
    for fit in fits:
        likelihood = clean.with_model(fit.model.likelihood.model)
        found, noisy = noise_beside(
            likelihood, fit.theta, per_file=setting.per_file, prior=setting.prior
        )
        tried.append((float(noisy.log_prob(fit.theta[None])[0]), noisy, found, fit.hypothesis))
    value, noisy, found, one = max(tried, key=lambda t: t[0])
    same = found == setting.found
    return _Likely(found, base if same else base.with_noise(noisy.noise), one, value)


def _averaged(
    fits: list[ModelFit], stated: Observables | None, setting: NoiseSetting, found: ExtraNoise
) -> list[ModelFit]:
    """Average the likelihood over the amount of noise, the same way for all models."""
    if stated is None or setting.prior is None or setting.prior.vis2 <= 0.0:
        return fits
    # Gains and coherent errors go with the fringes of a fit, as in the noise that was fitted.
    best = min(fits, key=lambda fit: float(fit.chi2[0]))
    clean = Likelihood(stated, best.model.likelihood.model)
    noise = averaged_noise(
        fits[0].model.likelihood.noise,
        clean.expecting(best.theta).observables,
        [(fit.model.likelihood, fit.theta) for fit in fits],
        per_file=setting.per_file,
        noise=found,
        prior=setting.prior,
    )
    return [
        replace(
            fit,
            model=(model := replace(fit.model, likelihood=fit.model.likelihood.with_noise(noise))),
            banks=tuple(replace(bank, model=model) for bank in fit.banks),
        )
        for fit in fits
    ]
