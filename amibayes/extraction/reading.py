"""One way in for every file: a list of formats, each with how it is recognised and read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.cube.header import orientation_of
from amibayes.cube.source import all_opened
from amibayes.data.joining import SEPARATOR
from amibayes.data.observables import Observables
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.setup import Setup
from amibayes.errors import DataError, UsageError
from amibayes.extraction.charge import CubeMigration, visit_migration
from amibayes.extraction.extract import extract_all
from amibayes.extraction.mask_map import MaskMap
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.response import pipeline_response, seen_at_pointing
from amibayes.extraction.view import plain_view
from amibayes.extraction.visits import visit_maps
from amibayes.instrument import Instrument, load_instrument
from amibayes.kpfits import is_kpfits, kernel_observables
from amibayes.oifits import observables_of, open_oifits
from amibayes.oifits.audit import errors_in
from amibayes.oifits.products import (
    FITS_MODEL,
    IMPLANEIA,
    Contents,
    is_product_header,
    open_products,
    pointing_of,
    product_of,
    read_products,
    refuse_calibrating_again,
    refuse_twice,
    uncalibrated,
)
from amibayes.support.fits_errors import UNREADABLE
from amibayes.support.shared_results import shared_of_file


@dataclass(frozen=True)
class ImageOptions:
    """How image cubes are turned into observables.

    Parameters
    ----------
    extraction : ExtractOptions
    header : mapping
        ``instrument``, ``filter``, ``pixel_scale_rad``, ``position_angle_deg`` in place of
        what the files say.
    maps : mapping of path to MaskMap
        Maps of the mask that targets and calibrators share, from `of_one_visit`.
    charges : mapping of path to CubeMigration
        What is done about charge migration, likewise.
    """

    extraction: ExtractOptions = field(default_factory=ExtractOptions)
    header: Mapping[str, Any] = field(default_factory=dict)
    maps: Mapping[str, MaskMap | None] = field(default_factory=dict)
    charges: Mapping[str, CubeMigration] = field(default_factory=dict)


def contents_of(path: str | Path) -> Contents:
    """Read the headers of a file; one that is not readable seems to hold nothing.

    The reader that is then chosen, that of OIFITS, says what is wrong with it.
    """
    header, *rest = shared_of_file(partial(_headers, path), path, "headers")
    return Contents(str(path), MappingProxyType(header), *rest)


def _headers(path: str | Path) -> tuple[Any, ...]:
    """Header of the first unit, names and shapes of all, columns of tables."""
    try:
        with fits.open(path, memmap=False, lazy_load_hdus=False) as hdus:
            names = tuple(hdu.name.upper() for hdu in hdus)
            shapes = tuple(tuple(hdu.shape) if hdu.is_image else () for hdu in hdus)
            columns = frozenset(
                str(hdu.header[key]).strip().upper()
                for hdu in hdus
                for key in hdu.header
                if key.startswith("TTYPE")
            )
            return dict(hdus[0].header), names, shapes, columns
    except UNREADABLE:
        return {}, (), (), frozenset[str]()


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
    found = extract_all(
        paths,
        images.extraction,
        one_star=one_star,
        maps=[images.maps.get(path) for path in paths] if images.maps else None,
        charges=[images.charges[path] for path in paths] if images.charges else None,
        **images.header,
    )
    return [e.observables for e in found]


def _oifits(
    paths: Sequence[str], images: ImageOptions, one_star: bool, **options: Any
) -> list[Observables]:
    asked = tuple(sorted(options.items()))
    return [
        shared_of_file(partial(_with_errors, path, **options), path, "OIFITS", asked)
        for path in paths
    ]


def _with_errors(path: str, **options: Any) -> Observables:
    """Read a file; what an audit calls an error stands in the notes."""
    oifits = open_oifits(path)
    found = observables_of(oifits, **options)
    return replace(found, notes=(*found.notes, *errors_in(oifits, found)))


def _is_product(contents: Contents) -> bool:
    if is_product_header(contents.header, contents.names):
        return True
    return IMPLANEIA in contents.columns and product_of(open_oifits(contents.path)) is not None


def _products(
    paths: Sequence[str], images: ImageOptions, one_star: bool, **options: Any
) -> list[Observables]:
    return [_with_response(found) for found in read_products(open_products(paths), **options)]


def _with_response(found: Observables) -> Observables:
    """Give what the pipeline's fit lets through of light off the axis, where it can be told."""
    setups = tuple(replace(s, response=_pipeline_response(s)) for s in found.setups)
    if all(s.response is None for s in setups):
        return found
    notes = ["light off the axis taken as let through by the pipeline's fit of the fringes"]
    known = [plain_view(*_instrument_of(s)) for s in setups if s.response is not None]
    if any(view.unsampled.any() for view in known):
        notes.append(
            "the pixels are too large for the longest fringes, and the product does not tell where "
            "in a pixel the star is: separations may be off by 4 % (search the images instead)"
        )
    return _centred(replace(found, setups=setups, notes=(*found.notes, *notes)))


