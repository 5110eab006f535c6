"""CPU time of amibayes for what the peers do too, and what part of it the machine itself needs."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from amibayes import BinaryModel, Likelihood, read_oifits, sample, search
from amibayes.detection.statistic import statistic_of
from amibayes.extraction import ExtractOptions, extract_all
from amibayes.posterior.priors import default_prior
from benchmarks.search import gemm_seconds

DRAWS = 10_000


def cpu(function: Callable[[], Any], repeat: int = 3) -> tuple[float, Any]:
    """Least CPU time of a few calls, and the last result."""
    times = []
    for _ in range(repeat):
        begin = time.process_time()
        result = function()
        times.append(time.process_time() - begin)
    return min(times), result


def searches(path: Path, field: tuple[float, float], model: BinaryModel) -> dict[str, float]:
    """Searches of the data, of null draws, the likelihood, and draws of the posterior."""
    likelihood = Likelihood(read_oifits(path), model)
    whole, result = cpu(lambda: search(likelihood, field))
    test = statistic_of(result, stated_errors=True)
    bank = test.bank
    null, _ = cpu(lambda: test.draw_null(DRAWS, np.random.default_rng(1)), repeat=1)
    noise, _ = cpu(
        lambda: np.random.default_rng(1).standard_normal((bank.n_rows, DRAWS), dtype=np.float32)
    )
    # Of the numbers that data are reduced to, which is what the draws have.
    floor = gemm_seconds(2.0 * (len(bank) / 2) * bank.n_rows * DRAWS)
    theta = np.tile(result.theta, (4096, 1)) * np.linspace(0.9, 1.1, 4096)[:, None]
    density, _ = cpu(lambda: likelihood.log_prob(theta))
    prior = default_prior(likelihood, *field)
    chain, posterior = cpu(lambda: sample(result, prior, np.random.default_rng(1)), repeat=1)
    return {
        "search_per_position": whole / len(bank),
        "null_search_per_position": null / DRAWS / len(bank),
        "null_share_gemm": floor / null,
        "null_share_random": noise / null,
        "log_probability": density / len(theta),
        "posterior_draw": chain / posterior.n_effective,
    }


def extraction(path: Path) -> dict[str, float]:
    """The default extraction of a file, beside one FFT of every image."""
    from astropy.io import fits

    images = fits.getdata(path).astype(np.float64)
    scale = 65.6 * np.pi / 180 / 3.6e6
    header = {"instrument": "niriss", "filter": "F480M", "pixel_scale_rad": scale}
    seconds, _ = cpu(lambda: extract_all(path, ExtractOptions(), **header))
    fourier, _ = cpu(lambda: np.fft.rfft2(images))
    return {
        "extraction_per_integration": seconds / len(images),
        "extraction_over_fft": seconds / fourier,
    }


def whole(path: Path) -> float:
    """CPU seconds of the command with all of its stages, from start to end of the process."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "amibayes", "search", str(path), "--out", folder, "--quiet"]
        subprocess.run(words, check=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
