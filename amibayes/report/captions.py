"""What each picture shows, in words: its caption, and its text for those who cannot see it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from amibayes.report.page import Figure, read_figure

CAPTIONS = {
    "map": (
        "Detection map",
        "Improvement of the fit by a companion at every position of the field, north up and east "
        "left, with the best position and the other local maxima marked.",
    ),
    "nsigma": (
        "CANDID's nσ",
        "CANDID's number of sigma of the best companion at every position; it is not a "
        "false-alarm rate.",
    ),
    "false_alarm": (
        "False-alarm probability",
        "Probability that noise alone gives as good a companion at each position, and anywhere "
        "in the field.",
    ),
    "fit": (
        "Data and model",
        "Squared visibilities and closure phases with their errors, the best binary model, and "
        "the residuals in units of the errors.",
    ),
    "files": (
        "Residuals of each file",
        "Reduced χ² of the V² and of the closure phases of each file under the joint fit, with "
        "the companion and without.",
    ),
    "coverage": (
        "Coverage",
        "Spatial frequencies that the data sample; they set which positions can be told apart.",
    ),
    "correlation": (
        "Correlations",
        "Correlation of every pair of data, as the fit uses them.",
    ),
    "null": (
        "Null distribution",
        "Best statistic of each simulated data set without a companion, the threshold of a "
        "detection, and the value of the data.",
    ),
    "corner": (
        "Posterior",
        "Marginal distributions of every parameter and of every pair, with the best fit marked.",
    ),
    "chains": (
        "Chains",
        "Every walker's path through every parameter, with the part that was thrown away.",
    ),
    "limits": (
        "Detection limits",
        "Magnitude difference at which an injected companion is recovered, against separation.",
    ),
    "completeness": (
        "Completeness",
        "Share of injected companions that the search recovers, for each separation and "
        "magnitude difference.",
    ),
    "calibrators": (
        "Calibrators",
        "Squared visibilities and closure phases of every calibrator beside each other, those "
        "that were dropped marked.",
    ),
}
"""Title and description of a picture by the name of its file."""


def captioned(folder: str | Path, names: Sequence[str]) -> list[Figure]:
    """Take the PNG files among ``names`` into figures; an unknown one is titled by its name.

    Parameters
    ----------
    folder : path
    names : sequence of str
        File names; those that are no PNG are left out.
    """
    figures = []
    for name in names:
        if name.endswith(".png"):
            stem = name.removesuffix(".png")
            title = stem.replace("_", " ").replace("-", " ").capitalize()
            title, alt = CAPTIONS.get(stem, (title, f"Picture {name}."))
            figures.append(read_figure(Path(folder) / name, title, alt))
    return figures
