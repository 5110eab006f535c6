"""Simulated files hold what the jwst package asks of them, and its products agree with ours.

The second needs an environment with that package: ``AMIBAYES_PEERS`` names the folder of
`benchmarks.peers`.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from amibayes.instrument import load_instrument
from amibayes.parallel import SerialExecutor
from amibayes.scene.sources import Scene
from amibayes.simulation import Detector, Exposure
from amibayes.simulation.detector import draw_maps
from amibayes.simulation.observation import Observation
from amibayes.simulation.observe import prepare_exposure, write_exposure

REQUIRED = (
    "DATAMODL", "TELESCOP", "INSTRUME", "FILTER", "PUPIL", "EXP_TYPE", "SUBARRAY", "TARGPROP",
    "TARGNAME", "PI_NAME", "TARG_RA", "TARG_DEC", "TARGURA", "TARGUDEC", "MU_RA", "MU_DEC",
    "VSTSTART", "EFFEXPTM", "NINTS", "EXPMID",
)  # fmt: skip
"""What jwst 3.0's ami_analyze reads of the primary header; without TARGNAME, say, it stops."""

BARYCENTRE = {f"int_{part}_BJD_TDB" for part in ("start", "mid", "end")}
"""Columns without which its data models refuse INT_TIMES."""


def test_what_ami_analyze_reads_is_there(tmp_path: Path) -> None:
    detector, path = Detector(), tmp_path / "star_calints.fits"
    observation = Observation(
        Scene(name="star"),
        load_instrument("niriss", "F480M").as_built(),
        Exposure(2, 2, n_pixels=32),
        detector,
        count_rate_e_s=1e5,
    )
    maps = draw_maps(detector, (32, 32), np.random.default_rng(1))
    write_exposure(path, prepare_exposure(observation, np.random.SeedSequence(1), maps),
                   SerialExecutor())  # fmt: skip
    with fits.open(path) as file:
        primary, science = file[0].header, file["SCI"].header
        assert [key for key in REQUIRED if key not in primary] == []
        assert {"ROLL_REF", "V3I_YANG", "VPARITY"} <= set(science)
        assert set(file["INT_TIMES"].columns.names) >= BARYCENTRE


@pytest.mark.release
def test_products_of_the_package_agree_with_the_extraction(tmp_path: Path) -> None:
    folder = os.environ.get("AMIBAYES_PEERS")
    if not folder:
        pytest.skip("AMIBAYES_PEERS names no folder with an environment of jwst")
    from benchmarks.jwst_pipeline import Visit, amibayes_route, pipeline, product_route

    paths = Visit(None, 1, 4).write(tmp_path)
    pipeline(paths, tmp_path, Path(folder), reuse=False)
    ours, _ = amibayes_route(paths)
    theirs = product_route(tmp_path, "amimulti-oi")
    order = [ours.vis2.stations.tolist().index(s) for s in theirs.vis2.stations.tolist()]
    sigma = np.sqrt(ours.covariance.variance[: ours.n_vis2][order])
    # The same photons, another fit: they agree better than either agrees with the truth.
    assert np.std((theirs.vis2.value - ours.vis2.value[order]) / sigma) < 1.0
