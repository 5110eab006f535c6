"""The sections of ``report.html`` on the fit: search, significance, posterior, limits."""

from __future__ import annotations

from typing import Any

from amibayes.models.bands import band_name
from amibayes.models.parameters import parameter_words
from amibayes.report.page import Column, Fact, Section, Table
from amibayes.report.sections.joint import joint_tables
from amibayes.report.statement import companion_stated, false_alarm, field
from amibayes.report.words import (
    FARTHEST_TOLD,
    NONE,
    capital,
    chance,
    count,
    fixed,
    measured,
    places_of,
    plain,
)

Json = dict[str, Any]

UNITS = {
    "separation_mas": ("Separation", "mas"),
    "position_angle_deg": ("Position angle", "°"),
    "east_mas": ("East", "mas"),
    "north_mas": ("North", "mas"),
    "contrast": ("Contrast (flux ratio)", ""),
    "delta_mag": ("Magnitude difference", "mag"),
    "diameter_mas": ("Diameter of the star", "mas"),
    "background": ("Over-resolved flux (star = 1)", ""),
}

FURTHER = {
    "limb_darkening": ("Limb darkening of the star (exponent)", ""),
    "companion_diameter_mas": ("Diameter of the companion", "mas"),
    "contrast_slope": ("Slope of the contrast (exponent of the wavelength)", ""),
}
"""Shown where they are free, or fixed at something else than nothing."""

MAX_MODES = 8
"""Rows of the table of positions."""

OPEN_DEG = 270.0
"""An interval of position angles wider than this leaves every direction open."""


def search(content: Json) -> Section:
    """The best fit, χ² and the other local maxima."""
    fit = content["fit"]
    text = (
        f"Every position of the field, {field(content)}, was tried. χ² falls from "
        f"{fixed(fit['chi2_single'], 1)} without a companion to "
        f"{fixed(fit['chi2_binary'], 1)} with one, for {count(fit['ndof'], 'degree')} of freedom: "
        f"reduced, from {plain(fit['chi2r_single'])} to {plain(fit['chi2r_binary'])}.",
    )
    return Section(
        "Search",
        text,
        tables=(_fit(fit), *joint_tables(content), *_modes(content)),
    )


def _fit(fit: Json) -> Table:
    rows = []
    further = {k: v for k, v in FURTHER.items() if fit["errors"].get(k) or fit.get(k)}
    for key, (name, unit) in (UNITS | further).items():
        error = fit["errors"].get(key)
        if key == "contrast" and (at := fit.get("reference_wavelength_um")):
            name = f"{name} at {fixed(at, 3)} µm"
        if key in ("diameter_mas", "background", *FURTHER) and error is None:
            rows.append((name, f"{plain(fit[key])} (fixed)", unit))
        else:
            rows.append((name, measured(fit[key], error), unit))
    caption = "Joint best fit; errors are 1σ, from the curvature of χ²"
    return Table(
        caption, (Column("", "text"), Column("Value"), Column("Unit", "text")), tuple(rows)
    )


def _modes(content: Json) -> tuple[Table, ...]:
    modes = content["modes"]
    if len(modes) < 2:
        return ()
    columns = ("Separation (mas)", "Position angle (°)", "Contrast", "Δχ²", "Probability")
    rows = tuple(
        (
            fixed(m["separation_mas"], 2),
            fixed(m["position_angle_deg"], 2),
            plain(m["contrast"]),
            fixed(m["delta_chi2"], 1),
            chance(m["probability"]) if "probability" in m else NONE,
        )
        for m in modes[:MAX_MODES]
    )
    caption = "Positions that fit nearly as well, best first; the probability is among these"
    if companion_stated(content) is False:
        caption = "Best positions of the field; the probability is among these, had it a companion"
    if len(modes) > MAX_MODES:
        caption += f" ({len(modes) - MAX_MODES} more in result.json)"
    return (Table(caption, tuple(Column(c) for c in columns), rows),)


