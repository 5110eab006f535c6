"""The answer of a search in words, from the content of ``result.json``."""

from __future__ import annotations

from typing import Any

from amibayes.comparison.agreement import model_words
from amibayes.comparison.verdict import UNDECIDED
from amibayes.report.page import Kind, Mark, Sky, Statement
from amibayes.report.words import (
    LARGEST_ANGLE_DEG,
    LARGEST_MAG,
    capital,
    chance,
    count,
    fixed,
    known,
    plain,
    sentence,
)
from amibayes.units import offset

Json = dict[str, Any]

REFUSED = {
    "model rejected": (
        "Model rejected",
        "Neither a star nor a star with a companion explains these data: the numbers of the best "
        "fit below are those of a wrong model. Images need no model (amibayes export).",
    ),
    "inconsistent data": (
        "Inconsistent data",
        "Parts of the data contradict each other: analyse them apart before any number of the "
        "best fit is used.",
    ),
}
"""Label and advice for each verdict that states no best fit."""

LABELS = {True: "Companion detected", False: "No companion detected", None: "No claim is made"}


def statement_of(content: Json) -> Statement:
    """State what was found, its probability, and what could have been seen.

    Parameters
    ----------
    content : dict
        As `amibayes.report.result_json` gives it.
    """
    if by_comparison(content):
        return _compared(content)
    if refused(content):
        return _refused(content)
    detected = companion_stated(content)
    kind = {True: "found", False: "none", None: "open"}[detected]
    headline = {True: _found, False: _nothing, None: _unjudged}[detected](content)
    sentences = [
        _note(content),
        _summary(content),
        _chance(content),
        _others(content),
        _limits(content),
        _upper_limit(content),
    ]
    return Statement(kind, LABELS[detected], headline, tuple(s for s in sentences if s))  # type: ignore[arg-type]


def companion_stated(content: Json) -> bool | None:
    """Whether a companion is stated; None where that is not known.

    Noise alone may not explain one, and a star without a companion may: the verdict says so.
    """
    detected: bool | None = content["significance"]["detected"]
    verdict = content.get("verdict")
    another = verdict is not None and verdict["statement"] == "no companion"
    return False if detected and another else detected


def refused(content: Json) -> bool:
    """Whether the verdict states no best fit, and nothing else does."""
    verdict = content.get("verdict")
    stated = verdict is not None and verdict["statement"] in REFUSED
    return stated and not by_comparison(content)


def _refused(content: Json) -> Statement:
    """The statement where neither a star nor a star with a companion explains the data."""
    verdict = content["verdict"]
    label, advice = REFUSED[verdict["statement"]]
    sentences = (advice, _summary(content), _chance(content))
    return Statement("open", label, sentence(verdict["because"]), tuple(s for s in sentences if s))


def by_comparison(content: Json) -> bool:
    """Whether the comparison of models is the answer, and not a star with one companion."""
    return bool((content.get("model_verdict") or {}).get("leads"))


def _compared(content: Json) -> Statement:
    """The statement where the comparison of models has the answer."""
    compared, verdict = content["model_verdict"], content.get("verdict")
    stated = compared["statement"]
    label = "Undecided" if stated == UNDECIDED else capital(model_words(stated))
    kind: Kind = "none" if stated == "star" else "found"
    if stated == UNDECIDED or not compared["fits"]:
        kind = "open"
    searched = f"With one companion and nothing else the best fit is at {place(content)}."
    if verdict is not None and verdict["statement"] == "model rejected":
        searched = f"A star with at most one companion is rejected: {verdict['because']}."
    elif verdict is not None and verdict["statement"] == "no companion":
        searched = _nothing(content)
    elif content["fit"]["contrast"] <= 0.0:
        searched = _unjudged(content)
    sentences = [searched, _chance(content)]
    if compared["agrees"]:
        sentences += [_limits(content), _upper_limit(content)]
    return Statement(kind, label, _summary(content), tuple(s for s in sentences if s))


def _summary(content: Json) -> str:
    """What the comparison of models says, and where to read of it."""
    found = (content.get("model_verdict") or {}).get("summary", "")
    return sentence(f"{found} (see Companion or disc)") if found else ""


def _note(content: Json) -> str:
    """What else may look like the companion that is stated."""
    note = (content.get("verdict") or {}).get("note", "")
    return sentence(note) if note else ""


def place(content: Json) -> str:
    """Where the best fit is, and how bright, with errors."""
    separation, angle, magnitude = numbers_of_place(content, "\u00a0mas", "\u00a0mag")
    text = f"{separation}, position angle {angle}, {magnitude} fainter than the star"
    if "reference_mjd" in content["fit"]:
        text += f" (at MJD\u00a0{fixed(content['fit']['reference_mjd'], 2)})"
    return text.replace(" ±", "\u00a0±")


def numbers_of_place(content: Json, mas: str, mag: str) -> list[str]:
    """Separation, position angle and magnitude of the best fit with errors, in these units."""
    fit, errors = content["fit"], content["fit"]["errors"]
    numbers = (
        ("separation_mas", mas, fit["separation_mas"]),
        ("position_angle_deg", "°", LARGEST_ANGLE_DEG),
        ("delta_mag", mag, LARGEST_MAG),
    )
    return [known(fit[key], errors[key], unit, largest) for key, unit, largest in numbers]


def field(content: Json) -> str:
    """The separations that were searched."""
    inner, outer = content["data"]["separation_mas"]
    return f"{plain(inner)} to {plain(outer)} mas"


def _found(content: Json) -> str:
    return f"A companion at {place(content)}."


