"""Migration taken out of slopes, as they are read."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from amibayes.cube import Cube
from amibayes.cube.ramps import GAIN_E_DN, RampFile
from amibayes.cube.source import Source
from amibayes.cube.timing import timing_of
from amibayes.ramps.curvature import filled
from amibayes.ramps.migration import Migration
from amibayes.ramps.own_response import OwnResponse
from amibayes.ramps.transfer import gains
from amibayes.units import BoolArray, FloatArray

ROUNDS = 2
"""Each leaves a percent of what the one before left: of a percent of the current, 1e-6."""


@dataclass(frozen=True, eq=False)
class MigrationFree:
    """A file of images or ramps without the charge that passed between its pixels.

    Parameters
    ----------
    source : Source
    migration : Migration
    electrons : float
        Electrons per second of the images' unit.
    time_s : float, optional
        Mean time from the reset that slopes are of; ramps know it of every pixel.
    waves : (len(WAVES), ny, nx) array, optional
        Currents (e⁻/s) that amplitudes of 1 of the converter's errors make, where these have
        been taken off the ramps.
    own : OwnResponse, optional
        What single pixels do, taken off too.
    """

    source: Source
    migration: Migration
    electrons: float
    time_s: float | None = None
    waves: FloatArray | None = None
    own: OwnResponse | None = None

    @property
    def template(self) -> Cube:
        """Everything but the images."""
        return self.source.template

    @property
    def n_integrations(self) -> int:
        """How many images."""
        return self.source.n_integrations

    @property
    def mean_time_s(self) -> float:
        """Mean time from the reset of a whole ramp."""
        if self.time_s is None:
            assert isinstance(self.source, RampFile)
            return float(self.source.timing.middle_s.mean())
        return self.time_s

    def read(self, start: int = 0, stop: int | None = None) -> Cube:
        """Read the integrations from ``start`` up to ``stop``."""
        if self.time_s is None:
            assert isinstance(self.source, RampFile)
            cube, time = self.source.read_with_time(start, stop)
        else:
            cube, time = self.source.read(start, stop), np.array(self.time_s)
        if not cube.n_integrations:
            return cube
        # What is taken off is a percent of the current: single precision is enough for it.
        current = np.asarray(cube.images * self.electrons, dtype=np.float32)
        value = None if self.own is None else self.own.value
        lost = charge_lost(self.migration.of_pixels, current, time, cube.bad, value)
        images = cube.images - (lost / self.electrons).astype(cube.images.dtype)
        return replace(cube, images=images)


def charge_lost(
    migration: Migration,
    current: NDArray[Any],
    time_s: FloatArray,
    bad: BoolArray,
    own: FloatArray | None = None,
) -> NDArray[Any]:
    """Current (n, ny, nx) that migration has added to measured currents.

    Parameters
    ----------
    migration : Migration
    current : (n, ny, nx) array
        Electrons per second, measured.
    time_s : array, broadcast to that
        Mean time from the reset of the measurement.
    bad : (n, ny, nx) bool array
        Pixels whose current is not known: it is taken as that of their neighbours.
    own : (ny, nx) array, optional
        Coefficients of single pixels, per electron.
    """
    measured = current
    some = bad.any(axis=(1, 2))
    if some.any():
        measured = current.copy()
        for k in np.flatnonzero(some):
            measured[k] = filled(np.where(bad[k], 0.0, current[k]), ~bad[k])
    lost, when = np.zeros_like(measured), np.asarray(time_s, dtype=measured.dtype)
    for _ in range(ROUNDS):
        # Migration grows with the charge: half of what is lost by the end has collected so far.
        charge = when * (measured - 0.5 * lost)
        moved = gains(migration.kinds, charge, measured - lost)
        alone = 0.0 if own is None else own.astype(measured.dtype) * charge * (measured - lost)
        lost = np.tensordot(migration.value.astype(measured.dtype), moved, axes=1) + alone
    return np.asarray(lost)


def electrons_of(template: Cube) -> float | None:
    """Electrons per second of the unit of some slopes; None where it is not known."""
    unit = template.unit.lower().replace(" ", "")
    if unit.startswith(("electron/s", "e-/s")):
        return 1.0
    if unit.startswith("dn/s"):
        return GAIN_E_DN
    scale = template.header.get("PHOTMJSR")
    if unit.startswith("mjy/sr") and isinstance(scale, int | float) and scale > 0.0:
        return GAIN_E_DN / float(scale)
    return None


def slope_time_s(header: Mapping[str, Any]) -> float | None:
    """Mean time from the reset that slopes are of, by the header; None where it does not tell.

    Weights of the groups are symmetric about the middle of the ramp, whatever the noise.
    """
    groups, step = header.get("NGROUPS"), header.get("TGROUP", header.get("TFRAME"))
    if not isinstance(groups, int) or not isinstance(step, int | float):
        return None
    if groups < 2 or not step > 0.0:
        return None
    # A read after the reset comes on top of the groups that are counted.
    reads = groups + (header.get("ZEROREAD") is True)
    return float(timing_of(header, reads, float(step)).middle_s.mean())
