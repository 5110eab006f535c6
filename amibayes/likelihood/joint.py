"""What a joint fit of several files leaves free: contrasts of bands, and motion."""

from __future__ import annotations

from dataclasses import replace

from amibayes.errors import UsageError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.bands import bands_of, dates
from amibayes.models.uv_points import YEAR_DAYS
from amibayes.support.arguments import checks_arguments
from amibayes.support.options import ContrastSharing
from amibayes.units import MAS


@checks_arguments
def joint_likelihood(
    likelihood: Likelihood,
    *,
    contrast: ContrastSharing | None = None,
    motion: bool = False,
    fastest_mas_yr: float | None = None,
) -> Likelihood:
    """Free the contrasts of bands, and the motion, in the model of a likelihood.

    Parameters
    ----------
    likelihood : Likelihood
    contrast : {"tied", "per-filter"}, optional
        One contrast for all bands, or one for each (the default where there are several: a
        companion need not have its star's colour).
    motion : bool
        The companion moves linearly; its place is that at the weighted mean date of the data.
    fastest_mas_yr : float, optional
        Largest rate along east and along north; by default λ/B_max over the span of the data.

    Raises
    ------
    UsageError
        Where all data are of one date and a motion is asked for.
    DataError
        Where a date is missing and a motion is asked for.
    """
    bands = bands_of(likelihood.observables) if contrast != "tied" else ()
    names = tuple(b.name for b in bands) if len(bands) > 1 else ()
    model = replace(likelihood.model, bands=names)
    if motion:
        first, last, mean = dates(likelihood.observables)
        if last <= first:
            raise UsageError(
                "all data are of one date", source="--motion", remedy="leave the motion out"
            )
        fringe = 1.0 / likelihood.samples.frequency.max() / MAS
        fastest = fastest_mas_yr or fringe * YEAR_DAYS / (last - first)
        model = replace(model, fastest_mas_yr=float(fastest), reference_mjd=mean)
    return likelihood.with_model(model)
