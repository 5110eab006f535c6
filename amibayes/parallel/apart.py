"""Calls in one process beside this one, for libraries that threads may not share.

Matplotlib keeps its settings in one place for the whole process, and two threads that draw at a
time disturb each other; workers of a cluster do have several threads. A process of its own that
is asked one thing after the other draws for all of them. It is no child of `multiprocessing`:
workers may not have such children.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any, BinaryIO

from threadpoolctl import threadpool_limits

from amibayes.errors import AmibayesError, RunError

HEAD = 8
"""Bytes of the length that goes before each message."""


class Apart:
    """One process that computes what it is asked, one thing after the other.

    It starts with the first question and ends with this process, however that ends.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Compute ``function(*arguments)`` there; both are of a module, or can be pickled.

        Raises
        ------
        RunError
            Where the process ended before it had answered.
        Exception
            What the function raised.
        """
        question = pickle.dumps((function, arguments))
        with self._lock:
            process = self._running()
            try:
                _send(process.stdin, question)
                answer = _receive(process.stdout)
            except (OSError, EOFError) as error:
                status = self._end(process)
                raise RunError(
                    f"the process that draws pictures ended (exit status {status})",
                    remedy="run again with --resume; fewer --workers need less memory",
                ) from error
        good, value = pickle.loads(answer)
        if good:
            return value
        raise value

    def close(self) -> None:
        """End the process."""
        with self._lock:
            if self._process is not None:
                self._end(self._process)

    def _running(self) -> subprocess.Popen[bytes]:
        if self._process is None or self._process.poll() is not None:
            # A group of its own: Ctrl-C is for this process, which then ends that one.
            self._process = subprocess.Popen(
                [sys.executable, "-c", f"from {__name__} import main; main()"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
                start_new_session=True,
            )
        return self._process

    def _end(self, process: subprocess.Popen[bytes]) -> int:
        self._process = None
        for stream in (process.stdin, process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        process.kill()
        return process.wait()


def _send(stream: Any, message: bytes) -> None:
    stream.write(len(message).to_bytes(HEAD, "big") + message)
    stream.flush()


def _receive(stream: Any) -> bytes:
    size = int.from_bytes(_exactly(stream, HEAD), "big")
    return _exactly(stream, size)


def _exactly(stream: Any, size: int) -> bytes:
    content = stream.read(size)
    if len(content) < size:
        raise EOFError
    return bytes(content)


def _answer(question: bytes) -> bytes:
    try:
        function, arguments = pickle.loads(question)
        with threadpool_limits(1):
            return pickle.dumps((True, function(*arguments)))
    except AmibayesError as error:
        return pickle.dumps((False, error))
    except Exception as error:  # noqa: BLE001 - travels to the process that asked
        return pickle.dumps((False, RuntimeError(f"{type(error).__name__}: {error}")))


def _serve(questions: BinaryIO, answers: BinaryIO) -> None:
    """Answer questions until there are no more."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            _send(answers, _answer(_receive(questions)))


def main() -> None:
    """Serve the process that started this one; what is printed goes to standard error."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "wb")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    _serve(sys.stdin.buffer, answers)


run_apart = Apart()
"""The process beside this one: there is one for all threads."""

atexit.register(run_apart.close)
