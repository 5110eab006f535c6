"""Which combinations of covariance, noise, residuals, files, model and method there are.

Every refusal stands here, with its reason; everything else works. `docs/statistics.md`
lists the same, and a test walks through all combinations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from amibayes.errors import UsageError
from amibayes.likelihood.averaged_noise import files_share_errors
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.residuals import files_of

CovarianceOrigin = Literal["known", "estimated"]
Amount = Literal["stated", "extra", "averaged"]
Residuals = Literal["gaussian", "student"]
Scope = Literal["common", "per file", "shared calibrators"]
Bank = Literal["tied", "per band", "motion"]
Channels = Literal["independent", "correlated"]
Method = Literal["search", "closed limits", "grid posterior"]


@dataclass(frozen=True)
class Combination:
    """One way to search.

    Parameters
    ----------
    covariance : {"known", "estimated"}
        Estimated from the scatter of integrations, or stated.
    noise : {"stated", "extra", "averaged"}
        The stated errors, a fitted amount beside them, or an average over that.
    residuals : {"gaussian", "student"}
    scope : {"common", "per file", "shared calibrators"}
        Which data have one amount of noise; the last where files share errors.
    bank : {"tied", "per band", "motion"}
        One contrast at rest, one for each band, or a companion that moves.
    companions : int
    method : {"search", "closed limits", "grid posterior"}
        What is asked of it.
    channels : {"independent", "correlated"}
        Whether channels of an exposure share some of their noise.
    """

    covariance: CovarianceOrigin = "known"
    noise: Amount = "stated"
    residuals: Residuals = "gaussian"
    scope: Scope = "common"
    bank: Bank = "tied"
    companions: int = 1
    method: Method = "search"
    channels: Channels = "independent"


def refusal(combination: Combination) -> tuple[str, str] | None:
    """Say why a combination is refused and what to do instead; None where it works."""
    c = combination
    if c.residuals == "student" and c.covariance == "estimated":
        # Weights of single data and the error of a covariance that all data share act alike.
        return (
            "robust residuals need errors that are stated, not estimated from the scatter",
            "leave --robust out: extraction has left out integrations that are outliers",
        )
    if c.method == "closed limits" and c.bank != "tied":
        # Their formulae have one linear parameter at each position: one contrast, at rest.
        return (
            "limits by a closed criterion are those of one contrast at rest",
            "use --criterion injection, or --contrast tied without --motion",
        )
    if c.method == "grid posterior" and (c.bank != "tied" or c.companions > 1):
        # Its cells are positions, its boxes one contrast: more dimensions cost too much.
        return (
            "the posterior is integrated over a grid for one companion of one contrast at rest",
            "use the chain, and evidences by importance sampling",
        )
    return None


def require(combination: Combination, source: str = "") -> None:
    """Refuse a combination that does not work.

    Raises
    ------
    UsageError
        With the reason and a remedy.
    """
    found = refusal(combination)
    if found is not None:
        raise UsageError(found[0], source=source, remedy=found[1])


def combination_of(
    likelihood: Likelihood,
    *,
    residuals: Residuals = "gaussian",
    noise: Amount = "stated",
    per_file: bool = False,
    method: Method = "search",
    channels: Channels = "independent",
) -> Combination:
    """The combination that a likelihood and a request amount to."""
    data, model = likelihood.observables, likelihood.model
    estimated = data.covariance_kind == "estimated" or data.freedom is not None
    several = per_file and len(files_of(data)) > 1
    scope: Scope = "per file" if several else "common"
    if several and files_share_errors(data):
        scope = "shared calibrators"
    bank: Bank = "motion" if model.moves else "per band" if model.n_contrasts > 1 else "tied"
    return Combination(
        "estimated" if estimated else "known",
        noise,
        residuals,
        scope,
        bank,
        model.companions,
        method,
        channels,
    )
