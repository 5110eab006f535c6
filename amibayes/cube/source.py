"""Where integrations come from: a file that is read a few at a time, or a cube in memory."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from amibayes.cube import Cube, open_cube


class Source(Protocol):
    """A cube that is read in parts; `amibayes.cube.CubeFile` is one."""

    @property
    def template(self) -> Cube:
        """Everything but the images."""

    @property
    def n_integrations(self) -> int:
        """How many images."""

    def read(self, start: int = 0, stop: int | None = None) -> Cube:
        """Read the integrations from ``start`` up to ``stop``."""


@dataclass(frozen=True, eq=False)
class InMemoryCube:
    """A cube in memory."""

    cube: Cube

    @property
    def template(self) -> Cube:
        """Everything but the images."""
        return self.read(0, 0)

    @property
    def n_integrations(self) -> int:
        """How many images."""
        return self.cube.n_integrations

    def read(self, start: int = 0, stop: int | None = None) -> Cube:
        """Give the integrations from ``start`` up to ``stop``."""
        cube, part = self.cube, slice(start, stop)
        return replace(
            cube,
            images=cube.images[part],
            error=None if cube.error is None else cube.error[part],
            dq=None if cube.dq is None else cube.dq[part],
            mjd=None if cube.mjd is None else cube.mjd[part],
        )


MOST_OPEN = 64
"""Files that are held open together: a quarter of what systems allow a process at least."""

Images = Cube | str | Path | Source
"""A cube, its file, or that opened."""


@contextmanager
def opened(cube: Images, **header: Any) -> Iterator[Source]:
    """Open a path, with `open_cube`'s options in place of its header, or a cube."""
    if isinstance(cube, Cube):
        yield InMemoryCube(cube)
    elif isinstance(cube, str | Path):
        with open_cube(cube, **header) as file:
            yield file
    else:
        yield cube


@contextmanager
def all_opened(cubes: Sequence[Images], **header: Any) -> Iterator[Sequence[Images]]:
    """Open files that are needed more than once; too many are left for `opened`.

    Reading its headers takes as long as extracting a hundred integrations.
    """
    with ExitStack() as stack:
        few = len(cubes) <= MOST_OPEN
        yield [stack.enter_context(opened(cube, **header)) for cube in cubes] if few else cubes
