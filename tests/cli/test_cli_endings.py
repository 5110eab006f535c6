"""How a run may end badly: always one line, an exit status, and nothing half-written."""

from __future__ import annotations

import errno
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import h5py
import pytest
from astropy.io import fits
from commands import heed_interruptions

from amibayes.cli import main
from amibayes.errors import UsageError
from amibayes.support.atomic_files import output_folder, output_locks

ROOT = Path(__file__).resolve().parents[2]
TRUTH = [110.0, -75.0, 0.02]
QUICK = ("--separation", "80:200", "--null-draws", "0", "--no-limits")


def start(
    *words: object, before: tuple[str, ...] = (), largest: int | None = None, **more: object
) -> subprocess.Popen[str]:
    """Start the command in a process of its own, in which no file may become larger."""

    def prepared() -> None:
        heed_interruptions()
        if largest is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))

    command = [*before, sys.executable, "-m", "amibayes", *map(str, words)]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    if largest is not None:  # what is covered could not be written either
        environment = {k: v for k, v in environment.items() if not k.startswith("COVERAGE")}
    return subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        preexec_fn=prepared,
        **more,  # type: ignore[call-overload]
    )  # fmt: skip


def ended(process: subprocess.Popen[str]) -> tuple[int, str]:
    """Exit status, and the one line on standard error."""
    try:
        out, err = process.communicate(timeout=120)
    finally:
        process.kill()
    assert out == ""
    lines = err.strip().split("\n")
    assert len(lines) == 1, err
    return process.returncode, lines[0]


def whole(folder: Path) -> None:
    """No temporary file is left, and what is there can be read to its end."""
    for path in folder.rglob("*") if folder.exists() else []:
        assert not path.name.startswith("."), path
        if path.suffix == ".json":
            json.loads(path.read_text())
        if path.suffix == ".png":
            assert path.read_bytes().endswith(b"IEND\xaeB`\x82")
        if path.suffix in (".fits", ".oifits"):
            with fits.open(path, checksum=False) as hdus:
                assert all(hdu.data is None or hdu.data.size for hdu in hdus)
        if path.suffix == ".h5":
            with h5py.File(path) as file:
                assert file["mcmc/chain"][()].size
        if path.suffix == ".html":
            assert path.read_text().endswith("</html>\n")


def test_a_fault_of_the_program_is_one_line(monkeypatch, capsys, tmp_path) -> None:
    import amibayes.support.environment

    def broken(*_: object) -> None:
        raise ZeroDivisionError("a\nfault")

    monkeypatch.setattr(amibayes.support.environment, "checkup", broken)
    assert main(["doctor"]) == 4
    captured = capsys.readouterr()
    assert captured.err.startswith("amibayes: unexpected ZeroDivisionError: a fault (")
    assert captured.err.count("\n") == 1
    assert captured.out == ""
    with pytest.raises(ZeroDivisionError):
        main(["doctor", "--debug"])


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (MemoryError("1 TiB"), "not enough memory: 1 TiB"),
        (OSError(errno.ENOSPC, "No space left on device", "x.fits"), "x.fits: No space left"),
        (KeyboardInterrupt(), "interrupted"),
        (RecursionError("deep"), "unexpected RecursionError"),
    ],
)
def test_other_endings(error, said, monkeypatch, capsys) -> None:
    import amibayes.support.environment

    def broken(*_: object) -> None:
        raise error

    monkeypatch.setattr(amibayes.support.environment, "checkup", broken)
    assert main(["doctor"]) == 4
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1


@pytest.mark.skipif(sys.platform == "win32", reason="needs RLIMIT_FSIZE")
@pytest.mark.parametrize(
    ("limit", "more", "file"),
    [
        (0, (), "stage-data.pickle"),
        pytest.param(200_000, (), "stage-integrate.pickle", marks=pytest.mark.slow),
        pytest.param(700_000, (), "posterior.h5", marks=pytest.mark.slow),
        pytest.param(200_000, ("--no-posterior",), ".png", marks=pytest.mark.slow),
        pytest.param(700_000, ("--no-posterior",), "report.html", marks=pytest.mark.slow),
    ],
)
def test_a_full_disk(limit: int, more, file: str, target: Path, tmp_path: Path) -> None:
    """No file may grow past the limit, as if the disk were full at that moment."""
    out = tmp_path / "out"
    process = start(
        "search", target, *QUICK, *more, "--out", out, "--quiet",
        largest=limit,
    )  # fmt: skip
    status, line = ended(process)
    assert status == 4
    assert f"{file}: cannot be written: File too large" in line
    assert str(out) in line
    assert not (out / "result.json").exists()
    whole(out)


