"""What a survey's targets mean together, as ``survey.json`` has it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from amibayes.detection.verdict import REFUSED
from amibayes.limits.mass_table import MassTable, read_mass_table
from amibayes.survey.completeness import StackedCompleteness, stack
from amibayes.survey.false_alarms import FDR_LEVEL, NULLS_ABOVE, FalseAlarms, false_alarms
from amibayes.survey.frequency import Box, FrequencyPosterior, frequency_posterior
from amibayes.survey.rows import Json, Outcome
from amibayes.units import FloatArray

N_SEPARATIONS, N_DEPTHS = 24, 25
"""Of the stacked completeness: finer than the rings of the single targets."""

BRIGHTEST, DEPTH_STEP = 0.0, 0.25
"""Magnitude differences that are stacked: from equal brightness, in steps of a quarter."""

BOX_COMPLETENESS = 0.5
"""Companions are counted down to the magnitude that half of the targets would show: fainter
ones would come from the prior."""

KEPT_NODES = 201
"""Of the frequency's posterior in ``survey.json``: enough to draw it."""


def statistics(outcomes: Sequence[Outcome], level: float = FDR_LEVEL) -> tuple[list[Json], Json]:
    """Compute what the targets mean together.

    Parameters
    ----------
    outcomes : sequence of Outcome
    level : float
        Of the false-discovery rate.

    Returns
    -------
    list of dict
        The entry of each target, with its columns `amibayes.survey.rows.TOGETHER`.
    dict
        ``false_alarms``, ``completeness``, ``completeness_au``, ``companion_frequency``; null
        where the targets do not have what it takes.
    """
    entries = [outcome.entry() for outcome in outcomes]
    alarms = _false_alarms(entries, level)
    measured = [o for o in outcomes if o.detection is not None]
    return entries, {
        "false_alarms": alarms,
        "completeness": _completeness(measured),
        "completeness_au": _physical(measured),
        "companion_frequency": _frequency(measured),
    }


def _false_alarms(entries: list[Json], level: float) -> Json | None:
    """Add the columns that depend on the others to the entries; sum them up.

    What is not like noise may be a disc, or different from file to file: where the verdict says so
    a small probability lists no companion.
    """
    tested = [
        e
        for e in entries
        if e.get("false_alarm_probability") is not None and e.get("verdict") not in REFUSED
    ]
    if not tested:
        return None
    found = false_alarms(np.array([e["false_alarm_probability"] for e in tested]), level)
    for entry, rate, wide in zip(
        tested, found.false_discovery_rate, found.survey_wide, strict=True
    ):
        entry["false_discovery_rate"] = float(rate)
        entry["survey_wide_false_alarm"] = float(wide)
    return _alarms_json(found, tested)


def _alarms_json(found: FalseAlarms, tested: list[Json]) -> Json:
    uniform = found.uniformity()
    alphas = [e["alpha"] for e in tested if e.get("alpha") is not None]
    names = [e["name"] for e, listed in zip(tested, found.discovered, strict=True) if listed]
    return {
        "n_tested": len(tested),
        "n_detected": sum(e.get("detected") is True for e in tested),
        "expected_false_detections": float(np.sum(alphas)),
        "smallest_probability": float(found.probability.min()),
        "survey_wide_probability": float(found.survey_wide.min()),
        "false_discovery_level": found.level,
        "discovered": names,
        "null_draws_needed": found.draws_needed(),
        "uniformity": None
        if uniform is None
        else {"above": NULLS_ABOVE, "n": uniform[0], "p": uniform[1]},
    }


def _completeness(measured: Sequence[Outcome]) -> Json | None:
    targets = [o.detection for o in measured if o.detection is not None]
    if not targets:
        return None
    inner = min(t.separation_mas[0] for t in targets)
    outer = max(t.separation_mas[-1] for t in targets)
    found = stack(targets, _separations(inner, outer), _magnitudes(measured))
    return _stacked_json(found, "separation_mas", "delta_mag")


def _separations(inner: float, outer: float) -> FloatArray:
    return np.geomspace(inner, outer, N_SEPARATIONS)


def _magnitudes(measured: Sequence[Outcome]) -> FloatArray:
    """From equal brightness to a magnitude past the best limit of all."""
    best = max(o.row.get("limit_delta_mag_best") or 5.0 for o in measured)
    return np.arange(BRIGHTEST, best + 2.0 + DEPTH_STEP, DEPTH_STEP)


