"""A point source seen by four telescopes through several spectral channels, night after night."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.special import gamma, jv

from amibayes.data.observables import Observables, join
from amibayes.data.point_source import point_source
from amibayes.units import MAS

TELESCOPES_M = np.array([[0.0, 0.0], [35.0, 12.0], [-20.0, 60.0], [70.0, 85.0]])
"""Baselines of 37 to 110 m: λ/B_max is 3.1 mas in H."""


def four_telescopes(
    n_exposures: int,
    channels: int = 3,
    *,
    vis2_error: float = 0.02,
    closure_error_deg: float = 1.0,
    turn_deg: float = 60.0,
    wavelength_m: tuple[float, float] = (1.55e-6, 1.75e-6),
) -> Observables:
    """Exposures ten minutes apart while the sky turns by ``turn_deg`` in all."""
    band = (wavelength_m[1] - wavelength_m[0]) / max(channels - 1, 1)
    parts = []
    for k, angle in enumerate(np.radians(np.linspace(0.0, turn_deg, n_exposures))):
        turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        parts.append(
            point_source(
                TELESCOPES_M @ turned.T,
                np.linspace(*wavelength_m, channels),
                band,
                vis2_error=vis2_error,
                closure_error_rad=np.radians(closure_error_deg),
                mjd=60000.0 + k / 144.0,
                insname="PIONIER",
            )
        )
    return join(parts)


def common_errors(
    data: Observables, vis2: float, closure_rad: float, rng: np.random.Generator
) -> np.ndarray:
    """Errors (n_data,) that the channels of an exposure share, one for each row of a table."""
    out = []
    for table, size in ((data.vis2, vis2), (data.closure_phase, closure_rad)):
        key = np.stack([table.setup, table.row], axis=1)
        row = np.unique(key, axis=0, return_inverse=True)[1].ravel()
        out.append(size * rng.standard_normal(row.max() + 1)[row])
    return np.concatenate(out)


def darkened_disc(diameter_mas: float, exponent: float, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Visibility of a disc I(μ) = μ^α, Hestroffer (1997), at spatial frequencies in 1/rad."""
    nu = 0.5 * exponent + 1.0
    x = np.maximum(np.pi * diameter_mas * MAS * np.hypot(u, v), 1e-9)
    return gamma(nu + 1.0) * jv(nu, x) / (x / 2.0) ** nu


def visibilities(
    sheet: Observables, source: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """What a source shows on the baselines (n_vis2,) and on the sides of triangles (n_cp, 3).

    ``source`` takes spatial frequencies, 1/rad, and wavelengths, m; smearing is left out.
    """
    vis2, closure = sheet.vis2, sheet.closure_phase
    u, v = (x[:, 0] / vis2.wavelength_m for x in (vis2.u_m, vis2.v_m))
    wavelength = closure.wavelength_m[:, None]
    sides = [np.column_stack([x, -x.sum(axis=1)]) / wavelength for x in (closure.u_m, closure.v_m)]
    return source(u, v, vis2.wavelength_m), source(*sides, wavelength)


def observed(
    sheet: Observables,
    source: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    rng: np.random.Generator | None = None,
) -> Observables:
    """Data of a source as for `visibilities`, with noise of the sheet's (none without rng)."""
    both, sides = visibilities(sheet, source)
    data = np.concatenate([np.abs(both) ** 2, np.angle(sides.prod(axis=1))])
    if rng is not None:
        data = data + sheet.covariance.draw(rng, 1)[:, 0]
    return sheet.with_data(data)
