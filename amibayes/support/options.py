"""Choices and defaults of all options: the command line, the API and the documentation read these.

The first value of a choice is its default, where none is named beside it. Nothing heavy is
imported here, since ``--help`` needs it.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Literal, TypeAlias, get_args

_FOURIER = "amibayes.extraction.fourier.transform:fourier_sampling"

EXTRACTION_METHODS: dict[str, str] = {
    "fringes": "amibayes.extraction.image_plane:fringe_sampling",
    "matched": _FOURIER,
    "fft": _FOURIER,
    "gauss": _FOURIER,
    "square": _FOURIER,
    "unique": _FOURIER,
}
"""Fit of the images, or a way to sample their Fourier transform, and what makes the
`amibayes.extraction.fourier.sampling.Sampling` of each: ``module:function`` of (view, basis, fit,
options), imported when it is used. A new method is one more line; the first is the default."""

ExtractionCovariance = Literal["shrunk", "scatter", "physical"]
"""Scatter of the integrations and photon noise combined, or one of them alone."""

Geometry = Literal["fitted", "stated"]
"""Scale and rotation of the mask, where the image determines them."""

CalibrationMethod = Literal["hierarchical", "weighted", "population"]
"""How calibrators are combined; unless given, by how many share a baseline."""

ClosureCovariance = Literal["assumed", "diagonal"]
"""Triangles of files without correlations: correlated through shared baselines, or independent."""

ContrastSharing = Literal["tied", "per-filter"]
"""One contrast for all bands, or one for each; unless given, by the number of bands."""

SAMPLERS: dict[str, str] = {"nested": "amibayes.posterior.nested:NestedSampler"}
"""Samplers that measure the evidence, each a `amibayes.posterior.sampler.Sampler`."""

EVIDENCE_METHODS = ("direct", "laplace", *SAMPLERS)
"""Integrate directly, by Laplace's approximation, or by one of the samplers."""

ContrastForm = Literal["log-uniform", "uniform"]
"""Prior of the contrast."""

PositionForm = Literal["area", "separation"]
"""Prior of the position: uniform in area, or in separation and angle."""

AnalyticMethod = Literal["absil", "candid", "posterior", "closure-phase"]
"""Closed criteria of the literature for a limit."""

LimitCriterion: TypeAlias = Literal["injection", "absil", "candid", "posterior", "closure-phase"]
"""Injection and recovery by the search's own criterion, or a closed one."""

ImagingProgram = Literal["irbis", "squeeze", "mira"]
"""Programs of image reconstruction."""

RampPreset = Literal["default", "paper"]
"""Rules for groups and integrations: the real brightest pixel, or those of Soulain et al. 2020."""

Observables = tuple[Literal["vis2", "cp"], ...]

OBSERVABLES: tuple[str, ...] = ("vis2", "cp")
"""Kinds of observables; all of them are fitted."""

COMPANIONS = (0, 1, 2)
"""Numbers of companions whose evidences can be compared."""

SKY_MODELS: dict[str, str] = {
    "star": "the star alone",
    "companion": "a companion",
    "two": "two companions",
    "disc": "a Gaussian disc, inclined",
    "uniform-disc": "a uniform disc, inclined",
    "ring": "a ring smoothed by a Gaussian, inclined",
    "crescent": "a ring whose brightness goes with azimuth, inclined",
    "halo": "light that no baseline resolves",
}
"""Models of the sky whose evidences are compared, and what each adds to the star; several are
joined by ``+``, as ring+companion."""

DEFAULT_SKY_MODELS = ("star", "companion")

CONFUSION_DRAWS = 40
"""Data sets simulated of each model: a rate of confusion of 5 % is then known to 3.5 %."""

MODEL_ODDS = 0.95
"""Probability from which a model counts as the one that the data choose."""

SEED = 1

NOISE_PRIOR = (0.05, 3.0)
"""Widths of the half-normal prior of extra noise: share of V², degrees of closure phase."""

CLIP_CALIBRATORS = 3.0
"""Standard deviations past which a calibrator's value is left out: one in 370 of good ones."""

CLIP_INTEGRATIONS = 5.0
"""Standard deviations past which an integration is left out. Its observables are tens of
numbers, whose largest passes 3 often."""

ALPHA = 0.0013
"""False-alarm probability of a detection: the one-sided tail of 3 sigma."""

NULL_DRAWS = 10_000
"""Null searches: α is then known to a quarter of itself."""

LIMITS_NULL_DRAWS = 20_000
"""Null searches for limits: the threshold of α is then known to 0.01 mag."""

LIMITS_SEPARATIONS = 24
"""Rings of a detection limit."""

LIMITS_TRIALS = 450
"""Companions injected per separation: a limit is then known to 0.01 mag."""

VETTING_ALPHA = 0.003
"""Probability of each test below which a calibrator is dropped."""

VETTING_NULL_DRAWS = 4000
"""Null searches of a calibrator: `VETTING_ALPHA` is then known to a third of itself."""

PLAN_SEPARATION_MAS = (50.0, 400.0)
"""Range of a plan's contrast curve: from half of λ/B_max of NIRISS to its field."""

PEAK_LIMIT_E = 30_000.0
"""Electrons that the brightest pixel may reach."""


def entry(place: str) -> Any:
    """Import what is at ``module:name``."""
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


def choices(literal: Any) -> tuple[str, ...]:
    """Give the values of a ``Literal``."""
    return tuple(get_args(literal))