def _physical(measured: Sequence[Outcome]) -> Json | None:
    """Completeness against au, and masses where each target with a distance has a table."""
    near = [o for o in measured if o.facts.get("distance_pc") is not None]
    targets = [o.detection for o in near if o.detection is not None]
    if not targets:
        return None
    distance = [float(o.facts["distance_pc"]) for o in near]
    edges = [t.separation_mas[[0, -1]] * d / 1000.0 for t, d in zip(targets, distance, strict=True)]
    au = _separations(min(e[0] for e in edges), max(e[1] for e in edges))
    if tables := _mass_tables(near):
        mass = np.geomspace(
            min(t.mass.min() for t in tables), max(t.mass.max() for t in tables), N_DEPTHS
        )
        found = stack(targets, au, mass, distance_pc=distance, masses=tables)
        return _stacked_json(found, "separation_au", "mass") | {"mass_unit": tables[0].unit}
    found = stack(targets, au, _magnitudes(near), distance_pc=distance)
    return _stacked_json(found, "separation_au", "delta_mag")


def _mass_tables(near: Sequence[Outcome]) -> list[MassTable]:
    """Table of masses of each target, in the unit of the first; none where one has none."""
    if not all(o.facts.get("mass_table") for o in near):
        return []
    tables = [mass_table(o) for o in near]
    try:
        return [table.converted_to(tables[0].unit) for table in tables]
    except ValueError:  # a unit that is none of mass: what the tables share is the magnitude
        return []


def mass_table(outcome: Outcome) -> MassTable:
    """Read the table of masses of a target."""
    magnitude = outcome.facts.get("primary_magnitude")
    return read_mass_table(
        Path(outcome.facts["mass_table"]), None if magnitude is None else float(magnitude)
    )


def _stacked_json(found: StackedCompleteness, separation: str, depth: str) -> Json:
    return {
        separation: found.separation.tolist(),
        depth: found.depth.tolist(),
        "mean": found.mean.round(6).tolist(),
        "n_covering": found.covering.tolist(),
        "n_targets": found.n_targets,
    }


def _frequency(measured: Sequence[Outcome]) -> Json | None:
    """Companion frequency in the box that the survey itself suggests.

    Of targets whose verdict is a companion or none: others count neither way.
    """
    tested = [o for o in measured if o.row.get("detected") is not None]
    box = suggested_box(tested)
    if box is None:
        return None
    p = np.array([box.completeness(o.detection) for o in tested if o.detection is not None])
    alpha = np.array([o.row["alpha"] or 0.0 for o in tested])
    hit = np.array([o.row["detected"] and _inside(o.row, box) for o in tested])
    if not (p > alpha).any():
        return None
    return _frequency_json(frequency_posterior(hit, p, alpha), box)


def _inside(row: Json, box: Box) -> bool:
    """Whether the companion of a row is one that counts; ``limits`` gives no place."""
    place = row.get("separation_mas"), row.get("delta_mag")
    return None in place or box.holds(*place)  # type: ignore[arg-type]


def suggested_box(measured: Sequence[Outcome]) -> Box | None:
    """Choose the separations and magnitudes in which companions are counted.

    Separations that at least half of the targets cover, magnitudes down to where the mean
    completeness there falls below `BOX_COMPLETENESS`; None where it never is as high.
    """
    targets = [o.detection for o in measured if o.detection is not None]
    if not targets:
        return None
    inner = float(np.median([t.separation_mas[0] for t in targets]))
    outer = float(np.median([t.separation_mas[-1] for t in targets]))
    magnitudes = _magnitudes(measured)
    mean = stack(targets, _separations(inner, outer), magnitudes).mean.mean(axis=0)
    complete = np.flatnonzero(mean >= BOX_COMPLETENESS)
    if not len(complete) or complete[-1] == 0:
        return None
    return Box((inner, outer), (BRIGHTEST, float(magnitudes[complete[-1]])))


def _frequency_json(found: FrequencyPosterior, box: Box) -> Json:
    every = np.linspace(0, len(found.frequency) - 1, KEPT_NODES).astype(int)
    number: Callable[[float], float] = found.quantile
    return {
        "separation_mas": list(box.separation_mas),
        "delta_mag": list(box.delta_mag),
        "n_targets": found.n_targets,
        "n_detected": found.n_detected,
        "mean_completeness": found.mean_completeness,
        "median": number(0.5),
        "interval_68": list(found.interval(0.68)),
        "interval_95": list(found.interval(0.95)),
        "upper_95": number(0.95),
        "prior": "Jeffreys",
        "frequency": found.frequency[every].tolist(),
        "density": found.density[every].tolist(),
    }


def survey_json(command: str, seed: int, outcomes: Sequence[Outcome], *, whole: bool) -> Json:
    """Build the content of ``survey.json``: the same for any number of workers.

    Parameters
    ----------
    command : str
    seed : int
    outcomes : sequence of Outcome
    whole : bool
        Every target has had its turn: only then do they mean something together.
    """
    from amibayes import __version__

    entries, together = statistics(outcomes) if whole else ([o.entry() for o in outcomes], {})
    return {
        "amibayes": __version__,
        "command": command,
        "seed": seed,
        "n_targets": len(outcomes),
        "n_done": sum(o.status == "done" for o in outcomes),
        "n_failed": sum(o.status == "failed" for o in outcomes),
        **together,
        "targets": entries,
    }
