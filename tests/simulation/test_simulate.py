"""The command simulate and its file: truth in, truth out, and one line for what cannot be."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

import amibayes
from amibayes.cli import main
from amibayes.cube import read_cube
from amibayes.errors import DataError
from amibayes.instrument import load_instrument
from amibayes.optics import psf, scene_image
from amibayes.scene.orientation import Orientation
from amibayes.scene.sources import Point, Scene
from amibayes.simulation import PRESETS, Detector, Exposure, simulate
from amibayes.simulation.exposure import Recorder
from amibayes.simulation.program import Overrides, example, read_program
from amibayes.support.toml import Section
from amibayes.units import DEGREE, MAS

SMALL = """
name = "AB Dor"
[star]
magnitude = 6.0
filter = "F380M"
[[companion]]
separation_mas = 300.0
position_angle_deg = 40.0
contrast = 0.05
[instrument]
filter = "F430M"
[exposure]
n_groups = 4
n_integrations = 40
n_pixels = 32
roll_deg = [0.0, 60.0]
dithers = 2
[wavefront]
piston_nm = 20.0
drift_nm = 10.0
[[calibrator]]
name = "HD 1"
n_integrations = 20
[calibrator.star]
magnitude = 7.0
filter = "F380M"
"""


def write(folder: Path, text: str = SMALL, name: str = "scene.toml") -> str:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return str(path)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    assert main(["simulate", write(folder), "--out", str(folder), "--seed", "3", "--quiet"]) == 0
    return folder


def test_files_of_all_exposures(made: Path) -> None:
    names = [f"AB_Dor_{k}_calints.fits" for k in (1, 2, 3, 4)]
    names += [f"HD_1_{k}_calints.fits" for k in (1, 2, 3, 4)]
    assert sorted(path.name for path in made.glob("*.fits")) == names
    target, calibrator = (read_cube(made / name) for name in (names[0], names[4]))
    assert target.images.shape == (40, 32, 32)
    assert calibrator.images.shape == (20, 32, 32)
    assert (target.header["IS_PSF"], calibrator.header["IS_PSF"]) == (False, True)
    ratio = calibrator.images.sum() / 20 / (target.images.sum() / 40)
    # one magnitude fainter, and without a companion of 5 %
    assert ratio == pytest.approx(10**-0.4 / 1.05, rel=0.02)


def test_keywords_are_those_of_a_real_file(made: Path, data: Path) -> None:
    keywords = "TELESCOP INSTRUME DETECTOR FILTER PUPIL EXP_TYPE READPATT NINTS NGROUPS NFRAMES"
    keywords += " GROUPGAP TFRAME TGROUP EFFINTTM EFFEXPTM DURATION EXPSTART EXPMID EXPEND DATE-OBS"
    keywords += " TIME-OBS SUBARRAY TARGPROP"
    real = fits.getheader(data / "cubes" / "niriss_f480m_calints.fits")
    with fits.open(made / "AB_Dor_1_calints.fits") as hdus:
        for key in keywords.split():
            assert type(hdus[0].header[key]) is type(real[key]), key
        assert {"ROLL_REF", "V3I_YANG", "VPARITY", "BUNIT"} <= set(hdus["SCI"].header)
        assert hdus[0].header["PUPIL"] == real["PUPIL"]


def test_truth_is_in_the_file(made: Path) -> None:
    with fits.open(made / "AB_Dor_3_calints.fits") as hdus:
        header, scene = hdus[0].header, hdus["SCENE"].data
        assert header["SEED"] == 3
        assert scene["flux"].tolist() == [1.0, 0.05]
        np.testing.assert_allclose(scene["east"][1], 300 * np.sin(np.radians(40)))
        np.testing.assert_allclose(scene["north"][1], 300 * np.cos(np.radians(40)))
        history = "".join(str(line) for line in header["HISTORY"])
        assert 'name = "AB Dor"' in history
        assert "contrast = 0.05" in history
        assert len(hdus["POINTING"].data) == 40
        first = hdus["WAVEFRONT"].data["piston"]
    with fits.open(made / "HD_1_1_calints.fits") as hdus:
        other = hdus["WAVEFRONT"].data["piston"]
    assert 0.0 < np.std(first - other) < 60.0


def test_image_is_that_of_the_truth_in_its_own_header(made: Path) -> None:
    """Rebuild the mean image from the tables alone; roll, dither and wavefront must agree."""
    path = made / "AB_Dor_3_calints.fits"
    cube = read_cube(path)
    assert cube.orientation.position_angle_rad == pytest.approx(60.0 * DEGREE)
    instrument = load_instrument("niriss", "F430M")
    channels = instrument.bandpass.channels(n=9)
    with fits.open(path) as hdus:
        header, sources = hdus[0].header, hdus["SCENE"].data
        jitter = np.stack([hdus["POINTING"].data[f"jitter_{c}"] for c in "xy"], axis=1) / 65.6
        wavefront = amibayes.Wavefront(piston_m=hdus["WAVEFRONT"].data["piston"] * 1e-9)
    model = np.full((32, 32), 0.165)
    centre = np.array([header["DITHER_X"], header["DITHER_Y"]]) / 65.6
    angle = 60.0 * DEGREE
    for flux, east, north in zip(sources["flux"], sources["east"], sources["north"], strict=True):
        # east is left of north, which is `angle` east of +y
        x = -(east * np.cos(angle) - north * np.sin(angle)) / 65.6
        y = (east * np.sin(angle) + north * np.cos(angle)) / 65.6
        image = scene_image(
            Scene(),
            instrument,
            channels,
            32,
            centre_px=(centre[0] + x, centre[1] + y),
            reach_px=np.abs(jitter).max(),
            wavefront=wavefront,
        )
        model += header["RATE"] * flux * image.mean(jitter)
    assert cube.error is not None
    pull = (cube.images.mean(axis=0) - model) / (cube.error.mean(axis=0) / np.sqrt(40))
    # photon and read noise, and a flat field 0.1 % off
    flat = 1e-3 * model / (cube.error.mean(axis=0) / np.sqrt(40))
    chi2 = np.sum(pull**2 / (1.0 + flat**2)) / pull.size
    assert chi2 == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / pull.size))


def test_same_seed_same_bytes_whatever_the_workers(made: Path, tmp_path: Path) -> None:
    scene = str(made / "scene.toml")
    words = ["simulate", scene, "--out", str(tmp_path), "--quiet"]
    assert main([*words, "--seed", "3", "--workers", "2"]) == 0
    for path in made.glob("*.fits"):
        assert path.read_bytes() == (tmp_path / path.name).read_bytes()
    assert main([*words, "--seed", "4", "--overwrite"]) == 0
    for path in made.glob("*.fits"):
        assert path.read_bytes() != (tmp_path / path.name).read_bytes()


def test_example_runs_and_explains_every_key(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["simulate", "--example"]) == 0
    text = capsys.readouterr().out
    assert text == example()
    small = text.replace("photons = 1e8", "photons = 1e6").replace("n_pixels = 80", "n_pixels = 24")
    scene = write(tmp_path, small)
    asked: set[str] = set()
    real = Section._get
    monkeypatch.setattr(
        Section, "_get", lambda self, key, default: asked.add(key) or real(self, key, default)
    )
    assert main(["simulate", scene, "--out", str(tmp_path / "out"), "--json"]) == 0
    exposures = json.loads(capsys.readouterr().out)["exposures"]
    assert [e["calibrator"] for e in exposures] == [False, True, True]
    assert len(list((tmp_path / "out").glob("*_calints.fits"))) == 3
    assert {"migration_threshold_e", "tilt_drift_mas", "n_wavelengths"} < asked
    assert [key for key in asked if not re.search(rf"\b{key}\b", text)] == []


def test_example_has_every_number_of_the_detector_with_its_defaults() -> None:
    table = example().partition("[detector]")[2].partition("[wavefront]")[0]
    lines = dict(re.findall(r"^# (\w+) = (.*)$", table, re.MULTILINE))
    paper, realistic = (PRESETS[name] for name in ("paper", "realistic"))
    assert set(lines) == {entry.name for entry in fields(Detector)}
    for name, line in lines.items():
        assert tomllib.loads(f"x = {line.split()[0]}")["x"] == getattr(paper, name), name
        other = getattr(realistic, name)
        if other != getattr(paper, name):
            stated = re.search(r"\(([^()]*)\)$", line)
            assert stated is not None, name
            assert tomllib.loads(f"x = {stated[1]}")["x"] == other, name


def test_paper_scene_of_the_examples_runs_as_it_is(tmp_path: Path) -> None:
    scene = Path(__file__).parents[2] / "examples" / "paper_scene.toml"
    assert main(["simulate", str(scene), "--out", str(tmp_path), "--quiet"]) == 0
    (path,) = tmp_path.glob("*_calints.fits")
    assert read_cube(path).filter == "F380M"


def test_realistic_preset_shows_its_effects(tmp_path: Path) -> None:
    text = SMALL.replace("[wavefront]", '[detector]\npreset = "realistic"\n[wavefront]')
    assert main(["simulate", write(tmp_path, text), "--out", str(tmp_path), "--quiet"]) == 0
    cube = read_cube(tmp_path / "AB_Dor_1_calints.fits")
    assert cube.dq is not None
    assert 0 < cube.bad[0].sum() < 20
    assert np.isnan(cube.images).any()


def test_simulate_in_memory() -> None:
    rng = np.random.default_rng(1)
    scene = Scene((Point(), Point(0.1, 0.0, 260 * MAS)), magnitude=6.0)
    instrument = load_instrument("niriss", "F430M")
    exposure = Exposure(5, 40, jitter_rad=0.0, dither_rad=0.0, n_pixels=32)
    orientation = Orientation(90.0 * DEGREE)  # north is to the right of the image
    cube = simulate(scene, instrument, exposure, rng, orientation=orientation)
    rate = instrument.count_rate(scene.spectrum, 6.0)
    channels = instrument.bandpass.channels(scene.spectrum)
    model = rate * (
        psf(instrument, channels, 32)
        + 0.1 * psf(instrument, channels, 32, centre_px=(260 / 65.6, 0.0))
    )
    assert cube.images.mean(axis=0) == pytest.approx(model, rel=0.1, abs=80.0)
    assert cube.images.mean(axis=0).sum() == pytest.approx(model.sum(), rel=2e-3)
    assert cube.mjd is not None
    assert np.diff(cube.mjd) * 86400 == pytest.approx(6 * 0.07544, rel=1e-4)
    with pytest.raises(DataError, match=r"'star\.magnitude' is missing"):
        simulate(Scene(), instrument, exposure, rng)
    bright = simulate(Scene(), instrument, exposure, rng, count_rate_e_s=1e5)
    assert bright.images[0].sum() == pytest.approx(
        1e5 * psf(instrument, channels, 32).sum(), rel=0.05
    )


@pytest.mark.parametrize("option", [(), ("--ramps",)])
def test_run_that_is_cut_off_goes_on_to_the_same_bytes(
    option: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    hits = '[detector]\npreset = "realistic"\ncosmic_rays_s = 2e-3\n'
    text = SMALL.replace("dithers = 2", "dithers = 1")
    scene = write(tmp_path, text.replace("[wavefront]", f"{hits}[wavefront]"))
    whole, cut = tmp_path / "whole", tmp_path / "cut"
    assert main(["simulate", scene, *option, "--out", str(whole), "--quiet"]) == 0
    calls: list[int] = []
    real = Recorder.__call__

    def failing(self: Recorder, piece: object) -> object:
        calls.append(1)
        if len(calls) == 4:
            raise MemoryError("as good as a kill")
        return real(self, piece)

    monkeypatch.setattr(Recorder, "__call__", failing)
    words = ["simulate", scene, *option, "--out", str(cut), "--quiet"]
    assert main(words) == 4
    assert 0 < len(list(cut.glob("*_calints.fits"))) < len(list(whole.glob("*_calints.fits")))
    begun = len(calls)
    assert main([*words, "--resume"]) == 0
    resumed = len(calls) - begun
    monkeypatch.undo()
    assert [p.name for p in sorted(cut.iterdir())] == [p.name for p in sorted(whole.iterdir())]
    for path in whole.iterdir():
        assert path.read_bytes() == (cut / path.name).read_bytes()
    # Each integration was simulated once: three pieces before, the rest after.
    pieces = sum(-(-read_cube(p).n_integrations // 32) for p in whole.glob("*_calints.fits"))
    assert resumed == pieces - 3


def edited(old: str, new: str) -> str:
    assert old in SMALL
    return SMALL.replace(old, new)


FAULTS = {
    "negative contrast": (edited("contrast = 0.05", "contrast = -0.1"), 3, "contrast"),
    "outside": (edited("= 300.0", "= 3000.0"), 3, "outside the image"),
    "filter": (edited('filter = "F430M"', 'filter = "F999M"'), 3, "niriss has no filter 'F999M'"),
    "groups": (edited("n_groups = 4", "n_groups = 1"), 3, "n_groups is 1; a slope needs 2"),
    "fraction": (edited("n_groups = 4", "n_groups = 2.5"), 3, "not a whole number"),
    "saturated": (edited("magnitude = 6.0", "magnitude = -2.0"), 3, "saturates"),
    "misspelt": (edited("n_groups", "n_gruops"), 3, "did you mean"),
    "unknown table": (edited("[wavefront]", "[wavefonrt]"), 3, "is not known"),
    "no star": (edited("[star]\nmagnitude = 6.0\n", "[sun]\n"), 3, "key 'star' is missing"),
    "no magnitude": (edited("magnitude = 6.0\n", ""), 3, "magnitude' is missing"),
    "not a number": (edited("n_pixels = 32", 'n_pixels = "many"'), 3, "not a whole number"),
    "detector": (edited("[wavefront]", "[detector]\nread_noise_e = -3.0\n[wavefront]"), 3, "is -3"),
    "preset": (edited("[wavefront]", '[detector]\npreset = "x"\n[wavefront]'), 3, "no detector"),
    "no groups": (edited("n_groups = 4", "n_groups = 0"), 3, "n_groups' is 0"),
    "endless": (edited("n_integrations = 40", "n_integrations = 40000000"), 3, "at most 1000000"),
    "same name": (edited('"HD 1"', '"AB Dor"'), 3, "two stars are called 'AB_Dor_1'"),
    "not TOML": ("[star", 3, "is not valid TOML"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_fault_of_the_file_is_one_line(
    fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text, status, message = FAULTS[fault]
    scene = write(tmp_path, text)
    assert main(["simulate", scene, "--out", str(tmp_path / "out")]) == status
    shown = capsys.readouterr()
    assert message in shown.err
    assert shown.err.startswith("amibayes: ")
    assert shown.err.count("\n") == 1
    assert "scene.toml" in shown.err or fault == "same name"
    assert not (tmp_path / "out").exists()


def test_image_without_scale_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fits.PrimaryHDU(np.ones((9, 9))).writeto(tmp_path / "disc.fits")
    text = SMALL.replace(
        "[instrument]", '[[image]]\nfile = "disc.fits"\ncontrast = 0.1\n[instrument]'
    )
    assert main(["simulate", write(tmp_path, text), "--out", str(tmp_path / "out")]) == 3
    assert "no pixel scale" in capsys.readouterr().err


def test_request_without_a_file_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["simulate"]) == 2
    assert "no scene is given" in capsys.readouterr().err
    assert main(["simulate", str(tmp_path / "none.toml")]) == 3
    assert "cannot be read" in capsys.readouterr().err


def test_present_files_and_bad_folders_are_one_line(
    made: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = str(made / "scene.toml")
    assert main(["simulate", scene, "--out", str(made)]) == 2
    assert "is there already" in capsys.readouterr().err
    (tmp_path / "file").write_text("in the way")
    assert main(["simulate", scene, "--out", str(tmp_path / "file")]) == 2
    assert "cannot be made a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("option", "said"),
    [
        (("--photons", "1e30"), "--photons: that exposure takes"),
        (("--photons", "3"), "--photons: 3 photons carry no closure phase"),
        (("--photons", "1e12"), "--photons: n_integrations is"),
        (("--filter", "F48"), "--filter: niriss has no filter 'F48'"),
    ],
)
def test_fault_of_an_option_is_not_the_files(
    option: tuple[str, str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["simulate", write(tmp_path), *option, "--out", str(out)]) == 2
    assert capsys.readouterr().err.startswith(f"amibayes: {said}")
    assert not out.exists()


@pytest.mark.parametrize("text", [SMALL, SMALL.replace('[instrument]\nfilter = "F430M"\n', "")])
def test_options_stand_in_the_place_of_the_file(text: str, tmp_path: Path) -> None:
    """Also of what it says of single stars, and of its number of integrations."""
    program = read_program(write(tmp_path, text), Overrides("F480M", 1e7))
    assert len(program.specs) == 8
    for spec in program.specs:
        taken = spec.observation
        assert taken.instrument.bandpass.name == "F480M"
        one = 4 * 0.0745 * taken.count_rate_e_s * taken.scene.flux
        assert 1e7 <= taken.exposure.n_integrations * one <= 1e7 + 2 * one


LIMITED = """
import resource, sys
from amibayes.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (400_000, 400_000))
sys.exit(main(sys.argv[1:]))
"""


def test_full_disk_is_one_line_and_leaves_nothing(tmp_path: Path) -> None:
    out = tmp_path / "out"
    words = ["simulate", write(tmp_path), "--out", str(out)]
    ended = subprocess.run(
        [sys.executable, "-c", LIMITED, *words], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 4
    assert "cannot be written: File too large" in ended.stderr
    assert ended.stderr.count("\n") == 1
    # No part of a file; what is finished is kept for --resume.
    assert [p.name for p in out.iterdir()] == ["simulate.journal"]


MEMORY = """
import resource, sys
import amibayes.cli.simulate, amibayes.simulation.program, scipy.special, astropy.io.fits
def used():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
before, (*scenes, words) = used(), sys.argv[1:]
for scene in scenes:
    assert amibayes.cli.main(["simulate", scene, *words.split(), f"--out={scene}.out"]) == 0
    print(used() - before)
