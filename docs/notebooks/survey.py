# %% [markdown]
# # A survey
#
# Many stars searched alike, and what their results mean together. The stars here are the target of
# the example and its three calibrators, each calibrated with the others. Run from the root of a
# clone.

# %%
import json
import tempfile
from pathlib import Path

from astropy.table import Table

from amibayes.cli import main

data = Path("examples/data").resolve()
folder = Path(tempfile.mkdtemp())
calibrators = [data / f"cal{k}.oifits" for k in (1, 2, 3)]


def others(star: Path) -> str:
    """The calibrators without the star itself."""
    return " ".join(str(path) for path in calibrators if path != star)


stars = [data / "target.oifits", *calibrators]
table = Table(
    {
        "name": [star.stem for star in stars],
        "target": [str(star) for star in stars],
        "cal": [others(star) for star in stars],
        "distance_pc": [25.0, 31.0, 54.0, 40.0],
    }
)
table.write(folder / "targets.ecsv")
table["name", "distance_pc"]

# %% [markdown]
# One command searches all of them. `--workers 2` would give the same bytes in less time, and
# `--resume` goes on after an interruption.

# %%
words = ["search", "--batch", str(folder / "targets.ecsv"), "--out", str(folder / "survey")]
code = main([*words, "--no-posterior", "--no-pictures"])
assert code == 0

# %% [markdown]
# A row for each star. `false_discovery_rate` is the smallest rate at which Benjamini and Hochberg's
# procedure lists the star.

# %%
rows = Table.read(folder / "survey" / "survey.ecsv")
rows["name", "verdict", "false_alarm_probability", "false_discovery_rate"]

# %% [markdown]
# The companion of the example is listed, and none of the single stars is.

# %%
listed = {row["name"] for row in rows if row["false_discovery_rate"] < 0.05}
assert listed == {"target"}

# %% [markdown]
# How frequent are companions? With four stars that is hardly known: the posterior says so. The page
# of the survey, `survey.html`, has the completeness of all targets together, in au as well.

# %%
survey = json.loads((folder / "survey" / "survey.json").read_text())
frequency = survey["companion_frequency"]
low, high = frequency["interval_95"]
print(f"{frequency['median']:.2f}, 95 %: {low:.2f} to {high:.2f}")
assert low < 0.25 < high
