"""Extraction against images and visibilities that it did not make."""

from __future__ import annotations

import json
import tracemalloc
import warnings
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from poppy_rig import poppy_image

from amibayes.calibration import calibrate
from amibayes.cli import main
from amibayes.companion_search.search import search
from amibayes.cube import Cube, cube_stream, read_cube, write_cube
from amibayes.cube.source import InMemoryCube
from amibayes.data.observables import Observables
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.errors import DataError, UsageError
from amibayes.extraction import METHODS, ExtractOptions, extract, extract_all
from amibayes.extraction.cleaning import median_and_scatter
from amibayes.extraction.geometry import Geometry, geometry_slopes, solve_geometry
from amibayes.extraction.image_plane import FringeModel, fringe_fit
from amibayes.extraction.noise import NoiseModel, noise_model
from amibayes.extraction.preparation import _fit_of_median, _noise_and_misfit, make_operator
from amibayes.extraction.summary import described
from amibayes.extraction.table import integrations, series
from amibayes.extraction.view import View
from amibayes.instrument import Instrument, load_instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.oifits import read_oifits, write_oifits
from amibayes.optics import fringe_basis, psf
from amibayes.scene.orientation import Orientation
from amibayes.units import DEGREE, MAS, FloatArray


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def niriss() -> Instrument:
    return load_instrument("niriss", "F430M")


def cube_of(images: FloatArray, instrument: Instrument, **more: object) -> Cube:
    return Cube(
        images=images,
        pixel_scale_rad=instrument.pixel_scale_rad,
        instrument="NIRISS",
        filter=instrument.bandpass.name,
        error=np.sqrt(np.maximum(images, 0.0) + 10.0),
        **more,  # type: ignore[arg-type]
    )


def binary_images(
    instrument: Instrument, places_px: FloatArray, offset_mas: tuple[float, float], contrast: float
) -> FloatArray:
    """A star and a companion at an image offset, each a PSF of its own; no fringe model."""
    step = np.array(offset_mas) * MAS / instrument.pixel_scale_rad

    def both(at: FloatArray) -> FloatArray:
        alone = star(instrument, *at)
        return alone + contrast * star(instrument, *(at + step)) if contrast else alone

    return 1e7 * np.stack([both(p) for p in places_px])


def star(instrument: Instrument, x: float, y: float) -> FloatArray:
    """PSF at a place, kept: most tests look at the same places."""
    key = (instrument.bandpass.name, instrument.pixel_scale_rad, instrument.mask.holes_m.tobytes())
    if (*key, x, y) not in STARS:
        channels = instrument.bandpass.channels()
        STARS[*key, x, y] = psf(instrument, channels, 80, centre_px=(float(x), float(y)))
    return STARS[*key, x, y]


STARS: dict[tuple[object, ...], FloatArray] = {}


def jittered(n: int, seed: int = 41) -> FloatArray:
    return np.array([0.3, -0.2]) + 0.1 * np.random.default_rng(seed).standard_normal((n, 2))


def with_photons(images: FloatArray, seed: int) -> FloatArray:
    return np.random.default_rng(seed).poisson(np.maximum(images, 0.0)).astype(float)


@pytest.mark.parametrize("method", METHODS)
def test_point_source_has_unit_vis2_and_no_closure_phase(niriss: Instrument, method: str) -> None:
    images = binary_images(niriss, jittered(4), (0.0, 0.0), 0.0)
    found = extract_all(cube_of(images, niriss), ExtractOptions(method=method))[0]  # type: ignore[arg-type]
    # No noise: what is left is the jitter, 0.1 pixels under an envelope that stays, and
    # without a window the light that the image's edges cut off.
    assert np.abs(found.average.vis2 - 1.0).max() < 5e-4
    assert np.abs(found.average.closure_phase).max() < np.radians(0.06)


def recovered(
    instrument: Instrument, method: str, separation: float, angle_deg: float
) -> tuple[FloatArray, FloatArray]:
    """Truth and the mode that `search` finds there: east and north (mas), contrast."""
    angle = np.radians(angle_deg)
    offset = (-separation * np.sin(angle), separation * np.cos(angle))
    both = []
    for at, contrast in (((0.0, 0.0), 0.0), (offset, 0.01)):
        images = binary_images(instrument, np.array([[0.2, -0.1], [0.25, -0.05]]), at, contrast)
        options = ExtractOptions(method=method, covariance="physical")  # type: ignore[arg-type]
        both.append(extract_all(cube_of(images, instrument), options)[0].observables)
    likelihood = Likelihood(calibrate(both[1], [both[0]]).observables)
    modes = search(likelihood, (separation - 25.0, separation + 25.0)).modes
    truth = np.array([-offset[0], offset[1], 0.01])
    places = np.array([[m.companion.east_mas, m.companion.north_mas] for m in modes])
    # The mask's lattice has aliases that fit nearly as well, with noise and without.
    best = int(np.hypot(*(places - truth[:2]).T).argmin())
    return truth, np.append(places[best], modes[best].companion.contrast)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("separation", "angle_deg"),
    [
        (400.0, 37.0),
        *(pytest.param(s, 37.0, marks=pytest.mark.slow) for s in (50.0, 150.0, 200.0, 300.0)),
        *(pytest.param(s, 111.0, marks=pytest.mark.slow) for s in (50.0, 300.0, 500.0)),
    ],
)
def test_companions_in_the_images_keep_their_contrast(
    niriss: Instrument, method: str, separation: float, angle_deg: float
) -> None:
    truth, found = recovered(niriss, method, separation, angle_deg)
    assert found[2] == pytest.approx(0.01, rel=0.01)
    assert np.hypot(*(found - truth)[:2]) < 0.5


