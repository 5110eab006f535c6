"""How many stars have companions: the posterior of a survey's companion frequency.

A star has a companion in a stated box of separation and contrast with probability f. Target i
then counts as a detection with probability q_i = f·p_i + (1 − f)·a_i, where p_i is its mean
probability of recovery over the box and a_i its false-positive rate: a binomial likelihood with
a probability of its own for every target, and Jeffreys' prior, the root of its Fisher
information. With p = 1 and a = 0 it is the textbook's beta distribution (k + ½, n − k + ½).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.errors import UsageError
from amibayes.survey.completeness import DetectionProbability
from amibayes.units import BoolArray, FloatArray, delta_mag_to_contrast

NODES = 2001
"""Of θ, f = sin²θ: in it Jeffreys' prior of a binomial probability is flat, and a posterior of
10⁴ targets is still 14 steps wide (1σ of θ is 1/(2√n))."""

BOX_NODES = 24
"""Separations and magnitudes over which the completeness of a box is averaged: the mean of a
logistic function that falls by 1 within a tenth of the box is then right to 1e-3."""


@dataclass(frozen=True)
class Box:
    """Companions that are counted: uniform in ln separation and in magnitude inside of it."""

    separation_mas: tuple[float, float]
    delta_mag: tuple[float, float]

    def holds(self, separation_mas: float, delta_mag: float) -> bool:
        """Whether a companion lies inside."""
        (inner, outer), (bright, faint) = self.separation_mas, self.delta_mag
        return inner <= separation_mas <= outer and bright <= delta_mag <= faint

    def completeness(self, target: DetectionProbability) -> float:
        """Mean probability that a companion in the box is recovered."""
        parts = (np.arange(BOX_NODES) + 0.5) / BOX_NODES
        inner, outer = np.log(self.separation_mas)
        bright, faint = self.delta_mag
        rho = np.exp(inner + parts * (outer - inner))
        contrast = delta_mag_to_contrast(bright + parts * (faint - bright))
        return float(target(rho, contrast).mean())


@dataclass(frozen=True, eq=False)
class FrequencyPosterior:
    """Posterior of the share of stars that have a companion.

    Parameters
    ----------
    frequency : (n,) float array
        Nodes, rising in [0, 1].
    density : (n,) float array
        Per unit of frequency.
    cumulative : (n,) float array
        Probability of a smaller frequency.
    n_targets, n_detected : int
    mean_completeness : float
    """

    frequency: FloatArray
    density: FloatArray
    cumulative: FloatArray
    n_targets: int
    n_detected: int
    mean_completeness: float

    def quantile(self, probability: float) -> float:
        """Frequency below which the truth lies with a probability."""
        return float(np.interp(probability, self.cumulative, self.frequency))

    def interval(self, level: float) -> tuple[float, float]:
        """Central credible interval."""
        rest = 0.5 * (1.0 - level)
        return self.quantile(rest), self.quantile(1.0 - rest)


def frequency_posterior(
    detected: BoolArray, completeness: FloatArray, false_positive: FloatArray | float = 0.0
) -> FrequencyPosterior:
    """Infer the companion frequency from detections and non-detections.

    Parameters
    ----------
    detected : (n,) bool array
        Targets with a detected companion inside of the box.
    completeness : (n,) float array
        Of each target, averaged over the box, at the threshold of the detections.
    false_positive : (n,) float array or float
        Probability that a target without a companion counts as a detection.

    Raises
    ------
    UsageError
        Where no target could have shown a companion.
    """
    found = np.asarray(detected, dtype=bool)
    p = np.asarray(completeness, dtype=float)
    false = np.broadcast_to(np.asarray(false_positive, dtype=float), p.shape)
    if not (p > false).any():
        raise UsageError("no target could have shown a companion in this box")
    theta = (np.arange(NODES) + 0.5) * (0.5 * np.pi / NODES)
    f = np.sin(theta) ** 2
    log_density, information = np.zeros(NODES), np.zeros(NODES)
    # Targets of one completeness share a term: a survey of 1e5 has few different ones.
    kinds, count = np.unique(np.stack([p, false, found]), axis=1, return_counts=True)
    for (own, alarm, hit), n in zip(kinds.T, count, strict=True):
        q = f * own + (1.0 - f) * alarm
        log_density += n * (np.log(q) if hit else np.log1p(-q))
        information += n * (own - alarm) ** 2 / (q * (1.0 - q))
    # dθ/df = 1/sin 2θ: the density of θ is that of f times sin 2θ.
    log_density += 0.5 * np.log(information) + np.log(np.sin(2.0 * theta))
    weight = np.exp(log_density - log_density.max())
    weight /= weight.sum()
    edges = np.concatenate([[0.0], np.cumsum(weight)])
    borders = np.sin(np.arange(NODES + 1) * (0.5 * np.pi / NODES)) ** 2
    density = np.diff(edges) / np.diff(borders)
    return FrequencyPosterior(
        f,
        density,
        np.asarray(np.interp(f, borders, edges)),
        len(found),
        int(found.sum()),
        float(p.mean()),
    )
