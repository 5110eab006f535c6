"""What makes the numbers of a result less certain than they seem."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import chi2

from amibayes.calibration import Calibration
from amibayes.companion_search.result import SearchResult
from amibayes.data.observables import Observables
from amibayes.detection.consistency import EPOCH_GAP_DAYS
from amibayes.detection.exposure_noise import ExposureNoise
from amibayes.detection.false_alarm import Significance, draws_needed
from amibayes.detection.note import taken_for_a_point
from amibayes.detection.residuals import chi2_of_kinds, correlated
from amibayes.detection.splits import Consistency
from amibayes.likelihood.extra_noise import ExtraNoise
from amibayes.pipeline.vetting import Vetting, notes
from amibayes.posterior.ensemble import Posterior
from amibayes.posterior.grid import integrable
from amibayes.posterior.modes import modes_to_sample
from amibayes.posterior.priors import Prior
from amibayes.support.terminal import equals
from amibayes.units import MAS, FloatArray

MAX_NAMED = 3
"""Outliers that a warning names."""

ENOUGH, DOMINANT = 3.0, 0.5
"""Integrations per datum, or else share of the expected noise, that make a covariance good."""

BRIGHT = 0.03
"""Contrast above which the square of a companion's light counts."""

UNLIKELY = 0.01
"""Probability below which a difference between calibrators is mentioned."""

FAR_TOO_SMALL, MEASURABLE = 1e-6, 0.01
"""Probability of a χ² as small, below which the errors are too large, and least reduced χ² that
tells by how much."""


def calibration_warnings(calibration: Calibration | None) -> list[str]:
    """Warn of what a single calibrator leaves unknown."""
    used = [] if calibration is None else [c for c in calibration.calibrators if c.n_used]
    if len(used) != 1:
        return []
    return [
        "how well one calibrator calibrates cannot be measured: the errors hold the noise of both "
        "stars, but not what else differs between them (pointing on the flat field, drift, air); "
        "in simulated NIRISS images 68 % intervals then held 54 %, with three calibrators "
        "their nominal share"
    ]


USUAL_CALIBRATOR_MAS, NOTABLE_LOSS = 0.3, 0.01
"""Diameter that calibrators of interferometers have, and a change of V² that diameters notice."""


def calibrator_warnings(
    targets: Sequence[Observables],
    references: Sequence[Observables],
    *,
    sized: bool,
    drifting: bool = False,
) -> list[str]:
    """Tell of calibrators taken for points that may not be, and of those of other nights.

    Parameters
    ----------
    targets, references : sequence of Observables
        As read; V² that are not used are flagged or left out.
    sized : bool
        Diameters of calibrators were given.
    drifting : bool
        They are a population, which tells how the instrument changes with time.
    """
    if not references:
        return []
    found = []
    used = [data.vis2.select(~data.vis2.flag) for data in targets]
    longest = max((float(np.max(m.frequency, initial=0.0)) for m in used), default=0.0)
    # V² of a small disc: 1 − x²/4.
    loss = 0.25 * (np.pi * USUAL_CALIBRATOR_MAS * MAS * longest) ** 2
    if loss > NOTABLE_LOSS and not sized:
        found.append(
            f"calibrators were taken for points: one of {USUAL_CALIBRATOR_MAS} mas makes V2 of the "
            f"target up to {100.0 * min(1.0, loss):.0f} % too large and its diameter too small "
            "(--calibrator-diameters)"
        )
    dates = np.concatenate([_dates(data) for data in references])
    for data in targets if len(dates) and not drifting else ():
        days = float(np.abs(_dates(data)[:, None] - dates).min(axis=1).max(initial=0.0))
        if days > EPOCH_GAP_DAYS:
            found.append(
                f"{data.source} has exposures {days:.1f} days from the nearest one of a "
                "calibrator: nothing tells how the instrument changed from night to night"
            )
    return found


def _dates(observables: Observables) -> FloatArray:
    """Dates of exposures, without those of a file that tells none."""
    dates = np.unique(np.concatenate([observables.vis2.mjd, observables.closure_phase.mjd]))
    return np.asarray(dates[dates > 1.0])


