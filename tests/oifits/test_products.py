"""JWST stage-3 products: recognised by content, repaired, and their errors true.

The truth is that of visibilities drawn here; genuine files of jwst 3.0 are compared where the
public data are at hand.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.io import fits
from jwst_products import (
    MASK,
    as_oifits,
    baselines,
    binary,
    columns_of,
    integrations,
    product,
    with_other_numbers,
    write_product,
)

from amibayes.errors import DataError, UsageError
from amibayes.extraction.reading import check_together, read_observations
from amibayes.instrument import load_instrument
from amibayes.oifits import read_oifits, write_oifits
from amibayes.oifits.audit import audit, repair
from amibayes.oifits.products import open_products, pointing_of, product_of, read_product
from amibayes.oifits.products.reading import SAME_ORIENTATION_RAD, _alike
from amibayes.oifits.products.repairs import repaired, vis2_error, with_columns
from amibayes.oifits.tables import open_oifits
from amibayes.units import MAS

SIGMA = 0.02
KINDS = ("ami-oi", "amimulti-oi", "aminorm-oi")


def draws(rng: np.random.Generator, n: int = 20, contrast: float = 0.1) -> np.ndarray:
    return integrations(binary(contrast, 120.0, -80.0), SIGMA, n, rng)


def star(rng: np.random.Generator, n: int = 20) -> np.ndarray:
    return integrations(np.full(21, 0.95 + 0j), SIGMA, n, rng)


def made(kind: str, path: Path, rng: np.random.Generator, n: int = 20) -> Path:
    calibrator = star(rng, n) if kind == "aminorm-oi" else None
    return write_product(path, kind, draws(rng, n), calibrator)


@pytest.mark.parametrize("kind", KINDS)
def test_a_kind_is_told_by_content(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    found = product_of(open_oifits(made(kind, tmp_path / "anything.fits", rng)))
    assert found is not None
    assert found.kind == kind
    assert found.n_integrations == 20


def test_other_files_are_no_products(tmp_path: Path, rng: np.random.Generator) -> None:
    data = read_oifits(made("ami-oi", tmp_path / "a.fits", rng))
    write_oifits(tmp_path / "b.oifits", data)
    assert read_product(as_oifits(tmp_path / "c.fits", "ami-oi", draws(rng))) is not None
    assert product_of(open_oifits(tmp_path / "b.oifits")) is None


@pytest.mark.parametrize("name", ["OI_VIS2", "OI_T3"])
def test_products_whose_tables_have_no_rows_are_refused(
    name: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    path = made("ami-oi", tmp_path / "a.fits", rng)
    with fits.open(path, mode="update") as hdus:
        hdus[name].data = hdus[name].data[:0]
    with pytest.raises(DataError, match="without one OI_VIS2 and one OI_T3 with rows"):
        read_oifits(path)


@pytest.mark.parametrize("kind", KINDS)
def test_values_are_those_of_the_source(
    kind: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    truth = binary(0.1, 120.0, -80.0)
    found = read_oifits(made(kind, tmp_path / "a.fits", rng))
    scale = 0.95**2 if kind == "aminorm-oi" else 1.0
    ij, jk, ik = truth[MASK.triangle_baselines.T]
    closure = np.angle(ij * jk * ik.conj())
    off = np.concatenate([found.vis2.value - np.abs(truth) ** 2 / scale,
                          found.closure_phase.value - closure])  # fmt: skip
    sigma = np.concatenate(found.errors)
    assert np.abs(off / sigma).max() < 6.0
    assert np.allclose(found.vis2.u_m[:, 0], baselines()[:, 0])
    assert np.allclose(found.vis2.mjd, 60000.17)
    assert found.vis2.integration_s[0] == pytest.approx(20 * 0.7544)
    assert found.vis2.band_m[0] == pytest.approx(3.02e-7, rel=0.01)
    assert len(np.unique(found.vis2.channel)) == 1
    assert len(found.vis2) == 21
    assert found.n_independent == 36


def test_each_repair_is_named(tmp_path: Path, rng: np.random.Generator) -> None:
    notes = " ".join(read_oifits(made("ami-oi", tmp_path / "a.fits", rng)).notes)
    for word in ("VIS2ERR times 4.47", "T3PHIERR divided", "EXPMID", "EFF_BAND", "INT_TIME"):
        assert word in notes
    many = " ".join(read_oifits(made("amimulti-oi", tmp_path / "b.fits", rng)).notes)
    assert "20 integrations" in many
    assert "T3PHIERR" not in many
    assert "one calibrator" in " ".join(
        read_oifits(made("aminorm-oi", tmp_path / "c.fits", rng)).notes
    )


def test_the_band_of_a_filter_that_is_not_known_is_widened_alike(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """The stated width is that of F480M's product: within 1 % of the filter's at half height."""
    unknown = product("ami-oi", draws(rng))
    unknown[0].header["FILTER"] = "F999X"
    unknown.writeto(tmp_path / "a.fits")
    low, high = load_instrument("niriss", "F480M").bandpass.half_power_m
    found = read_oifits(tmp_path / "a.fits")
    np.testing.assert_allclose(found.vis2.band_m, high - low, rtol=0.01)
    np.testing.assert_allclose(found.closure_phase.band_m, high - low, rtol=0.01)


def quoted_over_true(
    kind: str, path: Path, rng: np.random.Generator, n: int
) -> tuple[float, float]:
    """Root mean square of quoted errors over the scatter of the values, V² and closure phase."""
    values, variances = [], []
    layout = open_oifits(made(kind, path, rng))
    for _ in range(n):
        calibrator = star(rng) if kind == "aminorm-oi" else None
        drawn = with_other_numbers(layout, columns_of(kind, draws(rng), calibrator))
        found = read_product(drawn)
        assert found is not None
        values.append(found.data)
        variances.append(found.covariance.variance)
    true, quoted = np.var(values, axis=0, ddof=1), np.mean(variances, axis=0)
    return (
        float(np.sqrt(quoted[:21].sum() / true[:21].sum())),
        float(np.sqrt(quoted[21:].sum() / true[21:].sum())),
    )


@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_nearly_true(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    # 60 draws of 21 and 15 independent data: 2.4 and 2.4 % Monte Carlo error (4.5 sigma).
    for ratio in quoted_over_true(kind, tmp_path / "a.fits", rng, 60):
        assert ratio == pytest.approx(1.0, abs=0.11)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_errors_are_true(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    # 1500 draws: 0.47 % of Monte Carlo error, hence 6 sigma.
    for ratio in quoted_over_true(kind, tmp_path / "a.fits", rng, 1500):
        assert 0.97 < ratio < 1.03


def test_closure_errors_of_faint_fringes_are_those_of_their_noise(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """Target and calibrator of |V| = 0.6: three phases each, of errors σ/|V| and their mean's."""
    two = [integrations(np.full(21, 0.6 + 0j), SIGMA, 200, rng) for _ in range(2)]
    found = read_oifits(write_product(tmp_path / "a.fits", "aminorm-oi", *two))
    quoted = np.sqrt(found.covariance.variance[21:].mean())
    # 2 · 200 integrations of 35 triangles tell a scatter to 1 to 4 %.
    assert quoted == pytest.approx(np.sqrt(2 * 3 / 200) * SIGMA / 0.6, rel=0.1)


