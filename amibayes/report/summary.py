"""The summary of the main job on the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amibayes.companion_search.result import RIVAL, SearchResult
from amibayes.comparison.agreement import Agreement, agreement
from amibayes.detection.false_alarm import Significance
from amibayes.detection.tails import Tail
from amibayes.limits.limit import DetectionLimit
from amibayes.pipeline.report_types import SearchReport
from amibayes.posterior.ensemble import Posterior
from amibayes.posterior.evidence import Evidence
from amibayes.report.joint import joint_lines
from amibayes.report.models import models_lines
from amibayes.report.result import upper_limit
from amibayes.report.words import (
    FARTHEST_TOLD,
    LARGEST_ANGLE_DEG,
    LARGEST_MAG,
    OPEN_ANGLE_DEG,
    capital,
    percent,
    places_of,
    three_digits,
    with_error,
    with_sides,
)
from amibayes.support.terminal import equals, row, with_warnings

EVEN = 0.5
"""Probability that the stated errors are correct, above which extra noise is left out."""

UNRESOLVED = 2.0
"""Errors that a disc has to measure before its size is given: below, a bound says more."""


def summary(report: SearchReport, folder: Path) -> list[str]:
    """Write the result in at most 20 lines."""
    result = report.result
    used = result.likelihood.observables
    lines = [
        *_statement(report),
        f"data        {used.n_vis2} V2, {used.n_closure_phases} {used.phase_name}s, "
        f"{used.n_independent} independent ({used.covariance_kind} covariance)",
        f"field       {result.grid.inner_mas:.4g} to {result.grid.outer_mas:.4g} mas, "
        f"{len(result.grid)} positions",
        _verdict(report),
        *_best_fit(report),
        f"chi2        {result.chi2_single:.1f} single, {result.chi2_binary:.1f} binary "
        f"({result.ndof} dof: reduced {three_digits(result.chi2_single / result.ndof)} -> "
        f"{three_digits(result.chi2_binary / result.ndof)})",
        _detection(result),
    ]
    lines += [*joint_lines(report), *_shape_lines(report), *_nuisance_lines(report)]
    lines += _noise_lines(report)
    if report.posterior is not None and report.statement != "model rejected":
        lines += _posterior_lines(report.posterior)
    lines += _upper_limit_lines(report)
    if report.evidence is not None:
        lines += _evidence_lines(report, report.evidence)
        lines += _second_lines(report, report.evidence)
    lines += models_lines(report.models, report.limits_beside)
    if report.limits is not None:
        lines += _limit_lines(report.limits)
    return with_warnings(lines, report.warnings, row("written to", str(folder)), "result.json")


def _detection(result: SearchResult) -> str:
    """Gain of the fit; twice that in ln L by Student's t is not the difference of two χ²."""
    gain, difference = result.delta_chi2, result.chi2_single - result.chi2_binary
    estimated = np.isfinite(result.likelihood.degrees) and gain < 0.99 * difference
    told = " (2 ln L, as errors are estimated from scatter)" if estimated else ""
    sigma = f"CANDID n_sigma {result.candid_n_sigma:.1f} (not a false-alarm rate)"
    return row("detection", f"delta chi2 {gain:.1f}{told}, {sigma}")


def _statement(report: SearchReport) -> list[str]:
    """The verdict with its reason, after the comparison of models where that is the answer."""
    found, beside = report.verdict, _beside(report)
    words = "" if found is None else f"{found.statement.upper()}: {found.because}"
    if beside is None or not beside.leads:
        return [row("verdict", words)] if words else []
    first = row("verdict", f"{capital(beside.summary)} (models)")
    return [first, row("search", f"for one companion at most: {words}")] if words else [first]


def _beside(report: SearchReport) -> Agreement | None:
    return None if report.models is None else agreement(report.models, report.verdict)


