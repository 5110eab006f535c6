"""Charge migration in numbers: false alarms with and without it, coefficients, other effects.

    python -m benchmarks.charge_migration nulls [--n 200] [--photons 1e8] [--ratio 0.5]
    python -m benchmarks.charge_migration binaries [--n 100] [--photons 1e8] [--ratio 0.5]
    python -m benchmarks.charge_migration coefficients [--n 200]
    python -m benchmarks.charge_migration effects
    python -m benchmarks.charge_migration time

Everything is simulated in F480M: a target whose brightest pixel ends at 28 000 electrons and three
calibrators of a ratio of its brightness, on one detector whose brightest pixel loses 1 % to its
neighbours. In full: ``--n 200`` at 1e7, 1e8 and 1e9 photons and ratios of 1, 0.5 and 0.25, hours on
one core. Numbers are printed as tables of Markdown.
"""

from __future__ import annotations

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import argparse
import resource
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import binomtest

from amibayes import Likelihood, search, significance, statistic_of
from amibayes.calibration import calibrate
from amibayes.cube import open_cube
from amibayes.data.observables import Observables
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.reading import ImageOptions, of_one_visit, read_observations
from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.parallel import SerialExecutor
from amibayes.pipeline.false_alarm import false_alarm
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.ramps.curvature import curvature_of
from amibayes.ramps.fit import fit_migration
from amibayes.scene.sources import Point, Scene
from amibayes.simulation.detector import Detector, draw_maps
from amibayes.simulation.exposure import Exposure
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import prepare_exposure, ramp_path, write_exposure
from amibayes.units import MAS, FloatArray

SHIFT, PEAK_E, N_GROUPS = 3.6e-7, 28_000.0, 8
CALIBRATORS = 3
FIELD_MAS = (50.0, 400.0)
INSTRUMENT = load_instrument("niriss", "F480M")
PLAIN = Detector(zero_read=False)
MOVING = replace(PLAIN, boundary_shift_x=SHIFT, boundary_shift_y=SHIFT)


def peak_share() -> float:
    """Share of the photons that the brightest pixel of a centred star gets."""
    channels = INSTRUMENT.bandpass.channels()
    return float(scene_image(Scene(), INSTRUMENT, channels).centred.max())


def n_integrations(photons: float, n_groups: int = N_GROUPS) -> int:
    """Integrations of the target that collect so many photons."""
    return max(round(photons / (PEAK_E / peak_share())), 2)


def exposed(
    path: Path,
    scene: Scene,
    detector: Detector,
    seed: Sequence[int],
    *,
    n_int: int,
    n_groups: int = N_GROUPS,
    ratio: float = 1.0,
    jitter: bool = True,
) -> Path:
    """Write slopes and ramps of an exposure; give the path of the slopes."""
    rate = ratio * PEAK_E / (peak_share() * n_groups * detector.frame_time_s)
    pointing = {} if jitter else {"jitter_rad": 0.0, "dither_rad": 0.0}
    exposure = Exposure(n_groups, n_int, keep_ramps=True, **pointing)
    observation = Observation(scene, INSTRUMENT, exposure, detector, count_rate_e_s=rate)
    maps = draw_maps(detector, (80, 80), np.random.default_rng(seed[0]))
    prepared = prepare_exposure(observation, np.random.SeedSequence(list(seed)), maps)
    write_exposure(path, prepared, SerialExecutor())
    return path


def visit(
    folder: Path, detector: Detector, seed: int, n_int: int, ratio: float, truth: FloatArray | None
) -> list[Path]:
    """Slopes of a target and its calibrators; ramps are beside."""
    companion = () if truth is None else (Point(truth[2], truth[0] * MAS, truth[1] * MAS),)
    paths = []
    for k in range(1 + CALIBRATORS):
        scene = Scene((Point(), *(companion if k == 0 else ())), f"star {k}")
        path = folder / f"star{k}_calints.fits"
        own = ratio if k else 1.0
        paths.append(exposed(path, scene, detector, (seed, k), n_int=n_int, ratio=own))
    return paths


def calibrated(paths: Sequence[Path], migration: float | str) -> Observables:
    """Extract target (first) and calibrators, and calibrate."""
    # The geometry is known, and so are the calibrators: nothing but migration is in question.
    chosen = ExtractOptions(charge_migration=migration, geometry="stated")
    images = of_one_visit(paths, ImageOptions(chosen))
    target = read_observations(paths[:1], images)
    calibrators = [read_observations([path], images)[0] for path in paths[1:]]
    return calibrate(target, calibrators, method="weighted").observables


WAYS: dict[str, tuple[Detector, bool, float | str]] = {
    "no migration": (PLAIN, True, "off"),
    "no migration, fitted to ramps": (PLAIN, True, "fit"),
    "left in": (MOVING, True, "off"),
    "fitted to ramps": (MOVING, True, "fit"),
    "instrument's value, slopes": (MOVING, False, "fit"),
}
"""Detector, whether its ramps are given, and what is done about migration."""


