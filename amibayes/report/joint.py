"""A joint fit in ``result.json``: bands, motion, and each file by itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.detection.residuals import FileResiduals, file_residuals
from amibayes.likelihood.extra_noise import FileNoise
from amibayes.likelihood.residuals import files_of
from amibayes.models.bands import bands_of
from amibayes.pipeline.report_types import SearchReport
from amibayes.report.common import NOISE_KEYS, Json, noise_interval, number
from amibayes.units import contrast_to_delta_mag


def joint_fit_json(result: SearchResult) -> Json:
    """Contrasts of several bands and the motion, for ``fit``; empty where there is neither."""
    out: Json = {}
    if len(bands_of(result.likelihood.observables)) > 1:
        free = bool(result.likelihood.model.bands)
        out = {"contrast_kind": "per-filter" if free else "tied", "contrasts": _contrasts(result)}
    model = result.likelihood.model
    if model.moves:
        east, north = (float(result.theta[k]) for k in result.likelihood.parameters.rates)
        out |= {
            "east_rate_mas_yr": east,
            "north_rate_mas_yr": north,
            "reference_mjd": model.reference_mjd,
            "fastest_mas_yr": model.fastest_mas_yr,
        }
    return out


def _contrasts(result: SearchResult) -> list[Json]:
    """Every band's contrast, the reference band (that of ``fit.contrast``) first."""
    tied = (result.companion.contrast, result.companion.contrast_error)
    free = result.contrasts
    out = []
    for band in bands_of(result.likelihood.observables):
        contrast, error = free.get(band.name, tied)
        magnitude = contrast_to_delta_mag(contrast) if contrast > 0.0 else np.inf
        relative = error / contrast if contrast > 0.0 else np.nan
        out.append(
            {
                "band": band.name,
                "wavelength_um": 1e6 * band.wavelength_m,
                "contrast": contrast,
                "delta_mag": number(float(magnitude)),
                "errors": {
                    "contrast": number(error),
                    "delta_mag": number(2.5 / np.log(10.0) * relative),
                },
            }
        )
    return out


def is_joint(report: SearchReport) -> bool:
    """Whether more than one file is fitted."""
    return len(files_of(report.result.likelihood.observables)) > 1


def residuals_json(report: SearchReport) -> list[Json]:
    """Reduced χ² of every target in the order given, with the companion and without."""
    found = {f.source: f for f in file_residuals(report.result)}
    return [_one_file(path, found[path]) for path in report.targets if path in found]


def _one_file(path: str, f: FileResiduals) -> Json:
    return {
        "path": path,
        "n_vis2": f.n_vis2,
        "n_closure_phases": f.n_closure_phases,
        "chi2r_vis2": number(f.vis2),
        "chi2r_closure_phase": number(f.closure_phase),
        "chi2r_single_vis2": number(f.single_vis2),
        "chi2r_single_closure_phase": number(f.single_closure_phase),
    }


def noise_files_json(report: SearchReport) -> Json:
    """Extra noise of every file, where they have noise of their own."""
    options = report.options
    if not is_joint(report) or options.file_noise is False or not options.extra_noise:
        return {}
    own = {f.source: f for f in report.noise.files}
    found = report.noise_posterior or {}
    files = []
    for path in report.targets:
        amount = own.get(path, FileNoise(path))
        posterior = {
            key: noise_interval(found[f"{name}:{path}"], unit)
            for name, (key, unit) in NOISE_KEYS.items()
            if f"{name}:{path}" in found
        }
        files.append(
            {
                "path": path,
                "extra_vis2": amount.vis2,
                "extra_closure_phase_deg": float(np.degrees(amount.closure_phase_rad)),
                "posterior": posterior or None,
            }
        )
    return {"files": files}


def joint_lines(report: SearchReport) -> list[str]:
    """Lines of the summary on what the files share."""
    result, lines = report.result, []
    model, bands = result.likelihood.model, bands_of(result.likelihood.observables)
    if is_joint(report):
        worst = max(file_residuals(result), key=_largest)
        lines.append(
            f"files       {len(report.targets)} fitted together; worst reduced chi2 "
            f"{_largest(worst):.2f} ({Path(worst.source).name})"
        )
    if report.statement == "model rejected":
        return lines  # of which no number is stated
    if len(bands) > 1 and model.bands:
        each = [f"{b} {c:.5f} +/- {e:.5f}" for b, (c, e) in result.contrasts.items()]
        lines.append(f"per filter  {', '.join(each)} (one for all: --contrast tied)")
    elif len(bands) > 1:
        lines.append(f"per filter  one contrast for {', '.join(b.name for b in bands)}")
    if model.moves:
        columns = result.likelihood.parameters.rates
        rates, errors = result.theta[columns], np.sqrt(np.diag(result.theta_covariance))[columns]
        lines.append(
            f"motion      E {rates[0]:.3g} +/- {errors[0]:.2g}, N {rates[1]:.3g} +/- "
            f"{errors[1]:.2g} mas/yr; position of MJD {model.reference_mjd:.2f}"
        )
    return lines


def _largest(f: FileResiduals) -> float:
    return float(np.nanmax([f.vis2, f.closure_phase]))