def _centred(found: Observables) -> Observables:
    """Take out what the star itself lost, as the model of the fringes was not centred on it."""
    data, used = found.data.copy(), found.unflagged()
    n = used.n_vis2
    for number, setup in enumerate(found.setups):
        if setup.response is None:
            continue
        star = seen_at_pointing(setup.response)
        one, other = (m.setup == number for m in (used.vis2, used.closure_phase))
        a, b = used.vis2.stations[one].T
        data[:n][one] /= np.abs(star[a, b]) ** 2
        i, j, k = used.closure_phase.stations[other].T
        data[n:][other] -= np.angle(star[i, j] * star[j, k] * star[i, k].conj())
    return found.with_data(data)


def _pipeline_response(setup: Setup) -> OffAxisResponse | None:
    if setup.station_xyz_m is None:
        return None
    try:
        seen = _instrument_of(setup)
        header = contents_of(setup.source.split(SEPARATOR)[0]).header
        orientation = orientation_of(header, setup.source)
    except (UsageError, DataError):
        return None
    found = pipeline_response(*seen, orientation, setup.station_xyz_m[:, :2])
    if found is None:
        return None
    pointings = [pointing_of(p) for p in open_products(setup.source.split(SEPARATOR))]
    return replace(found, pointing=np.mean(pointings, axis=0))


def _instrument_of(setup: Setup) -> tuple[Instrument, int]:
    """Instrument as the pipeline's model of the fringes has it, and the side of its images."""
    header = contents_of(setup.source.split(SEPARATOR)[0]).header
    drawn = load_instrument(str(header.get("INSTRUME")), str(header.get("FILTER")))
    side = header.get("SUBSIZE1")
    size = min(side if isinstance(side, int) else drawn.n_pixels, drawn.n_pixels)
    return drawn.as_built(), size


def _is_fitted_image(contents: Contents) -> bool:
    return str(contents.header.get("DATAMODL", "")) == FITS_MODEL


def _fitted_images(
    paths: Sequence[str], images: ImageOptions, one_star: bool, **options: Any
) -> list[Observables]:
    """Refuse the images that `ami_analyze` fitted, with what its fit leaves of them."""
    raise DataError(
        f"holds images and their fits (jwst amilg{residual_share(paths[0])}), no observables",
        source=paths[0],
        remedy="give the ami-oi or amimulti-oi product, or the image cube (calints)",
    )


def residual_share(path: str) -> str:
    """Say how much of the images an ``amilg`` file's fits leave, rms; empty if it does not say."""
    with fits.open(path, memmap=False) as hdus:
        there = {hdu.name: hdu.data for hdu in hdus if hdu.is_image and hdu.data is not None}
    if not {"CTRD", "RESID"} <= set(there):
        return ""
    image, residual = (np.nan_to_num(np.asarray(there[k], float)) for k in ("CTRD", "RESID"))
    share = float(np.sqrt((residual**2).sum() / max(float((image**2).sum()), 1e-300)))
    return f", whose fits leave {100.0 * share:.1f} % of the image"


