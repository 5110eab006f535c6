"""Numbers of the search as they were recorded: a change of any of them is seen.

`pytest tests/companion_search/test_recorded_companion_search.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers import niriss, simulated
from recorded_numbers import numbers_of

from amibayes.companion_search.descent import damped_steps, descend
from amibayes.companion_search.exact_map import exact_map
from amibayes.companion_search.field import (
    choose_field,
    default_separation,
    look_inside,
    look_outside,
    notices_disc,
    outermost,
    resolution_mas,
    resolves_stars,
    wider_fields,
)
from amibayes.companion_search.grid import make_grid, trial_rates
from amibayes.companion_search.modes import distinct_modes, innermost_first
from amibayes.companion_search.optimise import (
    fit_single,
    refine,
    starting_points,
    widest_steps,
    with_disc,
    with_large_discs,
)
from amibayes.companion_search.result import Companion, Mode, SearchResult
from amibayes.companion_search.robust import RobustFits, search_robust
from amibayes.companion_search.scan import (
    GroupWeights,
    ScaleGroups,
    best_positive,
    scale_groups,
    weighted_gain,
)
from amibayes.companion_search.search import search
from amibayes.companion_search.second_companion import search_second
from amibayes.companion_search.seeds import bright_seeds, coarse_likelihood, peaks, trial_stars
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.companion_search.with_extra_noise import noise_averaged, search_with_noise
from amibayes.data.observables import Observables, join
from amibayes.likelihood.likelihood import Likelihood, single_likelihood
from amibayes.models.bands import bands_of
from amibayes.models.binary import BinaryModel
from amibayes.models.extended import Extended
from amibayes.models.parameters import Box

TRUTH = (150.0, -80.0, 0.02)
FIELD = (100.0, 220.0)
# Optimisers stop within a thousandth of χ²: places within some 1e-2 of their errors, at worst.
FITTED = {"rtol": 0.0, "atol": 1e-4}
EXACT = {"rtol": 0.0, "atol": 1e-5}
FREE = {
    "diameter_mas": "free",
    "limb_darkening": "free",
    "background": "free",
}


def data_of(theta: tuple[float, ...], model: BinaryModel | None = None, **options: Any) -> Any:
    return simulated(niriss(**options), theta, np.random.default_rng(1), model)


@pytest.fixture(scope="module")
def likelihood() -> Likelihood:
    return Likelihood(data_of(TRUTH))


@pytest.fixture(scope="module")
def result(likelihood: Likelihood) -> SearchResult:
    return search(likelihood, FIELD)


def of_result(found: SearchResult) -> dict[str, Any]:
    best = found.companion
    return {
        "theta": found.theta,
        "errors": np.sqrt(np.diag(found.theta_covariance)),
        "covariance": found.theta_covariance / found.theta_covariance.max(),
        "companion": best,
        "separation": best.separation_mas,
        "angle": best.position_angle_deg,
        "magnitude": (best.delta_mag, best.delta_mag_error),
        "single": found.single_theta,
        "chi2": (found.chi2_single, found.chi2_binary, found.delta_chi2),
        "ndof": found.ndof,
        "n_sigma": found.candid_n_sigma,
        "gains": [m.delta_chi2 for m in found.modes[:4]],
        "rivals": len(found.rivals),
        "aliases": len(found.aliases),
        "bank": (found.bank_contrast, found.bank_sigma, found.bank_gain),
        "bank_delta_chi2": found.bank_delta_chi2,
        "step": (found.grid.step_mas, len(found.grid)),
        "check": found.global_check and found.global_check.delta_chi2,
    }


def test_searches(likelihood: Likelihood, result: SearchResult, num_regression) -> None:
    star = BinaryModel(diameter_mas="free")
    bright = Likelihood(data_of((150.0, -80.0, 0.3, 30.0), star), star)
    numbers = numbers_of(
        faint=of_result(result),
        bright=of_result(search(bright, (100.0, 220.0))),
        alone=search(bright, (100.0, 220.0), check=False).star_alone(),
        vis2=of_result(search(Likelihood(data_of(TRUTH).only(["vis2"])), (100.0, 220.0))),
    )
    num_regression.check(numbers, default_tolerance=FITTED)


def test_joint_searches(num_regression) -> None:
    data = data_of(TRUTH)
    shifted = replace(
        data,
        setups=tuple(
            replace(s, wavelength_m=0.8 * s.wavelength_m, band_m=0.5 * s.band_m)
            for s in data.setups
        ),
        vis2=_moved(data.vis2),
        closure_phase=_moved(data.closure_phase),
    )
    both = join([data, shifted])
    bands = tuple(b.name for b in bands_of(both))
    numbers = {}
    for name, model in (
        ("bands", BinaryModel(bands=bands)),
        ("motion", BinaryModel(fastest_mas_yr=100.0, reference_mjd=60050.0)),
    ):
        found = search(Likelihood(both, model), (120.0, 200.0), check=False)
        bank = TemplateBank(found.likelihood, found.grid, found.single_theta)
        residuals = single_likelihood(found.likelihood).residuals(found.single_theta)[:, 0]
        numbers |= numbers_of(
            **{
                name: of_result(found),
                f"{name} contrasts": found.contrasts,
                f"{name} later": found.position_at(60300.0),
                f"{name} rates": trial_rates(found.likelihood),
                f"{name} filter": bank.matched_filter(residuals)(np.array([150.0, -80.0])),
            }
        )
    num_regression.check(numbers, default_tolerance=FITTED)


def _moved(table: Any) -> Any:
    return replace(
        table,
        mjd=table.mjd + 100.0,
        wavelength_m=0.8 * table.wavelength_m,
        band_m=0.5 * table.band_m,
    )


def noisy_pair() -> Observables:
    """Two companions, and errors that are understated."""
    pair, model = (*TRUTH, -90.0, 110.0, 0.01), BinaryModel(companions=2)
    noisy = simulated(niriss(0.012, 0.6), pair, np.random.default_rng(2), model)
    return replace(noisy, covariance=niriss().covariance)


def test_extra_noise_and_two_companions(num_regression) -> None:
    data = noisy_pair()
    found, noise = search_with_noise(Likelihood(data), (100.0, 200.0))
    two = search_second(found)
    averaged, second = noise_averaged(found, two, data)
    assert second is not None
    numbers = numbers_of(
        found=of_result(found),
        noise=noise,
        two=(two.theta, two.chi2, [m.delta_chi2 for m in two.modes[:2]]),
        two_errors=np.sqrt(np.diag(two.theta_covariance)),
        log_prob=averaged.likelihood.log_prob(found.theta),
        second=second.likelihood.log_prob(two.theta),
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-3})


def test_robust_residuals(monkeypatch: pytest.MonkeyPatch, num_regression) -> None:
    monkeypatch.setattr("amibayes.companion_search.robust.MAX_SEARCHES", 1)
    monkeypatch.setattr("amibayes.companion_search.robust.MAX_STEPS", 2)
    data = noisy_pair()
    spoilt = data.data.copy()
    spoilt[[4, 40]] += np.array([0.2, -0.2])
    robust, scale = search_robust(Likelihood(data.with_data(spoilt)), (110.0, 190.0))
    assert robust.robustness is not None
    student, _ = noise_averaged(robust, None, data)
    numbers = numbers_of(
        robust=of_result(robust),
        scale=scale,
        weights=robust.robustness.weights,
        residuals=robust.robustness.residuals,
        student=student.likelihood.log_prob(robust.theta),
        robust_log_prob=RobustFits(Likelihood(data), None, True).log_prob(robust.theta[None]),
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-3})


def test_template_banks(num_regression) -> None:
    data = data_of(TRUTH, channels=2)
    star = BinaryModel(diameter_mas="free", background="free")
    around = Extended("ring", "ring", smoothed=True, crescent=True)
    crescent = replace(star, surroundings=(around,))
    shapes = np.array([30.0, 0.1, 0.2, 100.0, 0.7, 30.0, 0.2, 0.6, 80.0])
    coloured = replace(star, companion_diameter_mas=20.0, contrast_slope=1.0)
    numbers = {}
    for name, model, single in (
        ("star", star, np.array([30.0, 0.1])),
        ("crescent", crescent, shapes),
        ("coloured", coloured, np.array([30.0, 0.1])),
    ):
        likelihood = Likelihood(data, model)
        bank = TemplateBank(likelihood, make_grid(80.0, 200.0, 25.0), single)
        white = single_likelihood(likelihood).residuals(single)[:, 0]
        draws = np.random.default_rng(3).standard_normal((len(data.data), 4))
        residuals = likelihood.noise.whiten(likelihood.noise.covariance.sparse @ draws * 100.0)
        groups = scale_groups(data, bank.n_nuisance)
        weight = 1.0 / groups.variances(residuals)
        weighted = GroupWeights(groups, weight)
        place = np.array([150.0, -80.0])
        reduced = bank.reduced(np.zeros(bank.n_data, dtype=np.intp))
        east, north = place[:1], place[1:]
        beside = TemplateBank(likelihood, bank.grid, single, beside=np.append(TRUTH, single))
        units = next(unit for _, each in bank.by_band() for unit in each)
        found = {
            "scan": bank.scan(white),
            "survey": bank.survey(white),
            "filter": bank.matched_filter(white)(place),
            "at": bank.scan_at(white, east, north),
            "largest": bank.largest_gain(residuals)[0],
            "weighted": bank.largest_gain(weight[groups.label] * residuals, weighted)[0],
            "gains": weighted_gain(weighted, units[None], [residuals.T @ units]),
            "projected": (bank.project(residuals) ** 2).sum(axis=0),
            "beside": beside.scan(white),
            "reduced": reduced.scan(reduced.reduce(white)),
            "length": (reduced.reduce(residuals) ** 2).sum(axis=0),
            "groups": (np.bincount(groups.label), groups.share, groups.degrees),
            "map": exact_map(likelihood, bank.grid, single, (0.1, 0.6)).chi2,
            "best": exact_map(likelihood, bank.grid, single, (0.1, 0.6)).best,
            "gain": exact_map(likelihood, bank.grid, single, (0.1, 0.6)).gain,
        }
        numbers |= numbers_of(**{name: found})
    num_regression.check(numbers, default_tolerance=EXACT)


def test_fits(likelihood: Likelihood, num_regression) -> None:
    box = Box(60.0, 160.0, resolution_mas(likelihood))
    seeds = np.array([[140.0, -70.0, 0.01], [-60.0, 30.0, 0.3], [20.0, 155.0, 0.0]])
    theta, chi2 = descend(likelihood, seeds, box)
    star = BinaryModel(**FREE, companion_diameter_mas="free", contrast_slope="free")
    resolved = Likelihood(data_of((*TRUTH, 20.0, 0.5, 70.0, 0.4, 0.1), star, channels=3), star)
    light = BinaryModel(surroundings=(Extended("gaussian", inclined=False),))
    around = Likelihood(data_of((*TRUTH, 0.1, 100.0), light), light)
    alone = np.array([60.0, 0.3, 0.1])
    points = starting_points(resolved, seeds[:, :2], seeds[:, 2:], alone, box)
    mode = refine(likelihood, seeds[0], Box(60.0, 400.0, box.fringe_mas), 100.0)
    rng = np.random.default_rng(5)
    root = rng.standard_normal((3, 4, 4))
    held = np.array([[0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 0, 0]], dtype=bool)
    steps = damped_steps(
        root @ root.swapaxes(1, 2), rng.random((3, 4)), 0.1 * np.ones((3, 4)), held
    )
    numbers = numbers_of(
        descended=(theta, chi2),
        steps=steps,
        refined=(mode.theta, mode.delta_chi2),
        known=fit_single(resolved, alone)[1],
        light=fit_single(around),
        points=points,
        large=with_large_discs(resolved, points, box),
        disc=with_disc(resolved, np.arange(7.0), box),
        widest=widest_steps(resolved, box),
        trials=trial_stars(resolved, alone, box),
        bright=bright_seeds(likelihood, np.empty(0), box),
    )
    num_regression.check(numbers, default_tolerance=FITTED)


def test_fields_and_grids(likelihood: Likelihood, result: SearchResult, num_regression) -> None:
    grid = make_grid(60.0, 200.0, 14.0)
    gain = 20.0 * np.cos(0.02 * grid.east_mas) ** 2 * np.cos(0.013 * grid.north_mas + 0.3) ** 2
    far = search(Likelihood(data_of((430.0, 60.0, 0.02))), FIELD, check=False)
    near = search(likelihood, (220.0, 320.0), check=False)
    outside = search(likelihood, (60.0, 120.0), check=False)
    many = Likelihood(niriss(channels=60))
    places = [(100.0, 50.0), (105.0, 52.0), (-300.0, 40.0), (-90.0, 10.0)]
    modes = [
        Mode((*place, 0.01), 50.0 - 0.3 * k, (Companion(*place, 0.01),))
        for k, place in enumerate(places)
    ]
    kept = distinct_modes(modes, 120.0)
    first, aliases = innermost_first(likelihood, kept, np.empty(0), 120.0)
    rng = np.random.default_rng(6)
    match = rng.standard_normal((3, 5))
    shared = {(0, 1): 0.4 * np.ones(5), (1, 2): -0.3 * np.ones(5)}
    groups = ScaleGroups(np.array([0, 0, 1, 1, 1, 2]), 0.8)
    numbers = numbers_of(
        grid=grid,
        image=grid.image(gain),
        tiles=[len(tile) for tile in grid.half_plane(40, tiles=True)],
        coarse=[grid.coarse(tile) for tile in grid.half_plane(40, tiles=True)],
        peaks=(peaks(grid, gain, 120.0), peaks(grid, gain, 120.0, 2, 3)),
        field=default_separation(likelihood),
        outermost=outermost(many),
        resolves=resolves_stars(likelihood),
        notices=[notices_disc(likelihood, d) for d in (1.0, 30.0)],
        chosen=choose_field(Likelihood(data_of((430.0, 60.0, 0.02), channels=3))),
        inside=look_inside(near),
        outside=(look_outside(outside), look_outside(far)),
        wider=(wider_fields(result), wider_fields(far)),
        coarser=len(coarse_likelihood(many, Box(50.0, 300.0, 120.0)).observables.data),
        modes=[m.place for m in kept],
        first=[m.place for m in first],
        aliases=[m.place for m in aliases],
        positive=best_positive(match, shared),
        variances=groups.variances(rng.standard_normal((6, 2))),
    )
    num_regression.check(numbers, default_tolerance=FITTED)
