"""Fits to exposures drawn anew: errors that owe nothing to a noise model.

Exposures are drawn with replacement, all that belongs to one together (every baseline, triangle
and channel), as CANDID and PMOIRED do. One that is drawn k times counts k times: its covariance
is divided by k. The spread of the fits holds whatever errors exposures have of their own,
correlated within them or not; an error common to all exposures it cannot see.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.companion_search.field import box_of
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.result import SearchResult
from amibayes.data.measurements import DAY_S, exposure_labels
from amibayes.data.observables import Observables
from amibayes.errors import DataError
from amibayes.likelihood.channel_noise import noise_with_channels
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.student import reweighted
from amibayes.models.parameters import Parameters
from amibayes.parallel import Progress
from amibayes.posterior.derived import DERIVED, derived, interval
from amibayes.units import (
    FloatArray,
    IntArray,
    read_only,
)

MIN_EXPOSURES = 5
"""Fewer exposures have too few ways to be drawn (126 of five) for the tails of an interval."""

MAX_TRIES = 20
"""Draws that leave fewer data than parameters are drawn again, so often at most."""


@dataclass(frozen=True, eq=False)
class Bootstrap:
    """Fits to exposures drawn anew.

    Parameters
    ----------
    parameters : Parameters
    samples : (n, n_dim) float array
    n_exposures : int
    """

    parameters: Parameters
    samples: FloatArray
    n_exposures: int

    def __post_init__(self) -> None:
        read_only(self, "samples")

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the columns."""
        return self.parameters.names

    def column(self, name: str) -> FloatArray:
        """Fits of a parameter, or of separation_mas, position_angle_deg or delta_mag."""
        if name not in DERIVED:
            return self.samples[:, self.parameters.index(name)]
        east, north = self.samples[:, self.parameters.place()].T
        return derived(name, east, north, self.samples[:, self.parameters.contrasts[0]])

    def interval(self, name: str, level: float = 0.68) -> tuple[float, float, float]:
        """(median, lower, upper) of a quantity; angles are cut opposite their mean."""
        return interval(name, self.column(name), level)


def bootstrap(
    result: SearchResult,
    noise: ExtraNoise,
    n: int,
    rng: np.random.Generator,
    *,
    progress: Progress | None = None,
) -> Bootstrap:
    """Fit exposures drawn anew, from the best fit of a search.

    Parameters
    ----------
    result : SearchResult
    noise : ExtraNoise
        Of the search: what channels share, and floors.
    n : int
        Fits.
    rng : numpy.random.Generator
    progress : callable, optional
        Called with (done, expected).

    Raises
    ------
    DataError
        Where there are fewer than `MIN_EXPOSURES` exposures.
    """
    likelihood = result.likelihood
    label = exposures_of(likelihood.observables)
    n_exposures = int(label.max()) + 1
    if n_exposures < MIN_EXPOSURES:
        raise DataError(
            f"holds {n_exposures} exposures, too few to be drawn anew",
            source=likelihood.observables.source,
            remedy=f"leave --bootstrap out below {MIN_EXPOSURES}",
        )
    box = box_of(result.grid, likelihood)
    samples = []
    for k in range(n):
        drawn = _drawn(likelihood, noise, label, rng)
        samples.append(refine(drawn, np.array(result.theta), box, 0.0).theta)
        if progress:
            progress(k + 1, n)
    return Bootstrap(likelihood.parameters, np.array(samples), n_exposures)


def _drawn(
    likelihood: Likelihood, noise: ExtraNoise, label: IntArray, rng: np.random.Generator
) -> Likelihood:
    """The likelihood of as many exposures, drawn with replacement."""
    n_exposures, data = int(label.max()) + 1, likelihood.observables
    for _ in range(MAX_TRIES):
        count = rng.multinomial(n_exposures, np.full(n_exposures, 1.0 / n_exposures))[label]
        kept = data.select(*np.split(count > 0, [data.n_vis2]))
        if kept.n_independent > len(likelihood.parameters):
            break
    kept = reweighted(kept, 1.0 / np.sqrt(count[count > 0]))
    channels = noise_with_channels(kept, noise.channels, noise.floors)
    return Likelihood(kept, likelihood.model, channels)


def exposures_of(data: Observables) -> IntArray:
    """Number of the exposure of every unflagged datum, (n_data,), from 0.

    V², closure phases and combiners of one file that are `TOGETHER_S` apart or less belong
    together; where times do not tell, as they follow each other.
    """
    tables = [data.vis2, data.closure_phase]
    setup, mjd = (np.concatenate([getattr(m, name) for m in tables]) for name in ("setup", "mjd"))
    kind = np.repeat([0, 1], [len(m) for m in tables])
    sources = np.unique([s.source for s in data.setups], return_inverse=True)[1][setup]
    label = np.concatenate([exposure_labels(m) for m in tables])
    keys, inverse = np.unique(
        np.stack([sources, 2 * setup + kind, label]), axis=1, return_inverse=True
    )
    inverse = inverse.ravel()
    time = np.bincount(inverse, mjd) / np.bincount(inverse)
    return _numbered(keys, time)[inverse]


def _numbered(keys: IntArray, time: FloatArray) -> IntArray:
    """Number exposures of tables, keys (3, n) of file, table and label, by their mean dates."""
    source, table, label = keys
    place = np.empty(len(time), dtype=np.intp)
    for one in np.unique(table):
        place[table == one] = np.unique(label[table == one], return_inverse=True)[1]
    out, number = np.empty(len(time), dtype=np.intp), -1
    seen: set[int] = set()
    begin, file = -np.inf, -1
    for k in np.lexsort((table, place, time, source)).tolist():
        late = (time[k] - begin) * DAY_S > TOGETHER_S
        if late or source[k] != file or int(table[k]) in seen:
            number, seen, begin, file = number + 1, set(), time[k], int(source[k])
        seen.add(int(table[k]))
        out[k] = number
    return out


TOGETHER_S = 60.0
"""Tables of one exposure state dates that differ by less: each has its own mean."""
