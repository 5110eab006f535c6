"""Files appear whole, with the mode of any new file; damage is told from mistakes of our own."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from amibayes.errors import DataError
from amibayes.oifits import tables
from amibayes.support.atomic_files import atomic_path, write_text
from amibayes.support.fits_errors import reporting_damage


def test_written_files_have_the_mode_of_new_files(tmp_path: Path) -> None:
    (plain := tmp_path / "plain").write_text("a")
    write_text(tmp_path / "atomic", "a")
    modes = [stat.S_IMODE((tmp_path / n).stat().st_mode) for n in ("plain", "atomic")]
    assert modes[0] == modes[1]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["atomic", plain.name]


def test_writing_leaves_the_umask_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(mask: int) -> int:
        raise AssertionError("the umask is the whole process's")

    monkeypatch.setattr(os, "umask", refuse)
    work = [threading.Thread(target=write_text, args=(tmp_path / f"{i}", str(i))) for i in range(8)]
    for thread in work:
        thread.start()
    for thread in work:
        thread.join()
    assert [(tmp_path / f"{i}").read_text() for i in range(8)] == [str(i) for i in range(8)]


def test_a_file_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    sync, move = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (order.append("sync"), sync(handle))[1])
    monkeypatch.setattr(Path, "replace", lambda a, b: (order.append("name"), move(a, b))[1])
    write_text(tmp_path / "a", "a")
    assert order == ["sync", "name", "sync"]


def test_nothing_is_left_of_a_file_that_failed(tmp_path: Path) -> None:
    with pytest.raises(UnicodeEncodeError), atomic_path(tmp_path / "a") as path:
        path.write_text("a\udc80")
    assert list(tmp_path.iterdir()) == []


def test_mistakes_of_our_own_are_not_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(DataError, match="damaged FITS file"), reporting_damage("x.fits"):
        raise TypeError("a library's")
    with pytest.raises(DataError, match="more memory than there is"), reporting_damage("x.fits"):
        raise MemoryError

    def mistaken(*arguments: object) -> None:
        exec(compile("None.missing", tables.__file__, "exec"))  # noqa: S102

    with pytest.raises(AttributeError), reporting_damage("x.fits"):
        mistaken()
