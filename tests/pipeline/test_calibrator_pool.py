"""Calibrators out of a pool: the nearest, by brute force, and named in the survey."""

from __future__ import annotations

import json
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from commands import run
from drifting_visits import Drift, visits
from helpers import error_of

from amibayes.errors import DataError
from amibayes.oifits import write_oifits
from amibayes.pipeline.calibrator_pool import PoolStar, nearest, star_of, subtype_of


def test_the_nearest_are_those_of_the_smallest_sum() -> None:
    rng = np.random.default_rng(1)
    pool = [
        PoolStar((f"c{k}",), *rng.normal([60000.0, 6.0, 40.0], [3.0, 1.0, 10.0])) for k in range(9)
    ]
    target = PoolStar(("t",), 60000.0, 6.0, 40.0)
    chosen = {c.star.files for c in nearest(pool, target, 3)}

    def total(stars: tuple[PoolStar, ...]) -> float:
        return sum(
            np.sqrt(
                (s.mjd - 60000.0) ** 2
                + ((s.magnitude - 6.0) / 0.75) ** 2
                + ((s.subtype - 40) / 10) ** 2
            )
            for s in stars
        )

    best = min(combinations(pool, 3), key=total)
    assert chosen == {s.files for s in best}


def test_what_is_not_known_counts_nothing_and_other_setups_never(tmp_path: Path) -> None:
    far = PoolStar(("far",), 60010.0, None, None, "NIRISS 4.82 µm")
    near = PoolStar(("near",), 60001.0, 3.0, None, "NIRISS 4.82 µm")
    other = PoolStar(("other",), 60000.0, 6.0, 40.0, "NIRISS 3.83 µm")
    target = PoolStar(("t",), 60000.0, None, 40.0, "NIRISS 4.82 µm")
    found = nearest([far, near, other, target], target, 4)
    assert [c.star.files for c in found] == [("near",), ("far",)]
    assert found[0].words() == "near (1 d)"
    with pytest.raises(DataError, match="no calibrator of"):
        nearest([other], target, 4)


def test_spectral_types_have_one_scale() -> None:
    assert [subtype_of(t) for t in ("A0", "K3.5III", " G2V", "M", "xyz")] == [
        20,
        53.5,
        42,
        65,
        None,
    ]


def test_dates_and_setups_are_read_from_files(tmp_path: Path) -> None:
    (data,) = visits(Drift(), [60005.0], np.random.default_rng(1))
    write_oifits(tmp_path / "a.oifits", data)
    star = star_of([str(tmp_path / "a.oifits")], {})
    assert star.mjd == pytest.approx(60005.0, abs=1.0)
    assert star.setup is not None
    assert star.setup.endswith("4.82 µm")
    header = fits.Header({"EXPMID": 60001.5, "INSTRUME": "NIRISS", "FILTER": "F480M"})
    fits.PrimaryHDU(header=header).writeto(tmp_path / "cube.fits")
    cube = star_of([str(tmp_path / "cube.fits")], {"magnitude": 5, "spectral_type": "K0"})
    assert cube == PoolStar((str(tmp_path / "cube.fits"),), 60001.5, 5.0, 50.0, "NIRISS F480M")
    assert star_of([str(tmp_path / "gone")], {}).setup is None


@pytest.mark.slow
def test_a_survey_names_the_calibrators_that_it_chose(tmp_path: Path, capsys) -> None:
    mjd = [60000.0, 60010.0, *(60000.0 + np.arange(0.0, 12.0, 2.0) + 0.5)]
    for k, data in enumerate(visits(Drift(), mjd, np.random.default_rng(2))):
        write_oifits(tmp_path / f"{'t' if k < 2 else 'c'}{k}.oifits", data)
    Table({"target": ["t0.oifits", "t1.oifits"]}).write(tmp_path / "targets.ecsv")
    Table({"target": [f"c{k}.oifits" for k in range(2, 8)]}).write(tmp_path / "pool.ecsv")
    words = ("--cal-pool", tmp_path / "pool.ecsv", "--cal-number", 2, "--null-draws", 0)
    words += ("--no-posterior", "--no-limits", "--no-pictures", "--separation", "80:200", "--quiet")
    out = tmp_path / "out"
    assert run("search", "--batch", tmp_path / "targets.ecsv", *words, "--out", out) == 0
    first, second = json.loads((out / "survey.json").read_text())["targets"]
    assert first["calibrators"] == ["c2.oifits", "c3.oifits"]
    assert second["calibrators"] == ["c7.oifits", "c6.oifits"]
    assert first["chosen_calibrators"].startswith("c2.oifits (0.5 d)")
    capsys.readouterr()
    assert run("search", tmp_path / "t0.oifits", *words[:2], "--out", tmp_path / "x") == 2
    assert "needs a table of targets" in error_of(capsys)
