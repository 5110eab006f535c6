"""``amibayes vet``: keep or drop each calibrator."""

from __future__ import annotations

import argparse

from amibayes.cli.options import common, data_options
from amibayes.errors import UsageError
from amibayes.support.options import VETTING_ALPHA, VETTING_NULL_DRAWS

RESULT, PICTURE = "vetting.json", "vetting.png"

EXAMPLES = """examples:
  amibayes vet cal*.oifits
  amibayes vet vetted_star_*.oifits --calibrated --separation 20:250
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``vet``."""
    parser.epilog = EXAMPLES
    parser.add_argument("calibrators", nargs="+", metavar="CAL", help="OIFITS files or image cubes")
    group = parser.add_argument_group("tests")
    group.add_argument(
        "--calibrated",
        action="store_true",
        help="the files are calibrated already: test each by itself, not against the others",
    )
    data_options.add_separation(group)
    group.add_argument(
        "--alpha",
        type=common.probability,
        default=VETTING_ALPHA,
        help="probability of chance of each test below which a calibrator is dropped "
        "(default: %(default)s)",
    )
    data_options.add_null_draws(group, VETTING_NULL_DRAWS, least=1)
    group.add_argument("--no-limits", action="store_true", help="leave the limits out")
    group.add_argument(
        "--charge-levels",
        type=common.numbers,
        metavar="LIST",
        help="charge level (or brightness) of the target, then of each calibrator",
    )
    data_options.add_closure_covariance(group)
    data_options.add_insname(group)
    data_options.add_cal_target(group)
    data_options.add_reduction(group)
    data_options.add_calibrator_diameters(group)
    common.add_seed_option(group)
    common.add_image_options(parser)
    common.add_output_options(parser, "vet")


def run(arguments: argparse.Namespace) -> int:
    """Test the calibrators and write the verdicts."""
    common.configure_logging(arguments)
    common.refuse_repeated(arguments.calibrators)
    levels = arguments.charge_levels
    from amibayes.calibration import diameters_of, reduce_data, without_disc
    from amibayes.extraction.reading import charge_of, check_together, of_one_visit
    from amibayes.pipeline.options import SearchOptions
    from amibayes.pipeline.prepare import read_calibrators
    from amibayes.pipeline.vetting import vet
    from amibayes.plots.style import save
    from amibayes.report.noise import migration_json, migration_lines
    from amibayes.report.vetting import vetting_json, vetting_picture, vetting_table
    from amibayes.support.atomic_files import output_folder, write_json

    folder = output_folder(arguments.out, [RESULT, PICTURE], overwrite=arguments.overwrite)
    check_together([], arguments.calibrators)
    images = of_one_visit(arguments.calibrators, common.image_options_of(arguments))
    reading = SearchOptions(
        images=images,
        insname=arguments.insname,
        cal_target=arguments.cal_target,
        closure_covariance=arguments.closure_covariance,
    )
    data = read_calibrators(arguments.calibrators, reading)
    if levels is not None and len(levels) != 1 + len(data):
        raise UsageError(
            f"needs {1 + len(data)} numbers, the target's first", source="--charge-levels"
        )
    data = [reduce_data(each, **data_options.reduction_of(arguments)) for each in data]
    diameters = diameters_of(arguments.calibrator_diameters, data)
    if diameters is not None:
        data = [without_disc(d, *size) for d, size in zip(data, diameters, strict=True)]
    vetting = vet(
        data,
        calibrated=arguments.calibrated,
        separation_mas=arguments.separation,
        alpha=arguments.alpha,
        null_draws=arguments.null_draws,
        limits=not arguments.no_limits,
        charge_levels=levels,
        seed=arguments.seed,
    )
    content = vetting_json(vetting)
    save(vetting_picture(vetting), folder / PICTURE)
    write_json(folder / RESULT, content)
    charge = charge_of(arguments.calibrators, images)
    last = [*migration_lines(migration_json(charge, None)), f"written to {folder}"]
    common.finish(arguments, content, lambda: vetting_table(vetting, last))
    return 0
