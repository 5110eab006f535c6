"""Extra noise: a variance per kind of observable, for errors that are too small.

Where the best model leaves residuals that the stated errors cannot explain, a variance is
added to every V² and one to every closure phase (through the baselines that its triangles
share) that makes the residuals as likely as can be. A reduced χ² of ten then means errors
three times larger, and not a companion. Of a joint fit each file may have noise of its own:
one with calibration errors of its own then does not spoil the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import block_diag, csr_array, diags_array

from amibayes.data.degrees_of_freedom import squared_share, welch_satterthwaite
from amibayes.data.observables import Observables
from amibayes.data.systematics import Systematics
from amibayes.likelihood.channel_noise import ChannelShare, noise_with_channels
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.residuals import files_of
from amibayes.units import FloatArray

UNLIKELY = 1e-3
"""Probability of a χ² as large as that of a kind of observable, below which noise is added."""


MAX_ROUNDS = 4


CONVERGED = 0.01
"""Relative change of the extra noise at which search and noise agree."""


VIS2_PRIOR, CLOSURE_PRIOR_RAD = 0.05, float(np.radians(3.0))
"""Half-normal prior of extra noise: of V², relative to its root mean square, and of closure
phases. Calibration of a few per cent and degrees is common; more is another model's light."""

BOUND = 3.0
"""Extra noise is at most so many times the width of its prior."""


@dataclass(frozen=True)
class NoisePrior:
    """How much noise beside the stated errors is plausible.

    Parameters
    ----------
    vis2 : float
        Width of the half-normal prior of extra noise of V², relative to the root mean square
        of V².
    closure_phase_rad : float
        Likewise of closure phases.
    channels : bool
        Whether channels of an exposure may share some of their noise.
    floors : tuple of Systematics
        Calibration errors of files, which no fit of the noise goes below.
    """

    vis2: float = VIS2_PRIOR
    closure_phase_rad: float = CLOSURE_PRIOR_RAD
    channels: bool = True
    floors: tuple[Systematics, ...] = ()

    def width(self, data: Observables, kind: str) -> float:
        """Width of the prior of one kind, in the unit of the data.

        Not below the typical stated error: near a null of V² errors are no share of it, and
        as much again is plausible of any.
        """
        if self.vis2 == 0.0 == self.closure_phase_rad:
            return 0.0
        n = data.n_vis2
        vis2 = kind == "vis2"
        variance = data.covariance.variance[:n] if vis2 else data.covariance.variance[n:]
        typical = float(np.sqrt(np.median(variance))) if len(variance) else 0.0
        if not vis2:
            return max(self.closure_phase_rad, typical)
        value = data.vis2.value[~data.vis2.flag]
        return max(self.vis2 * float(np.sqrt(np.mean(value**2))) if len(value) else 0.0, typical)


@dataclass(frozen=True)
class FileNoise:
    """Standard deviations added to the V² and to the closure phases of one file."""

    source: str
    vis2: float = 0.0
    closure_phase_rad: float = 0.0


@dataclass(frozen=True)
class ExtraNoise:
    """Standard deviations added in quadrature.

    Parameters
    ----------
    vis2 : float
        To every V².
    closure_phase_rad : float
        To every closure phase.
    files : tuple of FileNoise
        What each file gets, where files are told apart; the two above are then the root mean
        squares over all data.
    channels : tuple of ChannelShare
        What the channels of an exposure share of the whole variance, for every file where
        files are told apart; empty where channels are independent.
    floors : tuple of Systematics
        Calibration errors that were taken for certain.
    """

    vis2: float = 0.0
    closure_phase_rad: float = 0.0
    files: tuple[FileNoise, ...] = ()
    channels: tuple[ChannelShare, ...] = ()
    floors: tuple[Systematics, ...] = ()

    @property
    def any(self) -> bool:
        """Whether there is any."""
        return self.vis2 > 0.0 or self.closure_phase_rad > 0.0

    @property
    def smooth(self) -> tuple[float, float]:
        """Of V² and of closure phases: what channels share beside the errors, rms in these.

        The largest of all files; see `amibayes.likelihood.channel_noise.Correlation`.
        """
        vis2 = max((sum(c.vis2.smooth) for c in self.channels), default=0.0)
        closure = max((sum(c.closure_phase.smooth) for c in self.channels), default=0.0)
        return float(np.sqrt(vis2)), float(np.sqrt(closure))

    @property
    def exceeds_stated(self) -> bool:
        """Whether residuals show more than the stated errors and floors."""
        return self.any or sum(self.smooth) > 0.0

    def of(self, data: Observables) -> tuple[FloatArray, FloatArray]:
        """Variance added to each unflagged V² (n_vis2,) and closure phase (n_closure,)."""
        vis2 = np.full(data.n_vis2, self.vis2**2)
        closure = np.full(data.n_closure_phases, self.closure_phase_rad**2)
        if self.files:
            own = {f.source: f for f in self.files}
            for part in files_of(data):
                vis2[part.vis2] = own[part.source].vis2 ** 2
                closure[part.closure_phase] = own[part.source].closure_phase_rad ** 2
        return vis2, closure


def mean_of_files(data: Observables, files: Sequence[FileNoise]) -> ExtraNoise:
    """Extra noise of files, with its root mean square over all unflagged data of each kind."""
    vis2, closure = (
        float(np.sqrt(variance.mean())) if len(variance) else 0.0
        for variance in ExtraNoise(files=tuple(files)).of(data)
    )
    return ExtraNoise(vis2, closure, tuple(files))


def add_noise(observables: Observables, extra: ExtraNoise) -> Observables:
    """Add extra noise to the covariance of unflagged observables.

    Its size is taken as known: an estimated covariance then has more degrees of freedom.
    """
    if not extra.any:
        return observables
    data = observables.unflagged()
    noisy = replace(data, covariance=data.covariance.plus(covariance_of(data, extra)))
    if data.freedom is None:
        return noisy
    stated, whole = data.covariance.sparse, noisy.covariance.sparse
    freedom = welch_satterthwaite([(squared_share(stated, noisy.covariance), data.freedom)])
    scatter = None if data.scatter is None else csr_array(data.scatter + whole - stated)
    return replace(noisy, freedom=freedom, scatter=scatter)


def with_noise(likelihood: Likelihood, extra: ExtraNoise) -> Likelihood:
    """Add extra noise, and what channels share, to a likelihood with the stated errors."""
    data = add_noise(likelihood.observables, extra)
    return Likelihood(
        data, likelihood.model, noise_with_channels(data, extra.channels, extra.floors)
    )


def covariance_of(data: Observables, extra: ExtraNoise) -> csr_array:
    """Covariance (n_data, n_data) of extra noise of unflagged data."""
    vis2, closure = extra.of(data)
    return csr_array(block_diag([diags_array(vis2), _shared_noise(data, closure)]))


def _shared_noise(data: Observables, closure: FloatArray) -> csr_array:
    """`Measurements.shared_noise` of closure phases, of variances ``closure`` (n_closure,)."""
    root = diags_array(np.sqrt(closure))
    return csr_array(root @ data.closure_phase.shared_noise @ root)
