"""Pictures: labelled, true to their data, the same bytes each time, and without a warning."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from helpers import niriss, simulated
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from PIL import Image
from scipy.stats import binomtest

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.result import Companion, Mode, SearchResult
from amibayes.companion_search.search import search
from amibayes.data.covariance import diagonal_covariance
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance
from amibayes.detection.statistic import statistic_of
from amibayes.errors import RunError
from amibayes.imaging import reconstruct_image
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.mass_table import MassTable
from amibayes.models.binary import BinaryModel
from amibayes.plots.calibration import _keys, calibrator_plot
from amibayes.plots.contrast_curve import Curve, completeness_map, contrast_marks, limits_plot
from amibayes.plots.corner_plot import corner_plot, interval_text, label_of, trace_plot
from amibayes.plots.coverage import coverage_plot
from amibayes.plots.fit import _Kind, fit_plot
from amibayes.plots.maps import (
    detection_map,
    false_alarm_map,
    local_n_sigma,
    probability_maps,
    save_maps_fits,
    sky_map,
)
from amibayes.plots.null_plot import null_plot
from amibayes.plots.reconstruction import image_plot
from amibayes.plots.residual_corr import correlation_plot
from amibayes.plots.style import save
from amibayes.support.atomic_files import short_names

TRUTH = (90.0, 110.0, 0.01)
UNITS = ("(mas)", "(m)", "(Mλ)", "(°)", "(σ)", "(%)", "(µm)", "(flux ratio)")
PURE_NUMBERS = (
    "False-alarm probability",
    "V²",
    "σ of V²",
    "Δχ²",
    "√Δχ²",
    "Contrast",
    "Correlation",
    "Number of",
    "Null data sets",
    "Probability",
    "Largest",
    "Magnitude",
    "Share",
    "Step",
    "ln ",
)


@pytest.fixture(scope="module")
def found() -> SearchResult:
    data = simulated(niriss(channels=2), TRUTH, np.random.default_rng(4))
    return search(Likelihood(data, BinaryModel()), (60.0, 400.0))


def by_hand(data: Observables, theta: tuple[float, ...]) -> SearchResult:
    """A result without a search, for data sets too large for one."""
    likelihood = Likelihood(data, BinaryModel())
    grid = make_grid(50.0, 200.0, 50.0)
    contrast = np.linspace(-0.01, 0.01, len(grid))
    best = np.array(theta)
    return SearchResult(
        likelihood=likelihood,
        companion=Companion(*theta),
        theta=best,
        theta_covariance=np.eye(3),
        single_theta=np.empty(0),
        chi2_single=500.0,
        chi2_binary=100.0,
        ndof=100,
        modes=(Mode(theta, 400.0, (Companion(*theta),)),),
        grid=grid,
        bank_contrast=contrast,
        bank_sigma=np.full(len(grid), 0.001),
        global_check=Mode(theta, 400.0, (Companion(*theta),)),
    )


def samples(n: int = 4000) -> np.ndarray:
    mean, sigma = np.array([90.0, 110.0, 0.0101]), np.array([1.0, 2.0, 2e-4])
    return mean + sigma * np.random.default_rng(1).standard_normal((n, 3))


NAMES = ("east_mas", "north_mas", "contrast")
SEPARATION = np.linspace(50.0, 400.0, 8)
LIMIT = 6.0 + 0.002 * SEPARATION


def fraction() -> np.ndarray:
    return 1.0 / (1.0 + np.exp((np.linspace(3.0, 9.0, 13) - LIMIT[:, None]) / 0.3))


def null_maxima() -> np.ndarray:
    return np.random.default_rng(2).gumbel(6.0, 1.8, 1000)


def tails() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    x = np.linspace(10.0, 40.0, 50)
    return {"Pareto": (x, np.exp(-(x - 6.0) / 1.8)), "GEV": (x, np.exp(-(x - 6.0) / 1.9))}


PICTURES: dict[str, Callable[[SearchResult], Figure]] = {
    "map": detection_map,
    "map and signed contrast": lambda r: detection_map(r, quantity="delta_chi2", contrast="signed"),
    "map and contrast": lambda r: detection_map(r, contrast="positive"),
    "n sigma": lambda r: sky_map(r, local_n_sigma(r), "Local nσ (σ)", vmin=0.0),
    "false alarms": lambda r: false_alarm_map(r, weight_of(r)),
    "fit": fit_plot,
    "fit of closure phases": lambda r: fit_plot(
        by_hand(r.likelihood.observables.only(["cp"]), TRUTH)
    ),
    "coverage": lambda r: coverage_plot(r.likelihood.observables),
    "coverage of one channel": lambda r: coverage_plot(niriss()),
    "corner": lambda r: corner_plot(samples(), NAMES, truths=TRUTH, best=r.theta),
    "corner of few": lambda r: corner_plot(samples(50), NAMES),
    "chains": lambda r: trace_plot(
        samples(4000).reshape(200, 20, 3), NAMES, 40, samples(4000)[:, 0].reshape(200, 20)
    ),
    "correlations": lambda r: correlation_plot(r.likelihood.observables),
    "correlations of V²": lambda r: correlation_plot(niriss().only(["vis2"])),
    "correlations of many": lambda r: correlation_plot(niriss(channels=12)),
    "calibrators": lambda r: calibrator_plot(
        [niriss(), niriss()], [True, False], ["HD 1", "HD 2"], niriss()
    ),
    "calibrators of many": lambda r: calibrator_plot([niriss(channels=9)], [True], ["HD 1"]),
    "limits": lambda r: limits_plot(
        SEPARATION, {"a": Curve(LIMIT, LIMIT - 0.2, LIMIT + 0.2), "b": Curve(LIMIT)}, r.companion
    ),
    "limits, ambiguous places, masses": lambda r: limits_plot(
        SEPARATION,
        {"a": Curve(LIMIT, by_detection=SEPARATION > 200.0), "b": Curve(LIMIT - 0.5)},
        fringe_mas=140.0,
        masses=MassTable(np.array([2.0, 6.0, 12.0]), np.array([60.0, 20.0, 3.0]), "M_Jup"),
    ),
    "completeness": lambda r: completeness_map(
        SEPARATION, np.linspace(3.0, 9.0, 13), fraction(), LIMIT, LIMIT - 0.9
    ),
    "completeness, levels of their own": lambda r: completeness_map(
        SEPARATION, LIMIT[:, None] + np.linspace(-1.0, 1.0, 13), fraction()
    ),
    "null": lambda r: null_plot(null_maxima(), 31.0, tails(), 0.0013),
    "null, far": lambda r: null_plot(null_maxima(), 310.0, tails(), 0.0013),
    "null, tail at a point": lambda r: null_plot(
        null_maxima(), 24.0, {"Pareto": (np.array([24.0]), np.array([1e-5]))}, 0.0013
    ),
    "null alone": lambda r: null_plot(null_maxima(), 7.0),
}


def rc_settings() -> dict[str, object]:
    """matplotlib's own settings; looking at the backend would choose one."""
    return {k: matplotlib.rcParams[k] for k in matplotlib.rcParams if k != "backend"}


