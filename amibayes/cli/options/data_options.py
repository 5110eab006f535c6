"""Options on how data are read and calibrated: one name, one meaning, in every command."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from amibayes.cli.options import common
from amibayes.errors import UsageError
from amibayes.support.options import (
    CLIP_CALIBRATORS,
    NOISE_PRIOR,
    NULL_DRAWS,
    SKY_MODELS,
    CalibrationMethod,
    ClosureCovariance,
    ContrastSharing,
    choices,
)


def add_picture_option(group: argparse._ActionsContainer) -> None:
    """Add ``--no-pictures``."""
    group.add_argument(
        "--no-pictures",
        action="store_true",
        help="write no pictures, which take most of the time of a short run",
    )


def add_calibration(group: argparse._ActionsContainer) -> None:
    """Add ``--calibration`` and ``--clip``."""
    group.add_argument(
        "--calibration",
        choices=choices(CalibrationMethod),
        help="how calibrators are combined (default: population with --library, else hierarchical "
        "where 2 or more share a baseline)",
    )
    group.add_argument(
        "--library",
        type=Path,
        metavar="FILE",
        help="calibrators of other nights that are used beside --cal, as calibrate "
        "--add-to-library keeps them",
    )
    group.add_argument(
        "--clip",
        type=common.positive_float,
        default=CLIP_CALIBRATORS,
        metavar="SIGMA",
        help="leave out values that are outliers among the calibrators (default: %(default)s)",
    )


def add_calibrator_diameters(group: argparse._ActionsContainer) -> None:
    """Add ``--calibrator-diameters``."""
    group.add_argument(
        "--calibrator-diameters",
        metavar="LIST|TABLE",
        help="uniform-disc diameters in mas, in the order of the calibrators, as 0.31:0.02,0.4 "
        "(value:error); or a table (ECSV, CSV, FITS) with columns name, diameter_mas, error_mas, "
        "whose name is that of the file or of its target",
    )


def add_reduction(group: argparse._ActionsContainer) -> None:
    """Add what may be flagged and averaged before anything else."""
    group.add_argument(
        "--flag",
        action="append",
        default=[],
        metavar="RULE|FILE",
        help="flag data of target and calibrators, as 'vis2>1.1', 'cp_error_deg>20' or "
        "'station=A1', or by a file of such rules, one a line; may be given again",
    )
    group.add_argument(
        "--average-polarisations",
        action="store_true",
        help="average instrument tables that differ in a last P1, P2",
    )
    group.add_argument(
        "--bin-channels",
        type=common.positive_integer,
        default=1,
        metavar="N",
        help="average N adjacent channels",
    )
    group.add_argument(
        "--merge-epochs",
        type=common.positive_float,
        metavar="DAYS",
        help="average the target's exposures within this time, while (u, v) stays",
    )


def reduction_of(arguments: argparse.Namespace) -> dict[str, Any]:
    """Collect the options of `add_reduction`, as `reduce_data` takes them."""
    return {
        "flag": tuple(rule for given in arguments.flag for rule in _rules(given)),
        "polarisations": arguments.average_polarisations,
        "channels": arguments.bin_channels,
        "epochs_days": arguments.merge_epochs,
    }


def _rules(given: str) -> list[str]:
    """A rule, or those of a file: one a line, # begins a comment.

    Raises
    ------
    UsageError
        Where the file is no text.
    """
    if not Path(given).is_file():
        return [given]
    try:
        lines = Path(given).read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(
            "is no file of rules", source=given, remedy="give text, a rule in each line"
        ) from error
    return [rule for line in lines if (rule := line.split("#")[0].strip())]


def add_closure_covariance(group: argparse._ActionsContainer) -> None:
    """Add ``--closure-covariance``."""
    group.add_argument(
        "--closure-covariance",
        choices=choices(ClosureCovariance),
        default=choices(ClosureCovariance)[0],
        help="for files with errors and no correlations: triangles correlated through shared "
        "baselines, or (the field's habit) independent (default: %(default)s)",
    )


def add_insname(group: argparse._ActionsContainer) -> None:
    """Add ``--insname``."""
    group.add_argument("--insname", metavar="NAME", help="use one instrument table of the files")


def add_target(group: argparse._ActionsContainer) -> None:
    """Add ``--target``."""
    group.add_argument("--target", metavar="NAME", help="use one target of files that hold several")


def add_cal_target(group: argparse._ActionsContainer) -> None:
    """Add ``--cal-target``."""
    group.add_argument(
        "--cal-target",
        type=lambda text: tuple(text.split(",")),
        default=(),
        metavar="NAMES",
        help="calibrators of files that hold several stars (default: all but the target)",
    )


def add_keep_all(group: argparse._ActionsContainer) -> None:
    """Add ``--keep-all``."""
    group.add_argument(
        "--keep-all", action="store_true", help="use every calibrator, whatever vetting finds"
    )


def add_separation(group: argparse._ActionsContainer) -> None:
    """Add ``--separation``."""
    group.add_argument(
        "--separation",
        type=common.number_range,
        metavar="MIN:MAX",
        help="field in mas (default: lambda/2B_max to lambda/B_min of the data)",
    )


def add_null_draws(group: argparse._ActionsContainer, default: int | None, least: int = 0) -> None:
    """Add ``--null-draws``; without a default it is chosen by what a search costs."""
    stated = "%(default)s" if default else f"{NULL_DRAWS}, fewer where data are many"
    group.add_argument(
        "--null-draws",
        type=common.non_negative_integer if least == 0 else common.positive_integer,
        default=default,
        metavar="N",
        help="null searches for the false-alarm probability"
        f"{'; 0: none' if least == 0 else ''} (default: {stated})",
    )


def add_model(group: argparse._ActionsContainer) -> None:
    """Add field, primary and channel: what is fitted."""
    add_separation(group)
    group.add_argument(
        "--diameter",
        type=common.number_or_free,
        metavar="MAS|free",
        help="diameter of the primary (default: free where V2 is used, or where the contrast that "
        "closure phases alone give depends on it, else 0)",
    )
    group.add_argument(
        "--limb-darkening",
        type=common.number_or_free,
        metavar="ALPHA|free",
        help="brightness of the primary's disc goes as mu to the power of ALPHA (default: 0, a "
        "uniform disc; free where V2 reaches past the disc's first null)",
    )
    group.add_argument(
        "--companion-diameter",
        type=common.number_or_free,
        metavar="MAS|free",
        help="uniform-disc diameter of companions (default: 0; free where data show the disc "
        "of the companion that is found)",
    )
    group.add_argument(
        "--contrast-slope",
        type=common.any_number_or_free,
        default=0.0,
        metavar="P|free",
        help="the flux ratio goes with wavelength to the power of P (default: 0)",
    )
    group.add_argument(
        "--background",
        type=common.number_or_free,
        default=0.0,
        metavar="FLUX|free",
        help="over-resolved flux, primary = 1 (default: 0)",
    )
    group.add_argument(
        "--smearing",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="average the model over the width of each channel (default: yes)",
    )


def add_joint(group: argparse._ActionsContainer) -> None:
    """Add what several files share."""
    group.add_argument(
        "--contrast",
        choices=choices(ContrastSharing),
        help="one contrast for all bands, or one for each (default: per-filter where the files "
        "are of several bands)",
    )
    group.add_argument(
        "--motion",
        action="store_true",
        help="the companion moves linearly between the dates of the files",
    )
    group.add_argument(
        "--fastest",
        type=common.positive_float,
        metavar="MAS/YR",
        help="largest rate of a motion along east and along north (default: lambda/B_max over "
        "the time between the first and the last date)",
    )
    group.add_argument(
        "--file-noise",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="fit noise beyond the stated errors to every file by itself (default: yes)",
    )


def search_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Collect what `add_model`, `add_joint`, `add_data`, images and seed give `SearchOptions`.

    Raises
    ------
    UsageError
        For a largest rate without a motion, or a way to combine calibrators without any.
    """
    if arguments.fastest and not arguments.motion:
        raise UsageError("needs a motion", source="--fastest", remedy="give --motion")
    if arguments.calibration and not (arguments.cal or arguments.library):
        raise UsageError("needs calibrators", source="--calibration", remedy="give --cal FILES")
    if arguments.calibrator_diameters and not arguments.cal:
        raise UsageError(
            "needs calibrators", source="--calibrator-diameters", remedy="give --cal FILES"
        )
    return reading_settings(arguments) | {
        "separation_mas": arguments.separation,
        "diameter": arguments.diameter,
        "background": arguments.background,
        "limb_darkening": arguments.limb_darkening,
        "companion_diameter": arguments.companion_diameter,
        "contrast_slope": arguments.contrast_slope,
        "smearing": arguments.smearing,
        "library": arguments.library,
        "contrast": arguments.contrast,
        "motion": arguments.motion,
        "fastest_mas_yr": arguments.fastest,
        "extra_noise": arguments.extra_noise,
        "channel_noise": arguments.channel_noise,
        "noise_prior": arguments.noise_prior,
        "systematics": arguments.systematics,
        "robust": arguments.robust,
        "keep_outliers": arguments.keep_outliers,
        "file_noise": arguments.file_noise,
    }


