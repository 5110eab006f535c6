"""The main job's request and its answer."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from amibayes.companion_search.optimise import fit_single
from amibayes.comparison.hypotheses import split_settings
from amibayes.data.observables import Observables
from amibayes.data.systematics import systematics_of
from amibayes.extraction.reading import ImageOptions
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.bands import reference_wavelength
from amibayes.models.binary import BinaryModel
from amibayes.posterior.priors import PriorSetting
from amibayes.support.arguments import annulus, checks_arguments, in_range, one_of
from amibayes.support.options import (
    ALPHA,
    CLIP_CALIBRATORS,
    COMPANIONS,
    EVIDENCE_METHODS,
    NOISE_PRIOR,
    OBSERVABLES,
    SAMPLERS,
    SEED,
    CalibrationMethod,
    ClosureCovariance,
    ContrastSharing,
)
from amibayes.units import MAS

RANGES = {
    "diameter": (0.0, np.inf), "limb_darkening": (0.0, np.inf), "clip": (0.0, np.inf),
    "companion_diameter": (0.0, np.inf), "background": (0.0, np.inf), "alpha": (0.0, 1.0),
    "contrast_slope": (-np.inf, np.inf), "bin_channels": (1, np.inf), "null_draws": (0, np.inf),
    "merge_epochs_days": (0.0, np.inf), "fastest_mas_yr": (0.0, np.inf), "seed": (0, np.inf),
    "bootstrap": (0, np.inf),
}  # fmt: skip
"""Least and largest numbers of the fields of `SearchOptions`."""


@checks_arguments
@dataclass(frozen=True)
class SearchOptions:
    """What the main job is asked to do.

    Parameters
    ----------
    separation_mas : (inner, outer), optional
        By default λ/2B_max to λ/B_min of the data.
    observables : tuple of {"vis2", "cp"}
    diameter : float, "free" or None
        Diameter of the primary, mas. None: free where V² is used, or where the contrast that
        closure phases alone give depends on it, else 0.
    limb_darkening : float, "free" or None
        Exponent α of the brightness μ^α of the primary's disc. None: 0, and free where V²
        reaches past the first null of a free disc.
    companion_diameter : float, "free" or None
        Uniform-disc diameter of companions, mas. None: 0, or free where data show the disc of
        the companion that is found.
    contrast_slope : float or "free"
        Exponent of the flux ratio with wavelength.
    background : float or "free"
        Over-resolved flux in units of the primary's.
    smearing : bool
    closure_covariance : {"assumed", "diagonal"}
        For files that give errors and no correlations.
    calibration : {"hierarchical", "weighted", "population"}, optional
        By default population with a library, else hierarchical where 2 calibrators or more share
        a baseline.
    library : Path, optional
        Calibrators of other nights that are used beside those that are given
        (`amibayes.calibration.library`).
    clip : float
        Sigma clipping of the calibrators.
    keep_all : bool
        Use all calibrators, whatever vetting finds.
    insname, target : str, optional
        One instrument, one target of a file that holds several.
    cal_target : tuple of str
        Calibrators of files that hold several stars; by default every star but the targets.
    flag : tuple of str
        Rules of `amibayes.flag_by_rule`, for targets and calibrators.
    average_polarisations : bool
        Average instrument tables that differ in a last P1, P2.
    bin_channels : int
        Adjacent channels that are averaged.
    merge_epochs_days : float, optional
        Average the targets' exposures within this time, while (u, v) stays.
    calibrator_diameters : str, optional
        Uniform discs, as ``0.31:0.02,0.4`` in mas, or a table; see
        `amibayes.calibration.diameters_of`.
    null_draws : int, optional
        0 leaves the false-alarm probability out. By default 10 000, and fewer where data and
        positions are so many that these would take minutes.
    alpha : float
        False-alarm probability of a detection.
    contrast : {"tied", "per-filter"}, optional
        One contrast for all bands, or one for each: the default with several bands.
    motion : bool
        The companion moves linearly between the dates of the data.
    fastest_mas_yr : float, optional
        Largest rate of a motion along east and along north; by default λ/B_max over the span.
    extra_noise : bool
        Add noise per kind of observable where the residuals ask for it.
    channel_noise : bool
        Fit what the channels of one exposure share of the noise.
    noise_prior : (float, float)
        Widths of the half-normal prior of extra noise: of V², relative to it, and of closure
        phases, degrees. It is at most three times as large.
    bootstrap : int
        Fits to exposures drawn anew, for intervals beside the posterior's; 0: none.
    systematics : "table", "none" or (float, float)
        Floor of calibration errors that channels of an exposure share: of a table by
        instrument, for files of few exposures, or share of V² and degrees of closure phase.
    robust : bool
        Student-t residuals: data that fit nothing lose their weight.
    keep_outliers : bool
        Use all rows, those too that the best fit to all others is far from explaining.
    file_noise : bool, optional
        Fit that noise to every file by itself; by default where there are several.
    posterior, limits : bool
        Whether to sample the posterior, and to measure detection limits (which need the
        null draws).
    companions : tuple of int, optional
        Numbers of companions (0, 1, 2) whose evidences are compared; by default 0 and 1
        where the posterior is sampled.
    models : tuple of str, optional
        Models of the sky that are compared (`amibayes.support.options.SKY_MODELS`), with the
        confusion matrix of the data; None for the evidence of companions alone.
    evidence_method : {"direct", "laplace", "nested"}
        See `amibayes.posterior.evidence`.
    prior : tuple of PriorSetting
        Changes of the default prior.
    seed : int
    images : ImageOptions, optional
        How image cubes are turned into observables.
    """

    separation_mas: tuple[float, float] | None = None
    observables: tuple[str, ...] = OBSERVABLES
    diameter: float | Literal["free"] | None = None
    limb_darkening: float | Literal["free"] | None = None
    companion_diameter: float | Literal["free"] | None = None
    contrast_slope: float | Literal["free"] = 0.0
    background: float | Literal["free"] = 0.0
    smearing: bool = True
    closure_covariance: ClosureCovariance = "assumed"
    calibration: CalibrationMethod | None = None
    library: Path | None = None
    clip: float = CLIP_CALIBRATORS
    keep_all: bool = False
    insname: str | None = None
    target: str | None = None
    cal_target: tuple[str, ...] = ()
    flag: tuple[str, ...] = ()
    average_polarisations: bool = False
    bin_channels: int = 1
    merge_epochs_days: float | None = None
    calibrator_diameters: str | None = None
    null_draws: int | None = None
    alpha: float = ALPHA
    contrast: ContrastSharing | None = None
    motion: bool = False
    fastest_mas_yr: float | None = None
    extra_noise: bool = True
    channel_noise: bool = True
    noise_prior: tuple[float, float] = NOISE_PRIOR
    bootstrap: int = 0
    systematics: Literal["table", "none"] | tuple[float, float] = "table"
    robust: bool = False
    keep_outliers: bool = False
    file_noise: bool | None = None
    posterior: bool = True
    limits: bool = True
    companions: tuple[int, ...] | None = None
    models: tuple[str, ...] | None = None
    evidence_method: str = EVIDENCE_METHODS[0]
    prior: tuple[PriorSetting, ...] = ()
    seed: int = SEED
    images: ImageOptions | None = None

    def __post_init__(self) -> None:
        annulus("SearchOptions", "separation_mas", self.separation_mas)
        for name, (low, high) in RANGES.items():
            in_range("SearchOptions", name, getattr(self, name), low, high)
        for name, known in (("observables", OBSERVABLES), ("companions", COMPANIONS)):
            for one in getattr(self, name) or ():
                one_of("SearchOptions", name, one, known)
        methods = (*EVIDENCE_METHODS, *SAMPLERS)  # those too that were put there since
        one_of("SearchOptions", "evidence_method", self.evidence_method, dict.fromkeys(methods))
        _ = self.settings  # which refuses what no model has, before anything is read

    @property
    def settings(self) -> tuple[tuple[PriorSetting, ...], tuple[PriorSetting, ...]]:
        """Settings of priors: of companions and star, and of extended light.

        Raises
        ------
        UsageError
            Where one is impossible, or a model is not known.
        """
        free = self.background == "free"
        return split_settings(self.prior, self.models or (), background=free)

    def to_json(self) -> dict[str, Any]:
        """All of them in JSON's types, as ``result.json`` keeps them."""
        return dict(json.loads(json.dumps(asdict(self), default=str)))


