"""The whole way from images to observables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from amibayes.cube import Cube
from amibayes.cube.source import Images, all_opened, opened
from amibayes.data.covariance import Block
from amibayes.data.joining import SEPARATOR
from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.outliers import outlying
from amibayes.data.shrinkage import Shrunk, shrunk_covariance
from amibayes.errors import DataError
from amibayes.extraction.charge import (
    CubeMigration,
    observable_changes,
    shared_errors,
    visit_migration,
)
from amibayes.extraction.frames import (
    Average,
    Frames,
    average,
    concatenated,
    measure_file,
    refuse_starless,
    select,
)
from amibayes.extraction.mask_map import MaskMap, far_from_stated
from amibayes.extraction.operator import ExtractionOperator
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.preparation import make_operator
from amibayes.extraction.response import (
    mean_response,
    off_axis_response,
    pointing_response,
    star_image,
)
from amibayes.extraction.table import Extraction, independent_basis, observables_of, target_of
from amibayes.extraction.view import View
from amibayes.extraction.visits import exposures, visit_maps
from amibayes.oifits.products import Contents, refuse_twice
from amibayes.ramps.correction import MigrationFree
from amibayes.support.arguments import checks_arguments
from amibayes.support.options import EXTRACTION_METHODS
from amibayes.units import ComplexArray, FloatArray

TIMES = ("EXPMID", "MJD-AVG", "MJD-OBS")
"""Keywords that tell when an exposure was made, the best first."""

MAX_SHIFT_PX = 1.5
"""Integrations that point farther from the others are not used."""


@checks_arguments
def extract(
    cubes: Cube | str | Path | Sequence[Cube | str | Path],
    method: str = next(iter(EXTRACTION_METHODS)),
    *,
    options: ExtractOptions | None = None,
    **header: Any,
) -> Observables:
    """Measure V², closure phases and their joint covariance in images.

    Parameters
    ----------
    cubes : Cube, path, or a sequence of them
        Files of one instrument, filter and orientation are one exposure; others are laid
        side by side.
    method : {"fringes", "matched", "fft", "gauss", "square", "unique"}
        Fit of the images, or ways to sample their Fourier transform.
    options : ExtractOptions, optional
        Everything else; ``method`` goes before its own.
    **header
        ``instrument``, ``filter``, ``pixel_scale_rad``, ``position_angle_deg`` in place of
        what the files say.

    Returns
    -------
    Observables

    Raises
    ------
    DataError
        Where a file cannot be read, or nothing in it can be measured.
    """
    chosen = replace(options or ExtractOptions(), method=method)
    return join([e.observables for e in extract_all(cubes, chosen, **header)])


def extract_all(
    cubes: Cube | str | Path | Sequence[Cube | str | Path],
    options: ExtractOptions | None = None,
    *,
    one_star: bool = True,
    maps: Sequence[MaskMap | None] | None = None,
    charges: Sequence[CubeMigration] | None = None,
    **header: Any,
) -> list[Extraction]:
    """As `extract`, with everything that was found on the way, one for each exposure.

    Cubes that name no star are exposures of ``one_star``, or each of another one. ``maps`` of
    the mask and ``charges`` that pass between pixels, one for each cube, are by default those
    of `visit_maps` and `visit_migration` of these cubes.
    """
    given = [cubes] if isinstance(cubes, Cube | str | Path) else list(cubes)
    if not given:
        raise DataError("no cube to extract", remedy="give at least one file")
    chosen = options or ExtractOptions()
    chosen.refuse_unused()
    with all_opened(given, **header) as files:
        charges = visit_migration(files, chosen, header) if charges is None else charges
        maps = visit_maps(files, chosen, header, charges) if maps is None else maps
        parts = [
            _measured(file, index, chosen, header, mask_map, charge)
            for index, (file, mask_map, charge) in enumerate(zip(files, maps, charges, strict=True))
        ]
    refuse_twice([Contents(p.template.source, p.template.header, (), ()) for p in parts])
    groups = exposures(parts, lambda part: part.template, one_star=one_star)
    return [_finished(_numbered(group), chosen) for group in groups]


@dataclass(frozen=True, eq=False)
class _Part:
    """One file."""

    template: Cube
    operator: ExtractionOperator
    frames: Frames
    physical: FloatArray
    response: OffAxisResponse
    pointed: ComplexArray
    charge: CubeMigration
    changes: FloatArray | None


def _numbered(parts: list[_Part]) -> list[_Part]:
    """Number the files of an exposure, in order of time."""
    return [
        replace(p, frames=replace(p.frames, file=np.full(len(p.frames), k)))
        for k, p in enumerate(parts)
    ]


def _measured(
    cube: Images,
    index: int,
    options: ExtractOptions,
    header: dict[str, Any],
    mask_map: MaskMap | None,
    charge: CubeMigration,
) -> _Part:
    with opened(cube, **header) as raw:
        file = charge.applied(raw)
        operator = make_operator(file, options, mask_map)
        frames, samples, flux = measure_file(operator, file, index)
        changes = None
        if isinstance(file, MigrationFree):
            changes = observable_changes(file, operator, samples, flux)
    template = file.template
    refuse_starless(frames, template.source)
    frames = _with_times(frames, template)
    if not options.keep_all:
        frames = replace(frames, reason=select(frames, options.clip, MAX_SHIFT_PX))
    if not frames.used.any():
        raise DataError(f"no integration can be used: {frames.reason[0]}", source=template.source)
    star = star_image(operator.view)
    centre = frames.shift_px[frames.used].mean(axis=0)
    response = off_axis_response(
        star, operator.sampling, template.orientation, centre, options.method
    )
    return _Part(
        template,
        operator,
        frames,
        operator.sampling.expected_covariance(flux, samples, operator.variance, operator.skewness),
        response,
        pointing_response(star, operator.sampling, frames.shift_px),
        charge,
        changes,
    )


def _with_times(frames: Frames, template: Cube) -> Frames:
    """Give integrations without a time that of the middle of their exposure."""
    middle = next(
        (v for k in TIMES if isinstance(v := template.header.get(k), int | float)), np.nan
    )
    return replace(frames, mjd=np.where(np.isnan(frames.mjd), middle, frames.mjd))


def _finished(parts: list[_Part], options: ExtractOptions) -> Extraction:
    """One exposure out of its files: average, covariance, table."""
    view = parts[0].operator.view
    frames, mean, physical = _together(parts, options)
    n_vis2 = view.instrument.mask.n_baselines
    basis = independent_basis(view)
    shrunk = shrunk_covariance(mean.deviation, physical, basis, n_vis2, options.covariance)
    notes = _unnamed(parts) + _of_headers(parts) + _notes(view, frames, shrunk)
    notes += tuple(dict.fromkeys(note for p in parts for note in p.charge.notes))
    sources = tuple(p.template.source for p in parts)
    weight = np.bincount(frames.file[frames.used], minlength=len(parts)) / frames.used.sum()
    response = mean_response([p.response for p in parts], weight)
    observables = _tabled(parts[0], response, frames, mean, shrunk, basis, notes, sources)
    observables = _sharing(observables, parts, weight)
    operators = tuple(p.operator for p in parts)
    return Extraction(
        observables, frames, mean, shrunk, physical, operators, options, sources, parts[0].charge
    )


def _sharing(observables: Observables, parts: list[_Part], weight: FloatArray) -> Observables:
    """Put in what errors of the charge migration do to the mean of all files, by their weights."""
    changes = [
        (p.charge.migration, w * p.changes)
        for p, w in zip(parts, weight, strict=True)
        if p.charge.migration is not None and p.changes is not None
    ]
    return observables.with_shared_errors(shared_errors(changes))


def _together(parts: list[_Part], options: ExtractOptions) -> tuple[Frames, Average, FloatArray]:
    """Integrations of all files, outliers marked, their mean, and their noise."""
    frames = concatenated([p.frames for p in parts])
    pointed = np.concatenate([p.pointed for p in parts])
    count = np.array([p.frames.used.sum() for p in parts], dtype=float)
    physical = np.einsum("k,kij->ij", count / count.sum(), np.stack([p.physical for p in parts]))
    triangles = parts[0].operator.view.instrument.mask.triangle_baselines
    mean = average(frames.select(frames.used), pointed[frames.used], triangles)
    if not options.keep_all:
        off = np.zeros(len(frames), dtype=bool)
        off[frames.used] = outlying(mean.deviation, np.sqrt(np.diag(physical)), options.clip)
        if off.any():
            reason = np.where(off, "observables are outliers", frames.reason)
            frames = replace(frames, reason=reason)
            mean = average(frames.select(frames.used), pointed[frames.used], triangles)
    return frames, mean, np.asarray(physical)


def _tabled(
    part: _Part,
    response: OffAxisResponse,
    frames: Frames,
    mean: Average,
    shrunk: Shrunk,
    basis: FloatArray,
    notes: tuple[str, ...],
    sources: tuple[str, ...],
) -> Observables:
    n = int(frames.used.sum())
    scatter = None if shrunk.carried is None else csr_array(shrunk.scatter / n)
    return observables_of(
        part.operator.view,
        replace(part.template, source=SEPARATOR.join(sources)),
        mean,
        Block(np.arange(len(basis)), shrunk.matrix / n, basis),
        n_integrations=n if n > 1 else None,
        kind="estimated" if n > 1 else "given",
        freedom=shrunk.carried,
        scatter=scatter,
        response=response,
        mjd=_mjd(frames),
        integration_s=n * (part.template.integration_time_s or 0.0),
        notes=notes,
    )


def _mjd(frames: Frames) -> float:
    """Mean time of what was used; 0 where nothing tells it."""
    known = frames.mjd[frames.used & np.isfinite(frames.mjd)]
    return float(known.mean()) if len(known) else 0.0


def _unnamed(parts: list[_Part]) -> tuple[str, ...]:
    """Say that nothing but the command line tells the files to be of one star."""
    if len(parts) == 1 or target_of(parts[0].template):
        return ()
    return (f"{len(parts)} files that name no star are taken as exposures of one",)


MAPPED = "pixels taken as the header has them"
"""Begins the note on the map of the mask."""


def _of_headers(parts: list[_Part]) -> tuple[str, ...]:
    """What the headers are in doubt of, and how the images were taken to lie on the sky."""
    notes = dict.fromkeys(note for p in parts for note in p.template.notes)
    found = parts[0].operator.geometry.mask_map
    if found is not None:
        a, b = (f"{found.matrix[k, k]:.5f}" for k in (0, 1))
        c, d = (f"{x:+.5f}" for x in (found.matrix[0, 1], found.matrix[1, 0]))
        text = f"{MAPPED}; mask magnified {a}, {b} and sheared {c}, {d}"
        notes[text] = None
        notes |= dict.fromkeys(far_from_stated(found, parts[0].operator.view.instrument.distortion))
    return tuple(notes)


def _notes(view: View, frames: Frames, shrunk: Shrunk) -> tuple[str, ...]:
    notes = []
    if view.unsampled.any():
        notes.append(
            f"the pixels are too large for the fringes of {view.unsampled.sum()} of "
            f"{len(view.unsampled)} baselines: the response to light off the axis is that of the "
            "star's place within a pixel"
        )
    lost = int((~frames.used).sum())
    if lost:
        notes.append(f"{lost} of {len(frames)} integrations not used")
    if shrunk.block > 1:
        notes.append(
            f"integrations are correlated in time ({shrunk.correlation:.2f} from one to the "
            f"next): the covariance rests on means of {shrunk.block}"
        )
    return tuple(notes)
