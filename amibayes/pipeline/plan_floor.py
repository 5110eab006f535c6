"""What a calibrated search of a plan reaches: errors that more photons do not average out.

Beside photon and read noise every exposure has errors of its own: the flat field, which target
and calibrators sample at different places of the detector; holes that drift between pointings;
charge that passes between pixels and that fainter calibrators do not share; the converter, whose
errors go with the counts; and whatever else calibrators scatter by. Calibration learns of them
from the scatter between the calibrators (`amibayes.calibration.hierarchical`), and so does the
plan: calibrators are drawn, and what they leave of the target's response is its covariance. The
limit is that of the search: a global false-alarm probability in its field, with the scale of the
errors unknown.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from amibayes.calibration.hierarchical import predictive
from amibayes.calibration.matching import keys_of
from amibayes.calibration.scatter_likelihood import population_of
from amibayes.calibration.scatter_posterior import ScatterGrid
from amibayes.calibration.transfer import transfer_of
from amibayes.companion_search.search import search
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import dense_covariance
from amibayes.data.observables import Observables
from amibayes.data.off_axis_response import OffAxisResponse
from amibayes.detection.false_alarm import significance
from amibayes.detection.statistic import statistic_of
from amibayes.errors import UsageError
from amibayes.extraction.response import pipeline_response
from amibayes.instrument import Instrument
from amibayes.likelihood.likelihood import Likelihood
from amibayes.limits.completeness import COMPLETENESS, detection_limit
from amibayes.models.binary import BinaryModel
from amibayes.optics import Wavefront, fringe_basis, psf
from amibayes.pipeline.migration_plan import converter_change, envelope_fit, migration_change
from amibayes.scene.orientation import Orientation
from amibayes.simulation import Detector
from amibayes.simulation.budget import Plan, star_channels
from amibayes.simulation.detector import draw_maps
from amibayes.support.arguments import in_range
from amibayes.support.options import ALPHA
from amibayes.units import MAS, FloatArray, contrast_to_delta_mag

N_PIXELS = 40
"""Of the images: five times the width of a hole's image at half its height."""

REALISATIONS = 4
"""Wavefronts and sets of calibrators that the errors are averaged over: they are then
known to a tenth."""

NULL_DRAWS = 4000
"""Of the search: α is then known to 45 %, the limit to 0.03 mag."""

TRIALS = 40
"""Companions that are injected at each separation: the limit is then known to 0.05 mag."""

N_SEPARATIONS = 6
"""At which they are."""

SMALL_STEP_M, SMALL_STEP_RAD = 1e-9, 1.0 * MAS
"""Of pistons and tilts, over which the observables are straight lines."""

CALIBRATORS_FOR_SCATTER = 3
"""From so many on calibration measures the scatter between them."""


@dataclass(frozen=True)
class Floor:
    """Errors beside photon and read noise, of every exposure.

    Parameters
    ----------
    flat : float
        Standard deviation of the relative error of the flat field.
    dither_mas : float
        Scatter of the place of an exposure on the detector.
    brightness : float
        Of the calibrators, in units of the target's: what they do not share of charge migration,
        taken out with the instrument's value, is left by the error of that value.
    piston_nm, drift_nm : float
        Path of the holes that all exposures share, and that each adds.
    tilt_drift_mas : float
        Displacement of the image of each hole that each exposure adds, per axis.
    converter : float
        Errors of the analogue-to-digital converter that are left in, in units of those of JWST's
        readout: 1 in images, 0 in ramps whose superbias is at hand. Of instruments whose file
        has charge migration; others are not read out like that.
    vis2, closure_deg : float
        Scatter between calibrators beside all that.
    calibrators : int
        As long exposures as the target's.

    Raises
    ------
    UsageError
        Where a number makes no sense.
    """

    flat: float = 1e-3
    dither_mas: float = 15.0
    brightness: float = 0.5
    piston_nm: float = 30.0
    drift_nm: float = 5.0
    tilt_drift_mas: float = 0.0
    converter: float = 1.0
    vis2: float = 0.0
    closure_deg: float = 0.0
    calibrators: int = 3

    def __post_init__(self) -> None:
        for entry in fields(self):
            least = 1.0 if entry.name == "calibrators" else 0.0
            in_range("floor", entry.name, getattr(self, entry.name), least)
        if self.calibrators != int(self.calibrators):
            raise UsageError(f"{self.calibrators:g} calibrators", remedy="give a whole number")


