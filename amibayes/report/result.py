"""The content of ``result.json``."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np

from amibayes import __version__
from amibayes.companion_search.result import Companion, Mode, SearchResult
from amibayes.companion_search.second_companion import TwoCompanions
from amibayes.comparison.limits import LimitsBeside
from amibayes.detection.exposure_noise import ExposureNoise
from amibayes.detection.false_alarm import Significance
from amibayes.detection.verdict import REFUSED, Verdict
from amibayes.likelihood.likelihood import single_likelihood
from amibayes.likelihood.student import DEGREES, normal_moments
from amibayes.pipeline.report_types import SearchReport, calibrator_verdicts
from amibayes.posterior.bootstrap import Bootstrap
from amibayes.posterior.ensemble import Posterior
from amibayes.posterior.evidence import HALO_BACKGROUND, Evidence
from amibayes.posterior.grid import GridPosterior, integrable
from amibayes.posterior.priors import Prior
from amibayes.report.common import Json, data_json, inputs_json, number
from amibayes.report.joint import is_joint, joint_fit_json, residuals_json
from amibayes.report.limits import limits_json, map_json
from amibayes.report.models import models_json
from amibayes.report.noise import noise_json
from amibayes.units import contrast_to_delta_mag

QUANTITIES = (
    "separation_mas",
    "position_angle_deg",
    "contrast",
    "delta_mag",
    "east_mas",
    "north_mas",
)


def result_json(report: SearchReport, request: str = "") -> Json:
    """Build the content of ``result.json``, whose keys scripts rely on.

    Parameters
    ----------
    report : SearchReport
    request : str
        Digest of what was asked, for a run that is resumed.
    """
    result = report.result
    return {
        "amibayes": __version__,
        "verdict": _verdict(report.verdict),
        "consistency": [
            asdict(split) | {"parts": list(split.parts)} for split in report.consistency
        ],
        "seed": report.options.seed,
        "request": request,
        "options": report.options.to_json(),
        "inputs": inputs_json(report.targets, report.calibrators),
        "data": data_json(report.result, report.left_out),
        "fit": _fit(report),
        "significance": _significance(result, report.significance, report.options.alpha),
        "modes": _modes(report),
        "posterior": None if report.posterior is None else _posterior(report, report.posterior),
        "bootstrap": _bootstrap(report),
        "calibration": _calibration(report),
        "limits": _limits(report),
        "noise": noise_json(report),
        "robust": _robust(report.result),
        "evidence": None
        if report.evidence is None
        else evidence_json(report.evidence, report.second_significance),
        **models_json(report.models, report.evidence, report.verdict),
        "limits_beside": _limits_beside(report.limits_beside),
        "warnings": list(report.warnings),
        "timing_s": {name: round(seconds, 3) for name, seconds in report.timing_s.items()},
    } | ({"residuals": residuals_json(report)} if is_joint(report) else {})


def _robust(result: SearchResult) -> Json | None:
    """What Student-t residuals made of the data; null where it was not asked for."""
    found = result.robustness
    if found is None:
        return None
    return {
        "degrees_of_freedom": DEGREES,
        "mean_weight": float(found.weights.mean()),
        "mean_weight_of_normal_residuals": normal_moments().weight * DEGREES / (DEGREES + 1.0),
        "outliers": [asdict(outlier) for outlier in found.outliers],
    }


def _verdict(found: Verdict | None) -> Json | None:
    names = ("statement", "because", "p_model", "note")
    return None if found is None else {name: getattr(found, name) for name in names}


def _fit(report: SearchReport) -> Json:
    result = report.result
    c = result.companion
    return {
        **{name: number(getattr(c, name)) for name in QUANTITIES},
        "diameter_mas": result.nuisance("diameter_mas"),
        "background": result.nuisance("background"),
        "limb_darkening": result.nuisance("limb_darkening"),
        "companion_diameter_mas": result.nuisance("companion_diameter_mas"),
        "contrast_slope": result.nuisance("contrast_slope"),
        "reference_wavelength_um": 1e6 * result.likelihood.model.reference_wavelength_m or None,
        "chi2_single": result.chi2_single,
        "chi2_binary": result.chi2_binary,
        "chi2r_single": result.chi2_single / result.ndof,
        "chi2r_binary": result.chi2_binary / result.ndof,
        "ndof": result.ndof,
        **joint_fit_json(result),
        "star_alone": {
            name: {"value": value, "error": number(error)}
            for name, (value, error) in report.star_alone.items()
        },
        "errors": _errors(c, result),
    }


def _errors(c: Companion, result: SearchResult) -> Json:
    errors = companion_errors(c)
    names = result.likelihood.parameters.names
    for name, variance in zip(names, np.diag(result.theta_covariance), strict=True):
        if name not in errors:
            errors[name] = number(np.sqrt(variance))
    return errors


def companion_errors(c: Companion) -> Json:
    """1σ errors of a companion by the names of its quantities."""
    errors = {
        "separation_mas": c.separation_error_mas,
        "position_angle_deg": c.position_angle_error_deg,
        "contrast": c.contrast_error,
        "delta_mag": c.delta_mag_error,
        "east_mas": c.east_error_mas,
        "north_mas": c.north_error_mas,
    }
    return {name: number(value) for name, value in errors.items()}


def _significance(result: SearchResult, tested: Significance | None, alpha: float) -> Json:
    out: Json = {
        "delta_chi2": result.delta_chi2,
        "candid_n_sigma": result.candid_n_sigma,
        "false_alarm_probability": None,
        "false_alarm_interval": None,
        "n_null_draws": 0,
        "tail_extrapolated": False,
        "detected": None,
        "alpha": alpha,
    }
    if tested is not None:
        out |= {
            "false_alarm_probability": tested.probability,
            "false_alarm_interval": list(tested.interval),
            "n_null_draws": tested.n_draws,
            "detected": tested.detected,
            "statistic": tested.statistic,
            "threshold": tested.threshold(),
            "parametric": tested.parametric,
            "bright": tested.bright,
            "randomised": _randomised(tested),
            "exposures": _exposures(tested.exposures),
            "extrapolation": None
            if tested.tail is None
            else {
                "generalised_pareto": tested.tail.generalised_pareto,
                "extreme_value": tested.tail.extreme_value,
                "log10_error": number(tested.tail.log10_error),
            },
        }
    return out


def _randomised(weight: Significance) -> Json | None:
    check = weight.randomised
    if check is None:
        return None
    return {
        "n_exposures": check.n_exposures,
        "n_draws": check.n_draws,
        "probability": check.probability,
        "interval": None if check.interval is None else list(check.interval),
    }


def _exposures(shared: ExposureNoise | None) -> Json | None:
    if shared is None or (shared.vis2 is None and shared.closure_phase is None):
        return None
    names = ("share", "share_error", "hours")
    return {
        kind: None if drift is None else dict(zip(names, (*drift.share, drift.hours), strict=True))
        for kind, drift in (("vis2", shared.vis2), ("closure_phase", shared.closure_phase))
    }


def _modes(report: SearchReport) -> list[Json]:
    aliases = report.result.aliases
    modes = [_mode(mode) | {"alias": mode in aliases} for mode in report.result.modes]
    if report.posterior is not None:
        for mode, probability in zip(modes, report.posterior.mode_probability, strict=True):
            mode["probability"] = float(probability)
    return modes


def _mode(mode: Mode) -> Json:
    c = mode.companion
    return {
        "separation_mas": c.separation_mas,
        "position_angle_deg": c.position_angle_deg,
        "contrast": c.contrast,
        "delta_chi2": mode.delta_chi2,
    }


def _posterior(report: SearchReport, posterior: Posterior) -> Json:
    names = [*QUANTITIES, *(n for n in posterior.names if n not in QUANTITIES)]
    nuisance = single_likelihood(report.result.likelihood).parameters.names
    return _intervals(posterior, names) | {
        "autocorrelation_time": number(posterior.autocorrelation_time),
        "n_effective": posterior.n_effective,
        "n_steps": posterior.n_steps,
        "n_walkers": posterior.n_walkers,
        "acceptance": posterior.acceptance,
        "split_rhat": number(posterior.split_rhat),
        "converged": posterior.converged,
        "convergence": {
            name: {key: number(value) for key, value in line.items()}
            for name, line in posterior.convergence().items()
        },
        "integrated": None if report.grid is None else _intervals(report.grid, names),
        "mode_method": posterior.mode_method,
        "probability_elsewhere": number(posterior.elsewhere),
        "upper_limit": upper_limit(report),
        "prior": prior_json(posterior.prior, nuisance),
    }


def _bootstrap(report: SearchReport) -> Json | None:
    """Intervals of fits to exposures drawn anew; null where it was not asked for."""
    found = report.bootstrap
    if found is None:
        return None
    names = [*QUANTITIES, *(n for n in found.names if n not in QUANTITIES)]
    count: Json = {"n_fits": len(found.samples), "n_exposures": found.n_exposures}
    return _intervals(found, names) | count


def _intervals(found: Posterior | GridPosterior | Bootstrap, names: list[str]) -> Json:
    """Median, 68 and 95 % intervals: of the chain, or by direct integration over the field."""
    out: Json = {}
    for name in names:
        median, lower, upper = found.interval(name, 0.68)
        _, lower95, upper95 = found.interval(name, 0.95)
        out[name] = {
            "median": median,
            "lower": lower,
            "upper": upper,
            "lower_95": lower95,
            "upper_95": upper95,
        }
    return out


def prior_json(prior: Prior, nuisance: tuple[str, ...]) -> Json:
    """State a prior: ranges, forms, and the uniform ranges of the nuisance parameters."""
    rate = prior.fastest_mas_yr
    return {
        "separation_mas": [prior.inner_mas, prior.outer_mas],
        "contrast": [prior.contrast_min, prior.contrast_max],
        "form": prior.description,
        **({"rate_mas_yr": [-rate, rate]} if rate else {}),
    } | {name: list(range_) for name, range_ in zip(nuisance, prior.nuisance, strict=True)}


PRIOR_MADE = 0.5
"""Part of the bound by the prior alone above which a bound tells little of the data."""


def upper_limit(report: SearchReport, level: float = 0.95) -> Json | None:
    """Contrast below which a companion is, where none was detected; null where one was.

    With a contrast uniform in the range of the prior: a log-uniform one gives a bound that its
    lower end makes, as low as one likes. Null where it takes the chain's samples, which have one
    prior, and where the data do not lower the bound of the prior alone to half. Nor has a model
    that the verdict refuses a bound.
    """
    tested, posterior, grid = report.significance, report.posterior, report.grid
    if posterior is None or grid is None or (tested is not None and tested.detected):
        return None
    if report.statement in REFUSED:
        return None
    contrast = grid.upper_limit(level, uniform=True)
    low, high = posterior.prior.contrast_min, posterior.prior.contrast_max
    if contrast > PRIOR_MADE * (low + level * (high - low)):
        return None
    return {
        "level": level,
        "contrast": contrast,
        "delta_mag": float(contrast_to_delta_mag(contrast)),
        "contrast_stated_prior": grid.upper_limit(level),
        "prior": f"contrast uniform from {low:.2g} to {high:.2g}",
    }


def evidence_json(evidence: Evidence, second: Significance | None = None) -> Json:
    """Build the content of ``evidence`` in ``result.json``."""
    names = evidence.nuisance_names
    return {
        "companions": list(evidence.companions),
        "log_z": list(evidence.log_z),
        "log_z_error": [number(x) for x in evidence.log_z_error],
        "method": list(evidence.method),
        "probability": [float(x) for x in evidence.probability],
        "model_prior": list(evidence.model_prior),
        "prior": prior_json(evidence.prior, names),
        "halo": {
            "log_z": number(evidence.halo_log_z),
            "background": [0.0, HALO_BACKGROUND],
        },
        "two_companions": None if evidence.two is None else _two(evidence.two, second),
    }


def _two(two: TwoCompanions, second: Significance | None) -> Json:
    """The joint fit of two companions, the brighter one first."""
    return {
        "chi2": two.chi2,
        "false_alarm_probability": None if second is None else second.probability,
        "false_alarm_interval": None if second is None else list(second.interval),
        "ndof": two.likelihood.n_independent - len(two.theta),
        "companions": [
            {name: number(getattr(c, name)) for name in QUANTITIES}
            | {"errors": companion_errors(c)}
            for c in two.companions
        ],
    }


def _limits_beside(found: LimitsBeside | None) -> Json | None:
    return None if found is None else {"model": found.model, **limits_json(found.limit)}


def _limits(report: SearchReport) -> Json | None:
    if report.limits is None:
        return None
    joint = not integrable(report.result.likelihood)
    companion = {"companion": "the same contrast in every band, at rest"} if joint else {}
    return limits_json(report.limits) | companion | {"completeness_map": map_json(report.limits)}


def _n_own(report: SearchReport) -> int:
    """Number of calibrators that calibration was given, but for those of a library."""
    vetting = report.vetting
    return len(report.references) if vetting is None else sum(v.kept for v in vetting.calibrators)


def _calibration(report: SearchReport) -> Json | None:
    calibration = report.calibration
    if calibration is None:
        return None
    return {
        "method": calibration.method,
        "library": None if report.options.library is None else report.options.library.name,
        "n_of_library": sum(c.kept for c in calibration.calibrators[_n_own(report) :]),
        "calibrators": calibrator_verdicts(report),
        "tau": {
            "vis2": calibration.tau_vis2,
            "closure_phase_deg": None
            if calibration.tau_closure_phase_rad is None
            else float(np.degrees(calibration.tau_closure_phase_rad)),
        },
    }
