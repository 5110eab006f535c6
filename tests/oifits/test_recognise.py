"""Which files are products of the jwst pipeline."""

from __future__ import annotations

import numpy as np
from jwst_products import binary, integrations, product

from amibayes.oifits.products import product_of
from amibayes.oifits.tables import open_oifits


def test_products_have_one_table_of_each_kind(tmp_path) -> None:
    """With two tables of V² the repairs would not know which one they belong to."""
    rng = np.random.default_rng(1)
    made = product("ami-oi", integrations(binary(0.1, 120.0, -80.0), 0.02, 20, rng))
    made.writeto(tmp_path / "one.fits")
    made.append(made["OI_VIS2"].copy())
    made.writeto(tmp_path / "two.fits")
    assert product_of(open_oifits(tmp_path / "one.fits")) is not None
    assert product_of(open_oifits(tmp_path / "two.fits")) is None
