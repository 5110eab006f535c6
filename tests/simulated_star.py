"""A star on the detector, as several tests take it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from amibayes.instrument import Channels, Instrument, load_instrument
from amibayes.optics import scene_image
from amibayes.parallel import Executor, SerialExecutor
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import Detector, DetectorMaps, draw_maps
from amibayes.simulation.exposure import (
    Exposure,
    Pointings,
    Recorder,
    draw_pointings,
    make_recorder,
    record,
)
from amibayes.units import FloatArray


@dataclass(frozen=True, eq=False)
class Star:
    """A star of Table 1's brightness on a small array."""

    exposure: Exposure
    detector: Detector
    rate_e_s: float = 1279391.0
    seed: int = 7

    @cached_property
    def instrument(self) -> Instrument:
        return load_instrument("niriss", "F430M")

    @cached_property
    def channels(self) -> Channels:
        return self.instrument.bandpass.channels(n=2)

    @cached_property
    def seeds(self) -> list[np.random.SeedSequence]:
        return np.random.SeedSequence(self.seed).spawn(3)

    @cached_property
    def pointings(self) -> Pointings:
        return draw_pointings(self.exposure, self.instrument.pixel_scale_rad, self.seeds[0])

    @cached_property
    def maps(self) -> DetectorMaps:
        n = self.exposure.n_pixels
        return draw_maps(self.detector, (n, n), np.random.default_rng(self.seeds[1]))

    @cached_property
    def recorder(self) -> Recorder:
        image = scene_image(
            Scene(),
            self.instrument,
            self.channels,
            self.exposure.n_pixels,
            centre_px=tuple(self.pointings.dither_px),
            reach_px=self.pointings.reach_px,
            pixel_response=self.detector.pixel_response,
        )
        return make_recorder(
            image, self.rate_e_s, self.pointings, self.exposure, self.detector, self.maps
        )

    def take(self, executor: Executor | None = None) -> dict[str, FloatArray]:
        chunks = list(
            record(self.recorder, self.pointings, self.seeds[2], executor or SerialExecutor())
        )
        assert [c.start for c in chunks] == list(range(0, self.exposure.n_integrations, 32))
        return {
            name: np.concatenate([getattr(c, name) for c in chunks])
            for name in ("images", "error", "dq")
        }


def still(n_groups: int, n_integrations: int, n_pixels: int = 40) -> Exposure:
    return Exposure(n_groups, n_integrations, jitter_rad=0.0, dither_rad=0.0, n_pixels=n_pixels)
