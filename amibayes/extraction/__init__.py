"""From images to squared visibilities, closure phases and their joint covariance."""

from amibayes.extraction.extract import Extraction, extract, extract_all
from amibayes.extraction.options import METHODS, ExtractOptions, Method

__all__ = ["METHODS", "ExtractOptions", "Extraction", "Method", "extract", "extract_all"]
