"""Kernel phases as observables: frames of one orientation averaged, with their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np
from scipy.sparse import block_diag, coo_array, csr_array

from amibayes.data.closure import kernel_basis
from amibayes.data.covariance import Block, BlockCovariance, diagonal_covariance
from amibayes.data.degrees_of_freedom import stacked_freedom
from amibayes.data.kernel_model import KernelModel
from amibayes.data.measurements import Measurements
from amibayes.data.observables import CovarianceKind, Observables, join
from amibayes.data.setup import Setup
from amibayes.data.shrinkage import Shrunk, shrunk_covariance
from amibayes.errors import DataError
from amibayes.kpfits.file import KernelFile, open_kpfits
from amibayes.units import FloatArray, IntArray

SAME_ORIENTATION_DEG = 0.3
"""Frames that turn by less are averaged: half of it moves what is ten resolution elements
out by 0.03 of one, which changes its kernel phases by less than a fifth."""

MIN_SCATTER = 4
"""Frames from which on their scatter is a share of the covariance."""


def kernel_observables(
    path: str | Path,
    *,
    insname: str | None = None,
    target: str | None = None,
    closure_covariance: str = "assumed",
) -> Observables:
    """Read the kernel phases of a KPFITS file.

    Parameters
    ----------
    path : path
    insname, target : str, optional
        Refuse a file of another instrument or star.
    closure_covariance : {"assumed", "diagonal"}
        Keep the covariance, or take kernel phases as independent.

    Returns
    -------
    Observables
        Without V²; kernel phases stand in the table of closure phases, and each orientation
        of the detector is a `Setup`.

    Raises
    ------
    DataError
        Where the file cannot be read or used.
    """
    file = open_kpfits(path)
    _refuse_other(file, insname, target)
    parts = [
        _averaged(file, frames, closure_covariance == "diagonal") for frames in orientations(file)
    ]
    whole = join(parts)
    return Observables(
        whole.vis2,
        whole.closure_phase,
        whole.covariance,
        whole.covariance_kind,
        whole.setups,
        whole.n_integrations,
        notes_of(file, len(parts)),
        whole.freedom,
        whole.scatter,
    )


def notes_of(file: KernelFile, n_orientations: int) -> tuple[str, ...]:
    """What the reader decided."""
    notes = []
    if n_orientations > 1:
        notes.append(f"frames in {n_orientations} orientations, each averaged by itself")
    if not file.oriented:
        notes.append("no DETPA: the image is taken with north up and east to the left")
    if not file.has_covariance:
        notes.append("no KP-COV: kernel phases are taken as independent")
    return tuple(notes)


def _refuse_other(file: KernelFile, insname: str | None, target: str | None) -> None:
    if insname is not None and insname.casefold() != file.instrument.casefold():
        raise DataError(
            f"has no INSNAME {insname!r}", source=file.path, remedy=f"it has {file.instrument}"
        )
    if target is not None and file.target and target.casefold() != file.target.casefold():
        raise DataError(
            f"has no data of target {target!r}", source=file.path, remedy=f"it has {file.target}"
        )


def orientations(file: KernelFile) -> list[IntArray]:
    """Frames that may be averaged, each group within `SAME_ORIENTATION_DEG`."""
    angle = file.position_angle_deg % 360.0
    order = np.argsort(angle, kind="stable")
    groups: list[list[int]] = []
    for k in order.tolist():
        if groups and angle[k] - angle[groups[-1][0]] <= SAME_ORIENTATION_DEG:
            groups[-1].append(k)
        else:
            groups.append([k])
    if len(groups) > 1:
        across_north = angle[groups[0][-1]] + 360.0 - angle[groups[-1][0]]
        if across_north <= SAME_ORIENTATION_DEG:
            groups[0] += groups.pop()
    return [np.sort(g) for g in groups]


def _mean_angle(angle_deg: FloatArray) -> float:
    """Mean of angles that are near each other, also across north."""
    first = float(angle_deg[0])
    return first + float(np.mean((angle_deg - first + 180.0) % 360.0 - 180.0))


def _averaged(file: KernelFile, frames: IntArray, independent: bool) -> Observables:
    n, n_channels = len(file.matrix), len(file.wavelength_m)
    setup = make_setup(file, _mean_angle(file.position_angle_deg[frames]))
    value = file.value[frames].mean(axis=0)
    basis = kernel_basis(file.matrix)
    found = [_covariance(file, frames, k, basis) for k in range(n_channels)]
    matrices = [f.matrix / len(frames) for f in found]
    estimated = all(f.carried is not None for f in found)
    freedom = stacked_freedom((basis.shape[1], f.carried) for f in found) if estimated else None
    scatter = csr_array(block_diag([coo_array(f.scatter / len(frames)) for f in found]))
    stated: CovarianceKind = "given" if file.has_covariance else "diagonal"
    kind: CovarianceKind = "estimated" if estimated else stated
    if independent:
        kind, freedom = "diagonal", None
    return Observables(
        empty_table(2),
        _table(file, setup, value),
        _whole(matrices, basis, independent, file.path),
        kind,
        (setup,),
        len(frames) if estimated else None,
        (),
        freedom,
        scatter if freedom is not None and n * n_channels == scatter.shape[0] else None,
    )


def _covariance(file: KernelFile, frames: IntArray, channel: int, basis: FloatArray) -> Shrunk:
    """Covariance of the kernel phases of one frame at one wavelength."""
    value = file.value[frames, channel]
    stated = file.covariance[frames, channel].mean(axis=0)
    kind = "shrunk" if len(frames) >= MIN_SCATTER else "physical"
    try:
        return shrunk_covariance(value - value.mean(axis=0), stated, basis, 0, kind)
    except np.linalg.LinAlgError as error:
        raise DataError(
            "holds kernel phases whose covariance is not positive definite",
            source=file.path,
            remedy="write KP-COV (or KP-SIGM above 0) anew",
        ) from error


def _whole(
    matrices: Sequence[FloatArray], basis: FloatArray, independent: bool, path: str
) -> BlockCovariance:
    """Covariance of all wavelengths, those of one after those of the other."""
    n = len(basis)
    if independent:
        return diagonal_covariance(np.concatenate([np.diag(m) for m in matrices]))
    full = None if basis.shape[1] == n else basis
    blocks = [Block(k * n + np.arange(n), m, full) for k, m in enumerate(matrices)]
    return BlockCovariance(n * len(matrices), blocks)


def make_setup(file: KernelFile, position_angle_deg: float) -> Setup:
    """The instrument with its pupil turned on the sky by a position angle of the image's y."""
    angle = np.radians(position_angle_deg)
    # x points to position angle θ − 90°, y to θ: x = −α cos θ + δ sin θ, y = α sin θ + δ cos θ.
    u = -file.u_m * np.cos(angle) + file.v_m * np.sin(angle)
    v = file.u_m * np.sin(angle) + file.v_m * np.cos(angle)
    n = len(file.matrix)
    name = _digest(file)
    return Setup(
        insname=file.instrument,
        arrname=f"PUPIL_{name}",
        target=file.target,
        stations=tuple(f"{name}/{k + 1}" for k in range(n)),
        station_index=np.arange(1, n + 1),
        wavelength_m=file.wavelength_m,
        band_m=file.band_m,
        source=file.path,
        kernel=KernelModel(file.matrix, u, v),
    )


