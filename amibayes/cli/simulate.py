"""``amibayes simulate``: the images that the telescope would record of a scene."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amibayes import __version__
from amibayes.cli.options.common import (
    add_output_options,
    add_seed_option,
    configure_logging,
    finish,
    positive_float,
    progress_of,
)
from amibayes.cli.options.workers import add_parallel_options, executor_of
from amibayes.errors import UsageError
from amibayes.support.terminal import shortened

if TYPE_CHECKING:
    from amibayes.parallel import Executor, Journals, Progress
    from amibayes.simulation.observe import PreparedExposure
    from amibayes.simulation.program import ExposureSpec, Program

JOURNAL = "simulate.journal"

EPILOG = """examples:
  amibayes simulate --example > scene.toml
  amibayes simulate scene.toml --out images
  amibayes simulate scene.toml --filter F480M --photons 1e9 --workers 2
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.epilog = EPILOG
    parser.add_argument("scene", nargs="?", metavar="SCENE.toml", help="what to observe, and how")
    parser.add_argument(
        "--example", action="store_true", help="print a documented SCENE.toml and leave"
    )
    parser.add_argument("--filter", metavar="NAME", help="in place of the file's filter")
    parser.add_argument(
        "--photons",
        type=positive_float,
        metavar="N",
        help="in place of the file's photons and n_integrations",
    )
    parser.add_argument("--resume", action="store_true", help="go on with a run that was cut off")
    parser.add_argument("--ramps", action="store_true", help="write the reads too (*_ramp.fits)")
    add_seed_option(parser)
    add_parallel_options(parser)
    add_output_options(parser, "simulate")


def run(arguments: argparse.Namespace) -> int:
    """Simulate every exposure of the file."""
    configure_logging(arguments)
    from amibayes.simulation.program import Overrides, example, read_program

    if arguments.example:
        print(example(), end="")
        return 0
    if arguments.scene is None:
        raise UsageError("no scene is given", remedy="amibayes simulate --example > scene.toml")
    overrides = Overrides(arguments.filter, arguments.photons, arguments.ramps)
    program = read_program(arguments.scene, overrides)
    done = observe(arguments, program)
    content = {"amibayes": __version__, "seed": arguments.seed, "exposures": done}
    finish(arguments, content, lambda: summary(done))
    return 0


def observe(arguments: argparse.Namespace, program: Program) -> list[dict[str, Any]]:
    """Take and write the exposures; describe each."""
    from amibayes.parallel import Journals
    from amibayes.simulation.observe import ramp_path
    from amibayes.simulation.program import naming_source
    from amibayes.support.atomic_files import output_folder
    from amibayes.support.request import digest

    names = [spec.file_name for spec in program.specs]
    names += [ramp_path(Path(n)).name for n in names if program.keeps_ramps]
    overwrite = arguments.overwrite or arguments.resume
    folder = output_folder(arguments.out, names, overwrite=overwrite)
    key = digest(program, arguments.seed)
    journals = Journals(folder / JOURNAL, key, resume=arguments.resume)
    done = []
    with executor_of(arguments) as executor, naming_source(arguments.scene):
        for spec, prepared in program.prepared_exposures(arguments.seed):
            path = folder / spec.file_name
            with progress_of(arguments, spec.name, unit="integration") as progress:
                take(path, prepared, executor, program.history, progress, journals)
            done.append(described(spec, prepared, path))
    journals.remove()
    return done


def take(
    path: Path,
    prepared: PreparedExposure,
    executor: Executor,
    history: tuple[str, ...],
    progress: Progress,
    journals: Journals,
) -> None:
    """Take and write an exposure, unless a run that was cut off has finished it."""
    from amibayes.simulation.observe import write_exposure

    finished = journals.of(f"{path.stem}-finished")
    if finished.read(0) is not None and path.is_file():
        return
    pieces = journals.of(path.stem)
    write_exposure(path, prepared, executor, history=history, progress=progress, journal=pieces)
    finished.write(0, {"finished": True})
    pieces.remove()


def described(spec: ExposureSpec, prepared: PreparedExposure, path: Path) -> dict[str, Any]:
    """Describe an exposure in plain numbers."""
    import numpy as np

    from amibayes.units import MAS

    observation, exposure = prepared.observation, prepared.observation.exposure
    pixel = observation.instrument.pixel_scale_rad / MAS
    ramp = exposure.n_groups * observation.detector.frame_time_s
    rate = prepared.recorder.rate_e_s
    return {
        "path": str(path),
        "name": observation.scene.name,
        "calibrator": bool(observation.notes["IS_PSF"]),
        "instrument": observation.instrument.name,
        "filter": observation.instrument.bandpass.name,
        "n_groups": exposure.n_groups,
        "n_integrations": exposure.n_integrations,
        "count_rate_e_s": rate,
        "total_photons": rate * observation.scene.flux * ramp * exposure.n_integrations,
        "position_angle_deg": float(np.degrees(observation.orientation.position_angle_rad)),
        "dither_mas": (prepared.pointings.dither_px * pixel).tolist(),
    }


def summary(done: list[dict[str, Any]]) -> list[str]:
    """List what was made."""
    lines = [
        f"{entry['path']}  {entry['filter']}  {entry['n_groups']} groups, "
        f"{entry['n_integrations']} integrations, {entry['total_photons']:.3g} photons"
        for entry in done
    ]
    return shortened(lines)