@pytest.mark.parametrize(
    "method", ["fringes", "matched", pytest.param("unique", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    ("offset", "contrast"),
    [
        ((337.0, 184.0), 0.003),
        pytest.param((337.0, 184.0), 0.25, marks=pytest.mark.slow),
        ((-88.0, 48.0), 0.5),
    ],
)
def test_binaries_are_exact_without_noise(
    niriss: Instrument, method: str, offset: tuple[float, float], contrast: float
) -> None:
    """Faint ones and bright ones, which pull the centre of the image from the star by 30 mas.

    The images are sums of two PSFs, made without the fringe model and without a response.
    """
    images = binary_images(niriss, jittered(8), offset, contrast)
    alone = binary_images(niriss, jittered(8, 42), (0.0, 0.0), 0.0)
    target, star = (extract(cube_of(i, niriss), method) for i in (images, alone))  # type: ignore[arg-type]
    calibrated = calibrate(target, [star]).observables
    vis2, closure = truth_differences(calibrated, [-offset[0], offset[1], contrast])
    assert vis2 < 8e-4 * contrast
    assert closure < 0.05 * contrast
    beyond = np.hypot(*offset)
    found = search(Likelihood(calibrated), (0.5 * beyond, 1.3 * beyond)).companion
    assert found.contrast == pytest.approx(contrast, rel=1e-3)
    assert np.hypot(found.east_mas + offset[0], found.north_mas - offset[1]) < 0.05


def truth_differences(calibrated: Observables, theta: list[float]) -> tuple[float, float]:
    """RMS of V² and of closure phase (degrees) about a binary."""
    likelihood = Likelihood(calibrated)
    rest = likelihood.difference_from(likelihood.predict([theta]))[:, 0]
    n = calibrated.n_vis2
    return rms(rest[:n]), float(np.degrees(rms(rest[n:])))


@pytest.mark.parametrize("method", METHODS)
def test_ami_sim_pair_gives_the_companion_that_was_put_in(data: Path, method: str) -> None:
    target, calibrator = (
        extract(data / "cubes" / f"niriss_f480m_{name}.fits", method, filter="F480M")  # type: ignore[arg-type]
        for name in ("target", "calibrator")
    )
    calibrated = calibrate(target, [calibrator]).observables
    vis2, closure = truth_differences(calibrated, [-160.0, 117.0, 0.01])
    assert vis2 < 0.0006
    assert closure < 0.03
    found = search(Likelihood(calibrated), (50.0, 400.0)).companion
    assert found.separation_mas == pytest.approx(198.3, abs=2.0)
    assert found.east_mas == pytest.approx(-160.0, abs=2.0)
    assert found.north_mas == pytest.approx(117.0, abs=2.0)
    assert found.contrast == pytest.approx(0.01, abs=0.0005)


def test_independent_psf(niriss: Instrument) -> None:
    few = niriss.bandpass.channels(n=3)
    fine = poppy_image(niriss, few.wavelength_m, few.weight, 80, oversample=5)
    image = fine.reshape(80, 5, 80, 5).sum(axis=(1, 3))
    images = np.stack([1e7 * image / image.sum()] * 3)
    for method in ("fringes", "matched", "unique"):
        found = extract_all(cube_of(images, niriss), ExtractOptions(method=method))[0]  # type: ignore[arg-type]
        # 3 wavelengths leave 1e-3 of the image, and a pupil of black and white cells too.
        assert np.abs(found.average.vis2 - 1.0).max() < 0.03
        assert np.abs(np.degrees(found.average.closure_phase)).max() < 0.2


def geometry_of(cube: Cube, method: str = "fringes") -> tuple[Geometry, FloatArray]:
    found = extract_all(cube, ExtractOptions(method=method))[0]  # type: ignore[arg-type]
    return found.operators[0].geometry, found.average.vis2


@pytest.mark.parametrize(
    "method",
    ["fringes", *(pytest.param(m, marks=pytest.mark.slow) for m in ("matched", "square"))],
)
def test_wrong_pixel_scale_and_rotation_are_found_and_do_no_harm(
    niriss: Instrument, method: str
) -> None:
    pixel, mask = niriss.pixel_scale_rad, niriss.mask
    for scale, turn in ((1.002, 0.0), (1.0, 0.1), (0.995, -0.4)):
        true = replace(niriss, pixel_scale_rad=scale * pixel, mask=mask.rotated(np.radians(turn)))
        images = binary_images(true, jittered(3, 23), (0.0, 0.0), 0.0)
        geometry, vis2 = geometry_of(cube_of(images, niriss), method)
        assert geometry.scale == pytest.approx(scale, abs=1.5e-4)
        assert np.degrees(geometry.rotation_rad) == pytest.approx(turn, abs=0.01)
        # Half a step of the rounding is 5e-5 in scale: 1.5e-4 in V² of `square`.
        assert np.abs(vis2 - 1.0).max() < 1e-3
        stated = ExtractOptions(method=method, geometry="stated")  # type: ignore[arg-type]
        wrong = extract_all(cube_of(images, niriss), stated)[0].average.vis2
        assert rms(wrong - 1.0) > 3.0 * rms(vis2 - 1.0)


@pytest.mark.parametrize(
    ("name", "most"), [("F480M", 0.005), pytest.param("F277W", 0.03, marks=pytest.mark.slow)]
)
def test_slopes_of_the_geometry_are_those_of_the_fringe_model(name: str, most: float) -> None:
    instrument = load_instrument("niriss", filter=name)
    channels = instrument.bandpass.channels()
    view = View(instrument, channels, slice(0, 60), slice(0, 66), (0.3, -0.2))
    rng, n = np.random.default_rng(31), instrument.mask.n_baselines
    visibility = np.concatenate([0.6 + 0.4 * rng.random(n), 0.3 * rng.standard_normal(n)])
    coefficients = np.concatenate([[1.0], visibility])

    def image(scale: float, turn: float, x: float, y: float) -> FloatArray:
        pixel = instrument.pixel_scale_rad * (1.0 + scale)
        centre = (view.centre_px[0] + x, view.centre_px[1] + y)
        basis = fringe_basis(
            instrument, channels, view.shape,
            centre_px=centre, pixel_scale_rad=pixel, rotation_rad=turn,
        )  # fmt: skip
        return basis.matrix @ coefficients / (1.0 + scale) ** 2

    for slope, step in zip(geometry_slopes(view, coefficients), 1e-4 * np.eye(4), strict=True):
        exact = (image(*step) - image(*-step)) / 2e-4
        assert np.linalg.norm(slope - exact) < most * np.linalg.norm(exact)


def test_median_and_scatter_are_those_of_numpy() -> None:
    values = np.random.default_rng(32).standard_normal((6, 5, 4))
    for missing in (False, True):
        if missing:
            values[np.random.default_rng(33).random(values.shape) < 0.4] = np.nan
            values[:, 0, 0] = np.nan
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = np.nanmedian(values, axis=0)
            spread = 1.4826 * np.nanmedian(np.abs(values - expected), axis=0)
        np.testing.assert_array_equal(median_and_scatter(values), [expected, spread])


def test_geometry_is_left_as_stated_where_that_is_right_or_the_image_is_faint(
    niriss: Instrument,
) -> None:
    images = binary_images(niriss, jittered(6), (120.0, 160.0), 0.02)
    geometry, _ = geometry_of(cube_of(with_photons(images, 25), niriss))
    assert geometry.told
    assert geometry.stated
    faint, _ = geometry_of(cube_of(with_photons(2e-4 * images, 26), niriss))
    assert not faint.told
    assert faint.stated


def test_errors_of_the_geometry_are_those_of_repeated_measurements(niriss: Instrument) -> None:
    true = replace(niriss, pixel_scale_rad=1.002 * niriss.pixel_scale_rad)
    image = binary_images(true, np.array([[0.1, 0.2]]), (0.0, 0.0), 0.0)[0] / 10.0
    found = []
    for seed in range(30):
        cube = cube_of(with_photons(np.stack([image] * 4), 100 + seed), niriss)
        operator = make_operator(InMemoryCube(cube), ExtractOptions(geometry="stated"))
        variance = np.pi / 2.0 / 4.0 * (np.maximum(image, 0.0) + 10.0)
        basis = operator.view.basis()
        fit = fringe_fit(FringeModel.of(basis), variance, np.ones(image.shape, dtype=bool))
        solved = solve_geometry(operator.view, operator.reference.image, fit, basis)
        assert solved is not None
        found.append((solved.value - [0.002, 0.0]) / solved.error)
    off = np.array(found)
    # 60 numbers: standard deviation to 9 %; the variance of a median is 6 % below π/2 of
    # the mean's at n = 4.
    assert 0.6 < off.std() < 1.4
    assert abs(off.mean()) < 0.6


def test_orientation_turns_the_companion(niriss: Instrument) -> None:
    images = binary_images(niriss, jittered(3), (120.0, 160.0), 0.02)
    turned = Orientation(35.0 * DEGREE, -1)
    found = search(Likelihood(extract(cube_of(images, niriss, orientation=turned))), (100.0, 300.0))
    expected = 35.0 + np.degrees(np.arctan2(-120.0, 160.0))
    assert found.companion.position_angle_deg == pytest.approx(expected % 360.0, abs=0.3)
    assert found.companion.separation_mas == pytest.approx(200.0, abs=1.0)


def test_bad_pixels_leave_the_rest_alone(niriss: Instrument) -> None:
    clean = with_photons(binary_images(niriss, jittered(12), (120.0, 160.0), 0.02), 4)
    dirty, rng = clean.copy(), np.random.default_rng(5)
    for image in dirty:
        image[rng.integers(0, 80, 20), rng.integers(0, 80, 20)] = rng.choice([np.nan, 3e6], 20)
    dirty[:, 40, 44] = np.nan
    dirty[:, 30, 30] = 2e6
    first, second = (
        extract_all(replace(cube_of(clean, niriss), images=images))[0] for images in (clean, dirty)
    )
    assert second.operators[0].reference.n_bad == 2
    assert second.frames.used.all()
    change = (second.observables.data - first.observables.data) / np.sqrt(
        first.observables.covariance.variance
    )
    assert rms(change) < 1.0


def test_odd_integrations_go_and_the_others_stay(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(15), (0.0, 0.0), 0.0), 7)
    images[3] = np.nan
    images[5] *= 0.7
    images[8] = 0.0
    images[11] = np.roll(images[11], 3, axis=1)
    found = extract_all(cube_of(images, niriss))[0]
    assert [number for _, number, _ in found.rejected] == [3, 5, 8, 11]
    assert all(reason for *_, reason in found.rejected)
    kept = extract_all(cube_of(images[[0, 1, 2, 4, 6, 7]], niriss))[0]
    assert kept.frames.used.all()


def test_one_and_two_integrations(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(2), (0.0, 0.0), 0.0), 9)
    single = extract(cube_of(images[:1], niriss))
    assert (single.covariance_kind, single.n_integrations) == ("given", None)
    assert extract(cube_of(images, niriss)).n_integrations == 2
    bare = extract(replace(cube_of(images[:1], niriss), error=None))
    ratio = np.sqrt(bare.covariance.variance / single.covariance.variance)
    assert 0.7 < np.median(ratio) < 1.4


