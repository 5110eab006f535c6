"""Fit every public data set that has a published answer, and compare: a benchmark.

    python docs/published_results.py DATA_FOLDER

writes the table of `published_results.md` anew. DATA_FOLDER holds ``oifits/axcir_pionier.oifits``
and the other third-party files, which are not part of this project. A test runs the same sets
and fails where a number is more than 3σ from the published one without a reason given here.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from pages import put_table

from amibayes import BinaryModel, Likelihood, Observables, calibrate, read_oifits, search
from amibayes.calibration import bin_channels
from amibayes.companion_search.optimise import fit_single, single_likelihood
from amibayes.companion_search.result import SearchResult
from amibayes.data.covariance import diagonal_covariance
from amibayes.data.measurements import Measurements
from amibayes.data.observables import join
from amibayes.extraction.reading import read_observations
from amibayes.pipeline.options import SearchOptions

PAGE, MARK = "published_results.md", "table: docs/published_results.py"

MAX_SIGMA = 3.0
"""Differences past this need a reason."""

Numbers = dict[str, tuple[float, float]]
"""Value and 1σ error by name; the error is 0 where none was published."""


@dataclass(frozen=True)
class DataSet:
    """A public data set, the model of its published analysis, and what that found.

    Parameters
    ----------
    name : str
        Of the object and instrument.
    source, model : str
        Who found the numbers, and with what model.
    published : dict
        Values and errors.
    fit : callable
        Takes the folder of data; the same quantities by amibayes.
    reasons : dict of str to str
        Why a quantity differs by more than 3σ.
    needs : tuple of str
        Fields of `BinaryModel` without which the model cannot be fitted.
    slow : bool
        Takes more than some seconds.
    """

    name: str
    source: str
    model: str
    published: Numbers
    fit: Callable[[Path], Numbers]
    reasons: dict[str, str]
    needs: tuple[str, ...] = ()
    slow: bool = False

    @property
    def possible(self) -> bool:
        """Whether this version of amibayes has the model."""
        return set(self.needs) <= {f.name for f in fields(BinaryModel)}


@dataclass(frozen=True)
class Comparison:
    """One quantity of one data set."""

    data: DataSet
    quantity: str
    ours: tuple[float, float]
    theirs: tuple[float, float]

    @property
    def sigma(self) -> float:
        """Difference in standard errors of both."""
        return float((self.ours[0] - self.theirs[0]) / np.hypot(self.ours[1], self.theirs[1]))

    @property
    def reason(self) -> str:
        """Why they differ, where that is known."""
        return self.data.reasons.get(self.quantity, "")

    @property
    def fails(self) -> bool:
        """Whether they differ by more than `MAX_SIGMA` without a reason."""
        return abs(self.sigma) > MAX_SIGMA and not self.reason

    def row(self) -> str:
        """A line of the table."""
        return (
            f"| {self.data.name} | {self.data.model} | {self.quantity} | {_text(self.ours)} "
            f"| {_text(self.theirs)} ({self.data.source}) | {self.sigma:+.1f} | {self.reason} |"
        )


def _text(number: tuple[float, float]) -> str:
    value, error = number
    if error <= 0.0:
        return f"{value:g}"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def compare(data: DataSet, folder: Path) -> list[Comparison]:
    """Fit one data set and set the numbers beside the published ones."""
    ours = data.fit(folder)
    return [Comparison(data, q, ours[q], theirs) for q, theirs in data.published.items()]


def model(**wanted: Any) -> BinaryModel:
    """A model that this version may not have; `DataSet.needs` says so before."""
    return BinaryModel(**wanted)


def companion(
    data: Observables, fitted: BinaryModel, field: tuple[float, float] | None = None
) -> Numbers:
    """Everything that a search finds; errors grow by √χ² where the stated ones are too small."""
    return fitted_companion(data, fitted, field)[1]


def fitted_companion(
    data: Observables, fitted: BinaryModel, field: tuple[float, float] | None = None
) -> tuple[SearchResult, Numbers]:
    """The search, and what it finds."""
    result = search(Likelihood(data, fitted), field)
    grow = max(np.sqrt(result.chi2_binary / result.ndof), 1.0)
    c = result.companion
    found = {
        "east (mas)": (c.east_mas, c.east_error_mas),
        "north (mas)": (c.north_mas, c.north_error_mas),
        "separation (mas)": (c.separation_mas, c.separation_error_mas),
        "position angle (°)": (c.position_angle_deg, c.position_angle_error_deg),
        "flux ratio (%)": (100 * c.contrast, 100 * c.contrast_error),
        "magnitude difference": (c.delta_mag, c.delta_mag_error),
    }
    sigma = np.sqrt(np.diag(result.theta_covariance))
    names = result.likelihood.parameters.names
    for name, label in (
        ("diameter_mas", "diameter (mas)"),
        ("companion_diameter_mas", "companion's diameter (mas)"),
    ):
        place = next((i for i, n in enumerate(names) if n.startswith(name)), None)
        if place is not None:
            found[label] = float(result.theta[place]), float(sigma[place])
    return result, {q: (v, float(grow * e)) for q, (v, e) in found.items()}


def star(data: Observables, fitted: BinaryModel) -> Numbers:
    """Diameter (and limb darkening) of a star without companion, errors grown likewise."""
    likelihood = Likelihood(data, fitted)
    best, _ = fit_single(likelihood)
    alone = single_likelihood(likelihood)
    step = np.maximum(1e-3 * np.abs(best), 1e-4)
    n = len(best)
    at = np.eye(n) * step

    def chi2(theta: np.ndarray) -> float:
        return float(alone.chi2(theta[None])[0])

    curvature = np.array(
        [
            [
                (chi2(best + a + b) - chi2(best + a - b) - chi2(best - a + b) + chi2(best - a - b))
                / (4 * a.sum() * b.sum())
                for b in at
            ]
            for a in at
        ]
    )
    grow = max(np.sqrt(chi2(best) / (data.n_independent - n)), 1.0)
    sigma = grow * np.sqrt(np.diag(np.linalg.inv(curvature / 2)))
    labels = {"diameter_mas": "diameter (mas)", "limb_darkening": "limb darkening α"}
    return {
        labels[name]: (float(v), float(s))
        for name, v, s in zip(alone.parameters.names, best, sigma, strict=True)
        if name in labels
    }


FREE = BinaryModel(diameter_mas="free")
UNSMEARED = BinaryModel(diameter_mas="free", smearing=False)
FIELD = (0.7, 50.0)


def habit(folder: Path, name: str) -> Observables:
    """A file with independent errors, as most programs take them."""
    return read_oifits(folder / "oifits" / name, closure_covariance="diagonal")


def widened(data: Observables, factor: float) -> Observables:
    """The same data with channels wider by a factor."""

    def wide(m: Measurements) -> Measurements:
        return replace(m, band_m=m.band_m * factor)

    return replace(data, vis2=wide(data.vis2), closure_phase=wide(data.closure_phase))


def floored(data: Observables, vis2: float, closure_deg: float) -> Observables:
    """Errors of at least a part of V² and an angle, independent."""
    data = data.unflagged()
    sigma = np.sqrt(data.covariance.variance)
    floor = np.concatenate(
        [
            vis2 * np.abs(data.vis2.value),
            np.full(data.n_closure_phases, np.radians(closure_deg)),
        ]
    )
    return replace(data, covariance=diagonal_covariance(np.maximum(sigma, floor) ** 2))


def alpha_cen(folder: Path) -> Observables:
    return join([habit(folder, f"alphacen_pionier_{i}.fits") for i in (1, 2, 3)])


def iota_peg(folder: Path) -> Observables:
    return floored(habit(folder, "iotapeg_mirc4t.oifits"), 0.05, 1.0)


def o_leo(folder: Path, night: str) -> Observables:
    path = folder / "oifits" / f"oleo_gravity_{night}.fits"
    data = read_oifits(path, insname="GRAVITY_SC", closure_covariance="diagonal")
    return bin_channels(data, 10)


def cubes(folder: Path) -> Numbers:
    paths = [folder / "cubes" / f"niriss_f480m_{n}.fits" for n in ("target", "calibrator")]
    images = SearchOptions().images
    target, calibrator = (join(read_observations(p, images)) for p in paths)
    return companion(calibrate(target, [calibrator]).observables, BinaryModel(), (50.0, 400.0))


def jwst_product(folder: Path) -> Numbers:
    images = SearchOptions().images
    data = join(read_observations(folder / "jwst" / "sima_aminorm-oi.fits", images))
    return companion(data.only(("cp",)), BinaryModel(), (50.0, 400.0))


BINARY_DISCS = {"diameter_mas": "free", "companion_diameter_mas": "free"}
LIMB = {"diameter_mas": "free", "limb_darkening": "free"}

DATA_SETS: tuple[DataSet, ...] = (
    DataSet(
        "AX Cir, PIONIER",
        "CANDID run today",
        "disc; independent errors; channels √2 wider (CANDID's three points)",
        {
            "east (mas)": (6.234, 0.058),
            "north (mas)": (-28.511, 0.081),
            "flux ratio (%)": (0.912, 0.041),
            "diameter (mas)": (0.8195, 0.008),
        },
        lambda d: companion(widened(habit(d, "axcir_pionier.oifits"), 2**0.5), FREE, FIELD),
        {},
    ),
    DataSet(
        "AX Cir, PIONIER",
        "CANDID's README",
        "disc; correlated closure phases; channels as the file says",
        {
            "east (mas)": (6.247, 0.058),
            "north (mas)": (-28.506, 0.102),
            "flux ratio (%)": (1.041, 0.047),
        },
        lambda d: companion(read_oifits(d / "oifits" / "axcir_pionier.oifits"), FREE, FIELD),
        {},
    ),
    DataSet(
        "AX Cir, PIONIER",
        "PMOIRED",
        "disc; independent errors; no smearing",
        {"flux ratio (%)": (0.883, 0.040), "diameter (mas)": (0.8235, 0.0)},
        lambda d: companion(habit(d, "axcir_pionier.oifits"), UNSMEARED, FIELD),
        {},
    ),
    DataSet(
        "AX Cir, PIONIER, file with covariances",
        "fouriever",
        "disc; covariance of the file for V², closure phases correlated through baselines",
        {"flux ratio (%)": (0.934, 0.040), "diameter (mas)": (0.816, 0.0)},
        lambda d: companion(read_oifits(d / "oifits" / "axcir_pionier_cov.oifits"), FREE, FIELD),
        {},
    ),
    DataSet(
        "NIRISS F430M, simulated",
        "AMICAL's CANDID",
        "closure phases alone, independent errors, no smearing",
        {
            "separation (mas)": (147.13, 0.0),
            "position angle (°)": (46.77, 0.0),
            "magnitude difference": (5.98, 0.0),
        },
        lambda d: companion(
            habit(d, "niriss_f430m_amical.oifits").only(("cp",)),
            BinaryModel(smearing=False),
            (50.0, 400.0),
        ),
        {},
    ),
    DataSet(
        "NIRISS F430M, simulated",
        "truth",
        "V² and closure phases, correlated",
        {
            "separation (mas)": (147.7, 0.0),
            "position angle (°)": (46.6, 0.0),
            "magnitude difference": (6.0, 0.0),
        },
        lambda d: companion(
            read_oifits(d / "oifits" / "niriss_f430m_amical.oifits"), BinaryModel(), (50.0, 400.0)
        ),
        {},
    ),
    DataSet(
        "ι Peg, MIRC, 4 telescopes",
        "PMOIRED",
        "point companion; errors of at least 5 % of V² and 1°",
        {
            "east (mas)": (-0.784, 0.05),
            "north (mas)": (10.285, 0.05),
            "flux ratio (%)": (17.7, 0.3),
        },
        lambda d: companion(iota_peg(d), FREE, (1.0, 30.0)),
        {},
    ),
    DataSet(
        "ι Peg, MIRC, 4 telescopes",
        "PMOIRED",
        "disc companion; errors of at least 5 % of V² and 1°",
        {
            "east (mas)": (-0.784, 0.05),
            "north (mas)": (10.285, 0.05),
            "flux ratio (%)": (22.7, 0.4),
            "diameter (mas)": (1.037, 0.0),
            "companion's diameter (mas)": (0.644, 0.0),
        },
        lambda d: companion(iota_peg(d), model(**BINARY_DISCS), (1.0, 30.0)),
        {},
        needs=("companion_diameter_mas",),
        slow=True,
    ),
    *(
        DataSet(
            f"o Leo, GRAVITY, {night}",
            "PMOIRED's orbit",
            f"{kind} companion; science combiner, channels in tens",
            {"east (mas)": (east, 0.03), "north (mas)": (north, 0.03), "flux ratio (%)": ratio},
            lambda d, night=night, wanted=wanted: companion(
                o_leo(d, night), model(**wanted), (1.0, 20.0)
            ),
            {},
            needs=needs,
            slow=True,
        )
        for night, east, north in (("20220302", 1.222, 4.260), ("20220325", -2.096, -3.246))
        for kind, wanted, needs, ratio in (
            ("point", {"diameter_mas": "free"}, (), (24.6, 0.4)),
            ("disc", BINARY_DISCS, ("companion_diameter_mas",), (25.4, 0.4)),
        )
    ),
    DataSet(
        "α Cen A, PIONIER",
        "PMOIRED",
        "uniform disc, no companion",
        {"diameter (mas)": (8.299, 0.007)},
        lambda d: star(alpha_cen(d), FREE),
        {},
    ),
    DataSet(
        "α Cen A, PIONIER",
        "PMOIRED",
        "power-law limb darkening",
        {"diameter (mas)": (8.492, 0.007), "limb darkening α": (0.137, 0.008)},
        lambda d: star(alpha_cen(d), model(**LIMB)),
        {},
        needs=("limb_darkening",),
    ),
    DataSet(
        "Canopus, MATISSE",
        "published discs",
        "uniform disc, no companion",
        {"diameter (mas)": (6.85, 0.05)},
        lambda d: star(habit(d, "canopus_matisse.fits"), FREE),
        {},
    ),
    DataSet(
        "Arcturus, IOTA",
        "published discs",
        "uniform disc in H, no companion",
        {"diameter (mas)": (20.1, 0.1)},
        lambda d: star(habit(d, "arcturus_iota.fits"), FREE),
        {},
    ),
    DataSet(
        "SPHERE SAM, simulated, stations absent",
        "truth",
        "V² and closure phases, correlated",
        {
            "separation (mas)": (63.0, 0.0),
            "position angle (°)": (212.0, 0.0),
            "flux ratio (%)": (2.2, 0.0),
        },
        lambda d: companion(read_oifits(d / "oifits" / "uvonly_sam.oifits"), BinaryModel()),
        {},
    ),
    DataSet(
        "NIRISS F480M, jwst aminorm-oi",
        "a fit of its closure phases",
        "closure phases alone",
        {
            "separation (mas)": (198.8, 0.0),
            "position angle (°)": (305.6, 0.0),
            "flux ratio (%)": (0.97, 0.0),
        },
        jwst_product,
        {"flux ratio (%)": "the fit's response to light off the axis is corrected; truth 1.00"},
    ),
    DataSet(
        "NIRISS F480M images, simulated by ami_sim",
        "truth",
        "images extracted, calibrated and searched",
        {
            "separation (mas)": (198.3, 0.5),
            "position angle (°)": (306.2, 0.15),
            "flux ratio (%)": (1.0, 0.0),
        },
        cubes,
        {},
        slow=True,
    ),
)


def table(folder: Path) -> Iterator[str]:
    """The lines of the page's table, and in each the difference in σ."""
    yield "| data | model | quantity | amibayes | published | difference (σ) | reason |"
    yield "|---|---|---|---|---|---|---|"
    for data in DATA_SETS:
        if data.possible:
            for found in compare(data, folder):
                print(found.row(), file=sys.stderr)
                yield found.row()


def main(folder: Path) -> int:
    """Write the table into the page; 1 where a number differs without a reason."""
    lines = list(table(folder))
    put_table(PAGE, lines, MARK)
    return int(
        any(
            abs(float(x.split("|")[6])) > MAX_SIGMA and not x.split("|")[7].strip()
            for x in lines[2:]
        )
    )


if __name__ == "__main__":
    raise SystemExit(main(Path(sys.argv[1])))
