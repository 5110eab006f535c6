"""How often the intervals of a calibrated observable hold the truth, by number of calibrators.

Synthetic sets of 21 observables of one type, equal errors σ = 1, a scatter of τσ between stars
(calibrators and target alike). Columns: nominal 68.27 and 95.45 % intervals of `weighted` and
`hierarchical`, and of the estimators of the literature with Gaussian (or Student) intervals:
plain inverse variance, Birge's ratio, DerSimonian and Laird, Hartung and Knapp.
"""

from __future__ import annotations

import sys

import numpy as np
from scipy.stats import norm, t

from amibayes.calibration.scatter_likelihood import PRIOR_WIDTH, Group, Population

N_OBSERVABLES = 21
NOMINAL = (0.6827, 0.9545)
GRID = np.concatenate([[1e-3], np.geomspace(0.02, 30.0, 160)])


def population(values: np.ndarray) -> Population:
    """Calibrators' values (J, n) of unit error as a population."""
    j, n = values.shape
    one = np.ones((n, j, 1, 1))
    group = Group(
        keys=[np.array([i]) for i in range(n)],
        basis=[np.eye(1)] * n,
        design=one,
        data=values.T[..., None],
        noise=one,
        scatter=np.stack([one, 0 * one]),
        target_scatter=np.stack([one[:, 0], 0 * one[:, 0]]),
    )
    return Population((group,), np.array([PRIOR_WIDTH, np.nan]))


def quadrature(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the target's response by a sum over a grid of τ (no sampler)."""
    model = population(values)
    tau = np.stack([GRID, np.zeros_like(GRID)], axis=1)
    log_p = model.log_prob(tau)
    weight = np.exp(log_p - log_p.max()) * np.gradient(GRID)
    weight /= weight.sum()
    mean, covariance = model.groups[0].response(tau)
    centre = weight @ mean[..., 0]
    within = weight @ (covariance[..., 0, 0] + GRID[:, None] ** 2)
    return centre, within + weight @ (mean[..., 0] - centre) ** 2


def intervals(values: np.ndarray) -> dict[str, tuple[np.ndarray, np.ndarray, float]]:
    """By estimator: mean and variance of the response, (n,), degrees of freedom."""
    j = len(values)
    mean, plain = values.mean(axis=0), np.full(values.shape[1], 1.0 / j)
    out = {"inverse variance": (mean, plain, np.inf)}
    if j > 1:
        q = ((values - mean) ** 2).sum(axis=0)
        birge = q / (j - 1)
        excess = np.maximum(0.0, birge - 1.0)
        out["weighted"] = (mean, plain * np.maximum(1.0, birge), np.inf)
        out["Birge"] = (mean, plain * birge, np.inf)
        out["DerSimonian-Laird"] = (mean, (1 + excess) / j + excess, np.inf)
        out["Hartung-Knapp"] = (mean, birge / j + excess, j - 1)
        out["hierarchical"] = (*quadrature(values), np.inf)
    return out


def coverage(
    j: int, tau: float, n_sets: int, rng: np.random.Generator
) -> dict[str, tuple[float, float]]:
    """Fraction of intervals that hold the truth, at both nominal levels."""
    hits: dict[str, list[np.ndarray]] = {}
    for _ in range(n_sets):
        spread = np.hypot(1.0, tau)
        stars = spread * rng.standard_normal((j + 1, N_OBSERVABLES))
        for name, (mean, variance, freedom) in intervals(stars[1:]).items():
            off = np.abs(stars[0] - mean) / np.sqrt(1.0 + variance)
            limits = [t.ppf((1 + p) / 2, freedom) if freedom < 99 else norm.ppf((1 + p) / 2)
                      for p in NOMINAL]  # fmt: skip
            hits.setdefault(name, []).append(np.array([(off < x).mean() for x in limits]))
    return {name: tuple(np.mean(h, axis=0)) for name, h in hits.items()}


def main(n_sets: int) -> None:
    print(f"{n_sets} sets of {N_OBSERVABLES} observables, % of intervals that hold the truth")
    for j in (1, 2, 3, 5, 10):
        for tau in (0.0, 1.0, 2.0, 5.0):
            rng = np.random.default_rng([j, int(tau), 5])
            row = coverage(j, tau, n_sets, rng)
            cells = "  ".join(f"{n} {100 * a:.1f}/{100 * b:.1f}" for n, (a, b) in row.items())
            print(f"J={j} tau={tau:.0f}: {cells}", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 4000)
