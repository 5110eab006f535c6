"""A target freed of what the instrument did to it, by way of calibrators."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.sparse import coo_array, csr_array, diags_array, triu

from amibayes.calibration.freedom import calibrated_freedom, response_freedom
from amibayes.calibration.hierarchical import hierarchical_response
from amibayes.calibration.matching import Keys, foreign, keys_of
from amibayes.calibration.transfer import (
    Diameter,
    Transfer,
    on_one_branch,
    sparse_covariance,
    transfer_of,
    wrapped,
)
from amibayes.calibration.weighted import Response, clipped, weighted_response
from amibayes.errors import DataError
from amibayes.observables import BoolArray, CovarianceKind, Observables, join
from amibayes.oifits.correlations import Pairs, given_covariance
from amibayes.units import FloatArray

Method = Literal["hierarchical", "weighted"]

FAINTEST = 3.0
"""A calibrator's V² below this many of its errors divides nothing: the ratio has no moments."""


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
        Values that went into the mean, and that stood off the other calibrators'.
    """

    path: str
    kept: bool
    reason: str
    n_used: int
    n_clipped: int


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated target and how it came about.

    Parameters
    ----------
    observables : Observables
        All targets together, with the covariance that shared calibrators give them.
    method : {"hierarchical", "weighted"}
    calibrators : tuple of CalibratorUse
        In the order given.
    tau_vis2, tau_closure_phase_rad : float, optional
        Posterior median of the scatter between calibrators (hierarchical).
    n_setups : tuple of int
        Number of setups of each target.
    tau : (n, 2) float array, optional
        Posterior draws of both scatters.
    """

    observables: Observables
    method: Method
    calibrators: tuple[CalibratorUse, ...]
    tau_vis2: float | None
    tau_closure_phase_rad: float | None
    n_setups: tuple[int, ...]
    tau: FloatArray | None = None

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


