"""``amibayes calibrate``: a target freed of its instrument by calibrators."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from amibayes.cli import common, data_options
from amibayes.errors import DataError, UsageError

if TYPE_CHECKING:
    from amibayes.calibration import Calibration
    from amibayes.data.observables import Observables

RESULT = "calibrated.oifits"

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
        "--cal", nargs="+", required=True, metavar="CAL", help="calibrators, any order"
    )
    _add_method(parser.add_argument_group("calibration"))
    _add_data(parser.add_argument_group("data"))
    common.add_image_options(parser)
    common.add_output_options(parser, "calibrate")


def _add_method(group: argparse._ArgumentGroup) -> None:
    data_options.add_calibration(group)
    group.add_argument(
        "--calibrator-diameters",
        metavar="LIST|TABLE",
        help="uniform-disc diameters in mas, in the order of --cal, as 0.31:0.02,0.4 "
        "(value:error); or a table (ECSV, CSV, FITS) with columns name, diameter_mas, error_mas, "
        "whose name is that of the file or of its target",
    )
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
    group.add_argument("--target", metavar="NAME", help="use one target of the target's files")
    group.add_argument(
        "--flag",
        action="append",
        default=[],
        metavar="RULE",
        help="flag data of target and calibrators, as 'vis2>1.1', 'cp_error_deg>20' or "
        "'station=A1'; may be given again",
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


def run(arguments: argparse.Namespace) -> int:
    """Calibrate and write the file."""
    common.configure_logging(arguments)
    common.refuse_repeated([*arguments.targets, *arguments.cal])
    import numpy as np

    from amibayes.calibration import calibrate
    from amibayes.extraction.reading import check_together
    from amibayes.oifits import write_oifits
    from amibayes.support.atomic_files import output_folder

    check_together(arguments.targets, arguments.cal)
    calibrators = _prepared(arguments.cal, arguments, target=None, one_star=False)
    targets = _prepared(arguments.targets, arguments, target=arguments.target)
    if arguments.merge_epochs:
        from amibayes.calibration import merge_epochs

        targets = [merge_epochs(target, arguments.merge_epochs) for target in targets]
    folder = output_folder(arguments.out, [RESULT], overwrite=arguments.overwrite)
    found = calibrate(
        targets,
        calibrators,
        method=arguments.calibration,
        clip=arguments.clip,
        diameters_mas=_diameters(arguments, calibrators),
        window_days=arguments.time_window,
        charge_levels=arguments.charge_levels,
        rng=np.random.default_rng(arguments.seed),
    )
    write_oifits(folder / RESULT, found.observables, overwrite=True)
    content = _json(arguments, found, folder)
    common.finish(arguments, content, lambda: _summary(found, folder))
    return 0


def _prepared(
    paths: list[str],
    arguments: argparse.Namespace,
    target: str | None,
    *,
    one_star: bool = True,
) -> list[Observables]:
    """Read files, flag, average."""
    from amibayes.calibration import average_polarisations, bin_channels, flag_by_rule
    from amibayes.extraction.reading import read_observations

    found = read_observations(
        paths,
        common.image_options_of(arguments),
        one_star=one_star,
        insname=arguments.insname,
        target=target,
        closure_covariance=arguments.closure_covariance,
    )
    if arguments.flag:
        found = [flag_by_rule(each, arguments.flag) for each in found]
    if arguments.average_polarisations:
        found = [average_polarisations(each) for each in found]
    if arguments.bin_channels > 1:
        found = [bin_channels(each, arguments.bin_channels) for each in found]
    return found


def _diameters(
    arguments: argparse.Namespace, calibrators: list[Observables]
) -> list[tuple[float, float]] | None:
    """Diameter and error of each calibrator, from the list or the table."""
    given = arguments.calibrator_diameters
    if given is None:
        return None
    if Path(given).is_file():
        return _from_table(given, calibrators)
    try:
        pairs = [tuple(float(x) for x in word.split(":")) for word in given.split(",")]
        found = [(p[0], p[1] if len(p) > 1 else 0.0) for p in pairs]
    except ValueError:
        raise UsageError(
            f"{given!r} is neither a table nor a list of diameters",
            source="--calibrator-diameters",
            remedy="give mas, as 0.31:0.02,0.4",
        ) from None
    if len(found) != len(calibrators):
        raise UsageError(
            f"{len(found)} diameters for {len(calibrators)} calibrators",
            source="--calibrator-diameters",
            remedy="give one for each, in the order of --cal",
        )
    return found


def _from_table(path: str, calibrators: list[Observables]) -> list[tuple[float, float]]:
    from astropy.table import Table

    try:
        table = Table.read(path)
        names = [str(name).strip().casefold() for name in table["name"]]
        values = [float(x) for x in table["diameter_mas"]]
        errors = [float(x) for x in table["error_mas"]] if "error_mas" in table.colnames else []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "is no table of diameters",
            source=path,
            remedy="give columns name, diameter_mas and, if known, error_mas",
        ) from error
    out = []
    for calibrator in calibrators:
        file = Path(calibrator.source)
        known = {file.name, file.stem, str(file), calibrator.setups[0].target}
        rows = [i for i, name in enumerate(names) if name in {k.casefold() for k in known}]
        if not rows:
            raise DataError(
                f"has no line for {calibrator.source} ({calibrator.setups[0].target})",
                source=path,
                remedy="name the file or its target",
            )
        out.append((values[rows[0]], errors[rows[0]] if errors else 0.0))
    return out


def _json(arguments: argparse.Namespace, found: Calibration, folder: Path) -> dict[str, object]:
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
        "output": str(folder / RESULT),
        "warnings": list(used.notes),
    }


def _summary(found: Calibration, folder: Path) -> list[str]:
    used = found.observables
    lines = [
        f"data        {used.n_vis2} V2, {used.n_closure_phases} closure phases, "
        f"{used.n_independent} independent ({used.covariance_kind} covariance)",
        f"method      {found.method}",
    ]
    if found.tau_vis2 is not None:
        lines.append(f"scatter     {found.tau_vis2:.3g} in V2 between calibrators")
    if found.tau_closure_phase_deg is not None:
        tau = found.tau_closure_phase_deg
        lines.append(f"scatter     {tau:.3g} deg in closure phase between calibrators")
    for use in found.calibrators[:10]:
        state = "kept" if use.kept else "not used"
        lines.append(f"calibrator  {use.path}: {state}{', ' if use.reason else ''}{use.reason}")
    if len(found.calibrators) > 10:
        lines.append(f"calibrator  and {len(found.calibrators) - 10} more")
    return [*lines, f"written     {folder / RESULT}"]
