"""ln L between a few points is that of functions written down here, and costs few of them."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.posterior.contrast_profile import DEEP, profile

CENTRES = np.array([[0.2, 0.3, 0.7], [0.5, 0.5, 0.9], [-0.4, 0.1, 0.4], [0.02, 0.03, 0.05]])
"""Best contrasts of four cells and three nodes, within or below the range."""

FUNCTIONS = {
    "parabola": lambda x: -0.5 * x**2,
    "heavy tails": lambda x: -18.0 * np.log1p(x**2 / 36.0),
    "stated errors or more noise": lambda x: np.logaddexp(-0.5 * (2 * x) ** 2, -2 - 0.1 * x**2),
    "edge": lambda x: -np.abs(x),
}


def _both(name: str, sigma: float):
    sets = 0

    def at(rows, contrast):
        nonlocal sets
        sets += contrast.size
        return FUNCTIONS[name]((contrast - CENTRES.ravel()[rows, None]) / sigma)

    low, high = np.zeros(len(CENTRES)), np.ones(len(CENTRES))
    boxes = np.tile(np.linspace(0.0, 1.0, 131)[1::2], (len(CENTRES), 1))
    found = profile(at, low, high, boxes, CENTRES.shape[1])
    truth = FUNCTIONS[name]((boxes[:, None, :] - CENTRES[:, :, None]) / sigma)
    return found, truth, sets / CENTRES.size


@pytest.mark.parametrize("sigma", [0.05, 0.1, 1.0])
@pytest.mark.parametrize("name", ["parabola", "heavy tails"])
def test_masses_are_those_of_the_function(name: str, sigma: float) -> None:
    found, truth, _ = _both(name, sigma)
    top = truth.max(axis=(1, 2), keepdims=True)
    weight = np.exp(truth - top)
    error = (np.exp(found - top) - weight).sum(axis=(1, 2)) / weight.sum(axis=(1, 2))
    assert abs(error).max() < 0.01
    assert (abs(found - truth) * weight).max() < 0.01
    # Nothing is invented where there is nothing.
    assert (found - top)[truth - top < -2.0 * DEEP].max(initial=-np.inf) < -DEEP + 3.0


@pytest.mark.parametrize("sigma", [0.1, 1.0])
@pytest.mark.parametrize("name", ["stated errors or more noise", "edge"])
def test_what_is_no_polynomial_is_formed_more_often(name: str, sigma: float) -> None:
    found, truth, sets = _both(name, sigma)
    weight = np.exp(truth - truth.max(axis=(1, 2), keepdims=True))
    assert (abs(found - truth) * weight).max() < 0.06
    assert sets > 13 or name != "edge"


def test_parabolas_are_exact_and_cheap() -> None:
    found, truth, sets = _both("parabola", 0.1)
    assert abs(found - truth).max() < 1e-9 * abs(truth).max()
    assert sets <= 9
