"""The best fit of every model of the sky, searched for from many starting points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.modes import AS_GOOD
from amibayes.comparison.fitting import STEPS, SeedBank, least_squares
from amibayes.comparison.hypotheses import Hypothesis
from amibayes.comparison.unit_cube import CubeModel
from amibayes.units import FloatArray

START_VALUES, MIN_STARTS, MAX_STARTS = 20_000, 16, 256
"""Model values of all random starting points of the data, and limits of their number. Of 300 that
were fitted to strong NIRISS data, more than half ended in the best fit of rings and discs."""

FIRST_STEPS, CONTINUED = 8, 64
"""Steps that every fit takes, and how many, the best ones, go on to their end."""

KEPT = 24
"""Fits that are kept of each model, the best ones."""

REFERENCES, ELSEWHERE = 3, 0.05
"""Fits of a simpler model that another source is searched for beside: the best one, and others that
differ from it by so much in a dimension of the cube. Two companions may each be an alias, or
lie where the best single one does not."""


@dataclass(frozen=True, eq=False)
class ModelFit:
    """A model of the sky and its best fits to the data.

    Parameters
    ----------
    model : CubeModel
    cube : (n, n_dim) float array
        Points of the cube, the best fit first.
    chi2 : (n,) float array
    banks : tuple of SeedBank
        Where fits of other data may begin.
    """

    model: CubeModel
    cube: FloatArray
    chi2: FloatArray
    banks: tuple[SeedBank, ...]

    @property
    def hypothesis(self) -> Hypothesis:
        """What is on the sky."""
        return self.model.hypothesis

    @property
    def theta(self) -> FloatArray:
        """Parameters of the best fit, (n_dim,)."""
        return np.asarray(self.model.theta(self.cube[:1])[0])


def n_starts(model: CubeModel) -> int:
    """Number of random starting points."""
    wanted = START_VALUES // max(len(model.likelihood.samples), 1)
    return int(np.clip(wanted, MIN_STARTS, MAX_STARTS))


def fit_model(
    model: CubeModel,
    parts: Sequence[ModelFit],
    rng: np.random.Generator,
    known: FloatArray | None = None,
) -> ModelFit:
    """Fit a model from banks of seeds, from random points of its prior, and from known fits.

    Parameters
    ----------
    model : CubeModel
    parts : sequence of ModelFit
        Fits of models with one source less, which its banks take the others from; of the star
        alone for a model of one source.
    rng : numpy.random.Generator
    known : (n, n_dim) float array, optional
        Parameter sets to begin from too.
    """
    data = model.likelihood.observables.data
    seed = int(rng.integers(2**31))
    banks = tuple(_banks(model, parts, seed))
    more = [bank for k in range(1, REFERENCES) for bank in _banks(model, parts, seed, k)]
    starts = [bank.seeds(data[:, None])[0] for bank in (*banks, *more)]
    starts.append(rng.random((n_starts(model) if model.n_dim else 1, model.n_dim)))
    starts += [embedded(model, part.model, part.cube[0])[None] for part in parts]
    if known is not None:
        starts.append(model.cube(known))
    every = np.concatenate(starts)
    for steps, kept in ((FIRST_STEPS, CONTINUED), (STEPS, KEPT)):
        cube, chi2 = least_squares(model, every, np.tile(data[:, None], (1, len(every))), steps)
        order = np.argsort(chi2, kind="stable")[:kept]
        every = cube[order]
    cube, chi2 = model.brighter_first(every), chi2[order]
    order = np.argsort(np.arange(len(chi2)) != innermost(model, cube, chi2), kind="stable")
    return ModelFit(model, cube[order], chi2[order], banks)


def innermost(model: CubeModel, cube: FloatArray, chi2: FloatArray) -> int:
    """Which of the fits (n, n_dim) that are as good as the best has the nearest companions."""
    parameters, theta = model.likelihood.parameters, model.theta(cube)
    if not parameters.companions:
        return int(np.argmin(chi2))
    places = [theta[:, parameters.place(k + 1)] for k in range(parameters.companions)]
    far = np.sum([np.hypot(*place.T) for place in places], axis=0)
    return int(np.argmin(np.where(chi2 <= chi2.min() + AS_GOOD, far, np.inf)))


def references(fit: ModelFit) -> FloatArray:
    """Fits (n, n_dim) of a model that differ from each other, the best first."""
    kept = [fit.cube[0]]
    for cube in fit.cube[1:]:
        apart = np.abs(fit.model.apart(np.array(kept), cube)).max(axis=1, initial=0.0)
        if len(kept) < REFERENCES and (apart > ELSEWHERE).all():
            kept.append(cube)
    return np.array(kept)


def _banks(
    model: CubeModel, parts: Sequence[ModelFit], seed: int, number: int = 0
) -> list[SeedBank]:
    """A bank of every source that a simpler model lacks, on what that model fits.

    On the best of its fits, or the one of a ``number`` where it has companions.
    """
    found = []
    for part in parts:
        known = references(part) if part.hypothesis.companions else part.cube[:1]
        if number >= len(known):
            continue
        reference = embedded(model, part.model, known[number])
        names = [n.replace("ring_", "crescent_") for n in part.model.likelihood.parameters.names]
        names += part.model.likelihood.parameters.names
        for columns, flux in model.groups:
            if model.likelihood.parameters[flux].name not in names:
                found.append(SeedBank.of(model, reference, columns, flux, seed))
    return found


def embedded(model: CubeModel, part: CubeModel, cube: FloatArray) -> FloatArray:
    """Points of the cube (…, n_dim) where a simpler model is at, other sources without light.

    A crescent takes the place of a ring.
    """
    out = np.full((*cube.shape[:-1], model.n_dim), 0.5)
    for _, flux in model.groups:
        out[..., flux] = 0.0
    names = list(part.likelihood.parameters.names)
    for k, parameter in enumerate(model.likelihood.parameters):
        for name in (parameter.name, parameter.name.replace("crescent_", "ring_")):
            if name in names:
                out[..., k] = cube[..., names.index(name)]
                break
        else:
            if parameter.name.endswith("_modulation"):
                out[..., k] = 0.0
    return out
