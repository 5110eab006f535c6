"""What every detection limit says of itself, and the one by injection and recovery."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from astropy.table import QTable
from scipy import stats

from amibayes.data.tables import UNITS, quantity_table
from amibayes.detection.tails import clopper_pearson
from amibayes.support.labelled import labelled
from amibayes.support.notebook import html_table
from amibayes.units import BoolArray, FloatArray, IntArray, contrast_to_delta_mag

CRITERION = (
    "false-alarm probability of the search below the false-positive rate, and "
    "position within lambda/2B of the truth (anywhere, where criterion_at says detection)"
)

MAG_PER_LOG = 2.5 / np.log(10.0)
"""Magnitudes per unit of ln contrast."""


class Limit(Protocol):
    """A faintest contrast at every separation."""

    @property
    def method(self) -> str:
        """How it was found."""
        ...

    @property
    def separation_mas(self) -> FloatArray:
        """Separations, (n,)."""
        ...

    @property
    def contrast(self) -> FloatArray:
        """The limit, (n,); NaN where no contrast will do."""
        ...

    @property
    def delta_mag(self) -> FloatArray:
        """The limit in magnitudes, (n,)."""
        ...

    @property
    def spread(self) -> FloatArray:
        """16, 50 and 84 % points over the position angle, (n, 3)."""
        ...

    @property
    def by_detection(self) -> BoolArray:
        """Where a companion counts wherever it is seen, (n,)."""
        ...

    def facts(self) -> dict[str, Any]:
        """What it means and how well it is known, in JSON's types but for NaN."""
        ...

    def columns(self) -> dict[str, FloatArray]:
        """Further magnitudes at every separation, (n,) each, by name."""
        ...

    def cells(self) -> dict[str, Any] | None:
        """Completeness of every cell of separation and contrast; None without injections."""
        ...


SHARES = np.linspace(0.0025, 0.9975, 400)
"""At which the contrasts are kept: 0.5 and 0.95 are among them."""


