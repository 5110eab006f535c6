"""The comparison of models of the sky: its JSON, its section of the report, its lines."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from amibayes.companion_search.field import resolution_mas
from amibayes.comparison.agreement import agreement, model_words
from amibayes.comparison.compare import Compared, ModelComparison
from amibayes.comparison.limits import LimitsBeside
from amibayes.comparison.summary import intervals
from amibayes.detection.verdict import Verdict
from amibayes.likelihood.chi2 import REJECTED
from amibayes.models.parameters import Parameter, Parameters, parameter_words
from amibayes.posterior.evidence import Evidence
from amibayes.posterior.priors import Prior, Range
from amibayes.report.common import Json, number
from amibayes.report.page import Column, Section, Table
from amibayes.report.words import capital, chance, count, fixed, measured, percent, plain
from amibayes.support.options import SKY_MODELS
from amibayes.support.terminal import row

FEWEST_DRAWS = 50.0
"""Independent draws from which intervals are stated: models that the data exclude by far have
fewer, since their evidence is not worth more."""

BY_EVIDENCE = {0: "star", 1: "companion", 2: "two"}
"""Names of the models that the evidence of companions is of."""


def models_json(
    found: ModelComparison | None, evidence: Evidence | None, verdict: Verdict | None = None
) -> Json:
    """Build ``models``, ``confusion`` and ``model_verdict`` of ``result.json``.

    Where no models were asked for, ``models`` are those of the evidence of companions.
    """
    if found is None:
        known = [] if evidence is None else _of_evidence(evidence)
        return {"models": known or None, "confusion": None, "model_verdict": None}
    shares = zip(found.models, found.probability, strict=True)
    beside = agreement(found, verdict)
    return {
        "models": [_model(m, float(p)) for m, p in shares],
        "confusion": _confusion(found),
        "model_verdict": {
            **asdict(found.verdict),
            "summary": beside.summary,
            "agrees": beside.agrees,
            "leads": beside.leads,
            "fits": found.best.p_fit >= REJECTED,
            "p_confused": number(found.verdict.p_confused),
            "half_resolution_mas": 0.5 * resolution_mas(found.best.fit.model.likelihood),
            "n_simulated": 0 if found.confusion is None else found.confusion.n_draws,
            "extra_vis2": found.noise.vis2,
            "extra_closure_phase_rad": found.noise.closure_phase_rad,
        },
    }


def _of_evidence(evidence: Evidence) -> list[Json]:
    each = zip(
        evidence.companions,
        evidence.log_z,
        evidence.log_z_error,
        evidence.probability,
        strict=True,
    )
    return [
        {
            "model": BY_EVIDENCE[k],
            "log_z": float(z),
            "log_z_error": number(error),
            "probability": float(share),
        }
        for k, z, error, share in each
    ]


def _model(model: Compared, probability: float) -> Json:
    known = model.draws.n_effective >= FEWEST_DRAWS
    found = {
        name: {k: number(v) if known or k == "best" else None for k, v in asdict(i).items()}
        for name, i in intervals(model).items()
    }
    return {
        "model": model.name,
        "log_z": model.log_z,
        "log_z_error": model.log_z_error,
        "probability": probability,
        "chi2": model.chi2,
        "ndof": model.ndof,
        "p_fit": model.p_fit,
        "method": model.method,
        "n_effective": model.draws.n_effective,
        "parameters": found,
        "prior": _prior(model),
    }


def _prior(model: Compared) -> Json:
    """Prior of every parameter, and of what is derived from them, in words."""
    parameters, prior = model.fit.model.likelihood.parameters, model.fit.model.prior
    nuisance = [parameters[k] for k in parameters.nuisance]
    found = {p.name: _range(p, r) for p, r in zip(nuisance, prior.ranges, strict=True)}
    for name in [n for n in found if n.endswith("_axis_ratio")]:
        label = name.replace("_axis_ratio", "_inclination_deg")
        found[label] = f"that of its cosine, the axis ratio: {found[name]}"
    return _companion_prior(parameters, prior) | found if parameters.companions else found


def _companion_prior(parameters: Parameters, prior: Prior) -> Json:
    """Priors of companions, every one by its own names."""
    low, high = f"{prior.contrast_min:.3g}", f"{prior.contrast_max:.3g}"
    field = f"{prior.inner_mas:.4g} to {prior.outer_mas:.4g} mas"
    position = f"uniform in {prior.position_form}, {field}"
    contrast = f"{prior.contrast_form}, {low} to {high}"
    rate = f"uniform in area, up to {prior.fastest_mas_yr:.3g} mas/yr"
    place = f"that of the position: {position}"
    of = {"position": place, "flux": contrast, "rate": rate}
    found = {"position": position}
    for k in range(1, parameters.companions + 1):
        shapes = iter(prior.shapes)
        for p in (parameters[i] for i in parameters.companion(k)):
            found[p.name] = of.get(p.role) or _range(p, Range(*next(shapes)))
        suffix = "" if k == 1 else f"_{k}"
        found[f"separation_mas{suffix}"] = place
        found[f"position_angle_deg{suffix}"] = "uniform, 0 to 360 deg"
    return found


def _range(parameter: Parameter, one: Range) -> str:
    form = "log-uniform" if one.logarithmic else "uniform"
    form = f"half-Cauchy of {one.scale:g}" if one.scale else form
    unit = f" {parameter.unit}" if parameter.unit else ""
    return f"{form}, {one.low:.3g} to {one.high:.3g}{unit}"


def _confusion(found: ModelComparison) -> Json | None:
    """Share of the data sets of each model that are taken for another, or for none."""
    if found.confusion is None:
        return None
    out: Json = {}
    names, share = found.confusion.taken_for()
    for model, row_ in zip(found.confusion.names, share, strict=True):
        out |= {f"{model} taken for {n}": float(x) for n, x in zip(names, row_, strict=True)}
    return out


def models_section(content: Json) -> Section | None:
    """Odds of the models, their parameters, and how often they are confused."""
    verdict = content.get("model_verdict")
    if verdict is None:
        return None
    models = content["models"]
    text = [
        f"{headline(verdict)}: {verdict['because']}.",
        "All models have the same noise, the star of the search, and the same prior probability; "
        "their evidences integrate every parameter over its prior.",
    ]
    if verdict["n_simulated"]:
        text.append(
            f"{count(verdict['n_simulated'], 'data set')} were simulated with the noise of these "
            "data from the best fit of each model, and compared in the same way."
        )
    if verdict["degenerate"]:
        text.append(degenerate_text(verdict))
    text += _beside_text(content.get("limits_beside"))
    tables = [_odds(models), *_parameters(models)]
    if content["confusion"] is not None:
        tables.insert(1, _confusion_table(models, content["confusion"]))
    return Section("Companion or disc", tuple(text), tables=tuple(tables))


def _beside_text(limits: Json | None) -> list[str]:
    """What companions would be seen beside the disc."""
    reached = [] if limits is None else [m for m in limits["delta_mag"] if m is not None]
    if limits is None or not reached:
        return []
    inner, outer = limits["separation_mas"][0], limits["separation_mas"][-1]
    return [
        f"With the {limits['model']} in the model and its parameters free, companions up to "
        f"{fixed(min(reached), 1)} to {fixed(max(reached), 1)} mag fainter than the star would be "
        f"found {100.0 * limits['completeness']:.0f} % of the time at {plain(inner)} to "
        f"{plain(outer)} mas."
    ]


def headline(verdict: Json) -> str:
    """What the comparison says, in a word."""
    stated = verdict["statement"]
    return capital(SKY_MODELS.get(stated) or model_words(stated))


def degenerate_text(verdict: Json) -> str:
    """Say what cannot be told below λ/2B."""
    return (
        f"What was found is smaller than λ/2B ({plain(verdict['half_resolution_mas'])} mas): its "
        "size and its flux are degenerate there, and so are the models."
    )


def _odds(models: list[Json]) -> Table:
    columns = (
        Column("Model", "text"),
        Column("ln Z"),
        Column("Probability"),
        Column("χ²"),
        Column("Degrees of freedom"),
    )
    rows = tuple(
        (
            m["model"],
            measured(m["log_z"], m["log_z_error"]),
            chance(m["probability"]),
            fixed(m["chi2"], 1),
            str(m["ndof"]),
        )
        for m in models
    )
    return Table("Evidence and best fit of each model", columns, rows)


def _confusion_table(models: list[Json], confusion: Json) -> Table:
    names = [m["model"] for m in models]
    goals = list(dict.fromkeys(key.partition(" taken for ")[2] for key in confusion))
    columns = (Column("Simulated", "text"), *(Column(f"→ {n}") for n in goals))
    rows = tuple(
        (name, *(chance(confusion[f"{name} taken for {n}"]) for n in goals)) for name in names
    )
    return Table("What data simulated from each model are taken for", columns, rows)


def _parameters(models: list[Json]) -> list[Table]:
    """Posterior of the parameters of every model that is not out of the question."""
    columns = (Column("", "text"), Column("Median"), Column("68 % interval"), Column("Best fit"))
    tables = []
    for m in models:
        if m["probability"] < MENTIONED or not m["parameters"]:
            continue
        rows = tuple(
            (
                parameter_words(name),
                plain(i["median"], 4),
                f"{plain(i['lower'], 4)} to {plain(i['upper'], 4)}",
                plain(i["best"], 4),
            )
            for name, i in m["parameters"].items()
        )
        tables.append(Table(f"Parameters of the model {m['model']}", columns, rows))
    return tables


MENTIONED = 0.01
"""Probability below which a model's parameters are left to ``result.json``."""


