"""Observables: the one table of squared visibilities, closure phases and their covariance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from astropy.table import QTable
from scipy.sparse import csr_array

from amibayes.data.covariance import BlockCovariance, stack_covariances
from amibayes.data.degrees_of_freedom import Freedom, stacked_freedom, stacked_scatter
from amibayes.data.kernel_model import stands_alone
from amibayes.data.measurements import Measurements
from amibayes.data.setup import Setup
from amibayes.data.shared_errors import SharedErrors, joined_errors, vis2_first, with_shared
from amibayes.data.tables import measurements_table
from amibayes.errors import DataError
from amibayes.support.arguments import one_of
from amibayes.support.notebook import html_table
from amibayes.units import BoolArray, FloatArray

CovarianceKind = Literal["diagonal", "assumed", "given", "estimated"]

KINDS = ("vis2", "closure_phase")
"""Kinds of data that have a table."""


@dataclass(frozen=True, eq=False)
class Observables:
    """Squared visibilities and closure phases with the covariance of what is not flagged.

    Parameters
    ----------
    vis2, closure_phase : Measurements
    covariance : BlockCovariance
        Of the unflagged data, V² first, then closure phases in radians.
    covariance_kind : {"diagonal", "assumed", "given", "estimated"}
        Independent errors; errors only, closures correlated through shared baselines;
        correlations from the file; from the scatter of ``n_integrations``.
    setups : tuple of Setup
    n_integrations : int, optional
        Number of integrations an estimated covariance rests on.
    notes : tuple of str
        What the reader had to decide (tables not used, columns absent, …).
    freedom : Freedom, optional
        Of an estimated covariance; without it the covariance counts as known.
    scatter : sparse array, optional
        The covariance as the measured scatter alone has it, without the expected noise.
    shared : SharedErrors, optional
        Errors in common with other data sets; both covariances hold them.

    Raises
    ------
    DataError
        Where a covariance does not fit the unflagged data, or a value in use is not finite.
    """

    vis2: Measurements
    closure_phase: Measurements
    covariance: BlockCovariance
    covariance_kind: CovarianceKind
    setups: tuple[Setup, ...]
    n_integrations: int | None = None
    notes: tuple[str, ...] = ()
    freedom: Freedom | None = None
    scatter: csr_array | None = None
    shared: SharedErrors | None = None

    def __post_init__(self) -> None:
        sizes = [self.covariance.size, *([] if self.scatter is None else self.scatter.shape)]
        sizes += [] if self.shared is None else [len(self.shared.changes)]
        for size in sizes:
            if size != len(self.data):
                raise DataError(
                    f"a covariance of size {size} for {len(self.data)} data", source=self.source
                )
        if not np.isfinite(self.data).all():
            raise DataError("a value in use is not finite", source=self.source, remedy="flag it")

    @property
    def source(self) -> str:
        """The files the data come from."""
        return ", ".join(dict.fromkeys(s.source for s in self.setups if s.source))

    @cached_property
    def data(self) -> FloatArray:
        """The unflagged data, V² first, then closure phases in radians."""
        v, c = self.vis2, self.closure_phase
        return np.concatenate([v.value[~v.flag], c.value[~c.flag]])

    @property
    def n_vis2(self) -> int:
        """Number of unflagged squared visibilities."""
        return int((~self.vis2.flag).sum())

    @property
    def n_closure_phases(self) -> int:
        """Number of unflagged closure phases."""
        return int((~self.closure_phase.flag).sum())

    @property
    def phase_name(self) -> str:
        """What the phases are: closure phases, kernel phases or both, in the singular."""
        alone = stands_alone(self.closure_phase.stations)
        both = "closure or kernel phase" if alone.any() else "closure phase"
        return "kernel phase" if alone.any() and alone.all() else both

    @property
    def n_independent(self) -> int:
        """Number of independent data."""
        return self.covariance.rank

    @property
    def degrees_of_freedom(self) -> float:
        """Of the t distribution of the data; infinite where it is Gaussian."""
        return np.inf if self.freedom is None else self.freedom.degrees

    @cached_property
    def errors(self) -> tuple[FloatArray, FloatArray]:
        """1σ errors of V² and closure phase (radians); NaN where flagged."""
        flagged = np.full(len(self.vis2), np.nan), np.full(len(self.closure_phase), np.nan)
        return self._put_in(np.sqrt(self.covariance.variance), *flagged)

    def _put_in(
        self, data: FloatArray, vis2: FloatArray, closure: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Copies of columns of V² and closure phase, with (n_data,) numbers where not flagged."""
        vis2, closure = vis2.copy(), closure.copy()
        parts = np.split(np.asarray(data), [self.n_vis2])
        vis2[~self.vis2.flag], closure[~self.closure_phase.flag] = parts
        return vis2, closure

    def unflagged(self) -> Observables:
        """The same data without the flagged entries."""
        return replace(
            self,
            vis2=self.vis2.select(~self.vis2.flag),
            closure_phase=self.closure_phase.select(~self.closure_phase.flag),
        )

    def select(self, vis2: BoolArray, closure_phase: BoolArray) -> Observables:
        """The entries where the masks are true; the covariance follows."""
        used = np.concatenate([vis2[~self.vis2.flag], closure_phase[~self.closure_phase.flag]])
        vis2_left, closure_left = self.vis2.select(vis2), self.closure_phase.select(closure_phase)
        return self._of_part(vis2_left, closure_left, used)

    def flagged(self, vis2: BoolArray, closure_phase: BoolArray) -> Observables:
        """The same with entries flagged where the masks are true, besides those that are."""
        vis2, closure = vis2 | self.vis2.flag, closure_phase | self.closure_phase.flag
        used = np.concatenate([~vis2[~self.vis2.flag], ~closure[~self.closure_phase.flag]])
        tables = replace(self.vis2, flag=vis2), replace(self.closure_phase, flag=closure)
        return self._of_part(*tables, used)

    def _of_part(self, vis2: Measurements, closure: Measurements, used: BoolArray) -> Observables:
        """Other tables, with the errors of those unflagged data (n_data,) that they use."""
        return replace(
            self,
            vis2=vis2,
            closure_phase=closure,
            covariance=self.covariance.select(np.flatnonzero(used)),
            scatter=None if self.scatter is None else self.scatter[used][:, used],
            shared=None if self.shared is None else self.shared.select(used),
        )

    def with_data(self, data: FloatArray) -> Observables:
        """The same with other values (n_data,): V², then closure phases in radians.

        Flagged entries keep theirs.
        """
        vis2, closure = self._put_in(data, self.vis2.value, self.closure_phase.value)
        return replace(
            self,
            vis2=replace(self.vis2, value=vis2),
            closure_phase=replace(self.closure_phase, value=closure),
        )

    def with_shared_errors(self, shared: SharedErrors | None) -> Observables:
        """Data with errors in common with others put into the covariance, beside those it holds."""
        if shared is None:
            return self
        every = shared if self.shared is None else self.shared.beside(shared)
        return replace(self._covariance_moved(shared, 1.0), shared=every)

    def without_shared_errors(self) -> Observables:
        """Data with the covariance of their own errors only."""
        if self.shared is None:
            return self
        return replace(self._covariance_moved(self.shared, -1.0), shared=None)

    def _covariance_moved(self, shared: SharedErrors, sign: float) -> Observables:
        scatter = None if self.scatter is None else shared.added(self.scatter, sign)
        return replace(self, covariance=with_shared(self.covariance, shared, sign), scatter=scatter)

    def only(self, kinds: Sequence[str]) -> Observables:
        """The data of the given kinds, out of ``vis2`` and ``cp``.

        Raises
        ------
        DataError
            Where nothing is left.
        """
        n, m = len(self.vis2), len(self.closure_phase)
        chosen = self.select(np.full(n, "vis2" in kinds), np.full(m, "cp" in kinds))
        if not len(chosen.data):
            raise DataError(f"holds no usable {' or '.join(kinds)}", source=self.source)
        return chosen

    def to_table(self, kind: Literal["vis2", "closure_phase"] = "vis2") -> QTable:
        """One kind of data as an astropy table with units."""
        one_of("Observables.to_table", "kind", kind, KINDS)
        number = KINDS.index(kind)
        measured = (self.vis2, self.closure_phase)[number]
        return measurements_table(kind, measured, self.errors[number], self.setups, self.source)

    def _repr_html_(self) -> str:
        wavelengths = np.concatenate([setup.wavelength_m for setup in self.setups]) * 1e6
        rows = [
            ("squared visibilities", self.n_vis2),
            ("closure phases", self.n_closure_phases),
            ("independent numbers", self.n_independent),
            ("covariance", self.covariance_kind),
            ("instruments", ", ".join(dict.fromkeys(s.insname for s in self.setups))),
            ("targets", ", ".join(dict.fromkeys(s.target for s in self.setups if s.target))),
            ("wavelengths (µm)", f"{wavelengths.min():.4g} to {wavelengths.max():.4g}"),
            ("source", self.source),
            *(("note", note) for note in self.notes),
        ]
        return html_table("Observables", (), rows)

    def __repr__(self) -> str:
        return (
            f"<Observables: {self.n_vis2} V², {self.n_closure_phases} closure phases, "
            f"{self.n_independent} independent data, {self.covariance_kind} covariance, "
            f"{', '.join(dict.fromkeys(s.insname for s in self.setups))}>"
        )


