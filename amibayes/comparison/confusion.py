"""How often the data would have one model taken for another, by simulation.

Data sets are drawn from the best fit of each model with the noise of the data, and go through
the same comparison as the data: fits of every model, evidences, choice. What is counted holds
for these data, with their baselines, errors and correlations.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import numpy as np

from amibayes.comparison.fit_models import ModelFit, embedded
from amibayes.comparison.fitting import least_squares
from amibayes.comparison.integral import Effort, PriorDraws, integrate, log_z_laplace
from amibayes.comparison.verdict import Confusion
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.units import FloatArray

RANDOM_STARTS, KNOWN_STARTS = 8, 4
"""Starting points of each simulated data set beside those of the banks: random ones, and the best
fits to the data themselves."""

QUICK = Effort(prior=2048, modes=1024, repeats=0, centres=5, rounds=3)
"""ln Z of simulated data is then known to 0.02 to 0.1: less than what decides."""

THOROUGH = Effort(prior=2048, modes=2048, repeats=2, rounds=8)
POOR = 0.2
"""Effort where the quick one leaves a large error of ln Z, and that error: where data are so strong
that the posterior is small and bent, few draws find it, and the evidence comes out too small."""

LARGE = 1000
SMALL_EFFORT = Effort(prior=512, modes=256, repeats=0, centres=3, rounds=2)
"""Points of the (u, v) plane from which on evidences of simulated data get this effort alone, and
Laplace's approximation where it is poor: a draw costs as much as the data are many, and posteriors
of so many data are compact."""

HOPELESS = 15.0
"""A model whose largest ln L, which no evidence exceeds, is so far below another's evidence has
odds below 1e-6: its own evidence is not measured, and that bound stands for it."""

PIECE = 8
"""Simulated data sets that are compared together: fits of several share their arithmetic, and a
run that was cut off loses no more than these."""


def measure_confusion(
    fits: Sequence[ModelFit],
    n_draws: int,
    rng: np.random.Generator,
    *,
    log_prior: FloatArray,
    executor: Executor | None = None,
    journal: Journal | None = None,
    progress: Progress | None = None,
) -> Confusion:
    """Simulate data sets from the best fit of each model and compare the models on each.

    Parameters
    ----------
    fits : sequence of ModelFit
        Of the data; their noise is what data sets are drawn from and compared with.
    n_draws : int
        Data sets of each model.
    rng : numpy.random.Generator
    log_prior : (n_models,) float array
    executor : Executor, optional
        Where data sets are compared; the result does not depend on it.
    journal : Journal, optional
        Where finished pieces are kept.
    progress : callable, optional
    """
    effort = efforts(fits[0])[0].prior
    prior = [
        PriorDraws.of(f.model, effort, child) if f.model.n_dim else None
        for f, child in zip(fits, rng.spawn(len(fits)), strict=True)
    ]
    sizes = [part.stop - part.start for part in slices(n_draws, PIECE)]
    jobs = [(k, size) for k in range(len(fits)) for size in sizes]
    pieces = [(k, size, seed) for (k, size), seed in zip(jobs, spawn(rng, len(jobs)), strict=True)]
    work = partial(_piece, tuple(fits), prior)
    where = executor or SerialExecutor()
    done = [p["log_z"] for p in run_job(work, pieces, where, journal=journal, progress=progress)]
    models = tuple(f.hypothesis for f in fits)
    found = np.concatenate(done).reshape(len(fits), n_draws, len(fits))
    return Confusion(models, found, np.asarray(log_prior))


def _piece(
    fits: Sequence[ModelFit],
    prior: Sequence[PriorDraws | None],
    piece: tuple[int, int, np.random.SeedSequence],
) -> dict[str, FloatArray]:
    """Evidences (n, n_models) of some data sets simulated from one model."""
    k, n_draws, seed = piece
    rng, truth = np.random.default_rng(seed), fits[k]
    noise = truth.model.likelihood.noise.draw(n_draws, rng)
    data = truth.model.predict(truth.cube[:1]) + noise
    return {"log_z": evidences(fits, data, rng, prior)}


def evidences(
    fits: Sequence[ModelFit],
    data: FloatArray,
    rng: np.random.Generator,
    prior: Sequence[PriorDraws | None],
) -> FloatArray:
    """ln Z of every model for data sets (n_data, n), (n, n_models)."""
    tried: dict[str, tuple[FloatArray, FloatArray]] = {}
    for fit in fits:
        tried[fit.hypothesis.name] = _fitted(fit, data, tried, fits, rng)
    return np.array(
        [
            _evidences_of(fits, one, [(c[i], x[i]) for c, x in tried.values()], rng, prior)
            for i, one in enumerate(data.T)
        ]
    )


def _evidences_of(
    fits: Sequence[ModelFit],
    data: FloatArray,
    tried: Sequence[tuple[FloatArray, FloatArray]],
    rng: np.random.Generator,
    prior: Sequence[PriorDraws | None],
) -> FloatArray:
    """ln Z (n_models,) of one data set, the models that fit best first."""
    out = np.array([_bound(f, data, *t) for f, t in zip(fits, tried, strict=True)])
    best = -np.inf
    for k in np.argsort(-out, kind="stable"):
        if out[k] < best - HOPELESS:
            break
        cube, chi2 = tried[k]
        for effort in efforts(fits[k]):
            found = integrate(fits[k].model, data, cube, chi2, rng, prior=prior[k], effort=effort)
            if found.diagnostics["log_z_error"] < POOR:
                break
        out[k] = found.diagnostics["log_z"]
        if found.diagnostics["log_z_error"] > POOR:
            # Draws that miss a small, bent posterior make it too small, never too large.
            laplace = log_z_laplace(fits[k].model, data, cube, chi2)
            out[k] = max(out[k], laplace)
        best = max(best, out[k])
    return out


def efforts(fit: ModelFit) -> tuple[Effort, ...]:
    """Efforts to try for the evidence of a simulated data set, the cheapest first."""
    return (SMALL_EFFORT,) if len(fit.model.likelihood.samples) > LARGE else (QUICK, THOROUGH)


def _fitted(
    fit: ModelFit,
    data: FloatArray,
    tried: Mapping[str, tuple[FloatArray, FloatArray]],
    fits: Sequence[ModelFit],
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Fits (n, n_starts, n_dim) and χ² (n, n_starts) of data sets (n_data, n).

    They begin where the banks of seeds say, at random, at the fits to the data themselves, and
    where models that this one holds have their best fits.
    """
    model, n = fit.model, data.shape[1]
    n_random = RANDOM_STARTS if len(model.likelihood.samples) <= LARGE else RANDOM_STARTS // 4
    inner = [f for f in fits if f.hypothesis.name in tried and f.hypothesis.within(fit.hypothesis)]
    seeds = []
    for i, one in enumerate(data.T):
        starts = [bank.seeds(one) for bank in fit.banks]
        starts.append(rng.random((n_random if model.n_dim else 0, model.n_dim)))
        for part in inner:
            cube, chi2 = tried[part.hypothesis.name]
            starts.append(embedded(model, part.model, cube[i, int(np.argmin(chi2[i]))])[None])
        starts.append(fit.cube[: KNOWN_STARTS if model.n_dim else 1])
        seeds.append(np.concatenate(starts))
    # The banks' seeds come first: of data sets with more of them the worst are left out.
    most = min(len(s) for s in seeds)
    every = np.concatenate([s[-most:] for s in seeds])
    cube, chi2 = least_squares(model, every, np.repeat(data, most, axis=1))
    return cube.reshape(n, most, -1), chi2.reshape(n, most)


def _bound(fit: ModelFit, data: FloatArray, cube: FloatArray, chi2: FloatArray) -> float:
    """ln L of the best fit, which the evidence of a hopeless model is below."""
    at = cube[[int(np.argmin(chi2))]]
    return float(fit.model.log_prob(at, data)[0])
