"""Coefficients of charge migration and of the converter, with what is known of them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from scipy.linalg import block_diag

from amibayes.ramps.converter import WAVES
from amibayes.ramps.transfer import KINDS, SIDES
from amibayes.units import FloatArray, read_only

MigrationSource = Literal["fit", "instrument", "given", "off"]


@dataclass(frozen=True, eq=False)
class Migration:
    """What moves charge, and how strongly.

    Parameters
    ----------
    kinds : tuple of str
        Of `amibayes.ramps.transfer.KINDS`; then those of `amibayes.ramps.converter.WAVES`.
    value : (k,) array
        Coefficients per electron; amplitudes of waves, counts per count.
    covariance : (k, k) array
    source : {"fit", "instrument", "given"}
        Ramps of these data, the instrument's file, or the user.
    """

    kinds: tuple[str, ...]
    value: FloatArray
    covariance: FloatArray
    source: MigrationSource

    def __post_init__(self) -> None:
        read_only(self, "value", "covariance")
        unknown = set(self.kinds) - {*KINDS, *WAVES}
        if unknown or self.covariance.shape != 2 * (len(self.kinds),):
            raise ValueError(f"kinds {self.kinds} and covariance {self.covariance.shape}")

    @classmethod
    def isotropic(cls, per_e: float, error: float, source: MigrationSource) -> Migration:
        """One coefficient for the sides along x and y."""
        ones = np.ones(len(SIDES))
        return cls(SIDES, per_e * ones, error**2 * np.outer(ones, ones), source)

    @property
    def error(self) -> FloatArray:
        """(k,) standard deviations."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def mean(self) -> tuple[float, float]:
        """Mean of the coefficients of the sides, per electron, and its standard deviation."""
        weight = self._share
        return float(weight @ self.value), float(np.sqrt(weight @ self.covariance @ weight))

    @property
    def _share(self) -> FloatArray:
        """(k,) weights of the coefficients in their mean."""
        weight = np.array([kind in SIDES for kind in self.kinds], dtype=float)
        return np.asarray(weight / max(weight.sum(), 1.0))

    @property
    def of_pixels(self) -> Migration:
        """What charge does, without the converter."""
        return self._of(KINDS)

    @property
    def of_converter(self) -> Migration | None:
        """Amplitudes of the converter's waves; None where they were not fitted."""
        return self._of(WAVES) if set(WAVES) <= set(self.kinds) else None

    def _of(self, wanted: tuple[str, ...]) -> Migration:
        own = [k for k, kind in enumerate(self.kinds) if kind in wanted]
        kinds = tuple(self.kinds[k] for k in own)
        return replace(
            self, kinds=kinds, value=self.value[own], covariance=self.covariance[np.ix_(own, own)]
        )

    def beside(self, other: Migration) -> Migration:
        """Both together, their errors independent."""
        value = np.concatenate([self.value, other.value])
        covariance = block_diag(self.covariance, other.covariance)
        return replace(self, kinds=self.kinds + other.kinds, value=value, covariance=covariance)

    @property
    def directions(self) -> FloatArray:
        """(k, r) independent errors of one standard deviation: the covariance is D·Dᵀ."""
        # Numbers of different units: in units of their errors they are of one size.
        unit = np.where(self.error > 0.0, self.error, 1.0)
        eigenvalue, vector = np.linalg.eigh(self.covariance / np.outer(unit, unit))
        kept = eigenvalue > 1e-9 * max(float(eigenvalue.max(initial=0.0)), 1e-300)
        vector = vector[:, kept]
        # Of either sign: one and the same for data that were extracted apart, and share errors.
        first = np.argmax(np.abs(vector) > 0.5 * np.abs(vector).max(axis=0, initial=0.0), axis=0)
        sign = np.sign(vector[first, np.arange(vector.shape[1])])
        return np.asarray(unit[:, None] * vector * sign * np.sqrt(eigenvalue[kept]))

    def error_names(self, count: int) -> list[str]:
        """Names of ``count`` errors in common: along each of `directions`, then of pixels."""
        pairs = zip(self.kinds, self.value, strict=True)
        what = ", ".join(f"{kind} {value:.9e}" for kind, value in pairs)
        return [f"charge migration {k} ({what})" for k in range(1, count + 1)]

    @property
    def steps(self) -> dict[str, float]:
        """Changes of the first of `mean` by each of the errors in common, by their names."""
        changed = self._share @ self.directions
        names = self.error_names(len(changed))
        return dict(zip(names, map(float, changed), strict=True))

    def as_json(self) -> dict[str, Any]:
        """Plain numbers."""
        value, error = self.mean
        found: dict[str, Any] = {"value_per_e": value, "error_per_e": error, "source": self.source}
        found["coefficients"] = {
            kind: {"value_per_e": float(v), "error_per_e": float(e)}
            for kind, v, e in zip(self.kinds, self.value, self.error, strict=True)
            if kind in KINDS
        }
        converter = self.of_converter
        if converter is not None:
            rows = zip(converter.kinds, converter.value, converter.error, strict=True)
            found["converter"] = {k: {"value": float(v), "error": float(e)} for k, v, e in rows}
        return found
