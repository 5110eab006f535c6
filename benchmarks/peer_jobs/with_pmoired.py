"""PMOIRED: fits from a grid of positions, and bootstrap. Argument: an OIFITS file."""

import contextlib
import io
import resource
import sys

import pmoired


def cpu():
    used = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


if __name__ == "__main__":
    with contextlib.redirect_stdout(io.StringIO()):
        oi = pmoired.OI(sys.argv[1])
        oi.setupFit({"obs": ["V2", "T3PHI"]})
        model = {"*,ud": 0.8, "*,f": 1.0, "c,ud": 0.0, "c,f": 0.01, "c,x": 6.0, "c,y": -28.0}
        fixed = ["*,f", "c,ud"]
        begin = cpu()
        oi.gridFit(
            {"grid": {"c,x": (-30, 30, 15.0), "c,y": (-30, 30, 15.0)}},
            model=model,
            doNotFit=fixed,
            multi=False,
        )
        search = (cpu() - begin) / 25
        begin = cpu()
        oi.bootstrapFit(10, multi=False)
        resampled = (cpu() - begin) / 10
    print("cpu_s search_per_position", search)
    print("cpu_s posterior_draw", resampled)