@pytest.mark.slow
def test_files_of_one_exposure_are_one(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(12), (0.0, 0.0), 0.0), 11)
    halves = [replace(cube_of(part, niriss)) for part in (images[:6], images[6:])]
    joined = extract_all(halves)
    assert len(joined) == 1
    assert joined[0].observables.n_integrations == 12
    whole = extract(cube_of(images, niriss))
    change = (joined[0].observables.data - whole.data) / np.sqrt(whole.covariance.variance)
    assert rms(change) < 0.5
    turned = replace(halves[1], orientation=Orientation(0.5, -1))
    assert len(extract_all([halves[0], turned])) == 2
    stars = [replace(h, header={"TARGPROP": n}) for h, n in zip(halves, "AB", strict=True)]
    assert [e.observables.setups[0].target for e in extract_all(stars)] == ["A", "B"]
    assert len(extract_all([stars[0], stars[0]])) == 1


def test_files_too_many_to_be_held_open_give_the_same(
    niriss: Instrument, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    paths = []
    for seed, noisy in enumerate(np.split(binary_images(niriss, jittered(8), (0.0, 0.0), 0.0), 2)):
        paths.append(tmp_path / f"{seed}.fits")
        write_cube(paths[-1], cube_of(with_photons(noisy, seed), niriss))
    together = extract(paths)
    monkeypatch.setattr("amibayes.cube.source.MOST_OPEN", 1)
    one_by_one = extract(paths)
    np.testing.assert_array_equal(together.data, one_by_one.data)
    assert together.n_integrations == one_by_one.n_integrations


def test_oifits_keeps_everything(niriss: Instrument, tmp_path: Path) -> None:
    images = with_photons(binary_images(niriss, jittered(10), (90.0, 0.0), 0.05), 13)
    before = extract(cube_of(images, niriss, integration_time_s=2.0, mjd=59000.0 + np.arange(10)))
    write_oifits(tmp_path / "x.oifits", before)
    after = read_oifits(tmp_path / "x.oifits")
    np.testing.assert_array_equal(after.data, before.data)
    # Cholesky factors of the same matrix: equal to rounding.
    np.testing.assert_allclose(
        after.covariance.dense(), before.covariance.dense(), rtol=1e-12, atol=1e-18
    )
    assert after.setups[0].response is not None
    assert before.setups[0].response is not None
    for field in fields(OffAxisResponse):
        kept, written = (getattr(x.setups[0].response, field.name) for x in (after, before))
        if field.name == "method":
            assert (kept, written) == ("fringes", "fringes")
            continue
        np.testing.assert_allclose(kept, written, rtol=1e-12)
    assert after.n_integrations == 10
    assert after.vis2.integration_s[0] == 20.0
    assert after.vis2.mjd[0] == pytest.approx(59004.5)
    theta = [[80.0, 60.0, 0.02]]
    assert Likelihood(after).chi2(theta) == pytest.approx(Likelihood(before).chi2(theta), rel=1e-9)


def test_gradient_follows_the_response(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(10), (90.0, 0.0), 0.05), 15)
    likelihood = Likelihood(extract(cube_of(images, niriss)))
    theta = np.array([[-150.0, 210.0, 0.05]])
    _, gradient = likelihood.log_prob_and_gradient(theta)
    for k, step in enumerate((1e-3, 1e-3, 1e-6)):
        ahead, behind = theta.copy(), theta.copy()
        ahead[0, k] += step
        behind[0, k] -= step
        slope = (likelihood.log_prob(ahead) - likelihood.log_prob(behind)) / (2.0 * step)
        # Central differences lose eight of sixteen digits of the likelihood.
        assert gradient[0, k] == pytest.approx(slope[0], rel=1e-4)


