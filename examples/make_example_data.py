"""Make examples/data: a target with a faint companion and three calibrators, simulated.

    python examples/make_example_data.py [folder]

NIRISS aperture masking through F480M. All four share the instrument: each baseline loses
visibility and shifts phase by amounts of its own, which drift a little from one star to
the next, about as much as the noise of one exposure. Without calibration nothing fits.
The truth is in the headers; the files are the same, byte by byte, on every machine.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import Block, BlockCovariance, diagonal_covariance, stack_covariances
from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.oifits import write_oifits
from amibayes.units import DEGREE, FloatArray, delta_mag_to_contrast, offset

SEED = 20201211

INSTRUMENT = load_instrument("niriss", "F480M")

SEPARATION_MAS, POSITION_ANGLE_DEG, DELTA_MAG = 150.0, 40.0, 5.0

VIS2_ERROR = 0.002
PHASE_ERROR_RAD = 0.1 * DEGREE
"""Noise of V² and of the phase of each baseline in one exposure."""

GAIN, PHASE_OFFSET_RAD = 0.03, 1.0 * DEGREE
"""Spread over the baselines of the instrument's gain and phase, the same for all stars."""

GAIN_DRIFT, PHASE_DRIFT_RAD = 0.002, 0.1 * DEGREE
"""Spread over the stars, on each baseline."""

STARS = {"target": 60000.00, "cal1": 59999.97, "cal2": 60000.03, "cal3": 60000.06}
"""File and date (MJD) of each star."""

DIGITS, PICOMETRE = 7, 12
"""Decimals of the values (radians for phases) and of wavelengths: far below the noise, and
far above what differs between mathematical libraries."""


def blank(name: str, mjd: float) -> Observables:
    """A point source with the covariance of independent noise on every baseline."""
    mask, bandpass = INSTRUMENT.mask, INSTRUMENT.bandpass
    sheet = point_source(
        # North up and east left: the image's x runs to the west.
        mask.holes_m * [-1.0, 1.0],
        round(bandpass.pivot_m, PICOMETRE),
        round(bandpass.half_power_m[1] - bandpass.half_power_m[0], PICOMETRE),
        vis2_error=VIS2_ERROR,
        closure_error_rad=np.sqrt(3.0) * PHASE_ERROR_RAD,
        covariance="diagonal",
        insname="NIRISS",
        mjd=mjd,
    )
    matrix, _ = closure_matrix(sheet.closure_phase.stations)
    closures = Block(
        np.arange(len(matrix)), PHASE_ERROR_RAD**2 * (matrix @ matrix.T), kernel_basis(matrix)
    )
    covariance = stack_covariances(
        [
            diagonal_covariance(np.full(len(sheet.vis2), VIS2_ERROR**2)),
            BlockCovariance(len(matrix), [closures]),
        ]
    )
    setup = replace(
        sheet.setups[0],
        target=f"EXAMPLE-{name.upper()}",
        station_diameter_m=np.full(mask.n_holes, mask.size_m),
        right_ascension_deg=150.0,
        declination_deg=-40.0,
    )
    return replace(sheet, covariance=covariance, covariance_kind="given", setups=(setup,))


def observe(
    sheet: Observables, companion: bool, gain: FloatArray, phase: FloatArray
) -> Observables:
    """What is measured of a star through baselines with a gain and a phase of their own."""
    east, north = offset(SEPARATION_MAS, POSITION_ANGLE_DEG)
    contrast = float(delta_mag_to_contrast(DELTA_MAG)) if companion else 0.0
    model = Likelihood(sheet, BinaryModel()).predict([[east, north, contrast]])[:, 0]
    vis2, closure = np.split(model, [len(sheet.vis2)])
    matrix, _ = closure_matrix(sheet.closure_phase.stations)
    return replace(
        sheet,
        vis2=replace(sheet.vis2, value=np.round(vis2 * gain, DIGITS)),
        closure_phase=replace(
            sheet.closure_phase, value=np.round(closure + matrix @ phase, DIGITS)
        ),
    )


def simulate() -> dict[str, Observables]:
    """The target and its calibrators, by file name."""
    rng = np.random.default_rng(SEED)
    n = INSTRUMENT.mask.n_baselines
    instrument = 0.93 + GAIN * rng.standard_normal(n)
    instrument_phase = PHASE_OFFSET_RAD * rng.standard_normal(n)
    stars = {}
    for name, mjd in STARS.items():
        drift, noise, phase_drift, phase_noise = rng.standard_normal((4, n))
        gain = instrument * (1.0 + GAIN_DRIFT * drift) + VIS2_ERROR * noise
        phase = instrument_phase + PHASE_DRIFT_RAD * phase_drift + PHASE_ERROR_RAD * phase_noise
        stars[name] = observe(blank(name, mjd), name == "target", gain, phase)
    return stars


def header(name: str) -> dict[str, str | int | float]:
    """Keywords that hold the truth, and no date of today."""
    truth: dict[str, str | int | float] = {
        "HIERARCH TRUTH SEED": SEED,
        "HIERARCH TRUTH VIS2_DRIFT": GAIN_DRIFT,
        "HIERARCH TRUTH PHASE_DRIFT_DEG": PHASE_DRIFT_RAD / DEGREE,
    }
    if name == "target":
        truth |= {
            "HIERARCH TRUTH SEPARATION_MAS": SEPARATION_MAS,
            "HIERARCH TRUTH POSITION_ANGLE_DEG": POSITION_ANGLE_DEG,
            "HIERARCH TRUTH DELTA_MAG": DELTA_MAG,
        }
    program = {"DATE": "2023-02-25", "PROCSOFT": "amibayes, examples/make_example_data.py"}
    return {**program, "ORIGIN": "SIMULATED", "TELESCOP": "JWST", "INSMODE": "NRM F480M", **truth}


def main(folder: Path) -> None:
    """Write the four files."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, observables in simulate().items():
        path = folder / f"{name}.oifits"
        write_oifits(path, observables, header=header(name), overwrite=True)
        print(path)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "data")
