"""Options on how data are read and calibrated: one name, one meaning, in every command."""

from __future__ import annotations

import argparse

from amibayes.cli import common


def add_calibration(group: argparse._ActionsContainer) -> None:
    """Add ``--calibration`` and ``--clip``."""
    group.add_argument(
        "--calibration",
        choices=["weighted", "hierarchical"],
        help="how calibrators are combined (default: hierarchical with 3 or more)",
    )
    group.add_argument(
        "--clip",
        type=common.positive_float,
        default=3.0,
        metavar="SIGMA",
        help="leave out values that stand off the other calibrators (default: %(default)s)",
    )


def add_closure_covariance(group: argparse._ActionsContainer) -> None:
    """Add ``--closure-covariance``."""
    group.add_argument(
        "--closure-covariance",
        choices=["assumed", "diagonal"],
        default="assumed",
        help="for files with errors and no correlations: triangles correlated through shared "
        "baselines, or (the field's habit) independent (default: %(default)s)",
    )


def add_insname(group: argparse._ActionsContainer) -> None:
    """Add ``--insname``."""
    group.add_argument("--insname", metavar="NAME", help="use one instrument table of the files")


def add_separation(group: argparse._ActionsContainer) -> None:
    """Add ``--separation``."""
    group.add_argument(
        "--separation",
        type=common.number_range,
        metavar="MIN:MAX",
        help="field in mas (default: lambda/2B_max to lambda/B_min of the data)",
    )


def add_null_draws(group: argparse._ActionsContainer, default: int, least: int = 0) -> None:
    """Add ``--null-draws``."""
    group.add_argument(
        "--null-draws",
        type=common.non_negative_integer if least == 0 else common.positive_integer,
        default=default,
        metavar="N",
        help="null searches for the false-alarm probability"
        f"{'; 0: none' if least == 0 else ''} (default: %(default)s)",
    )
