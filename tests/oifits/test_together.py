"""Which files may be given together, and where a product's light was."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from jwst_products import EXPMID, as_oifits, baselines, binary, integrations, with_other_numbers

from amibayes.errors import UsageError
from amibayes.oifits.products import product_of
from amibayes.oifits.products.pointing import place_of, pointing_of
from amibayes.oifits.products.recognise import exposure_of
from amibayes.oifits.products.together import (
    Contents,
    refuse_calibrating_again,
    refuse_twice,
    uncalibrated,
)
from amibayes.units import MAS

TIMES = {"EXPSTART": 60000.0, "EXPEND": 60000.01, "TARGPROP": "STAR"}
PRODUCT = {"DATAMODL": "AmiOIModel"}
NAMES = ("PRIMARY", "OI_VIS2", "OI_T3")


def file(path: str, names: tuple[str, ...] = ("SCI",), *columns: str, **header: Any) -> Contents:
    return Contents(path, TIMES | header, names, (), frozenset(columns))


def test_contents_say_what_a_file_is() -> None:
    assert not file("a").has_oifits
    assert file("a", ("X", "OI_CORR")).has_oifits
    assert file("a_ramp.fits").is_ramp
    assert not file("a_rate.fits").is_ramp
    # The name that the pipeline gave it goes before that of the file.
    assert file("copy.fits", FILENAME="a_ramp.fits").is_ramp
    assert not file("a_ramp.fits", FILENAME="a_rate.fits").is_ramp
    assert file("a", INTSTART=3, INTEND=5).integrations == (3, 5)
    for wrong in ({"INTSTART": 3}, {"INTSTART": 3, "INTEND": "5"}, {"INTSTART": True, "INTEND": 5}):
        assert file("a", **wrong).integrations is None
    assert file("a", NAMES, **PRODUCT).is_product
    assert not file("a", ("OI_VIS",), **PRODUCT).is_product
    normalized = file("a", NAMES, "PISTON_T", "PISTON_C", **PRODUCT)
    assert normalized.is_normalized
    assert not file("a", NAMES, "PISTON_T", **PRODUCT).is_normalized
    assert file("a", NAMES, **PRODUCT, S_AMINOR="COMPLETE").is_normalized
    assert not file("a", S_AMINOR="COMPLETE").is_normalized


SEGMENT = {"INTSTART": 1, "INTEND": 4}


@pytest.mark.parametrize(
    ("one", "other", "refused"),
    [
        (file("a"), file("b"), False),
        (file("a_ramp.fits"), file("b"), True),
        (file("a_ramp.fits"), file("b_ramp.fits"), False),
        (file("a", **SEGMENT), file("b"), False),
        (file("a", **SEGMENT), file("b", INTSTART=5, INTEND=8), False),
        (file("a", INTSTART=5, INTEND=8), file("b", **SEGMENT), False),
        (file("a", **SEGMENT), file("b", INTSTART=4, INTEND=8), True),
        (file("a", INTSTART=4, INTEND=8), file("b", **SEGMENT), True),
        (file("a", INTSTART=2, INTEND=3), file("b", **SEGMENT), True),
        (file("a_ramp.fits", **SEGMENT), file("b", INTSTART=5, INTEND=8), False),
        (file("a", NAMES, **PRODUCT), file("b"), True),
        (file("a"), file("b", NAMES, **PRODUCT), True),
        (file("a", NAMES, **PRODUCT, **SEGMENT), file("b", INTSTART=5, INTEND=8), True),
        (file("a", NAMES, **PRODUCT), file("b", EXPSTART=60000.1), False),
        (file("a", NAMES, **PRODUCT), file("b", EXPEND=60000.02), False),
        (file("a", NAMES, **PRODUCT), file("b", TARGPROP="other"), False),
        (file("a", NAMES, **PRODUCT), file("b", TARGPROP="star "), True),
        (file("a", NAMES, **PRODUCT), file("b", DETECTOR="NIS"), False),
        (file("a", NAMES, **PRODUCT, EXPSTART=None), file("b", EXPSTART=None), False),
    ],
)  # fmt: skip
def test_an_exposure_counts_once(one: Contents, other: Contents, refused: bool) -> None:
    between = file("c", EXPSTART=61000.0, EXPEND=61000.1)
    files = [between, one, other]
    if not refused:
        refuse_twice(files)
        return
    with pytest.raises(UsageError, match=f"^{other.path}: is of the same exposure as {one.path}"):
        refuse_twice(files)


def test_times_tell_an_exposure_to_a_tenth_of_a_second() -> None:
    same = [exposure_of(TIMES | {"EXPSTART": 60000.0 + s / 86400.0}) for s in (0.0, 0.03, 0.3)]
    assert same[0] == same[1] != same[2]
    for wrong in (0.0, -1.0, np.nan, "60000"):
        assert exposure_of(TIMES | {"EXPEND": wrong}) is None
    found = exposure_of({"EXPSTART": 1.0, "EXPEND": 2.0, "TARGNAME": " A B "})
    assert found is not None
    assert (found.start, found.end, found.target) == (1.0, 2.0, "a b")


def test_calibrated_products_take_no_calibrators() -> None:
    raw, done = (file(p, NAMES, **PRODUCT, **more) for p, more in
                 (("raw", {}), ("done", {"S_AMINOR": "COMPLETE"})))  # fmt: skip
    refuse_calibrating_again([done], [])
    refuse_calibrating_again([raw], [raw])
    for targets, calibrators in (([raw, done], [raw]), ([raw], [raw, done])):
        with pytest.raises(UsageError, match=r"^done: is calibrated already \(jwst aminorm-oi\)"):
            refuse_calibrating_again(targets, calibrators)
    assert uncalibrated([raw, done, file("x"), raw], []) \
        == ("raw, raw: not calibrated (jwst); give its calibrators with --cal",)  # fmt: skip
    assert uncalibrated([raw], [raw]) == ()
    assert uncalibrated([done, file("x")], []) == ()


@pytest.mark.parametrize(
    ("category", "raw"),
    [
        ("TARGET_OIDATA_RAW", True),
        ("TARGET_OIDATA_CALIBRATED", False),
        ("TARGET_RAW_INT", True),
        ("TARGET_CAL_INT", False),
        ("SINGLE_SCI_VIS", True),
        ("SINGLE_SCI_VIS_CALIBRATED", False),
        ("VIS_SINGLE_CALIBRATED", False),
        ("SCIENCE_REDUCED", True),
    ],
)
def test_categories_of_eso_tell_what_is_calibrated(category: str, raw: bool) -> None:
    """Those of PIONIER, MATISSE, GRAVITY and AMBER; V² with the transfer function look binary."""
    said = uncalibrated([file("a", **{"ESO PRO CATG": category})], [])
    expected = f"a: not calibrated (ESO PRO CATG {category}); give its calibrators with --cal"
    assert said == ((expected,) if raw else ())
    assert not uncalibrated([file("a", **{"ESO PRO CATG": category})], [file("b")])


def pointed(place_mas: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Phases at (u, v) of light that stands elsewhere than the model's centre."""
    uv = baselines() / 4.8e-6
    return np.exp(-2j * np.pi * uv @ (np.array(place_mas) * MAS)), uv


