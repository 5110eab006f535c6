"""Migration taken out: of ramps that a brute-force drift made, of slopes, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from charge_drift import drifting_ramp

from amibayes.cube import Cube, read_cube, write_cube
from amibayes.cube.source import InMemoryCube, opened
from amibayes.data.observables import Observables
from amibayes.errors import UsageError
from amibayes.extraction import extract_all
from amibayes.extraction.charge import TOO_FEW_GROUPS, visit_migration
from amibayes.extraction.options import ExtractOptions
from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.ramps.correction import MigrationFree, electrons_of, slope_time_s
from amibayes.ramps.curvature import curvature_of
from amibayes.ramps.fit import fit_migration
from amibayes.ramps.migration import Migration
from amibayes.scene.sources import Scene
from amibayes.simulation.detector import Detector
from amibayes.simulation.ramps import read_ramps
from amibayes.units import FloatArray

SHIFT, PEAK_E, N, GROUPS, FRAME_S = 3.6e-7, 28_000.0, 24, 8, 0.07544
READ_E = 1.0
INSTRUMENT = load_instrument("niriss", "F480M")


def star(n: int = N, cells: int = 1) -> FloatArray:
    """Electrons per second of a star whose brightest pixel ends at 28 000 of them."""
    fine = replace(INSTRUMENT, pixel_scale_rad=INSTRUMENT.pixel_scale_rad / cells)
    centre = (0.33 * cells, -0.21 * cells)
    image = scene_image(
        Scene(), fine, INSTRUMENT.bandpass.channels(), n * cells, centre_px=centre
    ).centred
    pixels = image.reshape(n, cells, n, cells).sum(axis=(1, 3))
    return np.asarray(image * PEAK_E / (pixels.max() * GROUPS * FRAME_S))


@pytest.fixture(scope="module")
def drifted(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, FloatArray]:
    """Ramps that light drifting on a fine grid makes, and the light."""
    fine = star(cells=20)
    coarse = fine.reshape(N * 10, 2, N * 10, 2).sum(axis=(1, 3))
    by_coarse, by_fine = (
        drifting_ramp(image, k, SHIFT, FRAME_S, GROUPS, 1)
        for image, k in ((coarse, 10), (fine, 20))
    )
    # Cells are wrong by the first power of their width.
    charge = (2.0 * by_fine - by_coarse)[1:]
    rng = np.random.default_rng(3)
    ramps = charge + READ_E * rng.standard_normal((40, *charge.shape)) / np.sqrt(2.0)
    path = tmp_path_factory.mktemp("drift") / "drift_ramp.fits"
    write_ramps(path, ramps)
    return path, star()


def write_ramps(path: Path, ramps: FloatArray, **header: Any) -> None:
    primary = fits.PrimaryHDU()
    keywords = {
        "INSTRUME": "NIRISS",
        "FILTER": "F480M",
        "TGROUP": FRAME_S,
        "TFRAME": FRAME_S,
        "PIXELSCL": 0.0656,
        "BUNIT": "electron",
        "TARGPROP": path.stem,
    }
    primary.header.update(keywords | header)
    image = fits.ImageHDU(ramps.astype(np.float32), name="SCI")
    fits.HDUList([primary, image]).writeto(path)


def test_drifting_light_is_put_back(drifted: tuple[Path, FloatArray]) -> None:
    path, light = drifted
    with opened(path) as file:
        found = curvature_of(file)  # type: ignore[arg-type]
        assert found is not None
        fit = fit_migration([found]).migration
        # No photon noise, little read noise: what is left is the edges, where no light comes from.
        np.testing.assert_allclose(fit.value[:2], SHIFT, rtol=0.03)
        plain = file.read().images.mean(axis=0)
        free = MigrationFree(file, fit, 1.0).read().images.mean(axis=0)
    inside = np.s_[2:-2, 2:-2]
    before, after = (np.abs(image - light)[inside].max() for image in (plain, free))
    noise = READ_E / FRAME_S / np.sqrt(40.0) / 6.0
    assert before > 0.005 * light.max()
    assert after < 0.08 * before + 5.0 * noise


def test_slopes_are_corrected_with_a_given_value(drifted: tuple[Path, FloatArray]) -> None:
    path, light = drifted
    with opened(path) as file:
        slopes = file.read()
    header = {"NGROUPS": GROUPS, "TGROUP": FRAME_S, "TFRAME": FRAME_S}
    cube = replace(slopes, header=header)
    time = slope_time_s(cube.header)
    assert time == pytest.approx(4.5 * FRAME_S)
    assert electrons_of(cube) == 1.0
    free = MigrationFree(InMemoryCube(cube), Migration.isotropic(SHIFT, 0.0, "given"), 1.0, time)
    image = free.read().images.mean(axis=0)
    inside = np.s_[2:-2, 2:-2]
    before = np.abs(slopes.images.mean(axis=0) - light)[inside].max()
    after = np.abs(image - light)[inside].max()
    assert after < 0.2 * before
    assert free.read(0, 0).n_integrations == 0


def test_units_and_times_of_headers() -> None:
    blank = Cube(np.empty((0, 4, 4)), 1e-7, "NIRISS", "F480M", unit="DN/s")
    assert electrons_of(blank) == pytest.approx(1.61)
    sky = replace(blank, unit="MJy/sr", header={"PHOTMJSR": 0.5})
    assert electrons_of(sky) == pytest.approx(3.22)
    assert electrons_of(replace(sky, header={})) is None
    assert electrons_of(replace(blank, unit="photoelectrons")) is None
    averaged = {"NGROUPS": 5, "TGROUP": 0.4, "TFRAME": 0.1, "NFRAMES": 4}
    # Groups are at 0.25, 0.65, … s; the middle one at 1.05 s.
    assert slope_time_s(averaged) == pytest.approx(1.05)
    assert slope_time_s({"NGROUPS": 5}) is None
    assert slope_time_s({"NGROUPS": 4, "TGROUP": 0.1, "ZEROREAD": True}) == pytest.approx(0.2)


def noisy_ramps(seed: int, n_int: int, peak_ratio: float, n_groups: int = GROUPS) -> FloatArray:
    rng = np.random.default_rng(seed)
    detector = Detector(zero_read=False, boundary_shift_x=SHIFT, boundary_shift_y=SHIFT)
    light = np.broadcast_to(peak_ratio * star(48), (n_int, 48, 48))
    return read_ramps(light, detector, n_groups, rng).reads.swapaxes(0, 1)


@pytest.fixture(scope="module")
def visit(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A star, and one of half the brightness."""
    folder = tmp_path_factory.mktemp("visit")
    paths = [folder / "bright_ramp.fits", folder / "faint_ramp.fits"]
    for k, path in enumerate(paths):
        write_ramps(path, noisy_ramps(k, 30, 0.5**k))
    return paths


