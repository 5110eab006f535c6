"""Options that mean one thing in every command."""

from __future__ import annotations

import argparse
import logging
import math
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

from amibayes.errors import UsageError
from amibayes.support.options import (
    COMPANIONS,
    EXTRACTION_METHODS,
    OBSERVABLES,
    SEED,
    SKY_MODELS,
)

if TYPE_CHECKING:
    from amibayes.extraction.reading import ImageOptions
    from amibayes.parallel import Progress, StageBars
    from amibayes.posterior.priors import PriorSetting


def add_output_options(parser: argparse.ArgumentParser, command: str) -> None:
    """Add ``--out``, ``--overwrite``, ``--json`` and how much is printed."""
    group = parser.add_argument_group("output")
    group.add_argument(
        "--out",
        default=f"amibayes-{command}",
        metavar="DIR",
        help="folder for the results (default: %(default)s)",
    )
    group.add_argument(
        "--overwrite", action="store_true", help="replace results that are there already"
    )
    add_speech_options(group)


def add_speech_options(group: argparse._ActionsContainer) -> None:
    """Add ``--json`` and how much is printed."""
    group.add_argument(
        "--json",
        action="store_true",
        help="print the result as JSON on standard output and nothing else there",
    )
    amount = group.add_mutually_exclusive_group()
    amount.add_argument("--quiet", action="store_true", help="no progress, no summary")
    amount.add_argument("--verbose", action="store_true", help="report every stage and its seconds")
    group.add_argument("--debug", action="store_true", help="show the traceback of an error")


def add_image_options(parser: argparse.ArgumentParser) -> None:
    """Add what image cubes may need: what their header does not state, and the method."""
    group = parser.add_argument_group("image cubes")
    group.add_argument("--instrument", metavar="NAME", help="name or TOML file, such as niriss")
    group.add_argument("--filter", metavar="NAME", help="such as F480M")
    group.add_argument("--pixel-scale", type=positive_float, metavar="MAS", help="side of a pixel")
    group.add_argument(
        "--position-angle",
        type=finite_float,
        metavar="DEG",
        help="of the image's +y, east of north",
    )
    group.add_argument(
        "--bad-flags",
        type=lambda text: tuple(text.split(",")),
        metavar="NAMES",
        help="data quality flags of pixels that are not used, as in JWST files (default: "
        "DO_NOT_USE,NON_SCIENCE,DEAD,REFERENCE_PIXEL)",
    )
    group.add_argument(
        "--temperature",
        type=positive_float,
        metavar="K",
        help="blackbody in place of the stars' spectrum (default: as many photons at every "
        "wavelength of the filter)",
    )
    group.add_argument(
        "--charge-migration",
        type=charge_migration,
        default="fit",
        metavar="fit|VALUE|off",
        help="charge that passes between pixels: fitted to ramps, and the instrument's value for "
        "slopes (fit); displacement of pixels' sides, pixels per electron; or left in (off) "
        "(default: %(default)s)",
    )
    group.add_argument(
        "--method",
        choices=tuple(EXTRACTION_METHODS),
        default=next(iter(EXTRACTION_METHODS)),
        help="fit of the images (fringes), or a way to sample their Fourier transform "
        "(default: %(default)s)",
    )


def image_options_of(arguments: argparse.Namespace) -> ImageOptions:
    """Collect the options for image cubes."""
    from amibayes.extraction import ExtractOptions
    from amibayes.extraction.reading import ImageOptions
    from amibayes.units import MAS

    header = {
        "instrument": arguments.instrument,
        "filter": arguments.filter,
        "pixel_scale_rad": arguments.pixel_scale * MAS if arguments.pixel_scale else None,
        "position_angle_deg": arguments.position_angle,
        "bad_flags": _flags(arguments.bad_flags),
    }
    extraction = ExtractOptions(
        method=arguments.method,
        temperature_k=arguments.temperature,
        charge_migration=arguments.charge_migration,
    )
    return ImageOptions(extraction, header)


