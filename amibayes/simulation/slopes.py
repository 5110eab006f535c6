"""From reads to one rate per pixel: optimal weights, saturated ramps, cosmic rays.

The differences of successive reads share read noise with their neighbours: their
covariance is F·I + σ²·L, with F the electrons per frame, σ the noise of a read and L the
tridiagonal (−1, 2, −1). L is diagonal on sines, so the generalised least-squares weights
C⁻¹1 / (1ᵀC⁻¹1) of all pixels are two matrix products.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from amibayes.cube import DO_NOT_USE, JUMP_DET, SATURATED
from amibayes.simulation.detector import Detector, DetectorMaps
from amibayes.simulation.ramps import Ramps, to_neighbours
from amibayes.units import FloatArray

JUMP_SIGMA = 5.0
"""A difference so far above the others is a cosmic ray's."""

_LEAST_VARIANCE = 1e-6
"""Electrons²: a pixel without light and read noise still has weights."""


@dataclass(frozen=True, eq=False)
class SlopeWeights:
    """Linear estimate of the rate of each pixel.

    Parameters
    ----------
    increments : (n_increments, ny, nx) array
        Weights of the differences of successive reads, which give electrons per second.
    variance : (ny, nx) array
        Variance of the estimate, photon and read noise.
    """

    increments: FloatArray
    variance: FloatArray

    @property
    def reads(self) -> FloatArray:
        """(n_reads, ny, nx) weights of the reads themselves."""
        padded = np.pad(self.increments, [(1, 1), (0, 0), (0, 0)])
        return np.asarray(padded[:-1] - padded[1:])


def slope_weights(electrons: FloatArray, n_increments: int, detector: Detector) -> SlopeWeights:
    """Weights that minimise the variance of the rate.

    Parameters
    ----------
    electrons : (ny, nx) array
        Variance of the charge of one frame (its mean, but for inter-pixel capacitance).
    n_increments : int
        Differences of successive reads.
    detector : Detector
        Its read noise and frame time.

    Returns
    -------
    SlopeWeights
    """
    m = n_increments
    order = np.arange(1, m + 1)
    sines = np.sqrt(2.0 / (m + 1)) * np.sin(np.pi * np.outer(order, order) / (m + 1))
    eigenvalues = 2.0 - 2.0 * np.cos(np.pi * order / (m + 1))
    noise = detector.single_read_noise_e**2
    spectrum = electrons.reshape(1, -1) + noise * eigenvalues[:, None]
    solved = sines @ (sines.sum(axis=0)[:, None] / np.maximum(spectrum, _LEAST_VARIANCE))
    total = solved.sum(axis=0)
    weights = (solved / total / detector.frame_time_s).reshape(m, *electrons.shape)
    return SlopeWeights(weights, (1.0 / total / detector.frame_time_s**2).reshape(electrons.shape))


@dataclass(frozen=True, eq=False)
class Slopes:
    """Rates of some integrations, with errors and flags, each (n_int, ny, nx).

    ``jump`` is the number of the first read with a cosmic ray, 0 where none was found; None
    where none was looked for.
    """

    images: FloatArray
    variance: FloatArray
    dq: NDArray[np.uint32]
    jump: NDArray[np.int16] | None = None


