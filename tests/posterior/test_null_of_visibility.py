"""Two equally bright stars at a null of the visibility, where a closure phase turns at once."""

from __future__ import annotations

import numpy as np

from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior.laplace import gaussian_of
from amibayes.posterior.priors import Prior
from amibayes.units import MAS
from tests.interferometer import four_telescopes


def test_draws_around_a_mode_at_a_null_fill_all_dimensions():
    """The stars are half a fringe apart: V = (1 − c)/(1 + c), and the slope of the phase 1/V.

    An axis of 1e-7 of the errors ended the search of two equal stars.
    """
    sheet = four_telescopes(3, 3, vis2_error=0.02, closure_error_deg=1.0)
    vis2 = sheet.vis2
    u, v = (float(x[0, 0] / vis2.wavelength_m[0]) for x in (vis2.u_m, vis2.v_m))
    east, north = np.array([u, v]) / (2.0 * (u**2 + v**2)) / MAS
    likelihood = Likelihood(sheet, BinaryModel(smearing=False))
    theta = np.array([east, north, 1.0 - 1e-7])
    _, scatter = gaussian_of(likelihood, theta, Prior(0.5, 20.0))
    draws = np.random.default_rng(1).standard_normal((400, 3)) @ scatter.T
    correlation = np.corrcoef(draws.T)
    assert np.linalg.eigvalsh(correlation)[0] > 1e-9
    np.linalg.cholesky(draws.T @ draws)
