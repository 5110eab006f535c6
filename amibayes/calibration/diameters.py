"""Diameters of calibrators as a user gives them, and calibrators freed of their discs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from amibayes.calibration.transfer import Diameter
from amibayes.data.covariance import scaled
from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.scene.disc import uniform_disc

OPTION = "--calibrator-diameters"


def diameters_of(
    given: str | Path | None, calibrators: Sequence[Observables]
) -> list[Diameter] | None:
    """Uniform-disc diameter and error (mas) of each calibrator.

    Parameters
    ----------
    given : str or path, optional
        ``0.31:0.02,0.4`` in the order of the calibrators; or a table (ECSV, CSV, FITS) with
        columns name, diameter_mas and, if known, error_mas, whose name is that of the file or
        of its target.

    Raises
    ------
    UsageError, DataError
        Where it is neither, or does not have every calibrator.
    """
    if given is None:
        return None
    if Path(given).is_file():
        return _from_table(str(given), calibrators)
    try:
        pairs = [tuple(float(x) for x in word.split(":")) for word in str(given).split(",")]
        found = [(p[0], p[1] if len(p) > 1 else 0.0) for p in pairs]
    except ValueError:
        raise UsageError(
            f"{given!r} is neither a table nor a list of diameters",
            source=OPTION,
            remedy="give mas, as 0.31:0.02,0.4",
        ) from None
    if len(found) != len(calibrators):
        raise UsageError(
            f"{len(found)} diameters for {len(calibrators)} calibrators",
            source=OPTION,
            remedy="give one for each, in the order of --cal",
        )
    return found


def _from_table(path: str, calibrators: Sequence[Observables]) -> list[Diameter]:
    from astropy.table import Table

    try:
        table = Table.read(path)
        names = [str(name).strip().casefold() for name in table["name"]]
        values = [float(x) for x in table["diameter_mas"]]
        errors = [float(x) for x in table["error_mas"]] if "error_mas" in table.colnames else []
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "is no table of diameters",
            source=path,
            remedy="give columns name, diameter_mas and, if known, error_mas",
        ) from error
    out = []
    for calibrator in calibrators:
        file = Path(calibrator.source)
        known = {file.name, file.stem, str(file), calibrator.setups[0].target}
        rows = [i for i, name in enumerate(names) if name in {k.casefold() for k in known}]
        if not rows:
            raise DataError(
                f"has no line for {calibrator.source} ({calibrator.setups[0].target})",
                source=path,
                remedy="name the file or its target",
            )
        out.append((values[rows[0]], errors[rows[0]] if errors else 0.0))
    return out


def without_disc(calibrator: Observables, diameter_mas: float) -> Observables:
    """The squared visibilities of a calibrator over those of its disc: a point remains.

    Parameters
    ----------
    diameter_mas : float
        Uniform disc; its error is not in the covariance.
    """
    if diameter_mas == 0.0:
        return calibrator
    m = calibrator.vis2
    amplitude, _ = uniform_disc(np.hypot(m.u_m[:, 0], m.v_m[:, 0]) / m.wavelength_m, diameter_mas)
    factor = 1.0 / amplitude**2
    every = np.concatenate([factor[~m.flag], np.ones(calibrator.n_closure_phases)])
    scatter = calibrator.scatter
    return replace(
        calibrator,
        vis2=replace(m, value=np.where(m.flag, m.value, m.value * factor)),
        covariance=scaled(calibrator.covariance, every),
        scatter=None if scatter is None else (scatter * every[:, None] * every[None]).tocsr(),
        shared=None if calibrator.shared is None else calibrator.shared.scaled(every),
    )