def significance(content: Json) -> Section:
    """Every number of significance, with what it means and what it does not."""
    s = content["significance"]
    facts = [_false_alarm(s), *_extrapolated(s), _local(content)]
    if s.get("threshold") is not None:
        facts.append(
            Fact(
                "Statistic of the search",
                plain(s["statistic"], 4),
                f"The best value anywhere in the field. A detection needs {plain(s['threshold'])}, "
                f"which noise alone reaches with probability {plain(s['alpha'], 2)}.",
            )
        )
    facts += [
        Fact(
            "Δχ²",
            fixed(s["delta_chi2"], 1),
            "Twice the gain in ln likelihood over the best fit without a companion: the difference "
            "of the two χ² where the errors are known, less where they were estimated from few "
            "integrations. What a value means depends on how many positions were tried.",
        ),
        Fact(
            "CANDID nσ",
            fixed(s["candid_n_sigma"], 1),
            "Compares the two reduced χ² at one position (Gallenne et al. 2015, eq. 8); given "
            "for comparison with other papers. It is not a false-alarm rate.",
        ),
    ]
    return Section("Significance", facts=tuple(facts))


def _false_alarm(s: Json) -> Fact:
    meaning = (
        "Share of data sets without a companion, simulated with the noise of these, whose best "
        "position anywhere in the field is as good as that of the data."
    )
    if s.get("bright") is not None:
        meaning = (
            "Bound of the probability that noise alone, of any size, looks like a companion as "
            "bright as this one anywhere in the field."
        )
    elif s["false_alarm_probability"] is not None:
        low, high = s["false_alarm_interval"]
        meaning += (
            f" 95 % interval {chance(low)} to {chance(high)}, {count(s['n_null_draws'], 'draw')}."
        )
    return Fact("Global false-alarm probability", false_alarm(s), meaning)


def _extrapolated(s: Json) -> tuple[Fact, ...]:
    """What fitted laws give for a statistic that too few draws reach."""
    laws = s.get("extrapolation")
    if not laws:
        return ()
    pareto, extreme = (_by_law(laws[key]) for key in ("generalised_pareto", "extreme_value"))
    return (
        Fact(
            "Extrapolated false-alarm probability",
            pareto,
            "Too few draws reach the statistic to count them. This is a generalised Pareto law "
            f"of the largest draws; an extreme-value law gives {extreme}. So far out they are "
            "indications, no more.",
        ),
    )


def _by_law(probability: float) -> str:
    if probability < FARTHEST_TOLD:
        return f"<\u00a0{chance(FARTHEST_TOLD)}"
    return chance(probability)


def _local(content: Json) -> Fact:
    gain = max(content["significance"]["delta_chi2"], 0.0)
    return Fact(
        "Local significance",
        f"{fixed(gain**0.5, 1)} σ",
        "Root of Δχ², as if no other position had been tried; the size of the field is not in it.",
    )


def posterior(content: Json) -> Section | None:
    """Medians and intervals, and whether the chain has converged."""
    p = content["posterior"]
    if p is None:
        return None
    state = "It has converged" if p["converged"] else "IT HAS NOT CONVERGED"
    text = [
        f"Prior: {p['prior']['form']}; separation {plain(p['prior']['separation_mas'][0])} to "
        f"{plain(p['prior']['separation_mas'][1])} mas, contrast "
        f"{plain(p['prior']['contrast'][0])} to {plain(p['prior']['contrast'][1])}.",
        f"{state}: {count(p['n_walkers'], 'walker')} of {count(p['n_steps'], 'step')}, "
        f"autocorrelation time {plain(p['autocorrelation_time'])} steps, "
        f"{count(p['n_effective'], 'independent sample')}, split R̂ "
        f"{fixed(p['split_rhat'], 3)}.",
    ]
    if companion_stated(content) is False:
        text.insert(
            0,
            "No companion was detected: these are the places and contrasts that the data leave to "
            "one, if there is one, and not a measurement.",
        )
    return Section("Posterior", tuple(text), tables=(_intervals(p, content["fit"]),))


