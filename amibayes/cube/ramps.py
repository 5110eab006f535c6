"""Ramps (``*_ramp.fits``, 4-D, linear, jumps flagged) read as slope images.

Differences of successive groups share a read: their covariance is tridiagonal, photons and
twice the read noise on the diagonal, minus the read noise beside it. The slope is their
weighted mean by the inverse of that covariance; a difference across a jump, or of a saturated
group, is left out. The variance of the photons is that of the mean ramp of all integrations,
not of the noisy pixel itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.cube.container import DO_NOT_USE, JUMP_DET, NO_LIGHT, SATURATED, Cube, flag_bits
from amibayes.cube.reference_files import Linearity, as_read
from amibayes.cube.timing import GroupTiming
from amibayes.errors import DataError
from amibayes.support.fits_errors import reporting_damage
from amibayes.units import BoolArray, FloatArray, IntArray, SingleArray

GAIN_E_DN = 1.61
"""Electrons per DN of NIRISS (1.61 to 1.62)."""

LEFT_OUT = 1e6
"""A difference counts for nothing where its variance is so many times the largest."""

SAMPLE = 64
"""Integrations that the mean ramp and the read noise are taken from."""

CORRELATED, OF_MEDIAN = 1.5, 1.57
"""What a variance is worse known by: differences that share a read are correlated by −1/2, which
makes the variance of their mean square 1 + 2/4 times as large; π/2 of a median."""

FEW, TRIALS = 16, 20_000
"""Integrations below which the median of variances differs from their mean by 0.2 % or more, and
draws that tell by how much."""


@dataclass(frozen=True, eq=False)
class Differences:
    """Differences of successive groups of some integrations.

    Parameters
    ----------
    values : (n, m, ny, nx) array
        In the file's unit; 0 where they may not be used.
    good : (n, m, ny, nx) bool array
        Those that may be used.
    flags : (n, ny, nx) uint32 array
        SATURATED or JUMP_DET where a group has that flag; JUMP_DET where one is no number.
    """

    values: SingleArray
    good: BoolArray
    flags: NDArray[np.uint32]


@dataclass(frozen=True, eq=False)
class RampFile:
    """An open file of ramps that is read as slopes, a few integrations at a time.

    Parameters
    ----------
    template : Cube
        Everything but the images.
    n_integrations : int
    hdus : mapping
        SCI (n_int, n_groups, ny, nx) and, where the file has them, GROUPDQ and PIXELDQ.
    mjd : (n_int,) array, optional
    timing : GroupTiming
    bias_dn : (ny, nx) array, optional
        Counts that were taken off (the superbias), where that file is at hand.
    linearity : Linearity, optional
        What made the signal linear, where that file is at hand.
    excess_dn : (65536,) array, optional
        Counts too many for every number of counts, bias included: taken off what is read.
    """

    template: Cube
    n_integrations: int
    hdus: dict[str, Any]
    mjd: FloatArray | None
    timing: GroupTiming
    bias_dn: FloatArray | None = None
    linearity: Linearity | None = None
    excess_dn: FloatArray | None = field(default=None, repr=False)

    def read(self, start: int = 0, stop: int | None = None) -> Cube:
        """Fit the slopes of the integrations from ``start`` up to ``stop``."""
        return self.read_with_time(start, stop)[0]

    def read_with_time(self, start: int, stop: int | None) -> tuple[Cube, FloatArray]:
        """As `read`, and the mean time (n, ny, nx) from the reset that each slope is of, s."""
        part = slice(start, self.n_integrations if stop is None else stop)
        if part.start >= part.stop:
            return self.template, np.zeros(self.template.images.shape)
        found = self.differences(part)
        slope, error, when = self._weights.slopes(found)
        dq = found.flags | self.pixel_flags
        dq[~found.good.any(axis=1)] |= DO_NOT_USE
        time = self.timing.group_s
        mjd = None if self.mjd is None else self.mjd[part]
        cube = replace(self.template, images=slope / time, error=error / time, dq=dq, mjd=mjd)
        return cube, when

    def chunks(self, size: int = 64) -> Iterator[Cube]:
        """Read everything, ``size`` integrations at a time."""
        for start in range(0, self.n_integrations, size):
            yield self.read(start, min(start + size, self.n_integrations))

    @property
    def gain_e(self) -> float:
        """Electrons of the file's unit."""
        return 1.0 if "electron" in self.template.unit.lower() else GAIN_E_DN

    def differences(self, part: slice) -> Differences:
        """Differences of groups of the integrations of a slice."""
        with reporting_damage(self.template.source):
            # Single precision, as the files have: its rounding is far below the noise of a read.
            groups = np.asarray(self.hdus["SCI"].section[part], dtype=np.float32)
            flags = self.hdus.get("GROUPDQ")
            dq = None if flags is None else np.asarray(flags.section[part])
        good = np.isfinite(groups)
        flagged = np.where(good.all(axis=1), 0, JUMP_DET).astype(np.uint32)
        groups = self._true(groups)
        steps = groups[:, 1:] - groups[:, :-1]
        used = good[:, 1:] & good[:, :-1]
        if dq is not None and dq.any():
            good = (dq & (DO_NOT_USE | SATURATED)) == 0
            used &= good[:, 1:] & good[:, :-1] & ((dq[:, 1:] & JUMP_DET) == 0)
            flagged |= np.bitwise_or.reduce(dq, axis=1) & np.uint32(JUMP_DET | SATURATED)
        if not used.all():
            steps[~used] = 0.0
        return Differences(steps, used, flagged)

    def _true(self, groups: SingleArray) -> SingleArray:
        """Take off what the converter gave too much of, where that is known."""
        if self.excess_dn is None or self.bias_dn is None:
            return groups
        unit = np.float32(GAIN_E_DN / self.gain_e)
        signal, slope = as_read(np.nan_to_num(groups) / unit, self.linearity)
        number = np.clip(np.rint(signal + self.bias_dn), 0, len(self.excess_dn) - 1).astype(np.intp)
        return np.asarray(groups - unit * slope * self.excess_dn.astype(np.float32)[number])

    @cached_property
    def pixel_flags(self) -> Any:
        """Data quality flags (ny, nx) that hold for all integrations, or 0."""
        flags = self.hdus.get("PIXELDQ")
        if flags is None:
            return np.uint32(0)
        return np.asarray(flags.section[:, :]).astype(np.uint32)

    @property
    def _never_used(self) -> BoolArray:
        """Pixels (ny, nx) that are used in no integration."""
        flags = np.broadcast_to(self.pixel_flags, self.template.images.shape[1:])
        return np.asarray((flags & np.uint32(flag_bits(self.template.bad_flags))) != 0)

    @cached_property
    def noise(self) -> tuple[FloatArray, float]:
        """Photon variance of a difference (ny, nx), and read variance of one group, in units².

        The unit's gain tells what photons make of the mean ramp; what is left of the scatter
        of faint pixels is the reads'.
        """
        found = self.differences(slice(0, min(self.n_integrations, SAMPLE)))
        difference, good = found.values, found.good
        count = np.maximum(good.sum(axis=(0, 1)), 1)
        mean = difference.sum(axis=(0, 1), dtype=float) / count
        used = mean[(count > 1) & ~self._never_used]
        if not used.size or not np.ptp(used) > 0.0:
            raise DataError(NO_LIGHT, source=self.template.source)
        photons = np.maximum(mean, 0.0) / self.gain_e
        off = np.where(good, difference - mean, 0.0)
        # Differences of a ramp add up to its ends: their mean takes a part of one of them.
        m = self.timing.n_differences
        variance = (off**2).sum(axis=(0, 1), dtype=float) / np.maximum(count - 1.0 / m, 1.0)
        faint = (mean <= np.median(mean)) & (count > 1)
        spare = variance / median_of_variance(len(difference), m)
        spare -= photons * float(np.diag(self.timing.photon_covariance).mean())
        read = 0.5 * float(np.median(spare[faint]))
        return photons, max(read, 1e-6 * float(np.median(variance[faint])), 1e-12)

    @property
    def noise_degrees(self) -> float:
        """Degrees of freedom that the variance of a read is known with."""
        n = min(self.n_integrations, SAMPLE) * self.timing.n_differences
        faint = 0.5 * self.template.images.shape[1] * self.template.images.shape[2]
        return float(n * faint / (CORRELATED * OF_MEDIAN))

    @cached_property
    def _weights(self) -> SlopeWeights:
        return SlopeWeights.of(*self.noise, self.timing)


