"""Table 2 of Soulain et al. (2020): how faint a companion NIRISS sees, in three filters.

    python examples/paper_table2.py [--simulate 1e8] [--picture limits.png]
    python examples/paper_table2.py --simulate 1e9 --markdown | python docs/pages.py \\
        paper_table2.md "table: examples/paper_table2.py"

Prints the 3σ limits, as the range of the azimuthal median over 50 to 400 mas, beside the
paper's for 1e7 to 1e10 photons, under several readings of "3σ":

field      35 closure phases taken as independent, errors √1.5·N_holes/√N_photons, CANDID's
           nσ = 3 at a known position;
covariance the same Δχ², but with the covariance of closure phases that share baselines;
search     the same data, found anywhere in the field in half of the cases, while noise alone
           is taken for a companion in 0.27 % of searches: injection and recovery;
with V2    likewise, V² and closure phases of the fringe fit with their joint covariance from
           photon and read noise;
cubes      (--simulate) images of a target and a calibrator through the detector model, Fourier
           extraction, calibration, then as "field" with the measured errors.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy import stats

from amibayes import (
    Exposure,
    Instrument,
    Likelihood,
    Scene,
    calibrate,
    detection_limit,
    extract,
    load_instrument,
    make_plan,
    point_source,
    search,
    significance,
    simulate,
)
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.assumed_covariance import covariance_of_errors
from amibayes.data.observables import Observables
from amibayes.detection.statistic import statistic_of
from amibayes.likelihood.chi2 import candid_n_sigma
from amibayes.pipeline.planning import PAPER, contrast_curve, expected_observables
from amibayes.plots.style import MARKERS, SERIES, new_figure, save, styled
from amibayes.simulation import PRESETS
from amibayes.simulation.budget import Plan, star_channels
from amibayes.units import FloatArray

FILTERS = ("F380M", "F430M", "F480M")
PHOTONS = (1e7, 1e8, 1e9, 1e10)
FIELD_MAS = (50.0, 400.0)

PUBLISHED = {
    ("F380M", 1e7): (5.4, 6.3), ("F430M", 1e7): (4.5, 6.2), ("F480M", 1e7): (4.1, 5.9),
    ("F380M", 1e8): (6.8, 7.7), ("F430M", 1e8): (5.9, 7.7), ("F480M", 1e8): (5.4, 7.1),
    ("F380M", 1e9): (7.8, 8.9), ("F430M", 1e9): (6.9, 8.5), ("F480M", 1e9): (6.7, 8.6),
    ("F380M", 1e10): (8.9, 10.1), ("F430M", 1e10): (8.2, 9.9), ("F480M", 1e10): (8.1, 10.0),
}  # fmt: skip
"""Smallest and largest limit between 50 and 400 mas (Table 2 of the paper), mag."""

ALPHA = 0.0027
"""False-alarm probability of 3σ, two sides: the paper's 99.73 %."""


NULL_DRAWS = 20_000


@dataclass(frozen=True)
class Limit:
    """A contrast curve: separations (n,) in mas and magnitude differences (n,)."""

    separation_mas: FloatArray
    delta_mag: FloatArray

    @property
    def range(self) -> tuple[float, float]:
        """Smallest and largest of the curve."""
        return float(np.nanmin(self.delta_mag)), float(np.nanmax(self.delta_mag))

    def deeper(self, magnitudes: float) -> Limit:
        """The curve of data that see so much fainter companions."""
        return Limit(self.separation_mas, self.delta_mag + magnitudes)


def paper_plan(filter: str, photons: float) -> Plan:
    """The exposure of the paper's Table 1."""
    return make_plan(instrument(filter), magnitude=6.0, photons=photons, options=PAPER)


@cache
def instrument(filter: str) -> Instrument:
    """NIRISS in a filter."""
    return load_instrument("niriss", filter)


def sigma_closure_rad(photons: float) -> float:
    """Error of a closure phase, √1.5·N_holes/√N_photons."""
    return float(np.sqrt(1.5) * 7.0 / np.sqrt(photons))


def closures(filter: str, photons: float, covariance: str) -> Observables:
    """Closure phases of a single star, with the errors of the paper's formula."""
    niriss = instrument(filter)
    sheet = point_source(
        niriss.mask.holes_m,
        star_channels(niriss).mean_m,
        niriss.bandpass.effective_width_m,
        vis2_error=1.0,
        closure_error_rad=sigma_closure_rad(photons),
        covariance=covariance,
    )
    return sheet.only(("cp",))


def at_known_position(observables: Observables, delta_chi2: float = 9.0) -> Limit:
    """Contrast of a given Δχ², median around each ring; Δχ² grows as contrast squared."""
    curve = contrast_curve(observables, FIELD_MAS)
    shift = -1.25 * np.log10(delta_chi2 / 9.0)
    return Limit(curve.separation_mas, curve.delta_mag + shift)