def test_per_integration_series_average_to_the_mean(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(6), (0.0, 0.0), 0.0), 17)
    found = extract_all(cube_of(images, niriss))[0]
    vis2, closure = series(found)
    np.testing.assert_allclose(vis2.mean(axis=0), found.average.vis2, rtol=1e-12)
    np.testing.assert_allclose(closure.mean(axis=0), found.average.closure_phase, atol=1e-12)
    each = integrations(found)
    assert (each.n_vis2, each.n_closure_phases) == (6 * 21, 6 * 35)
    # Their scatter is their own: a t likelihood of all of them would count it six times.
    assert (each.covariance_kind, each.freedom) == ("given", None)


def test_methods_are_not_mixed(niriss: Instrument, tmp_path: Path) -> None:
    """A calibrator measured in another way has other errors of the optics to divide out."""
    images = with_photons(binary_images(niriss, jittered(6), (0.0, 0.0), 0.0), 17)
    target = extract(cube_of(images, niriss), "fringes")
    write_oifits(tmp_path / "square.oifits", extract(cube_of(images[::-1], niriss), "square"))
    with pytest.raises(DataError, match="extracted by square, the target by fringes"):
        calibrate(target, [read_oifits(tmp_path / "square.oifits")])
    other = extract(cube_of(images[:4], niriss), "fringes")
    with pytest.raises(UsageError, match="method is 'foo', not 'hierarchical'"):
        calibrate(target, [other], method="foo")  # type: ignore[arg-type]