def reduction_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Collect what `SearchOptions` has on what is flagged and averaged."""
    reduction = reduction_of(arguments)
    return {
        "flag": reduction["flag"],
        "average_polarisations": reduction["polarisations"],
        "bin_channels": reduction["channels"],
        "merge_epochs_days": reduction["epochs_days"],
    }


def reading_settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Collect what `SearchOptions` has on how data are read, reduced and calibrated."""
    return reduction_settings(arguments) | {
        "calibrator_diameters": arguments.calibrator_diameters,
        "closure_covariance": arguments.closure_covariance,
        "calibration": arguments.calibration,
        "clip": arguments.clip,
        "keep_all": arguments.keep_all,
        "insname": arguments.insname,
        "target": arguments.target,
        "cal_target": arguments.cal_target,
        "seed": arguments.seed,
        "images": common.image_options_of(arguments),
    }


def add_observables(
    group: argparse._ActionsContainer, default: tuple[str, ...] | None, explained: str
) -> None:
    """Add ``--observables``."""
    group.add_argument(
        "--observables",
        type=common.observable_kinds,
        default=default,
        metavar="vis2,cp",
        help=explained,
    )


def add_models(group: argparse._ActionsContainer, otherwise: str) -> None:
    """Add ``--models``; ``otherwise`` is what is done without."""
    group.add_argument(
        "--models",
        type=common.sky_models,
        metavar="LIST",
        help="models of the sky that are compared, with the confusion matrix of the data: out of "
        f"{', '.join(SKY_MODELS)}, or some joined as ring+companion ({otherwise})",
    )


