"""What every test may use: the public data where they are, and seeded randomness."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from helpers import niriss, simulated
from hypothesis import settings
from matplotlib.figure import Figure
from PIL import Image
from threadpoolctl import threadpool_limits

from amibayes.oifits import write_oifits

# The same examples every time: a failure that nobody can repeat helps nobody.
settings.register_profile("repeatable", derandomize=True, deadline=None)
settings.load_profile("repeatable")

ROOT = Path(__file__).resolve().parent.parent


def pytest_configure() -> None:
    """Give each of several workers one thread for its matrices: more would only wait."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        threadpool_limits(1)
        for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
            os.environ.setdefault(name, "1")


ON_REQUEST = ("slow", "release")
"""Marks of tests that run where an expression of ``-m`` asks for them, and not else."""


def asked_for(mark: str, expression: str) -> bool:
    """Whether an expression of ``-m`` names a mark without denying it."""
    words = expression.replace("(", " ").replace(")", " ").split()
    return any(word == mark and (k == 0 or words[k - 1] != "not") for k, word in enumerate(words))


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out slow and release tests unless they are asked for, whatever else ``-m`` says."""
    off = {mark for mark in ON_REQUEST if not asked_for(mark, config.option.markexpr)}
    marks = [{mark.name for mark in item.iter_markers()} & set(ON_REQUEST) for item in items]
    # A test with both marks runs for either.
    dropped = [item for item, own in zip(items, marks, strict=True) if own and own <= off]
    if dropped:
        config.hook.pytest_deselected(items=dropped)
        items[:] = [item for item in items if item not in set(dropped)]


def _greet_arviz() -> None:
    """Let ArviZ, which corner imports, say what it says once a day, before any test does.

    It writes a file as it does so, which workers that start together take from each other.
    """
    for _ in range(5):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                importlib.import_module("arviz")
        except OSError:
            time.sleep(0.1)
            continue
        except ImportError:
            pass
        return


_greet_arviz()

# Scripts of the documentation share a module.
sys.path.append(str(ROOT / "docs"))


def data_folder() -> Path:
    return Path(os.environ.get("AMIBAYES_DATA", ROOT.parent / "shared" / "data"))


def script(name: str) -> ModuleType:
    """A script of the documentation, as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Dataclasses look their module up.
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of third-party files; a test that needs it skips where it is absent."""
    folder = data_folder()
    if not folder.is_dir():
        pytest.skip(f"public data not found at {folder} (set AMIBAYES_DATA)")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20201211)


TRUTH = (110.0, -75.0, 0.02)
"""East and north in mas, and contrast, of the companion of `target`."""


def _written(folder: Path, theta: Sequence[float]) -> Path:
    path = folder / "target.oifits"
    data = simulated(niriss(), list(theta), np.random.default_rng(1))
    write_oifits(path, data, overwrite=True)
    return path


@pytest.fixture(scope="session")
def _target(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _written(tmp_path_factory.mktemp("target"), TRUTH)


@pytest.fixture
def target(_target: Path, tmp_path: Path) -> Path:
    """A file of a star with a companion."""
    return Path(shutil.copy(_target, tmp_path))


@pytest.fixture
def full_pictures() -> None:
    """Ask for pictures as a user has them, in a test outside the folders of `PICTURED`."""


PICTURED = ("plots", "report")
"""Folders of tests that look at pictures."""


@pytest.fixture(autouse=True)
def _unprinted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures are composed, but neither laid out nor rendered: half of the time of a quick search.

    That what is rendered is right is for the tests of `PICTURED` and those with `full_pictures`.
    """
    if request.path.parent.name in PICTURED or "full_pictures" in request.fixturenames:
        return
    monkeypatch.setattr("matplotlib.figure.Figure.get_layout_engine", lambda figure: None)
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", _save_noise)
    # A process that draws for the targets of a table would load all anew, and render.
    monkeypatch.setattr("amibayes.parallel.run_apart", lambda function, *of: function(*of))


def _save_noise(figure: Figure, path: str | Path, **options: object) -> None:
    """Write a picture of some kilobytes, as large as one of the figure."""
    size = (figure.get_size_inches() * 10.0).astype(int)
    noise = np.random.default_rng(0).integers(0, 256, (*size[::-1],), dtype=np.uint8)
    Image.fromarray(noise).save(path, format="png")


@pytest.fixture(scope="session")
def star(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of a star by itself."""
    return _written(tmp_path_factory.mktemp("star"), (0.0, 0.0, 0.0))