def _best_fit(report: SearchReport) -> list[str]:
    """Place and contrast; not those of a model that was rejected."""
    c = report.result.companion
    beside = _beside(report)
    apart = beside is not None and beside.agrees is False
    if report.statement == "model rejected":
        why = "see the models" if apart else "the model is rejected (amibayes export, for images)"
        return [row("best fit", f"not stated: {why}")]
    contrast = row(
        "contrast",
        f"{with_error(c.contrast, c.contrast_error, largest=1.0)} "
        f"(delta mag {with_error(c.delta_mag, c.delta_mag_error, largest=LARGEST_MAG)})",
    )
    if c.contrast <= 0.0:
        return [row("best fit", "no companion improves the fit"), contrast]
    places = max(0, places_of(c.separation_error_mas)) if c.separation_error_mas > 0.0 else 2
    angle = with_error(c.position_angle_deg, c.position_angle_error_deg, " deg", LARGEST_ANGLE_DEG)
    tested = report.significance
    # What noise alone gives has many places: that says nothing.
    rivals = "" if tested is not None and tested.detected is False else _rivals(report.result)
    place = rivals + (
        f"{with_error(c.separation_mas, c.separation_error_mas, ' mas', c.separation_mas)}, "
        f"PA {angle} (E {c.east_mas:.{places}f}, N {c.north_mas:.{places}f} mas)"
    )
    if report.statement == "no companion":
        noise = tested is None or not tested.detected
        place += ": no more than noise gives" if noise else ": needless, see the verdict"
    if apart:
        place = f"with one companion and nothing else: {place}"
    return [row("best fit", place), contrast]


def _rivals(result: SearchResult) -> str:
    """Where else a companion fits nearly as well: the errors of one position are not all."""
    places = [m.companion.separation_mas for m in (result.modes[0], *result.rivals)]
    if len(places) == 1:
        return ""
    return (
        f"not unique, {len(places)} positions at {min(places):.3g} to {max(places):.3g} mas "
        f"within Δχ² {RIVAL:.0f} (result.json, modes); the best: "
    )


def _verdict(report: SearchReport) -> str:
    tested = report.significance
    if tested is None:
        return "companion   not tested: no false-alarm probability was asked for"
    if tested.detected is None:
        return f"companion   undecided: {tested.n_draws} null draws are too few"
    if report.verdict is not None and report.verdict.statement not in ("companion", "no companion"):
        return f"companion   not stated: see the verdict; false alarm: {_chance(tested)}"
    if report.verdict is None:
        verdict = "DETECTED" if tested.detected else "not detected"
        return f"companion   {verdict}; false alarm: {_chance(tested)}"
    # The verdict has said whether there is one, and with which probability.
    return row("false alarm", _chance(tested, stated=report.verdict.statement == "companion"))


def _chance(tested: Significance, *, stated: bool = False) -> str:
    """The false-alarm probability, with that by randomised residuals where there is one."""
    if tested.bright is not None:
        return f"probability below {tested.bright:.2g}: a bright companion explains nearly all"
    check = tested.randomised
    if check is None or check.probability is None:
        return _parametric(tested, stated=stated)
    if check.probability < tested.probability:
        return f"{_parametric(tested, stated=stated)}; {check.note}"
    low, high = tested.interval
    return (
        f"probability {tested.probability:.2g} (95 %: {low:.2g} to {high:.2g}) by "
        f"randomised residuals of {check.n_exposures} exposures; {tested.parametric:.2g} by "
        f"{tested.n_draws} null searches"
    )


def _parametric(tested: Significance, *, stated: bool = False) -> str:
    """The false-alarm probability, and past the draws what is no more than extrapolated."""
    low, high = tested.interval
    tail = tested.tail
    if tail is None:
        return (
            f"probability {tested.probability:.2g} (95 %: {low:.2g} to {high:.2g}) "
            f"in {tested.n_draws} null searches"
        )
    told = "" if stated else f": probability below {high:.2g} (95 %)"
    return (
        f"{tested.n_above or 'none'} of {tested.n_draws} null searches reach it{told}; "
        f"extrapolated {_laws(tail)}"
    )


def _laws(tail: Tail) -> str:
    """Extrapolations by both laws, which are known to a power of ten; one where they agree."""
    pareto, extreme = _power(tail.generalised_pareto), _power(tail.extreme_value)
    return pareto if pareto == extreme else f"{pareto} (Pareto), {extreme} (extreme value)"


