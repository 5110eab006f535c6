"""A target freed of what the instrument did to it, by way of calibrators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.calibration.applying import apply_response
from amibayes.calibration.freedom import response_freedom
from amibayes.calibration.hierarchical import hierarchical_response
from amibayes.calibration.matching import Keys, foreign, keys_of
from amibayes.calibration.narrowing import Narrowed, narrowed
from amibayes.calibration.population import population_response, unlike_the_others
from amibayes.calibration.transfer import (
    Diameter,
    Transfer,
    on_one_branch,
    transfer_of,
)
from amibayes.calibration.weighted import TransferFunction, clipped, weighted_response
from amibayes.data.observables import Observables, join
from amibayes.errors import DataError
from amibayes.support.arguments import checks_arguments
from amibayes.support.notebook import Rows, Shown
from amibayes.support.options import CLIP_CALIBRATORS, CalibrationMethod
from amibayes.units import FloatArray


@dataclass(frozen=True)
class CalibratorUse:
    """What became of one calibrator.

    Parameters
    ----------
    path : str
    kept : bool
    reason : str
        Why it was not used, or what was left out of it; empty where nothing was.
    n_used, n_clipped : int
        Values that went into the mean, and that were outliers among the calibrators.
    """

    path: str
    kept: bool
    reason: str
    n_used: int
    n_clipped: int

    @property
    def in_words(self) -> str:
        """Kept or left out, and why."""
        used = f"{self.n_used} values used" if self.kept else "left out"
        return f"{used}: {self.reason}" if self.reason else used


@dataclass(frozen=True, eq=False, repr=False)
class Calibration(Shown):
    """A calibrated target and how it came about.

    Parameters
    ----------
    observables : Observables
        All targets together, with the covariance that shared calibrators give them.
    method : {"hierarchical", "weighted", "population"}
    calibrators : tuple of CalibratorUse
        In the order given.
    tau_vis2, tau_closure_phase_rad : float, optional
        Posterior median of the scatter between calibrators (hierarchical).
    n_setups : tuple of int
        Number of setups of each target.
    tau : (n, 2) float array, optional
        Posterior draws of both scatters.
    told : Narrowed, optional
        What calibrators of different charge told of errors that all data share.
    """

    observables: Observables
    method: CalibrationMethod
    calibrators: tuple[CalibratorUse, ...]
    tau_vis2: float | None
    tau_closure_phase_rad: float | None
    n_setups: tuple[int, ...]
    tau: FloatArray | None = None
    told: Narrowed | None = None

    def rows(self) -> Rows:
        """What an interpreter shows."""
        taus = (("V²", self.tau_vis2, ""), ("closure phase", self.tau_closure_phase_deg, "°"))
        return [
            ("method", self.method),
            ("targets", len(self.n_setups)),
            *((use.path or "calibrator", use.in_words) for use in self.calibrators),
            *((f"scatter of {name}", f"{t:.2g}{unit}") for name, t, unit in taus if t is not None),
            ("result", repr(self.observables)),
        ]

    @property
    def tau_closure_phase_deg(self) -> float | None:
        """Scatter of closure phases in degrees."""
        tau = self.tau_closure_phase_rad
        return None if tau is None else float(np.degrees(tau))

    def as_json(self) -> dict[str, object]:
        """As `result.json` holds it."""
        return {
            "method": self.method,
            "calibrators": [
                {"path": use.path, "kept": use.kept, "reason": use.reason}
                for use in self.calibrators
            ],
            "tau": {"vis2": self.tau_vis2, "closure_phase_deg": self.tau_closure_phase_deg},
        }

    @property
    def targets(self) -> tuple[Observables, ...]:
        """Each target by itself (without its covariance with the others)."""
        ends = np.cumsum(self.n_setups)
        whole = self.observables
        return tuple(
            whole.select(
                (whole.vis2.setup >= end - n) & (whole.vis2.setup < end),
                (whole.closure_phase.setup >= end - n) & (whole.closure_phase.setup < end),
            )
            for n, end in zip(self.n_setups, ends, strict=True)
        )


@checks_arguments
def calibrate(
    targets: Observables | Sequence[Observables],
    calibrators: Sequence[Observables],
    *,
    method: CalibrationMethod | None = None,
    clip: float | None = CLIP_CALIBRATORS,
    diameters_mas: Sequence[float | Diameter] | None = None,
    window_days: float | None = None,
    charge_levels: Sequence[float] | None = None,
    rng: np.random.Generator | None = None,
) -> Calibration:
    """Divide V² and subtract closure phases of calibrators, with the full covariance.

    Matched by baseline or triangle (stations by name or place, in any order) and wavelength.

    Parameters
    ----------
    targets : Observables, or a sequence of them
        Several keep the covariance that shared calibrators give them.
    calibrators : sequence of Observables
    method : {"hierarchical", "weighted", "population"}, optional
        Inverse-variance means; random effects (`amibayes.calibration.hierarchical`), the default
        where 2 share a baseline; or many that drift (`amibayes.calibration.population`).
    clip : float, optional
        Leave out values that differ from the other calibrators' by more standard deviations.
    diameters_mas : sequence of float or (diameter, error), optional
        Of each calibrator, as a uniform disc.
    window_days : float, optional
        Use only calibrators observed within this time of each epoch of the target.
    charge_levels : sequence of float, optional
        Of target, then calibrators: the response may depend on them linearly.
    rng : numpy.random.Generator, with a fixed seed by default

    Raises
    ------
    UsageError, DataError
        For an unknown method; for calibrators that are none, too few or do not belong here.
    """
    parts = [targets] if isinstance(targets, Observables) else list(targets)
    target = _joined(parts, calibrators := list(calibrators))
    keys = keys_of(target, window_days)
    seen = _transfers(calibrators, keys, diameters_mas)
    serving = _serving(target, calibrators, seen, window_days)
    chosen = _method(method, target, [seen[j] for j in serving])
    covariate = _covariate(charge_levels, calibrators, serving, chosen)
    used = [calibrators[j] for j in serving]
    kept = _consistent([seen[j] for j in serving], keys, None if chosen == "population" else clip)
    mjd = [mean_mjd(c) for c in (target, *used)]
    target, kept, told = _told(target, kept, covariate)
    response = _response(chosen, kept, keys, rng or np.random.default_rng(1), covariate, mjd)
    response = replace(response, freedom=response_freedom(used, kept))
    return Calibration(
        apply_response(target, keys, response, calibrators, _notes(used, keys, response)),
        chosen,
        _uses(calibrators, seen, dict(zip(serving, kept, strict=True))),
        *_tau(response),
        tuple(len(p.setups) for p in parts),
        response.tau,
        told,
    )


def _notes(used: list[Observables], keys: Keys, response: TransferFunction) -> tuple[str, ...]:
    unlike = (unlike_the_others(used[j].source, chi2) for j, chi2 in response.unlike)
    return (*(note for c in used if (note := foreign(c, keys))), *unlike)


def _told(
    target: Observables, kept: list[Transfer], covariate: FloatArray | None
) -> tuple[Observables, list[Transfer], Narrowed | None]:
    """Shared errors narrowed by the calibrators; a response that goes with charge has its own."""
    told = narrowed(kept) if covariate is None else None
    if told is None:
        return target, kept, None
    return told.of_target(target), [told.of_transfer(t) for t in kept], told


def mean_mjd(observables: Observables) -> float:
    """Mean date of the data that are not flagged."""
    parts = [m.mjd[~m.flag] for m in (observables.vis2, observables.closure_phase)]
    return float(np.concatenate(parts).mean())


def _method(
    method: CalibrationMethod | None, target: Observables, serving: list[Transfer]
) -> CalibrationMethod:
    """The method asked for, or what the calibrators of one baseline are enough for."""
    together = int(np.sum([t.seen for t in serving], axis=0).max())
    if method == "hierarchical" and together < 2:
        raise DataError(
            "one calibrator cannot tell the scatter between calibrators, and no baseline has more",
            source=target.source,
            remedy="give more of them, or use the weighted method",
        )
    return method or ("hierarchical" if together >= 2 else "weighted")


def _joined(parts: list[Observables], calibrators: list[Observables]) -> Observables:
    """Lay all targets together, and refuse calibrators that do not go with them."""
    _refuse_same(parts, calibrators)
    target = join(parts)
    _refuse_other_extraction(target, calibrators)
    return target


def _refuse_same(parts: list[Observables], calibrators: list[Observables]) -> None:
    """Refuse no data at all, and calibrators that are the target or another calibrator."""
    if not parts:
        raise DataError("no target to calibrate", remedy="give at least one file")
    if not calibrators:
        raise DataError("no calibrator given", source=parts[0].source, remedy="give at least one")
    before: list[tuple[Observables, str]] = [(p, "the target") for p in parts]
    for calibrator in calibrators:
        for other, name in before:
            if np.array_equal(calibrator.data, other.data):
                raise DataError(
                    f"holds the data of {name} {other.source}".rstrip(),
                    source=calibrator.source,
                    remedy="give every observation once",
                )
        before.append((calibrator, "another calibrator"))


def _refuse_other_extraction(target: Observables, calibrators: list[Observables]) -> None:
    """Refuse calibrators whose images were measured in another way: their errors differ too."""
    own = _extracted(target)
    for calibrator in calibrators:
        other = _extracted(calibrator)
        if own and other and own != other:
            raise DataError(
                f"was extracted by {_listed(other)}, the target by {_listed(own)}",
                source=calibrator.source,
                remedy="extract both by one method",
            )


def _extracted(observables: Observables) -> set[str]:
    """Methods that images of some observables were measured by, where they are known."""
    responses = (setup.response for setup in observables.setups)
    return {r.method for r in responses if r is not None and r.method}


def _listed(names: set[str]) -> str:
    return ", ".join(sorted(names))


def _transfers(
    calibrators: list[Observables],
    keys: Keys,
    diameters_mas: Sequence[float | Diameter] | None,
) -> list[Transfer]:
    """The response by each calibrator, without its disc."""
    diameters = _diameters(diameters_mas, calibrators)
    return [transfer_of(c, keys, d) for c, d in zip(calibrators, diameters, strict=True)]


def _consistent(serving: list[Transfer], keys: Keys, clip: float | None) -> list[Transfer]:
    """Calibrators with closure phases on one branch, without outliers.

    Those of a drifting population are its extremes, and tell most of its components: none goes.
    """
    kept = on_one_branch(serving, keys)
    return kept if clip is None else clipped(kept, keys, clip)


def _response(
    method: CalibrationMethod,
    kept: list[Transfer],
    keys: Keys,
    rng: np.random.Generator,
    covariate: FloatArray | None,
    mjd: Sequence[float],
) -> TransferFunction:
    if method == "population":
        return population_response(kept, keys, np.array(mjd[1:]), mjd[0])
    if method == "weighted":
        return weighted_response(kept, keys)
    return hierarchical_response(kept, keys, rng, covariate)


def _diameters(
    given: Sequence[float | Diameter] | None, calibrators: list[Observables]
) -> list[Diameter]:
    if given is None:
        return [(0.0, 0.0)] * len(calibrators)
    if len(given) != len(calibrators):
        raise DataError(
            f"{len(given)} diameters for {len(calibrators)} calibrators",
            remedy="give one for each, in their order",
        )
    pairs = [(float(d), 0.0) if isinstance(d, int | float) else d for d in given]
    if not all(np.isfinite(p).all() and min(p) >= 0 for p in pairs):
        raise DataError("a diameter that is negative or not finite", remedy="give mas")
    return pairs


def _serving(
    target: Observables,
    calibrators: list[Observables],
    seen: list[Transfer],
    window_days: float | None,
) -> list[int]:
    """Numbers of the calibrators that have something in common with the target."""
    serving = [j for j, transfer in enumerate(seen) if transfer.seen.any()]
    if not serving:
        names = ", ".join(c.source or "calibrator" for c in calibrators)
        if any(s.kernel is not None for part in (target, *calibrators) for s in part.setups):
            raise DataError(
                f"has another kernel matrix, or wavelength, than {names}",
                source=target.source,
                remedy="extract both with one model of the pupil",
            )
        near = "" if window_days is None else f" within {window_days:g} d"
        raise DataError(
            f"has no baseline at the same wavelength{near} in common with {names}",
            source=target.source,
            remedy="give calibrators of the same instrument, stations and filter",
        )
    return serving


def _covariate(
    charge_levels: Sequence[float] | None,
    calibrators: list[Observables],
    serving: list[int],
    method: CalibrationMethod,
) -> FloatArray | None:
    """Charge levels less that of the target, on the scale of the largest difference."""
    if charge_levels is None:
        return None
    if method != "hierarchical":
        raise DataError(
            "charge levels are for the hierarchical method", remedy="use it or leave them out"
        )
    levels = np.asarray(charge_levels, dtype=float)
    if len(levels) != 1 + len(calibrators) or not np.isfinite(levels).all():
        raise DataError(
            f"{len(levels)} charge levels for a target and {len(calibrators)} calibrators",
            remedy="give one number for each, the target first",
        )
    covariate = (levels[1:] - levels[0])[serving]
    if len(np.unique(covariate)) < 2 or len(covariate) < 3:
        raise DataError(
            "a dependence on charge level needs 3 calibrators of different levels",
            remedy="leave the charge levels out",
        )
    return np.asarray(covariate / np.abs(covariate).max())


def _tau(response: TransferFunction) -> tuple[float | None, float | None]:
    if response.tau is None:
        return None, None
    median = [float(np.median(draws)) for draws in response.tau.T]
    return tuple(None if np.isnan(m) else m for m in median)  # type: ignore[return-value]


def _uses(
    calibrators: list[Observables], seen: list[Transfer], kept: dict[int, Transfer]
) -> tuple[CalibratorUse, ...]:
    uses = []
    for j, (calibrator, transfer) in enumerate(zip(calibrators, seen, strict=True)):
        n = int(transfer.seen.sum())
        used = int(kept[j].seen.sum()) if j in kept else 0
        what = "is an outlier" if n - used == 1 else "are outliers"
        reason = "" if used == n else f"{n - used} of {n} values {what} among the calibrators"
        if not n:
            reason = "no baseline at the same wavelength and time in common with the target"
        uses.append(CalibratorUse(calibrator.source, used > 0, reason, used, n - used))
    return tuple(uses)