def measured(paths: list[Path], migration: Any) -> list[Observables]:
    options = ExtractOptions(charge_migration=migration)
    return [e.observables for e in extract_all(paths, options)]


def test_extraction_takes_it_out_and_shares_its_error(visit: list[Path]) -> None:
    left_in, free = measured(visit, "off"), measured(visit, "fit")
    exact = measured(visit, SHIFT)
    n = free[0].n_vis2
    assert free[0].shared is not None
    assert free[1].shared is not None
    assert free[0].shared.names == free[1].shared.names
    assert exact[0].shared is None
    noise = np.sqrt(exact[0].covariance.variance)
    by_migration = (left_in[0].data - exact[0].data)[:n]
    assert np.abs(by_migration / noise[:n]).max() > 2.0
    # The changes that are stated are those that another coefficient makes of the same ramps.
    step = 0.3e-7
    other = measured(visit, SHIFT + step)[0].data - exact[0].data
    one, both = (
        free[0].shared.changes,
        np.linalg.lstsq(free[0].shared.changes, other, rcond=None)[0],
    )
    np.testing.assert_allclose(one @ both, other, atol=0.03 * np.abs(other).max())
    # A bright star is changed twice as much as one of half its brightness.
    ratio = [np.linalg.norm(o.shared.changes) for o in free if o.shared is not None]
    assert ratio[0] / ratio[1] == pytest.approx(2.0, rel=0.05)
    assert any("fitted to ramps" in note for note in free[0].notes)


