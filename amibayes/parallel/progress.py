"""How far a long stage is: a bar on standard error with rate and time left."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

Progress = Callable[[int, int], None]
"""Called with (pieces done, pieces in all); the first call says where the run starts."""


@contextmanager
def progress_bar(
    description: str, *, unit: str = "piece", scale: float = 1.0, quiet: bool = False
) -> Iterator[Progress]:
    """Draw a bar on standard error where that is a terminal.

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
    bar: list[tqdm[None]] = []

    def show(done: int, total: int) -> None:
        if not bar:
            bar.append(_bar(description, unit, done * scale, total * scale, quiet))
        bar[0].update(done * scale - bar[0].n)

    try:
        yield show
    finally:
        for drawn in bar:
            drawn.close()


def _bar(description: str, unit: str, done: float, total: float, quiet: bool) -> tqdm[None]:
    return tqdm(
        desc=description,
        unit=f" {unit}",
        initial=round(done),
        total=round(total),
        disable=True if quiet else None,
        dynamic_ncols=True,
    )
