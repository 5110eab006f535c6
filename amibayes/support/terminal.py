"""The summary on the terminal: at most twenty lines, whatever there is."""

from __future__ import annotations

from collections.abc import Sequence

MAX_LINES = 20
"""What stays on a small terminal without scrolling."""


LEAST_TOLD = 1e-300
"""Probability below which a number of double precision is 0: it is said to be less."""


def tail(probability: float) -> str:
    """Write a probability of chance: ``0.02``; ``< 1e-300`` where the number is too small."""
    return f"{probability:.2g}" if probability >= LEAST_TOLD else f"< {LEAST_TOLD:.0e}"


def equals(probability: float) -> str:
    """Write the same after its name: ``= 0.02`` or ``< 1e-300``."""
    return f"= {tail(probability)}" if probability >= LEAST_TOLD else tail(probability)


def shortened(
    lines: Sequence[str], last: Sequence[str] = (), more: str = "and {} more lines"
) -> list[str]:
    """Leave out what does not fit, and write how much.

    Parameters
    ----------
    lines : sequence of str
        Of which those at the end may be left out.
    last : sequence of str
        Lines that are always at the end.
    more : str
        Replaces what is left out, ``{}`` for how many.

    Returns
    -------
    list of str
        At most `MAX_LINES`.
    """
    room = MAX_LINES - len(last)
    if len(lines) <= room:
        return [*lines, *last]
    return [*lines[: room - 1], more.format(len(lines) - room + 1), *last]


def with_warnings(lines: Sequence[str], warnings: Sequence[str], last: str, file: str) -> list[str]:
    """Put as many warnings after the lines as fit; the others are in a file.

    Parameters
    ----------
    lines : sequence of str
    warnings : sequence of str
    last : str
        Always at the end.
    file : str
        Name of the file that holds all warnings.
    """
    written = [row("WARNING", text) for text in warnings]
    return shortened([*lines, *written], [last], row("WARNING", f"{{}} more warnings in {file}"))


def row(label: str, text: str) -> str:
    """Write a line of a summary: what it is about, and what is found."""
    return f"{label:<11} {text}"
