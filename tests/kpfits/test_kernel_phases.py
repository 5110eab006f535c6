"""Kernel phases of a simulated full pupil, whose images and kernel matrix amibayes did not make."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from helpers import niriss
from pupil_images import WAVELENGTH, Pupil, write_kernel_file
from scipy import stats

import amibayes as ab
from amibayes.calibration import calibrate
from amibayes.cli import main
from amibayes.companion_search.grid import make_grid
from amibayes.data.kernel_model import stands_alone
from amibayes.data.observables import join
from amibayes.detection.statistic import make_statistic
from amibayes.kpfits import kernel_observables, write_kpfits
from amibayes.kpfits.audit import _scatter, audit_kpfits
from amibayes.kpfits.file import _wavelengths, open_kpfits
from amibayes.kpfits.write import write_observables
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.rings import make_rings

PUPIL = Pupil()
SEPARATION, ANGLE, CONTRAST = 150.0, 40.0, 0.02
EAST, NORTH = (float(SEPARATION * f(np.radians(ANGLE))) for f in (np.sin, np.cos))


def covariance(sigma: float = 2e-3) -> np.ndarray:
    """A correlated covariance of kernel phases: photons of an image of the star."""
    image = PUPIL.image([(0.0, 0.0, 1.0)], np.zeros(len(PUPIL.cells)))
    found = PUPIL.measure(image, image)[1]
    return found * sigma**2 / np.mean(np.diag(found))


def kernel_file(
    path: Path,
    value: np.ndarray | None = None,
    frames: int = 1,
    angle: float = 0.0,
    **options: object,
) -> Path:
    """Frames without noise of a star, or of given kernel phases."""
    one = np.zeros(len(PUPIL.kernel)) if value is None else value
    return write_kernel_file(
        path,
        PUPIL,
        np.tile(one, (frames, 1)) if one.ndim == 1 else one,
        np.tile(covariance(), (frames if one.ndim == 1 else len(one), 1, 1)),
        np.full(frames if one.ndim == 1 else len(one), angle),
        **options,  # type: ignore[arg-type]
    )


def noisy(rng: np.random.Generator, n: int, mean: np.ndarray | float = 0.0) -> np.ndarray:
    return mean + rng.multivariate_normal(np.zeros(len(PUPIL.kernel)), covariance(), n)


@pytest.mark.parametrize("angle", [0.0, 123.0])
def test_companion_in_images_is_found_where_it_is(angle: float, tmp_path: Path) -> None:
    """Photon noise of 6e6, a pupil with aberrations; 4 sigma of the fit's own errors."""
    rng = np.random.default_rng(1)
    x, y = PUPIL.on_image(EAST, NORTH, angle)
    phase = rng.normal(0.0, 0.02, len(PUPIL.cells))
    image = 1e6 * PUPIL.image([(0.0, 0.0, 1.0), (x, y, CONTRAST)], phase) + 20.0
    made = [PUPIL.measure(rng.poisson(image) - 20.0, image) for _ in range(6)]
    path = write_kernel_file(
        tmp_path / "a.fits", PUPIL, np.array([m[0] for m in made]),
        np.array([m[1] for m in made]), np.full(6, angle),
    )  # fmt: skip
    data = kernel_observables(path)
    assert (data.phase_name, data.n_independent) == ("kernel phase", 80)
    assert (data.covariance_kind, data.n_integrations) == ("estimated", 6)
    found = ab.search(ab.Likelihood(data), (60.0, 500.0))
    error = np.sqrt(np.diag(found.likelihood.errors(found.theta)))
    assert (np.abs(found.theta[:3] - [EAST, NORTH, CONTRAST]) < 4.0 * error[:3]).all()
    assert error[0] < 3.0
    assert found.chi2_binary < stats.chi2.isf(1e-4, 77)