def _nothing(content: Json) -> str:
    verdict = content.get("verdict")
    if content["significance"]["detected"] and verdict is not None:
        return f"No companion is stated: {verdict['because']}."
    return f"No companion is detected at {field(content)} from the star."


def _unjudged(content: Json) -> str:
    if content["fit"]["contrast"] <= 0.0:
        return f"Nothing at {field(content)} from the star improves the fit."
    return f"The best fit is a companion at {place(content)}; its chance is not known."


def _chance(content: Json) -> str:
    significance = content["significance"]
    probability, draws = significance["false_alarm_probability"], significance["n_null_draws"]
    if probability is None:
        return (
            "No data without a companion were simulated, so how often noise alone "
            "would give this is not known."
        )
    low, high = significance["false_alarm_interval"]
    alpha = plain(significance["alpha"], 2)
    asked = f"a detection is claimed below {alpha}"
    if significance["detected"] is None:
        asked = f"too few to measure anything below {alpha}"
    if significance.get("bright") is not None:
        return (
            "The companion explains nearly all of what a star alone leaves: the chance that noise "
            f"alone, of any size, looks like one of its brightness anywhere in the field "
            f"({field(content)}) is below {chance(high)}; {asked}."
        )
    if low == 0.0:
        # Where the bound does not meet what is asked, the estimate does.
        decided = significance["detected"] and high >= significance["alpha"]
        estimated = f"estimated as {chance(probability)}, and " if decided else ""
        return (
            f"Not one of {count(draws, 'data set')} simulated without a companion has anything as "
            f"good anywhere in the field ({field(content)}): the chance of this by noise is "
            f"{estimated}below {chance(high)}, with 95\u00a0% confidence; {asked}."
        )
    return (
        "The chance that noise alone gives something as good anywhere in the field "
        f"({field(content)}) is {chance(probability)}, and with 95\u00a0% confidence between "
        f"{chance(low)} and {chance(high)}: from the same search in {count(draws, 'data set')} "
        f"simulated without a companion; {asked}."
    )


def false_alarm(significance: Json) -> str:
    """The global false-alarm probability, or what it is below where no draw reaches the data."""
    if significance["false_alarm_probability"] is None:
        return "not computed"
    low, high = significance["false_alarm_interval"]
    if low == 0.0:
        return f"<\u00a0{chance(high)}"
    return chance(significance["false_alarm_probability"])


def _others(content: Json) -> str:
    """Whether the position is the only one."""
    modes = content["modes"]
    if len(modes) < 2 or companion_stated(content) is False:
        return ""
    # An alias lies where the field of one answer has ended: a warning says so.
    rivals = [m for m in modes[1:] if not m["alias"]]
    whole = modes[0].get("probability", 0.0) + sum(m.get("probability", 0.0) for m in rivals)
    rivals = [
        m | ({"probability": m["probability"] / whole} if "probability" in m else {})
        for m in rivals
    ]
    others = [m for m in rivals if m.get("probability", 1.0) >= 0.01]
    if not others:
        return ""
    text = "; ".join(
        f"{plain(m['separation_mas'], 4)} mas at {plain(m['position_angle_deg'], 4)}°"
        + (f" (probability {chance(m['probability'])})" if "probability" in m else "")
        for m in others[:3]
    )
    more = f" and {len(others) - 3} more" if len(others) > 3 else ""
    return f"The data do not rule out another position: {text}{more}."


def _limits(content: Json) -> str:
    limits = content["limits"]
    if limits is None:
        return ""
    curve = [
        (rho, mag)
        for rho, mag in zip(limits["separation_mas"], limits["delta_mag"], strict=True)
        if mag is not None
    ]
    if not curve:
        return "No injected companion is recovered reliably anywhere in this field."
    best = max(curve, key=lambda point: point[1])
    worst = min(curve, key=lambda point: point[1])
    return (
        f"Companions up to {fixed(worst[1], 2)} mag fainter than the star (at "
        f"{plain(worst[0])} mas) to {fixed(best[1], 2)} mag (at {plain(best[0])} mas) would be "
        f"found {100.0 * limits['completeness']:.0f}\u00a0% of the time, at a false-positive rate "
        f"of {plain(limits['false_positive_rate'], 2)}."
    )


def _upper_limit(content: Json) -> str:
    posterior = content["posterior"]
    limit = None if posterior is None else posterior["upper_limit"]
    if limit is None or content["significance"]["detected"] is None:
        return ""
    return (
        f"With {100.0 * limit['level']:.0f}\u00a0% probability a companion anywhere in the field "
        f"is more than {fixed(limit['delta_mag'], 2)} mag fainter than the star (prior: "
        f"{limit['prior']})."
    )


def sky_of(content: Json) -> Sky:
    """Sketch the field, the best fit and the other modes."""
    inner, outer = content["data"]["separation_mas"]
    fit = content["fit"]
    detected = companion_stated(content) and not by_comparison(content)
    marks = []
    for mode in content["modes"][1:]:
        east, north = offset(mode["separation_mas"], mode["position_angle_deg"])
        marks.append(Mark(float(east), float(north), "mode"))
    text = f"Sketch of the field, {field(content)} around the star, north up and east left"
    if fit["contrast"] > 0.0:
        kind = "companion" if detected else "candidate"
        marks.append(Mark(fit["east_mas"], fit["north_mas"], kind))  # type: ignore[arg-type]
        text += (
            f"; the {'companion' if detected else 'best fit'} is at "
            f"{plain(fit['separation_mas'], 4)} mas, {plain(fit['position_angle_deg'], 4)}°"
        )
    if content["modes"][1:]:
        text += f"; {count(len(content['modes']) - 1, 'other local maximum', 'other local maxima')}"
    return Sky(inner, outer, tuple(marks), text + ".")
