"""The posterior by emcee: started on the modes, stopped on the autocorrelation time.

Sampled in (east, north, ln contrast, nuisance…), whose prior is flat. The chain is written
whole after every segment, with the state of the random generator, so that a killed run
goes on from there and ends with the same samples.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import emcee
import h5py
import numpy as np

from amibayes.errors import DataError
from amibayes.files import atomic_path
from amibayes.inference.likelihood import Likelihood
from amibayes.inference.priors import Prior
from amibayes.inference.results import Mode, SearchResult
from amibayes.units import FloatArray, contrast_to_delta_mag, position_angle_deg, separation

N_WALKERS = 32
SEGMENT = 500
MAX_STEPS = 30_000

ENOUGH = 50.0
"""Autocorrelation times a chain must be long (Foreman-Mackey et al. 2013)."""

GOOD_RHAT = 1.02

GROUP = "mcmc"
"""Name of the HDF5 group, as emcee's own backend has it."""

Progress = Callable[[int, int], None]


@dataclass(frozen=True, eq=False)
class Posterior:
    """Samples of the posterior and how far they can be trusted.

    Parameters
    ----------
    names : tuple of str
        Names of the columns.
    samples : (n, n_dim) float array
        Thinned, burn-in removed; contrast as a flux ratio.
    log_prob : (n,) float array
    autocorrelation_time : float
        Longest of the parameters', in steps.
    n_steps, n_burn : int
        Steps of each walker, and those thrown away.
    split_rhat : float
        Largest split-R̂ (Gelman et al. 2013) of the parameters over the walkers.
    acceptance : float
        Mean fraction of accepted proposals.
    converged : bool
        Longer than 50 autocorrelation times and split-R̂ below 1.02.
    """

    names: tuple[str, ...]
    samples: FloatArray
    log_prob: FloatArray
    autocorrelation_time: float
    n_steps: int
    n_burn: int
    n_walkers: int
    split_rhat: float
    acceptance: float
    converged: bool
    prior: Prior

    @property
    def n_effective(self) -> int:
        """Number of independent samples, n_walkers · n_steps / autocorrelation time."""
        return int(self.n_walkers * (self.n_steps - self.n_burn) / self.autocorrelation_time)

    def column(self, name: str) -> FloatArray:
        """Samples of a parameter, or of separation_mas, position_angle_deg or delta_mag."""
        east, north, contrast = self.samples[:, :3].T
        if name == "separation_mas":
            return separation(east, north)
        if name == "position_angle_deg":
            return position_angle_deg(east, north)
        if name == "delta_mag":
            return contrast_to_delta_mag(contrast)
        return self.samples[:, self.names.index(name)]

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """(median, lower, upper) of a quantity.

        Position angles are cut opposite their mean; the median lies in [0, 360) and the
        limits on both sides of it.
        """
        values, cut = self.column(name), 0.0
        if name == "position_angle_deg":
            cut = float(np.angle(np.exp(1j * np.radians(values)).mean(), deg=True)) - 180.0
            values = (values - cut) % 360.0
        low, mid, high = np.quantile(values, [0.5 - level / 2, 0.5, 0.5 + level / 2]) + cut
        turn = 360.0 * (mid // 360.0) if name == "position_angle_deg" else 0.0
        return float(mid - turn), float(low - turn), float(high - turn)

    def __repr__(self) -> str:
        state = "converged" if self.converged else "NOT converged"
        return f"<Posterior: {len(self.samples)} samples of {', '.join(self.names)}; {state}>"


def sample(
    result: SearchResult,
    prior: Prior,
    rng: np.random.Generator,
    *,
    path: str | Path | None = None,
    resume: bool = False,
    max_steps: int = MAX_STEPS,
    progress: Progress | None = None,
) -> Posterior:
    """Sample the posterior of a search's model.

    Parameters
    ----------
    result : SearchResult
        Its modes are where the walkers start, in proportion to their Laplace weights.
    prior : Prior
    rng : numpy.random.Generator
    path : path, optional
        HDF5 file of the chain, readable by `emcee.backends.HDFBackend`.
    resume : bool
        Go on from ``path`` if it holds the chain of the same data, prior and seed.
    max_steps : int
        Steps after which a chain that has not converged is given up (and said to be so).
    progress : callable, optional
        Called with (steps done, steps expected).
    """
    likelihood = result.likelihood
    start = _start(result, prior, rng)
    seed = int(rng.integers(2**32))
    digest = _digest(likelihood, prior, start, seed)
    backend = _load(path, digest) if path and resume else None
    sampler = emcee.EnsembleSampler(
        len(start),
        start.shape[1],
        _log_posterior(likelihood, prior),
        vectorize=True,
        moves=[(emcee.moves.DEMove(), 0.8), (emcee.moves.DESnookerMove(), 0.2)],
        backend=backend,
    )
    state = emcee.State(start, random_state=np.random.RandomState(seed).get_state())
    while not (done := _long_enough(sampler)) and sampler.iteration < max_steps:
        sampler.run_mcmc(state if sampler.iteration == 0 else None, SEGMENT)
        if path:
            _save(sampler, path, digest)
        if progress:
            progress(sampler.iteration, int(ENOUGH * _time(sampler)))
    return _posterior(sampler, likelihood, prior, done)


def _log_posterior(likelihood: Likelihood, prior: Prior) -> Callable[[FloatArray], FloatArray]:
    def log_posterior(x: FloatArray) -> FloatArray:
        density = prior.log_density(x)
        inside = np.isfinite(density)
        if inside.any():
            density[inside] += likelihood.log_prob(_physical(x[inside]))
        return density

    return log_posterior


def _physical(x: FloatArray) -> FloatArray:
    """From the sampled coordinates to the model's: exp of the ln contrast."""
    theta = x.copy()
    theta[..., 2] = np.exp(theta[..., 2])
    return theta


def _start(result: SearchResult, prior: Prior, rng: np.random.Generator) -> FloatArray:
    """Walkers (n, n_dim) around the modes, each by its own covariance, inside the prior."""
    modes = [m for m in result.modes if m.theta[2] > prior.contrast_min] or [result.modes[0]]
    laplace = [_laplace(result.likelihood, m, prior) for m in modes]
    log_weight = np.array([w for _, _, w in laplace])
    weight = np.exp(log_weight - log_weight.max())
    which = rng.choice(len(modes), size=1000 * N_WALKERS, p=weight / weight.sum())
    trial = np.array(
        [laplace[k][0] + laplace[k][1] @ rng.standard_normal(len(laplace[k][0])) for k in which]
    )
    inside = trial[np.isfinite(prior.log_density(trial))]
    if len(inside) < N_WALKERS:
        raise DataError(
            "the best fit lies outside the prior", source=result.likelihood.observables.source
        )
    return inside[:N_WALKERS]


def _laplace(
    likelihood: Likelihood, mode: Mode, prior: Prior
) -> tuple[FloatArray, FloatArray, float]:
    """Centre, scatter matrix and log-weight of a mode in the sampled coordinates."""
    theta = np.array(mode.theta)
    theta[2] = np.clip(theta[2], 2.0 * prior.contrast_min, prior.contrast_max)
    stretch = np.ones(len(theta))
    stretch[2] = 1.0 / theta[2]
    # A weak mode's errors reach past the prior's edges; a walker needs only a fair start.
    wide = likelihood.errors(theta) * np.outer(stretch, stretch)
    values, vectors = np.linalg.eigh(wide)
    limit = np.max([0.05 * prior.outer_mas, 1.0])
    scatter = vectors * np.sqrt(np.clip(values, 1e-20, limit**2))
    theta[2] = np.log(theta[2])
    return theta, scatter, 0.5 * mode.delta_chi2 + float(np.log(np.abs(np.linalg.det(scatter))))


def _time(sampler: emcee.EnsembleSampler) -> float:
    """Longest integrated autocorrelation time of the second two thirds of the chain, steps."""
    chain = sampler.get_chain()[sampler.iteration // 3 :]
    times = emcee.autocorr.integrated_time(chain, tol=0)
    return float(np.nanmax(times)) if np.isfinite(times).any() else np.inf


def _long_enough(sampler: emcee.EnsembleSampler) -> bool:
    if sampler.iteration < 2 * SEGMENT:
        return False
    kept = sampler.iteration - sampler.iteration // 3
    return kept > ENOUGH * _time(sampler) and _split_rhat(sampler) < GOOD_RHAT


def _split_rhat(sampler: emcee.EnsembleSampler) -> float:
    """Largest split-R̂ of the parameters, every walker's second two thirds cut in two."""
    chain = sampler.get_chain()[sampler.iteration // 3 :]
    half = len(chain) // 2
    halves = np.concatenate([chain[:half], chain[half : 2 * half]], axis=1)
    within = halves.var(axis=0, ddof=1).mean(axis=0)
    between = halves.mean(axis=0).var(axis=0, ddof=1)
    return float(np.sqrt(((half - 1) / half * within + between) / within).max())


def _posterior(
    sampler: emcee.EnsembleSampler, likelihood: Likelihood, prior: Prior, converged: bool
) -> Posterior:
    time = _time(sampler)
    burn = sampler.iteration // 3
    thin = max(1, int(0.5 * time)) if np.isfinite(time) else 1
    return Posterior(
        names=likelihood.parameters,
        samples=_physical(sampler.get_chain(discard=burn, thin=thin, flat=True)),
        log_prob=sampler.get_log_prob(discard=burn, thin=thin, flat=True),
        autocorrelation_time=time,
        n_steps=sampler.iteration,
        n_burn=burn,
        n_walkers=sampler.nwalkers,
        split_rhat=_split_rhat(sampler),
        acceptance=float(np.mean(sampler.acceptance_fraction)),
        converged=converged,
        prior=prior,
    )


def _digest(likelihood: Likelihood, prior: Prior, start: FloatArray, seed: int) -> str:
    text = repr((likelihood.model, prior, seed, emcee.__version__)).encode()
    return sha256(text + likelihood.observables.data.tobytes() + start.tobytes()).hexdigest()


def _save(sampler: emcee.EnsembleSampler, path: str | Path, digest: str) -> None:
    """Write the chain in the layout of `emcee.backends.HDFBackend`, whole or not at all."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        group = file.create_group(GROUP)
        backend = sampler.backend
        group.attrs.update(
            version=emcee.__version__,
            nwalkers=sampler.nwalkers,
            ndim=sampler.ndim,
            has_blobs=False,
            iteration=sampler.iteration,
            amibayes_digest=digest,
        )
        for k, part in enumerate(backend.random_state):
            group.attrs[f"random_state_{k}"] = part
        group["accepted"] = backend.accepted
        group["chain"] = backend.get_chain()
        group["log_prob"] = backend.get_log_prob()


def _load(path: str | Path, digest: str) -> emcee.backends.Backend | None:
    """Read a chain back, if it is the chain of this very problem."""
    if not Path(path).is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            group = file[GROUP]
            if group.attrs.get("amibayes_digest") != digest:
                return None
            backend = emcee.backends.Backend()
            backend.reset(int(group.attrs["nwalkers"]), int(group.attrs["ndim"]))
            backend.chain = group["chain"][()]
            backend.log_prob = group["log_prob"][()]
            backend.accepted = group["accepted"][()]
            backend.iteration = int(group.attrs["iteration"])
            backend.random_state = tuple(group.attrs[f"random_state_{k}"] for k in range(5))
            backend.initialized = True
            return backend
    except (OSError, KeyError) as error:
        raise DataError(f"is not a chain that can be continued: {error}", source=path) from error
