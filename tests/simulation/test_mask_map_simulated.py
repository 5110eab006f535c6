"""Images behind the mask as built: their truth is told, and extraction finds it again."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import amibayes
from amibayes.calibration import calibrate
from amibayes.cli import main
from amibayes.extraction.extract import extract_all
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.visits import visit_maps
from amibayes.instrument import load_instrument
from amibayes.simulation.program import read_program

COMMISSIONED = np.array([[1.001417, 0.007333], [-0.006240, 1.007186]])

SCENE = """
name = "binary"
[star]
[[companion]]
separation_mas = 220.0
position_angle_deg = 75.0
contrast = 0.1
[instrument]
filter = "F480M"
mask_map = "as built"
[exposure]
count_rate = 1e11
n_groups = 2
n_integrations = 4
n_pixels = 64
jitter_mas = 1.0
roll_deg = [33.0]
[detector]
full_well_e = 1e12
flat_error = 0.0
[[calibrator]]
name = "star"
count_rate = 1e11
[calibrator.star]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "scene.toml").write_text(SCENE)
    words = ["simulate", str(folder / "scene.toml"), "--out", str(folder), "--quiet"]
    assert main([*words, "--seed", "2"]) == 0
    return folder


def test_separations_behind_the_mask_as_built_are_those_of_the_sky(folder: Path) -> None:
    paths = [folder / f"{name}_calints.fits" for name in ("binary", "star")]
    maps = visit_maps(paths, ExtractOptions(), {})
    for found in maps:
        assert found is not None
        np.testing.assert_allclose(found.matrix, COMMISSIONED, atol=3e-5)
    target, star = (
        extract_all(path, maps=[found])[0].observables
        for path, found in zip(paths, maps, strict=True)
    )
    calibrated = calibrate([target], [star], rng=np.random.default_rng(1)).observables
    found = amibayes.search(amibayes.Likelihood(calibrated), (180.0, 260.0)).companion
    assert found.separation_mas == pytest.approx(220.0, rel=2e-4)
    assert found.position_angle_deg == pytest.approx(75.0, abs=0.02)


def test_the_map_is_part_of_the_truth(folder: Path) -> None:
    header = fits.getheader(folder / "binary_calints.fits")
    stated = [header[f"MASK_{k}"] for k in ("XX", "XY", "YX", "YY")]
    np.testing.assert_allclose(np.reshape(stated, (2, 2)), COMMISSIONED)


@pytest.mark.parametrize(
    ("edit", "mapped"),
    [("", True), ('mask_map = "drawn"', False), (None, False), ("realistic", True)],
)
def test_which_mask_is_simulated(edit: str | None, mapped: bool, tmp_path: Path) -> None:
    """The paper's mask is the drawing, unless the scene says otherwise; realistic is the real."""
    text = SCENE
    if edit == "realistic":
        text = text.replace("[detector]", '[detector]\npreset = "realistic"')
    if edit != "":
        line = edit if edit and "=" in edit else ""
        text = text.replace('mask_map = "as built"', line)
    (tmp_path / "scene.toml").write_text(text)
    specs = read_program(tmp_path / "scene.toml").specs
    assert [s.observation.instrument.mask.is_mapped for s in specs] == [mapped, mapped]


def test_what_is_mapped_once_is_not_mapped_again() -> None:
    drawn = load_instrument("niriss", "F480M")
    once = drawn.as_built()
    np.testing.assert_array_equal(once.as_built().mask.holes_m, once.mask.holes_m)
    np.testing.assert_allclose(once.mask.holes_m, drawn.mask.holes_m @ COMMISSIONED.T)


def test_a_plan_is_one_of_the_mask_as_built(tmp_path: Path) -> None:
    words = ["plan", "--filter", "F430M", "--photons", "1e8", "--mag", "6", "--quiet"]
    words += ["--floor", "none"]
    plans = {}
    for preset in ("default", "paper"):
        out = tmp_path / preset
        assert main([*words, "--preset", preset, "--out", str(out)]) == 0
        plans[preset] = json.loads((out / "plan.json").read_text())
    peaks = {name: plan["peak_fraction"] for name, plan in plans.items()}
    assert peaks["default"]["point_sampled"] == pytest.approx(peaks["paper"]["point_sampled"])
    # A mask of smaller area makes a wider image.
    area = np.linalg.det(COMMISSIONED)
    assert peaks["default"]["centred"] / peaks["paper"]["centred"] == pytest.approx(area, abs=3e-3)


def test_fringes_of_the_mask_as_built_are_those_of_the_jwst_packages_model(
    rng: np.random.Generator,
) -> None:
    """The package's fringes: 2 π k′·b/λ of holes (−y, −x), k′ made of k = (row, column)."""
    mx, my, sx, sy = 0.99282, 0.99854, 0.00618605, -0.00727008
    drawn = load_instrument("niriss", "F480M")
    x, y = drawn.mask.holes_m.T
    row, column = rng.uniform(-30.0, 30.0, (2, 50))
    first = (my * row - sy * column) / (mx * my - sx * sy)
    second = (-sx * row + mx * column) / (mx * my - sx * sy)
    theirs = np.multiply.outer(first, -y) + np.multiply.outer(second, -x)
    ours = np.stack([column, row], axis=1) @ drawn.as_built().mask.holes_m.T
    np.testing.assert_allclose(ours, -theirs, atol=2e-4)
