"""Shapes of distributions around fits, of covariances that rounding has spoilt."""

from __future__ import annotations

import numpy as np

from amibayes.comparison.mixture import _cholesky


def test_a_covariance_that_is_indefinite_by_rounding_has_a_root() -> None:
    """The inverse of a precision of 1e12, as of V² of thousands, may have a negative eigenvalue."""
    turn = np.linalg.qr(np.random.default_rng(3).standard_normal((5, 5)))[0]
    indefinite = turn @ np.diag([4.0, 2.0, 1.0, 0.5, -1e-6]) @ turn.T
    root = _cholesky(indefinite)
    np.testing.assert_allclose(root @ root.T, indefinite, atol=1e-5)
    known = turn @ np.diag([4.0, 2.0, 1.0, 0.5, 0.1]) @ turn.T
    np.testing.assert_allclose(_cholesky(known), np.linalg.cholesky(known), rtol=1e-6)