@dataclass(frozen=True, eq=False)
class DetectionLimit:
    """Contrast that is recovered with a stated probability at a stated false-positive rate.

    Parameters
    ----------
    method : str
    separation_mas : (n,) float array
    contrast : (n,) float array
        Recovered with probability ``completeness``, averaged over the position angle; NaN
        where no injected one is.
    contrast_50 : (n,) float array
        Recovered half of the time.
    log_error, log_error_50 : (n,) float array
        1σ errors of ln contrast.
    spread : (n, 3) float array
        Contrast recovered with probability ``completeness`` at one position angle: the 16, 50
        and 84 % points over all of them.
    by_detection : (n,) bool array
        Where the data cannot tell a position from one nearer to the star in more than
        `MAX_AMBIGUOUS` of the directions, hardly any contrast can be found at its place
        with probability ``completeness``: there a companion counts wherever it is seen.
    ambiguous : (n,) float array
        Share of the directions in which that is so.
    threshold : float
        Statistic of a detection.
    false_positive_rate : float
        α, at which the threshold was set.
    false_positives : (int, int)
        Searches of noise alone that exceed the threshold, and how many there were.
    completeness : float
    level : (n, n_levels) float array
        Contrasts of the completeness map.
    trials, detected, located : (n, n_levels) int array
        Of the map. All contrasts of a ring are those of the same companions and noise.
    critical : (n, n_shares) float array
        Contrasts above which the `SHARES` of companions are recovered; NaN where none up to 1 is.
    """

    method: str
    separation_mas: FloatArray
    contrast: FloatArray
    contrast_50: FloatArray
    log_error: FloatArray
    log_error_50: FloatArray
    spread: FloatArray
    by_detection: BoolArray
    ambiguous: FloatArray
    threshold: float
    false_positive_rate: float
    false_positives: tuple[int, int]
    completeness: float
    level: FloatArray
    trials: IntArray
    detected: IntArray
    located: IntArray
    critical: FloatArray

    def to_table(self) -> QTable:
        """The limit at every separation as an astropy table with units."""
        columns = {
            "separation_mas": self.separation_mas,
            "contrast": self.contrast,
            "log_error": self.log_error,
            "delta_mag": self.delta_mag,
            "contrast_50": self.contrast_50,
        }
        meta = {
            "method": self.method,
            "false_positive_rate": self.false_positive_rate,
            "completeness": self.completeness,
        }
        return quantity_table(columns, UNITS, meta)

    def to_xarray(self) -> Any:
        """The curve and the completeness as labelled arrays (extra ``xarray``).

        Returns
        -------
        xarray.Dataset
            Of separation_mas: ``delta_mag``, ``contrast`` and others by the names of
            ``limits.json``; of (separation_mas, level): the injected contrasts, trials,
            detected and located companions, and their share, ``completeness``.
        """
        along, cells = ("separation_mas",), ("separation_mas", "level")
        curves = {"contrast": self.contrast, "delta_mag": self.delta_mag, **self.columns()}
        counts = {
            "injected_contrast": self.level,
            "trials": self.trials,
            "detected": self.detected,
            "located": self.located,
            "completeness": self.share,
        }
        variables: dict[str, Any] = {name: (along, values) for name, values in curves.items()}
        coordinates = {"separation_mas": self.separation_mas}
        facts = {"false_positive_rate": self.false_positive_rate, "limit_at": self.completeness}
        return labelled(
            variables | {name: (cells, values) for name, values in counts.items()},
            coordinates,
            {"method": self.method, **facts},
        )

    def __repr__(self) -> str:
        """One line for a notebook."""
        return (
            f"<DetectionLimit: {self.method}, {self.completeness:.0%} recovered at a "
            f"false-positive rate of {self.false_positive_rate:.2g}, "
            f"{len(self.separation_mas)} separations>"
        )

    def _repr_html_(self) -> str:
        """Show the curve in a notebook."""
        rows = [
            (f"{rho:.4g}", f"{mag:.2f}", f"{contrast:.3g}")
            for rho, mag, contrast in zip(
                self.separation_mas, self.delta_mag, self.contrast, strict=True
            )
        ]
        header = ("separation (mas)", "delta mag", "contrast")
        return html_table(repr(self).strip("<>"), header, rows)

    @property
    def delta_mag(self) -> FloatArray:
        """The limit in magnitudes, (n,)."""
        return contrast_to_delta_mag(self.contrast)

    def facts(self) -> dict[str, Any]:
        """What it means and how well it is known; see `amibayes.limits.limit.Limit`."""
        return {
            "criterion": CRITERION,
            "criterion_at": ["detection" if d else "position" for d in self.by_detection],
            "ambiguous_share": list(self.ambiguous),
            **self.columns(),
            "false_positive_rate": self.false_positive_rate,
            "false_positive_interval": list(self.false_positive_interval),
            "threshold": self.threshold,
            "completeness": self.completeness,
            "n_trials": int(self.trials[:, 0].sum()),
        }

    def columns(self) -> dict[str, FloatArray]:
        """Its error, and the contrast that is found half of the time, in magnitudes, (n,) each."""
        return {
            "delta_mag_error": MAG_PER_LOG * self.log_error,
            "delta_mag_50": contrast_to_delta_mag(self.contrast_50),
            "delta_mag_50_error": MAG_PER_LOG * self.log_error_50,
        }

    def cells(self) -> dict[str, Any]:
        """Completeness of every cell, with its Jeffreys interval."""
        low, high = self.jeffreys()
        return {
            "separation_mas": list(self.separation_mas),
            "contrast": self.level.tolist(),
            "delta_mag": contrast_to_delta_mag(self.level).tolist(),
            "trials": self.trials.tolist(),
            "detected": self.detected.tolist(),
            "located": self.located.tolist(),
            "completeness": list(self.share),
            "jeffreys_68": [low.tolist(), high.tolist()],
        }

    @property
    def recovered(self) -> IntArray:
        """Recovered companions, (n, n_levels): located ones, or detected ones."""
        return np.where(self.by_detection[:, None], self.detected, self.located)

    @property
    def share(self) -> FloatArray:
        """Share of recovered companions, (n, n_levels); NaN where none was injected."""
        return np.where(self.trials > 0, self.recovered / np.maximum(self.trials, 1), np.nan)

    def probability(self, separation_mas: float, contrast: float) -> float:
        """Probability that a companion is recovered; NaN at separations that were not tried.

        Between rings it is interpolated.
        """
        inner, outer = self.separation_mas[[0, -1]]
        if not inner <= separation_mas <= outer:
            return float("nan")
        behind = int(np.searchsorted(self.separation_mas, separation_mas, side="right")) - 1
        rings = [behind, min(behind + 1, len(self.separation_mas) - 1)]
        found = [self._share(k, contrast) for k in rings]
        return float(np.interp(separation_mas, self.separation_mas[rings], found))

    def _share(self, ring: int, contrast: float) -> float:
        known = np.isfinite(self.critical[ring])
        if not known.any():
            return 0.0
        at, share = np.log(self.critical[ring, known]), SHARES[known]
        highest = 1.0 if known.all() else float(share[-1])
        return float(np.interp(np.log(contrast), at, share, left=0.0, right=highest))

    def counts_anywhere(self, separation_mas: float) -> bool:
        """Whether a companion there counts as recovered wherever it is seen."""
        return bool(self.by_detection[np.abs(self.separation_mas - separation_mas).argmin()])

    @property
    def false_positive_interval(self) -> tuple[float, float]:
        """95 % Clopper–Pearson interval of the false-positive rate of the threshold."""
        return clopper_pearson(*self.false_positives)

    def jeffreys(self, level: float = 0.68) -> tuple[FloatArray, FloatArray]:
        """Jeffreys interval of the completeness of every cell, (n, n_levels) each."""
        rest = 0.5 * (1.0 - level)
        a, b = self.recovered + 0.5, self.trials - self.recovered + 0.5
        return np.asarray(stats.beta.ppf(rest, a, b)), np.asarray(stats.beta.isf(rest, a, b))
