"""``amibayes demo``: the whole loop on simulated images, with the truth beside the result."""

from __future__ import annotations

import argparse
import json
import shlex
import time
from pathlib import Path
from typing import Any

from amibayes.cli.options import common

EXAMPLES = """examples:
  amibayes demo
  amibayes demo --out try --seed 7

DIR then holds scene.toml, to change and to simulate again, and the folder of each step.
"""

SCENE, RESULT = "scene.toml", "demo.json"
PHOTONS = "3e7"
TARGET, CALIBRATORS = "target_calints", ("calibrator_1_calints", "calibrator_2_calints")

COMPARED = {
    "separation_mas": ("separation", "mas", 2),
    "position_angle_deg": ("position angle", "deg", 2),
    "delta_mag": ("magnitude difference", "mag", 3),
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of ``demo``."""
    parser.epilog = EXAMPLES
    common.add_seed_option(parser)
    common.add_output_options(parser, "demo")


def run(arguments: argparse.Namespace) -> int:
    """Run each step as a user would, then compare with the truth."""
    common.configure_logging(arguments)
    from amibayes.simulation.program import example
    from amibayes.support.atomic_files import output_folder, write_json, write_text

    folder = output_folder(arguments.out, [SCENE, RESULT], overwrite=arguments.overwrite)
    write_text(folder / SCENE, example())
    steps = [_step(arguments, words) for words in _commands(folder, arguments.seed)]
    found = json.loads((folder / "search" / "result.json").read_text(encoding="utf-8"))
    content = {
        "amibayes": found["amibayes"],
        "seed": arguments.seed,
        "steps": steps,
        "compared": _compared(truth(folder / SCENE), found["fit"]),
        "detected": found["significance"]["detected"],
        "statement": found["verdict"]["statement"],
        "report": str(folder / "search" / "report.html"),
    }
    write_json(folder / RESULT, content)
    common.finish(arguments, content, lambda: _summary(content))
    return 0


def _commands(folder: Path, seed: int) -> list[list[str]]:
    images, tables = folder / "images", folder / "extracted"
    again = ["--seed", str(seed)]
    names = (TARGET, *CALIBRATORS)
    stars = [str(tables / f"{name}.oifits") for name in names]
    return [
        ["simulate", str(folder / SCENE), "--photons", PHOTONS, *again, "--out", str(images)],
        ["extract", *(str(images / f"{name}.fits") for name in names), "--out", str(tables)],
        ["search", stars[0], "--cal", *stars[1:], *again, "--out", str(folder / "search")],
    ]


def _step(arguments: argparse.Namespace, words: list[str]) -> dict[str, Any]:
    """Run one command, and print it."""
    from amibayes.cli.main import run_command

    prints = not (arguments.quiet or arguments.json)
    line = shlex.join(["amibayes", *words])
    if prints:
        print(f"$ {line}", flush=True)
    begin = time.perf_counter()
    run_command([*words, "--quiet", *(["--overwrite"] if arguments.overwrite else [])])
    return {"command": line, "seconds": round(time.perf_counter() - begin, 1)}


def truth(scene: Path) -> dict[str, float]:
    """Where the companion of a scene is, and how faint."""
    from amibayes.scene.file import load_scene
    from amibayes.scene.sources import Point
    from amibayes.units import MAS, contrast_to_delta_mag, position_angle_deg, separation

    companion = load_scene(scene).components[1]
    assert isinstance(companion, Point)
    east, north = companion.east_rad / MAS, companion.north_rad / MAS
    return {
        "separation_mas": float(separation(east, north)),
        "position_angle_deg": float(position_angle_deg(east, north)),
        "delta_mag": float(contrast_to_delta_mag(companion.flux)),
    }


def _compared(true: dict[str, float], fit: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Truth, result, error, and the difference in units of the error."""
    return {
        name: {
            "truth": true[name],
            "found": fit[name],
            "error": fit["errors"][name],
            "sigma": (fit[name] - true[name]) / fit["errors"][name],
        }
        for name in COMPARED
    }


def _summary(content: dict[str, Any]) -> list[str]:
    lines = [
        "",
        f"the search states: {content['statement']}",
        f"{'':22}{'truth':>10}{'found':>12}{'error':>10}{'off by':>10}",
    ]
    for name, (label, unit, places) in COMPARED.items():
        c = content["compared"][name]
        lines.append(
            f"{label:22}{c['truth']:10.{places}f}{c['found']:12.{places}f}"
            f"{c['error']:10.{places}f}{c['sigma']:+9.1f}σ  {unit}"
        )
    took = sum(step["seconds"] for step in content["steps"])
    return [*lines, "", f"done in {took:.0f} s; open {content['report']}"]
