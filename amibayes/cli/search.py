"""``amibayes search``: the main job."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from amibayes.cli.options import batch, common, data_options, workers
from amibayes.cli.options.drawing import Drawing
from amibayes.support.options import EVIDENCE_METHODS, OBSERVABLES, SAMPLERS

if TYPE_CHECKING:
    from amibayes.parallel import Journals
    from amibayes.pipeline.options import SearchOptions
    from amibayes.pipeline.report_types import SearchReport

RESULT, REPORT = "result.json", "report.html"
PICTURES = (".png", ".fits")
"""Of the files that are written: the pictures, and the numbers of the maps."""

CHAIN, JOURNAL = "posterior.h5", "search.journal"
CALIBRATED, CALIBRATED_KP = "calibrated.oifits", "calibrated_kpfits.fits"

EXAMPLES = """examples:
  amibayes search target.oifits --cal cal*.oifits
  amibayes search epoch1.oifits epoch2.oifits --separation 50:400 --observables cp
  amibayes search pionier.oifits --diameter free --separation 1:50 --out axcir
  amibayes search target.oifits --models star,companion,ring,crescent
  amibayes search --batch targets.ecsv --workers 4
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``search``."""
    parser.epilog = EXAMPLES
    batch.add_inputs(parser)
    data_options.add_model(parser.add_argument_group("model"))
    data_options.add_joint(parser.add_argument_group("several files"))
    _add_comparison(parser.add_argument_group("prior and evidence"))
    data = parser.add_argument_group("data")
    data_options.add_observables(data, OBSERVABLES, "which observables to fit (default: both)")
    data_options.add_data(data)
    common.add_image_options(parser)
    stages = parser.add_argument_group("stages")
    data_options.add_null_draws(stages, None)
    stages.add_argument("--no-posterior", action="store_true", help="leave the posterior out")
    stages.add_argument(
        "--bootstrap",
        type=common.non_negative_integer,
        default=0,
        metavar="N",
        help="fit N times to exposures drawn anew, for intervals beside the posterior's",
    )
    stages.add_argument("--no-limits", action="store_true", help="leave detection limits out")
    data_options.add_picture_option(stages)
    stages.add_argument(
        "--resume",
        action="store_true",
        help="go on with a run that was cut off; with --batch, leave finished targets",
    )
    common.add_seed_option(stages)
    workers.add_parallel_options(parser, of_one=True)
    common.add_output_options(parser, "search")


def _add_comparison(group: argparse._ArgumentGroup) -> None:
    group.add_argument(
        "--prior",
        action="append",
        default=[],
        type=common.prior_setting,
        metavar="NAME=PRIOR",
        help="contrast=LOW:HIGH, contrast=log-uniform|uniform, contrast=uniform:LOW:HIGH; "
        "position=area|separation (uniform in area, or in separation and angle); "
        "diameter=LOW:HIGH in mas or background=LOW:HIGH where they are free (uniform); may be "
        "repeated (default: contrast=log-uniform:1e-5:1 position=area)",
    )
    group.add_argument(
        "--companions",
        type=common.companion_counts,
        metavar="0,1,2",
        help="numbers of companions whose evidences are compared; 2 searches for a second one and "
        "fits both (default: 0,1 with the posterior)",
    )
    data_options.add_models(group, "default: star,companion, without the confusion matrix")
    group.add_argument(
        "--evidence-method",
        choices=(*EVIDENCE_METHODS[:2], *SAMPLERS),
        default=EVIDENCE_METHODS[0],
        help="integrate directly, or by Laplace's approximation, or by nested sampling with "
        "dynesty (default: %(default)s)",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the main job, for one target or for each of a table, and write its files."""
    common.configure_logging(arguments)
    if arguments.batch is not None:
        return batch.run_batch(arguments)
    report, folder, content = perform(arguments)
    common.finish(arguments, content, lambda: _summary(report, folder))
    return 0


