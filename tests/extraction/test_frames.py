"""Which integrations are used, and what their average is, against sums written out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from amibayes.cube import Cube
from amibayes.cube.source import InMemoryCube
from amibayes.data.outliers import look_elsewhere
from amibayes.errors import DataError
from amibayes.extraction.cleaning import Reference
from amibayes.extraction.extract import TIMES, _mjd, _with_times
from amibayes.extraction.frames import (
    Frames,
    _chunk_size,
    average,
    concatenated,
    measure_file,
    refuse_starless,
    select,
)
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import make_operator
from amibayes.extraction.view import _part
from amibayes.instrument import load_instrument
from amibayes.optics import psf
from amibayes.units import ComplexArray

MASK = load_instrument("niriss", "F480M").mask


def frames(n: int, seed: int = 1) -> Frames:
    """Integrations that scatter by a percent; nothing speaks against any."""
    rng = np.random.default_rng(seed)
    pairs, triangles = MASK.n_baselines, len(MASK.triangles)
    flux = 100.0 * (1.0 + 0.01 * rng.standard_normal(n))
    fringe = rng.normal(size=(2, n, triangles)) + 5.0
    return Frames(
        flux, 0.05 * rng.standard_normal((n, 2)),
        flux[:, None] ** 2 * rng.uniform(0.8, 1.0, (n, pairs)),
        flux**2 - 3.0, fringe[0] + 1j * fringe[1], 0.1 + 0.001 * rng.standard_normal(n),
        np.arange(n), 6e4 + np.arange(n), np.zeros(n, int), np.arange(n), np.full(n, "", "U60"),
    )  # fmt: skip


def changed(made: Frames, name: str, entry: int, value: float) -> Frames:
    array = getattr(made, name).copy()
    array[entry] = value
    return replace(made, **{name: array})


def test_a_star_is_five_errors_above_nothing_in_one_integration() -> None:
    made = frames(4)
    # An error of 20 is a fifth of the flux.
    flux = np.array([99.0, 90.0, 99.9, 80.0])
    with pytest.raises(DataError, match=r"brightest integration is 99.9 ± 20 \("):
        refuse_starless(replace(made, flux=flux, square=flux**2 - 400.0), "a.fits")
    flux[1] = 100.1
    refuse_starless(replace(made, flux=flux, square=flux**2 - 400.0), "a.fits")
    refuse_starless(replace(made, square=made.flux**2 + 1.0), "a.fits")  # no error at all
    with pytest.raises(DataError, match=r" 0 ± 0 \(") as found:
        refuse_starless(replace(made, flux=np.zeros(4), square=np.ones(4)), "a.fits")
    assert found.value.source == "a.fits"


@pytest.mark.parametrize(("name", "floor"), [("flux", 0.1), ("shape", 0.02)], ids=["flux", "shape"])
def test_outliers_are_so_many_deviations_off(name: str, floor: float) -> None:
    """Of the scatter that the absolute deviations tell, and of the floor where that is larger."""
    field, limit, n = {"flux": "flux", "shape": "misfit"}[name], 4.0, 21
    made = frames(n)
    made = replace(made, shift_px=np.zeros((n, 2)))
    for width in (3.0, 0.1 * floor):
        usual = max(1.4826 * 0.5 * width, floor) * look_elsewhere(limit, n)
        hits = []
        for factor in (-1.2, -1.02, -0.9, 0.9, 1.02, 1.2):
            values = 100.0 + width * np.linspace(-1.0, 1.0, n)
            values[5] = 100.0 + factor * usual
            off = values - np.median(values)
            far = off[5] / max(1.4826 * np.median(np.abs(off)), floor)
            hits.append(abs(far) > look_elsewhere(limit, n))
            reason = select(replace(made, **{field: values}), limit, 1.5)
            assert reason[5] == (f"{name} is an outlier by {far:.1f} sigma" if hits[-1] else "")
            assert not any(np.delete(reason, 5))
        assert 0 < sum(hits) < 6


def test_dark_integrations_and_few_of_them_are_told_nothing_of() -> None:
    made = changed(frames(9), "flux", 2, 150.0)
    assert select(made, 3.0, 1.5)[2].startswith("flux is an outlier by ")
    two = made.select(np.isin(np.arange(9), [1, 2]))
    assert list(select(two, 3.0, 1.5)) == ["", ""]
    given = np.full(9, "no light", "U60")
    np.testing.assert_array_equal(select(replace(made, reason=given), 3.0, 1e-9), given)
    # What has a reason already neither counts nor gets another.
    reason = np.where(np.arange(9) < 4, "bad", "").astype("U60")
    wild = replace(made, flux=np.where(np.arange(9) < 4, 1e6, made.flux), reason=reason)
    assert list(select(wild, 9.0, 1.5)) == list(reason)


def test_stars_that_stand_far_from_the_middle_of_the_others_are_left_out() -> None:
    shift = np.array([[5.0, 3.0], [5.1, 3.0], [4.9, 3.1], [5.0, 2.9], [6.2, 3.9], [5.9, 3.9]])
    reason = select(replace(frames(6), shift_px=shift), 50.0, 1.4)
    middle = np.median(shift, axis=0)
    away = np.hypot(*(shift[4] - middle))
    assert away > 1.4 > np.hypot(*(shift[5] - middle))
    assert list(reason) == [*[""] * 4, f"star is {away:.2f} pixels off", ""]


def test_the_average_is_that_of_powers_and_bispectra(rng: np.random.Generator) -> None:
    """Sums written out, what the pointing lost and turned put back."""
    n, made = 5, frames(5)
    pointed = rng.uniform(0.7, 1.0, (n, MASK.n_baselines)) * np.exp(
        1j * rng.normal(size=(n, MASK.n_baselines))
    )
    found = average(made, pointed, MASK.triangle_baselines)
    square = sum(made.square) / n
    for b in range(MASK.n_baselines):
        power = [made.power[k, b] / abs(pointed[k, b]) ** 2 for k in range(n)]
        assert found.vis2[b] == pytest.approx(np.mean(power) / square)
        for k in range(n):
            own = (power[k] - found.vis2[b] * made.square[k]) / square
            assert found.deviation[k, b] == pytest.approx(own)
    angle = np.angle(pointed)
    for t, (ij, jk, ik) in enumerate(MASK.triangle_baselines):
        turned = [
            made.bispectrum[k, t] * np.exp(-1j * (angle[k, ij] + angle[k, jk] - angle[k, ik]))
            for k in range(n)
        ]
        assert found.closure_phase[t] == pytest.approx(np.angle(sum(turned)))
        for k in range(n):
            own = (turned[k] / np.mean(turned)).imag
            assert found.deviation[k, MASK.n_baselines + t] == pytest.approx(own)
    np.testing.assert_allclose(found.deviation.mean(axis=0), 0.0, atol=1e-12)


def stars() -> Cube:
    """Images of which one has no light and one no pixels; a row of pixels is never good."""
    instrument = load_instrument("niriss", "F480M")
    rng, n = np.random.default_rng(2), 7
    image = psf(instrument, instrument.bandpass.channels(n=2), 44, centre_px=(0.2, -0.1))
    images = rng.poisson(1e7 * image, (n, 44, 44)).astype(float)
    dq = np.zeros(images.shape, np.uint32)
    images[3] *= -1.0
    dq[1, 0, :30] = 1
    dq[5, :12] = 1
    dq[:, 40] = 1
    return Cube(
        images, instrument.pixel_scale_rad, "NIRISS", "F480M",
        error=np.sqrt(np.maximum(images, 0.0) + 5.0), dq=dq, mjd=6e4 + np.arange(n),
    )  # fmt: skip


def test_a_file_is_measured_in_pieces_as_in_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """And the mean of its samples is that of the integrations that hold light."""
    file = InMemoryCube(stars())
    operator = make_operator(file, ExtractOptions(), None)
    whole, samples, flux = measure_file(operator, file, 3)
    assert list(whole.number) == list(range(7))
    assert list(whole.file) == [3] * 7
    assert list(whole.mjd) == list(6e4 + np.arange(7))
    assert list(whole.reason) == [*[""] * 3, "no light", "", "too many bad pixels", ""]
    assert list(whole.n_bad[[0, 1]]) == [0, 30]
    assert whole.n_bad[5] >= 12 * 44
    assert flux == pytest.approx(whole.flux[whole.used].mean())
    lit, total = np.flatnonzero(whole.used), np.zeros(operator.sampling.n_samples, complex)
    pixels = file.read().images[:, operator.view.rows, operator.view.columns]
    moved: ComplexArray
    for k in lit:
        gone = ~operator.fit.used | file.read().bad[k].ravel()
        own = operator.fit.fill(pixels[k].reshape(1, -1), gone[None])
        _, moved = operator.sampling.apply(own)
        turn = np.exp(2j * np.pi * operator.view.frequency_px @ whole.shift_px[k])
        total += moved[0] * turn / len(lit)
    np.testing.assert_allclose(samples, total, rtol=1e-4, atol=1e-4 * flux)
    monkeypatch.setattr("amibayes.extraction.frames.CHUNK", 2)
    assert _chunk_size(file) == 2
    pieces, again, mean = measure_file(operator, file, 3)
    for name in ("flux", "shift_px", "power", "misfit", "n_bad", "mjd", "number"):
        np.testing.assert_allclose(getattr(pieces, name), getattr(whole, name), rtol=1e-5)
    np.testing.assert_allclose(again, samples, rtol=1e-5)
    assert mean == pytest.approx(flux)


def test_large_images_are_read_few_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    file = InMemoryCube(stars())
    assert _chunk_size(file) == 7
    for pixels, size in ((4 * 44 * 44 - 1, 3), (44, 1)):
        monkeypatch.setattr("amibayes.extraction.frames.CHUNK_PIXELS", pixels)
        assert _chunk_size(file) == size


def test_dates_of_integrations_else_of_the_exposure() -> None:
    made, template = frames(3), stars()
    some = replace(made, mjd=np.array([np.nan, 6e4, np.nan]))
    assert TIMES == ("EXPMID", "MJD-AVG", "MJD-OBS")
    header = {"EXPMID": "?", "MJD-AVG": 59000.5, "MJD-OBS": 58000}
    found = _with_times(some, replace(template, header=header))
    assert list(found.mjd) == [59000.5, 6e4, 59000.5]
    unknown = _with_times(some, replace(template, header={}))
    assert _mjd(unknown) == 6e4
    assert _mjd(replace(some, mjd=np.full(3, np.nan))) == 0.0
    reason = np.array(["", "bad", ""])
    assert _mjd(replace(found, reason=reason)) == 59000.5


def test_integrations_are_laid_end_to_end_and_chosen() -> None:
    one, other = frames(2), frames(3, seed=2)
    both = concatenated([one, other])
    assert len(both) == 5
    np.testing.assert_array_equal(both.power[2:], other.power)
    np.testing.assert_array_equal(both.select(np.arange(5) > 3).bispectrum, other.bispectrum[2:])


def test_an_integration_of_another_flux_is_no_outlier_and_its_hot_pixel_is() -> None:
    """Nine times the flux; the hot pixel, of a thousand times, does not decide what it is."""
    shape = (8, 8)
    reference = Reference(
        np.ones(shape), np.ones(shape), np.ones(shape, dtype=bool), None, 0,  # type: ignore[arg-type]
        np.ones((1, *shape)), has_errors=False, source="",
    )  # fmt: skip
    images = np.array([1.0, 9.0, 9.0, 9.0])[:, None, None] * np.ones(shape)
    images[2, 3, 4] = 7000.0
    images[3, 3, 4] = -7000.0
    bad = np.zeros(images.shape, dtype=bool)
    bad[1, 0, 0] = True
    images[1, 0, 0] = 1e9
    found = reference.outliers(images, bad, 5.0)
    assert np.argwhere(found).tolist() == [[2, 3, 4], [3, 3, 4]]


@pytest.mark.parametrize("size", [40, 80, 99, 100, 101, 300])
def test_the_part_of_an_image_around_a_star(size: int) -> None:
    """As large as usual, inside, and as near the middle as that allows; all if hardly larger."""
    for place in (0, 5, size // 2, size - 1):
        part = _part(size, 80, place)
        if size <= 100:
            assert part == slice(0, size)
            continue
        assert part.stop - part.start == 80
        starts = np.arange(size - 79)
        assert part.start == starts[np.abs(starts + 40 - place).argmin()]
