"""Local fits from many seeds at once, by damped least squares.

Of few data a fit's time goes into the calls, not into the sums: seeds that step together share
the calls. The steps are those of Levenberg (1944) and Marquardt (1963) on the whitened residuals.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from amibayes.companion_search.optimise import tolerance_of, widest_steps
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.parameters import Box, Parameters
from amibayes.units import BoolArray, FloatArray, IntArray

MAX_NUMBERS = 1_500_000
"""Of derivatives of the data that are held at once: 12 MB."""

MAX_STEPS = 30
"""Of a fit that only has to tell seeds apart: most arrive after six."""

FIRST_DAMPING, MAX_DAMPING = 1e-2, 1e6
"""Marquardt's λ, in units of the squared length of a parameter's derivative: a seed of the map is
nearly right, and a step damped a millionfold moves nothing that can be seen."""

MIN_DAMPING = 1e-10
"""Where the data know nothing of a direction (the rate of a motion, in data of one night) the
damping alone keeps the step from being infinite, and it has to be above rounding."""

LONGEST = 0.3
"""Longest step of a position, in units of λ/B_max: a peak is as wide."""

EASED, RAISED = 0.1, 10.0
"""What a step that fits better, and one that does not, makes of the damping; Marquardt's own."""


ROUNDING, NO_LENGTH = 1e-9, 1e-12
"""Part of a separation by which one may miss the edge that it stands at, and mas of a position
that has no direction."""