def join(parts: Sequence[Observables]) -> Observables:
    """Lay data sets together for one fit.

    The kind of the whole covariance is that of its least certain part, in the order
    given, estimated, assumed, diagonal (of parts with closure phases, where there are any: V² alone
    is diagonal by itself); its freedom that of `stacked_freedom`.
    """
    if len(parts) == 1:
        return parts[0]
    if any(p.shared is not None for p in parts):  # which correlate the parts
        shared = joined_errors([(p.n_vis2, p.n_closure_phases, p.shared) for p in parts])
        return join([p.without_shared_errors() for p in parts]).with_shared_errors(shared)
    shifts = np.cumsum([0, *(len(p.setups) for p in parts)])
    order = vis2_first([(p.n_vis2, p.n_closure_phases) for p in parts])
    kinds: list[CovarianceKind] = ["diagonal", "assumed", "estimated", "given"]
    closing = [p for p in parts if p.n_closure_phases or p.covariance_kind != "diagonal"]
    known = [p.n_integrations for p in parts if p.n_integrations is not None]
    scatter = stacked_scatter((p.covariance, p.scatter) for p in parts)
    return Observables(
        Measurements.joined([p.vis2 for p in parts], shifts),
        Measurements.joined([p.closure_phase for p in parts], shifts),
        stack_covariances([p.covariance for p in parts]).select(order),
        min((p.covariance_kind for p in closing or parts), key=kinds.index),
        tuple(s for p in parts for s in p.setups),
        min(known) if known else None,
        tuple(dict.fromkeys(n for p in parts for n in p.notes)),
        stacked_freedom((p.n_independent, p.freedom) for p in parts),
        None if scatter is None else scatter[order][:, order],
    )
