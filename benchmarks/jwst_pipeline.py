"""Simulated visits through stage 3 of the jwst package and through amibayes, against the truth.

`docs/jwst_pipeline.py` makes the tables. A visit is a target and a calibrator of the same
brightness, each in a ``calints`` file as `amibayes simulate` writes it. The step ``ami_analyze``
takes 2 s of CPU for an integration, nearly all of it for the fringe model at that integration's
centre; with ``reuse`` a model is kept for centres that agree to a twentieth of a pixel, which
takes a tenth of that where the pointing does not jitter.
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes import Likelihood, Observables, analytic_limit, calibrate, load_instrument
from amibayes.extraction.reading import ImageOptions, of_one_visit, read_observations
from amibayes.models.binary import BinaryModel
from amibayes.optics import PupilMap
from amibayes.parallel import SerialExecutor
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import Point, Scene
from amibayes.simulation import Detector, Exposure
from amibayes.simulation.detector import draw_maps
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import prepare_exposure, write_exposure
from amibayes.units import DEGREE, MAS, FloatArray
from benchmarks import peers
from benchmarks.statements import errors_of, searched

PUPIL_M, PUPIL_CELLS = 6.603464, 1024
"""Side of the reference file's picture of the mask, and its pixels."""

FILTER, RATE_E_S, N_GROUPS, ROLL_DEG = "F480M", 1.8e6, 10, 33.0

LIMIT_MAS = (100.0, 200.0, 300.0)

ROUTES = ("calints", "amimulti-oi", "ami-oi", "aminorm-oi")
"""Images by amibayes; integrations, averages, and calibrated averages of the jwst package."""


@dataclass(frozen=True)
class Visit:
    """What is simulated.

    Parameters
    ----------
    truth : (3,) array or None
        East, north (mas) and flux ratio of a companion; None for a single star.
    seed : int
    n_integrations : int
    jitter_mas : float
    """

    truth: FloatArray | None
    seed: int
    n_integrations: int
    jitter_mas: float = 7.0

    def write(self, folder: Path) -> list[Path]:
        """Simulate target and calibrator; return their files."""
        detector = Detector()
        maps = draw_maps(detector, (80, 80), np.random.default_rng([self.seed, 1]))
        paths = []
        for k, name in enumerate(("target", "calibrator")):
            points = [Point()]
            if self.truth is not None and not k:
                points.append(Point(self.truth[2], self.truth[0] * MAS, self.truth[1] * MAS))
            exposure = Exposure(N_GROUPS, self.n_integrations, jitter_rad=self.jitter_mas * MAS)
            observation = Observation(
                Scene(tuple(points), name),
                load_instrument("niriss", FILTER).as_built(),
                exposure,
                detector,
                Orientation(ROLL_DEG * DEGREE),
                start_mjd=60000.0 + 0.02 * k,
                count_rate_e_s=RATE_E_S,
                notes={"IS_PSF": bool(k)},
            )
            prepared = prepare_exposure(
                observation, np.random.SeedSequence([self.seed, 2, k]), maps
            )
            paths.append(folder / f"{name}_calints.fits")
            write_exposure(paths[-1], prepared, SerialExecutor())
        return paths


def write_optics(path: Path, filter_name: str = FILTER) -> None:
    """Write the mask (as drawn: the step has the map of commissioning) and the filter."""
    instrument = load_instrument("niriss", filter_name)
    mask, band = instrument.mask, instrument.bandpass
    pupil = PupilMap(np.zeros((PUPIL_CELLS,) * 2), PUPIL_M)
    picture = np.zeros((PUPIL_CELLS,) * 2)
    centres = 0.5 * (pupil.edges_m[1:] + pupil.edges_m[:-1])
    for patch in pupil.patches(mask):
        rows, columns = (np.searchsorted(centres, axis) for axis in (patch.y_m, patch.x_m))
        picture[np.ix_(rows, columns)] += patch.area_m2 / pupil.cell_m**2
    np.savez(
        path,
        holes=mask.holes_m,
        flat_to_flat=mask.size_m,
        pupil=picture,
        angstrom=band.wavelength_m * 1e10,
        throughput=band.throughput,
        filter=band.name,
    )


def pipeline(
    paths: Sequence[Path], folder: Path, environments: Path, reuse: bool
) -> dict[str, float]:
    """Run the steps on target (first) and calibrators; return CPU seconds.

    Raises
    ------
    MissingPeerError
        Where jwst is not to be had, or fails.
    """
    write_optics(folder / "optics.npz")
    peer = next(p for p in peers.PEERS if p.name == "jwst")
    words = ["--reuse"] if reuse else []
    words += [str(folder / "optics.npz"), str(folder), *map(str, paths)]
    return peers.measure(peer, environments, *words)