@pytest.mark.parametrize("place", [(0.0, 0.0), (31.7, -12.2), (-150.0, 188.0), (199.0, -199.0)])
def test_phases_of_a_star_tell_its_place(place: tuple[float, float]) -> None:
    fringe, uv = pointed(place)
    weight = np.random.default_rng(1).uniform(0.3, 1.0, len(uv))
    np.testing.assert_allclose(place_of(weight * fringe, uv) / MAS, place, atol=1e-6)


def test_bright_fringes_tell_the_place_better() -> None:
    """Least squares of phases by amplitudes, here by normal equations."""
    fringe, uv = pointed((20.0, 10.0))
    rng = np.random.default_rng(2)
    turned, weight = 0.05 * rng.normal(size=len(uv)), rng.uniform(0.1, 1.0, len(uv))
    design = 2.0 * np.pi * uv * weight[:, None]
    moved = -np.linalg.solve(design.T @ design, design.T @ (turned * weight))
    found = place_of(weight * fringe * np.exp(1j * turned), uv)
    np.testing.assert_allclose(found, np.array([20.0, 10.0]) * MAS + moved, atol=1e-6 * MAS)
    np.testing.assert_array_equal(place_of(np.empty(0, complex), np.empty((0, 2))), np.zeros(2))


@pytest.mark.parametrize("kind", ["ami-oi", "amimulti-oi", "aminorm-oi"])
def test_the_place_of_a_products_light(kind: str, tmp_path: Path) -> None:
    """Of integrations, of means, and of quotients, which tell none."""
    rng = np.random.default_rng(3)
    turn = pointed((40.0, -25.0))[0]
    # Light of one wavelength, the product's; (u, v) of the helper are at 4.8 µm.
    turn = np.exp(1j * np.angle(turn) * 4.8 / 4.8195)
    seen = integrations(binary(0.0, 0.0, 0.0) * turn, 1e-4, 9, rng)
    other = integrations(binary(0.0, 0.0, 0.0), 1e-4, 9, rng) if kind == "aminorm-oi" else None
    oifits = as_oifits(tmp_path / "a.fits", kind, seen, other)
    product = product_of(oifits)
    assert product is not None
    expected = (0.0, 0.0) if kind == "aminorm-oi" else (40.0, -25.0)
    np.testing.assert_allclose(pointing_of(product) / MAS, expected, atol=0.05)
    assert exposure_of(oifits.header) is not None
    assert abs(oifits.header["EXPMID"] - EXPMID) < 1e-9
    rows = product.table("OI_VIS")
    assert rows is not None
    columns = {name: np.array(rows.columns[name]) for name in ("VISPHI", "UCOORD")}
    columns["VISPHI"][4], columns["UCOORD"][7] = np.nan, np.nan
    spoilt = replace(product, oifits=with_other_numbers(oifits, {"OI_VIS": columns}))
    np.testing.assert_allclose(pointing_of(spoilt) / MAS, expected, atol=0.05)
    for without in ("OI_VIS", "OI_WAVELENGTH"):
        tables = tuple(t for t in oifits.tables if t.name != without)
        less = replace(product, oifits=replace(oifits, tables=tables))
        np.testing.assert_array_equal(pointing_of(less), np.zeros(2))