def unused_calibrators(calibration: Calibration | None, given: Sequence[str]) -> list[str]:
    """Name those given calibrators that calibrate nothing; those of a library are not asked."""
    uses = [] if calibration is None else calibration.calibrators
    return [
        f"calibrator {use.path} is not used: {use.reason}"
        for use in uses
        if not use.kept and use.path in given
    ]


def consistency_warnings(splits: Sequence[Consistency]) -> list[str]:
    """Name the calibrator that changes the companion most, where few good ones change it so."""
    tested = [s for s in splits if s.split == "calibrators"]
    worst = min(tested, key=lambda s: s.p, default=None)
    if worst is None or worst.p * len(tested) >= UNLIKELY:
        return []
    one, other = worst.parts
    return [
        f"the companion depends on the calibrator: {one} and {other} disagree on it (p "
        f"{equals(worst.p)}); search without {one} as well"
    ]


def vetting_warnings(vetting: Vetting | None) -> list[str]:
    """Name the calibrators that vetting dropped, and what to know of the kept ones."""
    if vetting is None:
        return []
    dropped = [
        f"calibrator {v.path} dropped: {v.reason}" for v in vetting.calibrators if not v.kept
    ]
    return dropped + [
        f"calibrator {v.path} {note}" for v in vetting.calibrators for note in notes(v, vetting)
    ]


def _outliers(result: SearchResult, noise: ExtraNoise) -> list[str]:
    """Name the data that a robust search hardly used, and what they do beside shared noise."""
    if result.robustness is None or not (outliers := result.robustness.outliers):
        return []
    kinds = {"vis2": "V2", "closure_phase": "closure phase"}
    names = [
        f"{kinds[o.kind]} {'-'.join(o.stations)} at {o.wavelength_m * 1e6:.3g} um, MJD {o.mjd:.4f} "
        f"({o.residual:+.1f} sigma, weight {o.weight:.2f})"
        for o in outliers[:MAX_NAMED]
    ]
    more = f" and {len(outliers) - MAX_NAMED} more" if len(outliers) > MAX_NAMED else ""
    found = [
        f"{len(outliers)} of {len(result.robustness.weights)} data are outliers that lost more "
        f"than three quarters of their weight: {', '.join(names)}{more}"
    ]
    if noise.channels:
        # A third of null sets with outliers has a probability below 0.05: docs/statistics.md.
        found.append(
            "with outliers among data whose channels share some of their noise the false-alarm "
            "probability is too small: take the outliers out (--flag) and leave --robust out"
        )
    return found


def _of_covariance(result: SearchResult) -> list[str]:
    """Warn of a covariance of too few integrations, without an expectation beside it."""
    freedom, p = result.likelihood.observables.freedom, result.likelihood.n_independent
    if freedom is None or freedom.scatter + 1.0 >= ENOUGH * p:
        return []
    if freedom.scatter_share <= 1.0 - DOMINANT:
        return []
    return [
        f"the covariance of {p} independent data rests on the scatter of about "
        f"{freedom.scatter + 1.0:.0f} integrations (N/p = {(freedom.scatter + 1.0) / p:.1f}), "
        "which the expected noise does not describe: errors are approximate"
    ]


def _of_errors(result: SearchResult, noise: ExtraNoise) -> list[str]:
    """Warn where the errors are larger than residuals allow, and say how many times."""
    if chi2.cdf(result.chi2_binary, result.ndof) > FAR_TOO_SMALL:
        return []
    of, size, dof = "", result.chi2_binary, float(result.ndof)
    # Errors of the other kind may be too small at the same time.
    kinds = chi2_of_kinds(result)
    large = [kind for kind, fit in kinds.items() if chi2.cdf(*fit) <= FAR_TOO_SMALL]
    if len(large) < len(kinds) and large:
        of, (size, dof) = f" of {large[0]}", kinds[large[0]]
    which = f"the stated errors{of}"
    if noise.exceeds_stated:
        which = f"the errors{of}, with the noise that was added,"
    if noise.floors:
        which = f"the errors{of}, with the calibration errors of the instrument,"
    times = f"about {np.sqrt(dof / size):.2g}" if size > MEASURABLE * dof else "far more than ten"
    return [
        f"{which} are {times} times too large: chi2 is {size:.0f} for {dof:.0f} degrees of freedom "
        "with the companion"
    ]