def perform(arguments: argparse.Namespace) -> tuple[SearchReport, Path, dict[str, object]]:
    """Run the main job for one target and write its files, without printing."""
    batch.refuse_none(arguments)
    common.refuse_repeated(arguments.targets, arguments.cal)
    from amibayes.parallel import Journals
    from amibayes.support.atomic_files import output_folder
    from amibayes.support.request import refuse_other

    options = _options(arguments)
    overwrite = arguments.overwrite or arguments.resume
    several = len(arguments.targets) > 1
    names = _names(options, calibrated=bool(arguments.cal), several=several)
    if arguments.no_pictures:
        names = [name for name in names if Path(name).suffix not in PICTURES]
    folder = output_folder(arguments.out, names, overwrite=overwrite)
    asked = request(arguments)
    if arguments.resume and not arguments.overwrite:
        refuse_other(folder / RESULT, asked, folder / JOURNAL)
    journals = Journals(folder / JOURNAL, asked, resume=arguments.resume)
    with Drawing(arguments, folder, journals.path / "pictures") as drawing:
        with journals.telling(folder / CHAIN):
            report = _search(arguments, options, folder, journals, drawing)
        for stale in _stale(names, report):
            (folder / stale).unlink(missing_ok=True)
        content = _write(arguments, report, folder, asked, drawing)
    journals.remove()
    return report, folder, content


def _names(options: SearchOptions, *, calibrated: bool, several: bool) -> list[str]:
    """List the files of a run."""
    from amibayes.plots.pictures import picture_names

    names = [RESULT, REPORT, *picture_names(options, calibrated=calibrated, several=several)]
    names += [CHAIN] if options.posterior else []
    return [*names, CALIBRATED, CALIBRATED_KP] if calibrated or options.library else names


def _stale(names: list[str], report: SearchReport) -> set[str]:
    """Files of earlier runs that this one has none of."""
    from amibayes.plots.pictures import PICTURES, pictures_of

    every, mine = {p.file for p in PICTURES}, {p.file for p in pictures_of(report)}
    others = _names(type(report.options)(), calibrated=True, several=True)
    return (every | set(others)) - set(names) | (every - mine)


def request(arguments: argparse.Namespace) -> str:
    """Digest all that the answer depends on."""
    from amibayes.support.request import request_of

    return request_of(arguments.targets, arguments.cal, _options(arguments))


def _search(
    arguments: argparse.Namespace,
    options: SearchOptions,
    folder: Path,
    journals: Journals,
    drawing: Drawing,
) -> SearchReport:
    from amibayes.pipeline.search import search_companion

    with (
        workers.executor_of_one(arguments) as executor,
        common.stages_of(arguments) as progress,
    ):
        return search_companion(
            arguments.targets,
            arguments.cal,
            options,
            chain=folder / CHAIN,
            resume=arguments.resume,
            journals=journals,
            announce=progress.stage,
            progress=progress.update,
            executor=executor,
            early=drawing.begin,
        )


def _options(arguments: argparse.Namespace) -> SearchOptions:
    from amibayes.pipeline.options import SearchOptions

    return SearchOptions(
        **data_options.search_settings(arguments),
        observables=arguments.observables,
        null_draws=arguments.null_draws,
        posterior=not arguments.no_posterior,
        limits=not arguments.no_limits,
        companions=arguments.companions,
        models=arguments.models,
        bootstrap=arguments.bootstrap,
        evidence_method=arguments.evidence_method,
        prior=tuple(arguments.prior),
    )


def _write(
    arguments: argparse.Namespace,
    report: SearchReport,
    folder: Path,
    request: str,
    drawing: Drawing,
) -> dict[str, object]:
    """Write everything but the chain; the result last: where it is, the run is finished."""
    from amibayes.errors import AmibayesError
    from amibayes.kpfits import write_observables
    from amibayes.report import captioned, explorer_data, result_json, search_page, write_page
    from amibayes.support.atomic_files import write_json

    if report.calibration is not None:
        write_observables(folder / CALIBRATED, report.observables)
    content = result_json(report, request)
    try:
        drawn = drawing.finish(report)
    except AmibayesError:
        raise  # a full disk, say: --resume goes on once there is room
    except Exception:
        # A fault of a picture would end every further run too: the numbers need no picture.
        write_json(folder / RESULT, content)
        raise
    figures = captioned(folder, [path.name for path in drawn])
    words = common.command_line(arguments)
    write_page(folder / REPORT, search_page(content, figures, words, explorer_data(report)))
    write_json(folder / RESULT, content)
    return content


def _summary(report: SearchReport, folder: Path) -> list[str]:
    from amibayes.report import summary

    return summary(report, folder)


__all__ = ["add_arguments", "run"]