def descend(likelihood: Likelihood, seeds: FloatArray, box: Box) -> tuple[FloatArray, FloatArray]:
    """Fit all free parameters from each of some seeds, staying near it and inside the field.

    Parameters
    ----------
    likelihood : Likelihood
    seeds : (n, n_dim) float array
    box : Box

    Returns
    -------
    theta : (n, n_dim) float array
    chi2 : (n,) float array
    """
    size = len(likelihood.observables.data) * (1 + seeds.shape[1])
    at_once = max(1, MAX_NUMBERS // size)
    parts = [seeds[k : k + at_once] for k in range(0, len(seeds), at_once)]
    found = [_together(likelihood, part, box) for part in parts]
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def _together(likelihood: Likelihood, seeds: FloatArray, box: Box) -> tuple[FloatArray, FloatArray]:
    """Step until no seed gains, each with a damping of its own."""
    field = _Field.around(likelihood.parameters, seeds, box)
    widest = widest_steps(likelihood, box)
    theta = field.clipped(seeds, np.arange(len(seeds)))
    now = _Quadratic.at(likelihood, theta)
    damping, moving = np.full(len(seeds), FIRST_DAMPING), np.ones(len(seeds), dtype=bool)
    for _ in range(MAX_STEPS):
        k = np.flatnonzero(moving)
        here = now.of(k).turned(field.axes(theta[k]))
        step = here.step(damping[k], widest, field.held(theta[k], here.slope, k))
        tried = field.moved(theta[k], step, k)
        there = _Quadratic.at(likelihood, tried)
        gain = here.chi2 - there.chi2
        better = gain > 0.0
        theta[k[better]] = tried[better]
        now.take(k[better], there.of(better))
        damping[k] = np.maximum(damping[k] * np.where(better, EASED, RAISED), MIN_DAMPING)
        enough = tolerance_of(likelihood, here.chi2)
        moving[k] = np.where(better, gain > enough, damping[k] < MAX_DAMPING)
        if not moving.any():
            break
    return theta, now.chi2


@dataclass(frozen=True, eq=False)
class _Quadratic:
    """χ² around parameter sets: value (n,), half of its downward slope, half of its curvature."""

    chi2: FloatArray
    slope: FloatArray
    curvature: FloatArray

    @classmethod
    def at(cls, likelihood: Likelihood, theta: FloatArray) -> _Quadratic:
        """Gauss and Newton's: residuals linear in the parameters."""
        white = likelihood.residuals_and_slopes(theta)
        residual, slopes = white[:, 0], white[:, 1:]
        by_set = slopes.transpose(2, 1, 0)
        return cls(
            np.einsum("dn,dn->n", residual, residual),
            np.einsum("dn,dpn->np", residual, slopes),
            by_set @ by_set.transpose(0, 2, 1),
        )

    def of(self, k: Any) -> _Quadratic:
        """Those of some sets."""
        return _Quadratic(self.chi2[k], self.slope[k], self.curvature[k])

    def take(self, k: Any, other: _Quadratic) -> None:
        """Put others in the place of some."""
        self.chi2[k], self.slope[k], self.curvature[k] = other.chi2, other.slope, other.curvature

    def turned(self, axes: FloatArray) -> _Quadratic:
        """Along other axes (n, n_dim, n_dim), one in each column."""
        back = axes.transpose(0, 2, 1)
        slope = (back @ self.slope[:, :, None])[:, :, 0]
        return _Quadratic(self.chi2, slope, back @ self.curvature @ axes)

    def step(self, damping: FloatArray, widest: FloatArray, held: BoolArray) -> FloatArray:
        """Damped step (n, n_dim); parameters that are held stay."""
        diagonal = np.maximum(np.einsum("npp->np", self.curvature), widest**-2.0)
        return damped_steps(self.curvature, self.slope, damping[:, None] * diagonal, held)


def damped_steps(
    curvature: FloatArray, slope: FloatArray, damping: FloatArray, held: BoolArray
) -> FloatArray:
    """Marquardt's steps, (n, n_dim).

    Parameters
    ----------
    curvature : (n, n_dim, n_dim) float array
    slope : (n, n_dim) float array
        Downward.
    damping : (n, n_dim) float array
        Added to the diagonal of the curvature.
    held : (n, n_dim) bool array
        Parameters that stay.
    """
    matrix = np.where(held[:, :, None] | held[:, None, :], 0.0, curvature)
    each = np.arange(slope.shape[1])
    matrix[:, each, each] += np.where(held, 1.0, damping)
    downward = np.where(held, 0.0, slope)
    return np.asarray(np.linalg.solve(matrix, downward[:, :, None])[:, :, 0])


@dataclass(frozen=True, eq=False)
class _Field:
    """Where fits may go: near each seed, within bounds, in the annulus.

    At an edge of the annulus a companion may move along it: its place steps outward and across.
    """

    low: FloatArray
    high: FloatArray
    places: tuple[IntArray, ...]
    box: Box

    @classmethod
    def around(cls, parameters: Parameters, seeds: FloatArray, box: Box) -> _Field:
        """Ranges of parameters, and positions as far as a fringe from the seed's."""
        bounds = np.array(parameters.bounds(parameters.columns()))
        low, high = (np.tile(edge, (len(seeds), 1)) for edge in bounds.T)
        at = parameters.columns("position")
        low[:, at], high[:, at] = seeds[:, at] - box.fringe_mas, seeds[:, at] + box.fringe_mas
        places = [parameters.place(k + 1) for k in range(parameters.companions)]
        return cls(low, high, tuple(places), box)

    def axes(self, theta: FloatArray) -> FloatArray:
        """Axes (n, n_dim, n_dim) of steps: outward and across in the place of east and north."""
        axes = np.tile(np.eye(theta.shape[1]), (len(theta), 1, 1))
        for east, north in self.places:
            out = theta[:, [east, north]] / _length(theta, east, north)[:, None]
            axes[:, east, east], axes[:, north, east] = out.T
            axes[:, east, north], axes[:, north, north] = -out[:, 1], out[:, 0]
        return axes

    def moved(self, theta: FloatArray, step: FloatArray, k: IntArray) -> FloatArray:
        """Parameter sets after steps along `axes`, each back to what is allowed."""
        at = [column for place in self.places for column in place]
        reach = np.abs(step[:, at]).max(axis=1, keepdims=True) / (LONGEST * self.box.fringe_mas)
        step = step / np.maximum(reach, 1.0)
        straight = (self.axes(theta) @ step[:, :, None])[:, :, 0]
        moved = theta + straight
        for east, north in self.places:  # across the line of sight to the star a step is an arc
            rho = _length(theta, east, north) + step[:, east]
            moved[:, [east, north]] *= (rho / _length(moved, east, north))[:, None]
        return self.clipped(moved, k)

    def clipped(self, theta: FloatArray, k: IntArray) -> FloatArray:
        """The nearest allowed parameter sets."""
        inside = np.clip(theta, self.low[k], self.high[k])
        for east, north in self.places:
            rho = _length(inside, east, north)
            allowed = np.clip(rho, self.box.inner_mas, self.box.outer_mas)
            inside[:, [east, north]] *= (allowed / rho)[:, None]
        return inside

    def held(self, theta: FloatArray, slope: FloatArray, k: IntArray) -> BoolArray:
        """Parameters at an end of their range, with χ² smaller beyond it."""
        value, low, high = theta.copy(), self.low[k].copy(), self.high[k].copy()
        for east, north in self.places:
            value[:, east], value[:, north] = _length(theta, east, north), 0.0
            low[:, east] = self.box.inner_mas * (1.0 + ROUNDING)
            high[:, east] = self.box.outer_mas * (1.0 - ROUNDING)
            low[:, north], high[:, north] = -np.inf, np.inf
        return np.asarray(((value <= low) & (slope < 0.0)) | ((value >= high) & (slope > 0.0)))


def _length(theta: FloatArray, east: int, north: int) -> FloatArray:
    return np.maximum(np.hypot(theta[:, east], theta[:, north]), NO_LENGTH)
