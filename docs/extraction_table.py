"""What every method of extraction makes of images that its model does not know, as a table.

    python docs/extraction_table.py

A star without a companion is imaged twice, as a target and as its calibrator, at pointings
15 mas apart and with a jitter of 7 mas, without noise; V² should be 1 and closure phases 0.
The table goes to docs/extraction.md, between the lines that mark it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from pages import put_table

from amibayes import Instrument, load_instrument, psf
from amibayes.calibration import calibrate
from amibayes.cube import Cube
from amibayes.extraction import METHODS, Extraction, ExtractOptions, extract_all
from amibayes.instrument import Channels
from amibayes.scene.spectrum import Blackbody
from amibayes.units import FloatArray

PHOTONS = 1e7
"""Per integration."""

POINTINGS_PX = (np.array([0.2, 0.1]), np.array([-0.03, 0.08]))
JITTER_PX = np.random.default_rng(1).normal(0.0, 0.1, (2, 5, 2))

FAINTER = 0.7
"""Flux of the calibrator in units of the target's."""

N_BAD = 20

Images = tuple[FloatArray, FloatArray]


def images(instrument: Instrument, channels: tuple[Channels, Channels] | None = None) -> Images:
    """Integrations (n, n_y, n_x) of the target and of the calibrator."""
    both = channels or (instrument.bandpass.channels(),) * 2
    target, calibrator = (
        PHOTONS * np.stack([psf(instrument, light, 80, centre_px=(x, y)) for x, y in at + jitter])
        for light, at, jitter in zip(both, POINTINGS_PX, JITTER_PX, strict=True)
    )
    return target, FAINTER * calibrator


def migrated(cube: FloatArray, threshold: float) -> FloatArray:
    """Charge above a threshold, 1 % of the brightest pixel, goes to the four neighbours."""
    lost = np.maximum(cube - threshold, 0.0) * 0.01 / (1.0 - threshold / cube.max())
    gained = sum(np.roll(lost, s, axis) for s in (1, -1) for axis in (1, 2)) / 4.0
    return np.asarray(cube - lost + gained)


def poppy_images(instrument: Instrument) -> Images:
    """The same star by poppy: sampled pupil, Fraunhofer transform, 9 wavelengths."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import poppy

        holes = []
        for k, (x, y) in enumerate(instrument.mask.holes_m):
            hole = poppy.HexagonAperture(flattoflat=instrument.mask.size_m, name=f"hole {k}")
            hole.shift_x, hole.shift_y = x, y
            holes.append(hole)
        system = poppy.OpticalSystem(pupil_diameter=6.6, npix=1024, oversample=1)
        system.add_pupil(poppy.CompoundAnalyticOptic(holes, mergemode="or"))
        pixel = np.degrees(instrument.pixel_scale_rad) * 3600.0
        system.add_detector(pixelscale=pixel, fov_pixels=84, oversample=5)
        channels = instrument.bandpass.channels(n=9)
        fine = sum(
            w * system.calc_psf(wavelength=float(wavelength))[0].data
            for wavelength, w in zip(channels.wavelength_m, channels.weight, strict=True)
        )

    def at(dx: int, dy: int) -> FloatArray:
        moved = np.roll(np.asarray(fine), (dy, dx), (0, 1)).reshape(84, 5, 84, 5)
        return np.asarray(moved.sum(axis=(1, 3))[2:-2, 2:-2])

    target = np.stack([at(1, 0), at(1, 1), at(0, 1)])
    calibrator = np.stack([at(0, 0), at(0, -1), at(-1, 0)])
    return PHOTONS * target / target[0].sum(), FAINTER * PHOTONS * calibrator / target[0].sum()


def with_bad_pixels(both: Images) -> Images:
    rng = np.random.default_rng(2)
    y, x = rng.integers(25, 55, (2, N_BAD))
    for cube in both:
        cube[:, y, x] = np.nan
    return both


def cases(instrument: Instrument) -> dict[str, Callable[[], Images]]:
    scaled = replace(instrument, pixel_scale_rad=1.002 * instrument.pixel_scale_rad)
    turned = instrument.with_mask(instrument.mask.rotated(np.radians(0.1)))
    cool, hot = (instrument.bandpass.channels(Blackbody(t)) for t in (3000.0, 10000.0))
    perfect = images(instrument)
    threshold = 0.5 * float(perfect[0].max())
    return {
        "nothing wrong": lambda: perfect,
        "pixels 0.2 % larger": lambda: images(scaled),
        "mask turned by 0.1°": lambda: images(turned),
        "stars of 3000 K and 10 000 K taken as flat": lambda: images(instrument, (cool, hot)),
        "1 % charge migration": lambda: (
            migrated(perfect[0], threshold),
            migrated(perfect[1], threshold),
        ),
        "20 bad pixels": lambda: with_bad_pixels((perfect[0].copy(), perfect[1].copy())),
        "images by poppy": lambda: poppy_images(instrument),
    }


def extracted(instrument: Instrument, cube: FloatArray, options: ExtractOptions) -> Extraction:
    error = np.sqrt(np.maximum(np.nan_to_num(cube), 0.0) + 10.0)
    filter_name = instrument.bandpass.name
    scale = instrument.pixel_scale_rad
    return extract_all(Cube(cube, scale, "NIRISS", filter_name, error=error), options)[0]


def biases(instrument: Instrument, both: Images, options: ExtractOptions) -> FloatArray:
    """RMS of V² − 1 and closure phase (degrees), of the target and calibrated, (4,)."""
    target, calibrator = (extracted(instrument, cube, options) for cube in both)
    found = calibrate(target.observables, [calibrator.observables]).observables
    values = (
        target.average.vis2 - 1.0,
        np.degrees(target.average.closure_phase),
        found.vis2.value - 1.0,
        np.degrees(found.closure_phase.value),
    )
    return np.array([np.sqrt(np.mean(v**2)) for v in values])


def row(case: str, label: str, found: FloatArray) -> str:
    vis2, closure, vis2_cal, closure_cal = found
    return f"| {case} | {label} | {vis2:.1e} | {closure:.1e} | {vis2_cal:.1e} | {closure_cal:.1e} |"


def table() -> list[str]:
    instrument = load_instrument("niriss", "F430M")
    lines = [
        "| images | method | V² | closure phase | calibrated V² | calibrated closure phase |",
        "|---|---|---|---|---|---|",
    ]
    for case, make in cases(instrument).items():
        both = make()
        for method in METHODS:
            options = ExtractOptions(method=method, covariance="physical")  # type: ignore[arg-type]
            lines.append(row(case, f"`{method}`", biases(instrument, both, options)))
            if case.startswith(("pixels", "mask")):
                stated = replace(options, geometry="stated")
                found = biases(instrument, both, stated)
                lines.append(row(case, f"`{method}`, geometry as stated", found))
            print(lines[-1], flush=True)
    return lines


def main() -> int:
    put_table("extraction.md", table(), "table: docs/extraction_table.py")
    return 0


if __name__ == "__main__":
    sys.exit(main())
