"""Baselines of products whose fringes were fitted under a map of the mask."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from jwst_products import MASK, baselines, binary, integrations, write_product

import amibayes
from amibayes.instrument import load_instrument
from amibayes.oifits.audit import audit
from amibayes.oifits.products.mask_map import map_of
from amibayes.oifits.products.reading import read_oifits
from amibayes.oifits.products.recognise import product_of
from amibayes.oifits.tables import open_oifits

COMMISSIONED = (0.99282, 0.99854, 0.00618605, -0.00727008)
BUILT = load_instrument("niriss", "F480M").as_built().mask


@pytest.mark.parametrize("affine", [COMMISSIONED, None], ids=["log", "default"])
@pytest.mark.parametrize("kind", ["ami-oi", "amimulti-oi"])
def test_baselines_are_those_of_the_fringes(
    kind: str, affine: tuple[float, ...] | None, tmp_path: Path, rng: np.random.Generator
) -> None:
    seen = integrations(binary(0.1, 180.0, -120.0, mask=BUILT), 0.003, 20, rng)
    path = write_product(tmp_path / "a.fits", kind, seen, affine=affine)
    found = read_oifits(path)
    uv = np.column_stack([found.vis2.u_m[:, 0], found.vis2.v_m[:, 0]])
    np.testing.assert_allclose(uv, baselines(mask=BUILT), atol=2e-4)
    sides = found.closure_phase
    np.testing.assert_allclose(
        np.abs([sides.u_m[:, 0], sides.v_m[:, 0]]).max(), np.abs(uv).max(), rtol=1e-3
    )
    companion = amibayes.search(amibayes.Likelihood(found), separation_mas=(80.0, 400.0)).companion
    off = np.array([companion.east_mas - 180.0, companion.north_mas + 120.0])
    errors = np.array([companion.east_error_mas, companion.north_error_mas])
    assert np.abs(off / errors).max() < 4.5
    # 216 mas turned by 0.39 deg are 1.5 mas: the errors tell that.
    assert errors.max() < 0.3
    (note,) = [n for n in found.notes if "(u, v) made those" in n]
    assert ("log" in note) == (affine is not None) or "no log" in note
    assert "0.09 deg" in note


def test_a_map_that_was_given_is_read_in_the_log(tmp_path: Path, rng: np.random.Generator) -> None:
    seen = integrations(np.ones(21) + 0j, 0.01, 5, rng)
    turned = (1.0, 1.0, -0.01, 0.01)  # of a user who had his own
    path = write_product(tmp_path / "a.fits", "ami-oi", seen, affine=turned)
    product = product_of(open_oifits(path))
    assert product is not None
    found = map_of(product)
    assert found is not None
    # Points of the image are turned by 0.01 in axes (y, x) to those of the drawing, and the sky is
    # the mirror image of (x, y).
    np.testing.assert_allclose(found.on_sky, [[1.0, 0.01], [-0.01, 1.0]], atol=2e-4)
    same = write_product(tmp_path / "b.fits", "ami-oi", seen)
    data = read_oifits(same)
    np.testing.assert_allclose(data.vis2.u_m[:, 0], baselines()[:, 0])
    assert any("0.09 deg" in note for note in data.notes)
    assert "product-mask-map" not in {f.code for f in audit(same).findings}
    assert "product-mask-map" in {f.code for f in audit(path).findings}


def test_a_product_that_tells_no_map_is_warned_of(tmp_path: Path, rng: np.random.Generator) -> None:
    seen = integrations(np.ones(21) + 0j, 0.01, 5, rng)
    path = write_product(tmp_path / "a.fits", "ami-oi", seen, affine=None, CAL_VER="1.8.5")
    data = read_oifits(path)
    np.testing.assert_allclose(data.vis2.u_m[:, 0], baselines()[:, 0])
    assert any("may be off by 0.4 deg" in note for note in data.notes)


def test_a_fit_with_another_mask_sees_the_companion_half_way() -> None:
    """Least squares of fringes of one mask to the image of another, written out for a baseline."""
    n, envelope, reach = 81, 18.0, np.arange(81) - 40.0
    y, x = np.meshgrid(reach, reach, indexing="ij")
    true, model = np.array([0.21, 0.08]), np.array([0.2115, 0.0788])  # cycles per pixel
    place = np.array([2.5, -1.5])

    def light(at: np.ndarray, phase: np.ndarray) -> np.ndarray:
        beam = np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2.0 * envelope**2 / 2.35**2))
        turn = 2.0 * np.pi * (phase[0] * (x - at[0]) + phase[1] * (y - at[1]))
        return np.asarray(beam * (1.0 + np.cos(turn)))

    beam = np.exp(-(x**2 + y**2) / (2.0 * envelope**2 / 2.35**2))
    turn = 2.0 * np.pi * (model[0] * x + model[1] * y)
    design = np.stack([beam, beam * np.cos(turn), beam * np.sin(turn)]).reshape(3, n * n).T

    def fitted(image: np.ndarray) -> complex:
        # The fit is linear in the image: light of each source is fitted by itself.
        _, real, imaginary = np.linalg.lstsq(design, image.ravel(), rcond=None)[0]
        return complex(real, imaginary)

    seen = fitted(light(place, true)) / fitted(light(np.zeros(2), true))
    half = 2.0 * np.pi * (0.5 * (true + model) @ place)
    assert np.angle(seen * np.exp(-1j * half)) == pytest.approx(0.0, abs=0.004)
    # What either mask alone would give is farther off.
    assert abs(2.0 * np.pi * (0.5 * (true - model) @ place)) > 0.01
    assert MASK.n_baselines == 21
