"""``survey.html``: what the targets of a survey mean together, and a table that sorts."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from amibayes import __version__
from amibayes.report.page import Fact, Figure, Kind, Page, Section, Statement, environment
from amibayes.report.page import read_figure as read_png
from amibayes.report.words import count
from amibayes.support.atomic_files import write_text

Json = dict[str, Any]

MAX_ROWS = 3000
"""Rows that a browser sorts within a blink; the others are in ``survey.ecsv``."""

NONE = "–"


@dataclass(frozen=True)
class Column:
    """A column of the table of targets."""

    title: str
    name: str
    form: str
    meaning: str
    kind: str = "number"


COLUMNS = (
    Column("Target", "name", "", "Name of the target and of its folder", "name"),
    Column("Result", "result", "", "Verdict, or why it failed", "text"),
    Column("False alarm", "false_alarm_probability", ".2g", "False-alarm probability"),
    Column("FDR", "false_discovery_rate", ".2g", "Smallest false-discovery rate that lists it"),
    Column("Δχ²", "delta_chi2", ".1f", "Improvement of the fit by a companion"),
    Column("ρ (mas)", "separation_mas", ".1f", "Separation of the best fit"),
    Column("PA (deg)", "position_angle_deg", ".1f", "Position angle, east of north"),
    Column("Δm (mag)", "delta_mag", ".2f", "Magnitude difference of the best fit"),
    Column("Limit (mag)", "limit_delta_mag", ".2f", "Median detection limit"),
    Column("χ²ᵣ", "chi2r_binary", ".2f", "Reduced χ² of the best fit"),
)

TEXTS = {
    "survey.png": (
        "Limits and companions",
        "Detection limit of each target against separation, and the companions that are detected.",
    ),
    "survey_false_alarms.png": (
        "Quantiles of the false-alarm probabilities",
        "False-alarm probability of each target against the one that noise alone gives at its "
        "place in the order, those that are listed among all and the others among themselves; "
        "points of noise alone lie in the grey band, companions far below it.",
    ),
    "survey_completeness.png": (
        "Completeness",
        "Probability that a companion is detected, averaged over the targets, against separation "
        "and magnitude difference.",
    ),
    "survey_completeness_au.png": (
        "Completeness in physical units",
        "The same against projected separation in au, and mass where a table of masses is given.",
    ),
    "survey_frequency.png": (
        "Companion frequency",
        "Posterior of the share of stars that have a companion, with Jeffreys' prior.",
    ),
}


NO_LIMITS = {
    "survey.png": (
        "Companions",
        "Separation and magnitude difference of the companions that are detected; detection limits "
        "were not asked for.",
    ),
}
"""Of surveys without limits."""


@dataclass(frozen=True)
class _Cell:
    text: str
    value: float | None = None
    link: str = ""


@dataclass(frozen=True)
class _Mark:
    x: float
    y: float
    r: float
    kind: str


@dataclass(frozen=True)
class _Sky:
    blind: float
    marks: tuple[_Mark, ...]
    description: str


@dataclass(frozen=True)
class _Row:
    cells: tuple[_Cell, ...]
    sky: _Sky | None
    found: bool


@dataclass(frozen=True)
class _Table:
    caption: str
    columns: tuple[Column, ...]
    rows: tuple[_Row, ...]


def write_survey_page(path: Path, content: Json, pictures: Sequence[str], link: str) -> None:
    """Write the page of a survey, whole or not at all.

    Parameters
    ----------
    path : Path
    content : dict
        Of ``survey.json``.
    pictures : sequence of str
        Names of the pictures that are beside the page.
    link : str
        File of a target's folder that its name leads to.
    """
    texts = TEXTS if _has_limits(content) else TEXTS | NO_LIMITS
    figures = {name: read_png(path.parent / name, *texts[name]) for name in pictures}
    page = Page(
        command=f"amibayes {content['command']} --batch",
        title=f"Survey of {content['n_targets']} targets",
        subtitle=f"{content['n_done']} done, {content['n_failed']} failed, seed {content['seed']}",
        statement=_statement(content),
        facts=_facts(content),
        sections=_sections(content, figures),
    )
    template = environment().get_template("survey.html")
    text = template.render(page=page, table=_table(content, link), version=__version__)
    write_text(path, text.lstrip() + "\n")


def _statement(content: Json) -> Statement:
    alarms = content.get("false_alarms")
    if not alarms:
        done = f"{content['n_done']} of {content['n_targets']} targets are done"
        searched = any(entry.get("verdict") for entry in content["targets"])
        return Statement("open", "UNDECIDED" if searched else "NO SEARCH", done, _failed(content))
    n, level = len(alarms["discovered"]), alarms["false_discovery_level"]
    kind: Kind = "found" if n else "none"
    label = "COMPANIONS" if n else "NO COMPANION"
    head = f"{n or 'None'} of {alarms['n_tested']} targets {'is' if n < 2 else 'are'} listed"
    head += f" as {'a companion' if n < 2 else 'companions'} at a false-discovery rate of {level:g}"
    found = count(alarms["n_detected"], "target has", "targets have")
    sentences = (
        f"Taken one by one, {found} a companion detected (false-alarm "
        f"probability up to their α); {alarms['expected_false_detections']:.2g} such detections "
        "are expected of noise.",
        f"The smallest false-alarm probability is {alarms['smallest_probability']:.2g}. Were none "
        f"of the {alarms['n_tested']} stars to have a companion, one as small or smaller would "
        f"turn up with probability {alarms['survey_wide_probability']:.2g}.",
        *_uniformity(alarms),
        *_failed(content),
    )
    return Statement(kind, label, head, sentences)


def _uniformity(alarms: Json) -> list[str]:
    uniform = alarms["uniformity"]
    if uniform is None:
        return []
    told = f"The {uniform['n']} false-alarm probabilities above {uniform['above']:g} are "
    test = f"(Kolmogorov–Smirnov p = {uniform['p']:.2g})"
    if uniform["p"] > 0.01:
        return [f"{told}uniform, as those of stars without companions should be {test}."]
    return [f"{told}NOT uniform {test}: errors of many targets are wrong."]


def _failed(content: Json) -> tuple[str, ...]:
    n = content["n_failed"]
    return (f"{n} target{' has' if n == 1 else 's have'} failed; the table says why.",) if n else ()


def _facts(content: Json) -> tuple[Fact, ...]:
    facts = [Fact("Targets done", f"{content['n_done']} of {content['n_targets']}")]
    if alarms := content.get("false_alarms"):
        facts += [
            Fact("Listed companions", str(len(alarms["discovered"])), "by false-discovery rate"),
            Fact(
                "Survey-wide false alarm",
                f"{alarms['survey_wide_probability']:.2g}",
                "chance of one as good anywhere, of noise",
            ),
        ]
    if frequency := content.get("companion_frequency"):
        low, high = frequency["interval_68"]
        facts.append(
            Fact(
                "Companion frequency",
                f"{frequency['median']:.1%}",
                f"{low:.1%} to {high:.1%} (68 %), below {frequency['upper_95']:.1%} (95 %)",
            )
        )
        facts.append(Fact("Mean completeness", f"{frequency['mean_completeness']:.0%}"))
    return tuple(facts)


def _sections(content: Json, figures: dict[str, Figure]) -> tuple[Section, ...]:
    parts: tuple[tuple[str, tuple[str, ...], Callable[[Json], tuple[str, ...]]], ...] = (
        ("False alarms", ("survey_false_alarms.png",), _alarm_text),
        ("Limits" if _has_limits(content) else "Companions", ("survey.png",), lambda _: ()),
        (
            "Completeness",
            ("survey_completeness.png", "survey_completeness_au.png"),
            lambda _: (
                "A target counts with probability 0 outside of the field that was searched.",
            ),
        ),
        ("Companion frequency", ("survey_frequency.png",), _frequency_text),
    )
    return tuple(
        Section(title, text(content), figures=tuple(figures[n] for n in names if n in figures))
        for title, names, text in parts
        if any(n in figures for n in names)
    )


def _has_limits(content: Json) -> bool:
    return any(entry.get("limits") for entry in content["targets"])


def _alarm_text(content: Json) -> tuple[str, ...]:
    alarms = content["false_alarms"]
    return (
        "The false-discovery rate is the share of the listed companions that is noise, on "
        "average (Benjamini and Hochberg). A probability is counted from null searches, and is "
        "1 over their number at least: to list a companion that is alone among "
        f"{alarms['n_tested']} targets takes {alarms['null_draws_needed']} for each target "
        "(--null-draws).",
    )


def _frequency_text(content: Json) -> tuple[str, ...]:
    found = content["companion_frequency"]
    (inner, outer), (bright, faint) = found["separation_mas"], found["delta_mag"]
    return (
        f"Of {found['n_targets']} targets {found['n_detected']} are detected with a companion at "
        f"{inner:.3g} to {outer:.3g} mas and {bright:g} to {faint:g} mag. Companions are taken as "
        "uniform in the logarithm of separation and in magnitude there; each target counts with "
        "its completeness over them and its rate of false alarms.",
    )


def _table(content: Json, link: str) -> _Table:
    entries = sorted(content["targets"], key=_order)
    used = [c for c in COLUMNS if c.name in ("name", "result") or any(c.name in e for e in entries)]
    caption = "One row for each target; a heading sorts. The field has north up and east left."
    if len(entries) > MAX_ROWS:
        caption += f" {len(entries) - MAX_ROWS} more rows are in survey.ecsv."
    rows = tuple(_row(e, used, link) for e in entries[:MAX_ROWS])
    return _Table(caption, tuple(used), rows)


def _order(entry: Json) -> tuple[bool, float, str]:
    """Failed targets first, then by false-alarm probability."""
    p = entry.get("false_alarm_probability")
    return entry["status"] != "failed", 2.0 if p is None else p, entry["name"]


def _row(entry: Json, columns: Sequence[Column], link: str) -> _Row:
    cells = tuple(_cell(entry, column, link) for column in columns)
    return _Row(cells, _sky(entry), entry.get("detected") is True)


def _cell(entry: Json, column: Column, link: str) -> _Cell:
    if column.name == "name":
        done = entry["status"] == "done"
        return _Cell(entry["name"], link=f"{quote(entry['name'])}/{link}" if done else "")
    if column.name == "result":
        return _Cell(_result(entry))
    value = entry.get(column.name)
    if value is None or not math.isfinite(value):
        return _Cell(NONE)
    return _Cell(format(value, column.form), float(value))


def _result(entry: Json) -> str:
    if entry["status"] != "done":
        return f"failed: {entry['error']}" if entry["status"] == "failed" else "not yet done"
    detected = {True: "detected", False: "not detected", None: "not tested"}
    return str(entry.get("verdict") or detected[entry.get("detected")])


def _sky(entry: Json) -> _Sky | None:
    """Sketch the field: what is masked by the star, the best fit, other maxima."""
    field = entry.get("field_mas")
    if not field or not field[1]:
        return None
    scale = 20.0 / field[1]
    modes = [(m["separation_mas"], m["position_angle_deg"]) for m in entry.get("modes", [])]
    marks = [_mark(rho, pa, scale, 1.6, "mode") for rho, pa in modes[1:]]
    best = entry.get("separation_mas"), entry.get("position_angle_deg")
    words = "no companion fitted"
    if best[0] is not None and best[1] is not None:
        kind = "companion" if entry.get("detected") else "candidate"
        marks.append(_mark(best[0], best[1], scale, 2.4, kind))
        words = f"{kind} at {best[0]:.3g} mas, {best[1]:.0f} deg"
    description = f"{entry['name']}: field to {field[1]:.3g} mas, {words}"
    return _Sky(round(scale * field[0], 2), tuple(marks), description)


def _mark(rho: float, pa_deg: float, scale: float, r: float, kind: str) -> _Mark:
    pa = math.radians(pa_deg)
    # East is left, and y of a picture grows downwards.
    return _Mark(
        round(-rho * math.sin(pa) * scale, 2), round(-rho * math.cos(pa) * scale, 2), r, kind
    )
