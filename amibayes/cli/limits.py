"""``amibayes limits``: what companions the data would have shown."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from amibayes.cli.options import batch, common, data_options, workers
from amibayes.cli.options.drawing import draw
from amibayes.errors import UsageError
from amibayes.support.options import (
    LIMITS_NULL_DRAWS,
    LIMITS_SEPARATIONS,
    LIMITS_TRIALS,
    LimitCriterion,
    choices,
)

if TYPE_CHECKING:
    from amibayes.pipeline.limits import LimitsOptions, LimitsReport

RESULT, TABLE, MAP, JOURNAL = "limits.json", "limits.ecsv", "completeness.png", "limits.journal"

EXAMPLES = """examples:
  amibayes limits target.oifits --cal cal*.oifits
  amibayes limits calibrated.oifits --separation 50:400 --criterion candid
  amibayes limits target.oifits --mass-table tracks.ecsv --primary-magnitude 3.2 --workers 4
  amibayes limits --batch targets.ecsv --workers 4
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``limits``."""
    parser.epilog = EXAMPLES
    batch.add_inputs(parser)
    _add_limit(parser.add_argument_group("limit"))
    data_options.add_model(parser.add_argument_group("model"))
    data_options.add_joint(parser.add_argument_group("several files"))
    data = parser.add_argument_group("data")
    data_options.add_observables(
        data, None, "limits from these alone (default: from both, and from each by itself)"
    )
    data_options.add_data(data)
    common.add_image_options(parser)
    workers.add_parallel_options(parser, of_one=True)
    common.add_output_options(parser, "limits")


def _add_limit(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--criterion",
        choices=choices(LimitCriterion),
        default=choices(LimitCriterion)[0],
        help="injection and recovery by the search's own criterion, or a closed criterion of the "
        "literature (default: %(default)s)",
    )
    group.add_argument(
        "--separations",
        type=common.positive_integer,
        default=LIMITS_SEPARATIONS,
        metavar="N",
        help="how many, over the whole field (default: %(default)s)",
    )
    group.add_argument(
        "--trials",
        type=common.positive_integer,
        default=LIMITS_TRIALS,
        metavar="N",
        help="companions injected per separation at most; large data get fewer, until the limit is "
        "known to 0.03 mag (default: %(default)s)",
    )
    group.add_argument(
        "--null-draws",
        type=common.non_negative_integer,
        metavar="N",
        help="null searches for the false-alarm probability; 0: none (default: "
        f"{LIMITS_NULL_DRAWS}, fewer where each is dear; closed criteria need them only to decide "
        "whether a companion is taken out first)",
    )
    group.add_argument(
        "--mass-table",
        metavar="FILE",
        help="ECSV or CSV with columns mass and delta_mag (or absolute_mag), for masses",
    )
    group.add_argument(
        "--primary-magnitude",
        type=common.finite_float,
        metavar="M",
        help="absolute magnitude of the star, for a table of absolute magnitudes",
    )
    data_options.add_picture_option(group)
    group.add_argument(
        "--resume",
        action="store_true",
        help="go on with a run that was cut off; with --batch, leave finished targets",
    )
    data_options.add_models(
        group, "then also the limit beside the disc or ring that is stated; default: none"
    )
    common.add_seed_option(group)


def run(arguments: argparse.Namespace) -> int:
    """Measure the limits of one target, or of each of a table; a finished run is shown again."""
    common.configure_logging(arguments)
    if arguments.batch is not None:
        return batch.run_batch(arguments)
    from amibayes.report import limits_summary

    content, folder = perform(arguments)
    common.finish(arguments, content, lambda: limits_summary(content, folder))
    return 0


def perform(arguments: argparse.Namespace) -> tuple[Any, Path]:
    """Measure the limits of one target and write their files, without printing."""
    batch.refuse_none(arguments)
    common.refuse_repeated(arguments.targets, arguments.cal)
    from amibayes.plots.contrast_curve import MIGRATION
    from amibayes.support.atomic_files import output_folder
    from amibayes.support.request import refuse_other

    options = _options(arguments)
    names = _names(options, pictures=not arguments.no_pictures)
    overwrite = arguments.overwrite or arguments.resume
    folder = output_folder(arguments.out, [*names, MIGRATION], overwrite=overwrite)
    request = _request(arguments, options)
    content = _finished(folder, names, request) if arguments.resume else None
    if content is None:
        if arguments.resume and not arguments.overwrite:
            refuse_other(folder / RESULT, request, folder / JOURNAL)
        content = _measure(arguments, options, folder, request)
        for stale in {MAP} - set(names):
            (folder / stale).unlink(missing_ok=True)
    return content, folder


def _names(options: LimitsOptions, *, pictures: bool) -> list[str]:
    """List the files of a run."""
    from amibayes.plots.contrast_curve import limits_picture_names

    return [RESULT, TABLE, *(limits_picture_names(options.criterion) if pictures else ())]


def request(arguments: argparse.Namespace) -> str:
    """Digest all that the answer depends on."""
    return _request(arguments, _options(arguments))


def _request(arguments: argparse.Namespace, options: LimitsOptions) -> str:
    from amibayes.support.request import request_of

    return request_of(arguments.targets, arguments.cal, options)


def _finished(folder: Path, names: list[str], request: str) -> Any:
    """Give the content of a finished run of the same request; None where there is none."""
    from amibayes.support.request import answers

    whole = all((folder / name).is_file() for name in names)
    return answers(folder / RESULT, request) if whole else None


def _measure(
    arguments: argparse.Namespace, options: LimitsOptions, folder: Path, request: str
) -> Any:
    """Do the work, keeping what is finished; the journal ends when all files are written."""
    from amibayes.parallel import Journals
    from amibayes.pipeline.limits import measure_limits
    from amibayes.report import limits_report_json

    journals = Journals(folder / JOURNAL, request, resume=arguments.resume)
    with (
        journals.telling(),
        workers.executor_of_one(arguments) as executor,
        common.stages_of(arguments) as progress,
    ):
        report = measure_limits(
            arguments.targets,
            arguments.cal,
            options,
            journals=journals,
            announce=progress.stage,
            progress=progress.update,
            executor=executor,
        )
    content = limits_report_json(report, request)
    _write(arguments, report, content, folder)
    journals.remove()
    return content


def _write(
    arguments: argparse.Namespace, report: LimitsReport, content: object, folder: Path
) -> None:
    from amibayes.plots.contrast_curve import MIGRATION, save_limits_pictures
    from amibayes.report import write_limits_table
    from amibayes.support.atomic_files import write_json

    (folder / MIGRATION).unlink(missing_ok=True)  # of an older run, that had ramps
    if not arguments.no_pictures:
        draw(arguments, save_limits_pictures, report, folder)
    write_limits_table(folder / TABLE, report)
    # Last: where it is, the run is finished.
    write_json(folder / RESULT, content)


def _options(arguments: argparse.Namespace) -> LimitsOptions:
    from amibayes.pipeline.limits import LimitsOptions
    from amibayes.pipeline.options import SearchOptions

    search = SearchOptions(
        **data_options.search_settings(arguments),
        null_draws=arguments.null_draws,
        models=arguments.models,
    )
    return LimitsOptions(
        search=search,
        criterion=arguments.criterion,
        observables=arguments.observables,
        n_separations=arguments.separations,
        trials=arguments.trials,
        masses=_masses(arguments),
    )


def _masses(arguments: argparse.Namespace) -> Any:
    if arguments.mass_table is None:
        if arguments.primary_magnitude is not None:
            raise UsageError(
                "needs a table", source="--primary-magnitude", remedy="give --mass-table FILE"
            )
        return None
    from amibayes.limits.mass_table import read_mass_table

    return read_mass_table(arguments.mass_table, arguments.primary_magnitude)


__all__ = ["add_arguments", "run"]