def calibrate(
    targets: Observables | Sequence[Observables],
    calibrators: Sequence[Observables],
    *,
    method: Method | None = None,
    clip: float | None = 3.0,
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
        Several targets keep the covariance that the calibrators they share give them.
    calibrators : sequence of Observables
    method : {"hierarchical", "weighted"}, optional
        Inverse-variance means, with the scatter where it is larger than the errors; or random
        effects (see `amibayes.calibration.hierarchical`), the default with 3 or more.
    clip : float, optional
        Leave out values that stand off the other calibrators' by more standard deviations.
    diameters_mas : sequence of float or (float, float), optional
        Uniform-disc diameter of each calibrator, or diameter and error.
    window_days : float, optional
        Use only calibrators observed within this time of each epoch of the target.
    charge_levels : sequence of float, optional
        Of the target, then of each calibrator: the response may depend on them linearly.
    rng : numpy.random.Generator, optional
        A fixed seed by default.

    Raises
    ------
    DataError
        Where calibrators are none, too few, the target itself, or have nothing in common.
    """
    parts = [targets] if isinstance(targets, Observables) else list(targets)
    calibrators = list(calibrators)
    chosen = _method(method, parts, calibrators)
    _refuse_same(parts, calibrators)
    target = join(parts)
    keys = keys_of(target, window_days)
    diameters = _diameters(diameters_mas, calibrators)
    seen = [transfer_of(c, keys, d) for c, d in zip(calibrators, diameters, strict=True)]
    serving = _serving(target, calibrators, seen, chosen)
    covariate = _covariate(charge_levels, calibrators, serving, chosen)
    kept = on_one_branch([seen[j] for j in serving], keys.n_vis2)
    kept = kept if clip is None else clipped(kept, keys, clip)
    notes = tuple(n for j in serving if (n := foreign(calibrators[j], keys)))
    if chosen == "weighted":
        response = weighted_response(kept, keys)
    else:
        response = hierarchical_response(kept, keys, rng or np.random.default_rng(1), covariate)
    response = replace(response, freedom=response_freedom([calibrators[j] for j in serving], kept))
    return Calibration(
        _calibrated(target, keys, response, calibrators, notes),
        chosen,
        _uses(calibrators, seen, dict(zip(serving, kept, strict=True))),
        *_tau(response),
        tuple(len(p.setups) for p in parts),
        response.tau,
    )


def _method(
    method: Method | None, parts: list[Observables], calibrators: list[Observables]
) -> Method:
    source = parts[0].source if parts else None
    if not parts:
        raise DataError("no target to calibrate", remedy="give at least one file")
    if not calibrators:
        raise DataError("no calibrator given", source=source, remedy="give at least one")
    if method == "hierarchical" and len(calibrators) < 2:
        raise DataError(
            "one calibrator says nothing of the scatter between calibrators",
            source=source,
            remedy="give more of them, or use the weighted method",
        )
    return method or ("hierarchical" if len(calibrators) >= 3 else "weighted")


def _refuse_same(parts: list[Observables], calibrators: list[Observables]) -> None:
    """Refuse a calibrator whose data are those of the target or of another calibrator."""
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
    method: Method,
) -> list[int]:
    """Numbers of the calibrators that have something in common with the target."""
    serving = [j for j, transfer in enumerate(seen) if transfer.seen.any()]
    if not serving:
        names = ", ".join(c.source or "calibrator" for c in calibrators)
        raise DataError(
            f"has no baseline at the same wavelength in common with {names}",
            source=target.source,
            remedy="give calibrators of the same instrument, stations and filter",
        )
    if method == "hierarchical" and len(serving) < 2:
        raise DataError(
            "has only one calibrator with baselines in common",
            source=target.source,
            remedy="give more of them, or use the weighted method",
        )
    return serving


def _covariate(
    charge_levels: Sequence[float] | None,
    calibrators: list[Observables],
    serving: list[int],
    method: Method,
) -> FloatArray | None:
    """Charge levels less that of the target, on the scale of the largest difference."""
    if charge_levels is None:
        return None
    if method == "weighted":
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


def _calibrated(
    target: Observables,
    keys: Keys,
    response: Response,
    calibrators: list[Observables],
    notes: tuple[str, ...],
) -> Observables:
    """Apply the response to the target."""
    error = np.sqrt(response.covariance.diagonal())
    usable = response.known.copy()
    usable[: keys.n_vis2] &= (response.value > FAINTEST * error)[: keys.n_vis2]
    keep = usable[keys.key]
    if not keep.any():
        raise DataError(
            "nothing is left: the V² of the calibrators are lost in their errors",
            source=target.source,
            remedy="use brighter calibrators",
        )
    used = target.select(*_on_entries(target, keep)).unflagged()
    key, sign = keys.key[keep], keys.sign[keep]
    value, target_slope, response_slope = _values(used, key, sign, response)
    spread = coo_array((response_slope, (np.arange(len(key)), key)), shape=(len(key), len(keys)))
    own = diags_array(target_slope)
    by_target = csr_array(own @ sparse_covariance(used.covariance) @ own)
    by_response = csr_array(spread @ response.covariance @ spread.T)
    kind = _kind(target, calibrators, keys)
    made = _rebuilt(target, keep, value, csr_array(by_target + by_response), kind, keys, notes)
    freedom = calibrated_freedom(
        made.covariance, by_target, used.freedom, by_response, response.freedom
    )
    return replace(made, freedom=freedom)


def _values(
    used: Observables, key: np.ndarray, sign: np.ndarray, response: Response
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Calibrated data and their derivatives by the target's datum and by the response."""
    n, data, m = used.n_vis2, used.data, response.value[key]
    value = np.concatenate([data[:n] / m[:n], wrapped(data[n:] - (sign * m)[n:])])
    by_target, by_response = np.ones(len(data)), -sign.astype(float)
    by_target[:n] = 1.0 / m[:n]
    by_response[:n] = -data[:n] / m[:n] ** 2
    return value, by_target, by_response


def _on_entries(target: Observables, keep: BoolArray) -> tuple[BoolArray, BoolArray]:
    """A mask of the unflagged data as masks of all V² and closure phases."""
    vis2, closure = ~target.vis2.flag, ~target.closure_phase.flag
    vis2[vis2] = keep[: target.n_vis2]
    closure[closure] = keep[target.n_vis2 :]
    return vis2, closure


def _rebuilt(
    target: Observables,
    keep: BoolArray,
    value: FloatArray,
    covariance: csr_array,
    kind: CovarianceKind,
    keys: Keys,
    notes: tuple[str, ...],
) -> Observables:
    """The target with calibrated values; what could not be calibrated is flagged."""
    vis2_kept, closure_kept = _on_entries(target, keep)
    vis2, closure = target.vis2.value.copy(), target.closure_phase.value.copy()
    n = int(vis2_kept.sum())
    vis2[vis2_kept], closure[closure_kept] = value[:n], value[n:]
    new_vis2 = replace(target.vis2, value=vis2, flag=~vis2_kept)
    new_closure = replace(target.closure_phase, value=closure, flag=~closure_kept)
    upper = triu(covariance, 1).tocoo()
    used = upper.data != 0
    pairs = Pairs(
        upper.row[used].astype(np.intp), upper.col[used].astype(np.intp), upper.data[used]
    )
    everywhere = np.ones(len(value), dtype=bool)
    lost = int((~keep).sum())
    notes = (*notes, *((f"{lost} value(s) without calibrator flagged",) if lost else ()))
    return replace(
        target,
        vis2=new_vis2,
        closure_phase=new_closure,
        covariance=given_covariance(
            covariance.diagonal(),
            pairs,
            new_closure.select(closure_kept),
            covered=everywhere,
            independent=everywhere & keys.independent,
        ),
        covariance_kind=kind,
        notes=(*target.notes, *notes),
    )


def _kind(target: Observables, calibrators: list[Observables], keys: Keys) -> CovarianceKind:
    """That of the least certain part; independent errors only where they were asked for."""
    if keys.independent:
        return "diagonal"
    kinds: list[CovarianceKind] = ["assumed", "estimated", "given"]
    found = [o.covariance_kind for o in (target, *calibrators)]
    return min([k for k in found if k in kinds] or ["assumed"], key=kinds.index)


def _tau(response: Response) -> tuple[float | None, float | None]:
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
        reason = "" if used == n else f"{n - used} of {n} values stand off the other calibrators'"
        if not n:
            reason = "no baseline at the same wavelength and time in common with the target"
        uses.append(CalibratorUse(calibrator.source, used > 0, reason, used, n - used))
    return tuple(uses)