def _digest(file: KernelFile) -> str:
    """Name that files of one kernel matrix share: only they can calibrate each other."""
    numbers = np.concatenate([file.matrix.ravel(), file.u_m, file.v_m])
    return sha256(np.round(numbers, 4).astype(np.float32).tobytes()).hexdigest()[:6]


def _table(file: KernelFile, setup: Setup, value: FloatArray) -> Measurements:
    """Kernel phases (n_wavelengths, n_kernels), by wavelength and then kernel."""
    n_channels, n = value.shape
    kernel, channel = np.tile(np.arange(n), n_channels), np.repeat(np.arange(n_channels), n)
    model = setup.kernel
    assert model is not None
    main = model.main_points()[kernel]
    nothing = np.zeros(len(kernel))
    exposure = file.header.get("EXPTIME", file.header.get("EFFINTTM"))
    time = float(exposure) if isinstance(exposure, int | float) else 0.0
    return Measurements(
        value=value.ravel(),
        u_m=np.stack([model.u_m[main], nothing], axis=1),
        v_m=np.stack([model.v_m[main], nothing], axis=1),
        wavelength_m=setup.wavelength_m[channel],
        band_m=setup.band_m[channel],
        mjd=np.full(len(kernel), file.mjd),
        integration_s=np.full(len(kernel), time),
        stations=np.stack([kernel] * 3, axis=1),
        setup=np.zeros(len(kernel), dtype=np.intp),
        row=kernel,
        channel=channel,
        flag=np.zeros(len(kernel), dtype=bool),
    )


def empty_table(n_stations: int) -> Measurements:
    """A table without entries: V² of an image of the full pupil."""
    none, whole = np.empty(0), np.empty(0, dtype=np.intp)
    legs = np.empty((0, n_stations - 1))
    stations = np.empty((0, n_stations), dtype=np.intp)
    return Measurements(
        none, legs, legs, none, none, none, none, stations, whole, whole, whole,
        np.empty(0, dtype=bool),
    )  # fmt: skip