@pytest.mark.parametrize("sigmas", [(SIGMA, SIGMA), (SIGMA, 0.3 * SIGMA), (0.3 * SIGMA, SIGMA)])
@pytest.mark.parametrize("lengths", [(0.4, 0.95), (0.95, 0.4)])
def test_closure_errors_of_unlike_fringes_are_those_of_their_noise(
    lengths: tuple[float, float],
    sigmas: tuple[float, float],
    tmp_path: Path,
    rng: np.random.Generator,
) -> None:
    """Each has σ √(Σ 1/|V|²) / √n of its own, whatever the other's |V|."""
    n, spread = 200, rng.uniform(0.6, 1.0, (2, 21))
    two = [
        integrations(length * own + 0j, sigma, n, rng)
        for length, own, sigma in zip(lengths, spread, sigmas, strict=True)
    ]
    found = read_oifits(write_product(tmp_path / "a.fits", "aminorm-oi", *two))
    legs = MASK.triangle_baselines
    true = sum(
        sigma**2 / n * ((length * own[legs]) ** -2).sum(axis=1)
        for length, own, sigma in zip(lengths, spread, sigmas, strict=True)
    )
    # Triangles share baselines: of the stated variances what 15 independent ones tell.
    quoted = found.covariance.variance[21:]
    assert np.sqrt(quoted.sum() / true.sum()) == pytest.approx(1.0, abs=0.06)


