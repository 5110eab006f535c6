"""What ``import amibayes`` gives, how fast, and that it stays that way."""

from __future__ import annotations

import subprocess
import sys

import pytest

import amibayes


@pytest.mark.parametrize("name", amibayes.__all__)
def test_public_names_exist_and_are_documented(name: str) -> None:
    thing = getattr(amibayes, name)
    assert name == "__version__" or thing.__doc__
    assert name == "__version__" or name in dir(amibayes)


def test_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="companions"):
        _ = amibayes.companions


@pytest.mark.parametrize("module", ["amibayes", "amibayes.cli"])
def test_import_loads_nothing_heavy(module: str) -> None:
    code = f"import sys, {module}; print(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    names = set(loaded.stdout.split())
    assert not names & {"numpy", "scipy", "astropy", "matplotlib", "emcee", "nlopt", "h5py"}
