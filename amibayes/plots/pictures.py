"""The pictures of the main job, by file name."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from amibayes.companion_search.residuals_by_file import file_residuals
from amibayes.companion_search.search import resolution_mas
from amibayes.detection.false_alarm import Significance
from amibayes.limits.limit import Limit
from amibayes.pipeline.limits import NAMES, LimitsReport
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport, calibrator_verdicts
from amibayes.plots.by_file import file_residuals_plot
from amibayes.plots.calibration import calibrator_plot
from amibayes.plots.chains import trace_plot
from amibayes.plots.contrast_curve import Curve, completeness_map, limits_plot
from amibayes.plots.corner_plot import corner_plot
from amibayes.plots.coverage import coverage_plot
from amibayes.plots.fit import fit_plot
from amibayes.plots.maps import (
    detection_map,
    false_alarm_map,
    local_n_sigma,
    probability_maps,
    save_maps_fits,
    sky_map,
)
from amibayes.plots.null_plot import null_plot
from amibayes.plots.residual_corr import correlation_plot
from amibayes.plots.style import save
from amibayes.support.atomic_files import short_names
from amibayes.units import FloatArray, contrast_to_delta_mag

MAPS = "maps.fits"


def picture_names(options: SearchOptions, *, calibrated: bool, several: bool = False) -> list[str]:
    """List the files that `save_pictures` will write for a job."""
    names = ["map.png", "nsigma.png", "fit.png", "coverage.png", "correlation.png", MAPS]
    names += ["null.png", "false_alarm.png"] if options.null_draws else []
    names += ["corner.png", "chains.png"] if options.posterior else []
    names += ["limits.png", "completeness.png"] if options.limits and options.null_draws else []
    names += ["files.png"] if several else []
    return names + (["calibrators.png"] if calibrated else [])


def save_pictures(report: SearchReport, folder: Path) -> list[Path]:
    """Draw every picture of a report into a folder."""
    drawn = []
    for name, draw in pictures(report).items():
        save(draw(), folder / name)
        drawn.append(folder / name)
    save_maps_fits(folder / MAPS, report.result, _probabilities(report))
    return drawn


def _probabilities(report: SearchReport) -> dict[str, FloatArray]:
    """False-alarm probabilities per position, by the name of their FITS extension."""
    weight = report.significance
    if weight is None or weight.field is None:
        return {}
    return {f"FAP_{name}": p for name, p in probability_maps(weight).items()}


def pictures(report: SearchReport) -> dict[str, Callable[[], Figure]]:
    """Name the pictures of a report and the functions that draw them."""
    result = report.result
    out: dict[str, Callable[[], Figure]] = {
        "map.png": lambda: detection_map(result, quantity="delta_chi2", contrast="positive"),
        "nsigma.png": lambda: sky_map(
            result, local_n_sigma(result), "CANDID nσ of the best companion at each position (σ)"
        ),
        "fit.png": lambda: fit_plot(result),
        "coverage.png": lambda: coverage_plot(result.likelihood.observables),
        "correlation.png": lambda: correlation_plot(result.likelihood.observables),
    }
    if len(report.targets) > 1:
        out["files.png"] = lambda: file_residuals_plot(file_residuals(result))
    if report.calibration is not None:
        out["calibrators.png"] = lambda: _calibrators(report)
    weight = report.significance
    if weight is not None:
        out["null.png"] = lambda: _null(weight)
        out["false_alarm.png"] = lambda: false_alarm_map(result, weight)
    if report.posterior is not None:
        out["corner.png"] = lambda: _corner(report)
        out["chains.png"] = lambda: _chains(report)
    if report.limits is not None:
        out["limits.png"] = lambda: _limits(report)
        out["completeness.png"] = lambda: _completeness(report)
    return out


def _calibrators(report: SearchReport) -> Figure:
    kept = [bool(c["kept"]) for c in calibrator_verdicts(report)]
    return calibrator_plot(report.references, kept, short_names(report.calibrators))


def _null(weight: Significance) -> Figure:
    label = (
        "Largest 2Δln L anywhere in the field, scale of the noise free"
        if weight.test is not None and weight.test.label != "Δχ²"
        else "Largest Δχ² anywhere in the field"
    )
    return null_plot(
        weight.null,
        weight.statistic,
        weight.tail_curves(),
        alpha=weight.alpha,
        statistic=label,
    )


def _corner(report: SearchReport) -> Figure:
    posterior = report.posterior
    assert posterior is not None
    return corner_plot(
        posterior.samples, _labels(report), best=[float(x) for x in report.result.theta]
    )


def _labels(report: SearchReport) -> list[str]:
    """Parameters of the posterior, every contrast with its band where there are several."""
    assert report.posterior is not None
    bands = report.result.likelihood.model.bands
    firsts = {"contrast", "contrast_2"} if bands else set()
    return [f"{n}[{bands[0]}]" if n in firsts else n for n in report.posterior.names]


def _chains(report: SearchReport) -> Figure:
    posterior = report.posterior
    assert posterior is not None
    return trace_plot(posterior.chain, _labels(report), posterior.n_burn)


def _limits(report: SearchReport) -> Figure:
    limits = report.limits
    assert limits is not None
    middle = contrast_to_delta_mag(limits.contrast_50)
    curves = {
        f"{limits.completeness:.0%} recovered": Curve(
            limits.delta_mag, by_detection=limits.by_detection
        ),
        "50% recovered": Curve(middle, by_detection=limits.by_detection),
    }
    weight = report.significance
    found = report.result.companion if weight is not None and weight.detected else None
    fringe = resolution_mas(report.result.likelihood)
    return limits_plot(limits.separation_mas, curves, found, fringe_mas=fringe)


def _completeness(report: SearchReport) -> Figure:
    assert report.limits is not None
    return completeness_picture(report.limits)


def completeness_picture(limits: Limit) -> Figure:
    """Draw the completeness map of a limit by injection."""
    cells = limits.cells()
    assert cells is not None
    magnitude, share = np.array(cells["delta_mag"]), np.array(cells["completeness"])
    low, high = float(magnitude.min()), float(magnitude.max())
    regular = np.linspace(low, high, 60)
    fraction = np.array(
        [
            np.interp(regular, mag, s, left=np.nan, right=np.nan)
            for mag, s in zip(magnitude[:, ::-1], share[:, ::-1], strict=True)
        ]
    )
    return completeness_map(
        limits.separation_mas,
        regular,
        fraction,
        c50=limits.columns()["delta_mag_50"],
        c95=limits.delta_mag,
    )


def limits_picture_names(method: str) -> list[str]:
    """List the files that `save_limits_pictures` will write."""
    return ["limits.png", "completeness.png"] if method == "injection" else ["limits.png"]


def save_limits_pictures(report: LimitsReport, folder: Path) -> None:
    """Draw the curves of all limits, and the completeness map of the main one."""
    save(limits_picture(report), folder / "limits.png")
    if report.main.limit.cells() is not None:
        save(completeness_picture(report.main.limit), folder / "completeness.png")


def limits_picture(report: LimitsReport) -> Figure:
    """Draw all limits in one picture, with their spread over the position angle."""
    curves = {}
    for measured in report.limits:
        limit = measured.limit
        low, _, high = contrast_to_delta_mag(limit.spread).T
        curves[f"{NAMES[measured.observables]}, {limit.method}"] = Curve(
            limit.delta_mag, low, high, limit.by_detection
        )
    weight, main = report.main.significance, report.main.result
    found = main.companion if weight is not None and weight.detected else None
    return limits_plot(
        report.main.limit.separation_mas,
        curves,
        found,
        fringe_mas=resolution_mas(main.likelihood),
        masses=report.options.masses,
    )