def _of_bright(result: SearchResult) -> list[str]:
    """Warn where the response of an extraction is known to first order only."""
    responses = [s.response for s in result.likelihood.observables.setups]
    if result.companion.contrast < BRIGHT or all(r is None or r.single for r in responses):
        return []
    return [
        "these images were measured with several samples to a baseline, whose response to light "
        f"off the axis is known to first order in the contrast: above {BRIGHT:g} it comes out up "
        "to some percent wrong; extract them with fringes, matched or unique"
    ]


def _floor_warning(noise: ExtraNoise) -> str:
    """Name the floors that were taken, once for files alike."""
    kinds = {(f.vis2, f.closure_phase_rad, f.instrument): f for f in noise.floors}
    each = [
        f"{100.0 * f.vis2:.2g} % of V2 and {np.degrees(f.closure_phase_rad):.2g} deg"
        + (f" ({f.instrument})" if f.instrument else "")
        for f in kinds.values()
    ]
    tabulated = any(f.instrument for f in noise.floors)
    why = " (too few exposures to tell their own)" if tabulated else ""
    return (
        f"calibration errors of {', '.join(each)}, common to the channels of an exposure, are in "
        f"the covariance{why}{_grown(noise)}: --systematics none leaves them out"
    )


def _grown(noise: ExtraNoise) -> str:
    """How much larger than their floor calibration errors were found, at most."""
    each = []
    for name, words in (("vis2", "V2"), ("closure_phase", "closure phase")):
        found = [getattr(share, name) for share in noise.channels]
        most = max((f for c in found for f in (c.offset, c.slope)), default=1.0)
        if most > 1.0:
            each.append(f"{np.sqrt(most):.2g} times as large in {words}")
    return f"; residuals show them {' and '.join(each)}" if each else ""


def _noise_warning(noise: ExtraNoise) -> str:
    parts = [f"noise of {_added(noise)} was added in quadrature"] * noise.any
    kinds = zip(noise.smooth, ("V2", "closure phase"), strict=True)
    if each := [f"{size:.2g} times the errors in {kind}" for size, kind in kinds if size > 0.0]:
        parts.append(f"the channels of an exposure share errors of {' and '.join(each)}")
    return (
        f"the stated errors do not explain the residuals: {', and '.join(parts)}; chi2 and errors "
        "include it"
    )


def _added(noise: ExtraNoise) -> str:
    each = [f for f in noise.files if f.vis2 > 0.0 or f.closure_phase_rad > 0.0]
    if each:
        return ", ".join(f"{_amount(f.vis2, f.closure_phase_rad)} to {f.source}" for f in each)
    return _amount(noise.vis2, noise.closure_phase_rad)


def _amount(vis2: float, closure_phase_rad: float) -> str:
    parts = [f"{vis2:.2g} in V2"] * (vis2 > 0.0)
    parts += [f"{np.degrees(closure_phase_rad):.2g} deg in closure phase"] * (closure_phase_rad > 0)
    return " and ".join(parts)


def _of_prior(result: SearchResult, prior: Prior) -> list[str]:
    """Warn where the prior leaves the best fit out."""
    c = result.companion.contrast
    if prior.contrast_min <= c <= prior.contrast_max:
        return []
    return [
        f"the best fit's contrast of {c:.3g} lies outside the prior, {prior.contrast_min:.3g} to "
        f"{prior.contrast_max:.3g}: posterior and evidence are of other companions"
    ]


WAVELENGTH_SCALE = 1e-3
"""Relative error of a spectrograph's wavelengths below which few are known."""


def _of_scale(result: SearchResult) -> list[str]:
    """Say what an error of all wavelengths does to a separation that is known better than they."""
    change = WAVELENGTH_SCALE * result.companion.separation_mas
    if not result.companion.separation_error_mas < change:
        return []
    return [
        "lengths on the sky go with the wavelengths that the data state: if these are off by "
        f"{100.0 * WAVELENGTH_SCALE:.1g} %, the separation is off by {change:.2g} mas; its error "
        "leaves that out"
    ]


