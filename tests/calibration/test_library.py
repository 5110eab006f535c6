"""Libraries of calibrators: kept, read, and drawn on by the commands."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import run
from drifting_visits import Drift, visits
from helpers import error_of

from amibayes.calibration.library import StarFacts, add_to_library, read_library
from amibayes.errors import DataError
from amibayes.oifits import write_oifits


def test_what_is_kept_is_read(tmp_path: Path) -> None:
    stars = visits(Drift(), [60003.0, 60001.0, 60002.0], np.random.default_rng(1))
    path = tmp_path / "f480m.h5"
    facts = [StarFacts("a", 60003.0, 2e4, "K0III", "opd.fits", 0.4, 0.02)]
    assert add_to_library(path, stars[:1], facts) == 1
    assert add_to_library(path, stars) == 2  # the first is there already
    found = read_library(path)
    assert [s.mjd for s in found.stars] == [60001.0, 60002.0, 60003.0]
    assert found.stars[2] == facts[0]
    assert found.diameters_mas[2] == (0.4, 0.02)
    assert np.isnan(found.stars[0].charge)
    for star, order in zip(found.observables, (1, 2, 0), strict=True):
        assert star.data == pytest.approx(stars[order].data, rel=1e-12)
    assert len(found.without(stars[:2]).stars) == 1
    assert read_library(path) is read_library(path)


def test_another_filter_and_what_is_no_library_are_refused(tmp_path: Path) -> None:
    (star,) = visits(Drift(), [60000.0], np.random.default_rng(1))
    path = tmp_path / "f480m.h5"
    add_to_library(path, [star])
    other = replace(star, setups=(replace(star.setups[0], wavelength_m=np.array([3.8e-6])),))
    with pytest.raises(DataError, match="one library for each instrument"):
        add_to_library(path, [other])
    assert len(read_library(path).stars) == 1
    (tmp_path / "junk.h5").write_text("nothing")
    for name in ("junk.h5", "gone.h5"):
        with pytest.raises(DataError, match=r"no library|cannot be read"):
            read_library(tmp_path / name)


@pytest.mark.slow
def test_commands_add_to_a_library_and_draw_on_it(tmp_path: Path, capsys) -> None:
    rng = np.random.default_rng(3)
    mjd = [*(60000.0 + 3.0 * np.arange(14)), 60020.0]
    stars = visits(Drift(), mjd, rng, {14: [90.0, 60.0, 0.02]})
    names = [tmp_path / f"star{k}.oifits" for k in range(15)]
    for name, star in zip(names, stars, strict=True):
        write_oifits(name, star)
    target, library = names[-1], tmp_path / "f480m.h5"
    words = ("--calibration", "hierarchical", "--quiet", "--out", tmp_path / "c")
    assert run("calibrate", target, "--cal", *names[:12], *words, "--add-to-library", library) == 0
    assert len(read_library(library).stars) == 12
    own = ("--cal", *names[11:14])  # one of which the library has
    words = ("--no-posterior", "--no-limits", "--null-draws", 200, "--quiet")
    words += ("--no-pictures", "--separation", "60:300", "--out", tmp_path / "s")
    assert run("search", target, *own, "--keep-all", "--library", library, *words) == 0
    found = json.loads((tmp_path / "s" / "result.json").read_text())
    assert found["calibration"]["method"] == "population"
    assert found["calibration"]["library"] == "f480m.h5"
    assert found["calibration"]["n_of_library"] == 11
    assert found["fit"]["separation_mas"] == pytest.approx(np.hypot(90.0, 60.0), abs=6.0)
    words = ("--library", library, "--quiet", "--out", tmp_path / "d")
    assert run("calibrate", target, *words) == 0
    assert run("calibrate", target, "--out", tmp_path / "e") == 2
    assert "no calibrator given" in error_of(capsys)


def test_what_is_wrong_with_a_library_is_told(tmp_path: Path, capsys) -> None:
    """One of its stars has a companion."""
    mjd = 60000.0 + 3.0 * np.arange(11)
    stars = visits(Drift(), mjd, np.random.default_rng(3), {5: [80.0, 100.0, 0.03]})
    write_oifits(tmp_path / "target.oifits", stars[-1])
    add_to_library(tmp_path / "f480m.h5", stars[:-1])
    words = ("--library", tmp_path / "f480m.h5", "--out", tmp_path / "d")
    assert run("calibrate", tmp_path / "target.oifits", *words) == 0
    told = [line for line in capsys.readouterr().out.splitlines() if "WARNING" in line]
    assert len(told) == 1
    assert "star5.oifits is not what the others predict" in told[0]
