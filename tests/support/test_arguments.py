"""Absurd arguments of the Python interface end in one line that names them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
import pytest
from helpers import niriss, simulated
from numpy.typing import ArrayLike, NDArray

import amibayes as ab
from amibayes.errors import UsageError
from amibayes.support.annotations import fits, wanted
from amibayes.support.arguments import checks_arguments

NAN = float("nan")


class Speaker(Protocol):
    name: str

    def speak(self) -> str: ...


class Dog:
    name = "Rex"

    def speak(self) -> str:
        return "woof"


@pytest.mark.parametrize(
    ("hint", "good", "bad", "words"),
    [
        (float, [1, 2.5, np.float32(1), np.array(3.0)], ["1", None, True, [1.0]], "a number"),
        (int, [3, np.int64(3)], [3.0, True, "3"], "a whole number"),
        (bool, [True, np.True_], [1, "yes", None], "True or False"),
        (float | None, [1.0, None], ["x"], "a number"),
        (Literal["a", "b"], ["a"], ["c", None, ["a"]], "'a' or 'b'"),
        (float | Literal["free"], [0.3, "free"], ["fre"], "a number or 'free'"),
        (str | Path, ["a", Path("a")], [3, None], "a path"),
        (tuple[float, float], [(1, 2), [1.0, 2.0]], [(1,), 1.0, "12"], "a list of 2 numbers"),
        (tuple[int, ...], [(), (1, 2)], [(1.5,), 3], "a list of whole numbers"),
        (Sequence[Dog], [[Dog()], ()], [Dog(), [3]], "a list of Dog"),
        (Sequence[float | tuple[float, float]], [[1.0, (2, 3)]], [["a"], 1.0], None),
        (Mapping[str, int], [{}], [[]], "a Mapping"),
        (Callable[[], int], [len], [3], "a Callable"),
        (NDArray[np.float64], [np.ones(3), 3.0], ["x", [[1], [2, 3]]], "an array of numbers"),
        (ArrayLike, [np.ones(3), [1, 2]], ["x"], "an array of numbers"),
        (Speaker, [Dog()], ["woof", 3], "a Speaker"),
        (Any, [3, None], [], None),
        (object, [3, None], [], None),
    ],
)  # fmt: skip
def test_annotations_tell_good_from_bad(hint, good, bad, words) -> None:
    assert all(fits(value, hint) for value in good)
    assert not any(fits(value, hint) for value in bad)
    assert words is None or wanted(hint) == words


@checks_arguments
def measured(separation_mas: float, n: int = 3, *others: str, error: float = NAN, **more: Any):
    return separation_mas, n, others, error, more


def test_what_is_asked_for_comes_through() -> None:
    got = measured(1.5, 4, "a", error=2.0, colour="red")
    assert got == (1.5, 4, ("a",), 2.0, {"colour": "red"})


@pytest.mark.parametrize(
    ("arguments", "settings", "line"),
    [
        (("far",), {}, "measured: separation_mas is 'far', not a number"),
        ((NAN,), {}, r"measured: separation_mas is NaN \(give a number\)"),
        ((1.0, 2.5), {}, "measured: n is 2.5, not a whole number"),
        ((), {}, "measured: missing a required argument: 'separation_mas'"),
    ],
)
def test_one_line_names_function_argument_and_fault(arguments, settings, line) -> None:
    with pytest.raises(UsageError, match=line) as caught:
        measured(*arguments, **settings)
    assert "\n" not in str(caught.value)


def test_nan_is_a_value_where_it_is_the_default() -> None:
    assert np.isnan(measured(1.0, error=NAN)[3])


RNG = np.random.default_rng(1)
DATA = simulated(niriss(), [90.0, 0.0, 0.03], RNG)
LIKELIHOOD = ab.Likelihood(DATA)


@pytest.fixture(scope="module")
def found() -> ab.SearchResult:
    return ab.search(LIKELIHOOD, (60.0, 150.0))


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda r: ab.Likelihood(LIKELIHOOD), "observables is a Likelihood, not an Observables"),
        (lambda r: ab.Likelihood("a.oifits"), r"make one: amibayes.read_oifits\(path\)"),
        (lambda r: ab.Likelihood(DATA, "binary"), "model is 'binary', not a BinaryModel"),
        (lambda r: LIKELIHOOD.chi2([1.0, 2.0]), "theta has 2 columns, not 3"),
        (lambda r: ab.search(DATA), r"make one: amibayes.Likelihood\(observables\)"),
        (lambda r: ab.search(LIKELIHOOD, (NAN, 400)), "separation_mas is NaN"),
        (lambda r: ab.search(LIKELIHOOD, (-5, 400)), "separation_mas is -5 to 400"),
        (lambda r: ab.search(LIKELIHOOD, (400, 94)), "separation_mas is 400 to 94"),
        (lambda r: ab.search(LIKELIHOOD, (94, np.inf)), "separation_mas is 94 to inf"),
        (lambda r: ab.search(LIKELIHOOD, 94.0), "not a list of 2 numbers"),
        (lambda r: ab.search(LIKELIHOOD, (200.0, 200.1)), "^separation_mas: no position between"),
        (lambda r: ab.join([DATA, DATA]), "holds the data of"),
        (lambda r: ab.join([]), "no data set to join"),
        (lambda r: ab.join(DATA), r"put it into a list: \[parts\]"),
        (lambda r: ab.BinaryModel(diameter_mas=-1.0), r"diameter_mas is -1 \(at least 0\)"),
        (lambda r: ab.BinaryModel(diameter_mas="fre"), "diameter_mas is 'fre', not a number or"),
        (lambda r: ab.BinaryModel(-1), "companions is -1"),
        (lambda r: ab.BinaryModel(diametre=1), "no argument diametre .did you mean diameter_mas"),
        (lambda r: ab.BinaryModel(contrast_slope=np.inf), "contrast_slope is inf"),
        (lambda r: ab.Companion(NAN, 1.0, 0.1), "Companion: east_mas is NaN"),
        (lambda r: ab.Prior(400.0, 94.0), "range of the separation, 400 to 94"),
        (lambda r: ab.Cube(np.ones((2, 8, 8)), 65.0, "NIRISS", "F480M"), "pixel_scale_rad is 65"),
        (lambda r: ab.Cube(np.ones((2, 8, 8)), NAN, "NIRISS", "F480M"), "pixel_scale_rad is NaN"),
        (lambda r: ab.Cube("x", 3e-7, "NIRISS", "F480M"), "images is 'x', not an array of numbers"),
        (lambda r: ab.calibrate(DATA, DATA), r"put it into a list: \[calibrators\]"),
        (lambda r: ab.calibrate(DATA, [DATA], method="best"), "not 'hierarchical' or 'weighted'"),
        (lambda r: ab.significance(r, 100, RNG), "amibayes.statistic_of"),
        (lambda r: ab.significance(ab.statistic_of(r), 0, RNG), "n_draws is 0"),
        (lambda r: ab.significance(ab.statistic_of(r), 9, 1), "numpy.random.default_rng.seed"),
        (lambda r: ab.analytic_limit(r, "absill"), "method is 'absill'"),
        (lambda r: ab.analytic_limit(r, "absil", sigmas=-1.0), "sigmas is -1"),
        (lambda r: ab.analytic_limit(r, "absil", separation_mas=[-3.0]), "separation_mas is -3"),
        (lambda r: ab.analytic_limit(r, "absil", n_separations=0), "n_separations is 0"),
        (lambda r: ab.sample(r, None, RNG), "prior is None, not a Prior"),
        (lambda r: ab.grid_posterior(r, ab.Prior(60.0, 150.0)), "its likelihood is result.likelih"),
        (lambda r: r.nuisance("diametr"), "choose from .*diameter_mas"),
        (lambda r: DATA.to_table("t3"), "choose from vis2, closure_phase"),
        (lambda r: ab.SearchOptions(null_draws=-3), "null_draws is -3"),
        (lambda r: ab.SearchOptions(observables=("v2",)), "observables has 'v2' .choose from vis2"),
        (lambda r: ab.SearchOptions(companions=(3,)), "companions has 3"),
        (lambda r: ab.SearchOptions(evidence_method="mcmc"), "evidence_method has 'mcmc'"),
        (lambda r: ab.SearchOptions(separation_mas=(9.0, 3.0)), "separation_mas is 9 to 3"),
        (lambda r: ab.SearchOptions(diameter_mas=1.0), "no argument diameter_mas .did you"),
        (lambda r: ab.search_companion([DATA]), "targets is 1 value.s. of the type Observables"),
        (lambda r: ab.recover(ab.statistic_of(r), np.full((2, 3), NAN), 9.0, RNG), "finite"),
        (lambda r: ab.recover(ab.statistic_of(r), np.ones((2, 2)), 9.0, RNG), "3 columns"),
        (lambda r: ab.read_oifits(None), "path is None, not a path"),
    ],
)  # fmt: skip
def test_the_public_interface_refuses_the_unusable(call, line: str, found) -> None:
    with pytest.raises(UsageError, match=line) as caught:
        call(found)
    assert "--" not in str(caught.value)


def test_an_option_is_an_argument_in_python() -> None:
    error = UsageError(
        "narrow it", source="--separation", remedy="give --pixel-scale, --target NAME"
    )
    assert str(error) == "separation_mas: narrow it (give pixel_scale_rad, target=NAME)"
    assert error.command_line.startswith("--separation: narrow it (give --pixel-scale")