def _joint_warnings(result: SearchResult, *, stated: bool) -> list[str]:
    """Warn of what free contrasts and motion take away, and where the rate is no measurement."""
    model = result.likelihood.model
    if integrable(result.likelihood):
        return []
    free = [f"{model.n_contrasts} contrasts"] * (model.n_contrasts > 1) + ["motion"] * model.moves
    if len(result.likelihood.parameters.columns("shape")):
        free.append("the companion's disc or colour")
    found = [
        f"with {' and '.join(free)} the posterior is not integrated directly: modes have "
        "probabilities by Laplace's approximation, one companion's evidence by importance "
        "sampling; limits are of one contrast in every band, at rest"
    ]
    rates = result.theta[result.likelihood.parameters.rates]
    if model.moves and stated and np.abs(rates).max() > 0.99 * model.fastest_mas_yr:
        found.append(
            f"the rate is at the edge of what was tried, {model.fastest_mas_yr:.3g} mas/yr: "
            "raise --fastest"
        )
    return found


def _correlated(result: SearchResult) -> list[str]:
    """Warn where channels err together: errors alone count them as independent."""
    correlation = correlated(result)
    if correlation is None:
        return []
    return [
        f"residuals of neighbouring channels are correlated by {correlation:.2f}, which the "
        "covariance does not have: the false-alarm probabilities, of a second companion above "
        "all, and the errors of the fit are smaller than they ought to be"
    ]


def _drifting(exposures: ExposureNoise) -> list[str]:
    """Warn where exposures that follow each other err alike."""
    named = {"V2": exposures.vis2, "closure phases": exposures.closure_phase}
    told = {name: d for name, d in named.items() if d and d.share[0] > SURE_SHARE * d.share[1]}
    return [
        f"{name} of exposures that follow each other err alike, for hours: "
        f"{drift.share[0]:.2f} +/- {drift.share[1]:.2f} of what channels share, if there is no "
        "companion; errors, false-alarm probability and limits allow for it"
        for name, drift in told.items()
    ]


SURE_SHARE = 3.0
"""A share of the noise, in its errors, that is said aloud."""


def search_warnings(
    observables: Observables,
    result: SearchResult,
    noise: ExtraNoise,
    tested: Significance | None,
    posterior: Posterior | None,
    *,
    stated: bool = True,
) -> tuple[str, ...]:
    """Warn of what makes the numbers of a search less than they seem; ``stated`` as they may be."""
    found = [*result.warnings, *observables.notes, *_joint_warnings(result, stated=stated)]
    found += [*_of_covariance(result), *_of_errors(result, noise), *_of_bright(result)]
    if noise.floors:
        found.append(_floor_warning(noise))
    if noise.exceeds_stated:
        found.append(_noise_warning(noise))
    elif result.chi2_binary / result.ndof > 2.0:
        found.append(
            f"reduced chi2 is {result.chi2_binary / result.ndof:.1f} with the companion: the "
            "errors are too small or the model is incomplete, and significance and errors are "
            "too optimistic"
        )
    if tested is not None and tested.detected is None:
        found.append(
            f"{tested.n_draws} null draws cannot measure a false-alarm probability below "
            f"{tested.alpha:g}: no detection is claimed or denied (give --null-draws "
            f"{draws_needed(tested.alpha)} or more)"
        )
    if tested is not None and tested.exposures is not None:
        found += _drifting(tested.exposures)
    found += _outliers(result, noise)
    found += _correlated(result)
    if tested is not None and tested.detected and stated:
        found += [*_of_scale(result), *taken_for_a_point(result)]
    excluded = [] if posterior is None else _of_prior(result, posterior.prior)
    found += excluded
    if posterior is not None and not excluded and len(posterior.mode_probability) > 1:
        # An alias is no rival: it lies where the field of one answer has ended.
        rival = np.array([m not in result.aliases for m in result.modes])
        share = posterior.mode_probability[0] / posterior.mode_probability[rival].sum()
        if share < 0.99 and len(modes_to_sample(result)) == 1:
            found.append(
                f"the posterior is that of the reported position, whose probability among "
                f"{rival.sum()} modes is {share:.2f} ({posterior.mode_method})"
            )
    if posterior is not None and not posterior.converged:
        exact = "; posterior.integrated in result.json does not rest on the chain"
        found.append(
            f"the posterior has NOT converged: {posterior.n_steps} steps, autocorrelation time "
            f"{posterior.autocorrelation_time:.0f}, split R-hat {posterior.split_rhat:.3f}"
            + (exact if posterior.mode_method == "grid" else "")
        )
    return tuple(found)
