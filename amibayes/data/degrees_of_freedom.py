"""How well an estimated covariance is known: its degrees of freedom, and what a sum has.

A covariance estimated from the scatter of N integrations, with an inverse-Wishart prior or
without, is itself uncertain. Data whose covariance is known like that follow a multivariate
t distribution instead of a Gaussian one (Sellentin & Heavens 2016, Percival et al. 2022).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from scipy.sparse import block_diag, csr_array

from amibayes.data.covariance import BlockCovariance


@dataclass(frozen=True)
class Freedom:
    """Degrees of freedom of an estimated covariance; those of a part of the data are the same.

    Parameters
    ----------
    degrees : float
        Of the t distribution that the data follow, more than 2. Their covariance is the
        estimate itself: L ∝ [1 + χ²/(degrees − 2)]^{−(degrees + p)/2} for p data.
    scatter : float
        Of the measured scatter that went into the estimate: integrations less one.
    """

    degrees: float
    scatter: float

    @property
    def scatter_share(self) -> float:
        """Share of the measured scatter in the estimate; the rest is its prior."""
        return self.scatter / (self.degrees - 2.0)


def welch_satterthwaite(parts: Iterable[tuple[float, Freedom | None]]) -> Freedom | None:
    """Freedom of a sum of independent estimates, by Welch and Satterthwaite.

    Parameters
    ----------
    parts : iterable of (weight, Freedom or None)
        The squared share of each part in the whole, and its freedom (None: known exactly).

    Returns
    -------
    Freedom or None
        1/ν = Σ weight/ν of both degrees; None where every part is known exactly.
    """
    known = [(weight, f) for weight, f in parts if f is not None and weight > 0.0]
    if not known:
        return None
    return Freedom(
        1.0 / sum(weight / f.degrees for weight, f in known),
        1.0 / sum(weight / f.scatter for weight, f in known),
    )


def squared_share(part: csr_array, whole: BlockCovariance) -> float:
    """Squared share of one term in a sum of covariances.

    In coordinates in which the whole is the unit matrix of rank p, a term E has the share
    (tr E² + (tr E)²)/(p + p²), which makes the sum as uncertain as its terms are together
    (Nel & van der Merwe 1986; Krishnamoorthy & Yu 2004). For one datum it is the square of
    the share in the variance.
    """
    white = csr_array(whole.whitening @ part @ whole.whitening.T)
    trace, square = float(white.diagonal().sum()), float((white.data**2).sum())
    return (square + trace**2) / (whole.rank + whole.rank**2)


def stacked_freedom(parts: Iterable[tuple[int, Freedom | None]]) -> Freedom | None:
    """Freedom of independent data sets laid side by side, each (rank, Freedom or None)."""
    given = list(parts)
    p = sum(rank for rank, _ in given)
    return welch_satterthwaite(((n + n**2) / (p + p**2), f) for n, f in given)


def stacked_scatter(parts: Iterable[tuple[BlockCovariance, csr_array | None]]) -> csr_array | None:
    """Covariance by scatter alone of independent data sets laid side by side.

    Parameters
    ----------
    parts : iterable of (BlockCovariance, sparse array or None)
        Each part's covariance, and that by its scatter alone (None: as the first).

    Returns
    -------
    sparse array or None
        None where no part has a scatter of its own.
    """
    given = list(parts)
    if all(scatter is None for _, scatter in given):
        return None
    return csr_array(block_diag([c.sparse if s is None else s for c, s in given]))
