"""``amibayes plan``: groups, integrations and time, and what they let one see."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from amibayes.cli.options.common import (
    add_output_options,
    configure_logging,
    finish,
    number_range,
    positive_float,
)
from amibayes.errors import UsageError
from amibayes.support.options import PEAK_LIMIT_E, PLAN_SEPARATION_MAS, RampPreset, choices

if TYPE_CHECKING:
    from amibayes.pipeline.migration_plan import MigrationExpectation
    from amibayes.pipeline.planning import (
        ContrastCurve,
        Expectation,
        Floor,
        FloorExpectation,
        Plan,
    )

EPILOG = """examples:
  amibayes plan --filter F430M --photons 1e8 --mag 6
  amibayes plan --filter F380M --mag 7.5 --time 3600
  amibayes plan --filter F480M --photons 1e10 --mag 6 --preset paper
  amibayes plan --filter F430M --photons 1e9 --mag 6 --floor drift_nm=20,calibrators=5
"""


SEARCH = "calibrated search, 95 %"
"""Of the line with the limit of a search."""

FLOOR_NAMES = (
    "flat",
    "dither_mas",
    "brightness",
    "piston_nm",
    "drift_nm",
    "tilt_drift_mas",
    "converter",
    "vis2",
    "closure_deg",
    "calibrators",
)
"""Of `amibayes.pipeline.plan_floor.Floor`, which is not imported to show the options."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.epilog = EPILOG
    parser.add_argument(
        "--instrument", default="niriss", metavar="NAME", help="name or TOML file (default: niriss)"
    )
    parser.add_argument("--filter", required=True, metavar="NAME", help="such as F430M")
    star = parser.add_mutually_exclusive_group(required=True)
    star.add_argument("--mag", type=float, metavar="M", help="Vega magnitude in the filter")
    star.add_argument(
        "--count-rate", type=positive_float, metavar="R", help="electrons per second instead"
    )
    depth = parser.add_mutually_exclusive_group(required=True)
    depth.add_argument("--photons", type=positive_float, metavar="N", help="photons to collect")
    depth.add_argument("--time", type=positive_float, metavar="SECONDS", help="time on the clock")
    parser.add_argument(
        "--preset",
        choices=choices(RampPreset),
        default=choices(RampPreset)[0],
        help="default: the real brightest pixel; paper: the rules of Soulain et al. (2020)",
    )
    parser.add_argument(
        "--peak-limit",
        type=positive_float,
        default=PEAK_LIMIT_E,
        metavar="E",
        help="electrons that the brightest pixel may reach (default: %(default)g)",
    )
    parser.add_argument(
        "--separation",
        type=number_range,
        default=PLAN_SEPARATION_MAS,
        metavar="MIN:MAX",
        help="range of the contrast curve in mas (default: 50:400)",
    )
    parser.add_argument(
        "--floor",
        type=floor,
        default="default",
        metavar="NAME=VALUE,...",
        help="errors that photons do not average out, for the limit of a calibrated search: flat, "
        "dither_mas, brightness (of calibrators), piston_nm, drift_nm, tilt_drift_mas, "
        "converter (left in, in units of JWST's), vis2, closure_deg, calibrators; or none "
        "(default: flat=0.001,dither_mas=15,brightness=0.5,piston_nm=30,drift_nm=5,converter=1,"
        "calibrators=3)",
    )
    add_output_options(parser, "plan")


def floor(text: str) -> str | dict[str, float]:
    """Parse ``default``, ``none`` or ``NAME=VALUE,…``."""
    if text in ("default", "none"):
        return text
    found = {}
    for part in text.split(","):
        name, equals, value = part.partition("=")
        if not equals or name not in FLOOR_NAMES:
            raise argparse.ArgumentTypeError(
                f"'{part}' is not NAME=VALUE of {', '.join(FLOOR_NAMES)}"
            )
        try:
            found[name] = float(value)
        except ValueError:
            raise argparse.ArgumentTypeError(f"'{value}' of {name} is not a number") from None
    return found


