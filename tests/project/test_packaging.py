"""One version, true lower bounds, and types on every public name."""

from __future__ import annotations

import inspect
import json
import os
import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import amibayes
from amibayes.support.environment import EXTRAS

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_the_version_stands_in_one_place() -> None:
    assert PROJECT["project"]["dynamic"] == ["version"]
    assert PROJECT["tool"]["hatch"]["version"]["path"] == "amibayes/__init__.py"
    cited = re.search(r"^version: (.*)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    assert cited is not None
    assert cited[1] == amibayes.__version__
    assert f"({amibayes.__version__})" in (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")


def test_the_lower_bounds_are_the_versions_that_are_tested() -> None:
    lines = (ROOT / "constraints-oldest.txt").read_text(encoding="utf-8").splitlines()
    pinned = dict(line.split("==") for line in lines if line and not line.startswith("#"))
    bounds = dict(re.split(">=", entry) for entry in PROJECT["project"]["dependencies"])
    assert pinned.keys() == bounds.keys()
    for name, bound in bounds.items():
        assert f"{pinned[name]}.".startswith(f"{bound}."), name


def test_types_are_shipped() -> None:
    assert (ROOT / "amibayes" / "py.typed").exists()


def callables() -> Iterator[tuple[str, object]]:
    """Public functions, and methods and properties of public classes, our own."""
    for name in amibayes.__all__:
        thing = getattr(amibayes, name)
        if inspect.isfunction(thing):
            yield name, thing
        elif inspect.isclass(thing):
            for attribute, member in vars(thing).items():
                if attribute.startswith("_") and attribute != "__init__":
                    continue
                function = member.fget if isinstance(member, property) else member
                function = getattr(function, "__func__", function)
                if inspect.isfunction(function) and function.__module__.startswith("amibayes"):
                    yield f"{name}.{attribute}", function


@pytest.mark.parametrize(
    ("name", "function"), [pytest.param(*pair, id=pair[0]) for pair in callables()]
)
def test_every_public_argument_and_result_has_a_type(name: str, function: object) -> None:
    signature = inspect.signature(function)
    bare = [
        p.name
        for p in signature.parameters.values()
        if p.annotation is p.empty and p.name not in ("self", "cls")
    ]
    assert not bare, f"{name}: {bare}"
    # Dataclasses write their own __init__, whose result nobody needs to be told.
    assert name.endswith("__init__") or signature.return_annotation is not signature.empty


def recipe() -> str:
    return (ROOT / "recipe" / "meta.yaml").read_text(encoding="utf-8")


CONDA_NAMES = {
    "astropy": "astropy-base",
    "matplotlib": "matplotlib-base",
    "lazy_loader": "lazy-loader",
}
"""Packages of conda-forge that have other names there; the -base ones come without a screen."""


def test_the_recipe_asks_for_what_the_project_asks_for() -> None:
    run = re.search(r"^  run:\n((?:    - .*\n)+)", recipe(), re.MULTILINE)
    assert run is not None
    asked = dict(re.findall(r"- (\S+) (>=[\d.]+)$", run[1], re.MULTILINE))
    needed = dict(re.split("(?=>=)", entry) for entry in PROJECT["project"]["dependencies"])
    assert asked == {CONDA_NAMES.get(name, name): bound for name, bound in needed.items()}
    oldest = (ROOT / "recipe" / "conda_build_config.yaml").read_text(encoding="utf-8")
    assert f'"{PROJECT["project"]["requires-python"].removeprefix(">=")}"' in oldest


def test_every_place_states_one_version_and_one_title() -> None:
    deposit = json.loads((ROOT / ".zenodo.json").read_text(encoding="utf-8"))
    cited = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert f'set version = "{amibayes.__version__}"' in recipe()
    assert f'title: "{deposit["title"]}"' in cited
    assert f"keywords: [{', '.join(deposit['keywords'])}]" in cited
    assert deposit["license"] == PROJECT["project"]["license"]["text"]
    assert "license: BSD-3-Clause" in cited


def test_one_extra_brings_all_that_users_need() -> None:
    extras = PROJECT["project"]["optional-dependencies"]
    (everything,) = extras["all"]
    named = set(re.findall(r"\[(.*)\]", everything)[0].split(","))
    # MPI needs a library of the cluster's own.
    assert named == set(EXTRAS) - {"mpi"}
    assert set(EXTRAS) <= set(extras)


@pytest.mark.parametrize("script", ["release", "recipe", "package", "run"])
def test_scripts_of_continuous_integration_can_be_run(script: str) -> None:
    path = ROOT / ".ci" / script
    assert os.access(path, os.X_OK)
    subprocess.run(["bash", "-n", str(path)], check=True)


def test_the_container_is_made_of_the_wheel() -> None:
    text = (ROOT / "Containerfile").read_text(encoding="utf-8")
    assert "--wheel" in text
    assert 'ENTRYPOINT ["amibayes"]' in text
    assert "USER observer" in text
