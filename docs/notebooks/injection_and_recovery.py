# %% [markdown]
# # Injection and recovery
#
# How faint a companion would these data have shown? Companions are put into simulated data with the
# noise of the real ones, and the very search that was run has to find them.

# %%
import numpy as np

import amibayes as ab

files = [f"examples/data/{name}.oifits" for name in ("target", "cal1", "cal2", "cal3")]
target, *calibrators = (ab.read_oifits(name) for name in files)
data = ab.calibrate(target, calibrators).observables
found = ab.search(ab.Likelihood(data), (94.0, 400.0))
rng = np.random.default_rng(1)

# %% [markdown]
# The threshold comes from data without a companion: noise alone exceeds it once in 770 times. The
# stated errors are taken for right: a scale of the noise that is measured in what a star alone
# leaves would hold the companion of these data.

# %%
test = ab.statistic_of(found, stated_errors=True)
tested = ab.significance(test, 3000, rng)
threshold = tested.threshold()
print(f"threshold {threshold:.1f} at a false-positive rate of {tested.alpha}")

# %% [markdown]
# Two hundred companions at 200 mas, at every position angle, twice: of 6 and of 9 magnitudes.

# %%
angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
share = {}
for magnitude in (6.0, 9.0):
    contrast = np.full(200, 10.0 ** (-0.4 * magnitude))
    places = np.column_stack([200.0 * np.sin(angle), 200.0 * np.cos(angle), contrast])
    recovery = ab.recover(test, places, threshold, rng)
    share[magnitude] = recovery.located.mean()
    print(f"{magnitude} mag: {share[magnitude]:.0%} recovered at their place")
assert share[6.0] > 0.8 > 0.1 > share[9.0]

# %% [markdown]
# The limit is where 95 of 100 are recovered; `to_xarray` has the completeness of every cell.

# %%
limit = ab.detection_limit(found, tested, rng, separation_mas=[150.0, 250.0], trials=100)
limit
assert (limit.delta_mag > 6.0).all()
assert (limit.delta_mag < 8.0).all()
