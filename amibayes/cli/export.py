"""``amibayes export``: one merged file for a program of image reconstruction."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from amibayes.cli.options import common, data_options
from amibayes.support.options import ImagingProgram, choices

if TYPE_CHECKING:
    from amibayes.oifits.export import Export

EXAMPLES = """examples:
  amibayes export calibrated.oifits --to squeeze
  amibayes export epoch1.oifits epoch2.oifits --to mira --out images
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``export``."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="OIFITS file(s) of one object, merged into one"
    )
    parser.add_argument("--to", required=True, choices=choices(ImagingProgram), help="the program")
    data_options.add_insname(parser)
    data_options.add_target(parser)
    common.add_output_options(parser, "export")


def run(arguments: argparse.Namespace) -> int:
    """Write the file and explain its use."""
    common.configure_logging(arguments)
    common.refuse_repeated(arguments.files)
    from amibayes import __version__
    from amibayes.oifits import read_oifits
    from amibayes.oifits.export import export, write_export
    from amibayes.support.atomic_files import output_folder, write_text

    parts = [
        read_oifits(path, insname=arguments.insname, target=arguments.target)
        for path in arguments.files
    ]
    exported = export(parts, arguments.to)
    names = [f"{arguments.to}.oifits", *(["irbis.sof"] if arguments.to == "irbis" else [])]
    folder = output_folder(arguments.out, names, overwrite=arguments.overwrite)
    path = folder / names[0]
    write_export(path, exported, overwrite=True)
    if arguments.to == "irbis":
        write_text(folder / names[1], exported.set_of_frames(path))
    content = {
        "amibayes": __version__,
        "program": exported.program,
        "target": exported.target,
        "path": str(path),
        "command": exported.command(path),
        "pixel_mas": exported.pixel_mas,
        "field_mas": exported.field_mas,
        "n_pixels": exported.n_pixels,
        "notes": list(exported.notes),
    }
    common.finish(arguments, content, lambda: _summary(exported, path))
    return 0


def _summary(exported: Export, path: Path) -> list[str]:
    lines = [
        f"written     {path}",
        f"image       {exported.n_pixels} pixels of {exported.pixel_mas:.4g} mas "
        f"({exported.field_mas:.4g} mas)",
    ]
    lines += [f"note        {note}" for note in exported.notes]
    return [*lines, f"next        {exported.command(path)}"]
