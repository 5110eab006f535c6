"""A chain on disk, in the layout of emcee's HDF5 backend, to go on from after a kill."""

from __future__ import annotations

from pathlib import Path

import emcee
import h5py

from amibayes.errors import DataError
from amibayes.support.atomic_files import atomic_path

GROUP = "mcmc"
"""Name of the HDF5 group, as emcee's own backend has it."""


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
