"""What was extracted, as `Observables`: stations are holes, baselines on the sky."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import csr_array

from amibayes.cube import Cube
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import Block, BlockCovariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.measurements import Measurements
from amibayes.data.observables import CovarianceKind, Observables, join
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.data.setup import Setup
from amibayes.data.shrinkage import Shrunk
from amibayes.errors import DataError
from amibayes.extraction.charge import CubeMigration
from amibayes.extraction.frames import Average, Frames
from amibayes.extraction.operator import ExtractionOperator
from amibayes.extraction.options import ExtractOptions
from amibayes.extraction.view import View
from amibayes.units import FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class Extraction:
    """Everything that came out of the cubes of one instrument, filter and orientation.

    Parameters
    ----------
    observables : Observables
    frames : Frames
        All integrations, those that were not used too.
    average : Average
        Of those that were used.
    covariance : Shrunk
        Of one integration.
    physical : (m, m) array
        Covariance of one integration that photon and read noise make.
    operators : tuple of ExtractionOperator
        One per file: view, reference image, operators.
    options : ExtractOptions
    sources : tuple of str
    charge : CubeMigration
        What was done about charge migration.
    """

    observables: Observables
    frames: Frames
    average: Average
    covariance: Shrunk
    physical: FloatArray
    operators: tuple[ExtractionOperator, ...]
    options: ExtractOptions
    sources: tuple[str, ...]
    charge: CubeMigration = field(default_factory=CubeMigration)

    @property
    def rejected(self) -> list[tuple[str, int, str]]:
        """File, number and reason of the integrations that were not used."""
        frames = self.frames
        return [
            (self.sources[int(frames.file[k])], int(frames.number[k]), str(frames.reason[k]))
            for k in np.flatnonzero(~frames.used)
        ]


def independent_basis(view: View) -> FloatArray:
    """(n_baselines + n_triangles, p): every V², then the kernel basis of closure phases."""
    mask = view.instrument.mask
    closures = kernel_basis(closure_matrix(mask.triangles)[0])
    n = mask.n_baselines
    basis = np.zeros((n + len(closures), n + closures.shape[1]))
    basis[:n, :n] = np.eye(n)
    basis[n:, n:] = closures
    return basis


def observables_of(
    view: View,
    template: Cube,
    average: Average,
    covariance: Block,
    *,
    n_integrations: int | None,
    kind: CovarianceKind,
    freedom: Freedom | None,
    scatter: csr_array | None,
    response: OffAxisResponse,
    mjd: float,
    integration_s: float,
    notes: tuple[str, ...],
) -> Observables:
    """Lay one average out as a table; ``covariance`` is that of the mean."""
    mask = view.instrument.mask
    holes = template.orientation.baselines_to_sky(mask.rotated(view.rotation_rad).holes_m)
    setup = _setup(view, template, holes, response)
    timing = (mjd, integration_s)
    vis2 = _rows(setup, holes, mask.pairs, [(0, 1)], average.vis2, timing)
    closure = _rows(setup, holes, mask.triangles, [(0, 1), (1, 2)], average.closure_phase, timing)
    return Observables(
        vis2,
        closure,
        BlockCovariance(len(covariance.index), [covariance]),
        kind,
        (setup,),
        n_integrations,
        notes,
        freedom,
        scatter,
    )


def target_of(template: Cube) -> str:
    """Name of the star as the header has it; empty where it has none.

    The archive calls a star that no catalogue was asked for UNKNOWN; the observer's name follows.
    """
    names = (str(template.header.get(k) or "").strip() for k in ("TARGNAME", "TARGPROP", "OBJECT"))
    return next((name for name in names if name and name.upper() != "UNKNOWN"), "")


def _setup(view: View, template: Cube, holes: FloatArray, response: OffAxisResponse) -> Setup:
    mask, header = view.instrument.mask, template.header
    n = mask.n_holes
    right, down = (header.get(key) for key in ("TARG_RA", "TARG_DEC"))
    return Setup(
        f"{template.instrument.upper()}_{view.instrument.bandpass.name}",
        mask.name[:40],
        target_of(template),
        tuple(f"H{k + 1}" for k in range(n)),
        np.arange(1, n + 1),
        np.array([view.wavelength_m]),
        np.array([view.instrument.bandpass.effective_width_m]),
        np.column_stack([holes, np.zeros(n)]),
        np.full(n, mask.size_m),
        template.source,
        float(right) if isinstance(right, int | float) else 0.0,
        float(down) if isinstance(down, int | float) else 0.0,
        response=response,
    )


def _rows(
    setup: Setup,
    holes: FloatArray,
    members: IntArray,
    legs: list[tuple[int, int]],
    value: FloatArray,
    timing: tuple[float, float],
) -> Measurements:
    n = len(members)
    leg = np.array(legs)
    vector = holes[members[:, leg[:, 1]]] - holes[members[:, leg[:, 0]]]
    zeros = np.zeros(n, dtype=np.intp)
    return Measurements(
        value=value,
        u_m=vector[..., 0],
        v_m=vector[..., 1],
        wavelength_m=np.full(n, setup.wavelength_m[0]),
        band_m=np.full(n, setup.band_m[0]),
        mjd=np.full(n, timing[0]),
        integration_s=np.full(n, timing[1]),
        stations=members,
        setup=zeros,
        row=np.arange(n),
        channel=zeros,
        flag=~np.isfinite(value),
    )


def series(extraction: Extraction) -> tuple[FloatArray, FloatArray]:
    """V² (n, n_baselines) and closure phase (n, n_triangles) of the integrations in use."""
    mean = extraction.average
    n = len(mean.vis2)
    closure = mean.closure_phase + mean.deviation[:, n:]
    return mean.vis2 + mean.deviation[:, :n], closure


def integrations(extraction: Extraction) -> Observables:
    """Every integration in use as an epoch of its own, with the covariance of one.

    Raises
    ------
    DataError
        Where there is only one.
    """
    used = np.flatnonzero(extraction.frames.used)
    if len(used) < 2:
        raise DataError(
            "holds one integration only", source=extraction.sources[0], remedy="leave it as it is"
        )
    vis2, closure = series(extraction)
    mean = extraction.observables.without_shared_errors()
    shared = extraction.observables.shared
    n = len(used)
    whole = mean.covariance.stretched(np.full(mean.covariance.size, np.sqrt(n)))
    # The scatter is that of these very data: what it does not tell of the covariance they do
    # not tell again, and a t likelihood of all of them would be too narrow.
    alone = replace(mean, covariance=whole, covariance_kind="given", freedom=None, scatter=None)
    one = alone.with_shared_errors(shared)
    time = extraction.frames.mjd[used]
    parts = []
    for k in range(n):
        mjd = time[k] if np.isfinite(time[k]) else mean.vis2.mjd[0]
        parts.append(
            replace(
                one,
                vis2=_at(mean.vis2, vis2[k], mjd, n),
                closure_phase=_at(mean.closure_phase, closure[k], mjd, n),
            )
        )
    return join(parts)


def _at(table: Measurements, value: FloatArray, mjd: float, n: int) -> Measurements:
    return replace(
        table,
        value=value,
        mjd=np.full(len(value), mjd),
        integration_s=table.integration_s / n,
    )
