"""Images of a full pupil by direct transforms, and its own kernel matrix by SVD."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from astropy.io import fits

WAVELENGTH, BAND = 4.8e-6, 0.3e-6
CELL_M = 0.65
MAS = np.pi / 180 / 3.6e6
PIXEL_RAD = 65.0 * MAS
SIDE = 65


@dataclass(frozen=True)
class Pupil:
    """Square cells of an annulus 6.5 m across; ``fine`` points a side for diffraction."""

    fine: int = 10

    @cached_property
    def cells(self) -> np.ndarray:
        """Centres (n, 2) in metres. Lopsided: one cell is missing, so that kernels see a flip."""
        axis = CELL_M * np.arange(-5, 6)
        x, y = (g.ravel() for g in np.meshgrid(axis, axis))
        radius = np.hypot(x, y)
        keep = (radius < 3.3) & (radius > 0.7) & ~((np.abs(x - 1.3) < 0.1) & (y > 2.0))
        return np.stack([x[keep], y[keep]], axis=1)

    @cached_property
    def _pairs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        lattice = np.rint(self.cells / CELL_M).astype(int)
        i, j = (k.ravel() for k in np.indices((len(lattice),) * 2))
        step = lattice[i] - lattice[j]
        half = (step[:, 0] > 0) | ((step[:, 0] == 0) & (step[:, 1] > 0))
        unique, which = np.unique(step[half], axis=0, return_inverse=True)
        matrix = np.zeros((len(unique), len(lattice)))
        np.add.at(matrix, (which.ravel(), i[half]), 1.0)
        np.add.at(matrix, (which.ravel(), j[half]), -1.0)
        return unique * CELL_M, matrix, np.bincount(which.ravel()).astype(float)

    @property
    def points(self) -> np.ndarray:
        """Baselines (n_points, 2) in metres."""
        return self._pairs[0]

    @property
    def baseline_matrix(self) -> np.ndarray:
        return self._pairs[1]

    @property
    def redundancy(self) -> np.ndarray:
        return self._pairs[2]

    @cached_property
    def kernel(self) -> np.ndarray:
        """Rows of unit length that annul (pupil phase → phase at the points), (n, n_points)."""
        _, matrix, redundancy = self._pairs
        left, singular, _ = np.linalg.svd(matrix / redundancy[:, None])
        null = left[:, np.sum(singular > 1e-9) :].T
        return null / np.linalg.norm(null, axis=1, keepdims=True)

    def image(self, sources: list[tuple[float, float, float]], phase: np.ndarray) -> np.ndarray:
        """Detector image (SIDE, SIDE), y up, of points (x, y in radians, flux); unit flux sum.

        |Σ field · e^{−2πi p·x/λ}|² at the pixels' centres, by a direct transform.
        """
        step = CELL_M / self.fine
        axis = PIXEL_RAD * (np.arange(SIDE) - SIDE // 2)
        offsets = step * (np.arange(self.fine) - (self.fine - 1) / 2)
        total = np.zeros((SIDE, SIDE))
        for x0, y0, flux in sources:
            image_x = np.exp(-2j * np.pi * np.outer(axis - x0, self.cells[:, 0]) / WAVELENGTH)
            image_y = np.exp(-2j * np.pi * np.outer(axis - y0, self.cells[:, 1]) / WAVELENGTH)
            cell_x = np.exp(-2j * np.pi * np.outer(axis - x0, offsets) / WAVELENGTH).sum(axis=1)
            cell_y = np.exp(-2j * np.pi * np.outer(axis - y0, offsets) / WAVELENGTH).sum(axis=1)
            amplitude = np.einsum("yn,n,xn->yx", image_y, np.exp(1j * phase), image_x)
            total += flux * np.abs(amplitude * np.outer(cell_y, cell_x)) ** 2
        return total / total.sum()

    @cached_property
    def fourier(self) -> np.ndarray:
        """exp(−2πi(ux + vy)/λ) of the points and pixels, (n_points, SIDE²)."""
        axis = PIXEL_RAD * (np.arange(SIDE) - SIDE // 2)
        y, x = (g.ravel() for g in np.meshgrid(axis, axis, indexing="ij"))
        turns = (np.outer(self.points[:, 0], x) + np.outer(self.points[:, 1], y)) / WAVELENGTH
        return np.exp(-2j * np.pi * turns)

    def measure(self, image: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Kernel phases of an image and their covariance by propagation of the pixels' variance."""
        seen = self.fourier @ image.ravel()
        slope = self.kernel @ ((self.fourier / seen[:, None]).imag)
        return self.kernel @ np.angle(seen), (slope * variance.ravel()) @ slope.T

    def phases(
        self, east_mas: float, north_mas: float, contrast: float, angle: float
    ) -> np.ndarray:
        """Kernel phases of a binary on the sky, image's y at position angle ``angle`` degrees."""
        x, y = self.on_image(east_mas, north_mas, angle)
        turns = (self.points[:, 0] * x + self.points[:, 1] * y) / WAVELENGTH
        return self.kernel @ np.angle(1.0 + contrast * np.exp(-2j * np.pi * turns))

    @staticmethod
    def on_image(east_mas: float, north_mas: float, angle: float) -> tuple[float, float]:
        """Place (x right, y up), radians, of an offset on the sky; east is left of north."""
        place_angle = np.arctan2(east_mas, north_mas) - np.radians(angle)
        length = MAS * np.hypot(east_mas, north_mas)
        return -length * np.sin(place_angle), length * np.cos(place_angle)


def write_kernel_file(
    path: Path,
    pupil: Pupil,
    value: np.ndarray,
    covariance: np.ndarray,
    angle: np.ndarray,
    drop: tuple[str, ...] = (),
    **replaced: np.ndarray,
) -> Path:
    """A KPFITS file (frames, 1, kernels), HDUs as jwst-kpi writes them."""
    frames = len(value)
    points, cells = pupil.points, pupil.cells
    tables = {
        "APERTURE": {"XXC": cells[:, 0], "YYC": cells[:, 1], "TRM": np.ones(len(cells))},
        "UV-PLANE": {"UUC": points[:, 0], "VVC": points[:, 1], "RED": pupil.redundancy},
        "CWAVEL": {"CWAVEL": np.array([WAVELENGTH]), "BWIDTH": np.array([BAND])},
    }
    images = {
        "KER-MAT": pupil.kernel,
        "BLM-MAT": pupil.baseline_matrix,
        "KP-DATA": value[:, None],
        "KP-SIGM": np.sqrt(np.einsum("fkk->fk", covariance))[:, None],
        "KP-COV": covariance[:, None],
        "DETPA": np.asarray(angle, dtype=float),
    } | {name.replace("_", "-"): array for name, array in replaced.items()}
    hdus = [fits.PrimaryHDU(np.zeros((frames, 1, 4, 4)))]
    hdus[0].header.update(
        {"INSTRUME": "NIRISS", "FILTER": "F480M", "PSCALE": 65.0, "TARGPROP": "HD 1",
         "CONTENT": "KPFITS1", "DATE-OBS": "2023-01-02", "TIME-OBS": "03:04:05.6"}
    )  # fmt: skip
    for name, columns in tables.items():
        built = [fits.Column(c, "D", array=a) for c, a in columns.items()]
        hdus.append(fits.BinTableHDU.from_columns(built, name=name))
    hdus += [fits.ImageHDU(array, name=name) for name, array in images.items()]
    fits.HDUList([h for h in hdus if h.name not in drop]).writeto(path, overwrite=True)
    return path