def run(arguments: argparse.Namespace) -> int:
    """Plan, write ``plan.json``, print a summary."""
    configure_logging(arguments)
    from amibayes.instrument import load_instrument
    from amibayes.pipeline.planning import PlanOptions, expect, make_plan
    from amibayes.support.atomic_files import output_folder, write_json
    from amibayes.units import MAS

    drawn = load_instrument(arguments.instrument, arguments.filter)
    instrument = drawn if arguments.preset == "paper" else drawn.as_built()
    plan = make_plan(
        instrument,
        magnitude=arguments.mag,
        count_rate_e_s=arguments.count_rate,
        photons=arguments.photons,
        time_s=arguments.time,
        options=PlanOptions(arguments.preset, arguments.peak_limit),
    )
    if arguments.separation[1] * MAS > 3.0 * instrument.field_rad:
        raise UsageError(
            f"reaches {arguments.separation[1]:g} mas; the baselines distinguish positions over "
            f"{instrument.field_rad / MAS:.0f} mas",
            source="--separation",
            remedy="narrow the range",
        )
    expected = expect(plan, arguments.separation, floor=_floor(arguments.floor))
    content = as_json(plan, expected, arguments.mag)
    folder = output_folder(arguments.out, ["plan.json"], overwrite=arguments.overwrite)
    write_json(folder / "plan.json", content)
    finish(arguments, content, lambda: summary(plan, expected))
    return 0


def _floor(given: str | dict[str, float]) -> Floor | None:
    """The floor that was asked for."""
    from amibayes.pipeline.planning import Floor

    if given == "none":
        return None
    whole = {} if isinstance(given, str) else dict(given)
    count = whole.pop("calibrators", Floor.calibrators)
    if count != int(count):
        raise UsageError(f"{count:g} calibrators", source="--floor", remedy="a whole number")
    return Floor(**whole, calibrators=int(count))


def as_json(plan: Plan, expected: Expectation, magnitude: float | None) -> dict[str, Any]:
    """Everything that was found, in plain numbers."""
    import numpy as np

    from amibayes import __version__

    return {
        "amibayes": __version__,
        "instrument": plan.instrument.name,
        "filter": plan.instrument.bandpass.name,
        "preset": plan.options.preset,
        "magnitude": magnitude,
        "count_rate_e_s": plan.count_rate_e_s,
        "photons_wanted": plan.photons_wanted,
        "n_groups": plan.n_groups,
        "n_integrations": plan.n_integrations,
        "total_photons": plan.total_photons,
        "frame_time_s": plan.options.frame_time_s,
        "exposure_time_s": plan.exposure_time_s,
        "groups": plan.groups,
        "peak_fraction": {
            "point_sampled": plan.peaks.point_sampled,
            "centred": plan.peaks.centred,
            "cornered": plan.peaks.cornered,
        },
        "peak_e": plan.peak_e,
        "sigma_closure_phase_deg": float(np.degrees(expected.closure_phase_rad)),
        "sigma_closure_phase_photons_deg": float(np.degrees(expected.closure_phase_photons_rad)),
        "sigma_vis2": expected.vis2,
        "charge_migration": None if expected.migration is None else _migration(expected.migration),
        "floor": None if expected.floor is None else _floor_json(expected.floor),
        "contrast_curve": _curve(expected.curve),
        "closure_phase_curve": _curve(expected.closure_curve),
        "warnings": list(plan.warnings),
    }


def _migration(found: MigrationExpectation) -> dict[str, float | int | None]:
    return {
        "vis2_bias": found.left_in,
        "vis2_bias_slopes": found.slopes,
        "vis2_bias_ramps": found.ramps,
        "error_per_e": found.error_per_e,
        "best_groups": found.best_groups,
    }


