"""Containers in an interpreter: a few lines, no arrays, the numbers that matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from helpers import niriss, simulated

import amibayes as ab
from amibayes.support.notebook import Shown

RNG = np.random.default_rng(1)
DATA = simulated(niriss(), [90.0, 0.0, 0.03], RNG)
FOUND = ab.search(ab.Likelihood(DATA), (60.0, 150.0))
CALIBRATOR = simulated(niriss(), [90.0, 0.0, 0.0], RNG)
INSTRUMENT = ab.load_instrument("niriss", "F430M")
IMAGES = np.ones((2, 80, 80))


@dataclass(frozen=True, repr=False)
class Thing(Shown):
    name: str
    values: object
    hidden: object = None


def test_arrays_are_shapes_and_text_is_cut() -> None:
    text = repr(Thing("x" * 200, (np.ones(4), np.ones(2))))
    assert text.splitlines()[0] == "Thing"
    assert "2 of ndarray" in text
    assert "hidden" not in text
    assert max(map(len, text.splitlines())) < 120
    assert "float64 array (3, 4)" in repr(Thing("a", np.ones((3, 4))))
    assert "&lt;b&gt;" in Thing("<b>", 1)._repr_html_()


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: ab.Cube(IMAGES, 3.17e-7, "NIRISS", "F430M"),
         ["2 of 80 × 80 pixels of 65.39 mas", "NIRISS F430M", "electron/s"]),
        (lambda: FOUND.likelihood,
         ["21 V², 35 closure phases, 36 independent", "east_mas, north_mas, contrast"]),
        (lambda: ab.calibrate(DATA, [CALIBRATOR]), ["weighted", "56 values used", "Observables"]),
        (lambda: ab.significance(ab.statistic_of(FOUND), 99, RNG),
         ["0.01 (95 %: 0 to 0.0366)", "99, 0 of them as large", "cannot be told"]),
        (lambda: ab.analytic_limit(FOUND, "absil", n_separations=3), ["105 mas", "mag", "scale"]),
        (lambda: FOUND.modes[0], ["90.", "PA 90.", "contrast 0.03", "Δχ²"]),
        (lambda: FOUND, ["SearchResult", "modes"]),
        (lambda: INSTRUMENT, ["NIRISS", "Bandpass F430M"]),
        (lambda: ab.PupilMap(np.zeros((64, 64)), 6.6), ["float64 array (64, 64)"]),
        (lambda: ab.Wavefront(), ["Wavefront"]),
    ],
)  # fmt: skip
def test_public_containers_show_a_few_lines(make, words: list[str]) -> None:
    thing = make()
    text = repr(thing)
    assert len(text.splitlines()) <= 12
    assert max(map(len, text.splitlines())) <= 160
    assert "array([" not in text
    for word in words:
        assert word in text


@pytest.mark.parametrize("name", ["Cube", "Likelihood", "Calibration", "SearchResult", "Companion",
    "Significance", "AnalyticLimit", "DetectionLimit", "Posterior", "GridPosterior", "Evidence",
    "Observables", "SearchReport", "LimitsReport"])  # fmt: skip
def test_what_a_notebook_shows_is_html(name: str) -> None:
    assert hasattr(getattr(ab, name), "_repr_html_")


def test_a_mode_has_the_names_of_the_json() -> None:
    mode, best = FOUND.modes[0], FOUND.companion
    for name in ("separation_mas", "position_angle_deg", "contrast", "delta_mag"):
        assert getattr(mode, name) == pytest.approx(getattr(best, name))