def three_sigma_of_candid(n_data: int) -> float:
    """Δχ² at which CANDID's nσ reaches 3: one free parameter, the flux ratio."""
    dof = n_data - 1
    return float(stats.chi2.isf(2.0 * stats.norm.sf(3.0), dof) - dof)


def field(filter: str, photons: float) -> Limit:
    """As the field does it: 35 closure phases as if independent, CANDID's nσ = 3."""
    data = closures(filter, photons, "diagonal")
    return at_known_position(data, three_sigma_of_candid(data.n_closure_phases))


def covariance(filter: str, photons: float) -> Limit:
    """The same criterion for closure phases that share baselines."""
    data = closures(filter, photons, "assumed")
    return at_known_position(data, three_sigma_of_candid(data.n_closure_phases))


def searched(filter: str, photons: float) -> Limit:
    """Closure phases with their covariance, by the criterion of a search."""
    return recovered_once(filter, False).deeper(1.25 * np.log10(photons / 1e8))


def searched_with_vis2(filter: str, photons: float) -> Limit:
    """V² and closure phases of the fringe fit, by the criterion of a search.

    All depths have the same groups; their covariance goes with the integrations.
    """
    ratio = paper_plan(filter, photons).n_integrations / paper_plan(filter, 1e8).n_integrations
    return recovered_once(filter, True).deeper(1.25 * np.log10(ratio))


@cache
def recovered_once(filter: str, with_vis2: bool) -> Limit:
    """Half of the companions injected at 1e8 photons are found by a search."""
    data = closures(filter, 1e8, "assumed")
    if with_vis2:
        data = expected_observables(paper_plan(filter, 1e8), PRESETS["paper"])
    result = search(Likelihood(data), FIELD_MAS)
    rng = np.random.default_rng(1)
    test = statistic_of(result, stated_errors=True)
    found = significance(test, NULL_DRAWS, rng, ALPHA)
    limit = detection_limit(result, found, rng, n_separations=15)
    return Limit(limit.separation_mas, -2.5 * np.log10(limit.contrast_50))


def cubes(filter: str, photons: float, seed: int = 1) -> Limit:
    """Through images: target and calibrator, Fourier extraction, then as `field`."""
    plan, rng = paper_plan(filter, photons), np.random.default_rng(seed)
    exposure = Exposure(plan.n_groups, plan.n_integrations)
    target, calibrator = (
        extract(
            simulate(
                Scene(),
                plan.instrument,
                exposure,
                rng,
                detector=PRESETS["paper"],
                count_rate_e_s=plan.count_rate_e_s,
            ),
            "fft",
        )
        for _ in range(2)
    )
    data = calibrate(target, [calibrator], rng=rng).observables.only(("cp",))
    rows, errors = data.closure_phase, data.errors[1]
    independent = covariance_of_errors(np.empty(0), rows, errors, "diagonal")
    data = replace(data, covariance=independent, covariance_kind="diagonal")
    return at_known_position(data, three_sigma_of_candid(data.n_closure_phases))


def false_alarms(filter: str, n: int = 2000, seed: int = 1) -> tuple[float, float]:
    """Share of noise-only data sets with nσ > 3 somewhere: real noise, and independent noise.

    Both are searched as 35 independent closure phases, over 50 to 400 mas.
    """
    correlated = closures(filter, 1e8, "assumed")
    result = search(Likelihood(closures(filter, 1e8, "diagonal")), FIELD_MAS)
    bank = TemplateBank(result.likelihood, result.grid, result.single_theta)
    rng, shares = np.random.default_rng(seed), []
    sigma = sigma_closure_rad(1e8)
    for noise in (correlated.covariance.draw(rng, n) / sigma, rng.standard_normal((35, n))):
        gain, _ = bank.largest_gain(noise.astype(np.float32))
        chi2 = (noise**2).sum(axis=0)
        shares.append(float((candid_n_sigma(chi2, chi2 - gain, 34) > 3.0).mean()))
    return shares[0], shares[1]


READINGS = {
    "field": field,
    "covariance": covariance,
    "search": searched,
    "with V2": searched_with_vis2,
}


def limits(largest_simulated: float = 0.0) -> dict[tuple[str, float], dict[str, Limit]]:
    """All readings of all cells."""
    out = {}
    for photons in PHOTONS:
        for filter in FILTERS:
            cell = {name: reading(filter, photons) for name, reading in READINGS.items()}
            if photons <= largest_simulated:
                cell["cubes"] = cubes(filter, photons)
            out[filter, photons] = cell
    return out


def readings_of(table: dict[tuple[str, float], dict[str, Limit]]) -> list[str]:
    """Names of the readings, with that of simulated images where there are any."""
    return [*READINGS, *(["cubes"] if any("cubes" in cell for cell in table.values()) else [])]


def beyond_paper(table: dict[tuple[str, float], dict[str, Limit]], name: str) -> FloatArray:
    """Ends of a reading's ranges less the paper's, (n_cells, 2)."""
    gaps = [np.subtract(c[name].range, PUBLISHED[k]) for k, c in table.items() if name in c]
    return np.array(gaps)


