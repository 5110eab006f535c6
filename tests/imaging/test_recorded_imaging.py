"""Numbers of reconstructed images as they were recorded: a change of any of them is seen.

`pytest tests/imaging/test_recorded_imaging.py --force-regen` records them anew. Images after
many steps of a minimiser depend on rounding: objectives, gradients and scores do not.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import niriss
from recorded_numbers import checker
from scenes import disc, observed

import amibayes as ab
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables
from amibayes.imaging.choice import as_good, cross_validated, largest_that_fits, p_fit
from amibayes.imaging.data_term import DataTerm
from amibayes.imaging.field import choose_grid, default_field, repetition_mas
from amibayes.imaging.folds import folds_of
from amibayes.imaging.grid import PixelGrid, pixel_response
from amibayes.imaging.problem import Problem
from amibayes.imaging.regularisers import REGULARISERS, default_image
from amibayes.imaging.warnings import warnings_of
from amibayes.models.uv_points import uv_points_of


@pytest.fixture(scope="module")
def data() -> Observables:
    return observed(niriss(0.003, 0.1), disc(), np.random.default_rng(5))


@pytest.mark.parametrize("regulariser", sorted(REGULARISERS))
@pytest.mark.parametrize("kind", ["gaussian", "estimated"])
def test_objectives_are_those_recorded(
    regulariser: str, kind: str, data: Observables, num_regression
) -> None:
    """Data term and regulariser with gradients, with and without a disc of the star."""
    if kind == "estimated":
        data = replace(data, freedom=Freedom(40.0, 39.0), covariance_kind="estimated")
    samples, grid = uv_points_of(data), PixelGrid(9, 50.0)
    light = np.random.default_rng(6).uniform(1e-4, 1e-3, 81)
    term = DataTerm.of(data, samples)
    numbers = {}
    for star, flux in ((True, None), (True, 0.05), (False, None)):
        response = pixel_response(samples, grid, star=star, diameter_mas=20.0)
        problem = Problem(response, grid, REGULARISERS[regulariser](grid, flux), True)
        visibility, _ = response.visibility(light)
        numbers[f"{star}{flux}"] = {
            "objective": problem.objective(term, 3.0, light),
            "visibility": visibility,
            "first": problem.first(term),
            "largest": problem.largest_disc_mas,
            "ends": len(problem.ends(light)),
            "fluxes": (response.star_flux, response.star),
        }
    checker(num_regression)(
        numbers=numbers,
        residual=term.residual(visibility),
        chi2=(term.chi2(visibility), term.deviance(visibility)),
        pull=term.with_pull(visibility),
        p=[p_fit(term, x) for x in (20.0, 40.0, 60.0)],
        counts=term.n_vis2,
    )


def test_grids_and_choices_are_those_recorded(data: Observables, num_regression) -> None:
    """Fields, folds of a cross-validation, scores that are as good as the best."""
    samples = uv_points_of(data)
    scores = np.array([5.0, 3.0, 2.4, 2.2, 2.5, 4.0])
    checker(num_regression)(
        grids=[
            choose_grid(samples),
            choose_grid(samples, 900.0),
            choose_grid(samples, 700.0, 31.0),
        ],
        field=(default_field(samples), repetition_mas(samples)),
        axes=(PixelGrid(5, 20.0).east_mas, PixelGrid(5, 20.0).north_mas),
        folds=folds_of(data, np.random.default_rng(7)),
        good=as_good(scores, np.full(6, 0.4)),
        prior=default_image(PixelGrid(7, 40.0)),
    )


def test_images_are_those_recorded(data: Observables, num_regression) -> None:
    """With a strong regulariser the minimum is well defined: to a per mille."""
    found = ab.reconstruct_image(
        data, regulariser="tv", weight=300.0, field_mas=350.0, pixel_mas=70.0, diameter_mas=0.0
    )
    checker(num_regression, 2e-3)(
        light=found.light,
        flux=found.flux,
        chi2=(found.chi2, found.chi2_vis2, found.chi2_phase, found.chi2_star, found.chi2r),
        p=found.p_fit,
        convolved=found.convolved(60.0),
        beam=(found.beam_mas, found.dirty_beam()),
        dirty=found.dirty_image(),
        counts=(found.n_vis2, found.n_phases, found.n_independent, len(warnings_of(found))),
        beside=found.beside_star,
    )


def test_weights_are_chosen_as_recorded(
    data: Observables, monkeypatch: pytest.MonkeyPatch, num_regression
) -> None:
    """Two strong weights, whose images are well defined."""
    monkeypatch.setattr("amibayes.imaging.choice.WEIGHTS", (3000.0, 300.0))
    samples, grid = uv_points_of(data), PixelGrid(5, 70.0)
    problem = Problem(pixel_response(samples, grid), grid, REGULARISERS["tv"](grid), True)
    term = DataTerm.of(data, samples)
    table = cross_validated(problem, data, samples, np.random.default_rng(8), None)
    weight, _ = largest_that_fits(problem, term, table)
    checker(num_regression, 2e-3)(table=table, weight=weight)
