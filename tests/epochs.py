"""One star in several bands and at several dates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers import NIRISS_HOLES

from amibayes.data.observables import Observables
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood

F430M, F480M = (4.286e-6, 0.213e-6), (4.817e-6, 0.302e-6)
"""Wavelength and width."""

MJD = (60000.0, 60200.0, 60500.0)


def epoch(
    band=F480M,
    mjd=60000.0,
    source="a.oifits",
    insname="NIRISS",
    turn_deg=0.0,
    stations=NIRISS_HOLES,
    vis2_error=0.005,
    closure_error_deg=0.3,
) -> Observables:
    """A noiseless point source in one band at one date, the mask turned on the sky."""
    c, s = np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg))
    data = point_source(
        stations @ np.array([[c, s], [-s, c]]),
        *band,
        vis2_error=vis2_error,
        closure_error_rad=np.radians(closure_error_deg),
        insname=insname,
        mjd=mjd,
    )
    return replace(data, setups=(replace(data.setups[0], source=source),))


def noisy(sheet: Observables, truth, rng) -> Observables:
    """Data of a companion (east, north, contrast) of one epoch, by the model of one file."""
    data = Likelihood(sheet).predict([truth])[:, 0]
    if rng is not None:
        data = data + sheet.covariance.draw(rng, 1)[:, 0]
    return sheet.with_data(data)
