"""The detector as numbers: every effect has one, and zero switches it off."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.cube import DO_NOT_USE
from amibayes.errors import UsageError
from amibayes.units import BoolArray, FloatArray

BIAS_DN = 12000.0
"""Counts of a pixel after the reset: those of NIRISS."""


@dataclass(frozen=True)
class Detector:
    """A detector that is read without destroying its charge (up the ramp).

    Parameters
    ----------
    frame_time_s : float
        Time from one read to the next; NISRAPID on the 80×80 subarray takes 0.07544 s.
    photon_noise : bool
        Draw the electrons of every group from a Poisson distribution.
    read_noise_e : float
        Noise of the difference of two reads (CDS); one read has it over √2.
    zero_read : bool
        Whether the charge right after the reset is read as well. The paper's simulator
        keeps it, so that n groups measure the light of n frames; JWST does not, and n
        groups measure that of n − 1.
    dark_e_s, background_e_s : float
        Electrons per second and pixel; both stay in the images.
    flat_error : float
        Standard deviation of the relative error of the flat field, fixed for a detector.
    flat_field : float
        Standard deviation of the sensitivity of pixels, fixed for a detector. Reads have it;
        slopes are divided by it, with that error.
    full_well_e : float
        Charge at which a pixel saturates.
    nonlinearity : float
        Fraction of the signal that is missing at full well (quadratic response).
    linearity_error : float
        Relative error of the correction for that.
    interpixel_capacitance : float
        Fraction of a pixel's signal that appears in each of its four neighbours.
    pixel_response : float
        Relative loss of sensitivity from the middle of a pixel to its edges.
    bad_pixel_fraction : float
        Pixels of no use, half of them dead and half hot, fixed for a detector.
    cosmic_rays_s : float
        Hits per second and pixel.
    cosmic_ray_charge_e : float
        Mean charge of a hit (exponential).
    migration : float
        Fraction of a pixel's charge above ``migration_threshold_e`` that its neighbours get.
    migration_threshold_e : float
        Charge above which new electrons go astray.
    boundary_shift_x, boundary_shift_y : float
        Displacement of the side between two neighbours along x, or y, per electron by which
        their charges differ, in pixels: light that falls there goes to the neighbour while
        the ramp is going on (`amibayes.ramps.transfer`). NIRISS: about 3.6e-7,
        1 % of the brightest pixel's current at 26 000 e⁻ in F480M.
    stripe_noise_e : float
        Noise of one read that all pixels of a column share, 1/f from column to column. A
        column is what NIRISS reads at one go: its fast axis is y in images as JWST has them.
    adc_nonlinearity : float
        Errors of the analogue-to-digital converter, in units of those of NIRISS
        (`amibayes.simulation.ramps.converted`).
    bias_spread_dn : float
        Standard deviation of the pixels' bias, which the converter's errors depend on.

    Raises
    ------
    UsageError
        Naming the number that makes no sense.
    """

    frame_time_s: float = 0.07544
    photon_noise: bool = True
    read_noise_e: float = 21.0
    zero_read: bool = True
    dark_e_s: float = 0.04
    background_e_s: float = 0.125
    flat_error: float = 1e-3
    flat_field: float = 0.0
    full_well_e: float = 72000.0
    nonlinearity: float = 0.0
    linearity_error: float = 0.0
    interpixel_capacitance: float = 0.0
    pixel_response: float = 0.0
    bad_pixel_fraction: float = 0.0
    cosmic_rays_s: float = 0.0
    cosmic_ray_charge_e: float = 3000.0
    migration: float = 0.0
    migration_threshold_e: float = 26000.0
    boundary_shift_x: float = 0.0
    boundary_shift_y: float = 0.0
    stripe_noise_e: float = 0.0
    adc_nonlinearity: float = 0.0
    bias_spread_dn: float = 300.0

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if not isinstance(value, bool):
                self._check(entry.name, value)

    def _check(self, name: str, value: float) -> None:
        positive = name in ("frame_time_s", "full_well_e", "cosmic_ray_charge_e")
        limit = LARGEST.get(name, math.inf)
        if not 0.0 <= value < math.inf or value > limit or (positive and value == 0.0):
            bounds = f"{'above' if positive else 'at least'} 0"
            bounds += f" and at most {limit:g}" if limit < math.inf else ""
            raise UsageError(f"detector.{name} is {value:g}; it must be {bounds}")

    @property
    def single_read_noise_e(self) -> float:
        """Noise of one read."""
        return self.read_noise_e / math.sqrt(2.0)

    def n_reads(self, n_groups: int) -> int:
        """Number of reads of a ramp of ``n_groups``."""
        return n_groups + int(self.zero_read)


LARGEST = {
    "flat_error": 0.3,
    "flat_field": 0.1,
    "nonlinearity": 0.2,
    "linearity_error": 0.2,
    "interpixel_capacitance": 0.1,
    "pixel_response": 0.5,
    "bad_pixel_fraction": 0.5,
    "cosmic_rays_s": 0.1,
    "migration": 0.5,
    "boundary_shift_x": 1e-5,
    "boundary_shift_y": 1e-5,
    "stripe_noise_e": 1e3,
    "adc_nonlinearity": 100.0,
    "bias_spread_dn": 2000.0,
}
"""Beyond these an effect is no longer the small correction that it is modelled as."""

PRESETS = {
    "paper": Detector(),
    "realistic": Detector(
        zero_read=False,
        nonlinearity=0.03,
        linearity_error=0.01,
        interpixel_capacitance=0.006,
        pixel_response=0.03,
        bad_pixel_fraction=0.003,
        cosmic_rays_s=1.6e-5,
        migration=0.075,
    ),
}
"""``paper``: the noise sources of Soulain et al. (2020) and nothing else. ``realistic``: all
effects on. There a pixel at 30 000 e⁻ has lost 1 % to its neighbours, and the rate of cosmic
rays is 5 per cm² and second on pixels of 18 µm."""


def detector_preset(name: str, changes: Mapping[str, Any] | None = None) -> Detector:
    """Give a preset with some numbers changed.

    Raises
    ------
    UsageError
        For a preset or a number of no known name.
    """
    if name not in PRESETS:
        raise UsageError(f"no detector preset '{name}'", remedy=f"choose from {', '.join(PRESETS)}")
    known = {entry.name for entry in fields(Detector)}
    for key in changes or {}:
        if key not in known:
            raise UsageError(f"a detector has no '{key}'")
    return replace(PRESETS[name], **(changes or {}))


@dataclass(frozen=True, eq=False)
class DetectorMaps:
    """What is the same in every exposure: one detector looks at target and calibrators.

    Parameters
    ----------
    flat : (ny, nx) array
        Factor by which the flat field used differs from the true one.
    sensitivity : (ny, nx) array
        Of pixels, their mean 1.
    dead, hot : (ny, nx) bool arrays
        Pixels without signal, and with too much of it.
    bias_dn : (ny, nx) array
        Counts after the reset.
    """

    flat: FloatArray
    sensitivity: FloatArray
    dead: BoolArray
    hot: BoolArray
    bias_dn: FloatArray

    @property
    def bad(self) -> BoolArray:
        """Pixels that are not to be used."""
        return self.dead | self.hot

    @property
    def dq(self) -> NDArray[np.uint32]:
        """(ny, nx) flags of pixels, the same in all integrations."""
        return np.where(self.bad, DO_NOT_USE, 0).astype(np.uint32)


def draw_maps(detector: Detector, shape: tuple[int, int], rng: np.random.Generator) -> DetectorMaps:
    """Draw the flat-field errors and bad pixels of one detector.

    Each effect has its own stream, so that switching one does not change the others.
    """
    of_flat, of_bad, of_sensitivity, of_bias = rng.spawn(4)
    flat = 1.0 + detector.flat_error * of_flat.standard_normal(shape)
    sensitivity = 1.0 + detector.flat_field * of_sensitivity.standard_normal(shape)
    lot = of_bad.random(shape)
    half = detector.bad_pixel_fraction / 2.0
    bias = BIAS_DN + detector.bias_spread_dn * of_bias.standard_normal(shape)
    hot = (lot >= half) & (lot < 2.0 * half)
    return DetectorMaps(flat, sensitivity, lot < half, hot, bias)