def _power(probability: float) -> str:
    if probability < FARTHEST_TOLD:
        return f"< {FARTHEST_TOLD:.0e}"
    return f"{probability:.0e}"


def _shape_lines(report: SearchReport) -> list[str]:
    """Disc and colour of the companion that is stated, where these are free."""
    result, lines = report.result, []
    if report.statement in ("no companion", "model rejected"):
        return []
    parameters = result.likelihood.parameters
    for k in parameters.columns("shape"):
        value, error = float(result.theta[k]), float(np.sqrt(result.theta_covariance[k, k]))
        if parameters[k].unit != "mas":
            at = 1e6 * result.likelihood.model.reference_wavelength_m
            shown = f"{with_error(value, error)} (exponent; contrast of {at:.3f} um)"
            lines.append(row("slope", shown))
        elif (bound := _upper_limit(value, error)) is not None:
            lines.append(row("disc", f"companion not resolved: below {bound:.2g} mas (2 sigma)"))
        else:
            remark = _remark(result, parameters[k].name, value)
            shown = f"of the companion {with_error(value, error, ' mas')}{remark}"
            lines.append(row("disc", shown))
    return lines


def _remark(result: SearchResult, name: str, diameter: float) -> str:
    """Say what the largest disc is that is tried, and what discs of phases alone are.

    o Leo's of 0.7 and 1.3 mas came out as 3.5 ± 0.2.
    """
    parameters = result.likelihood.parameters
    if diameter > AT_BOUND * parameters[parameters.index(name)].upper:
        return " (the largest that is tried: every baseline resolves it)"
    return "" if result.likelihood.observables.n_vis2 else " (closure phases alone hardly tell it)"


AT_BOUND = 0.999
"""Part of the upper bound of a disc, above which its fit ended there."""


def _upper_limit(diameter: float, error: float) -> float | None:
    """Of a disc that is not resolved; None where it is."""
    return diameter + UNRESOLVED * error if diameter < UNRESOLVED * error else None


def _nuisance_lines(report: SearchReport) -> list[str]:
    """The star's own parameters: of the fit without a companion, where there is none."""
    result, lines = report.result, []
    parameters = result.likelihood.parameters
    alone = report.statement == "no companion"
    star = {
        parameters[k].name: (float(result.theta[k]), float(np.sqrt(result.theta_covariance[k, k])))
        for k in parameters.nuisance
    }
    for name, (value, error) in (report.star_alone if alone else star).items():
        label = name.removesuffix("_mas").replace("limb_darkening", "limb dark.")
        unit = " mas" if name.endswith("_mas") else ""
        if name == "diameter_mas" and (bound := _upper_limit(value, error)) is not None:
            shown = f"not resolved: below {bound:.2g} mas (2 sigma, without its prior)"
            if not bound < result.grid.outer_mas:
                shown = "undetermined"
        else:
            largest = np.inf if unit else LARGEST_SHAPE
            shown = with_error(value, error, unit, largest) + (" (star alone)" if alone else "")
            shown += _remark(result, name, value) if name == "diameter_mas" else ""
        lines.append(row(label, shown))
    return lines


LARGEST_SHAPE = 2.0
"""An error of limb darkening or background as wide as its whole range."""


def _noise_lines(report: SearchReport) -> list[str]:
    """The posterior of the extra noise, where there is likely some."""
    found = report.noise_posterior or {}
    if all(noise.probability_none > EVEN for noise in found.values()):
        return []
    names = {"vis2": ("V2", 1.0), "closure_phase_rad": ("deg closure phase", np.degrees(1.0))}
    parts = []
    for name, noise in found.items():
        if noise.probability_none > EVEN:
            continue
        kind, _, source = name.partition(":")
        label, unit = names[kind]
        label += f" of {Path(source).name}" if source else ""
        median, low, high = (unit * x for x in noise.interval())
        parts.append(
            f"{median:.2g} +{high - median:.1g} -{median - low:.1g} {label} "
            f"(P(stated errors correct) {equals(noise.probability_none)})"
        )
    return [f"extra noise {', '.join(parts)}"]


