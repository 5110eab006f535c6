"""Numbers of observables and their covariance as they were recorded.

`pytest tests/data/test_recorded_data.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from helpers import niriss
from oi_builders import random_observables
from recorded_numbers import checker
from scipy.sparse import csr_array, diags_array

from amibayes.data.assumed_covariance import covariance_of_errors, kernel_blocks
from amibayes.data.blocks import Block, BlockCovariance
from amibayes.data.closure import (
    assumed_covariance,
    baseline_variances,
    canonical,
    canonical_uv,
    closure_matrix,
    kernel_basis,
)
from amibayes.data.covariance import covariance_from_matrix, dense_covariance, stack_covariances
from amibayes.data.degrees_of_freedom import (
    Freedom,
    squared_share,
    stacked_freedom,
    stacked_scatter,
    welch_satterthwaite,
)
from amibayes.data.joining import in_order
from amibayes.data.measurements import exposure_labels
from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import bspline_weights
from amibayes.data.outliers import look_elsewhere, outlying
from amibayes.data.shared_errors import SharedErrors
from amibayes.data.shrinkage import lag_one, shrunk_covariance
from amibayes.data.systematics import calibration_errors, n_exposures, systematics_of, table


def told(seed: int, **options: object) -> Observables:
    """Observables with freedom, scatter, and errors that are shared."""
    rng = np.random.default_rng(seed)
    data = random_observables(rng, n_stations=5, **options)  # type: ignore[arg-type]
    variance = data.covariance.variance
    data = replace(
        data,
        freedom=Freedom(20.0 + seed, 15.0 + 3.0 * seed),
        scatter=diags_array((0.3 + 0.1 * seed) * variance).tocsr(),
        setups=tuple(replace(s, source=f"{seed}.oifits") for s in data.setups),
    )
    names = ("charge x", "charge y") if seed % 2 else ("charge y", "linearity")
    changes = np.sqrt(variance)[:, None] * rng.normal(size=(len(variance), 2))
    return data.with_shared_errors(SharedErrors(names, changes))


def test_block_covariances_are_those_recorded(num_regression) -> None:
    """Blocks with and without a basis: whitened, scaled, selected, added to."""
    rng = np.random.default_rng(1)
    parts = []
    for k in range(2):
        closure = random_observables(rng, n_stations=5, kind="diagonal").closure_phase
        variance = rng.uniform(1.0, 2.0, len(closure.value))
        parts.append(
            covariance_of_errors(np.full(2 + k, 0.1), closure, np.sqrt(variance), "assumed")
        )
    root = rng.normal(size=(4, 9))
    plain = dense_covariance(root @ root.T)
    whole = stack_covariances([*parts, plain])
    n = whole.size
    factors = rng.uniform(0.5, 2.0, n)
    x = rng.normal(size=(n, 3))
    low = rng.normal(size=(n, 2)) * 0.3
    addition = csr_array(np.diag(rng.uniform(0.0, 0.5, n)))
    keep = np.sort(rng.permutation(n)[: n - 5])
    checker(num_regression)(
        whole=whole,
        solved=whole.solve(x),
        white=np.sum(whole.whiten(x) ** 2, axis=0),
        drawn=np.sum(whole.whiten(whole.draw(np.random.default_rng(2), 5)) ** 2, axis=0),
        scaled=whole.scaled(factors),
        stretched=whole.stretched(factors),
        selected=whole.select(keep),
        plus=whole.plus(addition),
        growing=whole.growing(addition),
        against=whole.against(addition, x[:, 0]),
        sparse=whole.sparse,
        independent=whole.independent,
        from_matrix=covariance_from_matrix(plain.dense()),
        joint=BlockCovariance(4, [Block(np.arange(4), root @ root.T + low[:4] @ low[:4].T)]),
    )


def test_closures_are_those_recorded(num_regression) -> None:
    """Their order, matrix, kernel, and what is assumed of their errors."""
    data = random_observables(np.random.default_rng(3), n_stations=5, n_channels=2, kind="assumed")
    closure = data.closure_phase
    stations = closure.stations[::2][:, [2, 0, 1]]
    matrix, baselines = closure_matrix(closure.stations[::2])
    variance = np.random.default_rng(4).uniform(0.5, 2.0, len(matrix))
    kernel = kernel_basis(matrix)
    checker(num_regression)(
        canonical=canonical(stations),
        uv=canonical_uv(stations, closure.u_m[::2], closure.v_m[::2]),
        matrix=(matrix, baselines),
        kernel=kernel @ kernel.T,
        variances=baseline_variances(matrix, variance[:, None]),
        assumed=assumed_covariance(matrix, variance[:, None]),
        blocks=[b.matrix for b in kernel_blocks(closure, np.full(len(closure.value), 0.02))],
        labels=exposure_labels(closure),
        sets=closure.sets,
        noise=closure.shared_noise,
    )


def test_joined_observables_are_those_recorded(num_regression) -> None:
    """Several files, a part of them, with other data, flags and errors of calibration."""
    parts = [told(k, n_exposures=2, kind="assumed") for k in range(2)]
    whole = join(parts)
    rng = np.random.default_rng(5)
    masks = [rng.uniform(size=len(m.value)) < 0.7 for m in (whole.vis2, whole.closure_phase)]
    tables = [whole.to_table("vis2"), whole.to_table("closure_phase")]
    flagged = whole.flagged(~masks[0], ~masks[1])
    checker(num_regression)(
        whole=whole,
        order=[p.source == "" for p in in_order(parts[::-1])],
        flagged=flagged,
        tables=[{n: np.asarray(t[n]) for n in t.colnames} for t in tables],
        unflagged=flagged.unflagged().data,
        selected=whole.select(*masks),
        only=[whole.only(["vis2"]).covariance, whole.only(["cp"]).covariance],
        without=whole.without_shared_errors().covariance,
        passed_over=("setups", "notes"),
    )


def test_shrunk_covariances_are_those_recorded(num_regression) -> None:
    """Of series that are correlated from one integration to the next, by every kind."""
    rng = np.random.default_rng(6)
    white = rng.normal(size=(40, 9)) @ (np.eye(9) + 0.3 * rng.normal(size=(9, 9)))
    deviation = white[1:] + 0.6 * white[:-1]
    deviation -= deviation.mean(axis=0)
    physical = np.diag(rng.uniform(0.5, 3.0, 9))
    physical[0, 1] = physical[1, 0] = 0.2
    basis = np.eye(9)
    numbers = {
        kind: shrunk_covariance(deviation, physical, basis, 4, kind)
        for kind in ("shrunk", "physical", "scatter")
    }
    checker(num_regression)(
        numbers=numbers,
        few=shrunk_covariance(deviation[:6], physical, basis, 4),
        lag=[lag_one(deviation.T), lag_one(white.T + 3.0)],
        offset=shrunk_covariance(deviation + 0.2, physical, basis, 4),
    )


def test_freedom_and_systematics_are_those_recorded(num_regression) -> None:
    """Degrees of freedom of sums, errors of calibrations of known instruments, outliers."""
    rng = np.random.default_rng(7)
    data = told(1, n_exposures=2, kind="assumed")
    whole = data.covariance
    part = csr_array(0.4 * whole.dense())
    parts = [(0.3, Freedom(12.0, 8.0)), (0.5, Freedom(40.0, 30.0)), (0.2, None)]
    known = niriss()
    checker(num_regression)(
        sum=welch_satterthwaite(parts),
        share=squared_share(part, whole),
        stacked=stacked_freedom([(10, Freedom(9.0, 7.0)), (20, Freedom(30.0, 25.0)), (5, None)]),
        scatter=stacked_scatter([(whole, part), (whole, None)]),
        half=Freedom(10.0, 25.0).scatter_share,
        systematics=[(s.vis2, s.closure_phase_rad, s.visibility) for s in table()],
        chosen=systematics_of(known, (0.01, 0.5)),
        errors=calibration_errors(known, (0.01, 0.5)),
        exposures=n_exposures(data, data.source),
        elsewhere=[look_elsewhere(limit, n) for limit, n in ((3.0, 10), (4.0, 1000))],
        outlying=outlying(2.0 * rng.normal(size=(30, 4)), rng.uniform(0.4, 0.8, (30, 4)), 3.0),
        splines=bspline_weights(np.array([[0.0, 0.3, 1.7, 4.2], [1.0, -0.6, 0.2, 0.9]]), 8),
    )
