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
from amibayes.comparison.integral import log_z_laplace
from amibayes.comparison.mixture import PriorDraws
from amibayes.comparison.pooled import PooledEffort, pooled_evidences
from amibayes.comparison.verdict import Confusion
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, run_job, slices, spawn
from amibayes.units import FloatArray

RANDOM_STARTS, KNOWN_STARTS = 4, 2
"""Starting points of each simulated data set beside those of the banks: random ones, and the best
fits to the data themselves."""

FIRST_STEPS, STEPS, CONTINUED = 4, 12, 6
"""Steps of every fit to simulated data, then of so many, the best ones: what is drawn around need
not be the minimum to a digit."""

QUICK = PooledEffort()
"""ln Z of simulated data is then known to 0.02 to 0.1: less than what decides."""

THOROUGH = PooledEffort(draws=8192, rounds=6)
POOR, EXCLUDED = 0.2, 8.0
"""Effort where the shared draws leave a large error of ln Z, and that error: where data are so
strong that the posterior is small and bent, few draws find it, and the evidence comes out too
small. A model whose odds are below e⁻⁸ gets none of it."""

LARGE = 1000
SMALL = PooledEffort(prior=512, draws=1024, centres=8, rounds=2)
"""Points of the (u, v) plane from which on evidences of simulated data get this effort alone, and
Laplace's approximation where it is poor: a draw costs as much as the data are many, and posteriors
of so many data are compact."""

HOPELESS = 15.0
"""A model whose largest ln L, which no evidence exceeds, is so far below another's evidence has
odds below 1e-6: its own evidence is not measured, and that bound stands for it."""

PIECE = 20
"""Simulated data sets that are compared together: fits of several share their arithmetic, and a
run that was cut off loses no more than these."""


Fits = tuple[FloatArray, FloatArray]
"""Points of the cube (n, n_starts, n_dim) where fits of data sets end, and their χ²."""


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
    prior = [
        PriorDraws.of(f.model, effort_of(f).prior, child) if f.model.n_dim else None
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
    """ln Z of every model for data sets (n_data, n), (n, n_models).

    Models that fit best come first: where one cannot come near them, the largest ln L stands.
    """
    tried: dict[str, Fits] = {}
    for fit in fits:
        tried[fit.hypothesis.name] = _fitted(fit, data, tried, fits, rng)
    found = [tried[fit.hypothesis.name] for fit in fits]
    out = np.stack([_bound(f, data, *t) for f, t in zip(fits, found, strict=True)], axis=1)
    best = np.full(data.shape[1], -np.inf)
    for k in np.argsort(-out.mean(axis=0), kind="stable"):
        near = np.flatnonzero(out[:, k] >= best - HOPELESS)
        if len(near):
            mine = found[k][0][near], found[k][1][near]
            out[near, k] = _evidence(fits[k], data[:, near], mine, rng, prior[k], best[near])
            best[near] = np.maximum(best[near], out[near, k])
    return out


def _evidence(
    fit: ModelFit,
    data: FloatArray,
    tried: Fits,
    rng: np.random.Generator,
    prior: PriorDraws | None,
    best: FloatArray,
) -> FloatArray:
    """ln Z (n,) of one model for data sets (n_data, n), where other models have ``best`` (n,)."""
    model = fit.model
    if prior is None:
        return _bound(fit, data, *tried)
    out, error = pooled_evidences(model, data, *tried, rng, prior, effort_of(fit))
    poor = np.flatnonzero((error > POOR) & (out > best - EXCLUDED))
    if len(poor) and len(model.likelihood.samples) <= LARGE:
        mine = data[:, poor], tried[0][poor], tried[1][poor]
        out[poor], error[poor] = pooled_evidences(model, *mine, rng, prior, THOROUGH)
    for i in np.flatnonzero(error > POOR):
        # Draws that miss a small, bent posterior make it too small, never too large.
        out[i] = max(out[i], log_z_laplace(model, data[:, i], tried[0][i], tried[1][i]))
    return out


def effort_of(fit: ModelFit) -> PooledEffort:
    """Effort of the evidences of simulated data sets."""
    return SMALL if len(fit.model.likelihood.samples) > LARGE else QUICK


def _fitted(
    fit: ModelFit,
    data: FloatArray,
    tried: Mapping[str, Fits],
    fits: Sequence[ModelFit],
    rng: np.random.Generator,
) -> Fits:
    """Fits (n, n_starts, n_dim) and χ² (n, n_starts) of data sets (n_data, n).

    They begin where the banks of seeds say, at random, at the fits to the data themselves, and
    where models that this one holds have their best fits.
    """
    model, n = fit.model, data.shape[1]
    starts = [bank.seeds(data) for bank in fit.banks]
    starts.append(rng.random((n, RANDOM_STARTS if model.n_dim else 0, model.n_dim)))
    for part in fits:
        if part.hypothesis.name in tried and part.hypothesis.within(fit.hypothesis):
            cube, chi2 = tried[part.hypothesis.name]
            best = cube[np.arange(n), chi2.argmin(axis=1)]
            starts.append(embedded(model, part.model, best)[:, None])
    known = fit.cube[: KNOWN_STARTS if model.n_dim else 1]
    starts.append(np.broadcast_to(known, (n, *known.shape)))
    every = np.concatenate(starts, axis=1)
    for steps, most in ((FIRST_STEPS, CONTINUED), (STEPS, CONTINUED)):
        flat = np.concatenate(every)
        cube, chi2 = least_squares(model, flat, np.repeat(data, every.shape[1], axis=1), steps)
        cube, chi2 = cube.reshape(every.shape), chi2.reshape(every.shape[:2])
        best = np.argsort(chi2, axis=1, kind="stable")[:, :most]
        every = np.take_along_axis(cube, best[:, :, None], axis=1)
    return every, np.take_along_axis(chi2, best, axis=1)


def _bound(fit: ModelFit, data: FloatArray, cube: FloatArray, chi2: FloatArray) -> FloatArray:
    """ln L (n,) of the best fits, which the evidence of a hopeless model is below."""
    at = cube[np.arange(len(cube)), chi2.argmin(axis=1)]
    difference = fit.model.difference(fit.model.predict(at), data)
    return fit.model.likelihood.noise.log_prob(difference)
