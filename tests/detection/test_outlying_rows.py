"""One spoilt row among many: it is found, named and left out; light that the model lacks is not."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import interferometer
import numpy as np
import pytest
from brute_force import coverage
from interferometer import darkened_disc

from amibayes.data.observables import Observables
from amibayes.detection.outlying_rows import OutlyingRow, may_be_left_out, outlying_rows
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import search_field
from amibayes.pipeline.options import SearchOptions
from amibayes.report.common import left_out_json
from amibayes.units import MAS

Visibility = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
OPTIONS = SearchOptions(separation_mas=(1.0, 12.0), diameter=0.5, systematics="none")


def sky(*companions: tuple[float, float, float]) -> Visibility:
    """A star of 0.5 mas and points at (east, north) of a flux ratio."""

    def visibility(u: np.ndarray, v: np.ndarray, _: np.ndarray) -> np.ndarray:
        light = darkened_disc(0.5, 0.0, u, v) + 0j
        for east, north, ratio in companions:
            light = light + ratio * np.exp(-2j * np.pi * MAS * (east * u + north * v))
        return np.asarray(light / (1.0 + sum(ratio for *_, ratio in companions)))

    return visibility


def observed(source: Visibility, seed: int) -> Observables:
    """PIONIER, with errors of 0.01 in V² and 0.5° in closure phase."""
    sheet = coverage("pionier", 0.01, np.radians(0.5))
    return interferometer.observed(sheet, source, np.random.default_rng(seed))


def spoilt(data: Observables, kind: str, entry: int) -> Observables:
    """The row of one entry with another V² (by 0.6), or closure phase (by 50°), in all channels."""
    table = data.vis2 if kind == "vis2" else data.closure_phase
    row = (table.setup == table.setup[entry]) & (table.row == table.row[entry])
    value = table.value + np.where(row, 0.6 if kind == "vis2" else np.radians(50.0), 0.0)
    name = "vis2" if kind == "vis2" else "closure_phase"
    return replace(data, **{name: replace(table, value=value)})


@pytest.mark.parametrize("kind", ["vis2", pytest.param("cp", marks=pytest.mark.slow)])
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_spoilt_row_is_left_out_and_the_companion_found(kind: str, seed: int) -> None:
    """The row alone, and the binary as it is found without it; all data where asked for."""
    clean = observed(sky((5.0, -4.0, 0.05)), seed)
    table = clean.vis2 if kind == "vis2" else clean.closure_phase
    entry = int(np.random.default_rng(seed).integers(len(table)))
    found = search_field(spoilt(clean, kind, entry), OPTIONS)
    (row,) = found.left_out
    assert (row.kind, row.setup, row.row) == (kind, table.setup[entry], table.row[entry])
    flagged = (
        found.observables.vis2.flag if kind == "vis2" else found.observables.closure_phase.flag
    )
    assert (flagged == ((table.setup == row.setup) & (table.row == row.row))).all()
    assert str(row) in found.warnings[0]
    companion = found.result.companion
    assert np.hypot(companion.east_mas - 5.0, companion.north_mas + 4.0) < 0.15
    assert companion.contrast == pytest.approx(0.05, rel=0.2)
    kept = search_field(spoilt(clean, kind, entry), replace(OPTIONS, keep_outliers=True))
    assert kept.left_out == ()
    assert not kept.observables.vis2.flag.any()
    assert kept.noise.exceeds_stated  # what the row is taken for


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(sky(), id="star", marks=pytest.mark.slow),
        pytest.param(sky((5.0, -4.0, 0.3)), id="binary"),
        pytest.param(sky((5.0, -4.0, 0.1), (-2.0, 7.0, 0.1)), id="triple", marks=pytest.mark.slow),
        pytest.param(sky((3.0, 2.0, 0.9)), id="equal stars", marks=pytest.mark.slow),
    ],
)
def test_nothing_is_left_out_of_other_light_and_of_noise(source: Visibility) -> None:
    """A third star is seen in many rows: none is outlying, or too many are."""
    for seed in range(4):
        assert search_field(observed(source, seed), OPTIONS).left_out == ()


def test_deviation_is_that_of_the_row() -> None:
    """Root mean square in errors, by hand, at the true source; rows of normal noise are none."""
    data = observed(sky((5.0, -4.0, 0.05)), 3)
    likelihood = Likelihood(data, BinaryModel(diameter_mas=0.5, smearing=False))
    theta = np.array([5.0, -4.0, 0.05])
    assert outlying_rows(data, likelihood, theta) == ()
    wrong = spoilt(data, "vis2", 7)
    (row,) = outlying_rows(wrong, likelihood, theta)
    at = (data.vis2.setup == row.setup) & (data.vis2.row == row.row)
    z = likelihood.difference(theta[None])[: data.n_vis2, 0][at] + 0.6
    assert row.deviation == pytest.approx(np.sqrt(np.mean(z**2)) / 0.01, rel=1e-6)
    # PIONIER's calibration errors (3 % of V², 0.005 of V) stand beside the stated ones.
    named = replace(wrong, setups=tuple(replace(s, insname="PIONIER") for s in wrong.setups))
    (again,) = outlying_rows(named, likelihood, theta)
    value = wrong.vis2.value[at]
    error = np.sqrt(0.01**2 + (0.03 * value) ** 2 + (2.0 * np.sqrt(value) * 0.005) ** 2)
    assert again.deviation == pytest.approx(np.sqrt(np.mean((z / error) ** 2)), rel=1e-6)
    assert outlying_rows(named, likelihood, theta, "none") == (row,)
    assert outlying_rows(named, likelihood, theta, (0.5, 1.0)) == ()


def test_rows_without_a_date_are_left_out() -> None:
    """One row at most as long as it is one: a date that is not a number equals no other."""
    clean = observed(sky((5.0, -4.0, 0.05)), 1)
    nowhen = {
        name: replace(t, mjd=np.full(len(t), np.nan))
        for name, t in (("vis2", clean.vis2), ("closure_phase", clean.closure_phase))
    }
    found = search_field(spoilt(replace(clean, **nowhen), "vis2", 5), OPTIONS)
    assert len(found.left_out) == 1
    assert "MJD" not in str(found.left_out[0])
    assert json.dumps(left_out_json(found.left_out), allow_nan=False)


def test_more_spoilt_rows_than_may_be_are_all_kept() -> None:
    """Six of some hundred rows, of five outlying at a time none is left out."""
    data = observed(sky((5.0, -4.0, 0.05)), 2)
    rows = np.unique(np.column_stack([data.vis2.setup, data.vis2.row]), axis=0, return_index=True)
    for entry in rows[1][:: max(1, len(rows[1]) // 6)][:6]:
        data = spoilt(data, "vis2", int(entry))
    assert search_field(data, OPTIONS).left_out == ()


def test_few_rows_only() -> None:
    """A twentieth of an instrument's rows, or one."""
    data = observed(sky(), 4)
    total = len(np.unique(np.column_stack([data.vis2.setup, data.vis2.row]), axis=0))
    rows = [
        OutlyingRow("vis2", int(s), int(r), "", (), 0.0, "closure phase", 9.0)
        for s, r in zip(data.vis2.setup, data.vis2.row, strict=True)
    ]
    rows = list(dict.fromkeys(rows))
    most = max(1, int(0.05 * total))
    assert may_be_left_out(data, rows[:most])
    assert not may_be_left_out(data, rows[: most + 1])