def test_model_is_the_sum_of_phases_of_the_pupil(tmp_path: Path) -> None:
    """Bright and faint, turned and not: against the direct sum, without wrapping at 2π."""
    bright = 30.0 * PUPIL.phases(EAST, NORTH, 0.9, 70.0)  # beyond ±π: a sum has no period
    path = kernel_file(tmp_path / "a.fits", bright, angle=70.0)
    likelihood = Likelihood(kernel_observables(path))
    theta = np.array([[EAST, NORTH, 0.9], [EAST, NORTH, 1e-3]])
    found = likelihood.predict(theta)
    for column, contrast in zip(found.T, (0.9, 1e-3), strict=True):
        assert column == pytest.approx(PUPIL.phases(EAST, NORTH, contrast, 70.0), abs=1e-12)
    assert np.abs(bright).max() > 4.0
    left = likelihood.difference(theta[:1])[:, 0]
    assert left == pytest.approx(bright - found[:, 0], abs=1e-12)


def test_pulls_and_chi2(tmp_path: Path) -> None:
    """150 data sets at the truth's own errors: spread of pulls and mean χ² within 4.5 sigma."""
    rng, n = np.random.default_rng(5), 150
    likelihood = Likelihood(kernel_observables(kernel_file(tmp_path / "a.fits")))
    truth = np.array([EAST, NORTH, CONTRAST])
    error = likelihood.errors(truth)
    jacobian = likelihood.jacobian(truth)
    mean = PUPIL.phases(EAST, NORTH, CONTRAST, 0.0)
    signal = noisy(rng, n, mean) - likelihood.predict(truth[None])[:, 0]
    white = likelihood.noise.whiten(signal.T)
    change = error @ jacobian.T @ white
    pull = change / np.sqrt(np.diag(error))[:, None]
    assert np.abs(pull.mean(axis=1)).max() < 4.5 / np.sqrt(n)
    assert np.abs(pull.std(axis=1) - 1.0).max() < 4.5 / np.sqrt(2 * n)
    chi2 = (white**2).sum(axis=0).mean()
    assert abs(chi2 - 80.0) < 4.5 * np.sqrt(160.0 / n)


def test_probability_of_nulls_is_uniform(tmp_path: Path) -> None:
    """400 nulls drawn by the test's covariance against null draws; Kolmogorov-Smirnov > 1e-4."""
    rng = np.random.default_rng(7)
    likelihood = Likelihood(kernel_observables(kernel_file(tmp_path / "a.fits")))
    test = make_statistic(likelihood, make_grid(60.0, 400.0, 30.0), np.empty(0), stated_errors=True)
    null = np.sort(test.draw_null(4000, rng))
    observed = test.evaluate(likelihood.noise.whiten(noisy(rng, 400).T))
    p = 1.0 - np.searchsorted(null, observed) / len(null)
    assert stats.kstest(p, "uniform").pvalue > 1e-4


def test_limit_is_that_of_the_brute_force(tmp_path: Path) -> None:
    """Contrast at Δχ² 36 of noise-free data (``closure-phase`` at 3 sigma), from direct sums."""
    likelihood = Likelihood(kernel_observables(kernel_file(tmp_path / "a.fits")))
    found = ab.search(likelihood, (60.0, 300.0))
    limit = ab.analytic_limit(found, "closure-phase", separation_mas=[100.0, 200.0])
    rings = make_rings(found, separation_mas=[100.0, 200.0])
    inverse = np.linalg.inv(covariance())
    for k in range(2):
        row = limit.contrast_at[k]
        for east, north, contrast in zip(
            rings.east_mas[k][:5], rings.north_mas[k][:5], row[:5], strict=True
        ):
            signal = PUPIL.phases(east, north, contrast, 0.0)
            assert signal @ inverse @ signal == pytest.approx(36.0, rel=0.03)


def test_frames_of_several_orientations_keep_their_own(tmp_path: Path) -> None:
    angles = np.array([10.0, 10.1, 359.99, 0.05, 80.0])
    value = np.array([PUPIL.phases(EAST, NORTH, CONTRAST, a) for a in angles])
    path = write_kernel_file(
        tmp_path / "a.fits", PUPIL, value, np.tile(covariance(), (5, 1, 1)), angles
    )
    data = kernel_observables(path)
    assert len(data.setups) == 3
    likelihood = Likelihood(data)
    difference = likelihood.difference(np.array([[EAST, NORTH, CONTRAST]]))[:, 0]
    assert np.abs(difference).max() < 2e-5
    assert likelihood.n_independent == 3 * 80


