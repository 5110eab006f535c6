"""The results of a validation: ``validation.json``, its pictures and ``validation.html``."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure as Drawing

from amibayes import __version__
from amibayes.plots.validation import (
    alarm_plot,
    completeness_plot,
    coverage_plot,
    rank_plot,
)
from amibayes.report.common import number
from amibayes.report.page import Column, Fact, Figure, Page, Section, Statement, Table
from amibayes.validation import Check, Validation
from amibayes.validation.plan import RANGES
from amibayes.validation.tally import SURPRISING
from amibayes.validation.trial import RANKED

COLUMNS = (
    Column("Check", "text"),
    Column("Trials"),
    Column("Measured"),
    Column("Expected"),
    Column("Error"),
    Column("p"),
    Column("Verdict", "text"),
)

EXPLAINED = {
    "ranks": "Truths drawn from the prior must have uniform ranks in their posteriors "
    "(simulation-based calibration, Talts et al. 2018). Measured is the Kolmogorov–Smirnov "
    "distance; expected and error are its mean and scatter for a correct implementation.",
    "coverage": "A 68 % interval must hold the truth 68 times in 100.",
    "false alarms": "Among stars without a companion, a false-alarm probability below p must "
    "come up with probability p.",
    "completeness": "Companions must be found as often as the detection limits of the same data "
    "state.",
    "second companion": "Beside the one companion of a star a second one must not be found more "
    "often than its false-alarm probability says.",
    "verdicts": "The model is right in every trial: it may be refused, and a single star called a "
    "companion, no more often than stated.",
}

PICTURES = {
    "ranks": (
        "ranks",
        "Ranks of the truths",
        "How far the truths' ranks stray from uniform.",
    ),
    "false alarms": (
        "false_alarms",
        "False alarms",
        "Share of stars without a companion that reach a stated false-alarm probability.",
    ),
    "coverage": ("coverage", "Coverage", "Share of intervals that hold the truth."),
    "completeness": (
        "completeness",
        "Expected and found",
        "Share of companions found against the completeness that the limits state.",
    ),
}
"""Group of checks → file name, title and description of its picture."""


QUANTITIES = {
    "east_mas": "east",
    "north_mas": "north",
    "separation_mas": "separation",
    "position_angle_deg": "position angle",
    "delta_mag": "magnitude difference",
}


def validation_json(validation: Validation) -> dict[str, Any]:
    """Build the content of ``validation.json``."""
    plan = validation.plan
    return {
        "amibayes": __version__,
        "seed": validation.seed,
        "plan": plan.name,
        "passed": validation.passed,
        "n_trials": len(validation.kind),
        "settings": [dict(vars(setting)) for setting in plan.settings],
        "contrasts": {kind: list(limits) for kind, limits in RANGES.items()},
        "null_draws": plan.null_draws,
        "alpha": plan.alpha,
        "checks": [_check_json(check) for check in validation.checks],
        "trials": _trials_json(validation),
    }


def _check_json(check: Check) -> dict[str, Any]:
    return {
        "group": check.group,
        "name": check.name,
        "n": check.n,
        "measured": number(check.measured),
        "expected": number(check.expected),
        "error": number(check.error),
        "p_value": float(check.p_value),
        "passed": check.passed,
    }


def _trials_json(validation: Validation) -> dict[str, Any]:
    def listed(array: Any) -> Any:
        return [listed(x) if np.ndim(x) else number(x) for x in array]

    columns = (
        "false_alarm_probability",
        "truth",
        "rank",
        "covered",
        "found",
        "expected",
        "statement",
        "second",
    )
    return {"kind": list(validation.kind)} | {
        name: listed(getattr(validation, name)) for name in columns
    }


def validation_pictures(validation: Validation) -> dict[str, Drawing]:
    """Draw the pictures, by file name without its ending."""
    ranks = {kind: validation.rank[validation.of_kind(kind)] for kind in RANGES}
    coverage = {
        plainly(c.name).replace(" interval of ", " "): (c.expected, c.measured, c.error)
        for c in validation.checks
        if c.group == "coverage"
    }
    alone = validation.false_alarm_probability[validation.of_kind("alone")]
    companions = validation.of_kind(*RANGES)
    return {
        "ranks": rank_plot(ranks, ("East", "North", "Contrast")[: len(RANKED)]),
        "false_alarms": alarm_plot(alone),
        "coverage": coverage_plot(coverage),
        "completeness": completeness_plot(
            validation.expected[companions], validation.found[companions]
        ),
    }


def validation_page(validation: Validation, figures: dict[str, Figure], folder: str) -> Page:
    """Lay out ``validation.html``; ``figures`` by file name without its ending."""
    checks = validation.checks
    failed = [c for c in checks if not c.passed]
    sections = [_section(validation, group, figures) for group in EXPLAINED]
    return Page(
        "amibayes validate",
        "Coverage and error rates on simulated exposures",
        f"{len(validation.kind)} simulated stars from photons to limits, "
        f"{validation.plan.name} plan, seed {validation.seed}",
        _statement(len(checks), failed),
        _tiles(validation),
        (*sections, _what_was_done(validation, folder)),
    )


def verdict(n_checks: int, failed: list[Check]) -> str:
    """Sum the outcome up in one sentence."""
    if not failed:
        return f"All {n_checks} checks hold."
    return f"{len(failed)} of {n_checks} checks fail: {'; '.join(c.name for c in failed)}."


def _statement(n_checks: int, failed: list[Check]) -> Statement:
    chance = 1.0 - (1.0 - SURPRISING) ** n_checks
    return Statement(
        "none" if not failed else "open",
        "Passed" if not failed else "Failed",
        verdict(n_checks, failed),
        (
            f"Each check fails by chance with probability {SURPRISING:g}; at least one of "
            f"{n_checks} with {chance:.2g}.",
        ),
    )


def _tiles(validation: Validation) -> tuple[Fact, ...]:
    by_name = {c.name: c for c in validation.checks}
    alarm, found = by_name["share below 0.05"], by_name["the same, near the limit"]
    wide = by_name["68% interval of separation_mas"]
    return (
        Fact("Separations in their 68 % interval", _share(wide)),
        Fact("Lone stars below a false-alarm probability of 0.05", _share(alarm)),
        Fact("Companions near the limit that were found", _share(found), _stated_share(found)),
    )


def _share(check: Check) -> str:
    if not np.isfinite(check.measured):
        return f"too few trials ({check.n})"
    return f"{check.measured:.3f} ± {check.error:.3f}"


def _stated_share(check: Check) -> str:
    return f"stated: {check.expected:.3f}" if np.isfinite(check.expected) else ""


def _section(validation: Validation, group: str, figures: dict[str, Figure]) -> Section:
    rows = tuple(_row(c) for c in validation.checks if c.group == group)
    caption = f"Checks of {group}"
    return Section(
        group.capitalize(),
        (EXPLAINED[group],),
        tables=(Table(caption, COLUMNS, rows),),
        figures=(figures[PICTURES[group][0]],) if group in PICTURES else (),
    )


def _row(check: Check) -> tuple[str, ...]:
    def shown(x: float) -> str:
        return f"{x:.3f}" if np.isfinite(x) else "–"

    verdict_text = "holds" if check.passed else "FAILS"
    return (
        plainly(check.name),
        str(check.n),
        shown(check.measured),
        shown(check.expected),
        shown(check.error),
        f"{check.p_value:.2g}" if np.isfinite(check.measured) else "–",
        verdict_text if np.isfinite(check.measured) else "too few",
    )


def plainly(name: str) -> str:
    """A check's name with its quantities as a reader calls them."""
    for quantity, called in QUANTITIES.items():
        name = name.replace(quantity, called)
    return name.replace("% interval", "\u00a0% interval")


