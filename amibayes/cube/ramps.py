"""Ramps (``*_ramp.fits``, 4-D, linear, jumps flagged) read as slope images.

Differences of successive groups share a read: their covariance is tridiagonal, photons and
twice the read noise on the diagonal, minus the read noise beside it. The slope is their
weighted mean by the inverse of that covariance; a difference across a jump, or of a saturated
group, is left out. The variance of the photons is that of the mean ramp of all integrations,
not of the noisy pixel itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from amibayes.cube.container import DO_NOT_USE, JUMP_DET, SATURATED, Cube
from amibayes.support.fits_errors import reporting_damage
from amibayes.units import BoolArray, FloatArray

GAIN_E_DN = 1.61
"""Electrons per DN of NIRISS (1.61 to 1.62)."""

LEFT_OUT = 1e6
"""A difference counts for nothing where its variance is so many times the largest."""

SAMPLE = 64
"""Integrations that the mean ramp and the read noise are taken from."""


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
    group_time_s : float
    """

    template: Cube
    n_integrations: int
    hdus: dict[str, Any]
    mjd: FloatArray | None
    group_time_s: float

    def read(self, start: int = 0, stop: int | None = None) -> Cube:
        """Fit the slopes of the integrations from ``start`` up to ``stop``."""
        part = slice(start, self.n_integrations if stop is None else stop)
        if part.start >= part.stop:
            return self.template
        difference, good = self._differences(part)
        photons, read = self._noise
        slope, error = weighted_slopes(difference, good, photons, read)
        dq = np.zeros(slope.shape, dtype=np.uint32)
        dq |= self._pixel_flags
        dq[~good.any(axis=1)] |= DO_NOT_USE
        dq[~good.all(axis=1)] |= JUMP_DET
        time = self.group_time_s
        mjd = None if self.mjd is None else self.mjd[part]
        return replace(self.template, images=slope / time, error=error / time, dq=dq, mjd=mjd)

    def chunks(self, size: int = 64) -> Iterator[Cube]:
        """Read everything, ``size`` integrations at a time."""
        for start in range(0, self.n_integrations, size):
            yield self.read(start, min(start + size, self.n_integrations))

    def _differences(self, part: slice) -> tuple[FloatArray, BoolArray]:
        """Differences of groups (n, n_groups − 1, ny, nx), and which may be used."""
        with reporting_damage(self.template.source):
            groups = np.asarray(self.hdus["SCI"].section[part], dtype=float)
            flags = self.hdus.get("GROUPDQ")
            dq = None if flags is None else np.asarray(flags.section[part]).astype(np.int64)
        good = np.isfinite(groups)
        cut = np.zeros(groups.shape, dtype=bool)
        if dq is not None:
            good &= (dq & (DO_NOT_USE | SATURATED)) == 0
            cut = (dq & JUMP_DET) > 0
        used = good[:, 1:] & good[:, :-1] & ~cut[:, 1:]
        return np.where(used, np.diff(np.nan_to_num(groups), axis=1), 0.0), used

    @cached_property
    def _pixel_flags(self) -> Any:
        flags = self.hdus.get("PIXELDQ")
        if flags is None:
            return np.uint32(0)
        return np.asarray(flags.section[:, :]).astype(np.uint32)

    @cached_property
    def _noise(self) -> tuple[FloatArray, float]:
        """Photon variance of a difference (ny, nx), and read variance of one group, in units².

        The unit's gain tells what photons make of the mean ramp; what is left of the scatter
        of faint pixels is the reads'.
        """
        n = self.n_integrations
        difference, good = self._differences(slice(0, min(n, SAMPLE)))
        count = np.maximum(good.sum(axis=(0, 1)), 1)
        mean = difference.sum(axis=(0, 1)) / count
        gain = 1.0 if "electron" in self.template.unit.lower() else GAIN_E_DN
        photons = np.maximum(mean, 0.0) / gain
        off = np.where(good, difference - mean, 0.0)
        variance = (off**2).sum(axis=(0, 1)) / np.maximum(count - 1, 1)
        faint = mean <= np.median(mean)
        read = 0.5 * float(np.median((variance - photons)[faint & (count > 1)]))
        return photons, max(read, 1e-6 * float(np.median(variance[faint])), 1e-12)


def weighted_slopes(
    difference: FloatArray, good: BoolArray, photons: FloatArray, read: float
) -> tuple[FloatArray, FloatArray]:
    """Slopes of ramps by generalised least squares, and their standard deviations.

    Parameters
    ----------
    difference : (n, m, ny, nx) array
        Of successive groups.
    good : (n, m, ny, nx) bool array
        Those that may be used.
    photons : (ny, nx) array
        Photon variance of one difference.
    read : float
        Variance of one group's read noise.

    Returns
    -------
    slope, error : (n, ny, nx) arrays
        Per group; 0 and infinite where no difference may be used.
    """
    n, m, ny, nx = difference.shape
    covariance = _tridiagonal(photons.ravel(), read, m)
    whole = np.linalg.inv(covariance).sum(axis=1)  # rows of 1ᵀC⁻¹, (pixels, m)
    weight = np.broadcast_to(whole, (n, ny * nx, m)).copy()
    used = good.reshape(n, m, -1).swapaxes(1, 2)
    some = ~used.all(axis=2)
    if some.any():
        pixel = np.nonzero(some)[1]
        cut = covariance[pixel] + np.einsum(
            "pk,kl->pkl", np.where(used[some], 0.0, LEFT_OUT * covariance[pixel, 0, :1]), np.eye(m)
        )
        weight[some] = np.where(used[some], np.linalg.inv(cut).sum(axis=1), 0.0)
    total = weight.sum(axis=2)
    data = difference.reshape(n, m, -1).swapaxes(1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(total > 0.0, (weight * data).sum(axis=2) / total, 0.0)
        error = np.where(total > 0.0, 1.0 / np.sqrt(total), np.inf)
    return slope.reshape(n, ny, nx), error.reshape(n, ny, nx)


def _tridiagonal(photons: FloatArray, read: float, m: int) -> FloatArray:
    """Covariance (n_pixels, m, m) of the differences of a ramp."""
    beside = np.eye(m, k=1) + np.eye(m, k=-1)
    reads = read * (2.0 * np.eye(m) - beside)
    return np.asarray(reads + photons[:, None, None] * np.eye(m))