def amibayes_route(paths: Sequence[Path]) -> tuple[Observables, float]:
    """Extract and calibrate; CPU seconds of it."""
    begin = time.process_time()
    images = of_one_visit(paths, ImageOptions())
    target, *others = (read_observations([path], images) for path in paths)
    data = calibrate(target, [o[0] for o in others], method="weighted").observables
    return data, time.process_time() - begin


def product_route(folder: Path, route: str) -> Observables:
    """Products as amibayes reads them, calibrated where the pipeline has not done it."""
    if route == "aminorm-oi":
        return read_observations([folder / "target_aminorm-oi.fits"])[0]
    psf = "" if route == "amimulti-oi" else "psf-"
    target, calibrator = (
        read_observations([folder / name])[0]
        for name in (f"target_{route}.fits", f"calibrator_{psf}{route}.fits")
    )
    return calibrate([target], [calibrator], method="weighted").observables


def delivered(folder: Path) -> dict[str, list[float]]:
    """Numbers of the pipeline's own calibrated file, untouched but for closure phases' wraps."""
    with fits.open(folder / "target_aminorm-oi.fits") as file:
        vis2, closure = file["OI_VIS2"].data, file["OI_T3"].data
        return {
            "vis2": vis2["VIS2DATA"].tolist(),
            "vis2_error": vis2["VIS2ERR"].tolist(),
            "closure_deg": ((closure["T3PHI"] + 180.0) % 360.0 - 180.0).tolist(),
            "closure_error_deg": closure["T3PHIERR"].tolist(),
        }


def numbers(data: Observables) -> dict[str, list[float]]:
    """The same of calibrated observables."""
    sigma, n = np.sqrt(data.covariance.variance), data.n_vis2
    return {
        "vis2": data.data[:n].tolist(),
        "vis2_error": sigma[:n].tolist(),
        "closure_deg": np.degrees(data.data[n:]).tolist(),
        "closure_error_deg": np.degrees(sigma[n:]).tolist(),
    }


def misfit(data: Observables, truth: FloatArray) -> dict[str, float]:
    """χ² of the truth for each independent number, of V² and of closure phases."""
    point = BinaryModel(diameter_mas=0.0)
    off, n = Likelihood(data, point).difference(truth[None])[:, 0], data.n_vis2
    parts = {"vis2": off[:n], "cp": off[n:]}
    noise = {kind: data.only((kind,)).covariance for kind in parts}
    return {
        f"chi2_{kind}": float((noise[kind].whiten(part) ** 2).sum() / noise[kind].rank)
        for kind, part in parts.items()
    }


def measured(data: Observables, truth: FloatArray | None) -> dict[str, Any]:
    """Of a single star its numbers and limits; of a binary what is stated of its companion."""
    if truth is not None:
        return {**errors_of(data, truth), **misfit(data, truth)}
    limit = analytic_limit(searched(data).noisy, "absil", separation_mas=LIMIT_MAS)
    return {**numbers(data), "limit_mag": limit.delta_mag.tolist()}


def make(visit: Visit, folder: Path, environments: Path, reuse: bool) -> dict[str, float]:
    """Simulate a visit and run the steps on it; return CPU seconds.

    A folder that has the visit already is left as it is, so that what is stated of its files
    can be worked out anew without them being made again.
    """
    done = folder / "seconds.json"
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        seconds = pipeline(visit.write(folder), folder, environments, reuse)
        for residuals in folder.glob("*_amilg.fits"):
            residuals.unlink()
        done.write_text(json.dumps(seconds), encoding="utf-8")
    return dict(json.loads(done.read_text(encoding="utf-8")))


def stated(visit: Visit, folder: Path) -> tuple[dict[str, Any], float]:
    """What each route states of a visit that was made; CPU seconds of amibayes' extraction."""
    paths = [folder / f"{name}_calints.fits" for name in ("target", "calibrator")]
    data, seconds = amibayes_route(paths)
    ways: dict[str, Any] = {"calints": measured(data, visit.truth)}
    for route in ROUTES[1:]:
        ways[route] = measured(product_route(folder, route), visit.truth)
    if visit.truth is None:
        ways["as delivered"] = delivered(folder)
    return ways, seconds
