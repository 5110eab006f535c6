"""How much scatter rotations of integrations need, to tell noise from a companion."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_array

from amibayes.data.degrees_of_freedom import Freedom
from amibayes.likelihood.rotation_null import LEAST_SCATTER, RotationNull, rotation_null

N = 36


def noise(scatter: int) -> SimpleNamespace:
    """Unit noise, by the scatter of a few integrations in directions of their own."""
    found = np.zeros((N, N))
    found[:scatter, :scatter] = np.eye(scatter)
    return SimpleNamespace(
        freedom=Freedom(200.0, float(scatter)),
        scatter=csr_array(found),
        covariance=SimpleNamespace(whitening=csr_array(np.eye(N))),
    )


def test_too_little_scatter_is_none_that_can_be_rotated() -> None:
    residual = np.full(N, 10.0)
    few, enough = (rotation_null(noise(k), residual) for k in (2, int(LEAST_SCATTER)))  # type: ignore[arg-type]
    assert few is None
    assert enough is not None
    assert enough.rows == LEAST_SCATTER + 1.0


@pytest.mark.parametrize(("scatter", "lowest", "highest"), [(2, 3e-3, 9e-3), (4, 0.0, 3e-4)])
def test_few_rotations_are_the_residuals_themselves(scatter, lowest, highest) -> None:
    """Within 6 degrees, whatever their size: noise is then never less likely than that."""
    rng, residual = np.random.default_rng(4), np.zeros(N)
    residual[-1] = 60.0
    factor = 60.0 * np.eye(N)[:, :scatter]
    drawn = RotationNull(200.0, scatter + 1.0, factor, residual).draw(
        rng.standard_normal((N, 40000)), rng
    )
    along = drawn[-1] ** 2 / (drawn**2).sum(axis=0)
    assert lowest < np.mean(along > np.cos(np.radians(6.0)) ** 2) < highest


def test_no_mean_takes_more_from_the_estimate_than_is_in_it() -> None:
    """Target and calibrators scatter in 12 directions with 5 degrees of freedom, a quarter of the
    estimate in their directions."""
    rng, scatter, residual = np.random.default_rng(5), np.zeros((N, N)), np.zeros(N)
    scatter[:12, :12], residual[-1] = 3.5 * np.eye(12), 60.0
    null = rotation_null(
        SimpleNamespace(  # type: ignore[arg-type]
            freedom=Freedom(22.0, 5.0),
            scatter=csr_array(scatter),
            covariance=SimpleNamespace(whitening=csr_array(np.eye(N))),
        ),
        residual,
    )
    assert null is not None
    drawn = null.draw(rng.standard_normal((N, 4000)), rng)
    total = (null.degrees - 2.0) * np.eye(N) + np.outer(residual, residual)
    assert (drawn * np.linalg.solve(total, drawn)).sum(axis=0).max() < 1.0
