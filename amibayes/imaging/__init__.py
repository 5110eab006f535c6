"""Light image reconstruction: for looking, not for measuring."""

from amibayes.imaging.reconstruct import reconstruct_image
from amibayes.imaging.result import ReconstructedImage

__all__ = ["ReconstructedImage", "reconstruct_image"]