def models_lines(found: ModelComparison | None, beside: LimitsBeside | None = None) -> list[str]:
    """What the summary says."""
    if found is None:
        return []
    verdict = found.verdict
    shares = zip(found.models, found.probability, strict=True)
    listed = ", ".join(f"{m.name} ln Z {m.log_z:.1f} ({p:.2g})" for m, p in shares)
    lines = [
        row("models", f"{verdict.statement.upper()}: {verdict.because}"),
        row("odds", f"(probability) {listed}"),
    ]
    if found.confusion is not None:
        lines.append(row("confusion", _confusion_line(found)))
    if beside is not None:
        depth = beside.limit.delta_mag
        lines.append(
            row(
                "limits",
                f"beside the {beside.model}: delta mag {np.nanmin(depth):.2f} to "
                f"{np.nanmax(depth):.2f} ({percent(beside.limit.completeness)} recovered)",
            )
        )
    if verdict.degenerate:
        lines.append(row("", "smaller than lambda/2B: size and flux are degenerate"))
    return lines


def _confusion_line(found: ModelComparison) -> str:
    """Where simulated data of every model go, in percent."""
    assert found.confusion is not None
    names, share = found.confusion.taken_for()
    parts = []
    for name, part in zip(found.confusion.names, share, strict=True):
        goes = [f"{100 * x:.0f} % {n}" for n, x in zip(names, part, strict=True) if x >= 0.005]
        parts.append(f"{name} -> {', '.join(goes)}")
    return f"{'; '.join(parts)} ({found.confusion.n_draws} simulated each)"
