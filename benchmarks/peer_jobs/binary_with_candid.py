"""CANDID, as AMICAL 1.6 bundles it: a binary of two discs, fitted from a grid of places.

Arguments: an OIFITS file, inner and outer edge of the field and step of the grid in mas, and
diameters at which fits begin. Prints one line of JSON.
"""

import contextlib
import io
import sys
import time

from amical.externals import candid
from fitted_binary import tell

if __name__ == "__main__":
    path, (inner, outer, step, star, companion) = sys.argv[1], map(float, sys.argv[2:7])
    candid.CONFIG["long exec warning"] = None
    begin = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        data = candid.Open(path)
        data.observables = ["v2", "cp"]
        data.fitMap(
            step=step,
            rmin=inner,
            rmax=outer,
            ncore=1,
            fig=0,
            fratio=20.0,
            addParam={"diam*": star, "diamc": companion},
        )
    names = {
        "east (mas)": ("x", 1.0),
        "north (mas)": ("y", 1.0),
        "flux ratio (%)": ("f", 1.0),
        "diameter (mas)": ("diam*", 0.0),
        "companion's diameter (mas)": ("diamc", 0.0),
    }
    version = sys.modules[candid.Open.__module__].__version__.split()[0]
    tell(data.bestFit, names, begin, version=version)
