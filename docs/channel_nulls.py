"""False-alarm probabilities of null data with half of the variance common to channels.

    python docs/channel_nulls.py [--sets 1000] [--draws 1000]

Null sets of four telescopes, six channels and eight exposures, as the tests make them
(`tests/channel_sets.py`); each is searched with the noise that is fitted to it, and with draws of
its own. Writes the shares below 1, 5, 10 and 50 % into `statistics.md`, in some
3 minutes of one core.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from pages import put_table
from scipy import stats

from amibayes.units import FloatArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from channel_sets import probabilities

LEVELS = (0.01, 0.05, 0.1, 0.5)
SEED = 2
PAGE, MARK = "statistics.md", "table: docs/channel_nulls.py"


def table(p: FloatArray) -> list[str]:
    """Shares below each level with their binomial errors, and the p of Kolmogorov and Smirnov."""
    lines = ["| probability below | share of null sets (%) |", "|---|---|"]
    for level in LEVELS:
        error = 100.0 * np.sqrt(level * (1.0 - level) / len(p))
        lines.append(f"| {level:g} | {100.0 * np.mean(p < level):.1f} ± {error:.1f} |")
    uniform = stats.kstest(p, "uniform").pvalue
    return [*lines, f"| {len(p)} sets | p of Kolmogorov and Smirnov: {uniform:.2f} |"]


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw the sets, write the table, and fail where the probabilities are not uniform."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--sets", type=int, default=1000)
    parser.add_argument("--draws", type=int, default=1000)
    options = parser.parse_args(arguments)
    p = probabilities(options.sets, options.draws, SEED)
    put_table(PAGE, table(p), MARK)
    return int(stats.kstest(p, "uniform").pvalue < 1e-3)


if __name__ == "__main__":
    sys.exit(main())
