"""Integrations that are outliers: found at their rate, whatever the unit and the true scatter."""

from __future__ import annotations

import numpy as np
import pytest

from amibayes.data.outliers import outlying


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("scatter", [1.0, 3.0])
def test_outliers_are_found_in_any_unit(unit: float, scatter: float) -> None:
    """Noise of 200 integrations; two of them 12 standard deviations off in one observable.

    The scatter is that of the integrations, also where the expected one is too small.
    """
    rng = np.random.default_rng(7)
    deviation = scatter * rng.standard_normal((200, 30))
    deviation[[17, 90], [3, 21]] += 12.0 * scatter
    found = outlying(unit * deviation, np.full(30, unit), 3.5)
    assert np.flatnonzero(found).tolist() == [17, 90]


def test_few_integrations_have_no_outliers() -> None:
    deviation = np.array([[0.0], [0.1], [-0.1], [1e6]])
    assert not outlying(deviation, np.ones(1), 3.0).any()


def test_a_chance_agreement_of_few_integrations_makes_no_outliers() -> None:
    """Five values of which four nearly agree in one of many observables."""
    rng = np.random.default_rng(8)
    deviation = rng.standard_normal((5, 30))
    deviation[:, 0] = [0.0, 1e-9, -1e-9, 2e-9, 1.0]
    assert not outlying(deviation, np.ones(30), 3.0).any()
