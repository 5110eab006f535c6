# %% [markdown]
# # A first look
#
# The data of a target and of three calibrators, as squared visibilities and closure phases; what is
# in them, and how sure that is. Run from the root of a clone.

# %%
import numpy as np

import amibayes as ab

files = [f"examples/data/{name}.oifits" for name in ("target", "cal1", "cal2", "cal3")]
target, *calibrators = (ab.read_oifits(name) for name in files)
target

# %% [markdown]
# Calibrators give what the instrument does to V² and closure phases. Their scatter is added to the
# target's errors: the target is one more star.

# %%
calibration = ab.calibrate(target, calibrators)
calibration

# %% [markdown]
# Every position of the field is tried, and the best are refined.

# %%
likelihood = ab.Likelihood(calibration.observables)
found = ab.search(likelihood, (94.0, 400.0))
found

# %% [markdown]
# Is it real? The same search, on data that hold noise alone.

# %%
rng = np.random.default_rng(1)
tested = ab.significance(ab.statistic_of(found), 3000, rng)
tested

# %%
posterior = ab.sample(found, ab.Prior(94.0, 400.0), rng)
posterior

# %% [markdown]
# The truth of these simulated data: 150 mas, position angle 40°, 5.0 magnitudes.

# %%
assert tested.detected
for name, truth in (("separation_mas", 150.0), ("position_angle_deg", 40.0), ("delta_mag", 5.0)):
    median, low, high = posterior.interval(name, 0.997)
    print(f"{name:20} {median:8.3f}  99.7 %: {low:.3f} to {high:.3f}  (truth {truth})")
    assert low < truth < high
