"""``report.html`` of a search, from the content of ``result.json`` and the pictures."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from amibayes.plots.pictures import PICTURES
from amibayes.report.models import models_section
from amibayes.report.page import (
    Column,
    Fact,
    Figure,
    Page,
    Section,
    Table,
    read_figure,
)
from amibayes.report.sections import fit as fit_sections
from amibayes.report.sections.noise import noise
from amibayes.report.statement import (
    by_comparison,
    companion_stated,
    false_alarm,
    field,
    numbers_of_place,
    refused,
    sky_of,
    statement_of,
)
from amibayes.report.words import (
    chance,
    count,
    fixed,
    plain,
    sentence,
    tail,
)

Json = dict[str, Any]

COVARIANCE = {
    "diagonal": "every number independent of the others",
    "assumed": "triangles correlated through the baselines that they share",
    "given": "all correlations as the files give them",
    "estimated": "all correlations as estimated from the data",
}


def search_page(
    content: Json,
    figures: Sequence[Figure] = (),
    command: str = "",
    explored: Json | None = None,
) -> Page:
    """Lay a search out so that a referee can follow it.

    Parameters
    ----------
    content : dict
        As `amibayes.report.result_json` gives it, or as read back from ``result.json``.
    figures : sequence of Figure
    command : str
        The command line that gives the same result again.
    explored : dict, optional
        What a reader can move over, from `amibayes.report.explorer.explorer_data`.
    """
    names = content["data"].get("targets") or [
        Path(i["path"]).name for i in content["inputs"] if i["role"] == "target"
    ]
    found = {name: write(content) for name, write in SECTIONS.items()}
    sections = [
        replace(section, figures=tuple(f for f in figures if f.section == name))
        for name, section in found.items()
        if section is not None
    ]
    sections[0] = replace(sections[0], explorer=explored)
    return Page(
        "amibayes search",
        ", ".join(names),
        _subtitle(content),
        statement_of(content),
        _tiles(content),
        (*sections, *_others(figures), _again(content, command)),
        sky_of(content),
        tuple(sentence(w) for w in content["warnings"]),
    )


def captioned(folder: str | Path, names: Sequence[str]) -> list[Figure]:
    """Take the PNG files among ``names`` into figures; an unknown one is titled by its name.

    Parameters
    ----------
    folder : path
    names : sequence of str
        File names; those that are no PNG are left out.
    """
    known = {picture.file: picture for picture in PICTURES}
    figures = []
    for name in names:
        if not name.endswith(".png"):
            continue
        title = Path(name).stem.replace("_", " ").replace("-", " ").capitalize()
        shown = (title, f"Picture {name}.", "")
        if name in known:
            shown = known[name].title, known[name].text, known[name].section
        figures.append(read_figure(Path(folder) / name, *shown))
    return figures


def _others(figures: Sequence[Figure]) -> list[Section]:
    left = tuple(figure for figure in figures if figure.section not in SECTIONS)
    return [Section("More pictures", figures=left)] if left else []


def _subtitle(content: Json) -> str:
    data = content["data"]
    return (
        f"{', '.join(data['instruments'])}: {data['n_vis2']} squared visibilities and "
        f"{data['n_closure_phases']} {data.get('phases', 'closure phase')}s, "
        f"{data['n_independent']} independent numbers"
    )


def _tiles(content: Json) -> tuple[Fact, ...]:
    """The companion's numbers, or where none was detected those of what there is not."""
    chance_text = false_alarm(content["significance"])
    alarm = Fact("False-alarm probability", chance_text, "by noise, anywhere in the field")
    if companion_stated(content) is False:
        return (alarm, *_excluded(content))
    if content["fit"]["contrast"] <= 0.0 or refused(content):
        return (alarm,)
    label = "" if content["significance"]["detected"] else " (best fit)"
    label = " (of one companion)" if by_comparison(content) else label
    names = ("Separation", "Position angle", "Magnitude difference")
    texts = numbers_of_place(content, " mas", "")
    place = (Fact(f"{name}{label}", text) for name, text in zip(names, texts, strict=True))
    return (*place, alarm)