def each_way(
    seed: int, n_int: int, ratio: float, truth: FloatArray | None
) -> dict[str, Observables]:
    """Calibrated observables of one visit, by the way that migration is treated."""
    found = {}
    for detector in (PLAIN, MOVING):
        with tempfile.TemporaryDirectory() as name:
            slopes = visit(Path(name), detector, seed, n_int, ratio, truth)
            ramps = [ramp_path(path) for path in slopes]
            for way, (own, from_ramps, migration) in WAYS.items():
                if own is detector:
                    found[way] = calibrated(ramps if from_ramps else slopes, migration)
    return found


def nulls(n: int, photons: float, ratio: float) -> None:
    """Shares of single stars below a false-alarm probability, errors as stated and noise fitted."""
    options = SearchOptions(separation_mas=FIELD_MAS, null_draws=500)
    n_int = n_integrations(photons)
    below: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    gains: dict[str, list[float]] = {way: [] for way in WAYS}
    for seed in range(n):
        for way, data in each_way(seed, n_int, ratio, None).items():
            result = search_field(data, options).result
            tested = false_alarm(result, options, np.random.default_rng(seed))
            stated = search(Likelihood(data), FIELD_MAS)
            bare = significance(statistic_of(stated), 500, np.random.default_rng(seed))
            below[way].append((float(bare.probability), float(tested.probability)))
            point = data.data.copy()
            point[: data.n_vis2] -= 1.0
            gains[way].append(float(point @ data.covariance.solve(point)) / data.n_independent)
        shown = [f"{p:.3f}" for pairs in below.values() for p in pairs[-1]]
        print(seed, *shown, file=sys.stderr, flush=True)
    print(f"\n{n} single stars, {photons:g} photons ({n_int} integrations), ratio {ratio:g}\n")
    columns = [f"p < {limit}, {kind}" for kind in ("stated", "fitted") for limit in (0.05, 0.01)]
    print(f"| migration | {' | '.join(columns)} | χ²/n of a point, median |\n|{'---|' * 6}")
    for way, pairs in below.items():
        shares = [share(p < limit) for p in np.array(pairs).T for limit in (0.05, 0.01)]
        print(f"| {way} | {' | '.join(shares)} | {np.median(gains[way]):.2f} |", flush=True)


def share(hit: np.ndarray) -> str:
    """Share with its 95 % interval."""
    interval = binomtest(int(hit.sum()), len(hit)).proportion_ci()
    return f"{hit.mean():.3f} ({interval.low:.3f} to {interval.high:.3f})"


def binaries(n: int, photons: float, ratio: float) -> None:
    """Bias, pulls and coverage of fitted companions, contrast 0.001 to 0.1, 100 to 400 mas."""
    n_int = n_integrations(photons)
    options = SearchOptions(separation_mas=FIELD_MAS)
    pulls: dict[str, list[float]] = {way: [] for way in WAYS}
    for seed in range(n):
        rng = np.random.default_rng(5000 + seed)
        radius, angle = rng.uniform(100.0, 400.0), rng.uniform(0.0, 2.0 * np.pi)
        contrast = 10.0 ** rng.uniform(-3.0, -1.0)
        truth = np.array([radius * np.sin(angle), radius * np.cos(angle), contrast])
        for way, data in each_way(9000 + seed, n_int, ratio, truth).items():
            found = search_field(data, options).result.companion
            if np.hypot(found.east_mas - truth[0], found.north_mas - truth[1]) < 60.0:
                pulls[way].append((found.contrast - contrast) / found.contrast_error)
    print(f"\n{n} binaries, {photons:g} photons, ratio {ratio:g}: contrast in units of its error\n")
    print(
        "| migration | found | median | rms | within 1 σ | within 2 σ |\n|---|---|---|---|---|---|"
    )
    for way, values in pulls.items():
        off = np.array(values)
        print(
            f"| {way} | {len(off)} | {np.median(off):.2f} | {np.sqrt((off**2).mean()):.2f} | "
            f"{(np.abs(off) < 1).mean():.2f} | {(np.abs(off) < 2).mean():.2f} |",
            flush=True,
        )


