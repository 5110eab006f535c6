"""``amibayes extract``: image cubes to OIFITS."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amibayes import __version__
from amibayes.cli.options import common
from amibayes.errors import UsageError
from amibayes.support.options import CLIP_INTEGRATIONS, ExtractionCovariance, Geometry, choices
from amibayes.support.terminal import shortened

if TYPE_CHECKING:
    from amibayes.extraction import Extraction

EXAMPLES = """examples:
  amibayes extract target_calints.fits
  amibayes extract dither1_calints.fits dither2_calints.fits --method matched --out target
  amibayes extract cube.fits --instrument niriss --filter F480M --pixel-scale 65
"""

SUMMARY = "extract.json"

MIGRATION = "migration"
"""Name of the picture of what changes along ramps, where there are some."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "cubes", nargs="+", metavar="CUBE", help="image cube(s), or exposures of one"
    )
    common.add_image_options(parser)
    group = parser.add_argument_group("extraction")
    group.add_argument(
        "--clip-integrations",
        type=common.positive_float,
        default=CLIP_INTEGRATIONS,
        metavar="SIGMA",
        help="leave out integrations that are outliers (default: %(default)g)",
    )
    group.add_argument(
        "--keep-integrations",
        action="store_true",
        help="leave no integration out that can be measured",
    )
    group.add_argument(
        "--window",
        type=common.finite_float,
        metavar="PIXELS",
        help="radius at which the window of the Fourier methods (all but fringes) has fallen to a "
        "half; 0 for none (default: 0.45 of the image's side)",
    )
    group.add_argument(
        "--covariance",
        choices=choices(ExtractionCovariance),
        default=choices(ExtractionCovariance)[0],
        help="scatter combined with photon noise, or one of them alone (default: %(default)s)",
    )
    group.add_argument(
        "--geometry",
        choices=choices(Geometry),
        default=choices(Geometry)[0],
        help="pixel scale and rotation of the mask (default: %(default)s, where "
        "the image determines them)",
    )
    group.add_argument("--per-integration", action="store_true", help="write every integration too")
    common.add_output_options(parser, "extract")


def run(arguments: argparse.Namespace) -> int:
    """Extract, write the files, print a summary."""
    common.configure_logging(arguments)
    common.refuse_repeated(arguments.cubes)
    from dataclasses import replace

    from amibayes.extraction import extract_all
    from amibayes.extraction.reading import check_together
    from amibayes.support.atomic_files import output_folder, write_json

    images = common.image_options_of(arguments)
    options = replace(
        images.extraction,
        clip=arguments.clip_integrations,
        keep_all=arguments.keep_integrations,
        window_px=arguments.window,
        covariance=arguments.covariance,
        geometry=arguments.geometry,
    )
    options.refuse_unused()
    check_together(arguments.cubes)
    stems = _stems(arguments.cubes)
    names = [SUMMARY, *(n for stem in stems for n in _names(stem, arguments))]
    folder = output_folder(arguments.out, names, overwrite=arguments.overwrite)
    with common.stages_of(arguments) as progress:
        progress.stage("extract")
        found = extract_all(arguments.cubes, options, **images.header)
    content = []
    for extraction in found:
        stem = stems[arguments.cubes.index(extraction.sources[0])]
        content.append(_write(extraction, folder, stem, arguments))
    result = {"amibayes": __version__, "extractions": content}
    write_json(folder / SUMMARY, result)
    common.finish(arguments, result, lambda: _summary(content))
    return 0


def _stems(paths: list[str]) -> list[str]:
    """Name of the output of each cube, were it the first of its exposure.

    Raises
    ------
    UsageError
        Where two would be the same.
    """
    stems = [Path(path).name.removesuffix(".gz").removesuffix(".fits") for path in paths]
    if len(set(stems)) < len(stems):
        raise UsageError("two cubes have the same name", remedy="extract them one by one")
    return stems


def _names(stem: str, arguments: argparse.Namespace) -> list[str]:
    from amibayes.plots.extraction import PICTURES

    extra = [f"{stem}_integrations.oifits"] if arguments.per_integration else []
    pictures = (*PICTURES, MIGRATION)
    return [f"{stem}.oifits", *extra, *(f"{stem}_{name}.png" for name in pictures)]


def _write(
    extraction: Extraction, folder: Path, stem: str, arguments: argparse.Namespace
) -> dict[str, Any]:
    from amibayes.extraction.summary import described, header_of
    from amibayes.extraction.table import integrations
    from amibayes.oifits import write_oifits
    from amibayes.plots.extraction import PICTURES
    from amibayes.plots.style import save

    header = header_of(extraction)
    path = folder / f"{stem}.oifits"
    write_oifits(path, extraction.observables, header=header, overwrite=True)
    if arguments.per_integration:
        single = folder / f"{stem}_integrations.oifits"
        write_oifits(single, integrations(extraction), header=header, overwrite=True)
    for name, draw in PICTURES.items():
        save(draw(extraction), folder / f"{stem}_{name}.png")
    if extraction.charge.fit is not None:
        from amibayes.plots.charge_migration import migration_plot

        save(migration_plot(extraction.charge.fit), folder / f"{stem}_{MIGRATION}.png")
    return {"path": str(path), **described(extraction)}


def _geometry(found: dict[str, Any]) -> str:
    """Map of the mask, or scale and rotation where the pixels are not known."""
    if found["mask_map"] is None:
        scale, turn = found["scale"], found["rotation_deg"]
        return f"pixel {scale:.4f} of the stated, mask turned {turn:+.3f} deg"
    (xx, xy), (yx, yy) = found["mask_map"]
    return f"pixels of the header, mask magnified {xx:.5f}, {yy:.5f}, sheared {xy:+.5f}, {yx:+.5f}"


def _summary(content: list[dict[str, Any]]) -> list[str]:
    from amibayes.extraction.extract import MAPPED

    lines = []
    for entry in content:
        lines += [
            f"{entry['path']}: {entry['instrument']} {entry['filter']}, method {entry['method']}",
            f"  integrations   {entry['n_used']} of {entry['n_integrations']} used",
            f"  star           x {entry['centre_px'][0][0]:+.3f}, "
            f"y {entry['centre_px'][0][1]:+.3f} pixels from the middle, "
            f"pointing {entry['jitter_px']:.3f} pixels rms",
            f"  geometry       {_geometry(entry['geometry'][0])}",
            f"  bad pixels     {entry['bad_pixels'][0]} always, {entry['outliers']:.1f} more in "
            "an integration",
            f"  V²             σ {entry['sigma_vis2']:.2g}, photon and read noise "
            f"{entry['sigma_vis2_physical']:.2g}",
            f"  closure phase  σ {entry['sigma_closure_phase_deg']:.3g} deg, photon and read noise "
            f"{entry['sigma_closure_phase_physical_deg']:.3g} deg",
        ]
        lines += [f"  {note}" for note in entry["notes"] if not note.startswith(MAPPED)]
    return shortened(lines)


__all__ = ["add_arguments", "run"]
