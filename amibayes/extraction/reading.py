"""One way in for every file: OIFITS as it is, images extracted first."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from astropy.io import fits

from amibayes.data.observables import Observables, join
from amibayes.extraction.extract import extract_all
from amibayes.extraction.options import ExtractOptions
from amibayes.oifits import read_oifits
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


def holds_images(path: str | Path) -> bool:
    """Tell whether a file holds images, and no OIFITS tables.

    Anything that is not readable is left for the reader of OIFITS to complain about.
    """
    try:
        with fits.open(path, memmap=False, lazy_load_hdus=False) as hdus:
            if any(hdu.name.startswith("OI_") for hdu in hdus):
                return False
            return any(hdu.is_image and len(hdu.shape) > 1 for hdu in hdus)
    except UNREADABLE:
        return False


def read_observations(
    path: str | Path, images: ImageOptions | None = None, **options: Any
) -> Observables:
    """Read observables, from OIFITS or out of an image cube.

    Parameters
    ----------
    path : str or path
    images : ImageOptions, optional
        For image cubes.
    **options
        For OIFITS, those of `read_oifits`.

    Raises
    ------
    DataError
        Where the file cannot be read or nothing in it can be measured.
    """
    if not holds_images(path):
        return read_oifits(path, **options)
    chosen = images or ImageOptions()
    found = extract_all(path, chosen.extraction, **chosen.header)
    return join([e.observables for e in found])