def test_faults_are_named(niriss: Instrument, tmp_path: Path, rng: np.random.Generator) -> None:
    images = binary_images(niriss, jittered(3), (0.0, 0.0), 0.0)
    good, noise = cube_of(images, niriss), rng.normal(size=images.shape)
    cases = {
        "no integration holds light .check SCI": replace(good, images=np.zeros_like(images)),
        "every pixel is flagged": replace(good, error=np.zeros_like(images)),
        "no star is seen": replace(good, images=noise * np.hanning(80) * np.hanning(80)[:, None]),
        "edge of the image": replace(good, images=np.roll(images, 39, axis=2)),
        "leave .* of the image": replace(good, filter="F277W"),
        "has no filter": replace(good, filter="F999W"),
        "is not known": replace(good, instrument="NOBODY"),
        "do not hold one fringe": replace(good, images=images[:, :9, :9], error=None, dq=None),
    }
    for message, cube in cases.items():
        with pytest.raises(DataError, match=message):
            extract(cube)
    with pytest.raises(DataError, match="no cube"):
        extract([])
    with pytest.raises(UsageError, match="method"):
        extract(good, "magic")  # type: ignore[arg-type]


WRONG_MASK = """
name = "Other"
pixel_scale_mas = 65.6
[mask]
name = "three holes"
holes_m = [[0.0, 2.0], [-1.9, -1.1], [1.3, -1.7]]
shape = "circle"
size_m = 0.6
[filters.F430M]
wavelength_um = [4.1, 4.2, 4.4, 4.5]
throughput = [0.0, 0.9, 0.9, 0.0]
"""


def test_another_mask_is_refused(niriss: Instrument, tmp_path: Path) -> None:
    (tmp_path / "other.toml").write_text(WRONG_MASK)
    images = binary_images(niriss, jittered(3), (0.0, 0.0), 0.0)
    cube = replace(cube_of(images, niriss), instrument=str(tmp_path / "other.toml"))
    with pytest.raises(DataError, match="check instrument, filter, pixel scale"):
        extract(cube)