@pytest.mark.parametrize("angles", [(360.0, 0.0), (359.95, -0.05), (0.1, 359.9, 0.0), (-0.1, 0.1)])
def test_frames_of_one_orientation_across_north_have_their_mean(
    angles: tuple[float, ...], tmp_path: Path
) -> None:
    value = np.array([PUPIL.phases(EAST, NORTH, CONTRAST, a) for a in angles])
    path = write_kernel_file(
        tmp_path / "a.fits", PUPIL, value, np.tile(covariance(), (len(angles), 1, 1)),
        np.array(angles),
    )  # fmt: skip
    likelihood = Likelihood(kernel_observables(path))
    assert likelihood.n_independent == 80
    assert np.abs(likelihood.difference(np.array([[EAST, NORTH, CONTRAST]]))).max() < 2e-5


def test_calibrators_take_the_pupil_out_with_their_errors(tmp_path: Path) -> None:
    """Instrumental kernel phases of 5σ; another orientation of the calibrators does not matter."""
    rng = np.random.default_rng(2)
    bias = rng.normal(0.0, 0.01, len(PUPIL.kernel))
    star = kernel_file(tmp_path / "t.fits", bias + PUPIL.phases(EAST, NORTH, 0.02, 33.0), angle=33)
    values = [bias + noise for noise in noisy(rng, 2)]
    paths = [kernel_file(tmp_path / f"c{k}.fits", v, angle=9.0 * k) for k, v in enumerate(values)]
    target, *calibrators = [kernel_observables(p) for p in (star, *paths)]
    found = calibrate(target, calibrators, method="weighted", clip=None).observables
    assert found.data == pytest.approx(target.data - np.mean(values, axis=0), abs=1e-9)
    dense = found.covariance.sparse.toarray()
    assert (np.diag(dense) >= 1.499 * np.diag(covariance())).all()
    best = ab.search(ab.Likelihood(found), (60.0, 400.0)).theta
    assert np.hypot(best[0] - EAST, best[1] - NORTH) < 10.0


def test_calibrators_of_another_kernel_matrix_are_refused(tmp_path: Path) -> None:
    other = kernel_file(tmp_path / "c.fits", KER_MAT=PUPIL.kernel[:, ::-1])
    star = kernel_observables(kernel_file(tmp_path / "t.fits", PUPIL.phases(EAST, NORTH, 0.1, 0.0)))
    with pytest.raises(ab.DataError, match="another kernel matrix"):
        calibrate(star, [kernel_observables(other)])


def test_written_file_reads_back(tmp_path: Path) -> None:
    angles = np.array([10.0, 80.0])
    value = np.array([PUPIL.phases(EAST, NORTH, CONTRAST, a) for a in angles])
    path = write_kernel_file(
        tmp_path / "a.fits", PUPIL, value, np.tile(covariance(), (2, 1, 1)), angles
    )
    data = kernel_observables(path)
    assert data.notes == ("frames in 2 orientations, each averaged by itself",)
    write_kpfits(tmp_path / "b.fits", data)
    again = kernel_observables(tmp_path / "b.fits")
    theta = np.array([[EAST, NORTH, CONTRAST]])
    chi2 = [float(Likelihood(d).chi2(1.1 * theta)[0]) for d in (data, again)]
    assert chi2[0] == pytest.approx(chi2[1], rel=1e-6)
    assert Likelihood(again).chi2(theta)[0] < 1e-6
    with pytest.raises(ab.DataError, match="OIFITS has no place for kernel phases"):
        ab.write_oifits(tmp_path / "c.oifits", data)
    mirrored = kernel_observables(kernel_file(tmp_path / "m.fits", KER_MAT=PUPIL.kernel[:, ::-1]))
    for other in (niriss(), join([data, mirrored])):
        with pytest.raises(ab.DataError, match="kernel phases of one pupil"):
            write_kpfits(tmp_path / "d.fits", other)