def test_what_cannot_be_corrected_is_said(visit: list[Path], tmp_path: Path) -> None:
    few = tmp_path / "few_ramp.fits"
    write_ramps(few, noisy_ramps(5, 4, 0.5, n_groups=3))
    (short,) = visit_migration([few], ExtractOptions(), {})
    assert TOO_FEW_GROUPS in short.notes
    assert short.migration is not None
    assert short.migration.source == "instrument"
    with opened(visit[0]) as file:
        slopes = file.read()
    untimed = tmp_path / "untimed.fits"
    write_cube(untimed, replace(slopes, header={}))
    (blind,) = visit_migration([untimed], ExtractOptions(), {})
    assert blind.migration is None
    assert blind.notes == ("charge migration not taken out: the header lacks NGROUPS and TGROUP",)
    assert blind.as_json()["source"] == "off"
    still = replace(slopes, header={"NGROUPS": 8, "TGROUP": 0.1, "BNDSHFTX": 0.0, "BNDSHFTY": 0.0})
    assert visit_migration([still], ExtractOptions(), {})[0].notes == ()
    with pytest.raises(UsageError, match="charge migration is 'none'"):
        ExtractOptions(charge_migration="none")  # type: ignore[arg-type]


def test_slopes_beside_ramps_are_corrected_with_their_fit(
    visit: list[Path], tmp_path: Path
) -> None:
    with opened(visit[1]) as file:
        slopes = file.read()
    beside = tmp_path / "slopes.fits"
    write_cube(beside, replace(slopes, header={"NGROUPS": GROUPS, "TGROUP": FRAME_S}))
    found = visit_migration([visit[0], beside], ExtractOptions(), {})
    assert [f.migration.source for f in found if f.migration is not None] == ["fit", "fit"]


def test_single_pixels_that_differ_go_through_the_extraction(tmp_path: Path) -> None:
    """A pixel of its own linearity is found, taken off and in the errors that files share."""
    ramps = noisy_ramps(9, 30, 1.0)
    top = np.unravel_index(np.argmax(ramps[:, -1].mean(axis=0)), ramps.shape[2:])
    at = (..., *top)
    ramps[at] += 0.5 * 6e-6 * ramps[at] ** 2
    path = tmp_path / "bent_ramp.fits"
    write_ramps(path, ramps)
    (found,) = extract_all([path], ExtractOptions(charge_migration="fit"))
    fit = found.charge.fit
    assert fit is not None
    assert fit.pixels_differ
    assert fit.own is not None
    assert fit.own.carried.dtype.kind == "i"
    assert found.observables.shared is not None
    assert len(found.observables.shared.names) > 10


def test_an_exposure_counts_once(visit: list[Path], tmp_path: Path) -> None:
    """Ramps beside their slopes, and a segment beside the whole, are refused; segments are not."""
    exposure = {"EXPSTART": 60000.0, "EXPEND": 60000.1, "TARGPROP": "star"}
    ramps = noisy_ramps(1, 8, 0.5)
    whole = tmp_path / "whole_ramp.fits"
    write_ramps(whole, ramps, **exposure, INTSTART=1, INTEND=8)
    parts = [tmp_path / f"seg{k}_ramp.fits" for k in (1, 2)]
    for k, path in enumerate(parts):
        own = {"INTSTART": 4 * k + 1, "INTEND": 4 * k + 4}
        write_ramps(path, ramps[4 * k : 4 * k + 4], **exposure, **own)
    slopes = tmp_path / "whole_calints.fits"
    write_cube(slopes, replace(read_cube(whole), header=fits.getheader(whole)))
    for pair in ([whole, parts[0]], [whole, slopes]):
        with pytest.raises(UsageError, match="same exposure"):
            extract_all(pair, ExtractOptions(charge_migration="off"))
    (found,) = extract_all(parts, ExtractOptions(charge_migration="off"))
    assert len(found.frames) == 8