def coefficients(n: int) -> None:
    """Bias and pulls of the coefficients by integrations and groups."""
    print("| groups | integrations | bias / truth | error / truth | rms pull x | rms pull y |")
    print("|---|---|---|---|---|---|")
    for n_groups, n_int, few in (
        (4, 20, 1),
        (5, 20, 1),
        (8, 20, 1),
        (19, 20, 1),
        (8, 60, 1),
        (8, 1000, 10),
    ):
        fits = []
        with tempfile.TemporaryDirectory() as name:
            for seed in range(max(n // few, 2)):
                path = Path(name) / "star_calints.fits"
                exposed(path, Scene(), MOVING, (seed, 7), n_int=n_int, n_groups=n_groups)
                with open_cube(ramp_path(path)) as file:
                    measured = curvature_of(file)
                assert measured is not None
                fits.append(fit_migration([measured]).migration)
        value = np.array([f.value[:2] for f in fits])
        error = np.array([f.error[:2] for f in fits])
        pull = np.sqrt((((value - SHIFT) / error) ** 2).mean(axis=0))
        bias, spread = (
            value.mean() / SHIFT - 1.0,
            value.mean(axis=1).std() / np.sqrt(len(fits)) / SHIFT,
        )
        print(
            f"| {n_groups} | {n_int} | {bias:+.3f} ± {spread:.3f} | {error.mean() / SHIFT:.3f} | "
            f"{pull[0]:.2f} | {pull[1]:.2f} |",
            flush=True,
        )


EFFECTS = {
    "migration": MOVING,
    "inter-pixel capacitance 0.6 %": replace(PLAIN, interpixel_capacitance=0.006),
    "flat error 0.1 %": replace(PLAIN, flat_error=1e-3),
    "flat field of 1 %, divided out": replace(PLAIN, flat_field=0.01, flat_error=0.0),
    "flat field of 1 %, in the ramps": replace(PLAIN, flat_field=0.01, flat_error=0.0),
    "analogue-to-digital converter": replace(PLAIN, adc_nonlinearity=1.0),
    "pixel response 3 %": replace(PLAIN, pixel_response=0.03),
    "linearity off by 1 % of 3 %": replace(PLAIN, nonlinearity=0.03, linearity_error=0.01),
    "1/f noise of 5 e⁻": replace(PLAIN, stripe_noise_e=5.0),
    "threshold at 26 000 e⁻, 7.5 %": replace(PLAIN, migration=0.075),
}


def effects() -> None:
    """What each effect does to V² and closure phase, without photon noise, after calibration."""
    print("| effect | ratio | V² rms | V² mean | closure phase rms, deg |\n|---|---|---|---|---|")
    for label, detector in EFFECTS.items():
        silent = replace(detector, photon_noise=False, read_noise_e=0.5)
        silent = replace(silent, flat_error=detector.flat_error if "flat" in label else 0.0)
        for ratio in (1.0, 0.5):
            with tempfile.TemporaryDirectory() as name:
                paths = [
                    exposed(
                        Path(name) / f"s{k}_calints.fits",
                        Scene((Point(),), f"star {k}"),
                        silent,
                        (3, k),
                        n_int=8,
                        ratio=ratio if k else 1.0,
                    )
                    for k in range(2)
                ]
                given = [ramp_path(p) for p in paths] if "in the ramps" in label else paths
                data = calibrated(given, "off")
            vis2, closure = data.data[: data.n_vis2] - 1.0, np.degrees(data.data[data.n_vis2 :])
            print(
                f"| {label} | {ratio:g} | {vis2.std():.1e} | {vis2.mean():+.1e} | "
                f"{np.sqrt((closure**2).mean()):.4f} |",
                flush=True,
            )


def duration() -> None:
    """Time of 1000 integrations of 8 groups against that of their slopes, and memory."""
    with tempfile.TemporaryDirectory() as name:
        path = exposed(Path(name) / "s_calints.fits", Scene(), MOVING, (1, 1), n_int=1000)
        taken = {}
        for label, file, migration in (
            ("slopes, left in", path, "off"),
            ("slopes, instrument's value", path, "fit"),
            ("ramps, left in", ramp_path(path), "off"),
            ("ramps, fitted", ramp_path(path), "fit"),
        ):
            start = time.process_time()
            images = of_one_visit([file], ImageOptions(ExtractOptions(charge_migration=migration)))
            read_observations([file], images)
            taken[label] = time.process_time() - start
    for label, seconds in taken.items():
        print(f"| {label} | {seconds:.1f} s | {seconds / taken['slopes, left in']:.1f} |")
    print(f"largest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


def main() -> None:
    """Do what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    kinds: dict[str, Callable[..., None]] = {
        "nulls": nulls,
        "binaries": binaries,
        "coefficients": coefficients,
        "effects": effects,
        "time": duration,
    }
    parser.add_argument("what", choices=tuple(kinds))
    parser.add_argument("--n", type=int, default=200)
    parser.add_argument("--photons", type=float, default=1e8)
    parser.add_argument("--ratio", type=float, default=0.5)
    arguments = parser.parse_args()
    if arguments.what in ("nulls", "binaries"):
        kinds[arguments.what](arguments.n, arguments.photons, arguments.ratio)
    elif arguments.what == "coefficients":
        coefficients(arguments.n)
    else:
        kinds[arguments.what]()


if __name__ == "__main__":
    main()