def _has_kernel_phases(contents: Contents) -> bool:
    return is_kpfits(contents.names)


def _kernel_phases(
    paths: Sequence[str], images: ImageOptions, one_star: bool, **options: Any
) -> list[Observables]:
    return [kernel_observables(path, **options) for path in paths]


OIFITS = InputFormat("OIFITS", lambda contents: True, _oifits)

FORMATS: tuple[InputFormat, ...] = (
    InputFormat("kernel phases (KPFITS)", _has_kernel_phases, _kernel_phases),
    InputFormat("JWST stage-3 product", _is_product, _products),
    InputFormat("fitted images", _is_fitted_image, _fitted_images),
    InputFormat("image cube", _is_cube, _extracted),
    OIFITS,
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
    return sorted(found, key=lambda part: first_file(part, given))


def first_file(part: Observables, paths: Sequence[str]) -> int:
    """Place among the paths of the first file that some observables come from."""
    own = {name for s in part.setups for name in s.source.split(SEPARATOR)}
    return next((k for k, path in enumerate(paths) if path in own), len(paths))


def check_together(
    targets: Sequence[str | Path], calibrators: Sequence[str | Path] = ()
) -> tuple[str, ...]:
    """Refuse files that must not be used together, and warn of what is missing.

    Returns
    -------
    tuple of str
        Warnings.

    Raises
    ------
    UsageError
        Where two files are of one exposure, or what is calibrated is given calibrators.
    """
    ours, theirs = ([contents_of(path) for path in paths] for paths in (targets, calibrators))
    refuse_calibrating_again(ours, theirs)
    refuse_twice([*ours, *theirs])
    return uncalibrated(ours, theirs)


EXTRACTED = "AMIBAYES METHOD"
"""A card that files have from an extraction and lose when they are calibrated."""


def uncalibrated_images(paths: Sequence[str | Path]) -> tuple[str, ...]:
    """Name the image cubes, and what was extracted from some, of a target without calibrators."""
    raw = [
        str(path)
        for path in paths
        if format_of(path).read is _extracted or EXTRACTED in contents_of(path).header
    ]
    if not raw:
        return ()
    return (
        f"{', '.join(raw)}: not calibrated: what optics and detector do to V2 and closure phases "
        "is taken for the star's, and may pass for a companion; give calibrators with --cal",
    )


def charge_of(paths: Sequence[str | Path], images: ImageOptions) -> CubeMigration | None:
    """What was done about charge migration: in the first cube, or as the first file says.

    Parameters
    ----------
    paths : sequence of path
    images : ImageOptions
        From `of_one_visit` of these.

    Returns
    -------
    CubeMigration or None
        None where all are files that were made of something else than images.
    """
    done = next(iter(images.charges.values()), None)
    if done is not None:
        return done
    stated = (CubeMigration.of_header(contents_of(path).header) for path in paths)
    return next((charge for charge in stated if charge is not None), None)


def of_one_visit(paths: Sequence[str | Path], images: ImageOptions | None = None) -> ImageOptions:
    """Find what image cubes, target's and calibrators', share: the mask's map, and migration.

    Raises
    ------
    DataError
        Where a cube cannot be read.
    """
    chosen = images or ImageOptions()
    cubes = [str(path) for path in paths if format_of(path).read is _extracted]
    with all_opened(cubes, **chosen.header) as files:
        charges = visit_migration(files, chosen.extraction, chosen.header)
        maps = visit_maps(files, chosen.extraction, chosen.header, charges)
    return replace(
        chosen,
        maps=dict(zip(cubes, maps, strict=True)),
        charges=dict(zip(cubes, charges, strict=True)),
    )
