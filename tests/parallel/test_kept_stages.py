"""Finished stages: read back as they were, or not at all."""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import numpy as np
import pytest
from helpers import niriss

from amibayes.errors import RunError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.parallel import Journals
from amibayes.parallel.kept_stages import DIGEST, read_stage, write_stage


def test_what_a_stage_made_is_read_back(tmp_path: Path) -> None:
    path, likelihood = tmp_path / "stage", Likelihood(niriss())
    write_stage(path, (likelihood, {"seconds": 1.5}, None))
    again, seconds, nothing = read_stage(path)
    theta = [[100.0, 50.0, 0.01]]
    np.testing.assert_array_equal(again.residuals(theta), likelihood.residuals(theta))
    assert seconds == {"seconds": 1.5}
    assert nothing is None
    assert [p.name for p in tmp_path.iterdir()] == ["stage"]


@pytest.mark.parametrize("keep", [0, 10, DIGEST, -1])
def test_a_part_of_a_file_is_no_file(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "stage"
    write_stage(path, np.arange(1000.0))
    whole = path.read_bytes()
    path.write_bytes(whole[:keep])
    assert read_stage(path) is None
    path.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert read_stage(path) is None
    path.write_bytes(whole)
    assert read_stage(path) is not None
    path.unlink()
    assert read_stage(path) is None


class Touch:
    """Its pickle has a function called, as that of a folder from elsewhere may."""

    def __init__(self, function: object, *arguments: object) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self) -> tuple[object, ...]:
        return self.function, self.arguments


def test_no_function_is_called_by_what_is_read(tmp_path: Path) -> None:
    mark, path = tmp_path / "mark", tmp_path / "stage"
    for other in (
        Touch(os.mkdir, str(mark)),
        Touch(Journals, str(tmp_path), "x"),
        Touch(eval, "1"),
    ):
        write_stage(path, other)
        assert read_stage(path) is None
        assert not mark.exists()
    assert pickle.loads(pickle.dumps(Touch(eval, "1"))) == 1


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    journals = Journals(tmp_path / "file", "key", resume=True)
    with pytest.raises(RunError, match="cannot be written"):
        journals.write_stage("search", 1)


def test_stages_are_kept_for_those_who_resume_and_told(tmp_path: Path) -> None:
    journals = Journals(tmp_path, "key", resume=True)
    assert journals.kept() == "no stage that can be kept was begun"
    journals.write_stage("data", 1)
    journals.write_stage("search", 2)
    journals.of("null").write(0, {"statistic": np.zeros(1)})
    assert journals.kept() == "kept the stages data, search, 1 piece of the null searches"
    assert Journals(tmp_path, "key", resume=True).read_stage("search") == 2
    assert Journals(tmp_path, "other", resume=True).read_stage("search") is None
    assert Journals(tmp_path, "key", resume=False).read_stage("search") is None
    assert not (tmp_path / "key").exists()
