"""Errors of an extraction against simulated exposures: pulls, efficiency, coverage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import script
from scipy import stats

from amibayes.calibration import calibrate
from amibayes.companion_search.search import search
from amibayes.cube import Cube
from amibayes.data.shrinkage import lag_one, shrunk_covariance
from amibayes.extraction import Extraction, ExtractOptions, extract_all
from amibayes.extraction.image_plane import fringe_sampling
from amibayes.extraction.noise import scatter_about_pointing
from amibayes.instrument import load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.optics import psf
from amibayes.scene.sources import Point, Scene
from amibayes.simulation import Detector, Exposure, simulate
from amibayes.units import MAS, FloatArray

_pulls = script("extraction_pulls")
VIS2, CLOSURE, IDEAL, pair = _pulls.VIS2, _pulls.CLOSURE, _pulls.IDEAL, _pulls.pair

QUICK = ((1e6, "fringes", "right"), (1e9, "matched", "0.1 % wrong, same pointing"))
"""Cells of the table that the default suite looks at, with fewer pairs."""

NOISELESS = Detector(flat_error=0.0, photon_noise=False, read_noise_e=0.0)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def wishart_data(n: int, rng: np.random.Generator, p: int = 36) -> tuple[FloatArray, FloatArray]:
    """Deviations of n draws from their mean, and the error of that mean, true covariance 1."""
    draws = rng.standard_normal((n, p))
    return draws - draws.mean(axis=0), draws.mean(axis=0)


@pytest.mark.parametrize(
    ("n", "scale", "trials"),
    [
        *((20, 2.0, 100), (200, 1.0, 100)),
        *(pytest.param(n, s, 300, marks=pytest.mark.slow) for n in (20, 50, 200) for s in (1, 2)),
    ],
)
def test_intervals_cover(n: int, scale: float, trials: int) -> None:
    rng = np.random.default_rng(1000 * n)
    weights = rng.standard_normal(36)
    inside = 0
    for _ in range(trials):
        deviation, mean = wishart_data(n, rng)
        found = shrunk_covariance(deviation, np.eye(36) / scale, np.eye(36), 21)
        sigma = np.sqrt(weights @ found.matrix @ weights / n)
        inside += abs(weights @ mean) < sigma
    # 4.2 binomial standard deviations of 68.3 %.
    assert inside / trials == pytest.approx(0.683, abs=4.2 * np.sqrt(0.683 * 0.317 / trials))


def test_generalised_least_squares_covers_at_few_integrations() -> None:
    """An amplitude fitted with the inverse covariance, where plug-in errors cover 19 %."""
    rng = np.random.default_rng(7)
    template = rng.standard_normal(36)
    trials, inside = 150, 0
    for _ in range(trials):
        deviation, mean = wishart_data(20, rng)
        matrix = shrunk_covariance(deviation, np.eye(36), np.eye(36), 21).matrix / 20
        weight = np.linalg.solve(matrix, template)
        inside += abs(weight @ mean) < np.sqrt(weight @ template)
    # 4.2 binomial standard deviations.
    assert inside / trials == pytest.approx(0.683, abs=0.16)


def test_scatter_wins_where_the_physics_is_wrong() -> None:
    rng = np.random.default_rng(3)
    root = np.eye(36) + 0.5 * rng.standard_normal((36, 36)) / 6.0
    draws = rng.standard_normal((2000, 36)) @ root.T
    found = shrunk_covariance(draws - draws.mean(axis=0), np.eye(36), np.eye(36), 21)
    assert found.prior_freedom < 1000.0
    # Relative errors of a sample covariance of 2000: 3 % on the diagonal.
    np.testing.assert_allclose(np.diag(found.matrix), np.diag(root @ root.T), rtol=0.15)


def test_correlation_in_time_is_found_and_paid_for() -> None:
    rng = np.random.default_rng(4)
    noise = rng.standard_normal((401, 36))
    drifting = noise[1:] + noise[:-1]  # lag one: 0.5; variance of the mean 4/n, not 2/n
    deviation = drifting - drifting.mean(axis=0)
    found = shrunk_covariance(deviation, 2.0 * np.eye(36), np.eye(36), 21)
    assert found.correlation == pytest.approx(0.5, abs=0.05)
    assert found.block > 1
    assert np.diag(found.matrix).mean() == pytest.approx(4.0, rel=0.2)
    quiet = shrunk_covariance(noise - noise.mean(axis=0), np.eye(36), np.eye(36), 21)
    assert quiet.block == 1
    assert abs(lag_one(noise.T)) < 4.5 / np.sqrt(noise.size)


def observed(photons: float, seed: int, method: str, flat_error: float = 0.0) -> list[Extraction]:
    """Target and calibrator, both of one star, on one detector."""
    options = ExtractOptions(method=method)  # type: ignore[arg-type]
    return [extract_all(cube, options)[0] for cube in pair(photons, 20, seed, flat_error)]


def bound(extraction: Extraction, cube: Cube) -> FloatArray:
    """Cramér–Rao bound (56,) of one integration: the fit whose weights are the true variances."""
    operator = extraction.operators[0]
    assert cube.error is not None
    variance = np.mean(np.asarray(cube.error, dtype=float) ** 2, axis=0).ravel()
    design = operator.fit.design
    numbers = np.linalg.inv(design.T @ (design / variance[:, None]))[:-1, :-1]
    flux = float(extraction.frames.flux.mean())
    fit = fringe_sampling(operator.view, None, operator.fit)
    jacobian = fit.jacobian(flux, np.full(21, flux, dtype=complex))
    return np.asarray(np.sqrt(np.diag(jacobian @ numbers @ jacobian.T)))


@pytest.mark.parametrize(
    ("photons", "method", "flat"),
    [
        pytest.param(p, m, f, marks=() if (p, m, f) in QUICK else pytest.mark.slow)
        for p in (1e6, 1e7, 1e8, 1e9)
        for m in ("fringes", "matched")
        for f in ("right", "0.1 % wrong, same pointing")
    ],
)
def test_calibrated_pulls(photons: float, method: str, flat: str) -> None:
    """No bias above a tenth of the error, and errors that are neither too small nor too large."""
    n = 4 if (photons, method, flat) in QUICK else 12
    found = _pulls.pulls(photons, method, _pulls.FLATS[flat], range(n))
    for part in (VIS2, CLOSURE):
        # What second order leaves of the noise is 0.08 σ per pair at 1e6 photons, and a flat
        # under the jitter 0.07 σ at 1e9: 0.04 of four pairs, 0.023 of twelve. With the bias
        # found, at most 0.03, the rms over 21 or 15 numbers stays below 0.1 by ten of its errors.
        assert found.bias(part)[0] < 0.1
    # n × 36 numbers of unit variance: 3.7 or 5.9 % (4); the probability of this is 1e-4.
    rate = stats.chi2.cdf(np.sum(found.white**2), found.white.size)
    assert 5e-5 < rate < 1.0 - 5e-5
    # Nor do the integrations scatter otherwise than photons and read noise are expected to make
    # them: 20 n × 36 numbers, 1 % (2 %).
    assert rms(found.physical) == pytest.approx(1.0, abs=0.06)


@pytest.mark.parametrize(
    "photons", [1e6, 1e9, *(pytest.param(p, marks=pytest.mark.slow) for p in (1e7, 1e8))]
)
def test_scatter_is_near_the_cramer_rao_bound(photons: float) -> None:
    cube = pair(photons, 60, 5)[0]
    for method, worst in (("fringes", 1.15), ("matched", 1.4)):
        found = extract_all(cube, ExtractOptions(method=method))[0]  # type: ignore[arg-type]
        ratio = found.average.deviation.std(axis=0, ddof=1) / bound(found, cube)
        for part in (VIS2, CLOSURE):
            # 60 integrations of 21 or 15 independent numbers: 2.5 to 3 %.
            assert np.sqrt(np.mean(ratio[part] ** 2)) < worst + 0.03


@pytest.mark.parametrize(
    "method", ["fringes", *(pytest.param(m, marks=pytest.mark.slow) for m in ("matched", "unique"))]
)
def test_pointing_does_not_bias_what_is_calibrated(method: str) -> None:
    """Jitter and dither without noise: the bias is below a tenth of the error at 1e9 photons."""
    instrument, rng = load_instrument("niriss", "F430M"), np.random.default_rng(31)
    options = ExtractOptions(method=method)  # type: ignore[arg-type]
    both = []
    for dither in ((0.2, 0.1), (-0.15, 0.05)):
        at = np.array(dither) + 0.1 * rng.standard_normal((8, 2))
        channels = instrument.bandpass.channels()
        images = 5e7 * np.stack([psf(instrument, channels, 80, centre_px=tuple(p)) for p in at])
        cube = Cube(images, instrument.pixel_scale_rad, "NIRISS", "F430M", error=np.sqrt(images))
        both.append(extract_all(cube, options)[0].observables)
    off = calibrate(both[0], [both[1]]).observables.data - IDEAL
    # σ of a closure phase at 1e9 photons is √1.5 · 7 / √1e9 = 2.7e-4 rad, and of V² as much.
    assert np.abs(off).max() < 2.7e-5


@pytest.mark.parametrize("method", ["fringes", pytest.param("matched", marks=pytest.mark.slow)])
def test_bright_stars_are_not_biased(method: str) -> None:
    scaled = []
    for seed in range(3):
        found = observed(1e9, 40 + seed, method)
        calibrated = calibrate(found[0].observables, [found[1].observables]).observables
        scaled.append((calibrated.data - IDEAL) / np.sqrt(calibrated.covariance.variance))
    # 63 values of V²; their mean is known to 0.13 were they independent.
    assert abs(np.mean(np.array(scaled)[:, VIS2])) < 0.6


@pytest.mark.parametrize(
    ("separation", "angle_deg", "contrast"),
    [
        (300.0, 70.0, 0.7),
        *(
            pytest.param(*case, 0.4, marks=pytest.mark.slow)
            for case in ((250.0, 34.0), (100.0, 10.0), (400.0, 37.0))
        ),
    ],
)
def test_bright_companions_are_not_biased(
    separation: float, angle_deg: float, contrast: float
) -> None:
    """Without noise, weighed as photon noise would be: what is left is the method's own.

    Weights that followed the images' own fringes took half a percent off the contrast, and a
    companion's light that was taken for another pixel scale moved it by 0.2 % of its distance.
    What remains, up to 0.6 %, is that the centre is not exactly on the brighter star.
    """
    angle = np.radians(angle_deg)
    companion = separation * MAS * np.array([np.sin(angle), np.cos(angle)])
    target, calibrator = (
        quiet(Scene(parts)) for parts in ((Point(), Point(contrast, *companion)), (Point(),))
    )
    assert target.operators[0].geometry.stated
    data = calibrate(target.observables, [calibrator.observables]).observables
    modes = search(Likelihood(data), (separation - 50.0, separation + 50.0)).modes
    # The mask's lattice has aliases that fit nearly as well.
    places = np.array([[m.companion.east_mas, m.companion.north_mas] for m in modes])
    off = np.hypot(*(places - companion / MAS).T)
    assert off.min() < 0.25
    assert modes[int(off.argmin())].companion.contrast == pytest.approx(contrast, rel=0.007)


def quiet(scene: Scene) -> Extraction:
    """Integrations without noise, whose errors are those of photons and read noise."""
    instrument, exposure = load_instrument("niriss", "F430M"), Exposure(14, 3)
    settings = {"count_rate_e_s": 1.2e6}
    noisy, bare = (
        simulate(scene, instrument, exposure, np.random.default_rng(3), detector=d, **settings)
        for d in (Detector(flat_error=0.0), NOISELESS)
    )
    options = ExtractOptions(covariance="physical")
    return extract_all(replace(bare, error=noisy.error), options)[0]


@pytest.mark.parametrize("n", [5, 6, 11, 12, 30])
def test_what_goes_with_the_pointing_is_no_scatter(n: int) -> None:
    """Its polynomial of as many terms as are at most half of the integrations."""
    rng = np.random.default_rng(n)
    shift, noise = rng.standard_normal((n, 2)), rng.standard_normal((n, 3))
    x, y = shift.T
    kinds = [np.ones(n), x + 2.0 * y, x**2 - 3.0 * x * y + y**2]
    least = [1, 6, 12]
    for terms, kind in zip(least, kinds, strict=True):
        left = scatter_about_pointing(1e3 * kind[:, None] * np.ones(3), shift)
        assert (left < 1e-12).all() == (n >= terms)
    design = np.stack(
        [np.ones(n), x, y, x * x, x * y, y * y][: 6 if n >= 12 else 3 if n >= 6 else 1]
    )
    rest = noise - design.T @ np.linalg.lstsq(design.T, noise, rcond=None)[0]
    expected = (rest**2).sum(axis=0) / (n - len(design))
    np.testing.assert_allclose(scatter_about_pointing(noise, shift), expected)
