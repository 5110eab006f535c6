"""How the current of every pixel changes while charge collects: what ramps know of migration.

A pixel whose area and response stay what they are collects at a constant current, whatever it
is. What changes along the ramp is hence free of the image: the mean over integrations of the
change, B in the current F + B·t, is all that a fit of migration needs of an exposure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, gaussian_filter

from amibayes.cube.container import NEVER_USED, flag_bits
from amibayes.cube.ramps import GAIN_E_DN, RampFile
from amibayes.cube.timing import GroupTiming
from amibayes.ramps.converter import WAVES, Predictor, WaveColumns, spread_of
from amibayes.ramps.transfer import KINDS, gains
from amibayes.units import BoolArray, FloatArray, IntArray, read_only

CHUNK = 64
"""Integrations that are worked on together."""

BATCHES = 24
"""Means of so many parts of an exposure: their scatter owes nothing to a model of the noise."""

SAMPLED = 128
"""Integrations, evenly chosen, whose images tell what migration makes of them: they differ by
the pointing, which changes that by percents, and its mean by a tenth of a percent then."""

MIN_SHARE = 0.5
"""A difference, or a pixel, is left out where it is good in a smaller share of the ramps."""

SURROUNDINGS = np.ones((3, 3), dtype=bool)
"""What passes to and from a pixel that is not known spoils those around it."""


@dataclass(frozen=True, eq=False)
class Curvature:
    """What the ramps of one exposure say, in electrons and seconds.

    Parameters
    ----------
    source : str
    n_integrations, n_differences : int
        Of what was used.
    time_s : float
        Mean time from the reset.
    current : (ny, nx) array
        Mean electrons per second at that time, in every pixel.
    change : (ny, nx) array
        Mean change of the current, electrons per second squared.
    sigma : (ny, nx) array
        Standard deviation of it by photon and read noise; infinite where it is not used.
    batches : (b, ny, nx) array
        Means of `change` over parts of the exposure; none with fewer than two integrations.
    gains : (len(KINDS), ny, nx) array
        Mean over integrations of what a coefficient of 1 per electron makes of the change.
    departure : (n_differences, ny, nx) array
        Mean current of each difference less `current`.
    lag_s : (n_differences,) array
        Time of each from ``time_s``.
    bend_chi2 : float
        χ² of what is left of the mean ramps beside a linear change.
    bend_dof : int
    waves : WaveColumns, optional
        What errors of the converter make of the ramps, where the bias is known.
    noise_degrees : float
        Degrees of freedom that the read noise is known with.
    """

    source: str
    n_integrations: int
    n_differences: int
    time_s: float
    current: FloatArray
    change: FloatArray
    sigma: FloatArray
    batches: FloatArray
    gains: FloatArray
    departure: FloatArray
    lag_s: FloatArray
    bend_chi2: float
    bend_dof: int
    waves: WaveColumns | None = None
    noise_degrees: float = np.inf

    def __post_init__(self) -> None:
        read_only(self, "current", "change", "sigma", "batches", "gains", "departure")

    @property
    def used(self) -> BoolArray:
        """(ny, nx) pixels that count."""
        return np.asarray(np.isfinite(self.sigma))


@dataclass(frozen=True, eq=False)
class _Weights:
    """Linear estimates of current and change of every pixel out of the differences of a ramp.

    Parameters
    ----------
    kept : (k,) int array
        Differences that are used.
    matrix : (2, k, n_pixels) array
    sigma : (n_pixels,) array
        Of the change, in one integration.
    inverse : (n_pixels, k, k) array
        Inverse covariance of the differences, as currents.
    lag_s : (k,) array
        Times of the differences from their mean.
    """

    kept: IntArray
    matrix: FloatArray
    sigma: FloatArray
    inverse: FloatArray
    lag_s: FloatArray

    def applied(self, steps: NDArray[Any]) -> tuple[FloatArray, FloatArray]:
        """Current and change (n, ny, nx) of ramps whose differences are (n, k, ny, nx)."""
        n, k, ny, nx = steps.shape
        current, change = np.zeros((2, n, ny * nx))
        flat = steps.reshape(n, k, -1)
        for i in range(k):
            current += flat[:, i] * self.matrix[0, i]
            change += flat[:, i] * self.matrix[1, i]
        return current.reshape(n, ny, nx), change.reshape(n, ny, nx)


def _weights(kept: IntArray, photons: FloatArray, read: float, timing: GroupTiming) -> _Weights:
    """Generalised least squares of a straight line; ``photons`` and ``read`` in electrons²."""
    by_photons, by_reads = (
        c[np.ix_(kept, kept)] for c in (timing.photon_covariance, timing.read_covariance)
    )
    covariance = photons.reshape(-1, 1, 1) * by_photons + read * by_reads
    inverse: FloatArray = np.asarray(np.linalg.inv(covariance), dtype=float) * timing.group_s**2
    lag = timing.middle_s[kept] - timing.middle_s[kept].mean()
    design = np.stack([np.ones(len(kept)), lag], axis=1)
    half = design.T @ inverse
    known = np.linalg.inv(half @ design)
    matrix = np.moveaxis(known @ half, 0, 2)
    return _Weights(kept, matrix, np.sqrt(known[:, 1, 1]), inverse, lag)


class _Sums:
    """Sums over integrations of one exposure."""

    def __init__(self, shape: tuple[int, int], kept: int, batches: int) -> None:
        self.count = np.zeros((batches, *shape))
        self.change = np.zeros((batches, *shape))
        self.current = np.zeros(shape)
        self.ramp = np.zeros((kept, *shape))
        self.gains = np.zeros((len(KINDS), *shape))
        self.waves = np.zeros((len(WAVES), kept, *shape))
        self.n = 0

    def add(
        self, number: IntArray, current: FloatArray, change: FloatArray, whole: BoolArray
    ) -> None:
        """Add integrations of a running number: their currents, changes and whole ramps."""
        kept = change if whole.all() else np.where(whole, change, 0.0)
        b = len(self.count)
        for k, batch in enumerate(number[:b] % b):
            self.count[batch] += np.count_nonzero(whole[k::b], axis=0)
            self.change[batch] += kept[k::b].sum(axis=0)
        self.current += np.where(whole, current, 0.0).sum(axis=0)


def curvature_of(file: RampFile) -> Curvature | None:
    """Measure how the currents of an exposure change; None with fewer than three differences.

    Two differences tell a change, but not whether it is one that charge makes: a reset that
    still decays, or a pointing that drifts, look the same.
    """
    gain = file.gain_e
    photons, read = file.noise[0] * gain**2, file.noise[1] * gain**2
    kept = _usable(file)
    if len(kept) < 3:
        return None
    weights = _weights(kept, np.maximum(photons, 1e-6), read, file.timing)
    shape = photons.shape
    bad = np.broadcast_to(np.asarray(file.pixel_flags) & flag_bits(NEVER_USED), shape) > 0
    usual = filled(photons / file.timing.group_s, ~bad)
    stride = -(-file.n_integrations // SAMPLED)
    sums = _Sums(shape, len(kept), min(BATCHES, file.n_integrations))
    predictor = _predictor(file, weights, photons, read)
    for start in range(0, file.n_integrations, CHUNK):
        part = slice(start, min(start + CHUNK, file.n_integrations))
        found = file.differences(part)
        whole = found.good[:, kept].all(axis=1) & ~bad
        steps = found.values[:, kept] * (gain / file.timing.group_s)
        current, change = weights.applied(steps)
        sums.add(np.arange(part.start, part.stop), current, change, whole)
        if not whole.all():
            steps = np.where(whole[:, None], steps, 0.0)
        sums.ramp += steps.sum(axis=0, dtype=float)
        light = np.where(whole, current, usual)[-part.start % stride :: stride]
        sums.gains += gains(KINDS, light, light).sum(axis=1)
        if predictor is not None:
            sums.waves += predictor(light)
        sums.n += len(light)
    return _averaged(sums, weights, file, bad)


def expected_curvature(
    light_e_s: FloatArray,
    read_variance_e2: float,
    frame_s: float,
    n_groups: int,
    n_integrations: int,
    first_s: float = 0.0,
) -> Curvature | None:
    """What ramps without migration would say, noise left out of all but its errors.

    Parameters
    ----------
    light_e_s : (ny, nx) array
    read_variance_e2 : float
        Of one read.
    frame_s, first_s : float
        From a read to the next, and from the reset to the first.
    n_groups, n_integrations : int
    """
    timing = GroupTiming(n_groups, frame_s, frame_s, first_s=first_s)
    m = timing.n_differences
    if m < 3:
        return None
    photons = np.maximum(light_e_s * frame_s, 1e-6)
    weights = _weights(np.arange(m), photons, read_variance_e2, timing)
    sigma = weights.sigma.reshape(light_e_s.shape) / np.sqrt(n_integrations)
    nothing = np.zeros((m, *light_e_s.shape))
    moved = gains(KINDS, light_e_s, light_e_s)
    time = float(timing.middle_s.mean())
    return Curvature(
        "expected", n_integrations, m, time, light_e_s, nothing[0], sigma, nothing[:0], moved,
        nothing, weights.lag_s, 0.0, 0,
    )  # fmt: skip


def _averaged(sums: _Sums, weights: _Weights, file: RampFile, bad: BoolArray) -> Curvature:
    n, count = file.n_integrations, sums.count.sum(axis=0)
    lost = bad | (count < MIN_SHARE * n)
    divisor = np.maximum(count, 1.0)
    current, change = sums.current / divisor, sums.change.sum(axis=0) / divisor
    sigma = weights.sigma.reshape(count.shape) / np.sqrt(divisor)
    sigma = np.where(binary_dilation(lost, SURROUNDINGS), np.inf, sigma)
    batches = sums.change / np.maximum(sums.count, 1.0)
    batches = np.where(sums.count > 0.0, batches, change)
    left = sums.ramp / divisor - current - change * weights.lag_s[:, None, None]
    flat = left.reshape(len(left), -1)
    chi2 = divisor.ravel() * np.einsum("kp,pkl,lp->p", flat, weights.inverse, flat)
    used = np.isfinite(sigma).ravel()
    found = Curvature(
        file.template.source,
        n,
        len(weights.kept),
        float(file.timing.middle_s[weights.kept].mean()),
        filled(current, ~lost),
        change,
        sigma,
        batches if len(batches) > 1 else batches[:0],
        sums.gains / sums.n,
        sums.ramp / divisor - current,
        weights.lag_s,
        float(chi2[used].sum()),
        int(used.sum()) * (len(weights.kept) - 2),
        noise_degrees=file.noise_degrees,
    )
    if file.bias_dn is None:
        return found
    return replace(found, waves=_wave_columns(sums.waves / sums.n, weights, left, sigma, divisor))


def _predictor(
    file: RampFile, weights: _Weights, photons: FloatArray, read: float
) -> Predictor | None:
    """Waves of the converter in differences; None where the pixels' bias is not known."""
    if file.bias_dn is None:
        return None
    light = photons.ravel() / file.timing.group_s
    spread = spread_of(file.timing, weights.kept, weights.matrix[0], light, read) / GAIN_E_DN**2
    shape = (-1, *photons.shape)
    return Predictor(
        file.bias_dn, file.linearity, GAIN_E_DN, file.timing, weights.kept, spread.reshape(shape)
    )


