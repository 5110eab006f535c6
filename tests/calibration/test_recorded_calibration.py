"""Numbers of the calibration as they were recorded: a change of any of them is seen.

`pytest tests/calibration/test_recorded_calibration.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from drifting_visits import Drift, visits
from oi_builders import random_observables
from recorded_numbers import checker
from scipy.sparse import diags_array

from amibayes.calibration import calibrate
from amibayes.calibration.diameters import diameters_of, without_disc
from amibayes.calibration.leave_one_out import leave_out
from amibayes.calibration.library import add_to_library, read_library
from amibayes.calibration.matching import keys_of, match, sharing, station_positions
from amibayes.calibration.narrowing import narrowed
from amibayes.calibration.population import components, inflation, predict
from amibayes.calibration.reduction import reduce_data
from amibayes.calibration.scatter_likelihood import population_of
from amibayes.calibration.scatter_posterior import ScatterGrid, sample_tau
from amibayes.calibration.transfer import kernel_projector, on_one_branch, transfer_of
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables, join
from amibayes.data.shared_errors import SharedErrors

DISCS = [(5.0, 0.5), (0.0, 0.0), (3.0, 0.2), (8.0, 0.0)]


def extracted(star: Observables, seed: int) -> Observables:
    """The same with what an extraction tells beside: freedom, scatter, errors of the charge."""
    rng = np.random.default_rng(seed)
    variance = star.covariance.variance
    changes = np.sqrt(variance)[:, None] * rng.normal(size=(len(star.data), 2))
    return replace(
        star,
        freedom=Freedom(30.0 + seed, 20.0 + 2.0 * seed),
        covariance_kind="estimated",
        n_integrations=40 + seed,
        scatter=diags_array(0.6 * variance).tocsr(),
    ).with_shared_errors(SharedErrors(("charge x", "charge y"), changes))


@pytest.fixture(scope="module")
def stars() -> list[Observables]:
    """A target with a companion, then four calibrators, of an instrument that drifts."""
    mjd = 60000.0 + np.array([4.0, 0.0, 3.0, 5.0, 9.0])
    return visits(Drift(2.0), mjd, np.random.default_rng(1), {0: [150.0, 60.0, 0.03]})


def check_calibration(found, num_regression) -> None:
    levels = [] if found.tau is None else np.quantile(found.tau, [0.1, 0.5, 0.9], axis=0)
    checker(num_regression)(
        data=found.observables.data,
        covariance=found.observables.covariance,
        freedom=found.observables.freedom,
        scatter=found.observables.scatter,
        shared=None if found.observables.shared is None else found.observables.shared.changes,
        expected=found.observables.vis2.expected,
        slope=found.observables.vis2.coherent_slope,
        tau=levels,
        medians=(found.tau_vis2 or 0.0, found.tau_closure_phase_rad or 0.0),
        used=[use.n_used for use in found.calibrators],
        clipped=[use.n_clipped for use in found.calibrators],
        told=None if found.told is None else found.told.number({"charge x": 1.0, "charge y": 2.0}),
    )


def test_calibration_with_outliers_is_that_recorded(
    stars: list[Observables], num_regression
) -> None:
    """Discs of calibrators whose diameters are uncertain, outliers among their values."""
    found = calibrate(stars[0], stars[1:], method="weighted", clip=2.5, diameters_mas=DISCS)
    check_calibration(found, num_regression)


def test_calibration_by_a_population_is_that_recorded(num_regression) -> None:
    """Nine calibrators that drift together."""
    mjd = 60000.0 + np.array([13.0, *(3.0 * np.arange(9))])
    target, *others = visits(Drift(4.0), mjd, np.random.default_rng(9))
    check_calibration(calibrate(target, others, method="population"), num_regression)


@pytest.mark.parametrize("method", ["weighted", "hierarchical"])
def test_calibrations_of_extracted_data_are_those_recorded(
    method: str, stars: list[Observables], num_regression
) -> None:
    """Freedom, scatter and shared errors go into those of the result."""
    told = [extracted(star, k) for k, star in enumerate(stars)]
    found = calibrate(told[0], told[1:4], method=method, diameters_mas=DISCS[:3])
    check_calibration(found, num_regression)


def test_calibration_by_charge_and_of_epochs_is_that_recorded(
    stars: list[Observables], num_regression
) -> None:
    """Two targets, of which a window of time leaves each its own calibrators."""
    other = replace(stars[4], setups=(replace(stars[4].setups[0], source="b.oifits"),))
    found = calibrate([stars[0], other], stars[1:4], window_days=4.5, method="weighted")
    only = [star.only(["vis2"]) for star in stars]
    charge = calibrate(only[0], only[1:], charge_levels=[2.0, 1.0, 3.0, 5.0, 4.0])
    checker(num_regression)(
        data=found.observables.data,
        covariance=found.observables.covariance,
        used=[use.n_used for use in found.calibrators],
        setups=found.n_setups,
        targets=[part.data for part in found.targets],
        by_charge=charge.observables.data,
        charge_covariance=charge.observables.covariance,
        tau=(charge.tau_vis2 or 0.0, charge.tau_closure_phase_rad or 0.0),
    )


def test_parts_of_the_scatter_are_those_recorded(stars: list[Observables], num_regression) -> None:
    """Transfers, likelihood of the scatter, its grid and draws, and one star left out."""
    keys = keys_of(stars[0])
    told = [extracted(star, k) for k, star in enumerate(stars[1:])]
    seen = on_one_branch([transfer_of(c, keys, d) for c, d in zip(told, DISCS, strict=True)], keys)
    known = np.all([t.seen for t in seen], axis=0)
    population = population_of(seen, keys, known)
    grid = ScatterGrid.of(population)
    left = leave_out(1, list(zip(told, DISCS, strict=True)), keys)
    assert left is not None
    templates = np.random.default_rng(2).normal(size=(3, len(keys)))
    against = left.against(templates, np.array([1]))
    drawn = left.draw(40, np.random.default_rng(3))
    tau = np.array([[0.1, 0.2], [1.0, 0.4], [3.0, 2.0]]) * population.prior_scale
    checker(num_regression)(
        transfers=seen,
        known=known,
        projector=kernel_projector(keys, known),
        log_prob=population.log_prob(tau),
        relative=grid.log_prob(np.array([[0.5, 0.6], [2.0, 0.1]])),
        density=grid.log_density(np.array([[0.5, 0.6], [2.0, 0.1]])),
        scale=grid.scale,
        posterior=grid.posterior,
        sampled=np.quantile(sample_tau(grid, np.random.default_rng(4)), [0.2, 0.8], axis=0),
        grid_draws=grid.draw(np.random.default_rng(5), 50),
        others=(left.n_others, left.n_independent),
        response=left.response,
        score=against.score(left.measured),
        against=against.covariance,
        scatter=against.scatter(drawn),
        whole=against.whole(drawn),
        narrowed=narrowed(seen),
        passed_over=("names",),
    )


def test_matches_are_those_recorded(num_regression) -> None:
    """Stations in another order, by their places, and reversed."""
    one = random_observables(np.random.default_rng(6), n_stations=5, n_channels=2, kind="diagonal")
    order = np.array([3, 1, 4, 0, 2])
    setup = one.setups[0]
    moved = replace(
        setup,
        stations=tuple(setup.stations[k] for k in order),
        station_xyz_m=setup.station_xyz_m[order],
        station_diameter_m=setup.station_diameter_m[order],
    )
    place = np.argsort(order)
    other = replace(
        one,
        vis2=replace(one.vis2, stations=place[one.vis2.stations]),
        closure_phase=replace(one.closure_phase, stations=place[one.closure_phase.stations]),
        setups=(moved,),
    )
    unnamed = replace(other, setups=(replace(moved, stations=tuple("abcde")),))
    keys = keys_of(one, 0.5)
    checker(num_regression)(
        keys=keys,
        names=match(other, keys),
        places=match(unnamed, keys),
        positions=station_positions(unnamed, 0),
        sharing=sharing([one, other, unnamed]),
        passed_over=("configurations", "setup"),
    )


def test_components_of_a_population_are_those_recorded(num_regression) -> None:
    """Modes with noise, their prediction at a date, and by how much errors are too small."""
    rng = np.random.default_rng(7)
    days = np.sort(rng.uniform(0.0, 60.0, 14))
    modes = rng.normal(size=(2, 9))
    data = np.stack([np.sin(days / 9.0), np.cos(days / 5.0)], axis=1) @ modes
    data += 0.3 * rng.normal(size=data.shape)
    noise = rng.uniform(0.05, 0.12, len(data))
    found = components(data, noise)
    checker(num_regression)(
        mean=found.mean,
        variance=found.variance,
        scatter=found.scatter,
        space=found.modes @ found.modes.T,
        predicted=predict(found, data, noise, days, 21.0),
        inflation=inflation(data, noise, days)[0],
    )


def test_reduced_data_are_those_recorded(num_regression) -> None:
    """Rules, polarisations, channels and epochs, of exposures that are nearly alike."""
    rng = np.random.default_rng(8)
    parts = []
    for name in ("I_P1", "I_P2"):
        star = random_observables(
            rng, n_stations=4, n_channels=4, n_exposures=3, kind="assumed", name=name
        )
        parts.append(replace(star, setups=(replace(star.setups[0], source=name),)))
    same = replace(parts[0].setups[0], insname="I_P2", source="I_P2")
    parts[1] = replace(parts[1], setups=(same,))
    for k, m in enumerate(("vis2", "closure_phase")):
        own = getattr(parts[0], m)
        parts[1] = replace(
            parts[1],
            **{m: replace(own, value=getattr(parts[1], m).value, mjd=own.mjd + 1e-4 * k)},
        )
    both = join(parts)
    rules = ["vis2>0.97", "cp_deg<-20", "vis2_error>0.0195", "cp_error_deg>1.12", "snr<28"]
    flagged = reduce_data(both, flag=rules)
    where = reduce_data(parts[0], flag=["baseline_m>3", "mjd>59000.265", "station=H3"])
    binned = reduce_data(parts[0], channels=3)
    averaged = reduce_data(both, polarisations=True)
    merged = reduce_data(flagged, channels=2, polarisations=True, epochs_days=0.015)
    checker(num_regression)(
        flags=(flagged.vis2.flag, flagged.closure_phase.flag),
        where=(where.vis2.flag, where.closure_phase.flag),
        binned=binned,
        averaged=averaged,
        merged=merged,
        properties=False,
        passed_over=("setups", "station_index", "wave"),
    )


def test_discs_and_a_library_are_those_recorded(
    stars: list[Observables], tmp_path: Path, num_regression
) -> None:
    """A table of diameters, the nearest band of a catalogue, and what a file keeps."""
    table, catalogue = tmp_path / "a.csv", tmp_path / "b.csv"
    table.write_text("name,diameter_mas,error_mas\nstar1,0.7,0.02\nstar2,1.4,0.1\n")
    catalogue.write_text("name,UDDK,UDDL,UDDM,e_LDD\nstar_1,1,2,3,0.1\nSTAR 2,4,5,6,0.2\n")
    told = extracted(stars[1], 3)
    add_to_library(tmp_path / "lib.h5", [told, stars[2]])
    library = read_library(tmp_path / "lib.h5")
    checker(num_regression)(
        table=diameters_of(table, stars[1:3]),
        catalogue=diameters_of(catalogue, stars[1:3]),
        without=without_disc(told, 12.0),
        kept=library.observables,
        mjd=[s.mjd for s in library.stars],
        passed_over=("setups",),
    )
