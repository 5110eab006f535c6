"""JWST stage-3 products: recognised, read, repaired, and what is wrong with them."""

from amibayes.oifits.products.pointing import pointing_of
from amibayes.oifits.products.reading import (
    open_products,
    read_product,
    read_products,
    write_repaired,
)
from amibayes.oifits.products.recognise import (
    FITS_MODEL,
    IMPLANEIA,
    Product,
    exposure_of,
    is_product_header,
    product_of,
)
from amibayes.oifits.products.repairs import Repair, repaired
from amibayes.oifits.products.together import (
    Contents,
    refuse_calibrating_again,
    refuse_twice,
    uncalibrated,
)

__all__ = [
    "FITS_MODEL",
    "IMPLANEIA",
    "Contents",
    "Product",
    "Repair",
    "exposure_of",
    "is_product_header",
    "open_products",
    "pointing_of",
    "product_of",
    "read_product",
    "read_products",
    "refuse_calibrating_again",
    "refuse_twice",
    "repaired",
    "uncalibrated",
    "write_repaired",
]