def _flags(names: tuple[str, ...] | None) -> tuple[str, ...] | None:
    """Check the names of data quality flags."""
    from amibayes.cube.container import flag_bits

    if names is not None:
        flag_bits(names)
    return names


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None


def finite_float(text: str) -> float:
    """Parse a finite number."""
    value = _number(text)
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not finite")
    return value


def charge_migration(text: str) -> float | str:
    """Parse ``fit``, ``off`` or a number."""
    return text if text in ("fit", "off") else finite_float(text)


def add_seed_option(parser: argparse._ActionsContainer) -> None:
    """Add ``--seed``: the same seed gives the same result."""
    parser.add_argument(
        "--seed",
        type=non_negative_integer,
        default=SEED,
        metavar="N",
        help="seed of all random numbers (default: %(default)s)",
    )


OF_THE_RUN = {
    "--out": 1, "--batch": 1, "--cal-pool": 1, "--cal-number": 1, "--workers": 1, "--scheduler": 1,
    "--overwrite": 0, "--resume": 0,
    "--json": 0, "--quiet": 0, "--verbose": 0, "--debug": 0, "--no-pictures": 0,
}  # fmt: skip
"""Options that leave the numbers of a result alone, and how many words follow each."""


def without(words: list[str], flags: dict[str, int]) -> list[str]:
    """Leave options out of a command line, with the words that belong to them."""
    kept, belonging = [], 0
    for word in words:
        flag = word.split("=")[0]
        if flag in flags:
            belonging = 0 if "=" in word else flags[flag]
        elif belonging and not word.startswith("--"):
            belonging -= 1
        else:
            belonging = 0
            kept.append(word)
    return kept


def command_line(arguments: argparse.Namespace) -> str:
    """Give the command that gets the same numbers again, with its seed."""
    import shlex

    words = without(arguments.words, OF_THE_RUN)
    if not any(word.split("=")[0] == "--seed" for word in words):
        words += ["--seed", str(arguments.seed)]
    return shlex.join(["amibayes", *words])


def progress_of(
    arguments: argparse.Namespace, description: str, *, unit: str = "piece", scale: float = 1.0
) -> AbstractContextManager[Progress]:
    """Open a progress bar, unless ``--quiet``."""
    from amibayes.parallel import progress_bar

    return progress_bar(description, unit=unit, scale=scale, quiet=arguments.quiet)


def stages_of(
    arguments: argparse.Namespace, *, unit: str = "piece"
) -> AbstractContextManager[StageBars]:
    """Open one progress bar after the other for a job of several stages, unless ``--quiet``."""
    from amibayes.parallel import stage_bars

    return stage_bars(unit=unit, quiet=arguments.quiet, verbose=arguments.verbose)


def positive_integer(text: str) -> int:
    """Parse an integer above zero."""
    value = non_negative_integer(text)
    if value == 0:
        raise argparse.ArgumentTypeError("0 is not a positive number")
    return value


def non_negative_integer(text: str) -> int:
    """Parse an integer that is not negative."""
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text} is negative")
    return value