@dataclass(frozen=True, eq=False)
class FloorExpectation:
    """Errors that photons do not average out, and what a search then reaches.

    Parameters
    ----------
    vis2, closure_phase_rad : dict of str to float
        Rms error of one exposure by each cause: ``flat``, ``drift``, ``migration``,
        ``converter``, ``scatter``.
    calibrated_vis2, calibrated_closure_phase_rad : float
        Median error after calibration, photon noise of all stars included.
    separation_mas, delta_mag : (n,) float arrays
        Companions that a search finds with probability ``completeness`` at its false-alarm
        probability ``alpha``.
    alpha, completeness : float
    """

    vis2: dict[str, float]
    closure_phase_rad: dict[str, float]
    calibrated_vis2: float
    calibrated_closure_phase_rad: float
    separation_mas: FloatArray
    delta_mag: FloatArray
    alpha: float = ALPHA
    completeness: float = COMPLETENESS


def expect_floor(
    plan: Plan,
    detector: Detector,
    photons: Observables,
    separation_mas: tuple[float, float],
    floor: Floor,
) -> FloorExpectation:
    """Predict what a calibrated search of a plan reaches.

    Parameters
    ----------
    plan : Plan
    detector : Detector
    photons : Observables
        A point source with the covariance of photon and read noise.
    separation_mas : (low, high)
        Range of the curve.
    floor : Floor
    """
    rng = np.random.default_rng(1)
    migration, between = migration_error(plan, detector, floor, rng)
    n = photons.n_vis2
    causes = {
        "flat": flat_error(plan, floor),
        "drift": drift_error(plan.instrument, floor, rng),
        "migration": _rms(migration, n),
        "converter": converter_error(plan, detector, floor, rng),
        "scatter": (floor.vis2, float(np.radians(floor.closure_deg))),
    }
    own = np.array(
        [*(causes[c] for c in ("flat", "drift", "converter", "scatter")), _rms(between, n)]
    )
    tau = np.sqrt((own**2).sum(axis=0))
    total = calibrated_covariance(photons, tau, floor.calibrators, rng)
    # Of migration the calibrators know little, but its error moves all data together.
    total += np.outer(migration, migration)
    basis = independent(photons)
    setups = tuple(replace(s, response=response_of(plan.instrument)) for s in photons.setups)
    known = replace(
        photons,
        covariance=dense_covariance(total, basis),
        covariance_kind="given",
        setups=setups,
    )
    rings = np.geomspace(*separation_mas, N_SEPARATIONS)
    vis2_error, closure_error = (float(np.median(e)) for e in known.errors)
    return FloorExpectation(
        {name: one for name, (one, _) in causes.items()},
        {name: other for name, (_, other) in causes.items()},
        vis2_error,
        closure_error,
        rings,
        search_limit(known, rings, rng),
    )


def _rms(change: FloatArray, n_vis2: int) -> tuple[float, float]:
    """Root mean square of V² and of closure phases."""
    parts = change[:n_vis2], change[n_vis2:]
    return tuple(float(np.sqrt((part**2).mean())) for part in parts)  # type: ignore[return-value]


def independent(observables: Observables) -> FloatArray:
    """Basis (n_data, n_independent) of what V² and closure phases of one exposure can be."""
    kernel = kernel_basis(closure_matrix(observables.closure_phase.stations)[0])
    n = observables.n_vis2
    basis = np.zeros((n + len(kernel), n + kernel.shape[1]))
    basis[:n, :n], basis[n:, n:] = np.eye(n), kernel
    return basis


