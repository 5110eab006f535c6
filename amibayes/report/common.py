"""Pieces of JSON that several commands write in one and the same way."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from amibayes.companion_search.result import SearchResult
from amibayes.data.observables import Observables
from amibayes.detection.outlying_rows import OutlyingRow
from amibayes.likelihood.averaged_noise import NoisePosterior
from amibayes.likelihood.channel_noise import share_of
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.support.atomic_files import sha256

Json = dict[str, Any]

NOISE_KEYS = {
    "vis2": ("extra_vis2", 1.0),
    "closure_phase_rad": ("extra_closure_phase_deg", float(np.degrees(1.0))),
}
"""Names in ``result.json`` of the kinds of `ExtraNoise`, and their units."""


def number(value: float) -> float | None:
    """Make a float for JSON: null where it is not finite."""
    return float(value) if math.isfinite(value) else None


def numbers(values: Iterable[float]) -> list[float | None]:
    """Make floats for JSON: null where one is not finite."""
    return [number(value) for value in values]


def inputs_json(targets: Sequence[str], calibrators: Sequence[str]) -> list[Json]:
    """List the input files with their checksums and roles."""
    files = [(p, "target") for p in targets] + [(p, "calibrator") for p in calibrators]
    return [{"path": path, "sha256": sha256(path), "role": role} for path, role in files]


def data_json(result: SearchResult, left_out: Sequence[OutlyingRow] = ()) -> Json:
    """Describe the data that were fitted, what was left out of them, and the field."""
    used = result.likelihood.observables
    freedom = used.freedom
    return {
        "n_vis2": used.n_vis2,
        "n_closure_phases": used.n_closure_phases,
        **({} if used.phase_name == "closure phase" else {"phases": used.phase_name}),
        "n_independent": used.n_independent,
        "left_out": left_out_json(left_out),
        "covariance": used.covariance_kind,
        "n_integrations": used.n_integrations,
        "degrees_of_freedom": None if freedom is None else freedom.degrees,
        "n_over_p": None if freedom is None else (freedom.scatter + 1.0) / used.n_independent,
        "scatter_share": None if freedom is None else min(1.0, freedom.scatter_share),
        "instruments": list(dict.fromkeys(s.insname for s in used.setups)),
        "targets": list(dict.fromkeys(s.target for s in used.setups if s.target)),
        "separation_mas": [result.grid.inner_mas, result.grid.outer_mas],
    }


def left_out_json(rows: Sequence[OutlyingRow]) -> list[Json]:
    """List the rows that were left out."""
    listed = []
    for row in rows:
        one = asdict(row) | {"mjd": number(row.mjd)}
        del one["phase"]
        listed.append(one)
    return listed


def channel_correlation_json(noise: ExtraNoise) -> Json:
    """Correlation of neighbouring channels' noise, its error, what all share, and exposures share.

    And errors that are smooth over channels, in units of the errors. Of files with correlations
    of their own the mean.
    """
    found: Json = {}
    for key in ("vis2", "closure_phase"):
        shares = [getattr(s, key) for s in noise.channels]
        value, error = (np.array([getattr(s, n) for s in shares]) for n in ("value", "error"))
        known = np.isfinite(error)
        found[key] = float(value[known].mean()) if known.any() else 0.0
        spread = np.sqrt((error[known] ** 2).sum()) / known.sum() if known.any() else np.nan
        found[f"{key}_error"] = number(float(spread))
        common = [s.common for s, ok in zip(shares, known, strict=True) if ok]
        found[f"{key}_common"] = float(np.mean(common)) if common else 0.0
        lasting = [sum(s.lasting) for s in shares]
        found[f"{key}_lasting"] = float(np.mean(lasting)) if lasting else 0.0
        smooth = np.array([s.smooth for s in shares]).reshape(-1, 3)
        rms = np.sqrt(smooth.mean(axis=0)) if len(smooth) else np.zeros(3)
        for name, size in zip(("offset", "slope", "curve"), rms.tolist(), strict=True):
            found[f"{key}_{name}_in_errors"] = size
    return found


def in_errors_json(noise: ExtraNoise, stated: Observables) -> Json:
    """Extra noise in units of the typical stated error of its kind."""
    n, variance = stated.n_vis2, stated.covariance.variance
    out: Json = {}
    for key, amount, part in (
        ("extra_vis2_in_errors", noise.vis2, variance[:n]),
        ("extra_closure_phase_in_errors", noise.closure_phase_rad, variance[n:]),
    ):
        out[key] = float(amount / np.sqrt(np.median(part))) if len(part) else 0.0
    return out


def systematics_json(noise: ExtraNoise) -> list[Json]:
    """Floors of calibration errors, file by file, and how many times as large they were found."""
    out = []
    for f in noise.floors:
        share = share_of(noise.channels, f.source)
        times = {
            f"{key}_{part}_times": float(np.sqrt(getattr(found, part)))
            for key, found in (("vis2", share.vis2), ("closure_phase", share.closure_phase))
            for part in ("offset", "slope")
        }
        out.append(
            {
                "path": f.source,
                "vis2_relative": f.vis2,
                "visibility": f.visibility,
                "closure_phase_deg": float(np.degrees(f.closure_phase_rad)),
                "instrument": f.instrument or None,
                "reference": f.reference or None,
                **times,
            }
        )
    return out


def noise_interval(found: NoisePosterior, unit: float) -> Json:
    """Intervals of the extra noise of one kind of observable."""
    median, lower, upper = (unit * x for x in found.interval(0.68))
    _, lower95, upper95 = (unit * x for x in found.interval(0.95))
    return {
        "median": median,
        "lower": lower,
        "upper": upper,
        "lower_95": lower95,
        "upper_95": upper95,
        "probability_errors_right": found.probability_none,
    }