def _floor_json(found: FloorExpectation) -> dict[str, Any]:
    import numpy as np

    return {
        "vis2": found.vis2,
        "closure_phase_deg": {
            name: float(np.degrees(value)) for name, value in found.closure_phase_rad.items()
        },
        "calibrated_sigma_vis2": found.calibrated_vis2,
        "calibrated_sigma_closure_phase_deg": float(np.degrees(found.calibrated_closure_phase_rad)),
        "separation_mas": found.separation_mas.tolist(),
        "delta_mag": [float(m) if np.isfinite(m) else None for m in found.delta_mag],
        "false_positive_rate": found.alpha,
        "completeness": found.completeness,
    }


def _floor_lines(found: FloorExpectation | None) -> list[str]:
    """Errors that photons do not average out, the largest first, and the errors after all."""
    import numpy as np

    if found is None:
        return []
    parts = [
        f"{name} {found.vis2[name]:.1g}, {np.degrees(found.closure_phase_rad[name]):.1g} deg"
        for name in sorted(found.vis2, key=found.vis2.__getitem__, reverse=True)
        if found.vis2[name] or found.closure_phase_rad[name]
    ]
    closure = np.degrees(found.calibrated_closure_phase_rad)
    return [
        f"floor           {'; '.join(parts) or 'none'}",
        f"calibrated      V² {found.calibrated_vis2:.2g}, closure phase {closure:.2g} deg",
    ]


def _migration_line(found: MigrationExpectation | None) -> list[str]:
    """Bias that calibrators of half the brightness do not share."""
    if found is None:
        return []
    ramps = "too few groups to fit" if found.ramps is None else f"{found.ramps:.2g} from ramps"
    return [
        f"migration       bias of V² {found.left_in:.2g} left in, {found.slopes:.2g} from slopes, "
        f"{ramps} (calibrators of half the brightness); slopes cost least with "
        f"{found.best_groups} groups"
    ]


def _curve(curve: ContrastCurve) -> dict[str, list[float]]:
    return {
        "separation_mas": curve.separation_mas.tolist(),
        "delta_mag_3sigma": curve.delta_mag.tolist(),
        "delta_mag_3sigma_worst": curve.delta_mag_worst.tolist(),
        "delta_mag_3sigma_best": curve.delta_mag_best.tolist(),
    }


def summary(plan: Plan, expected: Expectation) -> list[str]:
    """Sum the plan up in a few lines."""
    import numpy as np

    groups, curve, closures = plan.groups, expected.curve, expected.closure_curve
    at = np.unique(np.linspace(0, len(curve.separation_mas) - 1, 5).astype(int))

    found = expected.floor
    reached = None
    if found is not None:
        reached = np.interp(curve.separation_mas, found.separation_mas, found.delta_mag)

    def row(name: str, values: Any) -> str:
        return f"{name:<28}" + " ".join(f"{values[k]:6.1f}" for k in at)

    degrees = np.degrees([expected.closure_phase_rad, expected.closure_phase_photons_rad])
    return [
        f"{plan.instrument.name} {plan.instrument.bandpass.name}, "
        f"{plan.count_rate_e_s:.0f} e-/s, preset {plan.options.preset}",
        f"groups          {plan.n_groups}  (point-sampled peak of the paper {groups['paper']}, "
        f"brightest pixel {groups['centred']}, at a corner {groups['cornered']})",
        f"integrations    {plan.n_integrations}",
        f"photons         {plan.total_photons:.3g}",
        f"time            {plan.exposure_time_s:.1f} s on the clock, "
        f"frames of {plan.options.frame_time_s:g} s",
        f"brightest pixel {plan.peak_e:.0f} e- at the end of a ramp",
        f"closure phase   {degrees[0]:.4f} deg (photons alone, √1.5·N_holes/√N: "
        f"{degrees[1]:.4f} deg)",
        f"V²              {expected.vis2:.2g}",
        *_migration_line(expected.migration),
        *_floor_lines(expected.floor),
        row("separation (mas)", curve.separation_mas),
        row("3σ, V² + closure phase (mag)", curve.delta_mag),
        row("3σ, closure phase (mag)", closures.delta_mag),
        *([] if reached is None else [row(SEARCH, reached)]),
        *(f"warning: {warning}" for warning in plan.warnings),
    ]
