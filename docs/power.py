"""Power of the search: how often a companion is found, by three criteria.

    python docs/power.py [FOLDER]

Closure phases of NIRISS in F480M, independent errors of the baselines' phases, companions
between 50 and 400 mas. amibayes' criterion is a false-alarm probability of 1 %; CANDID's is
nσ > 3 or 5, with the 35 closure phases taken as independent, as is the habit, and the noise
correlated as it is. Their false-alarm rates are measured on null data sets. Writes power.png
and the table of statistics.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from pages import put_table

from amibayes import BinaryModel, Likelihood, Observables, TemplateBank, load_instrument
from amibayes.companion_search.grid import make_grid
from amibayes.data.point_source import point_source
from amibayes.detection.statistic import make_statistic
from amibayes.detection.tails import clopper_pearson
from amibayes.likelihood.chi2 import candid_n_sigma
from amibayes.plots.style import BLACK, BLUE, VERMILLION, new_figure, styled
from amibayes.units import FloatArray, offset

FIELD_MAS = (50.0, 400.0)
ERROR_DEG = 0.3
NULLS, TRIALS = 100_000, 4000
CONTRASTS = np.geomspace(1.5e-3, 3e-2, 14)
TICKS = (0.15, 0.2, 0.3, 0.5, 0.7, 1.0, 2.0, 3.0)
CRITERIA = ("false-alarm probability below 1 %", "CANDID nσ > 3", "CANDID nσ > 5")


def sheet(covariance: str) -> Observables:
    instrument = load_instrument("niriss", "F480M")
    band = instrument.bandpass
    return point_source(
        instrument.mask.holes_m,
        band.pivot_m,
        0.302e-6,
        vis2_error=1.0,
        closure_error_rad=np.radians(ERROR_DEG),
        covariance=covariance,
    ).only(("cp",))


def candid(bank: TemplateBank, data: FloatArray) -> FloatArray:
    """Largest nσ over the field of data (n_data, n) with independent errors."""
    white = bank.project(data)
    gain, _ = bank.largest_gain(white.astype(np.float32))
    chi2 = (white**2).sum(axis=0)
    return candid_n_sigma(chi2, chi2 - gain, bank.n_data - 3)


def statistics(true: Observables, noise: FloatArray, signal: FloatArray) -> list[FloatArray]:
    """Gain in χ² with kernel phases, and nσ with independent closure phases, (n,) each."""
    kernel, plain = banks(true)
    data = noise + signal
    gain, _ = kernel[0].largest_gain(kernel[1].whiten(data).astype(np.float32))
    return [gain, candid(plain[0], plain[1].whiten(data))]


def banks(true: Observables):
    grid = make_grid(*FIELD_MAS, 20.0)
    out = []
    for data in (true, sheet("diagonal")):
        out.append((TemplateBank(Likelihood(data), grid, np.empty(0)), data.covariance))
    return out


def measure() -> tuple[dict[str, FloatArray], dict[str, float]]:
    """Share of the companions found at each contrast, and the false-alarm rates."""
    rng = np.random.default_rng(1)
    true = sheet("assumed")
    grid = make_grid(*FIELD_MAS, 20.0)
    test = make_statistic(Likelihood(true), grid, np.empty(0), stated_errors=True)
    threshold = np.quantile(test.draw_null(NULLS, rng), 0.99)
    marks = (threshold, 3.0, 5.0)

    def hits(signal: FloatArray, n: int) -> list[float]:
        found = statistics(true, true.covariance.draw(rng, n), signal)
        return [float((found[min(k, 1)] > mark).mean()) for k, mark in enumerate(marks)]

    rates = dict(zip(CRITERIA, hits(np.zeros((35, 1)), NULLS), strict=True))
    model = Likelihood(true, BinaryModel())
    share = []
    for contrast in CONTRASTS:
        rho = np.sqrt(rng.uniform(FIELD_MAS[0] ** 2, FIELD_MAS[1] ** 2, TRIALS))
        east, north = offset(rho, rng.uniform(0.0, 360.0, TRIALS))
        theta = np.column_stack([east, north, np.full(TRIALS, contrast)])
        share.append(hits(model.predict(theta), TRIALS))
    return dict(zip(CRITERIA, np.array(share).T, strict=True)), rates


@styled()
def picture(share: dict[str, FloatArray], rates: dict[str, float]) -> Figure:
    figure = new_figure(4.6)
    ax = figure.subplots()
    styles = zip(share.items(), (BLUE, VERMILLION, BLACK), "os^", ("-", "--", ":"), strict=True)
    for (name, values), colour, marker, dash in styles:
        label = f"{name} (false alarms: {100 * rates[name]:.2g} %)"
        ax.semilogx(100 * CONTRASTS, values, dash, marker=marker, color=colour, label=label)
    ax.set_xticks(TICKS, [f"{tick:g}" for tick in TICKS])
    ax.set_xticks([], minor=True)
    ax.set_xlabel("Contrast, companion/primary flux (%)")
    ax.set_ylabel("Share of companions that are detected")
    ax.set_ylim(0.0, 1.02)
    figure.legend(loc="outside upper center")
    return figure


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "static"
    share, rates = measure()
    rows = [
        "| criterion | true false-alarm rate | contrast found half of the time "
        "| 95 % of the time |",
        "|---|---|---|---|",
    ]
    for name in CRITERIA:
        low, high = clopper_pearson(round(rates[name] * NULLS), NULLS)
        half = np.interp(0.5, share[name], CONTRASTS)
        most = np.interp(0.95, share[name], CONTRASTS)
        rows.append(
            f"| {name} | {100 * rates[name]:.2f} % ({100 * low:.2f}–{100 * high:.2f}) "
            f"| {half:.4f} | {most:.4f} |"
        )
    put_table("statistics.md", rows, "table: docs/power.py")
    picture(share, rates).savefig(folder / "power.png", dpi=130)


if __name__ == "__main__":
    main()
