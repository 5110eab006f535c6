"""Which mask the fringes of a stage-3 product are of: its (u, v) are of the mask as drawn.

`ami_analyze` fits fringes of a mask under an affine map, and writes baselines of the drawing. What
its fit gives is the visibility half-way between the baselines of its model and those of the
telescope: light off the axis has its envelope with it, and the phase in the middle of both
envelopes is what is measured. The map is in the log that the pipeline keeps in its products.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from amibayes.errors import DataError, UsageError
from amibayes.instrument import load_instrument
from amibayes.oifits.products.recognise import Product
from amibayes.oifits.tables import OITable, plain
from amibayes.units import DEGREE, FloatArray

LOGGED = re.compile(r"mx=(\S+?)\\tmy=(\S+?)[\"'\\].{0,200}?sx=(\S+?)\\tsy=(\S+?)[\"'\\]")
"""Four numbers of the step's log, in the text of the ASDF extension without line breaks."""

DEFAULT_SINCE = (1, 17)
"""Version of the package from which on its source is known: commissioning's map is the default."""

LIKE_DRAWN = 1e-3
"""Baselines are those of the drawing within this share of the longest."""


@dataclass(frozen=True, eq=False)
class ProductMap:
    """The map of the fringes.

    Parameters
    ----------
    on_sky : (2, 2) array
        Times a stated baseline (east, north): that of the fringes.
    known_from : str
        What tells it.
    error : float
        Of each number, by what is not known of the telescope's own map.
    """

    on_sky: FloatArray
    known_from: str
    error: float

    @property
    def changes(self) -> bool:
        """Whether baselines are others."""
        return bool(np.abs(self.on_sky - np.eye(2)).max() > 1e-6)

    @property
    def angle_deg(self) -> float:
        """By how much angles were too large."""
        return float((self.on_sky[0, 1] - self.on_sky[1, 0]) / 2.0 / DEGREE)

    @property
    def uncertainty(self) -> str:
        """What is left of it, in words."""
        return (
            f"angles are uncertain by {self.error / DEGREE:.2f} deg and separations by "
            f"{100.0 * self.error:.2f} % besides the errors of the fit, as a product does not "
            "measure the telescope's own map"
        )


def map_of(product: Product) -> ProductMap | None:
    """The map of a product's fringes; None where the file, or its instrument, does not tell."""
    header = product.oifits.header
    try:
        instrument = load_instrument(
            plain(header.get("INSTRUME", "")), plain(header.get("FILTER", ""))
        )
    except (UsageError, DataError):
        return None
    turn = _drawn_to_sky(product, instrument.mask.holes_m)
    if turn is None:
        return None
    matrix, source = _logged(product), "the pipeline's log in the file"
    if matrix is None and _version(plain(header.get("CAL_VER", ""))) >= DEFAULT_SINCE:
        matrix = instrument.distortion.matrix
        source = "the package's default, as the file has no log of the map"
    if matrix is None:
        return None
    # Half-way between the model's map, which is known, and the telescope's.
    return ProductMap(
        turn @ matrix @ np.linalg.inv(turn), source, 0.5 * instrument.distortion.error
    )


def _logged(product: Product) -> FloatArray | None:
    """Map (2, 2) in image x and y that the log states; None without one, or with two."""
    text = "".join(_text(t) for t in product.oifits.named("ASDF"))
    found = set(LOGGED.findall(re.sub(r"\s+", " ", text)))
    if len(found) != 1:
        return None
    try:
        mx, my, sx, sy = (float(number) for number in found.pop())
    except ValueError:
        return None
    # From the image to the drawing, and y first.
    inverse = np.linalg.inv(np.array([[mx, sx], [sy, my]]))
    return np.asarray(inverse[::-1, ::-1])


def _text(table: OITable) -> str:
    parts = (np.asarray(column) for column in table.columns.values())
    return "".join(p.astype(np.uint8).tobytes().decode("utf-8", "replace") for p in parts)


def _version(text: str) -> tuple[int, ...]:
    return tuple(int(n) for n in re.findall(r"\d+", text)[:2])


def _drawn_to_sky(product: Product, holes_m: FloatArray) -> FloatArray | None:
    """Rotation (2, 2), a mirror too, from the drawing to the stated (u, v); None for others."""
    table = product.table("OI_VIS2")
    if table is None or not {"UCOORD", "VCOORD", "STA_INDEX"} <= set(table.columns):
        return None
    a, b = (np.asarray(table.columns["STA_INDEX"], dtype=int) - 1).T
    uv = np.column_stack([table.columns["UCOORD"], table.columns["VCOORD"]]).astype(float)
    if min(a.min(), b.min()) < 0 or max(a.max(), b.max()) >= len(holes_m):
        return None
    drawn = holes_m[b] - holes_m[a]
    turn = np.linalg.lstsq(drawn, uv, rcond=None)[0].T
    near = np.abs(drawn @ turn.T - uv).max() <= LIKE_DRAWN * np.abs(uv).max()
    upright = np.abs(turn @ turn.T - np.eye(2)).max() <= LIKE_DRAWN
    return turn if near and upright else None


PAIRS = tuple((f"U{k}COORD", f"V{k}COORD") for k in ("", 1, 2, 3))
"""Columns of baselines in all tables."""


def mapped_columns(found: ProductMap, table: OITable) -> dict[str, FloatArray]:
    """Baselines of a table, of the fringes; empty where there are none."""
    new: dict[str, FloatArray] = {}
    for east, north in PAIRS:
        if {east, north} <= set(table.columns):
            stated = np.stack([table.columns[east], table.columns[north]]).astype(float)
            new[east], new[north] = np.tensordot(found.on_sky, stated, axes=1)
    return new