def test_older_files_without_an_axis_of_wavelengths(tmp_path: Path) -> None:
    """Covariances in KP-SIGM, wavelength in the header, angles in a table TEL."""
    value = np.array([PUPIL.phases(EAST, NORTH, CONTRAST, 50.0)] * 2)
    new = kernel_file(tmp_path / "a.fits", value, angle=50.0)
    with fits.open(new) as hdus:
        hdus["KP-DATA"].data = hdus["KP-DATA"].data[:, 0]
        hdus["KP-SIGM"].data = hdus["KP-COV"].data[:, 0]
        hdus[0].header["CWAVEL"] = 4.8e-6
        angle = fits.Column("pa", "D", array=hdus["DETPA"].data)
        kept = [h for h in hdus if h.name not in ("KP-COV", "DETPA", "CWAVEL")]
        kept.append(fits.BinTableHDU.from_columns([angle], name="TEL"))
        fits.HDUList(kept).writeto(tmp_path / "b.fits")
    one, two = kernel_observables(new), kernel_observables(tmp_path / "b.fits")
    assert two.data == pytest.approx(one.data)
    theta = np.array([[1.2 * EAST, NORTH, CONTRAST]])
    assert Likelihood(two).chi2(theta) == pytest.approx(Likelihood(one).chi2(theta))


BAD = {
    "no-points": ({"drop": ("UV-PLANE",)}, "without UV-PLANE"),
    "no-kernel": ({"drop": ("KER-MAT",)}, "without KER-MAT"),
    "shape": ({"KER_MAT": np.eye(5, 154)}, "do not fit"),
    "points": ({"KER_MAT": np.ones((80, 7))}, "UV-PLANE has 154 points, KER-MAT 7"),
    "errors": ({"drop": ("KP-SIGM", "KP-COV")}, "neither KP-COV nor KP-SIGM fits"),
    "wavelength": ({"drop": ("CWAVEL",)}, "does not state its wavelength"),
    "nan": ({"KP_DATA": np.full((1, 1, 80), np.nan)}, "not finite"),
    "angles": ({"DETPA": np.array([np.nan])}, "not finite"),
    "no-error": ({"KP_COV": np.zeros((1, 1, 80, 80))}, "not positive definite"),
}


def test_the_structure_of_xara_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = kernel_file(tmp_path / "a.fits")
    with fits.open(path) as hdus:
        hdus["KP-DATA"].name = "KP-DATA1"
        hdus.writeto(tmp_path / "x.fits")
    assert main(["search", str(tmp_path / "x.fits"), "--out", str(tmp_path / "o")]) == 3
    assert "in XARA's own structure" in capsys.readouterr().err


