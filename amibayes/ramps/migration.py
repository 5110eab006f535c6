"""Coefficients of charge migration, with what is known of them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from amibayes.ramps.transfer import KINDS, SIDES
from amibayes.units import FloatArray, read_only

MigrationSource = Literal["fit", "instrument", "given", "off"]


@dataclass(frozen=True, eq=False)
class Migration:
    """What moves charge, and how strongly.

    Parameters
    ----------
    kinds : tuple of str
        Of `amibayes.ramps.transfer.KINDS`.
    value : (k,) array
        Coefficients per electron.
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
        unknown = set(self.kinds) - set(KINDS)
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
        weight = np.array([kind in SIDES for kind in self.kinds], dtype=float)
        weight /= max(weight.sum(), 1.0)
        return float(weight @ self.value), float(np.sqrt(weight @ self.covariance @ weight))

    @property
    def directions(self) -> FloatArray:
        """(k, r) independent errors of one standard deviation: the covariance is D·Dᵀ."""
        eigenvalue, vector = np.linalg.eigh(self.covariance)
        kept = eigenvalue > 1e-9 * max(float(eigenvalue.max(initial=0.0)), 1e-300)
        return np.asarray(vector[:, kept] * np.sqrt(eigenvalue[kept]))

    def as_json(self) -> dict[str, Any]:
        """Plain numbers."""
        value, error = self.mean
        found: dict[str, Any] = {"value_per_e": value, "error_per_e": error, "source": self.source}
        found["coefficients"] = {
            kind: {"value_per_e": float(v), "error_per_e": float(e)}
            for kind, v, e in zip(self.kinds, self.value, self.error, strict=True)
        }
        return found
