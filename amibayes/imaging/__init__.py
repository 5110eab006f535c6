"""Light image reconstruction: for looking, not for measuring."""

from amibayes.imaging.reconstruct import ReconstructedImage, reconstruct_image

__all__ = ["ReconstructedImage", "reconstruct_image"]
