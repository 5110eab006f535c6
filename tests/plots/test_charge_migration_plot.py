"""The picture of charge migration: what is pooled, and that nothing lies over a datum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.container import ErrorbarContainer
from matplotlib.figure import Figure

from amibayes.plots.charge_migration import BINS, _groups, migration_plot
from amibayes.plots.style import save
from amibayes.ramps.curvature import expected_curvature
from amibayes.ramps.fit import MigrationFit, fit_migration
from amibayes.units import FloatArray

N = 31


@pytest.fixture(scope="module")
def fit() -> MigrationFit:
    """A star whose brightest pixel has most of the information, with noise."""
    y, x = np.mgrid[:N, :N] - N // 2
    light = 6e4 * np.exp(-0.5 * ((x - 0.1) ** 2 + (y + 0.2) ** 2) / 0.8**2) + 20.0
    expected = expected_curvature(light, 200.0, 0.07544, 8, 400)
    assert expected is not None
    noise = np.random.default_rng(2).standard_normal(light.shape)
    change = 3.6e-7 * expected.gains[:2].sum(axis=0) + expected.sigma * noise
    return fit_migration([replace(expected, change=change)])


@pytest.fixture(scope="module")
def picture(fit: MigrationFit, tmp_path_factory: pytest.TempPathFactory) -> Figure:
    figure = migration_plot(fit)
    save(figure, tmp_path_factory.mktemp("picture") / "migration.png")
    return figure


def points(ax: Axes) -> list[FloatArray]:
    """Data (n, 2) of every series with errors."""
    series = [c for c in ax.containers if isinstance(c, ErrorbarContainer)]
    return [np.asarray(c.lines[0].get_xydata()) for c in series]


def labelled(figure: Figure, label: str) -> Axes:
    return next(ax for ax in figure.axes if ax.get_xlabel().startswith(label))


def test_a_number_with_much_of_the_information_stands_alone() -> None:
    # Pixels of a real visit: the brightest has 43 % of the information.
    predicted = np.array([-750.0, -80.0, -60.0, -40.0, 3.0, -1.0, 200.0, 210.0, 150.0, 90.0])
    weight = np.full(10, 1e-4)
    group = _groups(predicted, weight)
    assert np.count_nonzero(group == group[0]) == 1
    assert group[1] == group[2] == group[3]


@pytest.mark.parametrize("scale", [0.0, 1.0])
def test_groups_are_in_order_and_none_is_empty(scale: float) -> None:
    rng = np.random.default_rng(3)
    predicted = scale * rng.standard_cauchy(500)
    weight = rng.uniform(0.5, 1.0, 500)
    group = _groups(predicted, weight)
    assert set(group) == set(range(group.max() + 1))
    assert (np.diff(group[np.argsort(predicted)]) >= 0).all()
    told = np.bincount(group, weight * predicted**2)
    count = np.bincount(group)
    # A group ends in the middle of a number's share, which is no more than that of a group.
    assert (told[count > 1] <= 2.01 / BINS * told.sum()).all()


def test_the_brightest_pixel_is_drawn_as_it_was_measured(
    fit: MigrationFit, picture: Figure
) -> None:
    (exposure,) = fit.exposures
    place = exposure.current.argmax()
    dominant = fit.predicted(exposure).ravel()[place], exposure.change.ravel()[place]
    (drawn,) = points(labelled(picture, "Predicted"))
    assert np.isclose(drawn, dominant).all(axis=1).any()
    assert len(drawn) <= 2 * BINS


def test_fringes_are_drawn_pixel_by_pixel(fit: MigrationFit, picture: Figure) -> None:
    (exposure,) = fit.exposures
    row, column = np.unravel_index(exposure.current.argmax(), exposure.current.shape)
    along_x, along_y = points(labelled(picture, "Place across the fringes"))
    assert len(along_x) == len(along_y) == 25
    np.testing.assert_allclose(along_x[:, 1], exposure.change[row, column - 12 : column + 13])
    np.testing.assert_allclose(along_y[:, 1], exposure.change[row - 12 : row + 13, column])
    np.testing.assert_allclose(along_x[:, 0].round(), np.arange(-12, 13))


def test_no_legend_lies_over_the_data(picture: Figure) -> None:
    legends = [(ax, ax.get_legend()) for ax in picture.axes if ax.get_legend() is not None]
    assert len(legends) == 3
    for ax, legend in legends:
        assert legend is not None
        assert legend.get_window_extent().y0 >= ax.get_window_extent().y1
