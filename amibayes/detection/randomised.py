"""False-alarm probability by randomised residuals: it owes nothing to a model of the noise.

Without a companion the residual closure phases of an exposure are as likely with the opposite
sign, all channels and triangles of the exposure together, whatever their correlations are; and
residuals of V² are as likely in another exposure of the same baselines and channels. Data
randomised so are searched with the statistic of the search. A pattern common to all exposures,
such as that of a companion, is destroyed by the signs; an error of single exposures is not.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.special import gammaln

from amibayes.data.measurements import Measurements, exposure_labels
from amibayes.data.observables import Observables
from amibayes.detection.null_draws import pieces_of
from amibayes.detection.statistic import Statistic
from amibayes.detection.tails import clopper_pearson
from amibayes.parallel import Executor, Journal, Progress, SerialExecutor, run_job, spawn
from amibayes.units import FloatArray, IntArray

MIN_EXPOSURES = 10
"""Exposures below which their scatter says little of how exposures differ."""

MIN_CHOICES = 1e5
"""Ways to randomise from which on a probability of 1e-3 can be told.

Of signs alone it takes 18 exposures: those that a companion hardly touches may have either sign
and leave the statistic as it is, which makes the smallest probability some 100 times the share of
one choice.
"""

SAME = 1e-4
"""Statistics that differ relatively by less are of the same data, or of their mirror image.

Products in single precision are good to 1e-6. Of N exposures one choice of signs in 2^(N−1) gives
the data back: counted, it would forbid any small probability where N is about ten.
"""


@dataclass(frozen=True, eq=False)
class Randomisation:
    """What may change places or sign without a companion.

    Parameters
    ----------
    n_vis2 : int
    exposure : (n_closure,) int array
        Exposure of every closure phase, from 0.
    exchangeable : tuple of (n_exposures, n_entries) int arrays
        V² that exposures of the same baselines and channels have in common, in one order.
    sigma : (n_vis2,) float array
        Errors of V²: exposures exchange residuals in these units.
    """

    n_vis2: int
    exposure: IntArray
    exchangeable: tuple[IntArray, ...]
    sigma: FloatArray

    @property
    def n_exposures(self) -> int:
        """Exposures with closure phases; without these, the most that exchange V²."""
        if len(self.exposure):
            return int(self.exposure.max()) + 1
        return max((len(entries) for entries in self.exchangeable), default=0)

    @property
    def log_choices(self) -> float:
        """ln of the number of ways to randomise that are no mirror images of each other."""
        signs = np.log(2.0) * max(self.n_exposures - 1, 0) if len(self.exposure) else 0.0
        return float(signs + sum(gammaln(len(entries) + 1.0) for entries in self.exchangeable))

    @property
    def enough(self) -> bool:
        """Whether there are enough exposures, and ways to randomise them."""
        return self.n_exposures >= MIN_EXPOSURES and self.log_choices >= np.log(MIN_CHOICES)

    def draw(self, residual: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
        """Randomise residuals (n_data,) n times, (n_data, n)."""
        out = np.repeat(residual[:, None], n, axis=1)
        for entries in self.exchangeable:
            standard = residual[entries] / self.sigma[entries]
            order = rng.permuted(np.tile(np.arange(len(entries))[:, None], n), axis=0)
            for k, rows in enumerate(entries):
                out[rows] = standard[order[k]].T * self.sigma[rows, None]
        if len(self.exposure):
            sign = rng.choice([-1.0, 1.0], (self.n_exposures, n))
            out[self.n_vis2 :] *= sign[self.exposure]
        return out


def randomisation_of(observables: Observables) -> Randomisation:
    """Find the exposures of unflagged observables."""
    data = observables.unflagged()
    sigma = np.sqrt(data.covariance.variance[: data.n_vis2])
    label = exposure_labels(data.closure_phase)
    exposure = np.unique(label, return_inverse=True)[1].astype(np.intp)
    return Randomisation(data.n_vis2, exposure, _exchangeable(data), sigma)


def _exchangeable(data: Observables) -> tuple[IntArray, ...]:
    """Entries of V² of exposures with the same baselines and channels."""
    label, keys = exposure_labels(data.vis2), _keys(data, data.vis2)
    alike: dict[tuple[object, ...], list[IntArray]] = {}
    for exposure in np.unique(label):
        entries = np.flatnonzero(label == exposure)
        entries = entries[sorted(range(len(entries)), key=lambda i: keys[entries[i]])]
        alike.setdefault(tuple(keys[i] for i in entries), []).append(entries)
    return tuple(np.array(members) for members in alike.values() if len(members) > 1)


def _keys(data: Observables, table: Measurements) -> list[tuple[str, ...]]:
    """Instrument, stations and channel of every entry."""
    names = [
        (data.setups[s].insname, *sorted(data.setups[s].stations[k] for k in stations))
        for s, stations in zip(table.setup, table.stations, strict=True)
    ]
    return [(*name, f"{c:06d}") for name, c in zip(names, table.channel, strict=True)]


@dataclass(frozen=True)
class Randomised:
    """False-alarm probability by randomised residuals.

    Parameters
    ----------
    n_exposures : int
    n_draws : int
        0 where the exposures are too few.
    probability : float or None
        (1 + number of draws above) / (1 + number of draws).
    interval : (float, float) or None
        Its 95 % Clopper–Pearson interval.
    """

    n_exposures: int
    n_draws: int = 0
    probability: float | None = None
    interval: tuple[float, float] | None = None

    @property
    def note(self) -> str:
        """Say what it is worth."""
        if self.probability is None:
            return (
                f"{self.n_exposures} exposures are too few to tell anything by randomised residuals"
            )
        return f"randomised residuals of {self.n_exposures} exposures: {self.probability:.2g}"


def randomised(
    test: Statistic,
    n_draws: int,
    rng: np.random.Generator,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
    journal: Journal | None = None,
) -> Randomised:
    """Place the statistic of the data among those of the same data randomised.

    Parameters
    ----------
    test : Statistic
    n_draws : int
    rng : numpy.random.Generator
    executor, progress, journal
        As in `amibayes.detection.statistic.BankStatistic.draw_null`.
    """
    shuffle = randomisation_of(test.likelihood.observables)
    if not shuffle.enough:
        return Randomised(shuffle.n_exposures)
    sizes = pieces_of(n_draws, len(test.residual))
    pieces = list(zip(spawn(rng, len(sizes)), sizes, strict=True))
    work, where = partial(_piece, test, shuffle), executor or SerialExecutor()
    done = run_job(work, pieces, where, journal=journal, progress=progress)
    found = np.concatenate([piece["statistic"] for piece in done])
    observed = float(test.evaluate(test.observed[:, None])[0])
    above = int((found > observed * (1.0 + SAME)).sum())
    interval = clopper_pearson(above, n_draws)
    return Randomised(shuffle.n_exposures, n_draws, (1 + above) / (1 + n_draws), interval)


def _piece(
    test: Statistic, shuffle: Randomisation, piece: tuple[np.random.SeedSequence, int]
) -> dict[str, FloatArray]:
    seed, size = piece
    drawn = shuffle.draw(test.residual, size, np.random.default_rng(seed))
    return {"statistic": test.evaluate(test.likelihood.noise.whiten(drawn))}
