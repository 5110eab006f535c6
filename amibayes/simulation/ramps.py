"""From the rate of light to the reads of each ramp."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from amibayes.cube.ramps import GAIN_E_DN
from amibayes.ramps.transfer import SIDES, gains
from amibayes.simulation.detector import BIAS_DN, Detector
from amibayes.units import FloatArray

TO_NEIGHBOURS = 0.05
"""Fraction of a cosmic ray's charge that ends up in each of the four neighbours."""


ADC_WAVES = (
    (1024.0, 124.34e-6, -6.41e-6),
    (512.0, -2.78e-6, 4.83e-6),
    (1024.0 / 3.0, -0.64e-6, 4.13e-6),
)
"""Periods in counts, and amplitudes of sine and cosine, of the readout of JWST's detectors."""


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
    rate_e_s: FloatArray,
    detector: Detector,
    n_groups: int,
    rng: np.random.Generator,
    bias_dn: FloatArray | float = BIAS_DN,
) -> Ramps:
    """Simulate the ramps of some integrations.

    Parameters
    ----------
    rate_e_s : (n_int, ny, nx) array, or (n_groups, n_int, ny, nx)
        Electrons per second that light makes in each pixel, in every frame where it changes.
    detector : Detector
        What happens to them.
    n_groups : int
        Groups (frames) of a ramp.
    rng : numpy Generator
        Of these integrations.
    bias_dn : (ny, nx) array, or float
        Counts of pixels after the reset.

    Returns
    -------
    Ramps
    """
    expected = (rate_e_s + (detector.dark_e_s + detector.background_e_s)) * detector.frame_time_s
    frames = np.broadcast_to(expected, (n_groups, *expected.shape[-3:]))
    reads = np.empty((detector.n_reads(n_groups), *frames.shape[1:]))
    rng.standard_normal(out=reads)
    reads *= detector.single_read_noise_e
    if detector.stripe_noise_e > 0.0:
        reads += striped(reads.shape, detector.stripe_noise_e, rng.spawn(1)[0])
    charge = np.zeros(frames.shape[1:])
    n_good: NDArray[np.int16] | None = None
    first = int(detector.zero_read)
    for group in range(n_groups):
        light = collected(charge, frames[group], detector)
        charge += rng.poisson(light) if detector.photon_noise else light
        if detector.cosmic_rays_s > 0.0:
            _add_hits(charge, detector, rng)
        reads[first + group] += measured_signal(charge, detector)
        n_good = _count_good(n_good, charge, detector.full_well_e, first + group)
    return Ramps(linearised(converted(reads, detector, bias_dn), detector), n_good)


def converted(
    reads: FloatArray, detector: Detector, bias_dn: FloatArray | float = BIAS_DN
) -> FloatArray:
    """Reads as the analogue-to-digital converter gives them, bias taken off, in electrons.

    Counts x become x/(1 + Σ(s sin + c cos)(2πx/p)); what a bias frame shows of it is taken off.
    """
    if detector.adc_nonlinearity == 0.0:
        return reads
    off = detector.adc_nonlinearity * GAIN_E_DN
    return np.asarray(reads + off * (_adc_error(reads / GAIN_E_DN + bias_dn) - _adc_error(bias_dn)))


def _adc_error(counts: FloatArray | float) -> FloatArray:
    """Counts that the converter gives too many, to first order of what is 1e-4."""
    waves = (
        s * np.sin(2.0 * np.pi * counts / period) + c * np.cos(2.0 * np.pi * counts / period)
        for period, s, c in ADC_WAVES
    )
    return np.asarray(-counts * sum(waves))


def collected(charge: FloatArray, light: FloatArray, detector: Detector) -> FloatArray:
    """Electrons that pixels collect in a frame, their boundaries moved by what they hold.

    Parameters
    ----------
    charge : (n_int, ny, nx) array
        At the start of the frame.
    light : (n_int, ny, nx) array
        Electrons that the frame's light makes in pixels of equal size.
    detector : Detector

    Returns
    -------
    (n_int, ny, nx) array
        Of the same sum.
    """
    strength = (detector.boundary_shift_x, detector.boundary_shift_y)
    if not any(strength):
        return light
    # Boundaries where they are half-way through the frame: exact to second order in time.
    gained = gains(SIDES, charge + 0.5 * light, light)
    return np.maximum(light + np.tensordot(strength, gained, axes=1), 0.0)


def striped(shape: tuple[int, ...], noise_e: float, rng: np.random.Generator) -> FloatArray:
    """Noise of reads (n_reads, n_int, 1, nx) that columns share, its power 1/f across them.

    Parameters
    ----------
    shape : (n_reads, n_int, ny, nx)
    noise_e : float
        Standard deviation, that of what all columns share included.
    rng : numpy Generator
    """
    n = shape[-1]
    # Twice as long as the image is wide: the ends of a Fourier series are neighbours.
    frequency = np.fft.rfftfreq(2 * n)
    amplitude = 1.0 / np.sqrt(np.maximum(frequency, frequency[1]))
    white = np.fft.rfft(rng.standard_normal((*shape[:2], 1, 2 * n)))
    # Of unit white noise every frequency but the first and last counts twice in the variance.
    power = (2.0 * (amplitude**2).sum() - amplitude[0] ** 2 - amplitude[-1] ** 2) / (2 * n)
    series = np.fft.irfft(white * amplitude / np.sqrt(power), 2 * n)[..., :n]
    return np.asarray(noise_e * series)


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


def linearity_coefficients(detector: Detector, shape: tuple[int, int]) -> FloatArray:
    """Coefficients (7, ny, nx) of the powers of counts with which `linearised` undoes it.

    A power series, whose numbers are those of Catalan: of a pixel that lacks 5 % it leaves 4e-6.
    """
    bend = detector.nonlinearity * (1.0 + detector.linearity_error) / detector.full_well_e
    series = (0.0, *(c * (bend * GAIN_E_DN) ** k for k, c in enumerate((1, 1, 2, 5, 14, 42))))
    return np.asarray(np.broadcast_to(np.array(series)[:, None, None], (len(series), *shape)))


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