def _what_was_done(validation: Validation, folder: str) -> Section:
    plan = validation.plan
    exposures = "; ".join(str(setting) for setting in plan.settings)
    ranges = "; ".join(f"{kind} {low:g} to {high:g}" for kind, (low, high) in RANGES.items())
    return Section(
        "What was done",
        (
            "Every star is simulated as NIRISS images of a G2V star of magnitude 6 with photon, "
            "read and flat noise, jitter and dithers, together with its calibrators, and the files "
            "are given to the function that `amibayes search` runs: the verdict, intervals, limits "
            "and probabilities are those it writes. The prior of the contrast is the range that "
            "truths were drawn from.",
            f"Exposures, in turn: {exposures}. "
            f"Contrasts, log-uniform: {ranges}. {plan.null_draws} null draws; detection at "
            f"{plan.alpha:g}.",
        ),
        code=f"amibayes validate --{plan.name} --seed {validation.seed} --out {folder}",
    )


def validation_table(validation: Validation) -> list[str]:
    """Lay the checks out as lines of text, at most 20."""
    failed = [c for c in validation.checks if not c.passed]
    shown = failed or [c for c in validation.checks if c.group != "ranks"]
    lines = [
        f"{'check':<52}{'n':>6}{'measured':>10}{'expected':>10}{'error':>8}{'p':>9}",
        *(_line(c) for c in shown[:16]),
    ]
    return [*lines, verdict(len(validation.checks), failed)]


def _line(check: Check) -> str:
    if not np.isfinite(check.measured):
        return f"{check.name:<52}{check.n:>6}{'too few':>10}"
    return (
        f"{check.name:<52}{check.n:>6}{check.measured:>10.3f}{check.expected:>10.3f}"
        f"{check.error:>8.3f}{check.p_value:>9.2g}"
    )
