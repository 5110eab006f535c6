"""The example files are what their script makes, and hold the companion they say they hold."""

from __future__ import annotations

import runpy
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.companion_search.search import search
from amibayes.likelihood.likelihood import Likelihood
from amibayes.oifits import read_oifits

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
NAMES = ("target", "cal1", "cal2", "cal3")


@pytest.fixture(scope="module")
def script() -> dict[str, object]:
    return runpy.run_path(str(EXAMPLES / "make_example_data.py"))


def test_the_committed_files_are_what_the_script_makes(
    script: dict[str, object], tmp_path: Path
) -> None:
    script["main"](tmp_path)
    for name in NAMES:
        made = (tmp_path / f"{name}.oifits").read_bytes()
        assert made == (EXAMPLES / "data" / f"{name}.oifits").read_bytes()


def test_reading_gives_what_was_simulated(script: dict[str, object]) -> None:
    for name, made in script["simulate"]().items():
        read = read_oifits(EXAMPLES / "data" / f"{name}.oifits")
        np.testing.assert_array_equal(read.data, made.data)
        np.testing.assert_allclose(read.covariance.dense(), made.covariance.dense(), rtol=1e-12)
        assert (read.covariance_kind, read.n_independent) == ("given", 36)


def test_calibrated_by_the_plain_mean_the_companion_is_that_of_the_header() -> None:
    data = {name: read_oifits(EXAMPLES / "data" / f"{name}.oifits") for name in NAMES}
    target, calibrators = data["target"], [data[name] for name in NAMES[1:]]
    gain = np.mean([c.vis2.value for c in calibrators], axis=0)
    offset = np.mean([c.closure_phase.value for c in calibrators], axis=0)
    calibrated = replace(
        target,
        vis2=replace(target.vis2, value=target.vis2.value / gain),
        closure_phase=replace(target.closure_phase, value=target.closure_phase.value - offset),
    )
    found = search(Likelihood(calibrated)).companion
    truth = fits.getheader(EXAMPLES / "data" / "target.oifits")
    # Noise and drift of one star and of the mean of three: 1.6 times the errors in the file.
    assert found.separation_mas == pytest.approx(
        truth["TRUTH SEPARATION_MAS"], abs=4 * 1.6 * found.separation_error_mas
    )
    assert found.position_angle_deg == pytest.approx(
        truth["TRUTH POSITION_ANGLE_DEG"], abs=4 * 1.6 * found.position_angle_error_deg
    )
    assert found.delta_mag == pytest.approx(
        truth["TRUTH DELTA_MAG"], abs=4 * 1.6 * found.delta_mag_error
    )


def test_without_calibration_nothing_fits() -> None:
    raw = search(Likelihood(read_oifits(EXAMPLES / "data" / "target.oifits")))
    assert raw.chi2_binary / raw.ndof > 100.0
    assert raw.companion.delta_mag < 4.0
