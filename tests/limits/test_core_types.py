"""The same numbers on every processor: the linear algebra library is told to be another one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import json, sys
import numpy as np
import amibayes as ab
from threadpoolctl import threadpool_info, threadpool_limits

with threadpool_limits(1):
    likelihood = ab.Likelihood(ab.read_oifits(sys.argv[1]))
    result = ab.search(likelihood, (60.0, 250.0))
    rng = np.random.default_rng(1)
    test = ab.statistic_of(result)
    found = ab.significance(test, 3000, rng)
    limit = ab.detection_limit(result, found, rng, n_separations=4, trials=200)
core = [library.get("architecture") for library in threadpool_info()]
print(json.dumps([core, limit.delta_mag.tolist(), found.probability, found.threshold()]))
"""

CORE_TYPES = ("Haswell", "SkylakeX", "Nehalem")


@pytest.mark.slow
def test_limits_are_alike_under_three_kinds_of_processor(star: Path) -> None:
    running = [
        subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(star)],
            env={**os.environ, "OPENBLAS_CORETYPE": core, "OPENBLAS_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
        )
        for core in CORE_TYPES
    ]
    answers = [json.loads(process.communicate()[0]) for process in running]
    first = answers[0]
    if len({str(answer[0]) for answer in answers}) == 1:
        pytest.skip("the linear algebra library does not listen to OPENBLAS_CORETYPE")
    for _, delta_mag, probability, threshold in answers[1:]:
        assert delta_mag == pytest.approx(first[1], abs=1e-4)
        assert probability == first[2]
        assert threshold == pytest.approx(first[3], rel=1e-6)
