"""Charge migration of a public detector simulator, GalSim's silicon sensor, fitted and taken out.

    pip install galsim; python -m benchmarks.galsim_sensor

The boundaries of its pixels are polygons whose corners move by tables of an electrostatic model
of an LSST sensor, with pixels several steps away in it: nothing of `amibayes.ramps`. A star of
28 000 electrons in its brightest pixel is collected in eight groups, with the same points of a
Sobol sequence in each instead of random photons, so that no noise hides what is left.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.stats import norm, qmc

from amibayes.cube import Cube
from amibayes.cube.ramps import RampFile
from amibayes.cube.timing import GroupTiming
from amibayes.ramps.correction import MigrationFree
from amibayes.ramps.curvature import curvature_of
from amibayes.ramps.fit import fit_migration
from amibayes.units import FloatArray

N, GROUPS, PEAK_E, WIDTH_PX = 24, 8, 28_000.0, 1.1
POINTS = 2**17
"""Of each group."""

COPIES, READ_E = 3000, 1.0
"""Integrations that the ramp is given as: as many as a deep exposure has."""


def ramp(sensor: Any, galsim: Any) -> FloatArray:
    """Charge (GROUPS, N, N) of a star that a sensor collects."""
    image = galsim.ImageD(N, N)
    image.setOrigin(0, 0)
    peak = (norm.cdf(0.5 / WIDTH_PX) - norm.cdf(-0.5 / WIDTH_PX)) ** 2
    charge = []
    for group in range(GROUPS):
        points = qmc.Sobol(2, seed=1).random(POINTS)
        x, y = (0.5 * (N - 1) + 0.2 + WIDTH_PX * norm.ppf(p.clip(1e-9, 1 - 1e-9)) for p in points.T)
        photons = galsim.PhotonArray(POINTS, x=x, y=y)
        photons.flux = PEAK_E / peak / GROUPS / POINTS
        sensor.accumulate(photons, image, resume=group > 0)
        charge.append(image.array.copy())
    return np.array(charge)


class Held:
    """An array that is read like an HDU."""

    def __init__(self, array: FloatArray) -> None:
        self.section = array


def main() -> None:
    """Print the coefficients and what is left of migration."""
    import galsim

    rng = galsim.BaseDeviate(1)
    moving = galsim.SiliconSensor("lsst_itl_8", diffusion_factor=0.0, rng=rng, nrecalc=2000)
    charge, still = ramp(moving, galsim), ramp(galsim.Sensor(), galsim)
    noise = READ_E * np.random.default_rng(1).standard_normal((COPIES, *charge.shape))
    timing = GroupTiming(GROUPS, 1.0, 1.0, first_s=1.0)
    template = Cube(np.empty((0, N, N)), 3e-7, "NIRISS", "F480M", unit="electron/s")
    file = RampFile(template, COPIES, {"SCI": Held(charge + noise)}, None, timing)
    measured = curvature_of(file)
    assert measured is not None
    fit = fit_migration([measured])
    true = still[-1] / GROUPS
    raw = file.read().images.mean(axis=0)
    free = MigrationFree(file, fit.migration, 1.0).read().images.mean(axis=0)
    for kind, value, error in zip(
        fit.migration.kinds, fit.migration.value, fit.migration.error, strict=True
    ):
        print(f"{kind}: {value:.2e} ± {error:.0e} per electron")
    for label, image in (("with migration", raw), ("taken out", free)):
        off = image - true
        print(f"{label}: largest error {np.abs(off).max() / true.max():.2e} of the peak, "
              f"rms {np.sqrt((off**2).mean()) / true.max():.1e}")  # fmt: skip


if __name__ == "__main__":
    main()
