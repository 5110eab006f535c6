"""Simulated images of a star and its calibrators, as files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from amibayes.cube import Cube, write_cube
from amibayes.instrument import load_instrument
from amibayes.parallel import child_seeds
from amibayes.scene.sources import Point, Scene
from amibayes.scene.spectrum import g2v
from amibayes.simulation import Detector, Exposure, draw_maps, simulate
from amibayes.units import MAS, FloatArray

MAGNITUDE = 6.0


@dataclass(frozen=True)
class SimulatedExposure:
    """NIRISS images of a G2V star and its calibrators on one detector.

    Parameters
    ----------
    filter : str
    n_groups, n_integrations, n_calibrators : int
    calibrator_magnitude : float
        The target has 6.
    boundary_shift : float
        Charge migration, see `amibayes.simulation.Detector`.
    field_mas : (float, float)
        Separations of the truths, and the field that is searched.
    """

    filter: str
    n_groups: int
    n_integrations: int
    n_calibrators: int
    calibrator_magnitude: float = MAGNITUDE
    boundary_shift: float = 0.0
    field_mas: tuple[float, float] = (50.0, 400.0)

    def write(
        self, truth: FloatArray | None, seed: np.random.SeedSequence, folder: Path
    ) -> tuple[list[Path], list[Path]]:
        """See `amibayes.validation.plan.Condition`."""
        target = scene_of(truth, MAGNITUDE)
        calibrator = scene_of(None, self.calibrator_magnitude)
        of_maps, *seeds = child_seeds(seed, 2 + self.n_calibrators)
        paths = []
        for k, child in enumerate(seeds):
            paths.append(folder / f"star{k}_calints.fits")
            write_cube(paths[-1], self._cube(calibrator if k else target, of_maps, child))
        return paths[:1], paths[1:]

    def _cube(
        self, scene: Scene, of_maps: np.random.SeedSequence, seed: np.random.SeedSequence
    ) -> Cube:
        shift = self.boundary_shift
        detector = Detector(boundary_shift_x=shift, boundary_shift_y=shift)
        exposure = Exposure(self.n_groups, self.n_integrations)
        return simulate(
            scene,
            load_instrument("niriss", self.filter),
            exposure,
            np.random.default_rng(seed),
            maps=draw_maps(detector, (exposure.n_pixels,) * 2, np.random.default_rng(of_maps)),
            detector=detector,
        )


def scene_of(truth: FloatArray | None, magnitude: float) -> Scene:
    """A star, and a companion east and north (mas) with a contrast."""
    companions = () if truth is None else (Point(truth[2], truth[0] * MAS, truth[1] * MAS),)
    return Scene((Point(), *companions), "star", magnitude, "F380M", g2v())
