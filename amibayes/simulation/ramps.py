"""From the rate of light to the reads of each ramp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amibayes.simulation.detector import Detector
from amibayes.units import FloatArray

TO_NEIGHBOURS = 0.05
"""Fraction of a cosmic ray's charge that ends up in each of the four neighbours."""


@dataclass(frozen=True, eq=False)
class Ramps:
    """Reads of some integrations.

    Parameters
    ----------
    reads : (n_reads, n_int, ny, nx) array
        Electrons, after the correction for nonlinearity.
    n_good : (n_int, ny, nx) int array, optional
        Reads before the pixel saturated; None where no pixel did.
    """

    reads: FloatArray
    n_good: NDArray[np.int16] | None


def read_ramps(
    rate_e_s: FloatArray, detector: Detector, n_groups: int, rng: np.random.Generator
) -> Ramps:
    """Simulate the ramps of some integrations.

    Parameters
    ----------
    rate_e_s : (n_int, ny, nx) array
        Electrons per second that light makes in each pixel.
    detector : Detector
        What happens to them.
    n_groups : int
        Groups (frames) of a ramp.
    rng : numpy Generator
        Of these integrations.

    Returns
    -------
    Ramps
    """
    expected = (rate_e_s + (detector.dark_e_s + detector.background_e_s)) * detector.frame_time_s
    reads = np.empty((detector.n_reads(n_groups), *expected.shape))
    rng.standard_normal(out=reads)
    reads *= detector.single_read_noise_e
    charge = np.zeros(expected.shape)
    n_good: NDArray[np.int16] | None = None
    first = int(detector.zero_read)
    for group in range(n_groups):
        charge += rng.poisson(expected) if detector.photon_noise else expected
        if detector.cosmic_rays_s > 0.0:
            _add_hits(charge, detector, rng)
        reads[first + group] += measured_signal(charge, detector)
        n_good = _count_good(n_good, charge, detector.full_well_e, first + group)
    return Ramps(linearised(reads, detector), n_good)


def measured_signal(charge: FloatArray, detector: Detector) -> FloatArray:
    """Signal that collected charge (n_int, ny, nx) gives at a read, without its noise."""
    signal = charge
    if detector.migration > 0.0:
        excess = np.maximum(charge - detector.migration_threshold_e, 0.0) * detector.migration
        signal = signal - excess + to_neighbours(excess, 0.25)
    if charge.max() > detector.full_well_e:
        signal = np.minimum(signal, detector.full_well_e)
    if detector.interpixel_capacitance > 0.0:
        kept = 1.0 - 4.0 * detector.interpixel_capacitance
        signal = kept * signal + to_neighbours(signal, detector.interpixel_capacitance)
    if detector.nonlinearity > 0.0:
        signal = signal * (1.0 - detector.nonlinearity / detector.full_well_e * signal)
    return signal


def linearised(reads: FloatArray, detector: Detector) -> FloatArray:
    """Undo the nonlinearity, as well as it is known."""
    if detector.nonlinearity == 0.0:
        return reads
    bend = detector.nonlinearity * (1.0 + detector.linearity_error) / detector.full_well_e
    # the root of q (1 - bend q) = reads that is the identity for small signals
    return np.asarray(2.0 * reads / (1.0 + np.sqrt(np.maximum(1.0 - 4.0 * bend * reads, 0.0))))


def to_neighbours(charge: FloatArray, fraction: float) -> FloatArray:
    """What each pixel (…, ny, nx) receives when each gives ``fraction`` to its four neighbours.

    What leaves the array is lost.
    """
    given = charge * fraction
    received = np.zeros_like(given)
    received[..., 1:, :] += given[..., :-1, :]
    received[..., :-1, :] += given[..., 1:, :]
    received[..., :, 1:] += given[..., :, :-1]
    received[..., :, :-1] += given[..., :, 1:]
    return received


def _add_hits(charge: FloatArray, detector: Detector, rng: np.random.Generator) -> None:
    """Add the cosmic rays of one group, in place."""
    mean = detector.cosmic_rays_s * detector.frame_time_s * charge.size
    n_int, ny, nx = charge.shape
    n = rng.poisson(mean)
    place = [rng.integers(0, length, n) for length in (n_int, ny, nx)]
    energy = rng.exponential(detector.cosmic_ray_charge_e, n)
    if n > 0:
        hits = np.zeros_like(charge)
        np.add.at(hits, tuple(place), energy)
        charge += (1.0 - 4.0 * TO_NEIGHBOURS) * hits + to_neighbours(hits, TO_NEIGHBOURS)


def _count_good(
    n_good: NDArray[np.int16] | None, charge: FloatArray, full_well_e: float, read: int
) -> NDArray[np.int16] | None:
    """Count reads below full well; ``read`` is the number of the present one."""
    below = charge < full_well_e
    if n_good is None and below.all():
        return None
    if n_good is None:
        n_good = np.full(charge.shape, read, np.int16)
    n_good[below & (n_good == read)] += 1
    return n_good
