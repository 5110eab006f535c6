"""Numbers of the detection as they were recorded: a change of any of them is seen.

`pytest tests/detection/test_recorded_detection.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import interferometer
import numpy as np
import pytest
from brute_force import coverage
from channel_sets import pionier, with_draw
from helpers import niriss, simulated
from interferometer import four_telescopes
from recorded_numbers import numbers_of
from test_alternatives import chromatic, oval
from test_calibrator_consistency import star as calibrator_star

from amibayes.calibration import calibrate
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.result import SearchResult
from amibayes.companion_search.search import search
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables, join
from amibayes.detection.alternatives import (
    _chromatic_star,
    _elongated_star,
    symmetric_chi2,
)
from amibayes.detection.calibrator_consistency import compare_calibrators
from amibayes.detection.consistency import by_night, compare, consistency
from amibayes.detection.exposure_noise import exposure_noise
from amibayes.detection.false_alarm import (
    Significance,
    _share,
    bright_probability,
    draws_needed,
    reachable,
    significance,
)
from amibayes.detection.outlying_rows import may_be_left_out, outlying_rows, without_rows
from amibayes.detection.randomised import randomisation_of, randomised
from amibayes.detection.ratio import Ratio
from amibayes.detection.residuals import channel_correlation, file_residuals
from amibayes.detection.splits import Consistency
from amibayes.detection.statistic import make_statistic, statistic_of
from amibayes.detection.tails import (
    clopper_pearson,
    extreme_value_survival,
    pareto_quantile,
    pareto_survival,
    tail_of,
)
from amibayes.detection.treatments import FreeScale, drawn_scale
from amibayes.detection.verdict import change_by_companion, joint_probability, parts_of_fit, verdict
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.noise import noise_of
from amibayes.likelihood.student import StudentNoise, symmetric_whitening
from amibayes.models.binary import BinaryModel

FIELD = (110.0, 220.0)
TRUTH = (150.0, -80.0, 0.02)
TOLERANCE = {"rtol": 0.0, "atol": 1e-4}
DISC = BinaryModel(diameter_mas="free")


def of_two_files(estimated: bool = False) -> Observables:
    """Two files of other nights, one of which understates its errors."""
    rng, parts = np.random.default_rng(3), []
    for k, name in enumerate(("a", "b")):
        data = simulated(niriss(0.01 * (1.0 + k), 0.4), TRUTH, rng)
        tables = [replace(t, mjd=t.mjd + 2.0 * k) for t in (data.vis2, data.closure_phase)]
        setups = tuple(replace(s, source=name) for s in data.setups)
        covariance = niriss().covariance
        data = replace(data, vis2=tables[0], closure_phase=tables[1], setups=setups)
        parts.append(replace(data, covariance=covariance))
    data = join(parts)
    return replace(data, freedom=Freedom(60.0, 58.0)) if estimated else data


@pytest.fixture(scope="module")
def result() -> SearchResult:
    return search(Likelihood(of_two_files()), FIELD, check=False)


def of_statistic(test: Any, contrast: float = 0.01) -> dict[str, Any]:
    rng = np.random.default_rng(4)
    places = np.array([[150.0, -80.0, contrast], [-120.0, 60.0, contrast]])
    hits = test.simulated(40, rng)
    found = test.hits_in(test.noise(test.bank.normals(2, rng), rng), test.signal_of(places))
    field, x = test.field(test.observed), np.array([5.0, 20.0, 60.0])
    return {
        "value": test.value,
        "field": (field.max(), field.mean(), field.argmax()),
        "strongest": test.strongest,
        "hits": (hits.statistic, hits.gain),
        "found": found,
        "null": test.draw_null(60, np.random.default_rng(5)),
        "scatter": test.scatter_posterior(6, rng, stated_probable=True),
        "gain": test.gain_at(x),
        "error": test.contrast_error(places[:, :2]),
        "local": test.local_survival(x),
        "change": test.change_by(places),
        "again": test.with_noise_of(0.5 * test.observed).value,
    }


def test_statistics(result: SearchResult, num_regression) -> None:
    likelihood = result.likelihood
    grid, none = make_grid(110.0, 200.0, 16.0), np.empty(0)
    estimated = Likelihood(of_two_files(True))
    one = estimated.observables.unflagged()
    whole = Likelihood(replace(one, freedom=Freedom(30.0, 29.0)))
    base = likelihood.observables
    student = StudentNoise(likelihood.noise, noise_of(base), symmetric_whitening(base))
    disc = Likelihood(simulated(niriss(), TRUTH, np.random.default_rng(2)), DISC)
    exposures = _drifting()
    lasting = exposure_noise(exposures, none)
    assert lasting is not None
    shaken = lasting.shared(
        np.cos(np.arange(len(exposures.observables.data) * 3.0)).reshape(-1, 3),
        np.random.default_rng(3),
    )
    numbers = numbers_of(
        free=of_statistic(make_statistic(likelihood, grid, none)),
        stated=of_statistic(make_statistic(likelihood, grid, none, stated_errors=True)),
        estimated=of_statistic(make_statistic(whole, grid, none)),
        robust=of_statistic(
            make_statistic(
                likelihood.with_noise(student), grid, none, whitening=symmetric_whitening(base)
            )
        ),
        disc=of_statistic(make_statistic(disc, grid, np.array([20.0]))),
        of_result=statistic_of(result, beside=True).value,
        lasting=(lasting.vis2, lasting.closure_phase),
        covariance=lasting.noise.covariance.dense(),
        shaken=(shaken**2).sum(axis=0),
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def _drifting() -> Likelihood:
    """Seven exposures of an hour whose first half is too high."""
    sheet = four_telescopes(7, channels=1)
    table = sheet.vis2
    value = table.value + np.where(table.mjd < 60000.02, 0.03, -0.01)
    rng = np.random.default_rng(4)
    data = replace(sheet, vis2=replace(table, value=value))
    return Likelihood(data.with_data(data.data + sheet.covariance.draw(rng, 1)[:, 0]))


def test_probabilities(result: SearchResult, num_regression) -> None:
    test = statistic_of(result, stated_errors=True)
    tested = significance(test, 400, np.random.default_rng(6), alpha=0.02)
    null = np.sort(np.random.default_rng(7).chisquare(3, 2000) + 4.0)
    drawn = Significance(15.0, null, 0.01, (0.005, 0.02), None, 0.01)
    x = np.array([5.0, 14.0, 22.0, 40.0])
    exposed = Likelihood(simulated(pionier(12), (5.0, -3.0, 0.05), np.random.default_rng(8)))
    shuffled = make_statistic(exposed, make_grid(3.0, 7.0, 1.0), np.empty(0))
    shuffle = randomisation_of(exposed.observables)
    bright = search(
        Likelihood(simulated(niriss(), (126.0, -62.0, 0.9), np.random.default_rng(1))),
        FIELD,
        check=False,
    )
    free = statistic_of(bright)
    assert isinstance(free.treatment, FreeScale)
    ratios = (Ratio.known(30), Ratio.scale_free(30), Ratio.student(30, 40, 12.0))
    numbers = numbers_of(
        tested=(tested.statistic, tested.null, tested.probability, tested.interval),
        parametric=(tested.parametric, tested.n_above, tested.threshold(), tested.reach),
        survival=(tested.survival(x), drawn.survival(x)),
        tail=tail_of(null, 30.0, np.random.default_rng(8)),
        extreme=extreme_value_survival(null, x),
        pareto=pareto_survival(null, x),
        quantile=[pareto_quantile(null, a) for a in (0.2, 0.05, 0.001)],
        binomial=[clopper_pearson(*two) for two in ((0, 40), (3, 40), (40, 40))],
        needed=(draws_needed(0.01), draws_needed(0.0013), reachable(0.01, 300)),
        curves=[
            y
            for _, y in replace(drawn, tail=tail_of(null, 15.0, np.random.default_rng(1)))
            .tail_curves()
            .values()
        ],
        bright=(np.log(bright_probability(bright, free)), _share(bright, free, free.bank, 0.0)),
        shuffled=randomised(shuffled, 60, np.random.default_rng(9)),
        choices=(shuffle.log_choices, shuffle.n_exposures),
        orders=shuffle.draw(shuffled.residual, 3, np.random.default_rng(1)),
        ratios=[
            (r(np.array([3.0, 20.0]), 50.0), r.gain_at(x), r.local_survival(x, 2)) for r in ratios
        ],
        scales=[
            np.sort(drawn_scale(s, 20.0, 30, np.random.default_rng(2), stated_probable=p))
            for s, p in ((1.1, True), (1.1, False), (2.5, True))
        ],
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_agreement_of_the_parts(result: SearchResult, num_regression) -> None:
    data, theta = result.likelihood.observables, result.theta
    apart = consistency(result, np.random.default_rng(3), alpha=0.05)
    masks = by_night(data)
    estimated = compare(
        Likelihood(of_two_files(True)), theta, "epochs", masks, np.random.default_rng(4), 200
    )
    disc = Likelihood(data, DISC)
    star = compare(disc, np.append(theta, 20.0), "epochs", masks, np.random.default_rng(4), 200)
    calibrators: dict[str, Any] = {}
    for n in (2, 3):
        rng = np.random.default_rng(5)
        target = calibrator_star(rng, TRUTH, "target", 1.0)
        stars = [calibrator_star(rng, (0.0, 0.0, 0.0), f"cal{k}", 1.0) for k in range(n)]
        calibrated = calibrate(target, stars, method="weighted", clip=None).observables
        found: Any = SimpleNamespace(likelihood=Likelihood(calibrated), theta=np.array(TRUTH))
        pairs = [(s, (0.2, 0.1)) for s in stars]
        calibrators[f"of {n}"] = compare_calibrators(found, pairs, rng, 150)
    tested = Significance(30.0, np.arange(100.0), 0.01, (0.0, 0.02), None, 0.05)
    quiet = replace(tested, statistic=5.0, probability=0.4, interval=(0.3, 0.5))
    verdicts = [
        verdict(result, one, other, splits, structured=kind, noise=ExtraNoise())
        for one, other in ((tested, quiet), (quiet, tested), (quiet, quiet))
        for splits in ((), (Consistency("files", ("a", "b"), 9.0, 0.001),))
        for kind in (True, False)
    ]
    names = ("companion", "no companion", "model rejected", "inconsistent data")
    numbers = numbers_of(
        apart=apart,
        estimated=estimated,
        star=star,
        calibrators=calibrators,
        files=file_residuals(result),
        probability=[
            joint_probability(parts_of_fit(result.likelihood, result.theta, result.ndof, s))
            for s in (None, ExtraNoise())
        ],
        verdicts=[(names.index(v.statement), v.p_model) for v in verdicts],
        change=change_by_companion(result),
        white=channel_correlation(search(Likelihood(_channels()), (3.0, 6.0), check=False)),
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def _channels() -> Observables:
    sheet = pionier(2)
    noise = np.random.default_rng(2).standard_normal(len(sheet.data))
    smooth = np.convolve(noise, np.ones(3) / np.sqrt(3.0), mode="same")
    return with_draw(sheet, smooth * np.sqrt(sheet.covariance.variance))


def test_alternatives_and_outlying_rows(monkeypatch: pytest.MonkeyPatch, num_regression) -> None:
    # Fewer starts, in less time.
    monkeypatch.setattr("amibayes.detection.alternatives.OVAL_FITS", 1)
    monkeypatch.setattr("amibayes.detection.alternatives.OVAL_SIZES", 16)
    sheet = coverage("pionier", 0.01, np.radians(0.5))
    numbers: dict[str, Any] = {}
    model = BinaryModel(diameter_mas="free", smearing=False)
    for name, source in (("chromatic", chromatic), ("oval", oval)):
        data = interferometer.observed(sheet, source, np.random.default_rng(1))
        likelihood = Likelihood(data, model)
        theta = np.array([2.0, 1.0, 0.05, 3.4])
        found: Any = SimpleNamespace(
            theta=theta,
            nuisance=lambda wanted: {"diameter_mas": 3.4}.get(wanted, 0.0),
            star_alone=dict,
            companion=SimpleNamespace(separation_mas=2.2),
            chi2_binary=float(likelihood.n_independent),
            ndof=likelihood.n_independent - 4,
        )
        others = [symmetric_chi2(likelihood)]
        if name == "chromatic":
            chromatic_star = _chromatic_star(likelihood, found)
            assert chromatic_star is not None
            others.append(chromatic_star.chi2)
        else:
            others.append(_elongated_star(likelihood, found).chi2)
        numbers |= numbers_of(**{name: others})
    data = interferometer.observed(sheet, oval, np.random.default_rng(1))
    value = data.vis2.value.copy()
    value[8:12] += 0.5
    spoilt = replace(data, vis2=replace(data.vis2, value=value))
    fitted = Likelihood(spoilt, model)
    for systematics in ("table", (0.02, 0.01)):
        rows = outlying_rows(spoilt, fitted, np.array([2.0, 1.0, 0.05, 3.4]), systematics)
        left = without_rows(spoilt, rows)
        numbers |= numbers_of(
            **{
                f"rows {systematics[0]}": {
                    "rows": rows,
                    "left": (left.vis2.flag.sum(), left.closure_phase.flag.sum()),
                    "may": (may_be_left_out(spoilt, rows), may_be_left_out(spoilt, rows[:1])),
                }
            }
        )
    num_regression.check(numbers, default_tolerance=TOLERANCE)
