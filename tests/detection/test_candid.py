"""CANDID's nσ against closed forms and independent libraries, near and far."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp
from scipy.stats import chi2, norm

from amibayes.likelihood.chi2 import candid_n_sigma, log_chi2_survival


def closed_form(x: np.ndarray, dof: int) -> np.ndarray:
    """For even degrees of freedom P(χ² > x) = e^(−x/2) Σ (x/2)^k / k!, k < dof/2."""
    k = np.arange(dof // 2)
    return logsumexp(k * np.log(0.5 * x[:, None]) - gammaln(k + 1), axis=1) - 0.5 * x


@pytest.mark.parametrize("dof", [2, 34, 1346])
def test_survival_is_the_closed_form_from_the_body_to_far_beyond_underflow(dof: int) -> None:
    x = dof * np.array([0.5, 1.0, 1.5, 3.0, 10.0, 1e3, 1e5])
    np.testing.assert_allclose(
        log_chi2_survival(x, dof), closed_form(x, dof), rtol=1e-10, atol=1e-12
    )


def test_n_sigma_of_a_map_is_that_of_each_position() -> None:
    binary = np.array([[33.0, 30.0], [20.0, 1.0]])
    together = candid_n_sigma(34.0, binary, 32)
    assert together.shape == binary.shape
    expected = norm.isf(0.5 * chi2.sf(32 * 34.0 / binary[:, 0], 32))
    np.testing.assert_allclose(together[:, 0], expected, rtol=1e-10)
    assert together[1, 1] == float(candid_n_sigma(34.0, 1.0, 32))


def test_three_sigma_is_the_published_delta_chi2() -> None:
    # 3σ at a reduced χ² of 1 is Δχ² = 26.7 with 32 degrees of freedom, 27.4 with 34.
    for dof, delta in [(32, 26.7), (34, 27.4)]:
        assert candid_n_sigma(dof + delta, dof, dof) == pytest.approx(3.0, abs=0.01)
