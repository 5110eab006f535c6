"""One instrument configuration: its name, stations and spectral channels."""

from __future__ import annotations

from dataclasses import dataclass

from amibayes.data.kernel_model import KernelModel
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.units import FloatArray, IntArray, freeze


@dataclass(frozen=True, eq=False)
class Setup:
    """One instrument configuration: its name, stations and spectral channels.

    Parameters
    ----------
    insname, arrname, target : str
        Names as OIFITS gives them (stripped).
    stations : tuple of str
        Station names; `Measurements.stations` indexes them.
    station_index : (n_stations,) int array
        The numbers that OIFITS uses for them (STA_INDEX).
    wavelength_m, band_m : (n_channels,) float array
        Effective wavelength and width of each channel, in metres.
    station_xyz_m : (n_stations, 3) float array, optional
        Positions (holes of a mask, telescopes of an array) in metres.
    station_diameter_m : (n_stations,) float array, optional
    source : str
        The file the data come from.
    right_ascension_deg, declination_deg : float
        Of the target (0 where unknown).
    response : OffAxisResponse, optional
        What the extraction lets through of light off the axis.
    array_frame : str
        FRAME of OI_ARRAY: "GEOCENTRIC" coordinates have their origin in ``array_centre_m``;
        empty on the sky, or where unknown.
    array_centre_m : tuple of float
        ARRAYX, ARRAYY, ARRAYZ.
    kernel : KernelModel, optional
        Of kernel phases: the sums of phases over a pupil that they are.
    """

    insname: str
    arrname: str
    target: str
    stations: tuple[str, ...]
    station_index: IntArray
    wavelength_m: FloatArray
    band_m: FloatArray
    station_xyz_m: FloatArray | None = None
    station_diameter_m: FloatArray | None = None
    source: str = ""
    right_ascension_deg: float = 0.0
    declination_deg: float = 0.0
    response: OffAxisResponse | None = None
    array_frame: str = ""
    array_centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    kernel: KernelModel | None = None

    def __post_init__(self) -> None:
        freeze(self)
