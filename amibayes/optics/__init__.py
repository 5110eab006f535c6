"""Light through the mask: one model, used by simulation and by extraction."""

from amibayes.optics.fringes import FringeBasis, fringe_basis
from amibayes.optics.psf import Wavefront, psf

__all__ = ["FringeBasis", "Wavefront", "fringe_basis", "psf"]