def test_a_full_disk_for_what_is_printed(tmp_path: Path) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("there is no /dev/full on this machine")
    with open("/dev/full", "w") as full:
        command = [sys.executable, "-m", "amibayes", "completion", "bash"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, stdout=full, stderr=subprocess.PIPE, text=True, env=environment, timeout=60
        )
    assert done.returncode == 4
    assert done.stderr.startswith("amibayes: No space left on device")
    assert done.stderr.count("\n") == 1


def test_a_reader_that_leaves(tmp_path: Path) -> None:
    command = f"{sys.executable} -m amibayes completion bash | head -c 10 >/dev/null; "
    done = subprocess.run(
        ["bash", "-c", command + 'echo "${PIPESTATUS[0]}"'],
        capture_output=True, text=True, timeout=60, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stderr == ""


def test_a_folder_that_is_read_only(target: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    out.chmod(0o555)
    humble: tuple[str, ...] = ()
    if os.geteuid() == 0:  # the superuser may write everywhere, unless stripped of that
        if shutil.which("setpriv") is None:
            pytest.skip("run by the superuser, and there is no setpriv")
        humble = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
    try:
        for folder, said in ((out, "cannot be written into"), (out / "new", "be made a folder")):
            status, line = ended(start("search", target, *QUICK, "--out", folder, before=humble))
            assert (status, said in line) == (2, True), line
        assert not any(out.iterdir())
    finally:
        out.chmod(0o755)


def begun(out: Path) -> None:
    """Wait until a run has its folder."""
    deadline = time.monotonic() + 60
    while not out.is_dir():
        assert time.monotonic() < deadline
        time.sleep(0.05)


LONG = ("--separation", "80:200", "--null-draws", "100000000", "--quiet")


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
@pytest.mark.parametrize(
    ("number", "workers", "pause"),
    [
        (signal.SIGINT, 1, 1.0),
        pytest.param(signal.SIGINT, 2, 1.0, marks=pytest.mark.slow),  # while the workers start
        pytest.param(signal.SIGINT, 2, 4.0, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 1, 1.0, marks=pytest.mark.slow),
    ],
)
def test_a_run_that_is_stopped(number, workers, pause, target: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    process = start(
        "search", target, *LONG, "--workers", workers, "--out", out, start_new_session=True
    )
    begun(out)
    time.sleep(pause)
    os.killpg(process.pid, number)
    status, line = ended(process)
    assert status == 4
    parts = r"(the stages? [a-z, ]+)?(, )?(\d+ pieces? of the null searches)?"
    kept = rf"(kept (?=\S){parts}|no stage that can be kept was begun)"
    assert re.fullmatch(
        rf"amibayes: interrupted: {kept} \(run again with --resume to go on\)", line
    )
    assert not (out / "result.json").exists()
    whole(out)


@pytest.mark.slow
def test_two_runs_in_one_folder(target: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    first = start("search", target, *LONG, "--out", out)
    try:
        begun(out)
        time.sleep(0.5)
        assert main(["search", str(target), *QUICK, "--out", str(out), "--overwrite"]) == 2
        captured = capsys.readouterr()
        assert "another run is writing here (wait for it, or choose --out)" in captured.err
        assert not (out / "result.json").exists()
    finally:
        first.kill()
        first.communicate()
    words = ["search", str(target), *QUICK, "--no-posterior", "--out", str(out), "--quiet"]
    assert main(words) == 0, "the lock of a killed run must not stay"
    whole(out)


def test_a_folder_is_let_go(tmp_path: Path) -> None:
    code = (
        "import sys; from amibayes.support.atomic_files import output_folder\n"
        "output_folder(sys.argv[1], [], overwrite=True)"
    )

    def other() -> int:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        command = [sys.executable, "-c", code, str(tmp_path)]
        return subprocess.run(command, env=environment, capture_output=True).returncode

    with output_locks():
        output_folder(tmp_path, [], overwrite=True)
        output_folder(tmp_path, [], overwrite=True)  # the same run may ask again
        with output_locks():
            output_folder(tmp_path / "inner", [], overwrite=True)
        assert other() != 0
    assert other() == 0
    (tmp_path / "a").touch()
    with output_locks(), pytest.raises(UsageError, match="is there already"):
        output_folder(tmp_path, ["a"], overwrite=False)
