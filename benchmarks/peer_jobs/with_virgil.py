"""virgil: null draws over a grid, evaluations of the likelihood, or its pipeline.

Arguments: the OIFITS file, and ``draws`` or ``pipeline FOLDER``.
"""

import os
import resource
import subprocess
import sys
import time

import jax
import numpy as np

path, job = sys.argv[1:3]


def cpu(who=resource.RUSAGE_SELF):
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


def draws():
    from virgil import OIData
    from virgil.detection import injection_recovery
    from virgil.likelihood import loglike
    from virgil.models import BinaryModelCartesian

    data = OIData(path)
    axis = np.arange(-400.0, 401.0, 25.0)
    grid = {"dra": axis, "ddec": axis, "flux": np.geomspace(1e-5, 1e-1, 40)}
    null = BinaryModelCartesian(0.0, 0.0, 0.0)

    def search(n):
        begin = cpu()
        injection_recovery(
            BinaryModelCartesian, null, data, grid, 0, n_null=n, chunk_size=8, progress=False
        )
        return cpu() - begin

    search(8)  # Compilation.
    seconds = (search(24) - search(8)) / 16
    print("cpu_s null_search_per_position", seconds / len(axis) ** 2)

    names = ["dra", "ddec", "flux"]
    many = jax.jit(jax.vmap(lambda x: loglike(x, names, BinaryModelCartesian, data)))
    theta = np.tile([96.4, 114.9, 0.01], (4096, 1)) * np.linspace(0.9, 1.1, 4096)[:, None]
    many(theta).block_until_ready()
    begin = time.process_time()
    for _ in range(10):
        many(theta).block_until_ready()
    print("cpu_s log_probability", (time.process_time() - begin) / 10 / len(theta))


def pipeline(folder):
    words = [os.path.join(os.path.dirname(sys.executable), "virgil-pipeline"), "binary", path]
    subprocess.run([*words, "--output", folder, "--fresh"], check=True, capture_output=True)
    print("cpu_s whole", cpu(resource.RUSAGE_CHILDREN))


if job == "draws":
    draws()
else:
    pipeline(sys.argv[3])