def _excluded(content: Json) -> Iterator[Fact]:
    """What a search without a detection rules out."""
    limits, posterior = content["limits"], content["posterior"]
    reached = [] if limits is None else [m for m in limits["delta_mag"] if m is not None]
    if reached:
        yield Fact(
            "Magnitude difference reached",
            f"{fixed(min(reached), 1)} to {fixed(max(reached), 1)}",
            f"{chance(limits['completeness'])} of such companions would be found",
        )
    if posterior is not None and posterior["upper_limit"] is not None:
        bound = posterior["upper_limit"]
        yield Fact(
            "Upper limit of the contrast",
            plain(bound["contrast"]),
            f"with {chance(bound['level'])} probability, anywhere in the field",
        )


def _data(content: Json) -> Section:
    data = content["data"]
    text = [
        f"{count(data['n_vis2'], 'squared visibility', 'squared visibilities')} and "
        f"{count(data['n_closure_phases'], data.get('phases', 'closure phase'))} hold "
        f"{count(data['n_independent'], 'independent number')}: "
        f"{COVARIANCE[data['covariance']]} ({data['covariance']} covariance)."
    ]
    calibration = content["calibration"]
    tables = []
    if calibration is None:
        text.append("No calibrators were given: the data were taken as calibrated.")
    else:
        text.append(_calibration(calibration))
        tables.append(_calibrators(calibration))
    tables += _consistency(content["consistency"])
    return Section(
        "Data and calibration",
        tuple(text),
        tables=tuple(tables),
    )


def _inputs(content: Json) -> Table:
    columns = (Column("Role", "text"), Column("File", "code"), Column("SHA-256", "code"))
    rows = tuple((i["role"], i["path"], i["sha256"]) for i in content["inputs"])
    return Table("Files that were read", columns, rows)


def _calibration(calibration: Json) -> str:
    kept = sum(c["kept"] for c in calibration["calibrators"])
    text = (
        f"{count(kept, 'calibrator')} of {len(calibration['calibrators'])} used, combined by the "
        f"{calibration['method']} method."
    )
    tau = calibration["tau"]
    parts = [
        f"{plain(tau[key], 2)}{unit} in {name}"
        for key, unit, name in (
            ("vis2", "", "V²"),
            ("closure_phase_deg", "°", "closure phase"),
        )
        if tau.get(key) is not None
    ]
    if not parts:
        return text
    return f"{text} They scatter by {' and '.join(parts)} more than their errors explain."


def _calibrators(calibration: Json) -> Table:
    columns = (
        Column("Calibrator", "code"),
        Column("Use", "text"),
        Column("Agreement"),
        Column("Reason", "text"),
    )
    rows = tuple(
        (
            c["path"],
            "kept" if c["kept"] else "dropped",
            tail(c.get("agreement_probability")),
            c["reason"] or "–",
        )
        for c in calibration["calibrators"]
    )
    caption = (
        "Calibrators; agreement is the probability that one which is like the others would "
        "differ from them at least as much"
    )
    return Table(caption, columns, rows)


def _consistency(splits: list[Json]) -> list[Table]:
    """Parts of the data, and calibrators, by how far they disagree on the companion."""
    if not splits:
        return []
    columns = Column("Compared", "text"), Column("Parts", "text"), Column("Δχ²"), Column("p")
    rows = tuple(
        (s["split"], ", ".join(s["parts"]), fixed(s["delta_chi2"], 1), tail(s["p"])) for s in splits
    )
    caption = (
        "Whether parts of the data, and the target calibrated with each calibrator and with the "
        "others, agree on the companion; p is the share of consistent data that go as far apart"
    )
    return [Table(caption, columns, rows)]


SECTIONS: dict[str, Callable[[Json], Section | None]] = {
    "search": fit_sections.search,
    "significance": fit_sections.significance,
    "posterior": fit_sections.posterior,
    "evidence": fit_sections.evidence,
    "models": models_section,
    "limits": fit_sections.limits,
    "noise": noise,
    "data": _data,
}
"""The sections of the report in their order, by the name that `Picture.section` gives.

A function makes a section of the content of ``result.json``, or None where there is nothing
to show; its pictures are put in afterwards. The answer comes before what it was made from. A new
section is one more line.
"""


def _again(content: Json, command: str) -> Section:
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "astropy"))
    return Section(
        "How to run it again",
        (
            "The same files (see the checksums), options and seed give the same numbers, for any "
            "number of workers.",
        ),
        code=command,
        tables=(_inputs(content),),
        notes=(
            f"amibayes {content['amibayes']}, seed {content['seed']}, field {field(content)}; "
            f"Python {platform.python_version()}, {packages}. Every number of this page is "
            "in result.json with all its digits.",
        ),
    )
