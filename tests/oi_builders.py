"""OIFITS files made by hand with astropy alone, and observables made of random numbers."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import (
    Block,
    BlockCovariance,
    Covariance,
    diagonal_covariance,
    stack_covariances,
)
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables
from amibayes.data.setup import Setup


def table(name: str, columns: dict[str, tuple[str, Any, str]], **keywords: Any) -> Any:
    """A binary table; columns are name: (format, values, unit)."""
    hdu = fits.BinTableHDU.from_columns(
        [fits.Column(n, f, unit=u or None, array=a) for n, (f, a, u) in columns.items()]
    )
    hdu.header["EXTNAME"] = name
    for key, value in keywords.items():
        hdu.header[key.replace("_OBS", "-OBS")] = value
    return hdu


def keywords(array: str, date: str) -> dict[str, dict[str, Any]]:
    """Keywords of the tables of a file of version 1."""
    common = {"OI_REVN": 1, "DATE_OBS": date, "ARRNAME": array, "INSNAME": "I"}
    return {
        "OI_TARGET": {"OI_REVN": 1},
        "OI_ARRAY": {"OI_REVN": 1, "ARRNAME": array, "FRAME": "SKY"},
        "OI_WAVELENGTH": {"OI_REVN": 1, "INSNAME": "I"},
        "OI_VIS2": dict(common),
        "OI_T3": dict(common),
    }


class HandMade:
    """A version 1 file of 4 stations, 3 channels and one exposure, to be changed at will.

    ``vis2``, ``vis2_error`` (6, 3), ``phase_deg``, ``phase_error_deg`` (4, 3) hold the truth.
    """

    def __init__(self, rng: np.random.Generator) -> None:
        self.baselines = np.array(list(combinations(range(1, 5), 2)))
        self.triangles = np.array(list(combinations(range(1, 5), 3)))
        self.xy = rng.normal(size=(4, 2)) * 30
        self.vis2 = rng.uniform(0.1, 1.0, (6, 3))
        self.vis2_error = rng.uniform(0.01, 0.05, (6, 3))
        self.phase_deg = rng.normal(size=(4, 3)) * 20
        self.phase_error_deg = rng.uniform(0.5, 2.0, (4, 3))
        self.wavelength_m = np.array([1.6e-6, 1.65e-6, 1.7e-6])
        uv = self.xy[self.baselines[:, 1] - 1] - self.xy[self.baselines[:, 0] - 1]
        t = self.triangles - 1
        uv1, uv2 = self.xy[t[:, 1]] - self.xy[t[:, 0]], self.xy[t[:, 2]] - self.xy[t[:, 1]]
        same = {"TARGET_ID": 1, "TIME": 0.0, "MJD": 57000.5, "INT_TIME": 30.0}
        self.tables: dict[str, Any] = {
            "OI_TARGET": {
                "TARGET_ID": ("1I", [1], ""),
                "TARGET": ("16A", ["alf Test"], ""),
                "RAEP0": ("1D", [10.0], "deg"),
                "DECEP0": ("1D", [-20.0], "deg"),
            },
            "OI_ARRAY": {
                "TEL_NAME": ("16A", ["T1", "T2", "T3", "T4"], ""),
                "STA_NAME": ("16A", ["A", "B", "C", "D"], ""),
                "STA_INDEX": ("1I", [1, 2, 3, 4], ""),
                "DIAMETER": ("1E", [1.8] * 4, "m"),
                "STAXYZ": ("3D", np.c_[self.xy, np.zeros(4)], "m"),
            },
            "OI_WAVELENGTH": {
                "EFF_WAVE": ("1E", self.wavelength_m, "m"),
                "EFF_BAND": ("1E", np.full(3, 5e-8), "m"),
            },
            "OI_VIS2": self._rows(same, 6)
            | {
                "VIS2DATA": ("3D", self.vis2, ""),
                "VIS2ERR": ("3D", self.vis2_error, ""),
                "UCOORD": ("1D", uv[:, 0], "m"),
                "VCOORD": ("1D", uv[:, 1], "m"),
                "STA_INDEX": ("2I", self.baselines, ""),
                "FLAG": ("3L", np.zeros((6, 3), bool), ""),
            },
            "OI_T3": self._rows(same, 4)
            | {
                "T3AMP": ("3D", np.full((4, 3), np.nan), ""),
                "T3AMPERR": ("3D", np.full((4, 3), np.nan), ""),
                "T3PHI": ("3D", self.phase_deg, "deg"),
                "T3PHIERR": ("3D", self.phase_error_deg, "deg"),
                "U1COORD": ("1D", uv1[:, 0], "m"),
                "V1COORD": ("1D", uv1[:, 1], "m"),
                "U2COORD": ("1D", uv2[:, 0], "m"),
                "V2COORD": ("1D", uv2[:, 1], "m"),
                "STA_INDEX": ("3I", self.triangles, ""),
                "FLAG": ("3L", np.zeros((4, 3), bool), ""),
            },
        }
        self.keywords = keywords("X", "2014-12-09")
        self.more: list[Any] = []

    @staticmethod
    def _rows(values: dict[str, float], n: int) -> dict[str, Any]:
        return {
            k: ("1I" if k == "TARGET_ID" else "1D", np.full(n, v), "") for k, v in values.items()
        }

    def put(self, name: str, column: str, values: Any, **change: Any) -> None:
        """Replace the values (and ``form``, ``unit``) of a column."""
        form, _, unit = self.tables[name][column]
        self.tables[name][column] = (change.get("form", form), values, change.get("unit", unit))

    def correlate(self, pairs: list[tuple[int, int, float]]) -> None:
        """Add an OI_CORR whose matrix runs over V² (1–18), then closure phases (19–30)."""
        i, j, c = zip(*pairs, strict=True)
        self.more.append(
            table(
                "OI_CORR",
                {"IINDX": ("1J", i, ""), "JINDX": ("1J", j, ""), "CORR": ("1D", c, "")},
                CORRNAME="K",
                NDATA=30,
            )
        )
        for name, column, start, n in (
            ("OI_VIS2", "CORRINDX_VIS2DATA", 1, 6),
            ("OI_T3", "CORRINDX_T3PHI", 19, 4),
        ):
            self.keywords[name]["CORRNAME"] = "K"
            self.tables[name][column] = ("1J", start + 3 * np.arange(n), "")

    def write(self, path: Path) -> Path:
        hdus = [table(n, columns, **self.keywords[n]) for n, columns in self.tables.items()]
        fits.HDUList([fits.PrimaryHDU(), *hdus, *self.more]).writeto(path, overwrite=True)
        return path


HOLES_M = np.array(
    [(0, -2.64), (-2.28631, 0), (2.28631, -1.32), (-2.28631, 1.32), (-1.14315, 1.98),
     (2.28631, 1.32), (1.14315, 1.98)]
)  # fmt: skip
"""Those of NIRISS: no two baselines are alike."""


class MaskFile:
    """Exposures of a mask on a turning field, as a sound version 1 file to be spoilt at will.

    ``tables`` and ``keywords`` as in `HandMade`; ``vis2`` and ``phase_deg`` are random, their
    errors differ from row to row, so that the covariance tells which triangles share what.
    """

    def __init__(
        self,
        rng: np.random.Generator,
        *,
        holes_m: np.ndarray = HOLES_M,
        n_exposures: int = 3,
        n_channels: int = 2,
        turn_deg: float = 5.0,
    ) -> None:
        n = len(holes_m)
        self.pairs = np.array(list(combinations(range(n), 2)))
        self.triples = np.array(list(combinations(range(n), 3)))
        self.n_exposures, self.wavelength_m = n_exposures, 2.1e-6 + 0.15e-6 * np.arange(n_channels)
        angle = np.radians(turn_deg) * np.arange(n_exposures)
        turned = [
            holes_m @ np.array([[np.cos(a), np.sin(a)], [-np.sin(a), np.cos(a)]]) for a in angle
        ]
        leg = [np.concatenate([xy[t[:, 1]] - xy[t[:, 0]] for xy in turned])
               for t in (self.pairs, self.triples, self.triples[:, 1:])]  # fmt: skip
        date = 57890.17 + 0.004 * np.arange(n_exposures)

        def rows(per_exposure: int) -> dict[str, Any]:
            mjd = np.repeat(date, per_exposure)
            return {
                "TARGET_ID": ("1I", np.ones(len(mjd)), ""),
                "TIME": ("1D", (mjd - np.floor(mjd)) * 86400.0, "s"),
                "MJD": ("1D", mjd, "day"),
                "INT_TIME": ("1D", np.ones(len(mjd)), "s"),
            }

        def values(count: int, low: float, high: float) -> tuple[str, Any]:
            return f"{n_channels}D", rng.uniform(low, high, (count * n_exposures, n_channels))

        n_pairs, n_triples, flag = len(self.pairs), len(self.triples), f"{n_channels}L"
        self.tables: dict[str, Any] = {
            "OI_TARGET": {
                "TARGET_ID": ("1I", [1], ""),
                "TARGET": ("16A", ["alf Test"], ""),
                "RAEP0": ("1D", [10.0], "deg"),
                "DECEP0": ("1D", [-20.0], "deg"),
            },
            "OI_ARRAY": {
                "TEL_NAME": ("16A", [f"H{i}" for i in range(n)], ""),
                "STA_NAME": ("16A", [f"H{i}" for i in range(n)], ""),
                "STA_INDEX": ("1I", np.arange(1, n + 1), ""),
                "DIAMETER": ("1E", np.ones(n), "m"),
                "STAXYZ": ("3D", np.c_[holes_m, np.zeros(n)], "m"),
            },
            "OI_WAVELENGTH": {
                "EFF_WAVE": ("1E", self.wavelength_m, "m"),
                "EFF_BAND": ("1E", np.full(n_channels, 5e-8), "m"),
            },
            "OI_VIS2": rows(n_pairs)
            | {
                "VIS2DATA": (*values(n_pairs, 0.5, 1.0), ""),
                "VIS2ERR": (*values(n_pairs, 0.01, 0.02), ""),
                "UCOORD": ("1D", leg[0][:, 0], "m"),
                "VCOORD": ("1D", leg[0][:, 1], "m"),
                "STA_INDEX": ("2I", np.tile(self.pairs + 1, (n_exposures, 1)), ""),
                "FLAG": (flag, np.zeros((n_pairs * n_exposures, n_channels), bool), ""),
            },
            "OI_T3": rows(n_triples)
            | {
                "T3PHI": (*values(n_triples, -5.0, 5.0), "deg"),
                "T3PHIERR": (*values(n_triples, 0.5, 0.7), "deg"),
                "U1COORD": ("1D", leg[1][:, 0], "m"),
                "V1COORD": ("1D", leg[1][:, 1], "m"),
                "U2COORD": ("1D", leg[2][:, 0], "m"),
                "V2COORD": ("1D", leg[2][:, 1], "m"),
                "STA_INDEX": ("3I", np.tile(self.triples + 1, (n_exposures, 1)), ""),
                "FLAG": (flag, np.zeros((n_triples * n_exposures, n_channels), bool), ""),
            },
        }
        self.keywords = keywords("SAM", "2017-05-17")
        self.more: list[Any] = []

    put = HandMade.put
    write = HandMade.write

    def change(self, name: str, how: Any, *columns: str) -> None:
        """Apply a function to the values of columns."""
        for column in columns:
            form, values, unit = self.tables[name][column]
            self.tables[name][column] = form, how(np.asarray(values)), unit

    def drop(self, *columns: str) -> None:
        """Leave columns out of both data tables."""
        for column in columns:
            for name in {"OI_VIS2", "OI_T3"} & set(self.tables):
                self.tables[name].pop(column, None)


def random_setup(rng: np.random.Generator, n_stations: int, n_channels: int, name: str) -> Setup:
    return Setup(
        insname=name,
        arrname="MASK",
        target="bet Test",
        stations=tuple(f"H{i}" for i in range(1, n_stations + 1)),
        station_index=np.arange(1, n_stations + 1),
        wavelength_m=np.sort(rng.uniform(3e-6, 5e-6, n_channels)),
        band_m=rng.uniform(1e-8, 1e-7, n_channels),
        station_xyz_m=np.c_[rng.normal(size=(n_stations, 2)), np.zeros(n_stations)],
        station_diameter_m=rng.uniform(0.7, 0.9, n_stations),
        right_ascension_deg=rng.uniform(0, 360),
        declination_deg=rng.uniform(-90, 90),
    )


def measurements(
    rng: np.random.Generator, setup: Setup, groups: np.ndarray, n_exposures: int, kind: str
) -> Measurements:
    """Random numbers on the baselines or triangles ``groups`` of each exposure."""
    n_channels = len(setup.wavelength_m)
    rows = n_exposures * len(groups)
    each = np.repeat(np.arange(rows), n_channels)
    channel = np.tile(np.arange(n_channels), rows)
    xy = np.asarray(setup.station_xyz_m)[:, :2]
    stations = np.tile(groups, (n_exposures, 1))[each]
    legs = xy[stations[:, 1:]] - xy[stations[:, :-1]]
    mjd = 59000.25 + 0.01 * np.repeat(np.arange(n_exposures), len(groups))
    value = rng.uniform(0.5, 1.0, len(each)) if kind == "vis2" else rng.normal(size=len(each)) * 0.2
    return Measurements(
        value=value,
        u_m=legs[:, :, 0],
        v_m=legs[:, :, 1],
        wavelength_m=setup.wavelength_m[channel],
        band_m=setup.band_m[channel],
        mjd=mjd[each],
        integration_s=np.full(len(each), 12.5),
        stations=stations,
        setup=np.zeros(len(each), dtype=np.intp),
        row=each,
        channel=channel,
        flag=np.zeros(len(each), dtype=bool),
    )


def joint_covariance(rng: np.random.Generator, closure: Measurements, n_vis2: int) -> Covariance:
    """One dense, random covariance of V² and closure phases, these in their kernel space."""
    matrix, baselines = closure_matrix(closure.stations)
    n_phase = len(baselines)
    root = rng.normal(size=(n_vis2 + n_phase, 3 * (n_vis2 + n_phase)))
    joint = root @ root.T / root.shape[1]
    carry = np.zeros((n_vis2 + len(closure), n_vis2 + n_phase))
    carry[:n_vis2, :n_vis2] = np.eye(n_vis2) * 0.01
    carry[n_vis2:, n_vis2:] = matrix * 0.02
    kernel = kernel_basis(matrix)
    basis = np.zeros((len(carry), n_vis2 + kernel.shape[1]))
    basis[:n_vis2, :n_vis2] = np.eye(n_vis2)
    basis[n_vis2:, n_vis2:] = kernel
    full = carry @ joint @ carry.T
    full = (full + full.T) / 2
    return BlockCovariance(len(full), [Block(np.arange(len(full)), full, basis)])


def random_observables(
    rng: np.random.Generator,
    *,
    n_stations: int = 7,
    n_channels: int = 1,
    n_exposures: int = 1,
    kind: str = "given",
    name: str = "NRM",
) -> Observables:
    """Random observables of a mask with a covariance of the given kind.

    ``given`` and ``estimated`` are dense over V² and closure phase (one exposure, one channel).
    """
    setup = random_setup(rng, n_stations, n_channels, name)
    baselines = np.array(list(combinations(range(n_stations), 2)))
    triangles = np.array(list(combinations(range(n_stations), 3)))
    vis2 = measurements(rng, setup, baselines, n_exposures, "vis2")
    closure = measurements(rng, setup, triangles, n_exposures, "cp")
    covariance: Covariance
    if kind in ("given", "estimated"):
        covariance = joint_covariance(rng, closure, len(vis2))
    else:
        errors = rng.uniform(0.01, 0.02, len(vis2)), rng.uniform(0.01, 0.02, len(closure))
        covariance = covariance_of_errors(errors[0], closure, errors[1], kind)  # type: ignore[arg-type]
    return Observables(
        vis2,
        closure,
        covariance,
        kind,  # type: ignore[arg-type]
        (setup,),
        69 if kind == "estimated" else None,
    )


def diagonal(observables: Observables) -> Observables:
    """The same data with independent errors."""
    from dataclasses import replace

    return replace(
        observables,
        covariance=diagonal_covariance(observables.covariance.variance),
        covariance_kind="diagonal",
        n_integrations=None,
    )


__all__ = [
    "HOLES_M",
    "HandMade",
    "MaskFile",
    "diagonal",
    "random_observables",
    "stack_covariances",
    "table",
]
