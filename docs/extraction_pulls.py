"""Bias and pulls of calibrated observables, from the detector's reads on, as a table.

    python docs/extraction_pulls.py

A star without a companion is observed twice on one detector, as a target and as its own
calibrator. Every exposure is simulated with its noise and, the same pointings, without. To
first order in the noise the observables follow from the difference of the two, and the mean
of that part is zero, whatever the noise: taken off, it leaves the bias and little else, and a
few dozen pairs show a bias of a few hundredths of an error.
The table goes to docs/extraction.md, between the lines that mark it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from pages import put_table

from amibayes import Scene, load_instrument
from amibayes.calibration import calibrate
from amibayes.cube import Cube
from amibayes.extraction import Extraction, ExtractOptions, extract_all
from amibayes.extraction.fourier.fine_image import FineImage
from amibayes.extraction.fourier.sampling import split
from amibayes.extraction.frames import average
from amibayes.extraction.image_plane import shift_of
from amibayes.extraction.response import pointing_response, star_image
from amibayes.parallel import SerialExecutor
from amibayes.simulation import Detector, Exposure
from amibayes.simulation.detector import draw_maps
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import PreparedExposure, blank_cube, prepare_exposure
from amibayes.units import MAS, FloatArray

N_INTEGRATIONS, N_GROUPS, N_PAIRS = 20, 14, 32

DITHER_RAD = 15.0 * MAS

STEP = 1e-3
"""Of the noise, for derivatives."""

VIS2, CLOSURE = slice(0, 21), slice(21, 56)

IDEAL = np.concatenate([np.ones(21), np.zeros(35)])

FLATS = {
    "right": (0.0, DITHER_RAD),
    "0.1 % wrong, same pointing": (1e-3, 0.0),
    "0.1 % wrong, dithers of 15 mas": (1e-3, DITHER_RAD),
}
"""Error of the flat field, and how far apart target and calibrator are."""


def pair(
    photons: float,
    n: int,
    seed: int,
    flat_error: float = 0.0,
    dither_rad: float = DITHER_RAD,
    *,
    noise: bool = True,
    n_groups: int = N_GROUPS,
) -> list[Cube]:
    """Two exposures of one star on one detector, whose flat is known to ``flat_error``.

    With and without ``noise`` flat and pointings are the same.
    """
    detector = Detector(flat_error=flat_error, full_well_e=1e9)
    if not noise:
        detector = replace(detector, photon_noise=False, read_noise_e=0.0)
    observation = Observation(
        Scene(),
        load_instrument("niriss", "F430M"),
        Exposure(n_groups, n, dither_rad=dither_rad),
        detector=detector,
        count_rate_e_s=photons / n / (n_groups * detector.frame_time_s),
    )
    maps, *exposures = np.random.SeedSequence(seed).spawn(3)
    drawn = draw_maps(detector, (80, 80), np.random.default_rng(maps))
    return [taken(prepare_exposure(observation, child, drawn)) for child in exposures]


def taken(prepared: PreparedExposure) -> Cube:
    """The exposure in memory."""
    chunks = list(prepared.take(SerialExecutor()))
    images, error, dq = (
        np.concatenate([getattr(c, name) for c in chunks]) for name in ("images", "error", "dq")
    )
    return replace(blank_cube(prepared), images=images, error=error, dq=dq)


def first_order(quiet: Extraction, cube: Cube, noisy: FloatArray) -> FloatArray:
    """What noise does to V² and closure phase (56,) of an extraction without it, linearly."""
    operator = quiet.operators[0]
    part = np.s_[:, operator.view.rows, operator.view.columns]
    images, change = (
        np.asarray(a, dtype=float)[part].reshape(len(noisy), -1) @ operator.sampling.matrix
        for a in (cube.images, noisy - cube.images)
    )
    star = star_image(operator.view)
    ahead, behind = (_observables(quiet, star, images + s * change) for s in (STEP, -STEP))
    return (ahead - behind) / (2.0 * STEP)


def _observables(quiet: Extraction, star: FineImage, numbers: FloatArray) -> FloatArray:
    """V² and closure phase of the mean of some integrations' numbers, pointing included."""
    operator = quiet.operators[0]
    sampling, view = operator.sampling, operator.view
    flux, samples = split(numbers)
    frames = replace(
        quiet.frames,
        power=sampling.power(samples),
        square=flux**2,
        bispectrum=sampling.bispectrum(samples),
    )
    pointed = pointing_response(
        star, sampling, shift_of(view, sampling.fringes(samples), operator.weight)
    )
    found = average(frames, pointed, view.instrument.mask.triangle_baselines)
    return np.concatenate([found.vis2, found.closure_phase])


