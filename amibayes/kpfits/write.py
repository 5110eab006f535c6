"""Write kernel phases as KPFITS: each orientation is a frame."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy.io import fits

from amibayes.data.observables import Observables
from amibayes.errors import DataError, UsageError
from amibayes.oifits import write_oifits
from amibayes.support.atomic_files import atomic_path
from amibayes.units import BoolArray, FloatArray


def write_kpfits(path: str | Path, observables: Observables, *, overwrite: bool = False) -> None:
    """Write unflagged kernel phases of one pupil with their covariance, whole or not at all.

    Covariances between orientations, as those of shared calibrators, have no place in the
    format and are left out.

    Parameters
    ----------
    path : path
    observables : Observables
        Kernel phases of one kernel matrix; points are written as seen on the sky, DETPA 0.
    overwrite : bool

    Raises
    ------
    DataError
        Where there are none, of several pupils, or some are flagged.
    UsageError
        Where the file is there and ``overwrite`` is false.
    """
    if Path(path).exists() and not overwrite:
        raise UsageError("is there already", source=path, remedy="choose another name")
    hdus = _hdus(observables)
    with atomic_path(path) as temporary:
        hdus.writeto(temporary, overwrite=True, output_verify="exception")


def write_observables(path: Path, observables: Observables) -> tuple[Path, ...]:
    """Write V² and closure phases as OIFITS, kernel phases as KPFITS beside it, over old files.

    Parameters
    ----------
    path : Path
        Of the OIFITS file; kernel phases get its name with ``_kpfits.fits`` at the end.

    Returns
    -------
    tuple of Path
        What was written.
    """
    kernel = np.array([s.kernel is not None for s in observables.setups])
    if not kernel.any():
        write_oifits(path, observables, overwrite=True)
        return (path,)
    beside = path.with_name(f"{path.stem}_kpfits.fits")
    write_kpfits(beside, of_setups(observables, kernel), overwrite=True)
    if kernel.all():
        return (beside,)
    write_oifits(path, of_setups(observables, ~kernel), overwrite=True)
    return path, beside


def of_setups(observables: Observables, chosen: BoolArray) -> Observables:
    """The data of some setups, numbered anew."""
    number = np.cumsum(chosen) - 1
    part = observables.select(
        chosen[observables.vis2.setup], chosen[observables.closure_phase.setup]
    )
    return replace(
        part,
        vis2=replace(part.vis2, setup=number[part.vis2.setup]),
        closure_phase=replace(part.closure_phase, setup=number[part.closure_phase.setup]),
        setups=tuple(s for s, use in zip(observables.setups, chosen, strict=True) if use),
    )


def _hdus(observables: Observables) -> fits.HDUList:
    models = [s.kernel for s in observables.setups]
    first, table = models[0], observables.closure_phase
    if first is None or not all(m and np.array_equal(m.matrix, first.matrix) for m in models):
        raise DataError("KPFITS holds kernel phases of one pupil", source=observables.source)
    n_frames, n, n_channels = len(models), len(first.matrix), len(observables.setups[0].band_m)
    if len(table) != n_frames * n * n_channels or table.flag.any():
        raise DataError(
            "some kernel phases are flagged, and KPFITS has no flags", source=observables.source
        )
    place = (table.setup * n_channels + table.channel) * n + table.stations[:, 0]
    order = np.argsort(place)
    whole = observables.covariance.sparse[order][:, order]
    blocks = [whole[k : k + n, k : k + n].toarray() for k in range(0, n_frames * n_channels * n, n)]
    covariance = np.array(blocks).reshape(n_frames, n_channels, n, n)
    value = table.value[order].reshape(n_frames, n_channels, n)
    angles = _angles(observables)
    setup = observables.setups[0]
    primary = fits.PrimaryHDU()
    primary.header.update(
        {"INSTRUME": setup.insname, "OBJECT": setup.target, "CONTENT": "KPFITS1",
         "PROCSOFT": "AMIBAYES", "CALFLAG": "True"}
    )  # fmt: skip
    mjd = float(np.nanmean(table.mjd)) if np.isfinite(table.mjd).any() else None
    if mjd is not None:
        primary.header["MJD-AVG"] = mjd
    tables = [
        _columns("UV-PLANE", {"UUC": -first.u_m, "VVC": first.v_m, "RED": np.ones(len(first.u_m))}),
        _columns("CWAVEL", {"CWAVEL": setup.wavelength_m, "BWIDTH": setup.band_m}),
    ]
    images = {
        "KER-MAT": first.matrix,
        "KP-DATA": value,
        "KP-SIGM": np.sqrt(np.einsum("fwkk->fwk", covariance)),
        "KP-COV": covariance,
        "DETPA": angles,
    }
    return fits.HDUList(
        [primary, *tables, *(fits.ImageHDU(data, name=name) for name, data in images.items())]
    )


def _columns(name: str, columns: dict[str, FloatArray]) -> fits.BinTableHDU:
    built = [fits.Column(key, "D", array=data) for key, data in columns.items()]
    return fits.BinTableHDU.from_columns(built, name=name)


def _angles(observables: Observables) -> FloatArray:
    """Turn of each orientation against the first, degrees."""
    points = [s.kernel.u_m + 1j * s.kernel.v_m for s in observables.setups if s.kernel is not None]
    return np.array([-np.degrees(np.angle(np.vdot(points[0], p))) for p in points])
