"""The modelled image on cells finer than the pixels, to be put anywhere between them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from amibayes.extraction.view import View
from amibayes.optics import fringe_image
from amibayes.optics.sampling import fine_sampling, fine_size, lattice_products, shifted_images
from amibayes.units import FloatArray, SingleArray

COARSER = 0.75
"""What it serves need not be known to better than the interpolation's 1e-6 at this sampling."""

FARTHEST = 1.8
"""It can be moved this far, in units of the field: nearly to the first null of a hole's image."""


@dataclass(frozen=True, eq=False)
class FineImage:
    """An image on fine cells, and the view it is of."""

    view: View
    cells: SingleArray
    oversample: int

    def moved(self, by_px: FloatArray) -> SingleArray:
        """Images (n, n_y, n_x) of the view, the star moved by (n, 2) from its centre."""
        places = by_px + np.array(self.view.centre_px)
        return shifted_images(self.cells, self.oversample, self.view.shape, places)

    def on_lattice(self, operator: FloatArray, step: int, half: int) -> SingleArray:
        """`lattice_products` (m, 2·half + 1, 2·half + 1) of an operator (n_pixels, m)."""
        view = self.view
        rows = np.ascontiguousarray(operator.T, dtype=np.float32).reshape(-1, *view.shape)
        return lattice_products(self.cells, self.oversample, rows, view.centre_px, step, half)


def fine_image(view: View, coefficients: FloatArray, reach_px: float | None = None) -> FineImage:
    """Make the image of coefficients (1 + 2·n_baselines,) of the view's fringe model.

    It can be moved by ``reach_px``, as far as light can be told to come from if not given.
    """
    instrument, channels = view.instrument, view.channels
    extent = instrument.mask.rotated(view.rotation_rad).extent_m
    pixel = instrument.pixel_scale_rad
    over = fine_sampling(COARSER * pixel * extent / float(channels.wavelength_m.min()))
    reach = FARTHEST * instrument.field_rad / pixel if reach_px is None else reach_px
    size = fine_size(max(view.shape), over, reach + max(abs(c) for c in view.centre_px))
    cells = fringe_image(
        instrument, channels, coefficients, size, over, rotation_rad=view.rotation_rad
    )
    return FineImage(view, cells, over)
