"""Injection and recovery in ten lines: in the observables, and in the images.

    python examples/injection_recovery.py

A NIRISS target and its calibrator are simulated; files serve as well (`read_cube`). A companion
counts as recovered when the search reports it at its place with a false-alarm probability
below 0.13 %. In the observables noise is drawn from their covariance: thousands of trials a
second. In the images the companion goes into the measured cube, which is then extracted,
calibrated and searched like any other.
"""

from __future__ import annotations

import numpy as np

from amibayes import (
    Exposure,
    Likelihood,
    Scene,
    calibrate,
    extract,
    load_instrument,
    make_criterion,
    measure_star,
    search,
    simulate,
)
from amibayes.cube import Cube
from amibayes.data.observables import Observables
from amibayes.units import FloatArray, offset

SEPARATION_MAS = 150.0
CONTRASTS = (0.001, 0.0015, 0.003)
TRIALS, TRIALS_IN_IMAGES = 1000, 2


def companions(contrast: float, n: int, rng: np.random.Generator) -> FloatArray:
    """Companions at one separation in all directions, (n, 3): east, north, contrast."""
    east, north = offset(SEPARATION_MAS, rng.uniform(0.0, 360.0, n))
    return np.column_stack([east, north, np.full(n, contrast)])


def observe(rng: np.random.Generator) -> Cube:
    """Images of a single star: twenty integrations of nineteen groups."""
    niriss = load_instrument("niriss", "F480M")
    return simulate(Scene(), niriss, Exposure(19, 20), rng, count_rate_e_s=1.1e6)


def main() -> list[tuple[float, float, float]]:
    """Print contrast and share recovered, in the observables and in the images."""
    rng = np.random.default_rng(1)
    target, calibrator = observe(rng), extract(observe(rng))

    def calibrated(cube: Cube) -> Observables:
        return calibrate(extract(cube), [calibrator]).observables

    criterion = make_criterion(search(Likelihood(calibrated(target)), (50.0, 400.0)), rng)
    star, shares = measure_star(target), []
    for contrast in CONTRASTS:
        by_data = criterion.recover(companions(contrast, TRIALS, rng), rng).located
        by_images = [
            criterion.apply(calibrated(star.with_companion(*one, rng)), *one[:2]).located
            for one in companions(contrast, TRIALS_IN_IMAGES, rng)
        ]
        shares.append((contrast, float(np.mean(by_data)), float(np.mean(by_images))))
        print(
            "contrast {:.4f}: {:.1%} in the observables, {:.0%} in the images".format(*shares[-1])
        )
    return shares


if __name__ == "__main__":
    main()