def flat_error(plan: Plan, floor: Floor) -> tuple[float, float]:
    """Error of V² and closure phase (rad) of an exposure by the flat field, what all share out.

    Every pixel errs by itself, by a part of its light. What is not shared goes with the place on
    the detector: in a straight line for small offsets, and no further than all of it.
    """
    instrument, channels = plan.instrument, star_channels(plan.instrument)
    pixel = floor.dither_mas * MAS / instrument.pixel_scale_rad
    total = np.zeros(2)
    for axis in np.eye(2) * pixel:
        changes = []
        for x, y in (axis, -axis):
            basis = fringe_basis(instrument, channels, N_PIXELS, centre_px=(x, y))
            changes.append(envelope_fit(basis) * np.asarray(basis.image()).ravel())
        total += _mean_squares(instrument, changes[1] - changes[0]) / 4.0
    size = floor.flat * np.sqrt(total)
    return float(size[0]), float(size[1])


def drift_error(
    instrument: Instrument, floor: Floor, rng: np.random.Generator
) -> tuple[float, float]:
    """Error of V² and closure phase (rad) of an exposure by holes that drift.

    A piston alone does nothing to the modulus of a fringe, and closure phases are free of it;
    both hold for one wavelength and for holes that only their fringes overlap with. The rest is
    linear in the drift where the holes are displaced already.
    """
    n = instrument.mask.n_holes
    steps = [("piston_m", k, floor.drift_nm * 1e-9, SMALL_STEP_M) for k in range(n)]
    steps += [("tilt_rad", k, floor.tilt_drift_mas * MAS, SMALL_STEP_RAD) for k in range(2 * n)]
    channels = star_channels(instrument)
    fit = envelope_fit(fringe_basis(instrument, channels, N_PIXELS))
    total = np.zeros(2)
    for _ in range(REALISATIONS):
        shared = {
            "piston_m": floor.piston_nm * 1e-9 * rng.standard_normal(n),
            "tilt_rad": np.zeros((n, 2)),
        }

        def measured(wavefront: dict[str, FloatArray]) -> FloatArray:
            image = psf(
                instrument,
                channels,
                N_PIXELS,
                wavefront=Wavefront(wavefront["piston_m"], wavefront["tilt_rad"]),
            )
            return _observed(instrument, fit @ image.ravel())

        before = measured(shared)
        for name, k, size, step in steps:
            if size == 0.0:
                continue
            moved = {key: value.copy() for key, value in shared.items()}
            moved[name].flat[k] += step
            change = (measured(moved) - before) * (size / step)
            total += _kinds(instrument, change[:, None]) / REALISATIONS
    return float(np.sqrt(total[0])), float(np.sqrt(total[1]))


