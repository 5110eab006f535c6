"""What else than a companion may look like the point that was found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.field import DISC_CONTRAST, box_of, resolution_mas
from amibayes.companion_search.optimise import refine
from amibayes.companion_search.result import SearchResult

LARGEST_STAR_MAS = 60.0
"""No star but the Sun looks larger: R Doradus has 57 ± 5 mas (Bedding et al. 1997,
MNRAS 286, 957)."""

SEE = "see the comparison of models"
"""Where a run that compares models says more."""


def note_of(result: SearchResult, *, compared: bool = False) -> str:
    """Say why a point that fits may be no companion; empty where nothing speaks against one.

    A star is a uniform or darkened disc in the search. A spot on it is a point inside it; a ring
    or a crescent around it is taken for its disc, larger than any star, and a point; and
    below λ/2B a point cannot be told from an elongated star. Where models of the sky are
    ``compared``, the reader is sent there.
    """
    where = SEE if compared else "--models"
    rho = result.companion.separation_mas
    diameter = result.nuisance("diameter_mas")
    half = 0.5 * resolution_mas(result.likelihood)
    if rho < 0.5 * diameter:
        return f"it lies inside the star's disc of {diameter:.3g} mas, where a spot fits as well"
    if diameter > LARGEST_STAR_MAS:
        return (
            f"the star's disc of {diameter:.3g} mas is larger than any star: light around it, such "
            f"as a crescent, may fit as well ({where})"
        )
    if rho < half:
        return (
            f"it is nearer than λ/2B, {half:.3g} mas, where an elongated star or a crescent may "
            f"fit as well ({where})"
        )
    return ""


def taken_for_a_point(result: SearchResult) -> list[str]:
    """Warn where a disc that the data do not show would change the contrast by more than its error.

    A companion of the star's surface brightness is smaller than it by the root of the contrast.
    """
    likelihood, found = result.likelihood, result.companion
    size = result.nuisance("diameter_mas") * float(np.sqrt(max(found.contrast, 0.0)))
    fixed = likelihood.model.companion_diameter_mas != 0.0
    if fixed or found.contrast < DISC_CONTRAST or not size > 0.0:
        return []
    disc = likelihood.with_model(replace(likelihood.model, companion_diameter_mas=size))
    fit = refine(disc, result.theta, box_of(result.grid, likelihood), 0.0)
    if not abs(fit.companion.contrast - found.contrast) > found.contrast_error:
        return []
    return [
        f"the companion is taken for a point: as a disc of {size:.2g} mas, of the star's surface "
        f"brightness, its contrast would be {fit.companion.contrast:.3g} "
        "(--companion-diameter free)"
    ]
