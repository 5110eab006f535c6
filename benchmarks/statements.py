"""What is stated of a companion, and how far it is from the truth, for tables of many visits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes import Likelihood, SearchResult, search
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.data.observables import Observables
from amibayes.models.binary import BinaryModel
from amibayes.pipeline.field import noise_prior
from amibayes.pipeline.options import SearchOptions
from amibayes.units import FloatArray

FIELD_MAS = (50.0, 400.0)

NEAR_MAS = 60.0
"""A companion farther from the truth is another solution: its error is no measure of that."""


@dataclass(frozen=True)
class Searched:
    """A search with the errors as stated, and that with the extra noise that the data ask for."""

    stated: SearchResult
    noisy: SearchResult


def searched(data: Observables) -> Searched:
    """Search as the command does, around a star that is known to be a point."""
    options = SearchOptions(separation_mas=FIELD_MAS)
    stated = search(Likelihood(data, BinaryModel(diameter_mas=0.0)), FIELD_MAS)
    prior = noise_prior(data, options)
    noisy, _ = search_with_noise(stated.likelihood, FIELD_MAS, prior=prior, first=stated)
    return Searched(stated, noisy)


def errors_of(data: Observables, truth: FloatArray) -> dict[str, float]:
    """Pulls of east, north and contrast; ``truth`` are these, in mas and as a flux ratio."""
    found = searched(data).noisy.companion
    off = np.array([found.east_mas, found.north_mas, found.contrast]) - truth
    error = (found.east_error_mas, found.north_error_mas, found.contrast_error)
    pulls = dict(zip(("east", "north", "contrast"), (off / error).tolist(), strict=True))
    stated = {
        "separation_mas": found.separation_mas,
        "separation_error_mas": found.separation_error_mas,
        "position_angle_deg": found.position_angle_deg,
        "position_angle_error_deg": found.position_angle_error_deg,
        "contrast_stated": found.contrast,
        "contrast_error": found.contrast_error,
    }
    near = bool(np.hypot(*off[:2]) < NEAR_MAS)
    return {"near": near, "bias": off[2] / truth[2], "truth": truth[2], **pulls, **stated}