def migration_error(
    plan: Plan, detector: Detector, floor: Floor, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """What the error of the instrument's charge migration leaves, (n_data,), and the calibrators'.

    Returns
    -------
    left : (n_data,) float array
        Of the calibrated target, all together for one standard deviation.
    scatter : (n_data,) float array
        Root mean square by which calibrators differ from each other.
    """
    known = plan.instrument.charge_migration
    pixel = floor.dither_mas * MAS / plan.instrument.pixel_scale_rad
    places = pixel * rng.standard_normal((1 + floor.calibrators, 2))
    changes = np.array([migration_change(plan, detector, (x, y)) for x, y in places])
    error = 0.0 if known is None else known.error
    own = error * floor.brightness * changes[1:]
    return error * changes[0] - own.mean(axis=0), own.std(axis=0)


def converter_error(
    plan: Plan, detector: Detector, floor: Floor, rng: np.random.Generator
) -> tuple[float, float]:
    """Error of V² and closure phase (rad) of an exposure by the converter, what all share out.

    Of what is left of the target after its calibrators the share of one exposure, as if all
    differed from each other by as much: calibrators of one brightness differ by a little less.
    """
    if floor.converter == 0.0 or plan.instrument.charge_migration is None:
        return 0.0, 0.0
    pixel = floor.dither_mas * MAS / plan.instrument.pixel_scale_rad
    shape = (N_PIXELS, N_PIXELS)
    bias = np.stack([draw_maps(detector, shape, rng).bias_dn for _ in range(REALISATIONS)])
    target, *others = (
        converter_change(plan, detector, bias, (x, y), floor.brightness if k else 1.0)
        for k, (x, y) in enumerate(pixel * rng.standard_normal((1 + floor.calibrators, 2)))
    )
    left = target - np.mean(others, axis=0)
    one = floor.converter / np.sqrt(1.0 + 1.0 / floor.calibrators)
    vis2, closure = _rms(one * left.T, plan.instrument.mask.n_baselines)
    return vis2, closure


def response_of(instrument: Instrument) -> OffAxisResponse | None:
    """What a fit of the fringes lets through of the light off the axis."""
    sky = Orientation()
    stations = sky.baselines_to_sky(instrument.mask.holes_m)
    return pipeline_response(instrument, N_PIXELS, sky, stations)


def _observed(instrument: Instrument, fitted: FloatArray) -> FloatArray:
    """V² and closure phases of a fit of flux and fringes."""
    n = instrument.mask.n_baselines
    visibility = (fitted[1 : 1 + n] + 1j * fitted[1 + n : 1 + 2 * n]) / fitted[0]
    closures = closure_matrix(instrument.mask.triangles)[0]
    return np.concatenate([np.abs(visibility) ** 2, closures @ np.angle(visibility)])


def _mean_squares(instrument: Instrument, change: FloatArray) -> FloatArray:
    """Mean square of V² and of closure phase by changes (1 + 2 n_baselines, m) of a point's fit."""
    n = instrument.mask.n_baselines
    closures = closure_matrix(instrument.mask.triangles)[0]
    vis2 = 2.0 * (change[1 : 1 + n] - change[:1])
    return _kinds(instrument, np.concatenate([vis2, closures @ change[1 + n : 1 + 2 * n]]))


def _kinds(instrument: Instrument, change: FloatArray) -> FloatArray:
    n = instrument.mask.n_baselines
    return np.array([(part**2).sum(axis=1).mean() for part in (change[:n], change[n:])])


def calibrated_covariance(
    photons: Observables, tau: FloatArray, calibrators: int, rng: np.random.Generator
) -> FloatArray:
    """Covariance (n_data, n_data) of a calibrated point, with a scatter tau between exposures.

    As random effects give it of calibrators that are drawn; of fewer than three the scatter is
    not measured, and what the search finds of it in its residuals is what there is.
    """
    noise = photons.covariance.dense()
    closures = closure_matrix(photons.closure_phase.stations)[0]
    between = np.zeros_like(noise)
    n = photons.n_vis2
    between[:n, :n] = tau[0] ** 2 * np.eye(n)
    between[n:, n:] = tau[1] ** 2 * closures @ closures.T / 3.0
    own = noise + between
    if calibrators < CALIBRATORS_FOR_SCATTER:
        return np.asarray(own * (1.0 + 1.0 / calibrators))
    keys, clean = keys_of(photons), photons.data
    drawn = rng.multivariate_normal(clean, own, (REALISATIONS, calibrators), method="svd")
    total = np.zeros_like(noise)
    for stars in drawn:
        seen = [transfer_of(photons.with_data(star), keys, (0.0, 0.0)) for star in stars]
        population = population_of(seen, keys, seen[0].seen)
        tau, weight = ScatterGrid.of(population).posterior
        response = predictive(population, tau, weight, len(keys))[1].toarray()
        total += response[np.ix_(keys.key, keys.key)] * np.outer(keys.sign, keys.sign)
    return np.asarray(noise + total / REALISATIONS)


def search_limit(
    observables: Observables, separation_mas: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Magnitudes (n,) that the search of a point reaches at some separations, by injection.

    Of noise whose size is what it is expected to be: the search takes it from the data, and with
    it its limits would scatter by a tenth of a magnitude and more.
    """
    noise = observables.covariance.draw(rng, 1)[:, 0]
    n = observables.n_vis2
    for kind, part in (("vis2", slice(0, n)), ("cp", slice(n, None))):
        some = observables.only((kind,)).covariance
        chi2 = float((some.whiten(noise[part]) ** 2).sum())
        noise[part] *= np.sqrt(some.rank / chi2)
    found = search(Likelihood(observables.with_data(observables.data + noise), BinaryModel()))
    tested = significance(statistic_of(found), NULL_DRAWS, rng)
    limit = detection_limit(
        found, tested, rng, separation_mas=separation_mas.tolist(), trials=TRIALS
    )
    return np.asarray(contrast_to_delta_mag(limit.contrast))
