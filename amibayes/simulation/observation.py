"""What decides an exposure: scene, instrument, detector, pointing; and how bright the star is."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from amibayes.errors import DataError
from amibayes.instrument import Instrument, instrument_names, load_instrument
from amibayes.optics import Wavefront
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import Detector
from amibayes.simulation.exposure import Exposure
from amibayes.support.notebook import Shown
from amibayes.units import FloatArray

DAY_S = 86400.0


@dataclass(frozen=True, eq=False, repr=False)
class Observation(Shown):
    """All that decides what an exposure shows, but for the random numbers.

    Parameters
    ----------
    scene : Scene
        What is on the sky.
    instrument : Instrument
        Mask, filter and pixel scale.
    exposure : Exposure
        Groups, integrations and pointing errors.
    detector : Detector
        What happens to the light.
    orientation : Orientation
        How the detector lies on the sky.
    wavefront : Wavefront, optional
        Errors of the holes.
    count_rate_e_s : float, optional
        Electrons per second of the star; from its magnitude unless given.
    n_wavelengths : int
        Wavelengths that stand for the filter.
    start_mjd : float
        Start of the exposure.
    notes : mapping
        Further header keywords.
    """

    scene: Scene
    instrument: Instrument
    exposure: Exposure
    detector: Detector = field(default_factory=Detector)
    orientation: Orientation = field(default_factory=Orientation)
    wavefront: Wavefront | None = None
    count_rate_e_s: float | None = None
    n_wavelengths: int = 9
    start_mjd: float = 60000.0
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def rate_e_s(self) -> float:
        """Electrons per second of the star.

        Raises
        ------
        DataError
            Where neither a magnitude nor a rate is known.
        """
        if self.count_rate_e_s is not None:
            return self.count_rate_e_s
        return star_rate(self.scene, self.instrument)

    @property
    def mid_times_mjd(self) -> FloatArray:
        """(n_int,) middle of each ramp; a frame that resets the detector follows each."""
        frame = self.detector.frame_time_s
        ramp = self.exposure.n_groups * frame
        start = np.arange(self.exposure.n_integrations) * (ramp + frame)
        return np.asarray(self.start_mjd + (start + ramp / 2.0) / DAY_S)


def star_rate(scene: Scene, instrument: Instrument, source: str | None = None) -> float:
    """Electrons per second of a scene's star, from its magnitude.

    Parameters
    ----------
    scene : Scene
        With a magnitude in any filter of the instrument.
    instrument : Instrument
        In the filter that is used.
    source : str, optional
        Name or file of the instrument, where its other filters are.

    Raises
    ------
    DataError
        Where the scene has no magnitude.
    """
    if scene.magnitude is None:
        raise DataError(
            "key 'star.magnitude' is missing", source=scene.source, remedy="or give 'count_rate'"
        )
    band = None
    if scene.magnitude_filter not in (None, instrument.bandpass.name):
        band = load_instrument(source or _catalogued(instrument), scene.magnitude_filter).bandpass
    return instrument.count_rate(scene.spectrum, scene.magnitude, band)


def _catalogued(instrument: Instrument) -> str:
    name = instrument.name.split()[0].lower()
    if name not in instrument_names():
        raise DataError(
            f"a magnitude in another filter needs the file of instrument {instrument.name}",
            remedy="give the magnitude in the filter used, or a count rate",
        )
    return name
