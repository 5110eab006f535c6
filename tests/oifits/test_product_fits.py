"""What the pipeline's fit of the fringes does to products: correlations, clipping, pointing."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from astropy.stats import sigma_clipped_stats
from jwst_products import MASK, binary, integrations, product, write_product

from amibayes.instrument import load_instrument
from amibayes.oifits import read_oifits
from amibayes.oifits.products import product_of
from amibayes.oifits.products.fringe_fit import correlated, fit_covariance
from amibayes.oifits.products.pointing import place_of
from amibayes.oifits.products.repairs import CLIPPED
from amibayes.oifits.tables import open_oifits
from amibayes.optics import scene_image
from amibayes.scene.sources import Scene
from amibayes.units import MAS


def test_correlations_are_those_of_images_fitted_with_even_weights(
    rng: np.random.Generator,
) -> None:
    """300 images with the noise of photons, by least squares of cosines and sines of our own."""
    instrument = load_instrument("niriss", "F480M").as_built()
    n, channels = 36, instrument.bandpass.channels()
    image = scene_image(Scene(), instrument, channels, n).centred
    pixel, holes = instrument.pixel_scale_rad, instrument.mask.holes_m
    place = pixel * (np.arange(n) - 0.5 * (n - 1))
    x, y = np.meshgrid(place, place)
    # The envelope from images of single holes at the mean wavelength; fringes of one colour.
    width = 1.03 * channels.mean_m / instrument.mask.size_m
    envelope = np.sinc(x / width) ** 2 * np.sinc(y / width) ** 2
    turns = [
        2.0 * np.pi * ((holes[j] - holes[i]) @ np.stack([x.ravel(), y.ravel()])) / channels.mean_m
        for i, j in combinations(range(len(holes)), 2)
    ]
    fringes = [envelope.ravel() * f(t) for f in (np.cos, np.sin) for t in turns]
    columns = np.stack([envelope.ravel(), *fringes, np.ones(n * n)], axis=1)
    photons = 1e6 * image.ravel() / image.sum()
    seen = photons + np.sqrt(photons) * rng.standard_normal((300, n * n))
    found = np.linalg.lstsq(columns, seen.T, rcond=None)[0][:-1]
    vis2 = (found[1:22] ** 2 + found[22:43] ** 2) / found[0] ** 2
    measured = np.corrcoef(vis2)
    covariance = fit_covariance("niriss", "F480M")
    assert covariance is not None
    slopes = np.zeros((21, 43))
    slopes[:, 0], slopes[np.arange(21), 1 + np.arange(21)] = -2.0, 2.0
    expected = slopes @ covariance @ slopes.T
    expected /= np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    apart = ~np.eye(21, dtype=bool)
    # 210 correlations of 300 draws: 0.06 each, but the model of this test is a rough one.
    assert expected[apart].mean() == pytest.approx(measured[apart].mean(), abs=0.03)
    assert np.sqrt(np.mean((expected - measured)[apart] ** 2)) < 0.10
    # What a contrast sees: the variance of a change that all baselines share.
    assert expected.sum() / 21 == pytest.approx(measured.sum() / 21, rel=0.25)


def test_an_average_has_the_correlations_of_its_fit(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    drawn = integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng)
    path = write_product(tmp_path / "a.fits", "ami-oi", drawn)
    found = read_oifits(path)
    whole = found.covariance.dense()
    sigma = np.sqrt(np.diag(whole))
    correlation = whole / np.outer(sigma, sigma)
    assert 0.05 < correlation[:21, :21][~np.eye(21, dtype=bool)].mean() < 0.15
    assert np.abs(correlation[:21, 21:]).max() < 1e-12
    assert found.covariance.rank == 36
    plain = read_oifits(path, closure_covariance="diagonal").covariance.dense()
    np.testing.assert_array_equal(plain, np.diag(np.diag(plain)))
    np.testing.assert_allclose(np.diag(plain)[:21], np.diag(whole)[:21], rtol=1e-12)
    assert np.diag(plain)[21:].sum() == pytest.approx(np.diag(whole)[21:].sum())


@pytest.mark.parametrize("n", [10, 20, 60])
def test_clipping_adds_what_clipped_means_scatter(n: int, rng: np.random.Generator) -> None:
    drawn = rng.standard_normal((n, 6000))
    off = sigma_clipped_stats(drawn, axis=0)[0] - drawn.mean(axis=0)
    share = np.interp(1.0 / n, *CLIPPED)
    assert n * np.mean(off**2) == pytest.approx(share, abs=0.004)


@pytest.mark.parametrize("place_mas", [(0.0, 0.0), (-12.0, 26.0), (90.0, -130.0)])
def test_the_place_of_light_is_that_of_its_phases(
    place_mas: tuple[float, float], rng: np.random.Generator
) -> None:
    mask = load_instrument("niriss", "F480M").mask
    uv = mask.uv_m / 4.8e-6
    place = MAS * np.array(place_mas)
    fringe = 0.9 * np.exp(-2j * np.pi * uv @ place + 0.02j * rng.standard_normal(21))
    # 0.02 rad of 21 baselines of 4 m and less: 0.2 mas.
    np.testing.assert_allclose(place_of(fringe, uv) / MAS, place_mas, atol=1.2)
    assert (place_of(fringe[:0], uv[:0]) == 0.0).all()


def test_baselines_counted_from_nought_have_no_place_in_the_fit(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Holes are counted from 1; where one is not among them nothing is changed."""
    drawn = integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng)
    path = write_product(tmp_path / "a.fits", "ami-oi", drawn)
    of_file = product_of(open_oifits(path))
    assert of_file is not None
    plain = read_oifits(path, closure_covariance="diagonal")
    setup = plain.setups[0]
    assert correlated(plain, of_file) is not plain
    # Of hole 0 one baseline is left, and the place that it would take by mistake is free.
    pairs = np.sort(plain.vis2.stations, axis=1).tolist()
    keep = [pair[0] > 0 or pair[1] == 3 for pair in pairs]
    keep = np.array([k and pair != [1, 2] for k, pair in zip(keep, pairs, strict=True)])
    few = plain.select(keep, np.ones(len(plain.closure_phase), bool))
    counted = replace(few, setups=(replace(setup, station_index=np.arange(7)),))
    assert correlated(counted, of_file) is counted
    for first in (0, 2):
        index = np.arange(first, first + 7)
        moved = replace(plain, setups=(replace(setup, station_index=index),))
        assert correlated(moved, of_file) is moved


def test_clipping_is_part_of_the_errors_of_closure_phases(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Without the errors of phases of baselines it is not known, and left out."""
    drawn = integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng)
    hdus = product("ami-oi", drawn)
    hdus.writeto(tmp_path / "a.fits")
    hdus["OI_VIS"].columns.del_col("VISPHIERR")
    hdus.writeto(tmp_path / "b.fits")
    more, less = (
        np.sum(read_oifits(tmp_path / name).errors[1] ** 2) for name in ("a.fits", "b.fits")
    )
    n = len(drawn)
    # Errors of phases of baselines, 0.02 by amplitudes near 1 and √n, on three sides of each.
    amplitude = np.abs(binary(0.1, 120.0, -80.0))
    each = (0.02 / amplitude) ** 2 / n
    added = np.interp(1.0 / n, *CLIPPED) * each[MASK.triangle_baselines].sum()
    assert more - less == pytest.approx(added, rel=0.25)
