"""``amibayes validate``: coverage and error rates on simulated exposures."""

from __future__ import annotations

import argparse

from amibayes.cli.options import common, workers

RESULT, PAGE, JOURNAL = "validation.json", "validation.html", "journal"

EXAMPLES = """examples:
  amibayes validate
  amibayes validate --full --workers 8
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``validate``."""
    parser.epilog = EXAMPLES
    size = parser.add_mutually_exclusive_group()
    size.add_argument(
        "--quick", action="store_true", help="36 stars, five minutes of one core (the default)"
    )
    size.add_argument("--full", action="store_true", help="3002 stars, a day of one core")
    common.add_seed_option(parser)
    workers.add_parallel_options(parser)
    parser.add_argument(
        "--resume", action="store_true", help="go on from the trials that are finished"
    )
    common.add_output_options(parser, "validate")


def run(arguments: argparse.Namespace) -> int:
    """Simulate, analyse, check, and write what came out."""
    common.configure_logging(arguments)
    from amibayes.plots.style import save
    from amibayes.report.page import read_figure, write_page
    from amibayes.report.validation import (
        PICTURES,
        validation_json,
        validation_page,
        validation_pictures,
        validation_table,
    )
    from amibayes.support.atomic_files import output_folder, write_json
    from amibayes.validation import FULL, QUICK, validate

    pngs = [f"{name}.png" for name, *_ in PICTURES.values()]
    folder = output_folder(
        arguments.out, [RESULT, PAGE, *pngs], overwrite=arguments.overwrite or arguments.resume
    )
    with (
        workers.executor_of(arguments) as executor,
        common.progress_of(arguments, "validate", unit="star") as progress,
    ):
        validation = validate(
            FULL if arguments.full else QUICK,
            arguments.seed,
            executor=executor,
            journal=folder / JOURNAL,
            resume=arguments.resume,
            progress=progress,
        )
    for name, drawing in validation_pictures(validation).items():
        save(drawing, folder / f"{name}.png")
    figures = {
        name: read_figure(folder / f"{name}.png", title, text)
        for name, title, text in PICTURES.values()
    }
    content = validation_json(validation)
    write_page(folder / PAGE, validation_page(validation, figures, arguments.out))
    write_json(folder / RESULT, content)
    common.finish(
        arguments, content, lambda: [*validation_table(validation), f"written to {folder}"]
    )
    return 0
