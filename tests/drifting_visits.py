"""Visits of an instrument whose response drifts: V² and closure phases change in a few ways."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from helpers import niriss, simulated

from amibayes.data.observables import Observables


@dataclass(frozen=True)
class Drift:
    """Response of an instrument: modes whose amplitudes go with time, and a scatter.

    V² loses coherence with the square of the baseline; closure phases follow a pattern of pistons
    of the holes, so that they close.
    """

    amplitude: float = 1.0
    days: float = 20.0
    scatter: float = 0.3
    seed: int = 1

    def responses(self, mjd: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """V² (n, 21) and closure phases (n, 35) of a point source at some dates."""
        sheet = niriss()
        correlation = np.exp(-np.abs(mjd[:, None] - mjd) / self.days)
        lower = np.linalg.cholesky(correlation + 1e-9 * np.eye(len(mjd)))
        first, second = (lower @ rng.standard_normal((len(mjd), 2))).T
        length = np.hypot(*(c[:, 0] for c in (sheet.vis2.u_m, sheet.vis2.v_m)))
        loss = 0.02 * self.amplitude * (length / length.max()) ** 2
        vis2 = 1.0 - 0.1 * (length / length.max()) ** 2 + first[:, None] * loss
        pattern = np.random.default_rng(self.seed).standard_normal(len(sheet.vis2)) * np.radians(
            0.7
        )
        pairs = {tuple(p): k for k, p in enumerate(sheet.vis2.stations)}
        triangles = [tuple(t) for t in sheet.closure_phase.stations]
        closing = np.array(
            [
                pattern[pairs[a, b]] + pattern[pairs[b, c]] - pattern[pairs[a, c]]
                for a, b, c in triangles
            ]
        )
        phase = self.amplitude * second[:, None] * closing
        own = sheet.covariance.draw(rng, len(mjd)).T * self.scatter
        return vis2 + own[:, : len(length)], phase + own[:, len(length) :]


def visits(
    drift: Drift,
    mjd: np.ndarray,
    rng: np.random.Generator,
    companions: dict[int, list[float]] | None = None,
) -> list[Observables]:
    """Observe stars at some dates, point sources but for those with companions."""
    vis2, closure = drift.responses(np.asarray(mjd, dtype=float), rng)
    out = []
    for k, date in enumerate(mjd):
        data = simulated(niriss(), (companions or {}).get(k, [0.0, 0.0, 0.0]), rng)
        dates = [np.full(len(m), float(date)) for m in (data.vis2, data.closure_phase)]
        out.append(
            replace(
                data,
                vis2=replace(data.vis2, value=data.vis2.value * vis2[k], mjd=dates[0]),
                closure_phase=replace(
                    data.closure_phase, value=data.closure_phase.value + closure[k], mjd=dates[1]
                ),
                setups=tuple(replace(s, source=f"star{k}.oifits") for s in data.setups),
            )
        )
    return out
