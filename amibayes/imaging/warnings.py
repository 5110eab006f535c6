"""What to hold against an image: what it is, a colon, and why."""

from __future__ import annotations

from amibayes.imaging.problem import MAX_FLUX
from amibayes.imaging.result import ReconstructedImage
from amibayes.likelihood.chi2 import REJECTED

NOT_PREDICTED = 3.0
"""χ² per datum left out beyond which data do not predict each other: simulated scenes that are
recognised have 0.5 to 2.5."""

NOT_APART = 0.1
"""Light within λ/4B of the star, in units of its own, from which on fluxes elsewhere depend on
what of it is counted to the star."""


def warnings_of(image: ReconstructedImage) -> tuple[str, ...]:
    """Warn of an image that does not fit, predicts nothing, or took the star's light."""
    found = []
    if image.p_fit < REJECTED:
        found.append(
            f"the image does not fit the data: chi2 is {image.chi2:.4g} of {image.n_independent} "
            "numbers; light outside the field (--field), finer than the pixels (--pixel), of "
            "another colour, or errors that are too small"
        )
    if image.left_out > NOT_PREDICTED:
        found.append(
            f"data left out are not predicted: chi2 is {image.left_out:.3g} per datum at best; "
            "baselines are too few for what there is, and details are the regulariser's"
        )
    if "flux" in image.bounds:
        found.append(
            f"the light around the star is at its bound of {MAX_FLUX:g} times the star's: the "
            "image has taken the star's place (--no-star, or --diameter free)"
        )
    if "diameter" in image.bounds:
        found.append(
            f"the star's diameter, {image.diameter_mas:.3g} mas, is at its bound: no baseline is "
            "short enough for it"
        )
    if image.beside_star > NOT_APART:
        found.append(
            f"the image may have light of the star: {image.beside_star:.2g} of its flux lies "
            "within λ/4B, where the data do not tell them apart; fluxes elsewhere are in units of "
            "a part of the star then"
        )
    return tuple(found)
