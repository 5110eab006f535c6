"""fouriever: fits from a grid of positions, and steps of emcee. Argument: an OIFITS file."""

import contextlib
import io
import os
import sys
import time

from fouriever import uvfit

path = sys.argv[1]
with contextlib.redirect_stdout(io.StringIO()) as output:
    data = uvfit.data(os.path.dirname(path) + "/", [os.path.basename(path)])

    def search(step_mas):
        begin = time.process_time()
        fit = data.chi2map(model="bin", cov=False, sep_range=(50.0, 400.0), step_size=step_mas)
        return time.process_time() - begin, fit

    search(100.0)
    # Positions of the square grid that lie inside the annulus.
    seconds, fit = search(25.0)
    steps = range(-16, 17)
    n = sum(50.0 <= 25.0 * (i * i + j * j) ** 0.5 <= 400.0 for i in steps for j in steps)

    begin = time.process_time()
    data.mcmc(fit, nburn=50, nstep=250, nwalkers=12, cov=False)
    chain = time.process_time() - begin
print("cpu_s search_per_position", seconds / n)
print("cpu_s log_probability", chain / (300 * 12))
