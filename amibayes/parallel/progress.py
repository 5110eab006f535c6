"""How far a long stage is: a bar on standard error with rate and time left."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm


def _report(line: str) -> None:
    """Write a line on standard error beside the bars."""
    tqdm.write(line, file=sys.stderr)


LINE_EVERY_S = 60.0
"""Off a terminal a stage reports with a line of its own, as often as that."""

_LOCK = threading.RLock()
"""Bars are of one process: tqdm's own lock is a semaphore that a killed worker would leave."""

Progress = Callable[[int, int], None]
"""Called with (pieces done, pieces in all); the first call gives where the run starts."""


@contextmanager
def progress_bar(
    description: str, *, unit: str = "piece", scale: float = 1.0, quiet: bool = False
) -> Iterator[Progress]:
    """Draw a bar on standard error, or write a line a minute where that is no terminal.

    Parameters
    ----------
    description : str
        What is being done.
    unit : str
        What is counted.
    scale : float
        Units per piece, for a rate that means something to the reader.
    quiet : bool
        Draw nothing.

    Yields
    ------
    Progress
        To be called with (done, total), in pieces. The rate counts only what this run
        did, not what an earlier one left in the journal.
    """
    with stage_bars(unit=unit, scale=scale, quiet=quiet, leave=True) as bars:
        bars.stage(description)
        yield bars.update


class StageBars:
    """One bar after the other, each for a stage; see `stage_bars`."""

    def __init__(
        self, unit: str, scale: float, *, quiet: bool, leave: bool, verbose: bool = False
    ) -> None:
        tqdm.set_lock(_LOCK)
        self._unit, self._scale, self._quiet, self._leave = unit, scale, quiet, leave
        self._verbose, self._begun = verbose, 0.0
        self._name, self._counts = "", False
        self._bar: tqdm[None] | None = None
        self._lines = not quiet and not sys.stderr.isatty()
        self._start, self._spoken = (0.0, 0), time.perf_counter()

    def stage(self, name: str) -> None:
        """Begin a stage: its name, and a bar as soon as its progress is known."""
        self.end()
        self._name, self._counts, self._begun = name, False, time.perf_counter()
        if self._verbose:
            _report(f"amibayes: {name}")
        if not self._leave:
            self._bar = self._new(0, None, bar_format="{desc} …")

    def update(self, done: int, total: int) -> None:
        """Show how much of the stage is done; the total may grow."""
        now, end = round(done * self._scale), round(total * self._scale)
        if self._lines:
            self._write_line(now, end)
        if self._bar is None or not self._counts:
            self.close()
            self._bar, self._counts = self._new(now, end), True
        grown = self._bar.total != end
        self._bar.total = end
        self._bar.update(now - self._bar.n)
        if grown:
            self._bar.refresh()

    def _write_line(self, now: int, end: int) -> None:
        """Write how far the stage is, where the last line was a minute ago or more."""
        clock = time.perf_counter()
        if not self._counts or now < self._start[1]:
            self._start = clock, now
        if clock - self._spoken < LINE_EVERY_S:
            return
        self._spoken = clock
        begun, before = self._start
        rate = (now - before) / max(clock - begun, 1e-9)
        left = f", {tqdm.format_interval((end - now) / rate)} left" if rate > 0 else ""
        unit = self._unit
        speed = f", {rate:.3g} {unit}s/s" if rate > 0 else ""
        _report(f"amibayes: {self._name}: {now} of {end} {unit}s{speed}{left}")

    def end(self) -> None:
        """End the stage, and report how long it took where that is wanted."""
        self.close()
        if self._verbose and self._name:
            _report(f"amibayes: {self._name}: {time.perf_counter() - self._begun:.1f} s")
        self._name = ""

    def close(self) -> None:
        """End the bar."""
        if self._bar is not None:
            self._bar.close()
            self._bar = None

    def _new(self, done: int, end: int | None, bar_format: str | None = None) -> tqdm[None]:
        return tqdm(
            desc=self._name,
            unit=f" {self._unit}",
            initial=done,
            total=end,
            disable=True if self._quiet else None,
            dynamic_ncols=True,
            leave=self._leave,
            bar_format=bar_format,
        )


@contextmanager
def stage_bars(
    *,
    unit: str = "piece",
    scale: float = 1.0,
    quiet: bool = False,
    leave: bool = False,
    verbose: bool = False,
) -> Iterator[StageBars]:
    """Draw the bars of a job of several stages.

    Parameters
    ----------
    unit, scale, quiet
        As for `progress_bar`.
    leave : bool
        Keep each bar when its stage is done.
    verbose : bool
        Report each stage as it begins, and its seconds as it ends, on standard error.
    """
    bars = StageBars(unit, scale, quiet=quiet, leave=leave, verbose=verbose)
    try:
        yield bars
    finally:
        bars.end()
