"""What a search reports, stage by stage."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

from amibayes.calibration import Calibration
from amibayes.companion_search.result import SearchResult
from amibayes.comparison.compare import ModelComparison
from amibayes.comparison.limits import LimitsBeside
from amibayes.data.observables import Observables
from amibayes.detection.false_alarm import Significance
from amibayes.detection.outlying_rows import OutlyingRow
from amibayes.detection.splits import Consistency
from amibayes.detection.verdict import Statement, Verdict
from amibayes.extraction.charge import CubeMigration
from amibayes.likelihood.averaged_noise import NoisePosterior
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.limits.limit import DetectionLimit
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.vetting import Vetting
from amibayes.posterior.bootstrap import Bootstrap
from amibayes.posterior.ensemble import Posterior
from amibayes.posterior.evidence import Evidence
from amibayes.posterior.grid import GridPosterior
from amibayes.support.notebook import Rows, Shown


@dataclass(frozen=True, eq=False, repr=False)
class SearchReport(Shown):
    """Everything the main job found, for `amibayes.report` and `amibayes.plots`."""

    options: SearchOptions
    targets: tuple[str, ...]
    calibrators: tuple[str, ...]
    observables: Observables
    calibration: Calibration | None
    references: tuple[Observables, ...]
    vetting: Vetting | None
    result: SearchResult
    noise: ExtraNoise
    significance: Significance | None
    posterior: Posterior | None
    limits: DetectionLimit | None
    warnings: tuple[str, ...]
    grid: GridPosterior | None = None
    evidence: Evidence | None = None
    noise_posterior: dict[str, NoisePosterior] | None = None
    second_significance: Significance | None = None
    verdict: Verdict | None = None
    consistency: tuple[Consistency, ...] = ()
    bootstrap: Bootstrap | None = None
    models: ModelComparison | None = None
    limits_beside: LimitsBeside | None = None
    charge_migration: CubeMigration | None = None
    left_out: tuple[OutlyingRow, ...] = ()
    timing_s: dict[str, float] = field(default_factory=dict)

    @property
    def statement(self) -> Statement | None:
        """What the verdict says; None where nothing was tested."""
        return None if self.verdict is None else self.verdict.statement

    @property
    def star_alone(self) -> dict[str, tuple[float, float]]:
        """Value and error of each free parameter of the star without a companion.

        Where there is none, with the noise that the star leaves: a companion takes for its light
        what a star alone, and its diameter, has as noise.
        """
        said = self.verdict
        return said.star if said is not None and said.star else self.result.star_alone()

    def rows(self) -> Rows:
        """What an interpreter shows."""
        stages = ("significance", "posterior", "limits", "evidence", "models")
        kept = [stage for stage in stages if getattr(self, stage) is not None]
        chance = self.significance
        return [
            ("targets", ", ".join(self.targets)),
            ("calibrators", ", ".join(self.calibrators) or "none"),
            ("statement", self.statement or "not tested"),
            *([] if self.models is None else [("models", self.models.verdict.statement)]),
            ("best fit", repr(self.result).strip("<>").removeprefix("SearchResult: ")),
            ("false alarm", "not tested" if chance is None else f"{chance.probability:.3g}"),
            ("holds", ", ".join(["result", "observables", *kept])),
            *(("warning", text) for text in self.warnings),
        ]


@dataclass(frozen=True)
class Stages:
    """What a run holds, known before it begins: which pictures there will be.

    Several files that are fitted together, calibrators, these stages, models of the sky with
    parameters, and ramps that charge migration was fitted to.
    """

    several: bool = False
    calibrated: bool = False
    significance: bool = False
    posterior: bool = False
    limits: bool = False
    models: bool = False
    fitted: bool = False
    ramps: bool = False

    @classmethod
    def asked(cls, options: SearchOptions, *, calibrated: bool, several: bool = False) -> Self:
        """Those of a run that has yet to begin; whether there are ramps it tells when it has."""
        tested = options.null_draws != 0
        limits = options.limits and tested
        models = options.models is not None
        return cls(several, calibrated, tested, options.posterior, limits, models, models, True)

    @classmethod
    def of(cls, report: SearchReport) -> Self:
        """Those of a run that has ended."""
        return cls(
            len(report.targets) > 1,
            bool(report.calibrators),
            report.significance is not None,
            report.posterior is not None,
            report.limits is not None,
            report.models is not None,
            report.models is not None and any(m.names for m in report.models.models),
            report.charge_migration is not None and report.charge_migration.fit is not None,
        )


def calibrator_verdicts(report: SearchReport) -> list[dict[str, object]]:
    """Every calibrator in the order given: vetting's verdict, then what calibration used.

    Files that are dithers of one star are one calibrator, with the names of all as its path.
    """
    if report.calibration is None:
        return []
    used = iter(report.calibration.calibrators)
    verdicts = None if report.vetting is None else report.vetting.calibrators
    out: list[dict[str, object]] = []
    for k, reference in enumerate(report.references):
        vetted = None if verdicts is None else verdicts[k]
        verdict = vetted if vetted is not None and not vetted.kept else next(used)
        agreement = None if vetted is None else vetted.agreement
        out.append(
            {
                "path": reference.source,
                "kept": verdict.kept,
                "reason": verdict.reason,
                "agreement_probability": agreement,
            }
        )
    return out
