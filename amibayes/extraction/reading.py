"""One way in for every file: a list of formats, each with how it is recognised and read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

from astropy.io import fits

from amibayes.data.observables import Observables
from amibayes.extraction.extract import SEPARATOR, extract_all
from amibayes.extraction.options import ExtractOptions
from amibayes.oifits import OIFits, observables_of, open_oifits
from amibayes.oifits.audit import errors_in
from amibayes.support.fits_errors import UNREADABLE


@dataclass(frozen=True)
class ImageOptions:
    """How image cubes are turned into observables.

    Parameters
    ----------
    extraction : ExtractOptions
    header : mapping
        ``instrument``, ``filter``, ``pixel_scale_rad``, ``position_angle_deg`` in place of
        what the files say.
    """

    extraction: ExtractOptions = field(default_factory=ExtractOptions)
    header: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Contents:
    """What a file holds, without its data.

    Parameters
    ----------
    path : str
    header : mapping
        Of the primary HDU.
    names : tuple of str
        EXTNAME of every HDU, in capitals.
    shapes : tuple of (int, ...)
        Shape of every HDU that is an image; empty for others.
    """

    path: str
    header: Mapping[str, Any]
    names: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]

    @property
    def has_oifits(self) -> bool:
        """Whether there is a table of OIFITS."""
        return any(name.startswith("OI_") for name in self.names)


def contents_of(path: str | Path) -> Contents:
    """Read the headers of a file; one that is not readable seems to hold nothing.

    The reader that is then chosen, that of OIFITS, says what is wrong with it.
    """
    try:
        with fits.open(path, memmap=False, lazy_load_hdus=False) as hdus:
            names = tuple(hdu.name.upper() for hdu in hdus)
            shapes = tuple(tuple(hdu.shape) if hdu.is_image else () for hdu in hdus)
            return Contents(str(path), MappingProxyType(dict(hdus[0].header)), names, shapes)
    except UNREADABLE:
        return Contents(str(path), MappingProxyType({}), (), ())


@dataclass(frozen=True)
class InputFormat:
    """A kind of file that observables can be read from.

    Parameters
    ----------
    name : str
        As messages call it.
    recognise : callable
        Whether `Contents` are of this kind.
    read : callable
        Read files of this kind that were given together, as ``read(paths, images, one_star,
        **options)``: one `Observables` for each exposure.
    """

    name: str
    recognise: Callable[[Contents], bool]
    read: Callable[..., list[Observables]]


def _is_cube(contents: Contents) -> bool:
    return not contents.has_oifits and any(len(shape) > 1 for shape in contents.shapes)


def _extracted(
    paths: Sequence[str], images: ImageOptions, one_star: bool, **options: Any
) -> list[Observables]:
    found = extract_all(paths, images.extraction, one_star=one_star, **images.header)
    return [e.observables for e in found]


def _oifits(
    paths: Sequence[str], images: ImageOptions, one_star: bool, **options: Any
) -> list[Observables]:
    return [_with_errors(open_oifits(path), **options) for path in paths]


def _with_errors(oifits: OIFits, **options: Any) -> Observables:
    """Read a file; what an audit calls an error stands in the notes."""
    found = observables_of(oifits, **options)
    return replace(found, notes=(*found.notes, *errors_in(oifits, found)))


FORMATS: tuple[InputFormat, ...] = (
    InputFormat("image cube", _is_cube, _extracted),
    InputFormat("OIFITS", lambda contents: True, _oifits),
)
"""Every kind of input, by the order in which they are tried; the last takes what is left."""


def format_of(path: str | Path) -> InputFormat:
    """Find the first format that recognises a file."""
    contents = contents_of(path)
    return next(kind for kind in FORMATS if kind.recognise(contents))


def read_observations(
    paths: str | Path | Sequence[str | Path],
    images: ImageOptions | None = None,
    *,
    one_star: bool = True,
    **options: Any,
) -> list[Observables]:
    """Read observables, from OIFITS or out of image cubes.

    Parameters
    ----------
    paths : path, or a sequence of them
        Files of one kind are read together: cubes that are exposures of one star are one.
    images : ImageOptions, optional
        For image cubes.
    one_star : bool
        Whether files that name no star are of one, as those of a target are; calibrators
        may be several stars.
    **options
        For OIFITS, those of `read_oifits`.

    Returns
    -------
    list of Observables
        One for each exposure, in the order of the first file of each.

    Raises
    ------
    DataError
        Where a file cannot be read or nothing in it can be measured.
    """
    given = [str(p) for p in ([paths] if isinstance(paths, str | Path) else paths)]
    kinds = {path: format_of(path) for path in given}
    found: list[Observables] = []
    for kind in dict.fromkeys(kinds.values()):
        ours = [path for path in given if kinds[path] is kind]
        found += kind.read(ours, images or ImageOptions(), one_star, **options)
    return sorted(found, key=lambda part: _first(part, given))


def _first(part: Observables, paths: list[str]) -> int:
    """Place among the paths of the first file that some observables come from."""
    own = {name for s in part.setups for name in s.source.split(SEPARATOR)}
    return next((k for k, path in enumerate(paths) if path in own), len(paths))
