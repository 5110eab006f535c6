"""From images to squared visibilities, closure phases and their joint covariance."""

from amibayes.extraction.extract import extract, extract_all
from amibayes.extraction.options import METHODS, ExtractOptions
from amibayes.extraction.table import Extraction

__all__ = ["METHODS", "ExtractOptions", "Extraction", "extract", "extract_all"]
