"""One merged file for a program of image reconstruction, and the command that starts it.

The programs read one object's squared visibilities and closure phases. They differ in what
they do with the rest: complex visibilities (OI_VIS) of most instruments are differential and
would be taken as absolute, so they are left out; triple amplitudes are computed from V² for
programs that ask for them; nothing is NaN, also where flagged.
"""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from amibayes.data.closure import canonical
from amibayes.data.covariance import diagonal_covariance
from amibayes.data.measurements import Measurements
from amibayes.data.observables import Observables, join
from amibayes.data.setup import Setup
from amibayes.errors import DataError, UsageError
from amibayes.oifits.columns import same
from amibayes.oifits.writer import to_hdus
from amibayes.support.atomic_files import atomic_path
from amibayes.support.options import ImagingProgram
from amibayes.units import MAS, BoolArray, FloatArray

PIXELS_PER_RESOLUTION = 4.0
"""Pixels per λ/B_max."""

MIN_PIXELS = 32
NO_AMPLITUDE_ERROR = 1e3
"""Error of a triple amplitude that V² cannot give: it then counts for nothing."""


@dataclass(frozen=True, eq=False)
class Export:
    """A file for image reconstruction.

    Parameters
    ----------
    program : {"irbis", "squeeze", "mira"}
    target : str
    hdus : astropy.io.fits.HDUList
    pixel_mas, field_mas : float
        Suggested pixel and width of the image.
    n_pixels : int
    wavelength_um : (shortest, longest)
    mjd_tolerance : float
        Largest difference in days between a triangle's date and those of its baselines.
    notes : tuple of str
        What was left out or changed.
    """

    program: ImagingProgram
    target: str
    hdus: fits.HDUList
    pixel_mas: float
    field_mas: float
    n_pixels: int
    wavelength_um: tuple[float, float]
    mjd_tolerance: float
    notes: tuple[str, ...]

    def command(self, path: str | Path) -> str:
        """The command line that reconstructs an image from the file ``path``."""
        stem = Path(path).with_suffix("")
        path, image = shlex.quote(str(path)), shlex.quote(f"{stem}-image")
        if self.program == "squeeze":
            return (
                f"squeeze {path} -s {self.pixel_mas:.4g} -w {self.n_pixels} -novis -not3amp "
                f"-chains 5 -o {image}"
            )
        if self.program == "mira":
            # The mean pixel of an image of unit flux is the threshold of the edges.
            return (
                f"ymira -pixelsize={self.pixel_mas:.4g}mas -fov={self.field_mas:.4g}mas -flux=1 "
                f"-min=0 -regul=hyperbolic -mu=3e3 -tau={self.n_pixels**-2.0:.2g} -ftol=0 -gtol=0 "
                f"-maxeval=1000 -initial=Dirac -bootstrap=1 -recenter {path} {image}.fits"
            )
        first, last = self.wavelength_um
        return (
            f"esorex mat_cal_imarec --fov={self.field_mas:.4g} --npix={self.n_pixels} "
            f"--lambda_from={first:.4f} --lambda_to={last:.4f} --algo_mode=1 --calc_t3amp=1 "
            f"--start_mode=1 --mjd_tol={self.mjd_tolerance:.2g} {shlex.quote(f'{stem}.sof')}"
        )

    def set_of_frames(self, path: str | Path) -> str:
        """Content of the set of frames that IRBis reads."""
        return f"{path} TARGET_CAL_INT\n"


