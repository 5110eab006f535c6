"""``amibayes calibrate``: a target freed of its instrument by calibrators."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amibayes.cli.options import common, data_options
from amibayes.errors import UsageError
from amibayes.support.terminal import row, shortened

if TYPE_CHECKING:
    from amibayes.calibration import Calibration
    from amibayes.calibration.transfer import Diameter
    from amibayes.data.observables import Observables
    from amibayes.extraction.reading import ImageOptions
    from amibayes.pipeline.options import SearchOptions

RESULT, KERNEL_RESULT = "calibrated.oifits", "calibrated_kpfits.fits"

EXAMPLES = """examples:
  amibayes calibrate target.oifits --cal cal*.oifits
  amibayes calibrate t1.oifits t2.oifits --cal c1.oifits c2.oifits --time-window 0.1
  amibayes calibrate target.oifits --cal c1.oifits c2.oifits --calibrator-diameters 0.31:0.02,0.4
  amibayes calibrate gravity.fits --cal cal.fits --average-polarisations --flag 'vis2_error>0.1'
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``calibrate``."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "targets", nargs="+", metavar="TARGET", help="OIFITS file(s) or image cube(s)"
    )
    parser.add_argument(
        "--cal", nargs="+", default=[], metavar="CAL", help="calibrators, any order"
    )
    _add_method(parser.add_argument_group("calibration"))
    parser.add_argument(
        "--add-to-library",
        type=Path,
        metavar="FILE",
        help="keep the calibrators in this library of their instrument and filter",
    )
    _add_data(parser.add_argument_group("data"))
    common.add_image_options(parser)
    common.add_output_options(parser, "calibrate")


def _add_method(group: argparse._ArgumentGroup) -> None:
    data_options.add_calibration(group)
    data_options.add_calibrator_diameters(group)
    group.add_argument(
        "--charge-levels",
        type=common.numbers,
        metavar="LIST",
        help="charge level (or brightness) of the target, then of each calibrator, on which the "
        "response may depend (hierarchical)",
    )
    group.add_argument(
        "--time-window",
        type=common.positive_float,
        metavar="DAYS",
        help="use only calibrators observed within this time of each epoch (default: all)",
    )
    common.add_seed_option(group)


