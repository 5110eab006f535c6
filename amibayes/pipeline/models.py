"""The stage that compares models of the sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from amibayes.companion_search.field import default_separation
from amibayes.comparison.agreement import agreement
from amibayes.comparison.best_fits import NoiseSetting
from amibayes.comparison.compare import ModelComparison, compare_sky_models
from amibayes.comparison.hypotheses import FAMILIES
from amibayes.comparison.limits import LimitsBeside, limits_beside, searchable
from amibayes.detection.verdict import Verdict
from amibayes.likelihood.chi2 import REJECTED
from amibayes.likelihood.likelihood import Likelihood
from amibayes.pipeline.field import FieldSearch
from amibayes.pipeline.options import SearchOptions, noise_prior
from amibayes.pipeline.report_types import SearchReport
from amibayes.pipeline.run import Run
from amibayes.posterior.priors import Prior
from amibayes.support.options import NULL_DRAWS, SAMPLERS


def compare_stage(
    found: FieldSearch,
    prior: Prior,
    options: SearchOptions,
    rng: np.random.Generator,
    run: Run,
) -> ModelComparison | None:
    """Compare the models that were asked for; None where none were.

    Residuals of Student's t distribution keep the noise that the robust search has.
    """
    if options.models is None:
        return None
    used = found.observables.only(options.observables)
    fitted = options.extra_noise and not options.robust
    noise = NoiseSetting(
        found.noise,
        noise_prior(used, options) if fitted else None,
        per_file=options.file_noise is not False,
    )
    method = options.evidence_method if options.evidence_method in SAMPLERS else "direct"
    with run.stage("models"):
        return compare_sky_models(
            found.result,
            prior,
            rng,
            models=options.models,
            stated=used if fitted else None,
            noise=noise,
            settings=options.settings[1],
            method=method,
            default_field=_default_field(found, options),
            executor=run.executor,
            journal=run.journal("confusion"),
            progress=run.progress,
        )


def limits_stage(
    models: ModelComparison | None,
    found: FieldSearch,
    options: SearchOptions,
    rng: np.random.Generator,
    run: Run,
) -> LimitsBeside | None:
    """Measure detection limits beside the most probable disc or ring, where it is stated."""
    if models is None or not options.limits or options.null_draws == 0:
        return None
    stated = models.verdict.statement in (models.best.name, FAMILIES["extended"])
    if not stated or not searchable(models.best):
        return None
    grid = found.result.grid
    field = _default_field(found, options) or (grid.inner_mas, grid.outer_mas)
    with run.stage("limits beside the disc"):
        return limits_beside(
            models,
            found.result.likelihood,
            field,
            rng,
            alpha=options.alpha,
            null_draws=options.null_draws or NULL_DRAWS,
            executor=run.executor,
        )


def with_models(
    report: SearchReport, found: ModelComparison | None, beside: LimitsBeside | None
) -> SearchReport:
    """Put a comparison of models, and what is to be warned of, in a report."""
    # First: the summary has room for a few.
    warnings = (*models_warnings(found, report.verdict), *report.warnings)
    return replace(report, models=found, limits_beside=beside, warnings=warnings)


def models_warnings(
    found: ModelComparison | None, verdict: Verdict | None = None
) -> tuple[str, ...]:
    """Warn of what makes the comparison less than it seems, and where the verdict is another."""
    if found is None:
        return ()
    warnings = []
    if found.best.p_fit < REJECTED:
        warnings.append(
            f"the most probable model of the sky, {found.best.name}, does not fit: chi2 is "
            f"{found.best.chi2:.4g} for {found.best.ndof} degrees of freedom; odds between models "
            "that do not fit mean little"
        )
    beside = agreement(found, verdict).warning
    return (*warnings, beside) if beside else tuple(warnings)


def _default_field(found: FieldSearch, options: SearchOptions) -> tuple[float, float] | None:
    """The default field, where the search went past it by itself."""
    if options.separation_mas is not None:
        return None
    inner, outer = default_separation(Likelihood(found.result.likelihood.observables))
    return (inner, outer) if found.result.grid.outer_mas > 1.01 * outer else None