def export(parts: Sequence[Observables], program: ImagingProgram) -> Export:
    """Merge data of one object for a program of image reconstruction.

    Parameters
    ----------
    parts : sequence of Observables
        Epochs, filters, files of the same object.
    program : {"irbis", "squeeze", "mira"}

    Raises
    ------
    DataError
        Where there are no V² or no closure phases: an image needs both.
    """
    whole, notes = _one_object(parts)
    if not whole.n_vis2 or not whole.n_closure_phases:
        missing = "closure phases" if whole.n_vis2 else "squared visibilities"
        raise DataError(
            f"has no usable {missing}", source=whole.source, remedy="an image needs both"
        )
    pixel, field, n_pixels = _image(whole, program)
    hdus = to_hdus(whole, {"PROCSOFT": "amibayes export"})
    amplitude, error, apart = triple_amplitudes(whole)
    _plain(hdus, whole, amplitude, error)
    if program == "irbis":
        hdus[0].header["HIERARCH ESO PRO CATG"] = "TARGET_CAL_INT"
    waves = np.concatenate([s.wavelength_m for s in whole.setups]) * 1e6
    bands = np.concatenate([s.band_m for s in whole.setups]) * 1e6
    return Export(
        program,
        whole.setups[0].target,
        hdus,
        pixel,
        field,
        n_pixels,
        (float((waves - bands / 2).min()), float((waves + bands / 2).max())),
        max(1e-4, 1.01 * apart),
        notes,
    )


def write_export(path: str | Path, exported: Export, *, overwrite: bool = False) -> None:
    """Write the file, whole or not at all.

    Raises
    ------
    UsageError
        Where it is there and ``overwrite`` is false.
    """
    if Path(path).exists() and not overwrite:
        raise UsageError("is there already", source=path, remedy="choose another name")
    with atomic_path(path) as temporary:
        exported.hdus.writeto(temporary, overwrite=True, output_verify="exception")


def _one_object(parts: Sequence[Observables]) -> tuple[Observables, tuple[str, ...]]:
    """All data under one name, without rows that are flagged throughout."""
    name = parts[0].setups[0].target
    others = {s.target for p in parts for s in p.setups if not same(s.target, name)}
    notes = [f"{', '.join(sorted(others))} written as {name}"] if others else []
    whole = join(parts)
    whole = replace(whole, setups=tuple(_of_target(s, whole.setups[0]) for s in whole.setups))
    masks = [_row_in_use(m) for m in (whole.vis2, whole.closure_phase)]
    dropped = sum(int((~mask).sum()) for mask in masks)
    notes += [f"{dropped} flagged value(s) left out"] if dropped else []
    whole = whole.select(masks[0], masks[1])
    if not whole.covariance.independent:
        notes.append("correlations left out: the program cannot use them")
    errors = diagonal_covariance(whole.covariance.variance)
    plain = replace(
        whole,
        covariance=errors,
        covariance_kind="diagonal",
        n_integrations=None,
        freedom=None,
        scatter=None,
    )
    return plain, (*notes, "complex visibilities (OI_VIS) are not written")


def _of_target(setup: Setup, first: Setup) -> Setup:
    """The same setup under the name and at the place of the first one's target."""
    return replace(
        setup,
        target=first.target,
        right_ascension_deg=first.right_ascension_deg,
        declination_deg=first.declination_deg,
    )


def _row_in_use(m: Measurements) -> BoolArray:
    """Entries whose row has at least one unflagged channel."""
    if not len(m):
        return np.zeros(0, dtype=bool)
    _, row = np.unique(np.stack([m.setup, m.row]), axis=1, return_inverse=True)
    return np.asarray(np.bincount(row.ravel(), ~m.flag)[row.ravel()] > 0)


def _image(whole: Observables, program: ImagingProgram) -> tuple[float, float, int]:
    """Pixel and width in mas, and number of pixels."""
    m = whole.vis2.select(~whole.vis2.flag)
    frequency = m.frequency[m.frequency > 0]
    pixel = 1.0 / (PIXELS_PER_RESOLUTION * frequency.max() * MAS)
    digits = 10.0 ** (1 - np.floor(np.log10(pixel)))
    pixel = np.floor(pixel * digits) / digits
    wanted = max(MIN_PIXELS, 2.0 / (frequency.min() * MAS) / pixel)
    # A Fourier transform likes powers of two, and IRBis asks for them.
    n = int(2 ** np.ceil(np.log2(wanted))) if program == "irbis" else int(2 * np.ceil(wanted / 2))
    return float(pixel), float(pixel * n), n