class SlopeFit:
    """The slope fit of one exposure.

    The weights and errors come from the expected image, not from each noisy ramp: weights
    that follow the noise bias the rate.

    Parameters
    ----------
    rate_e_s : (ny, nx) array
        Expected light.
    detector : Detector
        Its noise.
    maps : DetectorMaps
        Sensitivity, flat-field errors and bad pixels.
    n_groups : int
        Groups of a ramp.
    """

    def __init__(
        self, rate_e_s: FloatArray, detector: Detector, maps: DetectorMaps, n_groups: int
    ) -> None:
        self._detector = detector
        self._maps = maps
        self._n = detector.n_reads(n_groups) - 1
        self._electrons = electron_variance(rate_e_s, detector)
        self.weights = slope_weights(self._electrons, self._n, detector)
        self._read_weights = self.weights.reads

    def __call__(self, ramps: Ramps) -> Slopes:
        """Fit ramps."""
        images = np.einsum("knyx,kyx->nyx", ramps.reads, self._read_weights)
        slopes = Slopes(
            images,
            np.broadcast_to(self.weights.variance, images.shape).copy(),
            np.zeros(images.shape, np.uint32),
        )
        if ramps.n_good is not None:
            self._refit_saturated(slopes, ramps.reads, ramps.n_good)
        if self._detector.cosmic_rays_s > 0.0 and self._n > 1:
            slopes = replace(slopes, jump=self._refit_jumps(slopes, ramps))
        return self._flattened(slopes)

    def _refit_saturated(
        self, slopes: Slopes, reads: FloatArray, n_good: NDArray[np.int16]
    ) -> None:
        """Fit saturated ramps again, each with the reads it has."""
        for good in np.unique(n_good[n_good <= self._n]):
            where = n_good == good
            slopes.dq[where] |= SATURATED
            if good < 2:
                slopes.dq[where] |= DO_NOT_USE
                slopes.images[where] = np.nan
                slopes.variance[where] = np.nan
                continue
            electrons = np.broadcast_to(self._electrons, where.shape)[where]
            weights = slope_weights(electrons[None], int(good) - 1, self._detector)
            slopes.images[where] = np.sum(weights.reads[:, 0] * reads[:good, where], axis=0)
            slopes.variance[where] = weights.variance[0]

    def _refit_jumps(self, slopes: Slopes, ramps: Ramps) -> NDArray[np.int16]:
        """Find cosmic rays and fit their ramps without the difference that they are in.

        Gives the `Slopes.jump` of these ramps.
        """
        steps = np.diff(ramps.reads, axis=0)
        highest = steps.max(axis=0)
        others = (steps.sum(axis=0) - highest) / (self._n - 1)
        noise = self._electrons + 2.0 * self._detector.single_read_noise_e**2
        sigma = np.sqrt(noise * (1.0 + 1.0 / (self._n - 1)))
        hit = highest - others > JUMP_SIGMA * sigma
        if ramps.n_good is not None:
            hit &= ramps.n_good > self._n
        electrons = np.broadcast_to(self._electrons, hit.shape)[hit]
        slopes.images[hit], slopes.variance[hit] = _without_highest(
            steps[:, hit], electrons, self._detector
        )
        slopes.dq[hit] |= JUMP_DET
        jump = np.zeros(hit.shape, np.int16)
        jump[hit] = steps[:, hit].argmax(axis=0) + 1
        return jump

    def _flattened(self, slopes: Slopes) -> Slopes:
        """Divide by the flat field and mark the bad pixels."""
        flat = self._maps.flat * self._maps.sensitivity
        images, variance = slopes.images / flat, slopes.variance / flat**2
        images[:, self._maps.dead] = np.nan
        images[:, self._maps.hot] += self._detector.full_well_e
        slopes.dq[:] |= self._maps.dq
        return replace(slopes, images=images, variance=variance)


def group_flags(ramps: Ramps, slopes: Slopes) -> NDArray[np.uint8]:
    """Flags of the reads that slopes were fitted without, as JWST's GROUPDQ has them.

    Parameters
    ----------
    ramps : Ramps
    slopes : Slopes
        Of these ramps.

    Returns
    -------
    (n_int, n_reads, ny, nx) uint8 array
        SATURATED from the first read at full well on, and JUMP_DET at the read whose difference
        from the one before has a cosmic ray. Pixels that are bad in all ramps are not in it.
    """
    n_reads, n_int, ny, nx = ramps.reads.shape
    flags = np.zeros((n_int, n_reads, ny, nx), np.uint8)
    if ramps.n_good is not None:
        number = np.arange(n_reads)[:, None, None]
        flags[number >= ramps.n_good[:, None]] |= SATURATED
    if slopes.jump is not None:
        integration, y, x = np.nonzero(slopes.jump)
        flags[integration, slopes.jump[integration, y, x], y, x] |= JUMP_DET
    return flags


def electron_variance(rate_e_s: FloatArray, detector: Detector) -> FloatArray:
    """(ny, nx) variance of the signal of one frame, from light, dark and background.

    Inter-pixel capacitance averages the noise of neighbours: its squared kernel acts.
    """
    rate = rate_e_s + detector.dark_e_s + detector.background_e_s
    electrons = rate * detector.frame_time_s
    if not detector.photon_noise:
        return np.zeros_like(electrons)
    alpha = detector.interpixel_capacitance
    return (1.0 - 4.0 * alpha) ** 2 * electrons + to_neighbours(electrons, alpha**2)


def _without_highest(
    steps: FloatArray, electrons: FloatArray, detector: Detector
) -> tuple[FloatArray, FloatArray]:
    """Fit the (n_increments, n) steps of n ramps, each without its highest one.

    The highest gets a variance so large that it has no weight, which leaves the others the
    covariance that they have among themselves.
    """
    m, n = steps.shape
    noise = detector.single_read_noise_e**2
    laplacian = 2.0 * np.eye(m) - np.eye(m, k=1) - np.eye(m, k=-1)
    covariance = noise * laplacian + np.maximum(electrons, _LEAST_VARIANCE)[:, None, None] * np.eye(
        m
    )
    worst = steps.argmax(axis=0)
    covariance[np.arange(n), worst, worst] += 1e12
    solved = np.linalg.solve(covariance, np.ones((n, m, 1)))[..., 0]
    total = solved.sum(axis=1)
    rate = np.sum(solved * steps.T, axis=1) / total / detector.frame_time_s
    return rate, 1.0 / total / detector.frame_time_s**2