@dataclass(frozen=True, eq=False)
class Pulls:
    """Calibrated observables of some pairs.

    Parameters
    ----------
    off : (n, 56) array
        From the truth.
    first_order : (n, 56) array
        The part of it that is linear in the noise.
    noiseless : (n, 56) array
        What is off without noise: of the pair, its flat and its pointings.
    sigma : (n, 56) array
        Stated errors.
    white : (n, 36) array
        Whitened with the stated covariance.
    physical : (n, 56) array
        Scatter of the target's integrations in units of what noise is expected to make.
    """

    off: FloatArray
    first_order: FloatArray
    noiseless: FloatArray
    sigma: FloatArray
    white: FloatArray
    physical: FloatArray

    def bias(self, part: slice) -> tuple[float, float]:
        """Bias in units of the error, rms over observables, and the noise's share in that."""
        rest = ((self.off - self.first_order) / self.sigma)[:, part]
        error = rest.std(axis=0, ddof=1) / np.sqrt(len(rest))
        return rms(rest.mean(axis=0)), rms(error)

    def own(self, part: slice) -> float:
        """Systematic error of one pair in units of its stated error, rms."""
        return rms((self.noiseless / self.sigma)[:, part])


def rms(values: FloatArray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def pulls(photons: float, method: str, flat: tuple[float, float], seeds: Iterable[int]) -> Pulls:
    """Simulate, extract and calibrate pairs, one per seed."""
    options = ExtractOptions(method=method)  # type: ignore[arg-type]
    return _stacked([one_pair(photons, options, flat, seed) for seed in seeds])


def one_pair(
    photons: float, options: ExtractOptions, flat: tuple[float, float], seed: int
) -> Pulls:
    """As `pulls`, of one pair."""
    noisy, quiet = (pair(photons, N_INTEGRATIONS, seed, *flat, noise=n) for n in (True, False))
    quiet = [replace(q, error=c.error) for q, c in zip(quiet, noisy, strict=True)]
    found, bare = ([extract_all(c, options)[0] for c in cubes] for cubes in (noisy, quiet))
    linear = [
        first_order(e, q, np.asarray(c.images, dtype=float))
        for e, q, c in zip(bare, quiet, noisy, strict=True)
    ]
    seen, ideal = (
        calibrate(both[0].observables, [both[1].observables]).observables for both in (found, bare)
    )
    off = seen.data - IDEAL
    expected = np.sqrt(np.diag(found[0].physical))
    return Pulls(
        off,
        linear[0] - linear[1],
        ideal.data - IDEAL,
        np.sqrt(seen.covariance.variance),
        seen.covariance.whiten(off),
        found[0].average.deviation.std(axis=0, ddof=1) / expected,
    )


def _stacked(parts: list[Pulls]) -> Pulls:
    return Pulls(**{f.name: np.stack([getattr(p, f.name) for p in parts]) for f in fields(Pulls)})


def table() -> list[str]:
    """Lines of the table."""
    lines = [
        "| flat field | photons | method | σ(V²) | σ(closure phase) | bias of V² | bias of closure "
        "phase | of a pair: V² | closure phase | pulls |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for label, flat in FLATS.items():
        for photons in (1e6, 1e7, 1e8, 1e9):
            for method in ("fringes", "matched"):
                lines.append(
                    row(label, photons, method, pulls(photons, method, flat, range(N_PAIRS)))
                )
                print(lines[-1], flush=True)
    return lines


def row(label: str, photons: float, method: str, found: Pulls) -> str:
    """One line of it."""
    biases = (f"{b:.3f} ({e:.3f})" for b, e in map(found.bias, (VIS2, CLOSURE)))
    own = (f"{found.own(part):.3f}" for part in (VIS2, CLOSURE))
    vis2, closure = found.sigma[:, VIS2].mean(), np.degrees(found.sigma[:, CLOSURE].mean())
    cells = (label, f"{photons:.0e}", f"`{method}`", f"{vis2:.1e}", f"{closure:.2g}°")
    return f"| {' | '.join((*cells, *biases, *own, f'{found.white.std():.3f}'))} |"


def main() -> int:
    """Put the table where it belongs."""
    put_table("extraction.md", table(), "table: docs/extraction_pulls.py")
    return 0


if __name__ == "__main__":
    sys.exit(main())
