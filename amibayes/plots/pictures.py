"""The pictures of the main job, by file name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from amibayes.companion_search.field import resolution_mas
from amibayes.comparison.compare import ModelComparison
from amibayes.detection.residuals import file_residuals
from amibayes.parallel import Executor, SerialExecutor
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import SearchReport, Stages, calibrator_verdicts
from amibayes.plots import models
from amibayes.plots.calibration import calibrator_plot
from amibayes.plots.charge_migration import migration_plot
from amibayes.plots.contrast_curve import Curve, completeness_picture, limits_plot
from amibayes.plots.corner_plot import corner_plot, trace_plot
from amibayes.plots.coverage import coverage_plot
from amibayes.plots.fit import file_residuals_plot, fit_plot
from amibayes.plots.maps import (
    detection_map,
    false_alarm_map,
    local_n_sigma,
    probability_maps,
    save_maps_fits,
    sky_map,
)
from amibayes.plots.null_plot import null_plot
from amibayes.plots.residual_corr import correlation_plot
from amibayes.plots.style import save
from amibayes.support.atomic_files import short_names
from amibayes.units import FloatArray, contrast_to_delta_mag

MAPS = "maps.fits"
"""The numbers of the maps, beside the pictures."""


def always(run: Stages) -> bool:
    """Hold for every run."""
    return True


@dataclass(frozen=True)
class Picture:
    """A picture of the report, and all that is known of it.

    Parameters
    ----------
    name : str
        Of its file, without the ending.
    title : str
        What it shows, in a few words.
    text : str
        What it shows, for those who cannot see it.
    section : str
        Of the report, a key of `amibayes.report.search_page.SECTIONS`.
    draw : callable
        Draws it of a `SearchReport`.
    when : callable
        Decides from the `Stages` of a run whether it is drawn.
    """

    name: str
    title: str
    text: str
    section: str
    draw: Callable[[SearchReport], Figure]
    when: Callable[[Stages], bool] = always

    @property
    def file(self) -> str:
        """Name of its file."""
        return f"{self.name}.png"


def picture_names(options: SearchOptions, *, calibrated: bool, several: bool = False) -> list[str]:
    """List the files that `save_pictures` may write for a job: some need what a run finds."""
    run = Stages.asked(options, calibrated=calibrated, several=several)
    return [*(p.file for p in PICTURES if p.when(run)), MAPS]


def save_pictures(
    report: SearchReport, folder: Path, executor: Executor | None = None
) -> list[Path]:
    """Draw every picture of a report into a folder, and give their files."""
    draw_files(report, files := picture_files(report, folder), executor or SerialExecutor())
    save_maps_fits(folder / MAPS, report.result, _probabilities(report))
    return files


def picture_files(report: SearchReport, folder: Path) -> list[Path]:
    """List the files of the pictures that a report has."""
    return [folder / picture.file for picture in pictures_of(report)]


def draw_files(report: SearchReport, files: Sequence[Path], executor: Executor) -> None:
    """Draw some of them, several at a time where there are workers."""
    list(executor.map(partial(_save_picture, report), files))


def _save_picture(report: SearchReport, path: Path) -> None:
    # A path travels between processes, what draws a picture does not.
    picture = next(p for p in PICTURES if p.name == path.stem)
    save(picture.draw(report), path)


def pictures_of(report: SearchReport) -> list[Picture]:
    """List the pictures that a report has."""
    return [picture for picture in PICTURES if picture.when(Stages.of(report))]


def _probabilities(report: SearchReport) -> dict[str, FloatArray]:
    """False-alarm probabilities per position, by the name of their FITS extension."""
    found = report.significance
    if found is None or found.field is None:
        return {}
    return {f"FAP_{name}": p for name, p in probability_maps(found).items()}


def _map(report: SearchReport) -> Figure:
    return detection_map(report.result, quantity="delta_chi2", contrast="positive")


def _nsigma(report: SearchReport) -> Figure:
    label = "CANDID nσ of the best companion at each position (σ)"
    return sky_map(report.result, local_n_sigma(report.result), label)


def _false_alarm(report: SearchReport) -> Figure:
    assert report.significance is not None
    return false_alarm_map(report.result, report.significance)


def _migration(report: SearchReport) -> Figure:
    assert report.charge_migration is not None
    assert report.charge_migration.fit is not None
    return migration_plot(report.charge_migration.fit)


def _calibrators(report: SearchReport) -> Figure:
    kept, stars = [bool(c["kept"]) for c in calibrator_verdicts(report)], report.references
    return calibrator_plot(stars, kept, short_names([star.source for star in stars]))


def _null(report: SearchReport) -> Figure:
    tested = report.significance
    assert tested is not None
    label = (
        "Largest 2Δln L anywhere in the field, scale of the noise free"
        if tested.test is not None and tested.test.label != "Δχ²"
        else "Largest Δχ² anywhere in the field"
    )
    return null_plot(
        tested.null,
        tested.statistic,
        tested.tail_curves(),
        alpha=tested.alpha,
        statistic=label,
    )


def _corner(report: SearchReport) -> Figure:
    posterior = report.posterior
    assert posterior is not None
    return corner_plot(
        posterior.samples, _labels(report), best=[float(x) for x in report.result.theta]
    )


def _labels(report: SearchReport) -> list[str]:
    """Parameters of the posterior, every contrast with its band where there are several."""
    assert report.posterior is not None
    bands = report.result.likelihood.model.bands
    firsts = {"contrast", "contrast_2"} if bands else set()
    return [f"{n}[{bands[0]}]" if n in firsts else n for n in report.posterior.names]


def _chains(report: SearchReport) -> Figure:
    posterior = report.posterior
    assert posterior is not None
    return trace_plot(posterior.chain, _labels(report), posterior.n_burn)


def _limits(report: SearchReport) -> Figure:
    limits = report.limits
    assert limits is not None
    middle = contrast_to_delta_mag(limits.contrast_50)
    curves = {
        f"{100.0 * limits.completeness:.0f} % recovered": Curve(
            limits.delta_mag, by_detection=limits.by_detection
        ),
        "50 % recovered": Curve(middle, by_detection=limits.by_detection),
    }
    tested = report.significance
    found = report.result.companion if tested is not None and tested.detected else None
    fringe = resolution_mas(report.result.likelihood)
    return limits_plot(limits.separation_mas, curves, found, fringe_mas=fringe)


def _of_models(draw: Callable[[ModelComparison], Figure]) -> Callable[[SearchReport], Figure]:
    """Draw the comparison of models of a report."""

    def drawn(report: SearchReport) -> Figure:
        assert report.models is not None
        return draw(report.models)

    return drawn


PICTURES = (
    Picture(
        "map",
        "Detection map",
        "Improvement of the fit by a companion at every position of the field, north up and "
        "east left, with the best position and the other local maxima marked.",
        "search",
        _map,
    ),
    Picture(
        "fit",
        "Data and model",
        "Squared visibilities and closure phases with their errors, the best binary model, "
        "and the residuals in units of the errors.",
        "search",
        lambda report: fit_plot(report.result),
    ),
    Picture(
        "files",
        "Residuals of each file",
        "Reduced χ² of the V² and of the closure phases of each file under the joint fit, "
        "with the companion and without.",
        "search",
        lambda report: file_residuals_plot(file_residuals(report.result)),
        lambda run: run.several,
    ),
    Picture(
        "coverage",
        "Coverage",
        "Spatial frequencies that the data sample; they set which positions can be distinguished.",
        "data",
        lambda report: coverage_plot(report.result.likelihood.observables),
    ),
    Picture(
        "correlation",
        "Correlations",
        "Correlation of every pair of data, as the fit uses them.",
        "data",
        lambda report: correlation_plot(report.result.likelihood.observables),
    ),
    Picture(
        "calibrators",
        "Calibrators",
        "Squared visibilities and closure phases of every calibrator beside each other, those "
        "that were dropped marked.",
        "data",
        _calibrators,
        lambda run: run.calibrated,
    ),
    Picture(
        "charge_migration",
        "Charge migration",
        "Change of the current along the ramps, measured and as charge migration has it: of every "
        "pixel about the star, of the pixels across the fringes along a row and a column, of "
        "groups of pixels with errors, and how far the predicted pattern is in the current with "
        "time from the reset.",
        "noise",
        _migration,
        lambda run: run.ramps,
    ),
    Picture(
        "null",
        "Null distribution",
        "Best statistic of each simulated data set without a companion, the threshold of a "
        "detection, and the value of the data.",
        "significance",
        _null,
        lambda run: run.significance,
    ),
    Picture(
        "false_alarm",
        "False-alarm probability",
        "Probability that noise alone gives a companion as good as that of each position, anywhere "
        "in the field: grey where it is no detection, coloured below the threshold, and of one "
        "colour from where the null draws tell no more. A companion that was detected is taken out "
        "of the data elsewhere, as its sidelobes are no noise; the darkest grey there is structure "
        "that the fit leaves.",
        "significance",
        _false_alarm,
        lambda run: run.significance,
    ),
    Picture(
        "nsigma",
        "CANDID's nσ",
        "CANDID's number of sigma of the best companion at every position; it is not a "
        "false-alarm rate.",
        "significance",
        _nsigma,
    ),
    Picture(
        "corner",
        "Posterior",
        "Marginal distributions of every parameter, with lines at the median and the 68 % "
        "interval, and of every pair, with contours that hold 68 and 95 %; the best fit is marked.",
        "posterior",
        _corner,
        lambda run: run.posterior,
    ),
    Picture(
        "chains",
        "Chains",
        "Every walker's path through every parameter, with the part that was thrown away.",
        "posterior",
        _chains,
        lambda run: run.posterior,
    ),
    Picture(
        "limits",
        "Detection limits",
        "Magnitude difference at which an injected companion is recovered, against separation.",
        "limits",
        _limits,
        lambda run: run.limits,
    ),
    Picture(
        "completeness",
        "Completeness",
        "Share of injected companions that the search recovers, for each separation and "
        "magnitude difference.",
        "limits",
        lambda report: completeness_picture(report.limits),  # type: ignore[arg-type]
        lambda run: run.limits,
    ),
    Picture(
        "models_images",
        "Models of the sky",
        "The best fit of each model without its star, on one scale of brightness, north up and "
        "east left, with the beam in the lower left corner.",
        "models",
        _of_models(models.model_images),
        lambda run: run.models,
    ),
    Picture(
        "models_odds",
        "Odds and confusion",
        "Evidence of each model below that of the most probable one, and what data simulated "
        "from each model are taken for.",
        "models",
        _of_models(models.model_odds),
        lambda run: run.models,
    ),
    Picture(
        "models_visibilities",
        "Data and models",
        "Squared visibilities against the position angle of the baseline, and closure phases, "
        "with the best fit of each model.",
        "models",
        _of_models(models.model_visibilities),
        lambda run: run.models,
    ),
    Picture(
        "models_residuals",
        "Residuals of each model",
        "What the best fit of each model leaves, in units of the errors.",
        "models",
        _of_models(models.model_residuals),
        lambda run: run.models,
    ),
    Picture(
        "models_corner",
        "Posterior of the most probable model that has parameters",
        "Marginal distributions of its parameters, one by one and in pairs; fluxes as logarithms.",
        "models",
        _of_models(models.model_corner),
        lambda run: run.fitted,
    ),
)
"""The pictures of a search, in the order of the report: a new one is one more line here."""