def has_unit(label: str) -> bool:
    return any(u in label for u in UNITS) or label.startswith(PURE_NUMBERS)


@pytest.mark.parametrize("name", PICTURES)
def test_picture_is_labelled_whole_and_always_the_same_bytes(
    name: str,
    found: SearchResult,
    tmp_path: Path,
    caplog: pytest.LogCaptureFixture,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    settings = rc_settings()
    caplog.set_level(logging.WARNING)
    figure = PICTURES[name](found)
    labels = [a.get_label_text() for ax in figure.axes for a in (ax.xaxis, ax.yaxis)]
    assert sum(bool(label) for label in labels) >= 2
    assert [x for x in labels if x and not has_unit(x)] == []
    save(figure, tmp_path / "a.png")
    # The same bytes are asked of small pictures without layout, a tenth of the time.
    monkeypatch.setattr("amibayes.plots.style.DPI", 40)
    monkeypatch.setattr(ConstrainedLayoutEngine, "execute", lambda engine, figure: None)
    save(PICTURES[name](found), tmp_path / "b.png")
    with matplotlib.rc_context({"font.size": 20.0, "axes.facecolor": "red"}):
        save(PICTURES[name](found), tmp_path / "c.png")
    assert (tmp_path / "b.png").read_bytes() == (tmp_path / "c.png").read_bytes()
    with Image.open(tmp_path / "a.png") as image:
        assert image.width >= 1000
        assert len(image.convert("L").getcolors() or range(300)) > 20
        assert image.text == {}
        page = np.asarray(image.convert("L"))
    # Text that is cut off leaves dark pixels on the very edge.
    assert min(edge.min() for edge in (page[0], page[-1], page[:, 0], page[:, -1])) > 200
    assert rc_settings() == settings
    assert caplog.records == []


def test_the_same_figure_saved_again_is_the_same(found: SearchResult, tmp_path: Path) -> None:
    figure = detection_map(found)
    for name in ("a.png", "b.png"):
        save(figure, tmp_path / name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_save_into_no_folder_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="cannot be written"):
        save(coverage_plot(niriss()), tmp_path / "missing" / "a.png")


def test_map_has_east_left_and_the_companion_on_its_brightest_pixel(found: SearchResult) -> None:
    ax = detection_map(found).axes[0]
    left, right = ax.get_xlim()
    low, high = ax.get_ylim()
    assert left > 0 > right
    assert low < 0 < high
    image = ax.images[0]
    row, column = np.unravel_index(np.nanargmax(image.get_array()), image.get_array().shape)
    west, east, south, north = image.get_extent()
    n = len(image.get_array())
    at = west + (column + 0.5) * (east - west) / n, south + (row + 0.5) * (north - south) / n
    assert np.hypot(at[0] - TRUTH[0], at[1] - TRUTH[1]) < 1.5 * found.grid.step_mas
    marked = next(line for line in ax.lines if line.get_label() == "best fit")
    np.testing.assert_allclose(
        np.ravel(marked.get_data()), [found.companion.east_mas, found.companion.north_mas]
    )


def with_coordinates(result: SearchResult, ra: float, dec: float) -> SearchResult:
    data = result.likelihood.observables
    setup = replace(data.setups[0], right_ascension_deg=ra, declination_deg=dec, target="HD 1")
    moved = Likelihood(replace(data, setups=(setup,)), result.likelihood.model)
    return replace(result, likelihood=moved)


def test_fits_maps_lead_to_the_offsets_of_the_grid(found: SearchResult, tmp_path: Path) -> None:
    path = tmp_path / "maps.fits"
    star = SkyCoord(201.3, -63.1, unit="deg")
    extra = {"false_alarm": np.linspace(0.0, 1.0, len(found.grid))}
    save_maps_fits(path, with_coordinates(found, star.ra.deg, star.dec.deg), extra)
    with fits.open(path) as hdus:
        names = [h.name for h in hdus[1:]]
        assert names == ["DCHI2", "CONTRAST", "CONTRAST_ERR", "NSIGMA", "FALSE_ALARM"]
        values = [found.bank_delta_chi2, found.bank_contrast, found.bank_sigma]
        values += [local_n_sigma(found), *extra.values()]
        sky = WCS(hdus["DCHI2"].header)
        positions = star.spherical_offsets_by(
            *[x * 1e-3 / 3600.0 * star.ra.unit for x in (found.grid.east_mas, found.grid.north_mas)]
        )
        x, y = sky.world_to_pixel(positions)
        assert x[np.argmax(found.grid.east_mas)] < 1.5  # east is left
        i, j = np.rint(x).astype(int), np.rint(y).astype(int)
        assert np.abs([x - i, y - j]).max() < 1e-3
        for name, expected in zip(names, values, strict=True):
            np.testing.assert_array_equal(hdus[name].data[j, i], expected)
            assert np.isfinite(hdus[name].data).sum() == len(found.grid)


def test_fits_maps_without_coordinates_are_offsets_in_mas(
    found: SearchResult, tmp_path: Path
) -> None:
    save_maps_fits(tmp_path / "a.fits", found)
    save_maps_fits(tmp_path / "b.fits", found)
    assert (tmp_path / "a.fits").read_bytes() == (tmp_path / "b.fits").read_bytes()
    with fits.open(tmp_path / "a.fits") as hdus:
        sky, image = WCS(hdus["DCHI2"].header), hdus["DCHI2"].data
        row, column = np.unravel_index(np.nanargmax(image), image.shape)
        east, north = sky.wcs_pix2world(column, row, 0)
        assert list(sky.wcs.ctype) == ["EAST", "NORTH"]
        assert [str(u) for u in sky.wcs.cunit] == ["mas", "mas"]
    peak = int(np.argmax(found.bank_delta_chi2))
    assert east == pytest.approx(found.grid.east_mas[peak])
    assert north == pytest.approx(found.grid.north_mas[peak])


def weight_of(result: SearchResult) -> Significance:
    null = np.sort(null_maxima())
    test, field = statistic_of(result), result.bank_delta_chi2
    return Significance(31.0, null, 1e-3, (0.0, 4e-3), None, 0.0013, test, field)


def test_false_alarm_probability_is_lowest_where_the_statistic_is_highest(
    found: SearchResult,
) -> None:
    maps = probability_maps(weight_of(found))
    peak = int(np.argmax(found.bank_delta_chi2))
    for p in maps.values():
        assert p.argmin() == peak
        assert ((p > 0) & (p <= 1)).all()
    assert (maps["local"] <= maps["global"]).all()
    with pytest.raises(ValueError, match="no statistic per position"):
        probability_maps(replace(weight_of(found), field=None))


def test_a_map_of_another_size_is_refused(found: SearchResult, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one per position"):
        save_maps_fits(tmp_path / "a.fits", found, {"x": np.zeros(3)})
    assert list(tmp_path.iterdir()) == []


def test_residuals_are_those_of_the_likelihood_and_wrap(found: SearchResult) -> None:
    data = found.likelihood.observables
    alone = replace(data, covariance=diagonal_covariance(data.covariance.variance))
    turned = replace(
        alone,
        closure_phase=replace(alone.closure_phase, value=alone.closure_phase.value + 2.0 * np.pi),
    )
    result = by_hand(turned, TRUTH)
    lower = fit_plot(result).axes[3]
    drawn = np.sort(lower.lines[2].get_ydata())
    whitened = result.likelihood.residuals([TRUTH])[len(data.vis2) :, 0]
    np.testing.assert_allclose(drawn, np.sort(whitened), atol=1e-9)


@pytest.mark.slow
def test_a_hundred_thousand_data_are_thinned_and_it_says_so(tmp_path: Path) -> None:
    data = niriss(channels=1786)
    assert len(data.data) > 1e5
    figure = fit_plot(by_hand(data, TRUTH))
    notes = [text.get_text() for ax in figure.axes for text in ax.texts]
    assert notes[0] == "1 in 26 of 37506 data drawn here, all residuals below"
    assert len(figure.axes[1].lines[2].get_xdata()) == len(data.vis2)
    save(figure, tmp_path / "a.png")
    for large in (coverage_plot(data), correlation_plot(data)):
        save(large, tmp_path / "b.png")


def test_coverage_has_every_baseline_and_its_mirror_image() -> None:
    axes = coverage_plot(niriss()).axes
    closures, squares = [c.get_offsets() for c in axes[0].collections]
    hexagon = np.array([[5.28, 0.0]])
    assert len(squares) == len(closures) == 42
    assert np.hypot(*np.asarray(squares).T).max() == pytest.approx(hexagon[0, 0], rel=0.01)
    scaled = np.asarray(axes[1].collections[1].get_offsets())
    np.testing.assert_allclose(np.sort(scaled[:, 0]), np.sort(squares[:, 0]) / 4.817, atol=2e-6)


def test_corner_titles_are_medians_and_68_percent_intervals() -> None:
    draws = samples(50_000)
    axes = corner_plot(draws, NAMES).axes
    assert axes[0].get_title().startswith("East (mas)\n$90.0")
    assert axes[8].get_title().startswith("Contrast × 10$^{3}$\n$10.10_{-0.20}^{+0.20}")


def test_a_parameter_that_never_moves_has_a_corner() -> None:
    draws = samples()
    draws[:, 1] = 110.0
    assert "110" in corner_plot(draws, NAMES).axes[4].get_title()


def test_a_single_parameter_has_a_corner() -> None:
    """corner overplots lines on figures of two and more parameters only."""
    figure = corner_plot(samples()[:, :1], NAMES[:1], truths=[91.0], best=[90.0])
    (panel,) = figure.axes
    assert {90.0, 91.0} <= {float(np.mean(line.get_xdata())) for line in panel.lines}
    assert panel.get_title().startswith("East (mas)\n$90.0")


@pytest.mark.parametrize("shape", [(10, 2), (2, 3), (3, 3, 3), (10, 0)])
def test_samples_that_do_not_fit_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="labels"):
        corner_plot(np.zeros(shape), NAMES)


def test_samples_that_are_not_finite_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        corner_plot(np.full((10, 3), np.nan), NAMES)


def test_intervals_have_two_digits_of_the_smaller_side() -> None:
    assert interval_text(147.083, 0.72, 0.81) == "$147.08_{-0.72}^{+0.81}$"
    assert interval_text(147.083, 12.0, 25.0) == "$147_{-12}^{+25}$"
    assert label_of("contrast_2") == "Contrast, 2"
    assert label_of("jitter") == "jitter"


def test_a_contrast_of_a_band_says_so_on_a_line_of_its_own() -> None:
    names = ["contrast[NIRISS_4.29um]", "contrast_2[NIRISS_4.82um]"]
    axes = corner_plot(0.01 * samples()[:, :1] / 90.0 * [[1.0, 1.1]], names).axes
    band = "NIRISS\u00a04.29\u00a0µm"
    assert axes[0].get_title().startswith(f"Contrast × 10$^{{3}}$,\n{band}\n$10.0")
    assert label_of(names[1]) == "Contrast, 2,\nNIRISS\u00a04.82\u00a0µm"


def test_names_of_many_calibrators_stay_inside_the_picture() -> None:
    """As many columns as there is room for, and no two names alike."""
    names = short_names([f"{folder}/a_calibrator_calints.oifits" for folder in ("f380m", "f480m")])
    assert names == [f"{folder}/a_calibrator_calints.oifits" for folder in ("f380m", "f480m")]
    assert short_names(["a/x", "a/y", "b/a/y", "c/a/y"]) == ["x", "a/y", "b/a/y", "c/a/y"]
    drawn = calibrator_plot([niriss()] * 6, [True] * 6, names * 3)
    drawn.draw_without_rendering()
    (legend,) = drawn.legends
    box = legend.get_window_extent()
    assert box.x0 > 0.0
    assert box.x1 < drawn.bbox.x1


def test_chain_thinning_is_stated() -> None:
    chain = np.random.default_rng(3).standard_normal((5000, 100, 1))
    figure = trace_plot(chain, ["east_mas"], 1000)
    assert figure.axes[0].get_title() == "50 of 100 walkers, 5000 steps (1 in 3 drawn)"


def test_correlations_of_the_mask_are_one_third() -> None:
    image = correlation_plot(niriss()).axes[0].images[0].get_array()
    # Triangles share at most one baseline of three: correlations are 0 or ±1/3.
    off = np.abs(image[21:, 21:][~np.eye(35, dtype=bool)])
    assert off.max() == pytest.approx(1.0 / 3.0, abs=1e-3)
    assert np.abs(image[:21, 21:]).max() == 0.0


def test_calibrators_match_by_stations_and_closure_phases_follow_in_sign() -> None:
    sheet = simulated(niriss(), TRUTH, None)
    m = sheet.closure_phase
    # The same triangles the other way round: φ(cb) + φ(ba) − φ(ca) = −closure phase.
    back = replace(
        m,
        stations=m.stations[:, ::-1],
        value=-m.value,
        u_m=-m.u_m[:, ::-1],
        v_m=-m.v_m[:, ::-1],
    )
    key, sign = _keys(sheet, m)
    key_back, sign_back = _keys(sheet, back)
    np.testing.assert_array_equal(key, key_back)
    np.testing.assert_allclose(sign * m.value, sign_back * back.value)
    assert len(set(key)) == 35
    figure = calibrator_plot(
        [sheet, replace(sheet, closure_phase=back)], [True, True], ["a", "b"], sheet
    )
    drawn = [line.get_ydata() for line in figure.axes[1].lines if len(line.get_ydata()) == 35]
    np.testing.assert_allclose(*drawn)


def test_survival_and_its_band_are_the_binomial_ones() -> None:
    maxima = np.arange(1.0, 201.0)
    ax = null_plot(maxima, 150.0).axes[1]
    curve = ax.lines[0]
    np.testing.assert_allclose(curve.get_ydata()[150], 50 / 200)
    interval = binomtest(50, 200).proportion_ci(0.68)
    band = np.asarray(ax.collections[0].get_paths()[0].vertices)
    edge = np.unique(band[np.isclose(band[:, 0], 151.0)][:, 1])
    for bound in interval:
        assert np.abs(edge - bound).min() < 1e-12


def test_a_detection_far_beyond_the_draws_is_pointed_at() -> None:
    figure = null_plot(null_maxima(), 331.2, tails())
    left, right = figure.axes[0].get_xlim()
    assert 0.0 < left + 5.0 < right < 40.0
    assert "331.2" in figure.axes[0].texts[0].get_text()


def test_round_contrasts_stand_at_their_magnitudes() -> None:
    np.testing.assert_allclose(contrast_marks(2.4, 5.1), [2.5, 3.25257, 4.24743, 5.0], atol=1e-5)
    np.testing.assert_allclose(contrast_marks(6.2, 6.9), [6.30720, 6.74743], atol=1e-5)
    np.testing.assert_allclose(contrast_marks(0.0, 10.1), [0.0, 2.5, 5.0, 7.5, 10.0])


def test_fainter_is_lower() -> None:
    bottom, top = limits_plot(SEPARATION, {"a": Curve(LIMIT)}).axes[0].get_ylim()
    assert bottom > top


def test_residuals_of_angles_go_the_short_way_round() -> None:
    nothing = np.zeros(4)
    observed, model = np.array([179.0, -179.0, 10.0, 350.0]), np.array([-179.0, 179.0, 4.0, -8.0])
    sigma = np.array([1.0, 2.0, 3.0, 4.0])
    angles = _Kind("closure phase", "°", nothing, observed, sigma, nothing, nothing, 360.0)
    np.testing.assert_allclose(angles.residual(model), [-2.0, 1.0, 2.0, -0.5])
    plain = _Kind("V²", "", nothing, observed, sigma, nothing, nothing)
    np.testing.assert_allclose(plain.residual(model), (observed - model) / sigma)


def test_numbers_of_colour_bars_stay_apart(tmp_path: Path) -> None:
    """A companion far outside of the stated star's light: 21 000 of its flux in a pixel."""
    data = simulated(niriss(), [110.0, -75.0, 0.02], np.random.default_rng(3))
    found = reconstruct_image(data, weight=100.0, pixel_mas=60.0, rng=np.random.default_rng(4))
    bright = replace(found, light=found.light * 21_000.0 / found.light.max())
    figure = image_plot(bright)
    save(figure, tmp_path / "image.png")
    bars = [ax for ax in figure.axes if ax.get_label() == "<colorbar>"]
    assert "Flux per pixel (10⁴)" in [bar.get_xlabel() for bar in bars]
    for bar in bars:
        ends = [t.get_window_extent() for t in bar.get_xticklabels() if t.get_text()]
        assert all(one.x1 < other.x0 for one, other in pairwise(ends))
