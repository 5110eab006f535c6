"""The evidence for 0, 1 and 2 companions under stated priors, by independent methods.

- quadrature: no companion; only nuisance parameters are integrated.
- grid: one companion, by `grid_posterior`.
- importance: draws from t distributions with the posterior's own mean and covariance at every
  mode, of companions as the prior has them beside the star as the data have it, from these beside
  the prior, and from the prior itself, weighted; unbiased, with its own error.
- laplace: a Gaussian at every mode; right for strong companions only.
- nested: nested sampling with dynesty.

Companions are alike: each has the same prior, and a solution counts in both orders.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from amibayes.companion_search.result import Mode, SearchResult
from amibayes.companion_search.second_companion import TwoCompanions
from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.posterior.grid import GridPosterior
from amibayes.posterior.independence import Mixture, mode_mixture
from amibayes.posterior.laplace import log_evidence_laplace, physical, sampled
from amibayes.posterior.nuisance import log_evidence_none
from amibayes.posterior.priors import Prior, Range
from amibayes.posterior.sampler import draw_posterior, log_mean
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import html_table
from amibayes.support.options import SAMPLERS
from amibayes.units import FloatArray

MODEL_VALUES = 4e6
"""Model values (samples × parameter sets) of an importance sum."""

MIN_DRAWS, MAX_DRAWS = 4000, 200_000

DEFENSIVE = 0.2
"""Share of the draws that comes from the prior."""

GRID_ERROR = 0.005
"""Largest error of ln Z by grid and quadrature."""

HALO_BACKGROUND = 1.0
"""Largest over-resolved flux of the alternative, in units of the primary's; uniform from 0."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidences of models and what they make of prior odds.

    Parameters
    ----------
    companions : tuple of int
    log_z, log_z_error : tuple of float
        Logarithm of each evidence and its error (NaN where the method has none).
    method : tuple of str
    prior : Prior
        Of every companion and of the nuisance parameters.
    model_prior : tuple of float
        Prior probability of each number of companions.
    halo_log_z : float
        Of over-resolved light instead of a companion; NaN where the light is in every model.
    two : TwoCompanions or None
        The joint fit, where two were asked for.
    nuisance_names : tuple of str
    """

    companions: tuple[int, ...]
    log_z: tuple[float, ...]
    log_z_error: tuple[float, ...]
    method: tuple[str, ...]
    prior: Prior
    model_prior: tuple[float, ...]
    halo_log_z: float = float("nan")
    two: TwoCompanions | None = None
    nuisance_names: tuple[str, ...] = ()

    @property
    def probability(self) -> FloatArray:
        """Posterior probability of each number of companions, (n,)."""
        log = np.array(self.log_z) + np.log(self.model_prior)
        return np.asarray(np.exp(log - logsumexp(log)))

    def log_odds(self, more: int, fewer: int) -> float:
        """Logarithm of the posterior odds of two numbers of companions."""
        a, b = self.companions.index(more), self.companions.index(fewer)
        prior = np.log(self.model_prior[a]) - np.log(self.model_prior[b])
        return float(self.log_z[a] - self.log_z[b] + prior)

    def __repr__(self) -> str:
        each = zip(self.companions, self.log_z, strict=True)
        return f"<Evidence: {', '.join(f'{k} companions ln Z {z:.2f}' for k, z in each)}>"

    def _repr_html_(self) -> str:
        """Show the evidences in a notebook."""
        each = zip(
            self.companions,
            self.log_z,
            self.log_z_error,
            self.probability,
            self.method,
            strict=True,
        )
        rows = [(k, f"{z:.2f}", f"{e:.2g}", f"{p:.3g}", how) for k, z, e, p, how in each]
        header = ("companions", "ln Z", "1σ", "probability", "method")
        return html_table("Evidence", header, rows)


@checks_arguments
def compare_models(
    result: SearchResult,
    prior: Prior,
    rng: np.random.Generator,
    *,
    companions: Sequence[int] = (0, 1),
    grid: GridPosterior | None = None,
    two: TwoCompanions | None = None,
    method: str = "direct",
    model_prior: Sequence[float] | None = None,
) -> Evidence:
    """Compare numbers of companions with each other and with over-resolved light.

    Parameters
    ----------
    result : SearchResult
    prior : Prior
    rng : numpy.random.Generator
    companions : sequence of int
        Out of 0, 1, 2.
    grid : GridPosterior, optional
        Of the same likelihood and prior; without it one companion is integrated by importance.
    two : TwoCompanions
        Needed for 2.
    method : {"direct", "laplace", "nested"}
        Direct: quadrature, grid (or importance) and importance, for 0, 1 and 2. Otherwise
        Laplace's approximation, or one of `amibayes.support.options.SAMPLERS`.
    model_prior : sequence of float, optional
        Prior probabilities of the numbers of companions; equal by default.

    Raises
    ------
    UsageError
        Where dynesty is asked for and not installed, or the request makes no sense.
    """
    if not set(companions) <= {0, 1, 2} or (2 in companions and two is None):
        raise UsageError("numbers of companions are 0, 1 and 2 (two with their joint fit)")
    weights = np.array(model_prior if model_prior is not None else [1.0] * len(companions))
    if weights.shape != (len(companions),) or not (weights > 0).all():
        raise UsageError("every number of companions needs a positive prior probability")
    found = [
        _weigh(result, prior, child, k, grid, two, method)
        for k, child in zip(companions, rng.spawn(len(companions)), strict=True)
    ]
    log_z, error, how = zip(*found, strict=True)
    halo = log_evidence_halo(result.likelihood, prior)
    shares = tuple(float(w) for w in weights / weights.sum())
    names = single_likelihood(result.likelihood).parameters.names
    return Evidence(tuple(companions), log_z, error, how, prior, shares, halo, two, names)


def _weigh(
    result: SearchResult,
    prior: Prior,
    rng: np.random.Generator,
    companions: int,
    grid: GridPosterior | None,
    two: TwoCompanions | None,
    method: str,
) -> tuple[float, float, str]:
    """(ln Z, error, method) of one model."""
    none = single_likelihood(result.likelihood)
    likelihood = (
        none
        if companions == 0
        else two.likelihood
        if two and companions == 2
        else (result.likelihood)
    )
    if companions == 0 and (method not in SAMPLERS or not len(none.parameters)):
        return log_evidence_none(result.likelihood, prior), GRID_ERROR, "quadrature"
    modes = two.modes if two and companions == 2 else result.modes
    if method == "laplace":
        return log_evidence_laplace(likelihood, modes, prior), float("nan"), "laplace"
    if method in SAMPLERS:
        found = draw_posterior(likelihood, prior, rng, method).diagnostics
        return found["log_z"], found["log_z_error"], method
    if companions == 1 and grid is not None:
        return grid.log_z, GRID_ERROR, "grid"
    return (*log_evidence_importance(likelihood, modes, result.modes, prior, rng), "importance")


def log_evidence_halo(likelihood: Likelihood, prior: Prior) -> float:
    """ln Z of over-resolved light without a companion; NaN where it is in the model already."""
    if likelihood.model.background == "free":
        return float("nan")
    halo = likelihood.with_model(replace(likelihood.model, background="free"))
    names = [single_likelihood(one).parameters.names for one in (likelihood, halo)]
    found = dict(zip(names[0], prior.ranges, strict=True))
    found["background"] = Range(0.0, HALO_BACKGROUND)
    ranges = [found[n] for n in names[1]]
    limits, scales = tuple((r.low, r.high) for r in ranges), tuple(r.scale for r in ranges)
    return log_evidence_none(halo, replace(prior, nuisance=limits, half_cauchy=scales))


def log_evidence_importance(
    likelihood: Likelihood,
    modes: Sequence[Mode],
    one: Sequence[Mode],
    prior: Prior,
    rng: np.random.Generator,
) -> tuple[float, float]:
    """ln Z and its error from weighted draws.

    Parameters
    ----------
    likelihood : Likelihood
        With one companion or two.
    modes : sequence of Mode
        Of that model.
    one : sequence of Mode
        Of the model with one companion.
    prior : Prior
    rng : numpy.random.Generator
    """
    k = likelihood.model.companions
    own = mode_mixture(likelihood, modes, prior, rng)
    sources: list[Mixture | _Pairs] = [own]
    if k == 2:
        alone = likelihood.with_model(replace(likelihood.model, companions=1))
        sources = [_Pairs(own, prior, 0), _Pairs(mode_mixture(alone, one, prior, rng), prior, 1)]
    share = (1.0 - DEFENSIVE) / len(sources)
    wanted = MODEL_VALUES / len(likelihood.samples) / (1.0 - DEFENSIVE)
    n = int(np.clip(wanted, MIN_DRAWS, MAX_DRAWS))
    counts = [int(share * n)] * len(sources)
    drawn = [s.draw(rng, m) for s, m in zip(sources, counts, strict=True)]
    drawn.append(sampled(prior.draw(rng, n - sum(counts), k), likelihood.parameters))
    x = np.concatenate(drawn)
    log_prior = prior.log_density(x)
    x, log_prior = x[np.isfinite(log_prior)], log_prior[np.isfinite(log_prior)]
    log_f = log_prior + likelihood.log_prob(physical(x, likelihood.parameters))
    terms = [log_prior + np.log(DEFENSIVE)]
    terms += [s.log_density(x) + np.log(share) for s in sources]
    log_w = log_f - logsumexp(terms, axis=0)
    log_z, error = log_mean(log_w, n)
    return float(log_z), float(error)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Two companions out of a mixture of both, or of one and the prior of the other.

    The density is that of both orders, each with half the weight.

    Parameters
    ----------
    mixture : Mixture
        Of two companions, or of one.
    prior : Prior
    n_free : int
        Companions drawn from the prior.
    """

    mixture: Mixture
    prior: Prior
    n_free: int

    def draw(self, rng: np.random.Generator, n: int) -> FloatArray:
        x = self.mixture.draw(rng, n)
        if not self.n_free:
            return x
        one, both = self.prior.parameters(1), self.prior.parameters(2)
        out = np.empty((n, len(both)))
        free = sampled(self.prior.draw(rng, n), one)
        out[:, both.companion(1)] = x[:, one.companion()]
        out[:, both.companion(2)] = free[:, one.companion()]
        out[:, both.nuisance] = x[:, one.nuisance]
        return out

    def log_density(self, x: FloatArray) -> FloatArray:
        swapped = x[:, self.prior.parameters(2).swapped]
        return np.asarray(np.logaddexp(self._ordered(x), self._ordered(swapped)) - np.log(2.0))

    def _ordered(self, x: FloatArray) -> FloatArray:
        if not self.n_free:
            return self.mixture.log_density(x)
        bare = replace(self.prior, nuisance=(), half_cauchy=())
        free = self.prior.parameters(2).companion(2)
        rest = self.mixture.log_density(np.delete(x, free, axis=1))
        return np.asarray(bare.log_density(x[:, free]) + rest)