@pytest.mark.parametrize("name", BAD)
def test_bad_files_get_one_line(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options, fault = BAD[name]
    path = kernel_file(tmp_path / f"{name}.fits", **options)  # type: ignore[arg-type]
    for command in ("search", "limits"):
        assert main([command, str(path), "--out", str(tmp_path / command), "--quiet"]) == 3
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert fault in error
        assert f"{name}.fits" in error


def test_calibrate_and_extract_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What is calibrated is named; images of a KPFITS file are not taken for those of a mask."""
    star = kernel_file(tmp_path / "t.fits", PUPIL.phases(EAST, NORTH, 0.02, 0.0))
    rng = np.random.default_rng(1)
    (noise,) = noisy(rng, 1)
    calibrator = kernel_file(tmp_path / "c.fits", noise)
    out = tmp_path / "out"
    assert main(["calibrate", str(star), "--cal", str(calibrator), "--out", str(out)]) == 0
    assert "calibrated_kpfits.fits" in capsys.readouterr().out
    assert kernel_observables(out / "calibrated_kpfits.fits").n_independent == 80
    assert main(["calibrate", str(star), "--cal", str(calibrator), "--out", str(out)]) == 2
    capsys.readouterr()
    assert main(["extract", str(star), "--out", str(tmp_path / "x")]) == 3
    assert "holds kernel phases (KPFITS)" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "codes"),
    [
        ({}, set()),
        ({"drop": ("DETPA",)}, {"kp-orientation", "kp-missing"}),
        ({"drop": ("KP-COV",)}, {"kp-correlations"}),
        ({"KP_SIGM": np.full((1, 1, 80), 0.1)}, {"kp-errors-differ"}),
        ({"KER_MAT": np.eye(80, 154)}, {"kp-leak"}),
    ],
)
def test_audit(options: dict[str, object], codes: set[str], tmp_path: Path) -> None:
    found = audit_kpfits(kernel_file(tmp_path / "a.fits", **options))  # type: ignore[arg-type]
    assert {f.code for f in found.findings} == codes


def test_audit_of_errors_that_frames_contradict(tmp_path: Path) -> None:
    value = 3.0 * noisy(np.random.default_rng(3), 10)
    path = kernel_file(tmp_path / "a.fits", value)
    (finding,) = audit_kpfits(path).findings
    assert finding.code == "kp-scatter"
    assert "3." in finding.what or "2.9" in finding.what
    assert main(["audit", str(path), "--out", str(tmp_path / "out"), "--quiet"]) == 1
    content = json.loads((tmp_path / "out" / "audit.json").read_text())
    assert content["files"][0]["findings"][0]["code"] == "kp-scatter"


@pytest.mark.parametrize(("scale", "severity"), [(1.5, "error"), (0.6, "warning"), (1.0, None)])
def test_errors_too_small_are_worse_than_errors_too_large(
    scale: float, severity: str | None, tmp_path: Path
) -> None:
    """A search finds companions that are none with the former, and misses some with the latter."""
    value = scale * noisy(np.random.default_rng(3), 10)
    found = audit_kpfits(kernel_file(tmp_path / "a.fits", value)).findings
    assert [(f.code, f.severity) for f in found] == [("kp-scatter", severity)] * bool(severity)


@pytest.mark.slow
def test_search_with_calibrators_writes_everything(tmp_path: Path) -> None:
    """The whole command, small; the calibrated kernel phases are a KPFITS file."""
    rng = np.random.default_rng(4)
    bias = rng.normal(0.0, 0.01, len(PUPIL.kernel))
    signal = bias + PUPIL.phases(EAST, NORTH, CONTRAST, 20.0)
    star = kernel_file(tmp_path / "t.fits", noisy(rng, 4, signal), angle=20.0)
    calibrators = [kernel_file(tmp_path / f"c{k}.fits", noisy(rng, 4, bias)) for k in range(2)]
    arguments = ["--separation", "60:300", "--null-draws", "100", "--no-posterior", "--no-limits"]
    out = tmp_path / "out"
    given = ["search", str(star), "--cal", *map(str, calibrators), "--out", str(out), "--quiet"]
    assert main([*given, *arguments]) == 0
    result = json.loads((out / "result.json").read_text())
    assert result["data"]["phases"] == "kernel phase"
    assert result["fit"]["separation_mas"] == pytest.approx(SEPARATION, abs=5.0)
    assert result["fit"]["position_angle_deg"] == pytest.approx(ANGLE, abs=2.0)
    assert "80 kernel phases" in (out / "report.html").read_text()
    again = kernel_observables(out / "calibrated_kpfits.fits")
    assert again.n_independent == 80


def test_audit_of_a_covariance_without_an_inverse(tmp_path: Path) -> None:
    """Several directions of next to no error: the least is compared with the largest."""
    inner = np.linalg.qr(np.random.default_rng(5).standard_normal((80, 80)))[0]
    size = np.r_[1e-15, np.full(4, 1e-14), np.ones(75)] * 4e-6
    singular = (inner * size) @ inner.T
    one = np.sqrt(np.diag(singular))[None, None]
    path = kernel_file(tmp_path / "a.fits", KP_COV=singular[None, None], KP_SIGM=one)
    assert "kp-singular" in {f.code for f in audit_kpfits(path).findings}


def test_scatter_is_carried_for_every_channel(tmp_path: Path) -> None:
    """Frames at two wavelengths: the measured scatter of both goes along."""
    value = noisy(np.random.default_rng(8), 60)
    path = kernel_file(tmp_path / "a.fits", value)
    with fits.open(path) as hdus:
        cov, sigma = hdus["KP-COV"].data, hdus["KP-SIGM"].data
        twice = {
            "KP-DATA": np.stack([value, value[::-1]], axis=1),
            "KP-COV": np.repeat(cov, 2, axis=1),
            "KP-SIGM": np.repeat(sigma, 2, axis=1),
        }
        for name, array in twice.items():
            hdus[hdus.index_of(name)] = fits.ImageHDU(array, name=name)
        waves = hdus["CWAVEL"].data
        columns = [
            fits.Column(n, "D", array=waves[n][0] * np.array([1.0, 1.1])) for n in waves.names
        ]
        hdus[hdus.index_of("CWAVEL")] = fits.BinTableHDU.from_columns(columns, name="CWAVEL")
        hdus.writeto(tmp_path / "b.fits")
    one, two = (kernel_observables(tmp_path / n) for n in ("a.fits", "b.fits"))
    assert one.scatter is not None
    assert two.scatter is not None
    assert two.scatter.shape[0] == 2 * one.scatter.shape[0]
    first = two.scatter.toarray()[: one.scatter.shape[0], : one.scatter.shape[0]]
    np.testing.assert_allclose(first, one.scatter.toarray(), rtol=1e-6, atol=1e-12)


def test_date_is_the_mean_of_those_that_are_known(tmp_path: Path) -> None:
    data = kernel_observables(kernel_file(tmp_path / "a.fits", frames=4))
    mjd = np.where(np.arange(len(data.closure_phase)) % 2, np.nan, 60321.25)
    write_kpfits(
        tmp_path / "b.fits", replace(data, closure_phase=replace(data.closure_phase, mjd=mjd))
    )
    assert fits.getval(tmp_path / "b.fits", "MJD-AVG") == pytest.approx(60321.25)
    nothing = replace(data.closure_phase, mjd=np.full(len(mjd), np.nan))
    write_kpfits(tmp_path / "c.fits", replace(data, closure_phase=nothing))
    assert "MJD-AVG" not in fits.getheader(tmp_path / "c.fits")


def test_instrument_is_named_by_the_first_keyword_that_does(tmp_path: Path) -> None:
    path = kernel_file(tmp_path / "a.fits")
    names = []
    for changes in ({}, {"INSTRUME": "", "CURRINST": "NIRC2"}, {"CURRINST": ""}):
        with fits.open(path, mode="update") as hdus:
            hdus[0].header.update(changes)
        names.append(open_kpfits(path).instrument)
    assert names == ["NIRISS_F480M", "NIRC2_F480M", "KPFITS_F480M"]


def test_observables_of_two_kinds_go_to_two_files_over_old_ones(tmp_path: Path) -> None:
    kernel, masked = kernel_observables(kernel_file(tmp_path / "k.fits")), niriss()
    masked = masked.with_data(masked.data + 1e-4)  # phases of 0 count as none
    path, beside = tmp_path / "a.oifits", tmp_path / "a_kpfits.fits"
    both = join([masked, kernel])
    for data, expected in (
        (kernel, (beside,)),
        (masked, (path,)),
        (both, (path, beside)),
        (both, (path, beside)),
        (kernel, (beside,)),
    ):
        assert write_observables(path, data) == expected
    np.testing.assert_allclose(kernel_observables(beside).data, kernel.data, atol=1e-12)
    np.testing.assert_allclose(ab.read_oifits(path).data, masked.data, atol=1e-12)


@pytest.mark.parametrize(
    ("excess", "seen"), [(1.0, False), (1.03, False), (0.97, False), (1.1, True)]
)
def test_scatter_off_by_a_few_per_cent_is_no_finding(
    excess: float, *, seen: bool, tmp_path: Path
) -> None:
    """400 frames know their scatter to 0.4 %: what is 8σ off is named where it matters too."""
    file, n = open_kpfits(kernel_file(tmp_path / "a.fits")), 400
    draws = excess * noisy(np.random.default_rng(3), n)
    many = replace(
        file,
        value=draws[:, None],
        covariance=np.broadcast_to(file.covariance[:1], (n, *file.covariance.shape[1:])),
        position_angle_deg=np.zeros(n),
    )
    assert len(list(_scatter(many))) == seen


@pytest.mark.parametrize("left", [0.5, 0.88, 0.93])
def test_a_window_that_dims_the_field_is_named(left: float, tmp_path: Path) -> None:
    """exp(−(ρ/r)⁴) of the light is left at a radius ρ: here at the edge, λ/B_min."""
    path = kernel_file(tmp_path / "a.fits")
    assert not [f for f in audit_kpfits(path).findings if f.code == "kp-window"]
    edge = np.degrees(WAVELENGTH / np.hypot(*PUPIL.points.T).min()) * 3.6e6
    fits.setval(path, "WRAD", value=float(edge / 65.0 / (-np.log(left)) ** 0.25))
    found = [f for f in audit_kpfits(path).findings if f.code == "kp-window"]
    assert len(found) == (left < 0.9)
    for finding in found:
        assert f"leaves {100 * left:.2g} % at {edge:.0f} mas" in finding.what


def test_wavelengths_as_older_files_state_them(tmp_path: Path) -> None:
    """An image of them, a keyword in µm or one in metres, instead of a table."""
    image = kernel_file(tmp_path / "a.fits", drop=("CWAVEL",))
    with fits.open(image, mode="update") as hdus:
        hdus.append(fits.ImageHDU(np.array([WAVELENGTH]), name="CWAVEL"))
    file = open_kpfits(image)
    assert (file.wavelength_m.tolist(), file.band_m.tolist()) == ([WAVELENGTH], [0.0])
    for key, value in (("CWAVEL", WAVELENGTH), ("HIERARCH ESO INS CWLEN", 1e6 * WAVELENGTH)):
        path = kernel_file(tmp_path / "b.fits", drop=("CWAVEL",))
        with pytest.raises(ab.DataError, match="does not state its wavelength"):
            open_kpfits(path)
        with fits.open(path, mode="update") as hdus:
            hdus[0].header[key] = value
        file = open_kpfits(path)
        assert file.wavelength_m == pytest.approx([WAVELENGTH])
        assert file.band_m.tolist() == [0.0]


def test_one_angle_serves_all_frames_and_several_must_be_as_many(tmp_path: Path) -> None:
    one = kernel_file(tmp_path / "a.fits", frames=3, DETPA=np.array([40.0]))
    np.testing.assert_array_equal(open_kpfits(one).position_angle_deg, 40.0)
    same = kernel_file(tmp_path / "a.fits", frames=3, DETPA=np.array([40.0, 40.0]))
    np.testing.assert_array_equal(open_kpfits(same).position_angle_deg, 40.0)
    for angles in ([40.0, 50.0], []):
        wrong = kernel_file(tmp_path / "b.fits", frames=3, DETPA=np.array(angles))
        with pytest.raises(ab.DataError, match=f"{len(angles)} position angles for 3 frames"):
            open_kpfits(wrong)


def test_kernel_phases_are_told_from_triangles_and_have_no_period(tmp_path: Path) -> None:
    stations = np.array([[0, 1, 2], [3, 3, 3], [1, 1, 2], [2, 1, 1], [1, 2, 1]])
    np.testing.assert_array_equal(stands_alone(stations), [False, True, False, False, False])
    value = np.linspace(-9.0, 9.0, len(PUPIL.kernel))
    likelihood = Likelihood(kernel_observables(kernel_file(tmp_path / "a.fits", value)))
    np.testing.assert_allclose(likelihood.wrapped(value[:, None].copy())[:, 0], value)


def test_the_star_is_named_by_the_first_keyword_that_does(tmp_path: Path) -> None:
    path, names = kernel_file(tmp_path / "a.fits"), []
    for changes in ({}, {"TARGPROP": " ", "OBJECT": "b "}, {"TARGNAME": "c"}, {"TARGET": "d"}):
        with fits.open(path, mode="update") as hdus:
            hdus[0].header.update(changes)
        names.append(open_kpfits(path).target)
    assert names == ["HD 1", "b", "c", "c"]


@pytest.mark.parametrize("wrong", [4.8, 4800.0, 0.0, 9e-8, np.nan, np.inf])
def test_one_wavelength_that_is_not_in_metres_refuses_all(wrong: float) -> None:
    for wavelengths in ([wrong], [4.8e-6, wrong], [wrong, 4.8e-6]):
        with pytest.raises(ab.DataError, match="is not in metres"):
            _wavelengths({"CWAVEL": np.array(wavelengths)}, {}, "a")
    found, band = _wavelengths({"CWAVEL": np.array([1.1e-7, 0.9])}, {}, "a")
    assert (found.tolist(), band.tolist()) == ([1.1e-7, 0.9], [0.0, 0.0])
