"""Errors of the converter: fitted to ramps that a brute-force converter of test code counts."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.cube import Cube
from amibayes.cube.ramps import GAIN_E_DN, RampFile
from amibayes.cube.reference_files import Linearity
from amibayes.cube.source import opened
from amibayes.cube.timing import GroupTiming
from amibayes.extraction.charge import BIAS_UNKNOWN, LINEARITY_UNKNOWN, visit_migration
from amibayes.extraction.options import ExtractOptions
from amibayes.instrument import load_instrument
from amibayes.optics import scene_image
from amibayes.ramps.converter import HARMONICS, PERIOD_DN, WAVES, table, waves
from amibayes.ramps.curvature import Curvature, curvature_of
from amibayes.ramps.fit import MigrationFit, fit_migration
from amibayes.scene.sources import Scene
from amibayes.units import FloatArray

TRUE = np.array([120e-6, -30e-6, -3e-6, 5e-6, -1e-6, 4e-6])
PEAK_E, N, FRAME_S, READ_E, GROUPS = 28e3, 40, 0.07544, 12.0, 8
INSTRUMENT = load_instrument("niriss", "F480M")


def edges(amplitudes: FloatArray) -> FloatArray:
    """True counts at which the converter goes on to the next number, for every number."""
    number = np.arange(65537) - 0.5
    true = number.copy()
    for _ in range(8):
        off = np.zeros(len(true))
        for k, period in enumerate((1024.0, 512.0, 1024.0 / 3.0)):
            turn = 2.0 * np.pi * true / period
            off += amplitudes[2 * k] * np.sin(turn) + amplitudes[2 * k + 1] * np.cos(turn)
        # What is read of x is x / (1 + Σ): it is to be the edge's number.
        true = number * (1.0 + off)
    return true


def counted(
    seed: int,
    n_int: int,
    amplitudes: FloatArray,
    scale: float = 1.0,
    n_groups: int = GROUPS,
    missing: float = 0.0,
) -> tuple[RampFile, FloatArray]:
    """Ramps of whole counts, and what they would be in electrons without the converter.

    ``missing`` is the part of the signal that is not there at 30 000 electrons; what is given
    has been made linear, by a polynomial of fifth order that is fitted to the response.
    """
    rng = np.random.default_rng(seed)
    channels = INSTRUMENT.bandpass.channels()
    light = scene_image(Scene(), INSTRUMENT, channels, N, centre_px=(0.2, -0.3)).centred
    light = scale * PEAK_E / light.max() / n_groups * light
    # Not one per mille in a pixel: jitter and charge migration have tests of their own.
    charge = np.cumsum(rng.poisson(np.broadcast_to(light, (n_int, n_groups, N, N))), axis=1)
    reads = charge + READ_E * rng.standard_normal(charge.shape)
    bias = 12000.0 + 300.0 * np.random.default_rng(99).standard_normal((N, N))
    bend = missing * GAIN_E_DN / 30e3
    true = reads / GAIN_E_DN
    numbers = np.searchsorted(edges(amplitudes), true - bend * true**2 + bias) - 1
    template = Cube(np.empty((0, N, N)), 3e-7, "NIRISS", "F480M", unit="DN/s")
    timing = GroupTiming(n_groups, FRAME_S, FRAME_S, first_s=FRAME_S)
    coefficients = polynomial_of(bend)
    linear = np.polynomial.polynomial.polyval(numbers - bias, coefficients)
    known = Linearity(np.broadcast_to(coefficients[:, None, None], (6, N, N)))
    hdus = {"SCI": _Held(linear.astype(np.float32))}
    return RampFile(template, n_int, hdus, None, timing, bias, known), reads


def polynomial_of(bend: float) -> FloatArray:
    """Coefficients (6,) that make x − bend x² linear again, by least squares."""
    x = np.linspace(0.0, 30e3, 300)
    powers = np.stack([(x - bend * x**2) ** k for k in range(1, 6)], axis=1)
    scale = powers.max(axis=0)
    found = np.linalg.lstsq(powers / scale, x, rcond=None)[0] / scale
    return np.concatenate([[0.0], found])


class _Held:
    """An array that is read like an HDU."""

    def __init__(self, array: FloatArray) -> None:
        self.section = array


def measured(*arguments: object, **options: object) -> Curvature:
    found = curvature_of(counted(*arguments, **options)[0])  # type: ignore[arg-type]
    assert found is not None
    return found


def pulls(fit: MigrationFit, true: FloatArray = TRUE) -> FloatArray:
    found = fit.migration.of_converter
    assert found is not None
    return np.asarray((found.value - true) / found.error)


def test_a_table_undoes_the_brute_force_converter(rng: np.random.Generator) -> None:
    true = rng.uniform(8e3, 4e4, 5000)
    read = np.searchsorted(edges(TRUE), true) - 1
    left = read - table(TRUE)[read] - true
    # A number stands for half a count about it.
    assert np.abs(left).max() < 0.52
    assert np.abs(read - true).max() > 3.0
    assert waves(true).shape == (len(WAVES), 5000)
    assert len(WAVES) == 2 * len(HARMONICS)
    assert pytest.approx(1024.0) == PERIOD_DN


def test_amplitudes_come_back_within_their_errors() -> None:
    fits_ = [fit_migration([measured(k, 20, TRUE)]) for k in range(6)]
    off = np.array([pulls(f) for f in fits_])
    # 36 numbers: rms to 0.12, each below 4.5 but once in a thousand runs.
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.5)
    assert np.abs(off).max() < 4.5
    error = fits_[0].migration.of_converter
    assert error is not None
    assert error.error[0] < 0.1 * TRUE[0]
    # No charge passes between these pixels: what the converter does is not taken for that.
    sides = np.array([f.migration.value[:2] / f.migration.error[:2] for f in fits_])
    assert np.sqrt((sides**2).mean()) == pytest.approx(1.0, abs=0.9)
    assert all(f.explained for f in fits_)


def test_counts_are_those_before_the_signal_was_made_linear() -> None:
    """3 % is missing at 30 000 electrons: amplitudes come back all the same."""
    files = [counted(k, 20, TRUE, missing=0.03)[0] for k in range(4)]
    found = [curvature_of(f) for f in files]
    off = np.array([pulls(fit_migration([f]))[:2] for f in found if f is not None])
    assert np.abs(off).max() < 4.5
    assert np.sqrt((off**2).mean()) < 2.0


def test_slopes_without_the_converter_of_a_response_that_is_not_linear() -> None:
    file, reads = counted(3, 20, TRUE, missing=0.03)
    true = replace(file, hdus={"SCI": _Held(reads / GAIN_E_DN)}).read().images.mean(axis=0)
    before = file.read().images.mean(axis=0) - true
    mended = replace(file, excess_dn=table(TRUE))
    after = mended.read().images.mean(axis=0) - true
    assert np.sqrt((after**2).mean()) < 0.1 * np.sqrt((before**2).mean())
    # Counts of the brightest pixels are half a period off where they are taken as they are.
    blind = replace(mended, linearity=None).read().images.mean(axis=0) - true
    bright = true > 0.5 * true.max()
    assert np.abs(after[bright]).max() < 0.3 * np.abs(blind[bright]).max()


@pytest.mark.parametrize("missing", [0.0, 0.03, 0.06])
def test_what_made_a_signal_linear_is_undone(missing: float, rng: np.random.Generator) -> None:
    coefficients = polynomial_of(missing * GAIN_E_DN / 30e3)
    read = rng.uniform(0.0, 18e3, (3, 2, 2))
    linear = np.polynomial.polynomial.polyval(read, coefficients)
    known = Linearity(np.broadcast_to(coefficients[:, None, None], (6, 2, 2)))
    back, slope = known.undone(linear)
    np.testing.assert_allclose(back, read, atol=0.01)
    derivative = np.polynomial.polynomial.polyder(coefficients)
    expected = np.polynomial.polynomial.polyval(read, derivative)
    np.testing.assert_allclose(slope, expected, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("n_groups", [4, 8, 19])
def test_bias_and_pulls_of_amplitudes(n_groups: int) -> None:
    n = 60
    found = [fit_migration([measured(k, 20, TRUE, n_groups=n_groups)]) for k in range(n)]
    assert sum(f.migration.of_converter is not None for f in found) == n
    off = np.array([pulls(f) for f in found])
    # The prior holds the small waves: they scatter by less than their errors.
    assert np.abs(off.mean(axis=0)[:2]).max() < 4.2 / np.sqrt(n)
    np.testing.assert_allclose(off.std(axis=0)[:2], 1.0, atol=4.2 / np.sqrt(2 * n))


def test_a_fault_less_converter_is_left_alone() -> None:
    none = np.zeros(6)
    found = [fit_migration([measured(k, 20, none)]) for k in range(6)]
    # Asked for at one in a thousand.
    assert sum(f.migration.of_converter is not None for f in found) == 0
    alone = fit_migration([replace(measured(0, 20, none), waves=None)])
    np.testing.assert_array_equal(alone.migration.value, found[0].migration.value)


def test_without_the_bias_nothing_is_said_of_the_converter() -> None:
    file, _ = counted(1, 20, TRUE)
    found = curvature_of(replace(file, bias_dn=None))
    assert found is not None
    assert found.waves is None
    assert fit_migration([found]).migration.of_converter is None
    # With the pixels' bias exchanged the waves have no phase in common: not fitted either.
    assert file.bias_dn is not None
    wrong = curvature_of(replace(file, bias_dn=file.bias_dn[::-1, ::-1]))
    assert wrong is not None
    assert fit_migration([wrong]).migration.of_converter is None


def test_slopes_are_those_without_the_converter() -> None:
    file, reads = counted(3, 40, TRUE)
    found = curvature_of(file)
    assert found is not None
    converter = fit_migration([found]).migration.of_converter
    assert converter is not None
    mended = replace(file, excess_dn=table(converter.value)).read().images.mean(axis=0)
    before = file.read().images.mean(axis=0)
    true = replace(file, hdus={"SCI": _Held(reads / GAIN_E_DN)}).read().images.mean(axis=0)
    off, left = (np.abs(image - true) for image in (before, mended))
    assert np.sqrt((left**2).mean()) < 0.1 * np.sqrt((off**2).mean())
    assert left.max() < 0.15 * off.max()
    # What is in the covariance is what another amplitude would do to the slopes.
    more = converter.value + np.array([20e-6, 0, 0, 0, 0, 0])
    changed = replace(file, excess_dn=table(more)).read().images.mean(axis=0) - mended
    assert found.waves is not None
    expected = -20e-6 * found.waves.current[0] / GAIN_E_DN
    np.testing.assert_allclose(changed, expected, atol=0.05 * np.abs(expected).max())


def test_exposures_share_one_converter() -> None:
    target, calibrator = measured(1, 20, TRUE), measured(2, 20, TRUE, 0.5)
    both = fit_migration([target, calibrator])
    alone = [fit_migration([e]).migration.of_converter for e in (target, calibrator)]
    together = both.migration.of_converter
    assert together is not None
    assert alone[0] is not None
    assert together.error[0] < 0.85 * alone[0].error[0]
    assert np.abs(pulls(both)).max() < 4.5


def written(folder: Path, name: str, seed: int, **header: object) -> Path:
    file, _ = counted(seed, 20, TRUE)
    primary = fits.PrimaryHDU()
    keywords = {
        "INSTRUME": "NIRISS",
        "FILTER": "F480M",
        "TGROUP": FRAME_S,
        "TFRAME": FRAME_S,
        "NGROUPS": GROUPS,
        "PIXELSCL": 0.0656,
        "BUNIT": "DN",
        "SUBSTRT1": 1045,
        "SUBSTRT2": 1,
        "R_SUPERB": "crds://jwst_niriss_superbias_0182.fits",
    }
    primary.header.update(keywords | header)
    path = folder / name
    image = fits.ImageHDU(file.hdus["SCI"].section, name="SCI")
    fits.HDUList([primary, image]).writeto(path)
    return path


def test_the_superbias_is_found_where_the_package_keeps_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, "a_ramp.fits", 1)
    monkeypatch.setenv("CRDS_PATH", str(tmp_path / "crds"))
    (none,) = visit_migration([path], ExtractOptions(), {})
    assert BIAS_UNKNOWN in none.notes
    bias = counted(1, 1, TRUE)[0].bias_dn
    assert bias is not None
    # A file of the whole detector, of which the exposure is a part.
    whole = np.zeros((60, 1100), np.float32)
    whole[:N, 1044 : 1044 + N] = bias
    kept = tmp_path / "crds" / "references" / "jwst" / "niriss"
    kept.mkdir(parents=True)
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(whole, name="SCI")]).writeto(
        kept / "jwst_niriss_superbias_0182.fits"
    )
    (found,) = visit_migration([path], ExtractOptions(), {})
    assert BIAS_UNKNOWN not in found.notes
    assert any("errors of the converter" in note for note in found.notes)
    assert found.as_json()["converter"][WAVES[0]]["value"] == pytest.approx(TRUE[0], rel=0.5)
    with opened(path) as file:
        assert isinstance(file, RampFile)
        assert file.bias_dn is not None
        np.testing.assert_allclose(file.bias_dn, bias, atol=1e-3)
    fits.setval(kept / "jwst_niriss_superbias_0182.fits", "SUBSTRT1", value=2000)
    (other,) = visit_migration([path], ExtractOptions(), {})
    assert BIAS_UNKNOWN in other.notes


def test_the_linearity_is_found_of_a_part_of_the_detector(tmp_path: Path) -> None:
    path = written(tmp_path, "a_ramp.fits", 1, R_LINEAR="crds://jwst_niriss_linearity_0017.fits")
    whole = np.zeros((3, 60, 1100), np.float32)
    whole[1], whole[2, :N, 1044 : 1044 + N] = 1.0, 1e-6
    whole[2, 3, 1044 + 5] = np.nan
    flags = np.zeros((60, 1100), np.uint32)
    flags[7, 1044 + 9] = 1 << 20
    images = [fits.ImageHDU(whole, name="COEFFS"), fits.ImageHDU(flags, name="DQ")]
    fits.HDUList([fits.PrimaryHDU(), *images]).writeto(tmp_path / "jwst_niriss_linearity_0017.fits")
    bias = np.zeros((60, 1100), np.float32)
    bias[:N, 1044 : 1044 + N] = counted(1, 1, TRUE)[0].bias_dn
    superbias = tmp_path / "jwst_niriss_superbias_0182.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(bias, name="SCI")]).writeto(superbias)
    with opened(path) as file:
        assert isinstance(file, RampFile)
        assert file.linearity is not None
        known = file.linearity.coefficients
    expected = np.full((N, N), 1e-6)
    expected[3, 5] = expected[7, 9] = 0.0  # left as they are
    np.testing.assert_allclose(known[2], expected, atol=1e-12)
    assert (known[1] == 1.0).all()
    (found,) = visit_migration([path], ExtractOptions(), {})
    assert LINEARITY_UNKNOWN not in found.notes
    (tmp_path / "jwst_niriss_linearity_0017.fits").unlink()
    (without,) = visit_migration([path], ExtractOptions(), {})
    assert LINEARITY_UNKNOWN in without.notes
