"""Truth and reconstructions of simulated scenes, and the table of the page on imaging.

python docs/imaging.py [FOLDER]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.colors import PowerNorm

import amibayes as ab
from amibayes.plots.style import SEQUENTIAL, new_figure, save, styled

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))

from helpers import niriss  # noqa: E402
from pages import put_table  # noqa: E402
from scenes import SCENES, binned, observed  # noqa: E402

SEEDS = (5, 6, 7)


def blurred(image: ab.ReconstructedImage, light: np.ndarray) -> np.ndarray:
    """Light with the beam of an image."""
    return type(image)(**{**vars(image), "light": light}).convolved()


def rows() -> dict[str, list[tuple[ab.ReconstructedImage, np.ndarray]]]:
    """Images of every scene and regulariser, with the truth; several draws of noise."""
    found: dict[str, list[tuple[ab.ReconstructedImage, np.ndarray]]] = {}
    for name, make in SCENES.items():
        for regulariser in ("tv", "entropy"):
            for seed in SEEDS:
                data = observed(niriss(0.003, 0.1), make(), np.random.default_rng(seed))
                image = ab.reconstruct_image(data, regulariser=regulariser)
                truth = binned(make(), image.grid.n, image.grid.pixel_mas)
                found.setdefault(f"{name}, {regulariser}", []).append((image, truth))
    return found


def table(found: dict[str, list[tuple[ab.ReconstructedImage, np.ndarray]]]) -> None:
    """Write one line for each scene and regulariser: means over the draws."""
    lines = [
        "| scene, regulariser | correlation with the truth (beam of λ/2B) | flux, of the truth "
        "| χ² per datum | χ² per datum left out | weight |",
        "|---|---|---|---|---|---|",
    ]
    for name, pairs in found.items():
        each = [
            (
                np.corrcoef(image.convolved().ravel(), blurred(image, truth).ravel())[0, 1],
                image.flux / truth.sum(),
                image.chi2r,
                image.scores[image.weights == image.weight].mean(),
                np.log10(image.weight),
            )
            for image, truth in pairs
        ]
        r, flux, chi2r, left, weight = np.mean(each, axis=0)
        lines.append(
            f"| {name} | {r:.2f} | {flux:.2f} | {chi2r:.2f} | {left:.2f} | {10**weight:.3g} |"
        )
    put_table("howto/imaging.md", lines, "table: docs/imaging.py")


@styled()
def picture(found: dict[str, list[tuple[ab.ReconstructedImage, np.ndarray]]], path: Path) -> None:
    """Truth with the beam, and both reconstructions of the first draw with it."""
    figure = new_figure(7.2, 7.0)
    axes = figure.subplots(3, 3, sharex=True, sharey=True)
    for row, name in zip(axes, SCENES, strict=True):
        images = [found[f"{name}, {r}"][0] for r in ("tv", "entropy")]
        first, truth = images[0]
        seen = [blurred(first, truth), *(image.convolved() for image, _ in images)]
        reach = 0.5 * first.grid.n * first.grid.pixel_mas
        norm = PowerNorm(0.5, 0.0, max(float(s.max()) for s in seen))
        for ax, values in zip(row, seen, strict=True):
            ax.imshow(
                values[:, ::-1], origin="lower", extent=(reach, -reach, -reach, reach),
                cmap=SEQUENTIAL, norm=norm,
            )  # fmt: skip
            ax.plot(0.0, 0.0, "*", color="white", mec="black", ms=9)
        row[0].set_ylabel(f"{name}\nNorth (mas)")
    for ax, title in zip(axes[0], ("truth", "total variation", "maximum entropy"), strict=True):
        ax.set_title(title)
    for ax in axes[-1]:
        ax.set_xlabel("East (mas)")
    save(figure, path)


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "static"
    images = rows()
    table(images)
    picture(images, folder / "imaging.png")
