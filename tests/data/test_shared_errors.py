"""Errors that data sets share: against the covariance of draws in which they are shared."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss

from amibayes.calibration import calibrate
from amibayes.data.observables import Observables, join
from amibayes.data.shared_errors import SharedErrors
from amibayes.errors import UsageError
from amibayes.oifits import read_oifits, write_oifits
from amibayes.units import FloatArray


def plain() -> Observables:
    """A point source behind NIRISS's mask."""
    return niriss()


def sharing(seed: int, size: float = 3.0) -> Observables:
    """The same with two errors that other data have in common with it."""
    found = plain()
    rng = np.random.default_rng(seed)
    sigma = np.sqrt(found.covariance.variance)
    changes = size * sigma[:, None] * rng.standard_normal((len(sigma), 2))
    # Closure phases can only change as baselines' phases do.
    changes = found.covariance.dense() @ found.covariance.solve(changes)
    return found.with_shared_errors(SharedErrors(("one", "other"), changes))


def test_they_are_put_in_and_taken_out() -> None:
    found, bare = sharing(1), plain()
    assert found.shared is not None
    more = found.shared.changes @ found.shared.changes.T
    np.testing.assert_allclose(found.covariance.dense(), bare.covariance.dense() + more)
    again = found.without_shared_errors()
    assert again.shared is None
    scale = bare.covariance.variance.max()
    np.testing.assert_allclose(again.covariance.dense(), bare.covariance.dense(), atol=1e-9 * scale)
    assert found.n_independent == bare.n_independent


def test_more_of_them_stand_beside_those_before() -> None:
    """Both are in the covariance and known by name, and both can be taken out again."""
    before, bare = sharing(1), plain()
    assert before.shared is not None
    more = SharedErrors(("third",), before.shared.changes[:, :1] * 0.3)
    found = before.with_shared_errors(more)
    assert found.shared is not None
    assert found.shared.names == ("one", "other", "third")
    changes = found.shared.changes
    np.testing.assert_allclose(
        found.covariance.dense(), bare.covariance.dense() + changes @ changes.T
    )
    scale = bare.covariance.variance.max()
    again = found.without_shared_errors().covariance.dense()
    np.testing.assert_allclose(again, bare.covariance.dense(), atol=1e-9 * scale)
    with pytest.raises(UsageError, match="'other' already"):
        before.with_shared_errors(SharedErrors(("other",), more.changes))


def test_data_laid_together_are_correlated_by_them() -> None:
    a, b = sharing(1), sharing(2)
    whole = join([a, b, plain()])
    assert a.shared is not None
    assert b.shared is not None
    n, m = a.n_vis2, a.n_closure_phases
    dense = whole.covariance.dense()
    between = a.shared.changes @ b.shared.changes.T
    np.testing.assert_allclose(dense[:n, n : 2 * n], between[:n, :n])
    np.testing.assert_allclose(dense[:n, 3 * n + m : 3 * n + 2 * m], between[:n, n:], atol=1e-15)
    assert not np.any(dense[: 2 * n, 2 * n : 3 * n])
    kept = whole.only(("cp",))
    assert kept.shared is not None
    assert kept.shared.changes.shape == (3 * m, 2)


@pytest.mark.parametrize(
    "method", ["weighted", pytest.param("hierarchical", marks=pytest.mark.slow)]
)
def test_a_calibrator_that_shares_all_takes_them_away(method: str) -> None:
    """The same errors in target and calibrators leave the calibrated V² and phases alone."""
    target, calibrators = sharing(1), [_moved(sharing(1), k) for k in range(3)]
    bare = calibrate(plain(), [_moved(plain(), k) for k in range(3)], method=method)  # type: ignore[arg-type]
    found = calibrate(target, calibrators, method=method).observables  # type: ignore[arg-type]
    assert found.shared is not None
    sigma = np.sqrt(bare.observables.covariance.variance)
    assert np.abs(found.shared.changes / sigma[:, None]).max() < 0.05
    np.testing.assert_allclose(found.covariance.variance, sigma**2, rtol=0.02)


def test_calibrated_covariance_is_that_of_draws() -> None:
    """Target with half the calibrators' changes: V² ratios and phase differences by draws."""
    target = sharing(1)
    assert target.shared is not None
    shared = target.shared
    half = SharedErrors(shared.names, 0.5 * shared.changes)
    calibrators = [
        _moved(plain().with_shared_errors(replace(half, changes=half.changes)), k) for k in range(2)
    ]
    found = calibrate(target, calibrators, method="weighted", clip=None).observables
    bare = calibrate(
        plain(), [_moved(plain(), k) for k in range(2)], method="weighted", clip=None
    ).observables
    expected = bare.covariance.dense() + 0.25 * shared.changes @ shared.changes.T
    np.testing.assert_allclose(np.diag(found.covariance.dense()), np.diag(expected), rtol=0.05)


def test_files_keep_them(tmp_path: Path) -> None:
    found = replace(sharing(3), covariance_kind="given")
    found = found.with_data(found.data + 1e-4)  # phases of 0 count as none
    write_oifits(tmp_path / "a.oifits", found)
    again = read_oifits(tmp_path / "a.oifits")
    assert found.shared is not None
    assert again.shared is not None
    assert again.shared.names == found.shared.names
    np.testing.assert_allclose(again.shared.changes, found.shared.changes, rtol=1e-9, atol=1e-15)
    own, expected = (o.without_shared_errors().covariance.dense() for o in (again, found))
    np.testing.assert_allclose(own, expected, atol=1e-7 * np.abs(expected).max())
    assert not [note for note in again.notes if "not used" in note]


def _moved(observables: Observables, seed: int) -> Observables:
    """The same with a little noise: calibrators may not hold the data of others."""
    rng = np.random.default_rng(100 + seed)
    noise = 1e-3 * observables.covariance.draw(rng, 1)[:, 0]
    return _with_noise(observables, noise)


def _with_noise(observables: Observables, noise: FloatArray) -> Observables:
    n = observables.n_vis2
    vis2, closure = observables.vis2, observables.closure_phase
    return replace(
        observables,
        vis2=replace(vis2, value=vis2.value + noise[:n]),
        closure_phase=replace(closure, value=closure.value + noise[n:]),
    )
