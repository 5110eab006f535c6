"""Coefficients that a file states are those that were written."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.extraction.charge import CubeMigration
from amibayes.ramps.converter import WAVES
from amibayes.ramps.header import KEY, migration_cards, migration_of
from amibayes.ramps.migration import Migration

KINDS = ("x", "y", "linearity", *WAVES)


def fitted() -> Migration:
    rng = np.random.default_rng(5)
    root = 1e-8 * rng.standard_normal((len(KINDS), len(KINDS)))
    root[3:] *= 1e3
    value = np.array([3.4567890123e-7, -2.2e-7, 1e-9, *1e-5 * rng.standard_normal(6)])
    return Migration(KINDS, value, root @ root.T, "fit")


def written(path: Path, charge: CubeMigration) -> fits.Header:
    primary = fits.PrimaryHDU()
    for key, card in charge.in_header.items():
        primary.header[key] = card
    primary.writeto(path)
    return fits.getheader(path)


def test_the_whole_covariance_comes_back(tmp_path: Path) -> None:
    migration = fitted()
    header = written(tmp_path / "a.fits", CubeMigration(migration, p_values=(0.25, 1e-5)))
    found = CubeMigration.of_header(header)
    assert found is not None
    assert found.migration is not None
    assert found.migration.kinds == KINDS
    assert found.migration.source == "fit"
    np.testing.assert_allclose(found.migration.value, migration.value, rtol=1e-12)
    np.testing.assert_allclose(found.migration.covariance, migration.covariance, rtol=1e-11)
    # Data that were extracted apart know the errors that they share by these.
    assert list(found.migration.steps) == list(migration.steps)
    np.testing.assert_allclose(
        list(found.migration.steps.values()), list(migration.steps.values()), rtol=1e-4, atol=1e-14
    )
    content = found.as_json()
    assert content["value_per_e"] == pytest.approx(migration.mean[0], rel=1e-12)
    assert content["error_per_e"] == pytest.approx(migration.mean[1], rel=1e-9)
    assert (content["p_value"], content["p_value_bend"]) == (0.25, 1e-5)
    assert content["explained"] is False
    assert header[f"{KEY} VALUE"] == pytest.approx(migration.mean[0])


def test_what_was_off_is_off_and_what_is_not_stated_is_unknown(tmp_path: Path) -> None:
    off = CubeMigration.of_header(written(tmp_path / "off.fits", CubeMigration()))
    assert off is not None
    assert off.as_json()["source"] == "off"
    assert CubeMigration.of_header({}) is None


@pytest.mark.parametrize("key", ["SOURCE", "KIND1", "VALUE2", "COVARIANCE1 2"])
@pytest.mark.parametrize("value", [None, "nonsense", float("nan")])
def test_headers_that_make_no_sense_state_nothing(key: str, value: object) -> None:
    cards = migration_cards(Migration.isotropic(3.6e-7, 1.2e-7, "instrument"))
    header: dict[str, object] = {k.removeprefix("HIERARCH "): v for k, v in cards.items()}
    assert migration_of(header) is not None
    header[f"{KEY} {key}"] = value
    assert migration_of(header) is None


def test_steps_have_the_error_of_the_mean_in_them() -> None:
    migration = fitted()
    steps = np.array(list(migration.steps.values()))
    assert np.sqrt((steps**2).sum()) == pytest.approx(migration.mean[1], rel=1e-6)
    (step,) = Migration.isotropic(3.6e-7, 1.2e-7, "instrument").steps.values()
    assert step == pytest.approx(1.2e-7)
