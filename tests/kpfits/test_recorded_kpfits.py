"""Numbers of files of kernel phases as they were recorded.

`pytest tests/kpfits/test_recorded_kpfits.py --force-regen` records them anew.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from pupil_images import Pupil, write_kernel_file
from recorded_numbers import checker

from amibayes.calibration import calibrate
from amibayes.kpfits import kernel_observables, write_kpfits
from amibayes.kpfits.audit import audit_kpfits
from amibayes.kpfits.file import open_kpfits
from amibayes.kpfits.observables import orientations

SETTINGS = {"passed_over": ("setups", "header", "mjd")}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Frames at two angles of a target, frames of a calibrator, and one frame."""
    folder, pupil = tmp_path_factory.mktemp("kernel"), Pupil()
    rng = np.random.default_rng(1)
    n = len(pupil.kernel)
    root = 0.002 * (np.eye(n) + 0.1 * rng.normal(size=(n, n)) / np.sqrt(n))
    made = {"target": [10.0, 10.0, 10.0, 50.0, 50.0], "star": [12.0] * 4, "single": [30.0]}
    return {
        name: write_kernel_file(
            folder / f"{name}.fits", pupil,
            0.03 * np.sin(np.arange(n)) + rng.normal(size=(len(angle), n)) @ root.T,
            np.stack([root @ root.T * (1.0 + 0.1 * k) for k in range(len(angle))]),
            np.array(angle),
        )
        for name, angle in made.items()
    }  # fmt: skip


@pytest.mark.parametrize("name", ["target", "star", "single"])
def test_kernel_phases_are_read_as_recorded(
    name: str, files: dict[str, Path], num_regression
) -> None:
    """Frames of one orientation are averaged, with their scatter or their stated errors."""
    found = kernel_observables(files[name])
    file = open_kpfits(files[name])
    m = found.closure_phase
    checker(num_regression)(
        value=m.value, u=m.u_m, v=m.v_m, wave=m.wavelength_m, band=m.band_m,
        error=found.errors, freedom=found.freedom, counts=(found.n_integrations or 0, found.n_independent),
        covariance=found.covariance, scatter=found.scatter,
        kernel=[(s.kernel.matrix, s.kernel.u_m, s.kernel.v_m) for s in found.setups],
        file=(file.matrix, file.u_m, file.v_m, file.value, file.covariance, file.position_angle_deg),
        orientations=orientations(file), findings=len(audit_kpfits(files[name]).findings),
    )  # fmt: skip


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