@pytest.mark.slow
def test_closure_errors_of_unlike_fringes_are_true(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    layout = open_oifits(made("aminorm-oi", tmp_path / "a.fits", rng))
    shape, other = (rng.uniform(0.3, 0.5, 21) + 0j, rng.uniform(0.8, 1.0, 21) + 0j)
    values, variances = [], []
    for _ in range(1500):
        pair = (integrations(mean, SIGMA, 20, rng) for mean in (shape, other))
        found = read_product(with_other_numbers(layout, columns_of("aminorm-oi", *pair)))
        assert found is not None
        values.append(found.data[21:])
        variances.append(found.covariance.variance[21:])
    true, quoted = np.var(values, axis=0, ddof=1), np.mean(variances, axis=0)
    assert 0.97 < np.sqrt(quoted.sum() / true.sum()) < 1.03


def test_noise_bias_of_vis2_is_taken_off(tmp_path: Path, rng: np.random.Generator) -> None:
    noisy = integrations(np.full(21, 0.5 + 0j), 0.1, 400, rng)
    found = read_oifits(write_product(tmp_path / "a.fits", "amimulti-oi", noisy))
    # bias 2 sigma² = 0.02; mean of 21 V² known to 2·0.5·0.1/√(400·21)
    assert found.vis2.value.mean() == pytest.approx(0.25, abs=0.005)


def test_phases_beyond_half_a_turn_are_wrapped(tmp_path: Path, rng: np.random.Generator) -> None:
    turned = draws(rng) * np.exp(1j * rng.uniform(-2.0, 2.0, 21))
    other = star(rng) * np.exp(1j * rng.uniform(-2.0, 2.0, 21))
    found = read_oifits(write_product(tmp_path / "a.fits", "aminorm-oi", turned, other))
    assert np.abs(found.closure_phase.value).max() <= np.pi
    assert any("wrapped" in note for note in found.notes)


@pytest.mark.parametrize("kind", ["ami-oi", "amimulti-oi"])
def test_one_integration_has_no_errors(kind: str, tmp_path: Path, rng: np.random.Generator) -> None:
    with pytest.raises(DataError, match=r"integration.*nothing tells its errors"):
        read_oifits(made(kind, tmp_path / "a.fits", rng, 1))


def test_dithers_are_averaged_together(tmp_path: Path, rng: np.random.Generator) -> None:
    one = write_product(tmp_path / "a.fits", "amimulti-oi", draws(rng))
    two = write_product(tmp_path / "b.fits", "amimulti-oi", draws(rng), turned_deg=37.302,
                        EXPSTART=60000.2, EXPMID=60000.21, EXPEND=60000.22)  # fmt: skip
    far = write_product(tmp_path / "c.fits", "amimulti-oi", draws(rng), turned_deg=47.3,
                        EXPSTART=60001.2, EXPMID=60001.21, EXPEND=60001.22)  # fmt: skip
    found = read_observations([one, two, far])
    assert [f.n_integrations for f in found] == [40, 20]
    assert str(one) in found[0].source
    assert str(two) in found[0].source


def test_an_exposure_is_not_given_twice(tmp_path: Path, rng: np.random.Generator) -> None:
    one = made("ami-oi", tmp_path / "a.fits", rng)
    two = made("amimulti-oi", tmp_path / "b.fits", rng)
    with pytest.raises(UsageError, match=r"same exposure as .*a\.fits"):
        check_together([one, two])
    with pytest.raises(UsageError, match="same exposure"):
        check_together([one], [two])


def test_nothing_is_calibrated_twice(tmp_path: Path, rng: np.random.Generator) -> None:
    done = made("aminorm-oi", tmp_path / "a.fits", rng)
    other = write_product(tmp_path / "b.fits", "ami-oi", star(rng), TARGPROP="STAR")
    with pytest.raises(UsageError, match="calibrated already"):
        check_together([done], [other])
    assert check_together([done]) == ()
    assert "not calibrated" in check_together([other])[0]


CODES = {
    "ami-oi": {"product-vis2-error", "product-closure-error", "product-phase-error",
               "product-date", "product-integration-time", "product-band", "product-stations",
               "product-table", "product-table-order", "product-array", "product-proper-motion"},
    "amimulti-oi": {"product-integrations", "product-flag", "product-date", "product-band"},
    "aminorm-oi": {"product-vis2-error", "product-partly-calibrated", "product-one-calibrator"},
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_an_audit_finds_every_fault_and_mends(
    kind: str, tmp_path: Path, rng: np.random.Generator
) -> None:
    path = made(kind, tmp_path / "a.fits", rng)
    found = audit(path)
    assert {f.code for f in found.findings} >= CODES[kind]
    repair(found.oifits, list(found.findings), tmp_path / "b.fits")
    copy, data = read_oifits(tmp_path / "b.fits"), read_oifits(path)
    # The star of these tests has V² of 0.9, so that calibrated ones exceed 1.
    assert {f.code for f in audit(tmp_path / "b.fits").findings} <= {"vis2-above-one"}
    assert np.array_equal(copy.data, data.data)
    assert np.allclose(copy.covariance.dense(), data.covariance.dense(), rtol=1e-12)


def test_an_audit_of_one_integration_or_of_roll_0(tmp_path: Path, rng: np.random.Generator) -> None:
    path = write_product(tmp_path / "a.fits", "amimulti-oi", draws(rng, 1), ROLL_REF=0.0)
    found = audit(path).findings
    assert {"product-no-errors", "product-roll-zero"} <= {f.code for f in found}
    assert not any(f.certain for f in found)


def test_most_of_a_centre_is_common_to_star_and_calibrator(data: Path) -> None:
    """Of a quotient it is not known: by the star's alone, a companion moved by 1.6 mas."""
    star, calibrator, quotient = (
        pointing_of(open_products([str(data / "jwst" / f"sima{name}-oi.fits")])[0]) / MAS
        for name in ("-target_amimulti", "-calibrator_amimulti", "_aminorm")
    )
    # 1 % of the light 198 mas away moves the centroid by 2 mas.
    assert 1.0 < np.hypot(*(star - calibrator)) < 3.0 < 4.0 < np.hypot(*calibrator)
    assert (quotient == 0.0).all()


ROUTES = {
    "integrations": (["sima-target_amimulti-oi.fits"], ["sima-calibrator_amimulti-oi.fits"]),
    "averages": (["sima-target_a3001_ami-oi.fits"], ["sima-calibrator_a3001_psf-ami-oi.fits"]),
    "calibrated": (["sima_aminorm-oi.fits"], []),
}


@pytest.mark.parametrize("route", ROUTES)
def test_genuine_products_give_the_companion(route: str, data: Path) -> None:
    import amibayes
    from amibayes.calibration import calibrate

    targets, calibrators = ([str(data / "jwst" / n) for n in names] for names in ROUTES[route])
    check_together(targets, calibrators)
    read = read_observations(targets)
    if calibrators:
        rng = np.random.default_rng(1)
        calibrated = calibrate(read, read_observations(calibrators), rng=rng).observables
    else:
        (calibrated,) = read
    found = amibayes.search(amibayes.Likelihood(calibrated), separation_mas=(80.0, 400.0)).companion
    assert found.separation_mas == pytest.approx(198.8, abs=0.5)
    assert found.position_angle_deg == pytest.approx(305.57, abs=0.15)
    assert found.contrast == pytest.approx(0.01, abs=0.0001)


def test_errors_of_negative_vis2_are_positive(tmp_path: Path, rng: np.random.Generator) -> None:
    """σ(V²) = 2|V|·σ(|V|) = 2|V²|·σ(|V|)/|V|, also where noise made V² negative."""
    found = product_of(open_oifits(made("ami-oi", tmp_path / "a.fits", rng)))
    assert found is not None
    table, amplitude = found.table("OI_VIS2"), found.table("OI_VIS")
    value = table.columns["VIS2DATA"] * np.where(np.arange(21) % 3, 1.0, -1.0)
    sigma = vis2_error(found, with_columns(table, {"VIS2DATA": value}))
    ratio = amplitude.columns["VISAMPERR"] / amplitude.columns["VISAMP"]
    np.testing.assert_allclose(sigma, 2.0 * np.abs(value) * ratio)


@pytest.mark.parametrize(
    ("keywords", "seconds"),
    [({}, 20 * 0.7544), ({"EFFEXPTM": 7.0}, 7.0), ({"EFFEXPTM": 0.0}, 20 * 0.7544),
     ({"EFFEXPTM": "x", "EFFINTTM": 0.5}, 10.0), ({"EFFEXPTM": 0.0, "EFFINTTM": 0.0}, 0.7544)],
)  # fmt: skip
def test_integration_time_is_that_of_the_exposure(
    keywords: dict[str, object], seconds: float, tmp_path: Path, rng: np.random.Generator
) -> None:
    oifits = as_oifits(tmp_path / "a.fits", "ami-oi", draws(rng), **keywords)
    found = product_of(oifits)
    assert found is not None
    for table in repaired(found)[0].named("OI_VIS2"):
        np.testing.assert_allclose(table.columns["INT_TIME"], seconds)


def test_exposures_of_one_star_belong_together_and_those_of_no_name_do_not() -> None:
    uv = np.array([[3.0, 4.0], [-2.0, 1.0]])

    def product(header: dict[str, str], places: np.ndarray = uv) -> SimpleNamespace:
        columns = {"UCOORD": places[:, 0], "VCOORD": places[:, 1]}
        return SimpleNamespace(
            oifits=SimpleNamespace(header={"INSTRUME": "NIRISS", "FILTER": "F480M"} | header),
            table=lambda name: SimpleNamespace(columns=columns) if name == "OI_VIS2" else None,
        )

    one = product({"TARGPROP": "HD 1"})
    nearly, turned = uv @ turn(0.5 * SAME_ORIENTATION_RAD), uv @ turn(3.0 * SAME_ORIENTATION_RAD)
    for other, together in (
        (product({"TARGPROP": "hd 1"}), True),
        (product({"TARGPROP": "HD 1"}, nearly), True),
        (product({"TARGPROP": "HD 1"}, turned), False),
        (product({"TARGPROP": "HD 1"}, uv[:1]), False),
        (product({"TARGPROP": "HD 2"}), False),
        (product({"TARGPROP": "HD 1", "TARGNAME": "b"}), False),
        (product({"TARGPROP": "HD 1", "FILTER": "F430M"}), False),
        (product({"TARGPROP": "HD 1", "INSTRUME": "X"}), False),
    ):
        assert _alike(one, other) == _alike(other, one) == together  # type: ignore[arg-type]
    assert not _alike(product({}), product({}))  # type: ignore[arg-type]
    assert _alike(product({"TARGNAME": "b"}), product({"TARGNAME": "b"}))  # type: ignore[arg-type]


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
