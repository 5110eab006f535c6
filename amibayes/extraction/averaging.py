"""From integrations to one set of observables with its joint covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.extraction.frames import Frames
from amibayes.units import ComplexArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Average:
    """Mean observables of some integrations.

    Parameters
    ----------
    vis2 : (n_baselines,) array
    closure_phase : (n_triangles,) array
        Phase of the mean bispectrum, radians.
    deviation : (n, n_baselines + n_triangles) array
        What each integration deviates from the mean by, V² and closure phase, to first
        order in its noise; its mean is zero.
    """

    vis2: FloatArray
    closure_phase: FloatArray
    deviation: FloatArray


def average(frames: Frames, pointed: ComplexArray, triangles: IntArray) -> Average:
    """Average power and bispectrum, not their ratios and phases.

    Parameters
    ----------
    frames : Frames
        The integrations to be used.
    pointed : (n, n_baselines) complex array
        What each integration's pointing makes of a visibility of 1.
    triangles : (n_triangles, 3) int array
        Baselines ij, jk, ik of every triangle.
    """
    power = frames.power / np.abs(pointed) ** 2
    turn = pointed / np.abs(pointed)
    ij, jk, ik = (turn[:, index] for index in triangles.T)
    bispectrum = frames.bispectrum * (ij * jk).conj() * ik
    square = frames.square.mean()
    vis2 = power.mean(axis=0) / square
    by_vis2 = (power - frames.square[:, None] * vis2) / square
    total = bispectrum.mean(axis=0)
    by_closure = (bispectrum / total).imag
    return Average(vis2, np.angle(total), np.concatenate([by_vis2, by_closure], axis=1))