def add_data(group: argparse._ActionsContainer) -> None:
    """Add how data are read, calibrated and selected."""
    add_reduction(group)
    add_closure_covariance(group)
    add_calibration(group)
    add_calibrator_diameters(group)
    add_keep_all(group)
    group.add_argument(
        "--extra-noise",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="add noise where the stated errors do not explain the residuals (default: yes)",
    )
    group.add_argument(
        "--channel-noise",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="fit what the channels of an exposure share of the noise (default: yes)",
    )
    group.add_argument(
        "--noise-prior",
        type=common.pair_of_numbers,
        default=NOISE_PRIOR,
        metavar="VIS2,DEG",
        help="widths of the prior of extra noise, of V² as a share of it and of closure phases; "
        "three times as much is the most (default: 0.05,3)",
    )
    group.add_argument(
        "--systematics",
        type=common.systematics,
        default="table",
        metavar="VIS2,DEG|table|none",
        help="floor of calibration errors that channels of an exposure share: of a table by "
        "instrument, for files of fewer than 10 exposures (default), or share of V² and degrees",
    )
    add_insname(group)
    group.add_argument(
        "--robust",
        action="store_true",
        help="Student-t residuals: outliers lose their weight, in search, null draws, limits and "
        "posterior",
    )
    group.add_argument(
        "--keep-outliers",
        action="store_true",
        help="use the few baselines or triangles of single exposures, too, that the best fit to "
        "all others is far from explaining",
    )
    add_target(group)
    add_cal_target(group)
