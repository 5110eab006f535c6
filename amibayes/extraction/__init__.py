"""From images to squared visibilities, closure phases and their joint covariance."""

from amibayes.extraction.extract import Extraction, extract, extract_all
from amibayes.extraction.options import METHODS, ExtractOptions

__all__ = ["METHODS", "ExtractOptions", "Extraction", "extract", "extract_all"]