def report(table: dict[tuple[str, float], dict[str, Limit]]) -> list[str]:
    """The table as lines, and how far each reading is from the paper."""
    names = readings_of(table)
    head = f"{'photons':8}{'filter':8}{'paper':^12}" + "".join(f"{name:^14}" for name in names)
    lines = [head + f"{'-2.5 log σ':>12}"]
    for (filter, photons), cell in table.items():
        low, high = PUBLISHED[filter, photons]
        line = f"{photons:<8.0e}{filter:8}{low:5.1f}-{high:4.1f}  "
        for name in names:
            found = "{:6.2f}-{:5.2f}  ".format(*cell[name].range) if name in cell else ""
            line += f"{found:14}"
        lines.append(line + f"{-2.5 * np.log10(sigma_closure_rad(photons)):11.2f}")
    for name in names:
        gap = beyond_paper(table, name)
        mean, rms = gap.mean(axis=0), np.sqrt((gap**2).mean())
        lines.append(
            f"{name:11}minus the paper: smallest {mean[0]:+.2f}, largest {mean[1]:+.2f} mag on "
            f"average; rms {rms:.2f} mag over {gap.size} numbers"
        )
    return lines


def markdown(table: dict[tuple[str, float], dict[str, Limit]]) -> list[str]:
    """The same as two tables of Markdown, with a line between them."""
    names = readings_of(table)
    columns = ["photons", "filter", "paper", *(name.replace("V2", "V²") for name in names)]
    lines = [f"| {' | '.join(columns)} |", "|---" * len(columns) + "|"]
    superscript = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")
    for (filter, photons), cell in table.items():
        power = str(round(np.log10(photons))).translate(superscript)
        published = "{:.1f}–{:.1f}".format(*PUBLISHED[filter, photons])
        ours = ["{:.2f}–{:.2f}".format(*cell[n].range) if n in cell else "" for n in names]
        lines.append(f"| {' | '.join([f'10{power}', filter, published, *ours])} |")
    lines += ["", "| reading | smallest limit | largest limit | rms |", "|---|---|---|---|"]
    for name in names:
        gap = beyond_paper(table, name)
        mean = [f"{x:+.2f}".replace("-", "−") for x in gap.mean(axis=0)]
        rms = float(np.sqrt((gap**2).mean()))
        lines.append(f"| {name.replace('V2', 'V²')} | {mean[0]} | {mean[1]} | {rms:.2f} |")
    return lines


@styled()
def draw(table: dict[tuple[str, float], dict[str, Limit]], path: str) -> None:
    """Contrast curves of two readings, and the paper's ranges as bars."""
    figure = new_figure(5.2, 9.6)
    panels = figure.subplots(1, 3, sharey=True)
    for ax, filter in zip(panels, FILTERS, strict=True):
        for k, photons in enumerate(PHOTONS):
            cell, colour = table[filter, photons], SERIES[k]
            ax.plot(*_xy(cell["field"]), color=colour, ls="--", lw=1.2)
            label = f"{photons:.0e} photons".replace("e+", "e")
            ax.plot(*_xy(cell["with V2"]), color=colour, marker=MARKERS[k], ms=4, label=label)
            low, high = PUBLISHED[filter, photons]
            ax.errorbar(
                420 + 14 * k,
                0.5 * (low + high),
                0.5 * (high - low),
                color=colour,
                marker=MARKERS[k],
                ms=5,
                capsize=4,
                lw=2,
            )
        ax.set_title(filter)
        ax.set_xlabel("Separation (mas)")
    panels[0].set_ylabel("Magnitude difference")
    panels[0].invert_yaxis()
    _explain(figure, panels[0])
    save(figure, path)


def _explain(figure: Figure, ax: Axes) -> None:
    """Make a legend of what colours and lines mean."""
    ax.plot([], [], color="black", ls="--", lw=1.2, label="field: known position, CANDID's 3σ")
    ax.plot([], [], color="black", label="V² + closure phase, found by a search")
    ax.errorbar([], [], [], color="black", capsize=4, lw=2, label="paper, range 50 to 400 mas")
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)


def _xy(limit: Limit) -> tuple[FloatArray, FloatArray]:
    return limit.separation_mas, limit.delta_mag


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--simulate", type=float, default=0.0, metavar="N",
                        help="simulate images too, up to so many photons")  # fmt: skip
    parser.add_argument("--picture", metavar="PNG", help="draw the curves")
    parser.add_argument("--markdown", action="store_true", help="print tables of Markdown")
    arguments = parser.parse_args()
    table = limits(arguments.simulate)
    if arguments.markdown:
        print("\n".join(markdown(table)))
        return
    print("\n".join(report(table)))
    for filter in FILTERS:
        real, independent = false_alarms(filter)
        print(f"{filter}: CANDID's nσ > 3 somewhere in the field for noise alone in {real:.1%} of "
              f"data sets ({independent:.1%} were closure phases independent)")  # fmt: skip
    if arguments.picture:
        draw(table, arguments.picture)


if __name__ == "__main__":
    main()