def median_of_variance(n: int, m: int) -> float:
    """Median of the mean square of m differences of n ramps of read noise, in units of its mean.

    Sums of squares of differences that share reads are those of independent numbers of
    variances 2 − 2 cos(πk/(m + 1)).
    """
    if n >= FEW:
        return 1.0
    values = 2.0 - 2.0 * np.cos(np.pi * np.arange(1, m + 1) / (m + 1))
    drawn = np.random.default_rng(0).chisquare(n, (TRIALS, m)) @ values
    return float(np.median(drawn) / (n * values.sum()))


@dataclass(frozen=True, eq=False)
class SlopeWeights:
    """Generalised least squares of the slope of every pixel.

    Parameters
    ----------
    covariance : (n_pixels, m, m) array
        Of the differences of a ramp.
    weight : (n_pixels, m) array
        Rows of 1ᵀC⁻¹: what each difference counts.
    middle_s : (m,) array
        Times of the differences.
    """

    covariance: FloatArray
    weight: FloatArray
    middle_s: FloatArray

    @classmethod
    def of(cls, photons: FloatArray, read: float, timing: GroupTiming) -> SlopeWeights:
        """Weights for a photon variance (ny, nx) of a difference and that of a group's read."""
        by_photons = photons.reshape(-1, 1, 1) * timing.photon_covariance
        covariance = by_photons + read * timing.read_covariance
        return cls(covariance, np.linalg.inv(covariance).sum(axis=1), timing.middle_s)

    def slopes(self, found: Differences) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Slopes of ramps, their standard deviations, and the mean times that they are of.

        Returns
        -------
        slope, error, time : (n, ny, nx) arrays
            Per group; 0, infinite and 0 where no difference may be used.
        """
        n, m, ny, nx = found.values.shape
        good = found.good.reshape(n, m, -1)
        weight = self.weight.T
        total = np.broadcast_to(weight.sum(axis=0), (n, ny * nx)).copy()
        slope = np.zeros((n, ny * nx))
        for k in range(m):
            slope += found.values.reshape(n, m, -1)[:, k] * weight[k]
        time = np.broadcast_to(self.middle_s @ weight, (n, ny * nx)).copy()
        some = ~good.all(axis=1)
        if some.any():
            number, pixel = np.nonzero(some)
            own = self._cut(good[number, :, pixel], pixel)
            total[some], time[some] = own.sum(axis=1), own @ self.middle_s
            slope[some] = (own * found.values.reshape(n, m, -1)[number, :, pixel]).sum(axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            lit = total > 0.0
            slope, time = (np.where(lit, x / total, 0.0) for x in (slope, time))
            error = np.where(lit, 1.0 / np.sqrt(total), np.inf)
        shape = (n, ny, nx)
        return slope.reshape(shape), error.reshape(shape), time.reshape(shape)

    def _cut(self, used: BoolArray, pixel: IntArray) -> FloatArray:
        """Weights (k, m) of some ramps of which only the differences ``used`` (k, m) count."""
        covariance = self.covariance[pixel]
        large = LEFT_OUT * np.einsum("kmm->km", covariance).max(axis=1)[:, None]
        none = np.where(used, 0.0, large)
        cut = covariance + none[:, :, None] * np.eye(used.shape[1])
        return np.where(used, np.linalg.inv(cut).sum(axis=1), 0.0)