def triple_amplitudes(whole: Observables) -> tuple[FloatArray, FloatArray, float]:
    """Triple amplitudes √(V²V²V²) of the closure phases, their errors, and the days between.

    Of each baseline the V² nearest in time serves; where one is missing, flagged or not above
    its error the amplitude is 1 with an error that makes it count for nothing.
    """
    v, c = whole.vis2, whole.closure_phase
    sigma = whole.errors[0]
    usable = np.flatnonzero(~v.flag & (v.value > np.nan_to_num(sigma, nan=np.inf)))
    by_baseline: dict[tuple[int, ...], list[int]] = {}
    ordered, _ = canonical(v.stations)
    for i in usable.tolist():
        key = (int(v.setup[i]), int(v.channel[i]), *ordered[i].tolist())
        by_baseline.setdefault(key, []).append(i)
    amplitude, error = np.ones(len(c)), np.full(len(c), NO_AMPLITUDE_ERROR)
    apart = 0.0
    for i in range(len(c)):
        sides = _sides(c, i, v, by_baseline)
        if sides:
            days = float(np.abs(v.mjd[sides] - c.mjd[i]).max())
            apart = max(apart, days)
            amplitude[i] = np.sqrt(np.prod(v.value[sides]))
            relative = sigma[sides] / (2 * v.value[sides])
            error[i] = amplitude[i] * np.sqrt((relative**2).sum())
    return amplitude, error, apart


def _sides(
    c: Measurements, i: int, v: Measurements, by_baseline: dict[tuple[int, ...], list[int]]
) -> list[int]:
    """The V² of the three sides of a triangle, nearest in time; none where one is missing."""
    found = []
    a, b, d = sorted(c.stations[i].tolist())
    for pair in ((a, b), (b, d), (a, d)):
        rows = by_baseline.get((int(c.setup[i]), int(c.channel[i]), *pair))
        if rows is None:
            return []
        found.append(rows[int(np.argmin(np.abs(v.mjd[rows] - c.mjd[i])))])
    return found


def _plain(
    hdus: fits.HDUList, whole: Observables, amplitude: FloatArray, error: FloatArray
) -> None:
    """Leave the standard's own columns, without NaN; triple amplitudes as computed."""
    for i, hdu in enumerate(hdus[1:], 1):
        names = [n for n in hdu.columns.names if not n.startswith("NS_")]
        columns = [hdu.columns[n] for n in names]
        table = fits.BinTableHDU.from_columns(
            [fits.Column(c.name, c.format, unit=c.unit, array=hdu.data[c.name]) for c in columns],
            header=hdu.header,
            name=hdu.name,
        )
        if hdu.name == "OI_T3":
            _fill_amplitudes(table, hdu, whole, amplitude, error)
        _fill(table)
        for key in [k for k in table.header if k.startswith("AMIBAYES")]:
            del table.header[key]
        hdus[i] = table


def _fill_amplitudes(
    table: Any, original: Any, whole: Observables, amplitude: FloatArray, error: FloatArray
) -> None:
    """Put the amplitudes of one setup into the cells of its table."""
    closure = whole.closure_phase
    ours = np.flatnonzero(closure.setup == original.header["AMIBAYES SETUP"] - 1)
    _, row = np.unique(closure.row[ours], return_inverse=True)
    for name, values in (("T3AMP", amplitude), ("T3AMPERR", error)):
        shape = table.data[name].shape
        grid = np.full((shape[0], int(np.prod(shape[1:]))), np.nan)
        grid[row.ravel(), closure.channel[ours]] = values[ours]
        table.data[name] = grid.reshape(shape)
    phase = table.data["T3PHI"]
    table.data["T3PHI"] = phase - 360.0 * np.round(phase / 360.0)


def _fill(table: Any) -> None:
    """Harmless numbers where a flagged cell holds none: 0 with an enormous error."""
    for name in table.columns.names:
        values = table.data[name]
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            filler = NO_AMPLITUDE_ERROR if name.endswith("ERR") else 0.0
            table.data[name] = np.where(np.isfinite(values), values, filler)
