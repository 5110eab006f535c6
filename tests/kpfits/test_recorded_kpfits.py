"""Numbers of files of kernel phases as they were recorded.

`pytest tests/kpfits/test_recorded_kpfits.py --force-regen` records them anew.
"""

from __future__ import annotations

from itertools import combinations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from pupil_images import write_kernel_file
from recorded_numbers import checker

from amibayes.calibration import calibrate
from amibayes.kpfits import kernel_observables, write_kpfits
from amibayes.kpfits.audit import audit_kpfits
from amibayes.kpfits.file import open_kpfits
from amibayes.kpfits.observables import orientations


def small_pupil() -> Any:
    """Five holes, whose kernel is that of the triangles at one of them: no rounding decides it."""
    cells = np.array([(0.0, 0.0), (2.1, 0.4), (-1.3, 1.9), (0.7, -2.3), (-2.2, -1.1)])
    pairs = list(combinations(range(5), 2))
    legs = np.array([cells[b] - cells[a] for a, b in pairs])
    matrix = np.zeros((len(pairs), 4))
    for k, (a, b) in enumerate(pairs):
        matrix[k, b - 1] = 1.0
        if a:
            matrix[k, a - 1] = -1.0
    kernel = np.zeros((6, len(pairs)))
    for k, (a, b) in enumerate(combinations(range(1, 5), 2)):
        for pair, sign in (((0, a), 1.0), ((a, b), 1.0), ((0, b), -1.0)):
            kernel[k, pairs.index(pair)] = sign * (1.0 + 0.1 * k)
    return SimpleNamespace(
        points=legs,
        cells=cells,
        redundancy=np.arange(5.0, 15.0),
        kernel=kernel,
        baseline_matrix=matrix,
    )


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Frames at two angles of a target, frames of a calibrator, and one frame."""
    folder, pupil = tmp_path_factory.mktemp("kernel"), small_pupil()
    rng = np.random.default_rng(1)
    n = len(pupil.kernel)
    root = 0.002 * (np.eye(n) + 0.3 * rng.normal(size=(n, n)))
    made = {
        "target": [10.0] * 9 + [50.0] * 8,
        "star": [12.0] * 9,
        "few": [20.0, 20.0, 70.0],
        "single": [30.0],
    }
    return {
        name: write_kernel_file(
            folder / f"{name}.fits",
            pupil,
            0.03 * np.sin(np.arange(n)) + rng.normal(size=(len(angle), n)) @ root.T,
            np.stack([root @ root.T * (1.0 + 0.1 * k) for k in range(len(angle))]),
            np.array(angle),
        )
        for name, angle in made.items()
    }


@pytest.mark.parametrize("name", ["target", "star", "few", "single"])
def test_kernel_phases_are_read_as_recorded(
    name: str, files: dict[str, Path], num_regression
) -> None:
    """Frames of one orientation are averaged, with their scatter or their stated errors."""
    found = kernel_observables(files[name])
    file = open_kpfits(files[name])
    m = found.closure_phase
    checker(num_regression)(
        values=(m.value, m.u_m, m.v_m, m.wavelength_m, m.band_m),
        error=found.errors,
        freedom=found.freedom,
        counts=(found.n_integrations or 0, found.n_independent),
        covariance=found.covariance,
        scatter=found.scatter,
        kernel=[(s.kernel.matrix, s.kernel.u_m, s.kernel.v_m) for s in found.setups],
        file=(file.matrix, file.u_m, file.v_m, file.value, file.covariance),
        angles=file.position_angle_deg,
        orientations=orientations(file),
        findings=len(audit_kpfits(files[name]).findings),
    )


def test_kernel_phases_are_written_as_recorded(
    files: dict[str, Path], tmp_path: Path, num_regression
) -> None:
    """What is calibrated, in a file and back."""
    target, star = (kernel_observables(files[n]) for n in ("target", "star"))
    found = calibrate(target, [star], method="weighted").observables
    path = tmp_path / "a.fits"
    write_kpfits(path, found)
    back = kernel_observables(path)
    with fits.open(path) as hdus:
        images = {h.name: h.data for h in hdus if isinstance(h, fits.ImageHDU)}
        tables = {
            f"{h.name}.{c}": h.data[c]
            for h in hdus
            if isinstance(h, fits.BinTableHDU)
            for c in h.columns.names
            if h.data[c].dtype.kind in "fi"
        }
    checker(num_regression)(
        images=images, tables=tables, back=back.closure_phase.value, covariance=back.covariance
    )
