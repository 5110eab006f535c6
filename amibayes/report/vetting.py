"""The results of vetting: `vetting.json`, the table on the terminal, and its picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from amibayes.pipeline.vetting import Vetted, Vetting, notes
from amibayes.plots.calibration import columns_of
from amibayes.plots.style import GREY, marker_of, new_figure, styled
from amibayes.report import limits_json, number
from amibayes.support.atomic_files import short_names
from amibayes.support.terminal import shortened, tail

Json = dict[str, Any]


def vetting_json(vetting: Vetting) -> Json:
    """Build the content of ``vetting.json``, calibrators in the order given."""
    return {
        "calibrators": [_entry(v, vetting) for v in vetting.calibrators],
        "alpha": vetting.alpha,
        "false_drop_rate": vetting.false_drop_rate,
    }


def _entry(vetted: Vetted, vetting: Vetting) -> Json:
    return {
        "path": vetted.path,
        "kept": vetted.kept,
        "reason": vetted.reason,
        "notes": notes(vetted, vetting),
        "agreement_probability": vetted.agreement,
        "companion": _companion(vetted),
        "diameter_mas": vetted.diameter_mas,
        "diameter_probability": vetted.diameter_probability,
        "charge_ratio": vetted.charge_ratio,
        "limits": None if vetted.limit is None else limits_json(vetted.limit),
    }


def _companion(vetted: Vetted) -> Json | None:
    found, tested = vetted.companion, vetted.significance
    if found is None or tested is None:
        return None
    c = found.companion
    return {
        "separation_mas": c.separation_mas,
        "position_angle_deg": c.position_angle_deg,
        "contrast": c.contrast,
        "delta_mag": number(c.delta_mag),
        "delta_chi2": found.delta_chi2,
        "false_alarm_probability": tested.probability,
        "false_alarm_interval": list(tested.interval),
    }


def vetting_table(vetting: Vetting, last: Sequence[str] = ()) -> list[str]:
    """Write keep or drop, and why, one line each; ``last`` follows."""
    lines = [f"{'calibrator':<28} {'verdict':<7} {'agreement':>10} {'companion':>10} {'disc':>10}"]
    for name, v in _named(vetting):
        tested = None if v.significance is None else v.significance.probability
        numbers = " ".join(_cell(p) for p in (v.agreement, tested, v.diameter_probability))
        lines.append(f"{name:<28} {'keep' if v.kept else 'DROP':<7} {numbers}")
        lines += [f"    {text}" for text in [v.reason, *notes(v, vetting)] if text]
    rule = (
        f"probabilities of chance; below {vetting.alpha:g} a calibrator is dropped "
        f"(good ones: {vetting.false_drop_rate:.1%} of the time)"
    )
    return shortened(lines, [rule, *last])


def _named(vetting: Vetting) -> list[tuple[str, Vetted]]:
    """Each calibrator with a short name that no other one has."""
    names = short_names([v.path for v in vetting.calibrators])
    return list(zip(names, vetting.calibrators, strict=True))


def _cell(probability: float | None) -> str:
    return f"{'-':>10}" if probability is None else f"{tail(probability):>10}"


HEIGHT_OF_NAMES = 0.2
"""Inches that a line of a legend takes."""


@styled()
def vetting_picture(vetting: Vetting) -> Figure:
    """Draw the probabilities of the three tests and what each calibrator rules out."""
    limited = [(name, v) for name, v in _named(vetting) if v.limit is not None]
    n = len(vetting.calibrators)
    heights = [1.2 + 0.4 * n, 4.0] if limited else [1.2 + 0.4 * n]
    figure = new_figure(sum(heights) + HEIGHT_OF_NAMES * (1 + len(limited)))
    axes = np.atleast_1d(figure.subplots(len(heights), 1, height_ratios=heights))
    _draw_tests(axes[0], vetting)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    if limited:
        _draw_limits(axes[1], limited)
        drawn, texts = axes[1].get_legend_handles_labels()
        figure.legend(drawn, texts, loc="outside lower center", ncols=columns_of(texts))
    return figure


def _draw_tests(ax: Any, vetting: Vetting) -> None:
    tests = {
        "agreement with the others": [v.agreement for v in vetting.calibrators],
        "no companion": [
            None if v.significance is None else v.significance.probability
            for v in vetting.calibrators
        ],
        "no disc": [v.diameter_probability for v in vetting.calibrators],
    }
    rows = np.arange(len(vetting.calibrators))
    for k, (label, values) in enumerate(tests.items()):
        colour, marker = marker_of(k)
        shown = [np.nan if p is None else max(p, MIN_SHOWN) for p in values]
        ax.plot(shown, rows + 0.15 * (k - 1), marker, color=colour, label=label, ls="none")
    ax.axvline(vetting.alpha, color=GREY, ls="--")
    ax.set_xscale("log")
    ax.set(xlim=(0.5 * MIN_SHOWN, 2.0), ylim=(len(rows) - 0.5, -0.5))
    ax.set_yticks(
        rows,
        [name if v.kept else f"{name} (dropped)" for name, v in _named(vetting)],
    )
    ax.set_xlabel(f"probability of chance (dashed: dropped below {vetting.alpha:g})")


MIN_SHOWN = 1e-8
"""Smaller probabilities are drawn here."""


def _draw_limits(ax: Any, limited: list[tuple[str, Vetted]]) -> None:
    for k, (name, vetted) in enumerate(limited):
        assert vetted.limit is not None
        colour, marker = marker_of(k)
        ax.plot(
            vetted.limit.separation_mas,
            vetted.limit.delta_mag,
            marker=marker,
            ls="-" if vetted.kept else ":",
            color=colour,
            label=name if vetted.kept else f"{name} (dropped)",
        )
    ax.invert_yaxis()
    limit = limited[0][1].limit
    assert limit is not None
    ax.set_xlabel("Separation (mas)")
    ax.set_ylabel(f"Magnitude difference ruled out ({limit.completeness:.0%})")
