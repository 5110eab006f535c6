"""Errors of the analogue-to-digital converter: waves in the counts, bias included.

A converter whose steps are not of equal width gives counts that are off by a function of the
counts, x (s sin + c cos)(2πx/p): for JWST's detectors p is 1024 counts, with a little at its half
and third. What ramps are given as has the bias of the pixel taken off, which pixels differ in by
hundreds of counts; only with the bias known (the superbias reference file) do all pixels share
one phase, and six numbers describe what each of them does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.cube.reference_files import Linearity, as_read
from amibayes.cube.timing import GroupTiming
from amibayes.units import FloatArray, IntArray, read_only

PERIOD_DN = 1024.0
"""Of the longest wave, counts."""

HARMONICS = (1, 2, 3)

WAVES = tuple(f"{name} {PERIOD_DN / h:.0f}" for h in HARMONICS for name in ("sine", "cosine"))
"""Amplitudes, counts per count; of the order of 1e-4."""

WAVE_PRIOR = (3e-4, 3e-4, 2e-5, 2e-5, 2e-5, 2e-5)
"""Standard deviations before any ramp: three times what JWST's detectors have of each."""

TOP_DN = 65536
"""Counts that a converter of 16 bits can give."""


def waves(counts: FloatArray) -> FloatArray:
    """Counts too many, (len(WAVES), …), by an amplitude of 1, at true counts with the bias."""
    first = np.exp(2j * np.pi / PERIOD_DN * counts)
    powers = [first, first * first, first * first * first]
    return np.stack([-counts * part for w in powers for part in (w.imag, w.real)])


def table(amplitudes: FloatArray) -> FloatArray:
    """Counts to take off (65536,) for each that was read."""
    read = np.arange(TOP_DN, dtype=float)
    off = np.zeros(TOP_DN)
    # Amplitudes of 1e-4 change over counts by less than 0.02: each round is better by that.
    for _ in range(3):
        off = np.tensordot(amplitudes, waves(read - off), axes=1)
    return np.asarray(off)


@dataclass(frozen=True, eq=False)
class WaveColumns:
    """What amplitudes of 1 make of the mean ramps of an exposure.

    Parameters
    ----------
    current, change : (len(WAVES), ny, nx) arrays
        Electrons per second, and per second squared.
    departure : (len(WAVES), k, ny, nx) array
        Of each difference from `current`.
    normal : (len(WAVES), len(WAVES)) array
        Normal equations by the bends of ramps alone, a linear change left free.
    right : (len(WAVES),) array
    """

    current: FloatArray
    change: FloatArray
    departure: FloatArray
    normal: FloatArray
    right: FloatArray

    def __post_init__(self) -> None:
        read_only(self, "current", "change", "departure", "normal", "right")


@dataclass(frozen=True, eq=False)
class Predictor:
    """Waves in the differences of ramps whose light is known but for its noise.

    The counts are those that the fitted current predicts: with the counts that were read their
    noise would be fitted to itself. What noise moves the true counts by blurs the waves.

    Parameters
    ----------
    bias_dn : (ny, nx) array
    linearity : Linearity, optional
        What made the signal linear after it was read; the counts are those before.
    gain_e : float
        Electrons per count.
    timing : GroupTiming
    kept : (k,) int array
        Differences that are used.
    spread_dn2 : (n_groups, ny, nx) array
        Variance of the true counts about the predicted.
    """

    bias_dn: FloatArray
    linearity: Linearity | None
    gain_e: float
    timing: GroupTiming
    kept: IntArray
    spread_dn2: FloatArray

    def __call__(self, light: FloatArray) -> FloatArray:
        """Sum over integrations (n, ny, nx), in e⁻/s, of the currents (len(WAVES), k, ny, nx)."""
        times = self.timing.read_s
        shape = (len(WAVES), len(times), *self.bias_dn.shape)
        total = np.zeros(shape)
        for one in light:
            for group, frames in enumerate(times):
                for t in frames:
                    signal, slope = as_read(one * (t / self.gain_e), self.linearity)
                    total[:, group] += slope * waves(self.bias_dn + signal)
        total *= self._left
        steps = np.diff(total, axis=1)[:, self.kept]
        return np.asarray(steps * (self.gain_e / (self.timing.group_s * times.shape[1])))

    @property
    def _left(self) -> FloatArray:
        """Share of each wave that noise leaves, (len(WAVES), n_groups, ny, nx)."""
        turn = 2.0 * np.pi / PERIOD_DN * np.repeat(HARMONICS, 2)
        return np.exp(-0.5 * turn[:, None, None, None] ** 2 * self.spread_dn2)


def spread_of(
    timing: GroupTiming, kept: IntArray, current_weight: FloatArray, photons_s: FloatArray,
    read_e2: float,
) -> FloatArray:  # fmt: skip
    """Variance (n_groups, n_pixels) of the charge about that of the fitted current, electrons².

    Parameters
    ----------
    timing : GroupTiming
    kept : (k,) int array
    current_weight : (k, n_pixels) array
        Of each difference (e⁻/s) in the fitted current.
    photons_s : (n_pixels,) array
        Electrons per second.
    read_e2 : float
        Variance of a group's reads.
    """
    time = timing.read_s.mean(axis=1)
    between = np.minimum.outer(time, time)
    step = (np.eye(len(time) - 1, len(time), 1) - np.eye(len(time) - 1, len(time)))[kept]
    weight = current_weight.T @ step / timing.group_s
    moved = photons_s[:, None] * (weight @ between) + read_e2 * weight
    whole = np.einsum("pg,pg->p", moved, weight)
    own = photons_s[:, None] * time + read_e2
    spread = own - 2.0 * time * moved + time**2 * whole[:, None]
    return np.asarray(np.maximum(spread, 0.0).T)
