"""A chain on disk, in the layout of emcee's HDF5 backend, to go on from after a kill."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import emcee
import h5py

from amibayes import __version__
from amibayes.errors import DataError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.posterior.priors import Prior
from amibayes.support.atomic_files import atomic_path
from amibayes.units import FloatArray

GROUP = "mcmc"
"""Name of the HDF5 group, as emcee's own backend has it."""


def digest_of(
    likelihood: Likelihood,
    prior: Prior,
    start: FloatArray,
    seed: int,
    region: FloatArray,
    *,
    leaps: bool,
) -> str:
    """Say in short which data, noise, model, prior, start, region and moves a chain belongs to."""
    noise = likelihood.noise
    # The noise in numbers: another covariance or average is another chain.
    kind = (type(noise).__name__, noise.parameters, noise.degrees, noise.log_norm)
    versions = __version__, emcee.__version__
    text = repr((kind, likelihood.model, prior, seed, leaps, versions)).encode()
    arrays = likelihood.observables.data, noise.covariance.variance, start, region
    return sha256(text + b"".join(a.tobytes() for a in arrays)).hexdigest()


def save_chain(sampler: emcee.EnsembleSampler, path: str | Path, digest: str) -> None:
    """Write the chain in the layout of `emcee.backends.HDFBackend`, whole or not at all."""
    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        group = file.create_group(GROUP)
        backend = sampler.backend
        group.attrs.update(
            version=emcee.__version__,
            nwalkers=sampler.nwalkers,
            ndim=sampler.ndim,
            has_blobs=False,
            iteration=sampler.iteration,
            amibayes_digest=digest,
        )
        for k, part in enumerate(backend.random_state):
            group.attrs[f"random_state_{k}"] = part
        group["accepted"] = backend.accepted
        group["chain"] = backend.get_chain()
        group["log_prob"] = backend.get_log_prob()


def load_chain(path: str | Path, digest: str) -> emcee.backends.Backend | None:
    """Read a chain back, if it is the chain of this very problem."""
    if not Path(path).is_file():
        return None
    try:
        with h5py.File(path, "r") as file:
            group = file[GROUP]
            if group.attrs.get("amibayes_digest") != digest:
                return None
            backend = emcee.backends.Backend()
            backend.reset(int(group.attrs["nwalkers"]), int(group.attrs["ndim"]))
            backend.chain = group["chain"][()]
            backend.log_prob = group["log_prob"][()]
            backend.accepted = group["accepted"][()]
            backend.iteration = int(group.attrs["iteration"])
            backend.random_state = tuple(group.attrs[f"random_state_{k}"] for k in range(5))
            backend.initialized = True
            return backend
    except (OSError, KeyError) as error:
        raise DataError(f"is not a chain that can be continued: {error}", source=path) from error
