"""``amibayes image``: a reconstructed image, for looking."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from amibayes.cli.options import common, data_options
from amibayes.support.options import OBSERVABLES

if TYPE_CHECKING:
    from amibayes.pipeline.imaging import ImagingOptions

RESULT, IMAGE, PICTURE = "image.json", "image.fits", "image.png"

EXAMPLES = """examples:
  amibayes image target.oifits --cal cal*.oifits
  amibayes image calibrated.oifits --regulariser entropy --field 600 --pixel 15

an image is for looking: whether a disc, a ring or a companion is there, and how bright it is,
says amibayes search --models
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``image``."""
    parser.epilog = EXAMPLES
    parser.add_argument(
        "targets", nargs="*", metavar="TARGET", help="OIFITS file(s) or image cube(s)"
    )
    parser.add_argument(
        "--cal", nargs="+", default=[], metavar="CAL", help="calibrators, any order"
    )
    group = parser.add_argument_group("image")
    group.add_argument(
        "--regulariser",
        choices=("tv", "entropy"),
        default="tv",
        help="total variation, which keeps edges, or maximum entropy, which is smooth (default: "
        "%(default)s)",
    )
    group.add_argument(
        "--weight",
        type=common.positive_float,
        metavar="W",
        help="of the regulariser (default: chosen by cross-validation)",
    )
    group.add_argument(
        "--field",
        type=common.positive_float,
        metavar="MAS",
        help="side of the image (default: λ/B of the shortest baseline to either side, less where "
        "the sky repeats itself)",
    )
    group.add_argument(
        "--pixel",
        type=common.positive_float,
        metavar="MAS",
        help="side of a pixel (default: a quarter of λ/2B)",
    )
    group.add_argument(
        "--star",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="a star in the middle is no part of the image (default: yes)",
    )
    group.add_argument(
        "--diameter",
        type=common.number_or_free,
        metavar="MAS|free",
        help="of the star, a uniform disc; free: fitted with the image (default: free where V2 "
        "would notice 0.3 mas, else 0)",
    )
    common.add_seed_option(group)
    _add_data(parser.add_argument_group("data"))
    common.add_image_options(parser)
    common.add_output_options(parser, "image")


def _add_data(data: argparse._ArgumentGroup) -> None:
    data_options.add_observables(data, OBSERVABLES, "which to use (default: both)")
    data_options.add_reduction(data)
    data_options.add_closure_covariance(data)
    data_options.add_calibration(data)
    data_options.add_calibrator_diameters(data)
    data_options.add_keep_all(data)
    data_options.add_insname(data)
    data_options.add_target(data)
    data_options.add_cal_target(data)


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct the image and write its files."""
    common.configure_logging(arguments)
    common.refuse_repeated(arguments.targets, arguments.cal)
    from amibayes.pipeline.imaging import make_image
    from amibayes.plots.reconstruction import image_plot
    from amibayes.plots.style import save
    from amibayes.report.reconstruction import imaging_json, imaging_summary, save_image_fits
    from amibayes.support.atomic_files import output_folder, write_json
    from amibayes.support.request import request_of

    options = _options(arguments)
    folder = output_folder(arguments.out, [RESULT, IMAGE, PICTURE], overwrite=arguments.overwrite)
    with common.stages_of(arguments) as progress:
        report = make_image(
            arguments.targets,
            arguments.cal,
            options,
            announce=progress.stage,
            progress=progress.update,
        )
    save(image_plot(report.image), folder / PICTURE)
    save_image_fits(folder / IMAGE, report.image)
    request = request_of(arguments.targets, arguments.cal, options)
    content = imaging_json(report, request)
    write_json(folder / RESULT, content)
    common.finish(arguments, content, lambda: imaging_summary(content, folder))
    return 0


def _options(arguments: argparse.Namespace) -> ImagingOptions:
    from amibayes.pipeline.imaging import ImagingOptions
    from amibayes.pipeline.options import SearchOptions

    search = SearchOptions(
        observables=arguments.observables,
        diameter=arguments.diameter,
        **data_options.reading_settings(arguments),
    )
    return ImagingOptions(
        search,
        arguments.regulariser,
        arguments.weight,
        arguments.field,
        arguments.pixel,
        arguments.star,
    )
