# %% [markdown]
# # A model of your own
#
# A component of the sky is a class with its free parameters and its visibility. Here a Gaussian
# halo of known size and unknown flux surrounds the star; search and errors take it as any other.

# %%
from dataclasses import dataclass

import numpy as np

import amibayes as ab
from amibayes.units import MAS


@dataclass(frozen=True)
class Halo:
    """A Gaussian halo around the star, of known size."""

    fwhm_mas: float

    @property
    def parameters(self):
        """One: its flux, in units of the star's."""
        return (ab.Parameter("halo", "", "nuisance", 0, 0.0, 1.0),)

    def source(self, samples, values, *, slopes=False):
        """Flux and visibility; the flux enters the sum linearly, so that its slope is 1."""
        width = np.pi * self.fwhm_mas * MAS / (2.0 * np.sqrt(np.log(2.0)))
        wave = np.exp(-((width * samples.frequency[:, None]) ** 2)) * np.ones_like(values[0])
        moves = (ab.Slope(flux=1.0),) if slopes else ()
        return ab.Source(values[0], wave.astype(complex), slopes=moves)


halo: ab.Component = Halo(100.0)

# %% [markdown]
# Simulated data of a star with a halo of 5 % and a companion of 2 %: the model of the truth, and
# noise by the covariance of the example's data.

# %%
data = ab.read_oifits("examples/data/target.oifits")
model = ab.BinaryModel(surroundings=(halo,))
likelihood = ab.Likelihood(data, model)
likelihood

# %%
from dataclasses import replace

truth = np.array([110.0, -75.0, 0.02, 0.05])
rng = np.random.default_rng(1)
seen = likelihood.predict(truth)[:, 0] + likelihood.noise.covariance.draw(rng, 1)[:, 0]
n = likelihood.observables.n_vis2
simulated = replace(
    likelihood.observables,
    vis2=replace(likelihood.observables.vis2, value=seen[:n]),
    closure_phase=replace(likelihood.observables.closure_phase, value=seen[n:]),
)

# %% [markdown]
# With the halo in the model the companion comes back; without it the fit is bad.

# %%
with_halo = ab.search(ab.Likelihood(simulated, model), (94.0, 400.0))
without = ab.search(ab.Likelihood(simulated), (94.0, 400.0))
print(with_halo)
print(
    f"reduced χ²: {with_halo.chi2_binary / with_halo.ndof:.2f} with the halo, "
    f"{without.chi2_binary / without.ndof:.1f} without"
)
pull = (with_halo.theta - truth) / np.sqrt(np.diag(with_halo.theta_covariance))
print("off by", np.round(pull, 1), "σ")
assert np.abs(pull).max() < 4.0
assert without.chi2_binary / without.ndof > 3.0 * with_halo.chi2_binary / with_halo.ndof
