"""From a scene to a publication plot: the code of the tutorial, run whenever it is built.

    python docs/tutorial.py [FOLDER]

Writes images, pictures and what it prints (``tutorial.txt``) into FOLDER (``tutorial``). It
ends with an error if the companion that it finds is not the one of ``tutorial.toml``.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

# [imports]
import numpy as np

import amibayes as ab
from amibayes.cli import main as amibayes_command
from amibayes.plots.contrast_curve import Curve, limits_plot
from amibayes.plots.corner_plot import corner_plot
from amibayes.plots.fit import fit_plot
from amibayes.plots.maps import detection_map
from amibayes.plots.null_plot import null_plot
from amibayes.plots.style import save
from amibayes.posterior.priors import default_prior

# [/imports]

SCENE = Path(__file__).resolve().parent / "tutorial.toml"
FOLDER = Path(sys.argv[1] if len(sys.argv) > 1 else "tutorial")
FOLDER.mkdir(parents=True, exist_ok=True)
os.chdir(FOLDER)
OUTPUT = Path("tutorial.txt").open("w", encoding="utf-8")  # noqa: SIM115


def say(section: str, text: str) -> None:
    """Print, and keep for the page what was printed, section by section."""
    print(text)
    print(f"# [{section}]\n{text}\n# [/{section}]", file=OUTPUT)


# [simulate]
amibayes_command(["simulate", str(SCENE), "--out", "images", "--overwrite", "--quiet"])
cube = ab.read_cube("images/target_calints.fits")
# [/simulate]
say("simulate", f"{cube.images.shape} images of {cube.instrument} {cube.filter}")

# [extract]
stars = ["target", "calibrator_1", "calibrator_2", "calibrator_3"]
measured = {star: ab.extract(f"images/{star}_calints.fits") for star in stars}
target = measured.pop("target")
# [/extract]
scatter = np.degrees(np.std(target.closure_phase.value))
noise = np.degrees(np.median(target.errors[1]))
say(
    "extract",
    f"{target.n_vis2} V2, {target.n_closure_phases} closure phases, "
    f"{target.n_independent} of all these independent\n"
    f"closure phases scatter by {scatter:.2f} deg; their noise is {noise:.3f} deg",
)

# [calibrate]
calibration = ab.calibrate(target, list(measured.values()))
data = calibration.observables
ab.write_oifits("calibrated.oifits", data, overwrite=True)
# [/calibrate]
scatter = np.degrees(np.std(data.closure_phase.value))
say(
    "calibrate",
    f"closure phases scatter by {scatter:.2f} deg after calibration\n"
    f"scatter between stars: {calibration.tau_vis2:.4f} in V2, "
    f"{calibration.tau_closure_phase_deg:.3f} deg in closure phase",
)

# [search]
result = ab.search(ab.Likelihood(data), (50.0, 450.0))
found = result.companion
# [/search]
say(
    "search",
    f"{len(result.grid)} positions searched\n"
    f"{found.separation_mas:.1f} +/- {found.separation_error_mas:.1f} mas, "
    f"PA {found.position_angle_deg:.2f} +/- {found.position_angle_error_deg:.2f} deg, "
    f"{found.delta_mag:.2f} +/- {found.delta_mag_error:.2f} mag\n"
    f"delta chi2 {result.delta_chi2:.0f}",
)

# [significance]
rng = np.random.default_rng(2026)
significance = ab.significance(ab.statistic_of(result), 10_000, rng)
# [/significance]
say(
    "significance",
    f"false-alarm probability {significance.probability:.1e} "
    f"(95%: {significance.interval[0]:.1g} to {significance.interval[1]:.1g}), "
    f"{significance.n_draws} null searches: detected is {significance.detected}",
)

# [posterior]
prior = default_prior(result.likelihood, 50.0, 450.0)
posterior = ab.sample(result, prior, rng)
# [/posterior]
lines = []
for name in ("separation_mas", "position_angle_deg", "delta_mag"):
    middle, low, high = posterior.interval(name, 0.68)
    lines.append(f"{name:19} {middle:7.2f}  68%: {low:.2f} to {high:.2f}")
lines.append(f"converged: {posterior.converged} (split R-hat {posterior.split_rhat:.3f})")
say("posterior", "\n".join(lines))

# [limits]
limits = ab.detection_limit(result, significance, rng)
# [/limits]
say(
    "limits",
    "\n".join(
        f"{rho:5.0f} mas  {magnitude:5.2f} mag"
        for rho, magnitude in list(zip(limits.separation_mas, limits.delta_mag, strict=True))[::3]
    ),
)

# [figures]
save(detection_map(result), "map.png")
save(fit_plot(result), "fit.png")
save(null_plot(significance.null, significance.statistic, alpha=significance.alpha), "null.png")
save(corner_plot(posterior.samples, posterior.names), "corner.png")
curves = {"95 % recovered": Curve(limits.delta_mag)}
save(limits_plot(limits.separation_mas, curves, found), "limits.png")
# [/figures]

OUTPUT.close()
for value, error, truth in (
    (found.separation_mas, found.separation_error_mas, 150.0),
    (found.position_angle_deg, found.position_angle_error_deg, 40.0),
    (found.delta_mag, found.delta_mag_error, 5.5),
):
    assert abs(value - truth) < 4.0 * error, f"{value} +/- {error} is not {truth}"
assert significance.detected
assert posterior.converged