def _limit_lines(limits: DetectionLimit) -> list[str]:
    usable = np.isfinite(limits.delta_mag)
    delta, rho = limits.delta_mag[usable], limits.separation_mas[usable]
    if not len(delta):
        return ["limits      no injected companion is recovered reliably in this field"]
    return [
        f"limits      delta mag {delta.min():.2f} to {delta.max():.2f} at {rho.min():.0f} to "
        f"{rho.max():.0f} mas ({percent(limits.completeness)} recovered, false-positive rate "
        f"{limits.false_positive_rate:.2g})"
    ]


def _upper_limit_lines(report: SearchReport) -> list[str]:
    limit = upper_limit(report) if report.significance is not None else None
    if limit is None:
        return []
    return [
        f"upper limit contrast < {limit['contrast']:.2g}, delta mag > {limit['delta_mag']:.2f} "
        f"({percent(limit['level'])}, anywhere in the field; prior: {limit['prior']})"
    ]


def _evidence_lines(report: SearchReport, evidence: Evidence) -> list[str]:
    """Evidences, and what speaks against the most likely number of companions."""
    shares = zip(evidence.companions, evidence.log_z, evidence.probability, strict=True)
    said = ", ".join(f"{k}: ln Z {z:.1f} ({_share(p)})" for k, z, p in shares)
    if evidence.halo_log_z > max(evidence.log_z) + HALO_LIKELIER:
        said += (
            f"; none, but light that no baseline resolves: {evidence.halo_log_z:.1f}, more likely "
            "(--background free)"
        )
    likeliest = evidence.companions[int(np.argmax(evidence.log_z))]
    shared = report.significance is not None and report.significance.exposures is not None
    if shared and likeliest > 0 and report.statement == "no companion":
        said += "; as if exposures erred independently, which the verdict does not take for granted"
    return [f"evidence    companions (probability) {said}"]


HALO_LIKELIER = 3.0
"""Gain in ln Z from which over-resolved light is told of: odds of 20."""


def _share(probability: float) -> str:
    """Probability of a model; one that the evidences leave no chance has no digits."""
    return f"{probability:.2g}" if probability >= LEAST_SHARE else f"< {LEAST_SHARE:.0e}"


LEAST_SHARE = 1e-6


def _second_lines(report: SearchReport, evidence: Evidence) -> list[str]:
    """The second companion, with its false-alarm probability."""
    if evidence.two is None:
        return []
    first = report.result.companion
    other = max(
        evidence.two.companions,
        key=lambda c: np.hypot(c.east_mas - first.east_mas, c.north_mas - first.north_mas),
    )
    gain = report.result.chi2_binary - evidence.two.chi2
    angle = with_error(
        other.position_angle_deg, other.position_angle_error_deg, " deg", LARGEST_ANGLE_DEG
    )
    separation = with_error(
        other.separation_mas, other.separation_error_mas, " mas", other.separation_mas
    )
    line = (
        f"second      {separation}, PA {angle}, contrast "
        f"{with_error(other.contrast, other.contrast_error, largest=1.0)}: delta chi2 {gain:.1f}"
    )
    if report.second_significance is not None:
        tested = report.second_significance
        line += f" ({'detected' if tested.detected else 'NOT detected'}; {_chance(tested)})"
    return [line]


def _posterior_lines(posterior: Posterior) -> list[str]:
    parts = []
    for name, unit in (
        ("separation_mas", "mas"),
        ("position_angle_deg", "deg"),
        ("delta_mag", "mag"),
    ):
        median, low, high = posterior.interval(name)
        if name == "position_angle_deg" and high - low > OPEN_ANGLE_DEG:
            parts.append("any position angle")
            continue
        parts.append(f"{with_sides(median, low, high)} {unit}")
    state = "converged" if posterior.converged else "NOT CONVERGED"
    return [
        f"posterior   {', '.join(parts)} (median, 68 %)",
        f"chain       {posterior.n_steps} steps, tau {posterior.autocorrelation_time:.1f}, "
        f"split R-hat {posterior.split_rhat:.3f}: {state}",
    ]