def test_files_that_hold_no_cube_are_named(niriss: Instrument, tmp_path: Path) -> None:
    images = binary_images(niriss, jittered(3), (0.0, 0.0), 0.0)
    whole = tmp_path / "whole.fits"
    write_cube(whole, cube_of(images, niriss))
    cut, ramp, wide = (tmp_path / f"{name}.fits" for name in ("cut", "ramp", "dq"))
    cut.write_bytes(whole.read_bytes()[:40000])
    with fits.open(whole) as hdus:
        hdus["SCI"].data = np.ones((2, 3, 4, 8, 8), dtype=np.float32)
        hdus.writeto(ramp)
    with fits.open(whole) as hdus:
        hdus["DQ"].data = np.zeros((80, 80), dtype=np.uint32)
        hdus.writeto(wide)
    for path, message in ((cut, "cut short"), (ramp, "5-dimensional"), (wide, "DQ has the shape")):
        with pytest.raises(DataError, match=message) as raised:
            extract(path)
        assert str(raised.value).startswith(str(path))
        assert main(["extract", str(path), "--out", str(tmp_path / "out"), "--overwrite"]) == 3
    missing = replace(cube_of(images, niriss), images=np.full_like(images, np.nan), error=None)
    with pytest.raises(DataError, match="no integration holds light"):
        extract(missing)


def test_a_plain_image_is_one_integration(niriss: Instrument, tmp_path: Path) -> None:
    image = with_photons(binary_images(niriss, jittered(1), (0.0, 0.0), 0.0), 30)[0]
    fits.writeto(tmp_path / "image.fits", image)
    header = {"instrument": "niriss", "filter": "F430M"}
    found = extract_all(tmp_path / "image.fits", **header)[0]
    assert found.observables.n_integrations is None
    assert rms(found.average.vis2 - 1.0) < 0.02


def test_memory_does_not_grow_with_the_number_of_integrations(
    niriss: Instrument, tmp_path: Path
) -> None:
    image = binary_images(niriss, jittered(1), (0.0, 0.0), 0.0)
    cube = cube_of(image, niriss)
    peaks = []
    for n in (300, 1500):
        rng = np.random.default_rng(n)
        with cube_stream(tmp_path / f"{n}.fits", cube, n) as stream:
            for start in range(0, n, 100):
                noisy = rng.poisson(np.tile(cube.images, (100, 1, 1))).astype(float)
                stream.write(start, noisy, np.tile(cube.error, (100, 1, 1)))
        tracemalloc.start()
        found = extract_all(tmp_path / f"{n}.fits")[0]
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert found.frames.used.sum() > 0.98 * n
    # Images of 1200 more integrations, with errors and flags, would be 150 MB.
    assert peaks[1] < peaks[0] + 10e6