def positive_float(text: str) -> float:
    """Parse a finite number above zero."""
    value = _number(text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def number_range(text: str) -> tuple[float, float]:
    """Parse ``LOW:HIGH`` with 0 ≤ LOW < HIGH."""
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not LOW:HIGH") from None
    if not 0.0 <= low < high < float("inf"):
        raise argparse.ArgumentTypeError(f"{text!r} needs 0 <= LOW < HIGH")
    return low, high


def pair_of_numbers(text: str) -> tuple[float, float]:
    """Parse ``A,B``, neither below zero."""
    try:
        first, second = (float(word) for word in text.split(","))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not A,B") from error
    if not (0.0 <= first < math.inf and 0.0 <= second < math.inf):
        raise argparse.ArgumentTypeError(f"{text!r} holds a number below zero, or infinite")
    return first, second


def systematics(text: str) -> str | tuple[float, float]:
    """Parse ``table``, ``none`` or ``VIS2,DEG``."""
    return text if text in ("table", "none") else pair_of_numbers(text)


def configure_logging(arguments: argparse.Namespace) -> None:
    """Send the program's log and the libraries' warnings where they belong: standard error."""
    level = logging.DEBUG if arguments.verbose else logging.WARNING
    logging.basicConfig(stream=sys.stderr, level=level, format="amibayes: %(message)s")
    for chatty in ("matplotlib", "PIL", "h5py"):
        logging.getLogger(chatty).setLevel(logging.WARNING)
    if not arguments.debug:
        warnings.simplefilter("ignore")


def refuse_repeated(paths: Sequence[str], calibrators: Sequence[str] = ()) -> None:
    """Refuse a file that was given twice, under whatever name.

    A file of several stars may be one of targets and one of calibrators.

    Raises
    ------
    UsageError
        Naming the file.
    """
    seen: set[Path] = set()
    for given in (paths, calibrators):
        own: set[Path] = set()
        for path in given:
            resolved = Path(path).resolve()
            if resolved in own or (resolved in seen and not _holds_several(path)):
                raise UsageError("is given twice", source=path, remedy="give every file once")
            own.add(resolved)
        seen |= own


def _holds_several(path: str) -> bool:
    from amibayes.pipeline.prepare import stars_of

    return len(stars_of(path)) > 1


def number_or_free(text: str) -> float | str:
    """Parse a number that is not negative, or the word ``free``."""
    if text == "free":
        return text
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is neither a number nor 'free'") from None
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} is negative or not finite")
    return value


def any_number_or_free(text: str) -> float | str:
    """Parse a finite number of any sign, or the word ``free``."""
    return text if text == "free" else finite_float(text)


def probability(text: str) -> float:
    """Parse a number between 0 and 1, both left out."""
    value = positive_float(text)
    if value >= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is not below 1")
    return value


def numbers(text: str) -> list[float]:
    """Parse positive numbers with commas between them."""
    try:
        return [positive_float(part) for part in text.split(",")]
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is no list of numbers: {error}") from None


def observable_kinds(text: str) -> tuple[str, ...]:
    """Parse ``vis2,cp``: one or both, once each."""
    kinds = text.split(",")
    if not set(kinds) <= set(OBSERVABLES) or len(set(kinds)) != len(kinds):
        raise argparse.ArgumentTypeError(f"{text!r} is not vis2, cp or vis2,cp")
    return tuple(sorted(kinds, reverse=True))


def companion_counts(text: str) -> tuple[int, ...]:
    """Parse ``0,1,2``: one or more of them, once each, in rising order."""
    counts = text.split(",")
    if not set(counts) <= {str(n) for n in COMPANIONS} or len(set(counts)) != len(counts):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list out of 0,1,2")
    return tuple(sorted(int(c) for c in counts))


def sky_models(text: str) -> tuple[str, ...]:
    """Parse ``star,companion,ring``: models of the sky, once each."""
    names = tuple(text.split(","))
    unknown = [n for n in names if not set(n.split("+")) <= set(SKY_MODELS)]
    if unknown or len(set(names)) != len(names):
        listed = ",".join(SKY_MODELS)
        raise argparse.ArgumentTypeError(
            f"{text!r} is no list out of {listed}, or of some joined as ring+companion"
        )
    return names


def prior_setting(text: str) -> PriorSetting:
    """Parse ``NAME=[FORM:]LOW:HIGH`` or ``NAME=FORM``."""
    from amibayes.posterior.priors import parse_setting

    try:
        return parse_setting(text)
    except UsageError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def finish(
    arguments: argparse.Namespace, content: object, summary: Callable[[], list[str]]
) -> None:
    """Print the JSON or the summary, as was asked for."""
    if arguments.json:
        from amibayes.support.atomic_files import to_json

        sys.stdout.write(to_json(content))
    elif not arguments.quiet:
        print("\n".join(summary()))
