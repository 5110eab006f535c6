"""PMOIRED: a binary of two discs, fitted from a grid of places.

Arguments: an OIFITS file, inner and outer edge of the field and step of the grid in mas, and
diameters at which fits begin. Prints one line of JSON.
"""

import contextlib
import io
import sys
import time

import pmoired
from fitted_binary import tell

if __name__ == "__main__":
    path, (inner, outer, step, star, companion) = sys.argv[1], map(float, sys.argv[2:7])
    begin = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()):
        oi = pmoired.OI(path)
        oi.setupFit({"obs": ["V2", "T3PHI"]})
        model = {"*,ud": star, "*,f": 1.0, "c,ud": companion, "c,f": 0.2, "c,x": 0.0, "c,y": 0.0}
        axis = (-outer, outer, step)
        oi.gridFit(
            {"grid": {"c,x": axis, "c,y": axis}},
            model=model,
            doNotFit=["*,f"],
            multi=False,
            constrain=[
                ("np.sqrt(c,x**2+c,y**2)", ">=", inner),
                ("np.sqrt(c,x**2+c,y**2)", "<=", outer),
            ],
        )
    names = {
        "east (mas)": ("c,x", 1.0),
        "north (mas)": ("c,y", 1.0),
        "flux ratio (%)": ("c,f", 100.0),
        "diameter (mas)": ("*,ud", 0.0),
        "companion's diameter (mas)": ("c,ud", 0.0),
    }
    tell(oi.bestfit, names, begin)