"""


def peak_memory_mb(
    folder: Path, *n_integrations: int, options: tuple[str, ...] = ()
) -> list[float]:
    """The most that a process has used after each of several simulations, the shortest first."""
    scenes = [scene_of(folder, n) for n in n_integrations]
    ended = subprocess.run(
        [sys.executable, "-c", MEMORY, *scenes, " ".join([*options, "--quiet"])],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [float(word) for word in ended.stdout.split()]


def scene_of(folder: Path, n_integrations: int) -> str:
    text = '[star]\nmagnitude = 9.0\n[instrument]\nfilter = "F430M"\n[exposure]\nn_groups = 2\n'
    text += f'n_integrations = {n_integrations}\n[detector]\npreset = "realistic"\n'
    text += "cosmic_rays_s = 1e-3\n"
    return write(folder, text, f"n{n_integrations}.toml")


@pytest.mark.parametrize("option", [(), pytest.param(("--ramps",), marks=pytest.mark.slow)])
def test_memory_does_not_grow_with_the_exposure(option: tuple[str, ...], tmp_path: Path) -> None:
    short, long = peak_memory_mb(tmp_path, 100, 800, options=option)
    assert long < 300.0
    assert long - short < 40.0  # the images alone would take 700 × 77 kB more


@pytest.mark.slow
def test_memory_of_ten_thousand_integrations(tmp_path: Path) -> None:
    assert peak_memory_mb(tmp_path, 10000)[0] < 300.0


def test_map_of_the_wavefront_is_that_of_its_file(tmp_path: Path) -> None:
    """And the exposures are taken through it."""
    opd_m = 30e-9 * np.random.default_rng(1).standard_normal((48, 48))
    fits.PrimaryHDU(opd_m).writeto(tmp_path / "opd.fits")
    text = SMALL.replace("[wavefront]", '[wavefront]\nmap = "opd.fits"\nmap_width_m = 6.6')
    program = read_program(write(tmp_path, text))
    assert program.specs
    for spec in program.specs:
        assert spec.errors.map is not None
        np.testing.assert_array_equal(spec.errors.map.opd_m, opd_m)
        assert spec.errors.map.width_m == 6.6
    for _, prepared in program.prepared_exposures(1):
        wavefront = prepared.observation.wavefront
        assert wavefront is not None
        assert wavefront.map is not None
        np.testing.assert_array_equal(wavefront.map.opd_m, opd_m)
    assert read_program(write(tmp_path)).specs[0].errors.map is None
    for width in ("", "map_width_m = 0.0"):
        bad = SMALL.replace("[wavefront]", f'[wavefront]\nmap = "opd.fits"\n{width}')
        with pytest.raises(DataError, match="map_width_m"):
            read_program(write(tmp_path, bad))