def _wave_columns(
    steps: FloatArray, weights: _Weights, left: FloatArray, sigma: FloatArray, count: FloatArray
) -> WaveColumns:
    """Columns of waves whose mean differences are (len(WAVES), k, ny, nx).

    Parameters
    ----------
    steps : array
        Currents.
    weights : _Weights
    left : (k, ny, nx) array
        What the mean ramps have beside a linear change.
    sigma, count : (ny, nx) arrays
        Infinite where a pixel does not count; ramps that were averaged.
    """
    current, change = weights.applied(steps)
    departure = steps - current[:, None]
    bend = departure - change[:, None] * weights.lag_s[:, None, None]
    shape = (*bend.shape[:2], -1)
    inverse = weights.inverse * np.where(np.isfinite(sigma), count, 0.0).reshape(-1, 1, 1)
    whitened = np.einsum("wkp,pkl->wlp", bend.reshape(shape), inverse)
    normal = np.einsum("wlp,vlp->wv", whitened, bend.reshape(shape))
    right = np.einsum("wlp,lp->w", whitened, left.reshape(shape[1:]))
    return WaveColumns(current, change, departure, normal, right)


def _usable(file: RampFile) -> IntArray:
    """Differences that are good in most ramps: groups may be flagged in all of them."""
    good = file.differences(slice(0, min(CHUNK, file.n_integrations))).good
    return np.flatnonzero(good.mean(axis=(0, 2, 3)) > MIN_SHARE)


def filled(image: FloatArray, good: BoolArray) -> FloatArray:
    """Image (ny, nx) with the Gaussian-weighted mean of good neighbours where it is not good."""
    if good.all():
        return image
    weight = gaussian_filter(good.astype(float), 1.0)
    smooth = gaussian_filter(np.where(good, image, 0.0), 1.0) / np.maximum(weight, 1e-12)
    return np.where(good, image, smooth)
