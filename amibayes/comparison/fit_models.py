"""The best fit of every model of the sky, searched for from many starting points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

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
    banks = tuple(_banks(model, parts, int(rng.integers(2**31))))
    starts = [bank.seeds(data[:, None])[0] for bank in banks]
    starts.append(rng.random((n_starts(model) if model.n_dim else 1, model.n_dim)))
    starts += [embedded(model, part.model, part.cube[0])[None] for part in parts]
    if known is not None:
        starts.append(model.cube(known))
    every = np.concatenate(starts)
    for steps, kept in ((FIRST_STEPS, CONTINUED), (STEPS, KEPT)):
        cube, chi2 = least_squares(model, every, np.tile(data[:, None], (1, len(every))), steps)
        order = np.argsort(chi2, kind="stable")[:kept]
        every = cube[order]
    return ModelFit(model, cube[order], chi2[order], banks)


def _banks(model: CubeModel, parts: Sequence[ModelFit], seed: int) -> list[SeedBank]:
    """A bank of every source that a simpler model lacks, on what that model fits."""
    found = []
    for part in parts:
        reference = embedded(model, part.model, part.cube[0])
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
