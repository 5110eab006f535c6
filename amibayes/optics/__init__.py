"""Light through the mask: one model, used by simulation and by extraction."""

from amibayes.optics.fringe_field import FringeField, fringe_field, fringe_image
from amibayes.optics.fringes import FringeBasis, fringe_basis
from amibayes.optics.image import ShiftedImage, scene_image
from amibayes.optics.psf import Wavefront, psf
from amibayes.optics.pupil import PupilMap

__all__ = [
    "FringeBasis",
    "FringeField",
    "PupilMap",
    "ShiftedImage",
    "Wavefront",
    "fringe_basis",
    "fringe_field",
    "fringe_image",
    "psf",
    "scene_image",
]
