"""OIFITS, versions 1 and 2, both ways, with every correlation."""

from amibayes.oifits.products.reading import read_oifits
from amibayes.oifits.reader import observables_of
from amibayes.oifits.tables import OIFits, OITable, open_oifits
from amibayes.oifits.writer import write_oifits

__all__ = ["OIFits", "OITable", "observables_of", "open_oifits", "read_oifits", "write_oifits"]