def _add_data(group: argparse._ArgumentGroup) -> None:
    data_options.add_closure_covariance(group)
    data_options.add_insname(group)
    data_options.add_target(group)
    data_options.add_cal_target(group)
    data_options.add_reduction(group)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate and write the file."""
    common.configure_logging(arguments)
    common.refuse_repeated(arguments.targets, arguments.cal)
    if not arguments.cal and arguments.library is None:
        raise UsageError("no calibrator given", remedy="give --cal FILES, or --library FILE")
    import numpy as np

    from amibayes.calibration import calibrate, diameters_of
    from amibayes.extraction.reading import charge_of, check_together, of_one_visit
    from amibayes.kpfits import write_observables
    from amibayes.pipeline.prepare import read, read_calibrators
    from amibayes.pipeline.warnings import calibrator_warnings
    from amibayes.report.noise import migration_json, migration_lines
    from amibayes.support.atomic_files import output_folder

    check_together(arguments.targets, arguments.cal)
    images = of_one_visit([*arguments.targets, *arguments.cal], common.image_options_of(arguments))
    reading = _reading(arguments, images)
    targets = read(arguments.targets, reading)
    calibrators = read_calibrators(arguments.cal, reading, targets)
    names = [RESULT, KERNEL_RESULT]
    folder = output_folder(arguments.out, names, overwrite=arguments.overwrite)
    diameters = diameters_of(arguments.calibrator_diameters, calibrators)
    serving, sizes, method = _with_library(arguments, targets, calibrators, diameters)
    found = calibrate(
        targets,
        serving,
        method=method,
        clip=arguments.clip,
        diameters_mas=sizes,
        window_days=arguments.time_window,
        charge_levels=arguments.charge_levels,
        rng=np.random.default_rng(arguments.seed),
    )
    write_observables(folder / RESULT, found.observables)
    if arguments.add_to_library is not None:
        _keep(arguments, calibrators, diameters)
    charge = charge_of([*arguments.targets, *arguments.cal], images)
    migration = migration_json(charge, found)
    warned = calibrator_warnings(
        targets,
        calibrators,
        sized=diameters is not None,
        drifting=found.method == "population",
    )
    content = _json(arguments, found, folder, warned) | {"charge_migration": migration}
    taken_out, told = migration_lines(migration), [*found.observables.notes, *warned]
    common.finish(arguments, content, lambda: _summary(found, folder, taken_out, told))
    return 0


def _with_library(
    arguments: argparse.Namespace,
    targets: list[Observables],
    calibrators: list[Observables],
    diameters: Sequence[Diameter] | None,
) -> tuple[list[Observables], Sequence[Diameter] | None, Any]:
    """Give calibrators, their diameters and the method, with those of a library."""
    if arguments.library is None:
        return calibrators, diameters, arguments.calibration
    from amibayes.calibration.library import read_library

    stored = read_library(arguments.library).without([*calibrators, *targets])
    sizes = [*(diameters or [(0.0, 0.0)] * len(calibrators)), *stored.diameters_mas]
    return [*calibrators, *stored.observables], sizes, arguments.calibration or "population"


def _keep(
    arguments: argparse.Namespace,
    calibrators: list[Observables],
    diameters: Sequence[Diameter] | None,
) -> None:
    """Add the calibrators to a library, with what the command line has of them."""
    from amibayes.calibration.calibrate import mean_mjd
    from amibayes.calibration.library import StarFacts, add_to_library

    levels = (arguments.charge_levels or [])[1:] or [float("nan")] * len(calibrators)
    sizes = diameters or [(0.0, 0.0)] * len(calibrators)
    facts = [
        StarFacts(Path(c.source).name, mean_mjd(c), level, "", "", *size)
        for c, level, size in zip(calibrators, levels, sizes, strict=True)
    ]
    add_to_library(arguments.add_to_library, calibrators, facts)


def _reading(arguments: argparse.Namespace, images: ImageOptions) -> SearchOptions:
    """Collect how files are read, flagged and averaged."""
    from amibayes.pipeline.options import SearchOptions

    return SearchOptions(
        images=images,
        insname=arguments.insname,
        target=arguments.target,
        cal_target=arguments.cal_target,
        closure_covariance=arguments.closure_covariance,
        **data_options.reduction_settings(arguments),
    )


def _json(
    arguments: argparse.Namespace, found: Calibration, folder: Path, warned: list[str]
) -> dict[str, object]:
    from amibayes import __version__
    from amibayes.support.atomic_files import sha256

    used = found.observables
    return {
        "amibayes": __version__,
        "seed": arguments.seed,
        "inputs": [
            {"path": path, "sha256": sha256(path), "role": role}
            for role, paths in (("target", arguments.targets), ("calibrator", arguments.cal))
            for path in paths
        ],
        "data": {
            "n_vis2": used.n_vis2,
            "n_closure_phases": used.n_closure_phases,
            "n_independent": used.n_independent,
            "covariance": used.covariance_kind,
        },
        "calibration": found.as_json(),
        "output": _written(found, folder),
        "warnings": [*used.notes, *warned],
    }


def _written(found: Calibration, folder: Path) -> str:
    """The file that holds the result; kernel phases have a format of their own."""
    kernels = found.observables.phase_name == "kernel phase" and not found.observables.n_vis2
    return str(folder / (KERNEL_RESULT if kernels else RESULT))


def _summary(
    found: Calibration, folder: Path, taken_out: list[str], warned: list[str]
) -> list[str]:
    used = found.observables
    lines = [
        f"data        {used.n_vis2} V2, {used.n_closure_phases} {used.phase_name}s, "
        f"{used.n_independent} independent ({used.covariance_kind} covariance)",
        f"method      {found.method}",
        *taken_out,
    ]
    if found.tau_vis2 is not None:
        lines.append(f"scatter     {found.tau_vis2:.3g} in V2 between calibrators")
    if found.tau_closure_phase_deg is not None:
        tau = found.tau_closure_phase_deg
        lines.append(f"scatter     {tau:.3g} deg in closure phase between calibrators")
    lines += [row("WARNING", text) for text in warned]
    for use in found.calibrators:
        state = "kept" if use.kept else "not used"
        lines.append(f"calibrator  {use.path}: {state}{', ' if use.reason else ''}{use.reason}")
    return shortened(lines, [row("written to", _written(found, folder))])