def test_command_writes_what_it_says(
    niriss: Instrument, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = with_photons(binary_images(niriss, jittered(8), (0.0, 0.0), 0.0), 20)
    path = tmp_path / "star_calints.fits"
    write_cube(path, cube_of(images, niriss, mjd=59000.0 + np.arange(8)))
    out = tmp_path / "out"
    line = ["extract", str(path), "--per-integration", "--out", str(out), "--json"]
    assert main(line) == 0
    content = json.loads(capsys.readouterr().out)
    assert content == json.loads((out / "extract.json").read_text())
    assert content["extractions"][0]["n_used"] == 8
    header = fits.getheader(out / "star_calints.oifits")
    assert header["AMIBAYES METHOD"] == "fringes"
    assert header["AMIBAYES SOURCE1"] == path.name
    names = {p.name.removeprefix("star_calints") for p in out.iterdir()}
    assert {".oifits", "_integrations.oifits", "_frame.png", "_fit.png", "_time.png"} <= names
    assert main(line) == 2  # nothing is overwritten
    assert main(["extract", str(tmp_path / "none.fits"), "--out", str(tmp_path / "o2")]) == 3


@pytest.mark.slow
def test_star_is_told_from_the_middle_of_the_image_as_given(
    niriss: Instrument, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A frame so large that only a part of it is used, with the star 12 and -9 pixels off."""
    part = with_photons(binary_images(niriss, jittered(3), (0.0, 0.0), 0.0), 34)
    frame = np.random.default_rng(35).normal(0.0, 3.0, (3, 120, 130))
    frame[:, 11:91, 37:117] += part
    path = tmp_path / "täräget one.fits"
    write_cube(path, cube_of(frame, niriss))
    assert main(["extract", str(path), "--out", str(tmp_path / "out")]) == 0
    entry = json.loads((tmp_path / "out" / "extract.json").read_text())["extractions"][0]
    assert max(extract_all(path)[0].operators[0].view.shape) < 120
    expected = np.array([12.0, -9.0]) + jittered(3).mean(axis=0)
    assert entry["centre_px"][0] == pytest.approx(list(expected), abs=0.1)
    x, y = entry["centre_px"][0]
    assert f"x {x:+.3f}, y {y:+.3f} pixels from the middle" in capsys.readouterr().out
    header = fits.getheader(tmp_path / "out" / "täräget one.oifits")
    assert header["AMIBAYES SOURCE1"] == "t\\xe4r\\xe4get one.fits"


def test_window_is_for_the_methods_that_have_one(niriss: Instrument) -> None:
    cube = cube_of(binary_images(niriss, jittered(1), (0.0, 0.0), 0.0), niriss)
    with pytest.raises(UsageError, match="fringes has no window"):
        extract(cube, options=ExtractOptions(window_px=20.0))
    plain, narrow = (extract(cube, "fft", options=ExtractOptions(window_px=w)) for w in (0.0, 9.0))
    assert not np.array_equal(plain.data, narrow.data)


def test_files_that_name_no_star_are_said_to_be_taken_as_one(niriss: Instrument) -> None:
    cube = cube_of(binary_images(niriss, jittered(2), (0.0, 0.0), 0.0), niriss)
    said = "2 files that name no star are taken as exposures of one"
    assert said in extract([cube, cube]).notes
    assert said not in extract(cube).notes
    named = replace(cube, header={"TARGPROP": "A"})
    assert said not in extract([named, named]).notes


@pytest.mark.parametrize(("name", "coarse"), [("F277W", True), ("F380M", False)])
def test_reader_is_told_of_pixels_too_large_for_the_fringes(name: str, coarse: bool) -> None:
    """Two pixels of 65.6 mas are 0.131 arcsec; λ/B of the longest baseline 0.109 and 0.149."""
    instrument = load_instrument("niriss", name)
    images = with_photons(binary_images(instrument, jittered(3), (0.0, 0.0), 0.0), 20)
    notes = " ".join(extract(cube_of(images, instrument)).notes)
    assert ("too large for the fringes" in notes) == coarse


@pytest.mark.slow
def test_temperature_sets_the_wavelength(niriss: Instrument, tmp_path: Path) -> None:
    """Against Planck's law over the filter's table, integrated here."""
    images = with_photons(binary_images(niriss, jittered(3), (0.0, 0.0), 0.0), 20)
    write_cube(tmp_path / "star.fits", cube_of(images, niriss))
    wavelength, throughput = niriss.bandpass.wavelength_m, niriss.bandpass.throughput
    grid = np.linspace(wavelength[0], wavelength[-1], 20001)
    through = np.interp(grid, wavelength, throughput)
    for kelvin in (None, "600"):
        out = tmp_path / f"out_{kelvin}"
        option = [] if kelvin is None else ["--temperature", kelvin]
        assert main(["extract", str(tmp_path / "star.fits"), *option, "--out", str(out)]) == 0
        x = 0.014387769 / (grid * 600.0)
        photons = through * (1.0 if kelvin is None else grid**-4 / np.expm1(x))
        expected = photons.sum() / (photons / grid).sum()
        found = read_oifits(out / "star.oifits").vis2.wavelength_m[0]
        # The quadrature of the band serves images, to 1e-6 of the wavelength.
        assert found == pytest.approx(expected, rel=2e-6)
    hopeless = ["extract", str(tmp_path / "star.fits"), "--temperature", "1"]
    assert main([*hopeless, "--out", str(tmp_path / "o2")]) == 2


def test_search_takes_cubes(niriss: Instrument, tmp_path: Path) -> None:
    for name, contrast, seed in (("target", 0.02, 21), ("cal", 0.0, 22)):
        images = binary_images(niriss, jittered(8), (120.0, 160.0), contrast)
        write_cube(tmp_path / f"{name}.fits", cube_of(with_photons(images, seed), niriss))
    line = f"search {tmp_path}/target.fits --cal {tmp_path}/cal.fits --separation 120:300"
    line += f" --null-draws 0 --no-posterior --no-limits --method matched --out {tmp_path}/out"
    assert main(line.split()) == 0
    fit = json.loads((tmp_path / "out" / "result.json").read_text())["fit"]
    assert fit["separation_mas"] == pytest.approx(200.0, abs=6.0 * fit["errors"]["separation_mas"])
    assert fit["contrast"] == pytest.approx(0.02, abs=6.0 * fit["errors"]["contrast"])


def test_calints_made_by_mirage(data: Path) -> None:
    cube = read_cube(data / "cubes" / "niriss_f480m_calints.fits")
    found = extract_all(cube)[0]
    assert found.frames.used.sum() >= 66
    assert found.average.vis2.min() > 0.8


@pytest.mark.parametrize("kelvin", [3000.0, 8000.0])
def test_temperatures_of_stars_are_taken(kelvin: float) -> None:
    assert ExtractOptions(temperature_k=kelvin).temperature_k == kelvin


@pytest.mark.parametrize("kelvin", [1.0, np.nan])
def test_temperatures_without_light_are_refused(kelvin: float) -> None:
    with pytest.raises(UsageError, match="temperature"):
        ExtractOptions(temperature_k=kelvin)


def test_images_without_dates_have_none(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(3), (0.0, 0.0), 0.0), 17)
    undated = replace(cube_of(images, niriss), mjd=None)
    assert not np.any(extract(undated).vis2.mjd)


@pytest.mark.parametrize("method", METHODS)
def test_units_of_the_images_do_not_matter(niriss: Instrument, method: str) -> None:
    images = with_photons(binary_images(niriss, jittered(3), (120.0, 160.0), 0.02), 4)
    one = cube_of(images, niriss)
    other = replace(one, images=1e-12 * images, error=1e-12 * one.error)
    first, second = (extract(cube, method) for cube in (one, other))  # type: ignore[arg-type]
    sigma = np.sqrt(first.covariance.variance)
    assert np.abs((second.data - first.data) / sigma).max() < 1e-4
    np.testing.assert_allclose(second.covariance.variance, first.covariance.variance, rtol=1e-4)


@pytest.mark.parametrize(("scale", "turn"), [(0.975, 0.0), (1.025, 0.0), (1.0, 1.5), (1.0, -1.5)])
def test_a_header_that_is_far_off_is_not_put_right(
    niriss: Instrument, scale: float, turn: float
) -> None:
    """Beyond 2 % and 0.02 rad it is no small error: another mask or detector."""
    mask = niriss.mask.rotated(np.radians(turn))
    true = replace(niriss, pixel_scale_rad=scale * niriss.pixel_scale_rad, mask=mask)
    geometry, _ = geometry_of(cube_of(binary_images(true, jittered(3), (0.0, 0.0), 0.0), niriss))
    assert (geometry.scale, geometry.rotation_rad) == (1.0, 0.0)


def test_errors_in_the_summary_are_medians_of_those_of_the_average(niriss: Instrument) -> None:
    images = with_photons(binary_images(niriss, jittered(6), (120.0, 160.0), 0.02), 4)
    found = extract_all(cube_of(images, niriss))[0]
    told, n = described(found), 21
    for name, covariance in (("", found.covariance.matrix), ("_physical", found.physical)):
        sigma = np.sqrt(np.diag(covariance) / found.frames.used.sum())
        assert told[f"sigma_vis2{name}"] == pytest.approx(np.median(sigma[:n]))
        degrees = np.degrees(np.median(sigma[n:]))
        assert told[f"sigma_closure_phase{name}_deg"] == pytest.approx(degrees)
    shift = found.frames.shift_px[found.frames.used]
    assert told["jitter_px"] == pytest.approx(np.sqrt(np.mean(shift.std(axis=0) ** 2)))
    assert told["flux"] == pytest.approx(found.frames.flux.mean())


@pytest.mark.parametrize(
    ("errors", "n", "measured"),
    [(True, 2, False), (True, 4, False), (False, 2, True), (False, 3, False)],
)
def test_few_images_without_errors_tell_their_noise_by_what_the_fit_leaves(
    niriss: Instrument, monkeypatch: pytest.MonkeyPatch, *, errors: bool, n: int, measured: bool
) -> None:
    images = with_photons(binary_images(niriss, jittered(n), (120.0, 160.0), 0.02), 4)
    one = cube_of(images, niriss)
    operator = make_operator(
        InMemoryCube(one if errors else replace(one, error=None)), ExtractOptions()
    )
    reference, view = operator.reference, operator.view
    even = fringe_fit(FringeModel.of(view.basis()), np.ones(view.shape), reference.good[view.part])
    asked: list[bool] = []

    def counted(*given: FloatArray) -> NoiseModel:
        asked.append(True)
        return noise_model(*given)

    monkeypatch.setattr("amibayes.extraction.preparation.noise_model", counted)
    _fit_of_median(view, even, reference)
    assert bool(asked) == measured


def test_noise_by_residuals_allows_for_the_columns_of_the_fit(
    niriss: Instrument, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of white noise, to 0.4 %: the fit of 6400 pixels follows 44 parts of it, 0.7 %, and the
    pointing six integrations of 150, 4 %."""
    image = binary_images(niriss, jittered(1), (0.0, 0.0), 0.0)[0]
    noise = np.random.default_rng(7).standard_normal((150, *image.shape))
    images = image + 100.0 * noise
    cube = replace(cube_of(images[:4], niriss), error=None)
    operator = make_operator(InMemoryCube(cube), ExtractOptions())
    reference = replace(operator.reference, sample=images)
    view = operator.view
    good = reference.good[view.part]
    even = fringe_fit(FringeModel.of(view.basis()), np.ones(view.shape), good)
    asked: list[FloatArray] = []

    def kept(mean: FloatArray, measured: FloatArray, used: FloatArray) -> NoiseModel:
        asked.append(measured[used])
        return noise_model(mean, measured, used)

    monkeypatch.setattr("amibayes.extraction.preparation.noise_model", kept)
    _noise_and_misfit(view, even, reference)
    assert asked[0].mean() == pytest.approx(1e4, rel=0.004)


@pytest.mark.parametrize("method", METHODS)
def test_images_without_any_noise_are_extracted(niriss: Instrument, method: str) -> None:
    """Three times the same one: simulators make such cubes."""
    image = binary_images(niriss, jittered(1), (0.0, 0.0), 0.0)
    cube = replace(cube_of(np.repeat(image, 3, axis=0), niriss), error=None)
    found = extract(cube, method)  # type: ignore[arg-type]
    assert np.isfinite(found.covariance.variance).all()
    assert np.abs(found.vis2.value - 1.0).max() < 0.01
    assert np.abs(found.closure_phase.value).max() < 1e-3