def _intervals(p: Json, fit: Json) -> Table:
    names = [key for key, value in p.items() if isinstance(value, dict) and "median" in value]
    rows = []
    for key in names:
        name, unit = _named(key, fit)
        q = p[key]
        places = _places(q)
        rows.append(
            (
                f"{name} ({unit})" if unit else name,
                fixed(q["median"], places),
                _range(key, q["lower"], q["upper"], places),
                _range(key, q["lower_95"], q["upper_95"], places),
            )
        )
    columns = (Column("", "text"), Column("Median"), Column("68 %"), Column("95 %"))
    return Table("Marginal posterior of each quantity", columns, tuple(rows))


def _named(key: str, fit: Json) -> tuple[str, str]:
    """What a quantity of the posterior is called, and its unit; a contrast with its band."""
    key, _, band = key.partition("[")
    name, unit = (UNITS | FURTHER).get(key) or (capital(parameter_words(key)), "")
    if fit.get("contrast_kind") == "per-filter" and key in ("contrast", "delta_mag") and not band:
        band = fit["contrasts"][0]["band"]
    return (f"{name}, {band_name(band.rstrip(']'))}" if band else name), unit


def _range(key: str, low: float, high: float, places: int) -> str:
    """An interval; that of an angle may go through north, or leave every direction open."""
    if key == "position_angle_deg":
        if high - low > OPEN_DEG:
            return "any"
        low, high = low % 360.0, high % 360.0
    return f"{fixed(low, places)} to {fixed(high, places)}"


def _places(quantity: Json) -> int:
    width = 0.5 * (quantity["upper"] - quantity["lower"])
    return min(max(places_of(width), 0), 9) if width > 0.0 else 3


def evidence(content: Json) -> Section | None:
    """Models with different numbers of companions, compared."""
    e = content["evidence"]
    if e is None:
        return None
    rows = tuple(
        (str(n), measured(z, error), chance(share), method)
        for n, z, error, share, method in zip(
            e["companions"],
            e["log_z"],
            e["log_z_error"],
            e["probability"],
            e["method"],
            strict=True,
        )
    )
    columns = (
        Column("Companions"),
        Column("ln Z"),
        Column("Probability"),
        Column("Computed by", "text"),
    )
    text = (
        "The evidence Z compares models with all their parameters integrated over the prior; the "
        "probabilities are those of the models given the data, and depend on that prior.",
    )
    table = Table("Evidence and probability of each number of companions", columns, rows)
    return Section("Evidence", text, tables=(table, *_two(e)))


def _two(e: Json) -> tuple[Table, ...]:
    two = e["two_companions"]
    if two is None:
        return ()
    rows = tuple(
        (
            measured(c["separation_mas"], c["errors"]["separation_mas"]),
            measured(c["position_angle_deg"], c["errors"]["position_angle_deg"]),
            measured(c["contrast"], c["errors"]["contrast"]),
        )
        for c in two["companions"]
    )
    columns = (Column("Separation (mas)"), Column("Position angle (°)"), Column("Contrast"))
    caption = (
        f"Joint fit of two companions: χ² {fixed(two['chi2'], 1)} for "
        f"{count(two['ndof'], 'degree')} of freedom"
    )
    return (Table(caption, columns, rows),)


def limits(content: Json) -> Section | None:
    """What could have been seen."""
    found = content["limits"]
    if found is None:
        return None
    share = f"{100.0 * found['completeness']:.0f} %"
    text = (
        f"Companions were injected into data without one and searched for by the same criterion "
        f"(method {found['method']}, false-positive rate "
        f"{plain(found['false_positive_rate'], 2)}). A dash is given where none is recovered "
        "reliably, whatever its brightness.",
    )
    rows = tuple(
        (fixed(rho, 1), fixed(mag, 2), plain(contrast), fixed(half, 2))
        for rho, mag, contrast, half in zip(
            found["separation_mas"],
            found["delta_mag"],
            found.get("contrast") or [None] * len(found["separation_mas"]),
            found.get("delta_mag_50") or [None] * len(found["separation_mas"]),
            strict=True,
        )
    )
    columns = (
        Column("Separation (mas)"),
        Column(f"Δmag, {share} recovered"),
        Column(f"Contrast, {share}"),
        Column("Δmag, 50 % recovered"),
    )
    table = Table("Limit at each separation", columns, rows)
    return Section("Detection limits", text, tables=(table,))