def noise_prior(observables: Observables, options: SearchOptions) -> NoisePrior:
    """Prior of extra noise; of width 0 where the stated errors count as right."""
    vis2, degrees = options.noise_prior if options.extra_noise else (0.0, 0.0)
    floors = systematics_of(observables, options.systematics)
    return NoisePrior(vis2, float(np.radians(degrees)), options.channel_noise, floors)


def past_first_null(likelihood: Likelihood) -> bool:
    """Whether the star is so large that the longest baseline is past the null of its V².

    There a uniform disc misses the height of the lobes, which limb darkening lowers, by more
    than what a faint companion does; before the null a larger disc looks the same.
    """
    if not likelihood.observables.n_vis2:
        return False
    disc = likelihood.with_model(BinaryModel(1, "free"))
    (diameter,), _ = fit_single(disc)
    return is_past_null(likelihood, diameter)


def is_past_null(likelihood: Likelihood, diameter_mas: float) -> bool:
    """Whether the longest baseline is past the null of a disc."""
    longest = likelihood.samples.frequency.max()
    return bool(np.pi * diameter_mas * MAS * longest > FIRST_NULL)


FIRST_NULL = 3.83
"""First zero of J₁."""


def model_of(likelihood: Likelihood, options: SearchOptions) -> BinaryModel:
    """Make the model of one companion that the options ask for."""
    diameter, disc = options.diameter, options.companion_diameter
    coloured = options.contrast_slope != 0.0
    if diameter is None:
        diameter = "free" if likelihood.observables.n_vis2 else 0.0
    darkening = options.limb_darkening
    if darkening is None:
        darkening = "free" if diameter == "free" and past_first_null(likelihood) else 0.0
    return BinaryModel(
        1,
        diameter,
        options.background,
        options.smearing,
        limb_darkening=darkening,
        companion_diameter_mas=0.0 if disc is None else disc,
        contrast_slope=options.contrast_slope,
        reference_wavelength_m=reference_wavelength(likelihood.observables) if coloured else 0.0,
    )
