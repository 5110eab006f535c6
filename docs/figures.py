"""The figures of the page on statistics, each from a small simulation of its own.

python docs/figures.py [FOLDER]
"""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

import numpy as np
from scipy import stats

import amibayes as ab
from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.search import search
from amibayes.data.closure import closure_matrix
from amibayes.plots.maps import detection_map
from amibayes.plots.style import (
    BLACK,
    BLUE,
    DIVERGING,
    GREEN,
    VERMILLION,
    new_figure,
    save,
    styled,
)
from amibayes.units import DEGREE, offset

N_DRAWS = 10_000
SIGMA_RAD = 0.1 * DEGREE


def niriss(covariance: str, filter_name: str = "F480M") -> ab.Observables:
    """A NIRISS snapshot of a point source whose closure phases have equal errors."""
    instrument = ab.load_instrument("niriss", filter_name)
    low, high = instrument.bandpass.half_power_m
    return ab.point_source(
        instrument.mask.holes_m,
        instrument.bandpass.pivot_m,
        high - low,
        vis2_error=0.005,
        closure_error_rad=np.sqrt(3.0) * SIGMA_RAD,
        covariance=covariance,
    )


@styled()
def closure_correlation(path: Path) -> None:
    """Correlations of the 35 closure phases, and their 15 non-zero eigenvalues."""
    matrix, _ = closure_matrix(niriss("assumed").closure_phase.stations)
    correlation = matrix @ matrix.T / 3.0
    values = np.linalg.eigvalsh(correlation)[::-1]
    figure = new_figure(7.6)
    left, right = figure.subplots(2, 1, gridspec_kw={"height_ratios": [2.2, 1.0]})
    drawn = left.imshow(correlation, cmap=DIVERGING, vmin=-1, vmax=1)
    figure.colorbar(drawn, ax=left, label="Correlation")
    left.set_xlabel("Triangle")
    left.set_ylabel("Triangle")
    right.plot(np.arange(1, 36), values, "o", color=BLUE)
    right.axhline(7 / 3, color=BLACK, ls=":", label="7/3")
    right.set_xlabel("Number of the eigenvalue")
    right.set_ylabel("Eigenvalue")
    right.legend()
    save(figure, path)


def naive_coverage(rng: np.random.Generator) -> float:
    """How often a 68 % interval holds a contrast fitted as if 35 phases were independent."""
    true, naive = (ab.Likelihood(niriss(c).only(("cp",))) for c in ("assumed", "diagonal"))
    noise = true.observables.covariance.draw(rng, N_DRAWS)
    derivative = true.predict([[90.0, 110.0, 1e-6]])[:, 0] / 1e-6
    weight = naive.observables.covariance.solve(derivative)
    contrast = weight @ noise / (weight @ derivative)
    return float((np.abs(contrast) < 1.0 / np.sqrt(weight @ derivative)).mean())


@styled()
def look_elsewhere(path: Path) -> None:
    """What noise alone reaches: at one position, anywhere, and with wrong correlations."""
    rng = np.random.default_rng(20)
    true, naive = (ab.Likelihood(niriss(c).only(("cp",))) for c in ("assumed", "diagonal"))
    grid = make_grid(50.0, 400.0, 15.0)
    noise = true.observables.covariance.draw(rng, N_DRAWS)
    series = {}
    for name, likelihood in (("correlated", true), ("taken as independent", naive)):
        bank = ab.TemplateBank(likelihood, grid, np.empty(0))
        white = likelihood.observables.covariance.whiten(noise)
        series[name] = np.sort(bank.largest_gain(white.astype(np.float32))[0])
    figure = new_figure(4.6)
    ax = figure.subplots()
    x = np.linspace(0.0, 45.0, 300)
    ax.plot(x, stats.norm.sf(np.sqrt(x)), "k:", label="one position chosen beforehand")
    above = 1.0 - np.arange(N_DRAWS) / N_DRAWS
    styles = ((BLUE, "-", "anywhere in 50–400 mas"), (VERMILLION, "--", "the same, 35 closure"
              " phases taken as independent"))  # fmt: skip
    for values, (colour, dash, label) in zip(series.values(), styles, strict=True):
        ax.step(values, above, color=colour, ls=dash, label=label)
    ax.axvline(9.0, color=GREEN, ls="-.", label="Δχ² = 9, “3σ”")
    ax.set_yscale("log")
    ax.set_ylim(3e-4, 1.2)
    ax.set_xlim(0.0, 45.0)
    ax.set_xlabel("Largest Δχ² of noise alone")
    ax.set_ylabel("Probability to exceed")
    figure.legend(loc="outside lower center")
    save(figure, path)


@styled()
def aliases(path: Path) -> None:
    """A wide field: the lattice of the mask repeats the companion."""
    data = niriss("assumed")
    east, north = offset(150.0, 40.0)
    model = ab.Likelihood(data).predict([[east, north, 0.005]])[:, 0]
    model += data.covariance.draw(np.random.default_rng(3), 1)[:, 0]
    seen = data.with_data(model)
    save(detection_map(search(ab.Likelihood(seen), (50.0, 1100.0))), path)


def paper_limits(path: Path) -> None:
    """Contrast curves beside Table 2 of the paper, as the example draws them."""
    example = Path(__file__).resolve().parent.parent / "examples" / "paper_table2.py"
    script = runpy.run_path(str(example))
    script["draw"](script["limits"](), str(path))


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    paper_limits(folder / "paper_limits.png")
    closure_correlation(folder / "closure_correlation.png")
    look_elsewhere(folder / "look_elsewhere.png")
    aliases(folder / "aliases.png")
    share = naive_coverage(np.random.default_rng(4))
    print(f"68 % intervals of 35 closure phases taken as independent hold {100 * share:.0f} %")
    assert abs(share - 0.487) < 5 * np.sqrt(0.25 / N_DRAWS)


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "statistics"))
