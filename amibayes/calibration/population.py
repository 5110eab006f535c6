"""Calibrators as a population whose transfer functions drift: a library of many stars and dates.

What the instrument does to a point source changes from star to star and with time, in few ways:
the principal components of the transfer functions of a library. Calibrator j at time t_j sees

    z_j = μ + Σ_k u_k a_k(t_j) + δ_j + n_j,

with amplitudes a_k of mean 0 and variance σ_k² whose covariance between two dates is
σ_k² (ρ exp(−|Δt|/ℓ) + 1 − ρ if they are one), a scatter δ_j of τ² times the errors, with a τ of V²
and one of closure phases (coherence that is lost moves the one and not the other), and the errors
n_j. The target is one more draw: amplitudes at its date come from the calibrators near to it
(kriging with an unknown mean), and what is left of their variance is put into its
covariance, so that a fit does not rest on the combinations of V² and closure phases that drift.
ρ and ℓ are averaged over a grid by their likelihood.

The number of components is that of singular values above the threshold of Gavish & Donoho
(2014, IEEE Trans. Inf. Theory 60, 5040) for unknown noise; their variances are corrected for what
noise adds to the largest eigenvalues (Baik & Silverstein 2006). Each calibrator predicted
from the others tells whether the stated covariance of a prediction is right, and scales it up
where it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_array

from amibayes.calibration.matching import Keys
from amibayes.calibration.transfer import Transfer, closure_sets
from amibayes.calibration.weighted import TransferFunction
from amibayes.errors import DataError
from amibayes.units import BoolArray, FloatArray, IntArray

MIN_MEMBERS = 6
"""Below it a covariance of components means nothing: hierarchical calibration serves better."""

CORRELATED = np.array([0.0, 0.3, 0.6, 0.8, 0.9, 0.95, 0.98, 0.995])
"""ρ, the share of a component's variance that goes with time."""

N_TIMES = 12
"""Correlation times ℓ, from the shortest interval between calibrators to ten times the span."""

MAX_LEFT_OUT = 20
"""Calibrators that are predicted from the others: the mean of their χ² is then known to a
twentieth, since each is of many data."""

FARTHEST = 3
"""Of more calibrators those farthest from the median are left out too, to tell of them."""

UNLIKE = 8.0
"""Times the usual χ² per datum: of libraries of 7 to 20 simulated stars that drift the largest has
4 times the usual one, a star with a companion of 2 % at errors of 1 % and 0.3° 10 and more."""

UNKNOWN_MEAN = 100.0
"""Variance of the mean amplitude in units of the component's: as good as no knowledge."""


@dataclass(frozen=True, eq=False)
class Components:
    """The population, in units in which what components leave is alike in all data.

    Parameters
    ----------
    mean : (q,) float array
    modes : (q, k) float array
        Orthonormal.
    variance : (k,) float array
        Of the amplitudes.
    scatter : (q,) float array
        τ²: variance of what neither components nor errors explain.
    """

    mean: FloatArray
    modes: FloatArray
    variance: FloatArray
    scatter: FloatArray


def components(data: FloatArray, noise: FloatArray) -> Components:
    """Find the principal components of transfer functions.

    Parameters
    ----------
    data : (n, q) float array
        Of n calibrators, in units of the typical error and scatter.
    noise : (n,) or (n, q) float array
        Variance of the errors of each, in these units.
    """
    n, q = data.shape
    errors = _of_each(noise, data)
    mean = data.mean(axis=0)
    _, singular, rows = np.linalg.svd((data - mean) / np.sqrt(n - 1), full_matrices=False)
    singular, rows = singular[: n - 1], rows[: n - 1]  # the mean took one direction
    n_modes = int((singular > _threshold(n - 1, q) * np.median(singular)).sum())
    n_modes = min(n_modes, n - 3, q - 1)
    eigen = singular**2
    free = (q - n_modes) * (1.0 - n_modes / (n - 1))
    bulk = float(eigen[n_modes:].sum()) / max(free, 1.0)
    variance = _debiased(eigen[:n_modes], bulk, q / (n - 1))
    scatter = np.maximum(bulk - errors.mean(axis=0), 0.0)
    return Components(mean, rows[:n_modes].T, variance, scatter)


def _of_each(noise: FloatArray, data: FloatArray) -> FloatArray:
    """Variances of the errors of every calibrator and datum, (n, q)."""
    return np.broadcast_to(np.reshape(noise, (len(data), -1)), data.shape)


def _units(data: FloatArray, noise: FloatArray, kind: IntArray) -> FloatArray:
    """Root of scatter and errors of each kind of datum by itself, (q,).

    Components are directions that stand out of what is alike in all others: V² that scatter by
    five errors among closure phases that do not scatter would be components, or the mean of both
    would be the scatter of each.
    """
    out = np.empty(data.shape[1])
    for number in np.unique(kind):
        ours = kind == number
        alone = components(data[:, ours], noise[:, ours])
        out[ours] = np.sqrt(np.mean(alone.scatter + noise[:, ours].mean(axis=0)))
    return out


def _threshold(n: int, q: int) -> float:
    """Gavish & Donoho's threshold in units of the median singular value, to 0.02."""
    ratio = min(n, q) / max(n, q)
    return float(0.56 * ratio**3 - 0.95 * ratio**2 + 1.82 * ratio + 1.43)


def _debiased(eigen: FloatArray, bulk: float, ratio: float) -> FloatArray:
    """Variance of a component beyond the bulk, from its eigenvalue in a sample."""
    total = eigen + bulk - ratio * bulk
    root = np.sqrt(np.maximum(total**2 - 4.0 * eigen * bulk, 0.0))
    return np.asarray(np.maximum(0.5 * (total + root) - bulk, 0.0))


@dataclass(frozen=True, eq=False)
class Prediction:
    """Mean (q,) and covariance (q, q) of the transfer function at a date."""

    mean: FloatArray
    covariance: FloatArray


def predict(
    found: Components, data: FloatArray, noise: FloatArray, days: FloatArray, at: float
) -> Prediction:
    """Predict the transfer function of one more star at a date.

    Parameters
    ----------
    found : Components
    data : (n, q) float array
    noise : (n,) or (n, q) float array
    days : (n,) float array
        Dates of the calibrators.
    at : float
        Date of the target.
    """
    n, q = data.shape
    amplitude = (data - found.mean) @ found.modes
    own = _of_each(noise, data) + found.scatter
    of_amplitude = own @ found.modes**2
    apart, gap = np.abs(days[:, None] - days), np.abs(days - at)
    settings = [
        _krige(amplitude, found.variance, of_amplitude, rho * np.exp(-apart / time), 1.0 - rho,
               rho * np.exp(-gap / time))
        for rho, time in _grid(days)
    ]  # fmt: skip
    log_likelihood = np.array([s[0] for s in settings])
    weight = np.exp(log_likelihood - log_likelihood.max())
    weight /= weight.sum()
    means = np.array([s[1] for s in settings])
    centre = weight @ means
    variance = weight @ (np.array([s[2] for s in settings]) + (means - centre) ** 2)
    outside = np.eye(q) - found.modes @ found.modes.T
    of_mean = outside @ np.diag(own.mean(axis=0) / n) @ outside
    covariance = np.diag(found.scatter) + of_mean
    covariance = covariance + (found.modes * variance) @ found.modes.T
    return Prediction(found.mean + found.modes @ centre, covariance)


def _grid(days: FloatArray) -> list[tuple[float, float]]:
    """Shares and times of the correlation; one setting where all have one date."""
    steps = np.diff(np.unique(days))
    if not len(steps):
        return [(0.0, 1.0)]
    times = np.geomspace(max(steps.min(), 1e-4 * np.ptp(days)), 10.0 * np.ptp(days), N_TIMES)
    return [(0.0, 1.0), *((rho, time) for rho in CORRELATED[1:] for time in times)]


def _krige(
    amplitude: FloatArray,
    variance: FloatArray,
    own: FloatArray,
    together: FloatArray,
    alone: float,
    near: FloatArray,
) -> tuple[float, FloatArray, FloatArray]:
    """Likelihood of the amplitudes, and mean and variance of the target's, (k,) each."""
    log_likelihood, means, variances = 0.0, [], []
    for a, v, noise in zip(amplitude.T, variance, own.T, strict=True):
        matrix = v * (together + UNKNOWN_MEAN) + np.diag(v * alone + noise)
        lower = np.linalg.cholesky(matrix)
        white = np.linalg.solve(lower, np.stack([a, v * (near + UNKNOWN_MEAN)], axis=1))
        log_likelihood -= 0.5 * float(white[:, 0] @ white[:, 0])
        log_likelihood -= float(np.log(np.diagonal(lower)).sum())
        means.append(float(white[:, 1] @ white[:, 0]))
        variances.append(v * (1.0 + UNKNOWN_MEAN) - float(white[:, 1] @ white[:, 1]))
    return log_likelihood, np.array(means), np.array(variances)


def left_out(
    data: FloatArray, noise: FloatArray, days: FloatArray, numbers: IntArray
) -> FloatArray:
    """χ² per datum of some calibrators, each predicted from all others."""
    chi2, errors = [], _of_each(noise, data)
    for j in numbers:
        rest = np.arange(len(data)) != j
        found = components(data[rest], noise[rest])
        made = predict(found, data[rest], noise[rest], days[rest], float(days[j]))
        residual = data[j] - made.mean
        total = made.covariance + np.diag(errors[j])
        chi2.append(float(residual @ np.linalg.solve(total, residual)) / len(residual))
    return np.array(chi2)


def inflation(
    data: FloatArray, noise: FloatArray, days: FloatArray
) -> tuple[float, list[tuple[int, float]]]:
    """By how much to scale the covariance, and who is far from what the others predict.

    The mean χ² per datum of calibrators predicted from the others, at least 1; numbers and χ² per
    datum of those that are far.
    """
    numbers = np.unique(np.linspace(0, len(data) - 1, MAX_LEFT_OUT).astype(np.intp))
    away = np.argsort(((data - np.median(data, axis=0)) ** 2).sum(axis=1))[-FARTHEST:]
    every = np.append(numbers, np.setdiff1d(away, numbers))
    chi2 = left_out(data, noise, days, every)
    usual = max(float(np.median(chi2)), 1.0)
    found = zip(every.tolist(), chi2.tolist(), strict=True)
    scale = max(float(chi2[: len(numbers)].mean()), 1.0)
    return scale, [(j, each) for j, each in found if each > UNLIKE * usual]


def population_response(
    transfers: Sequence[Transfer], keys: Keys, days: FloatArray, at: float
) -> TransferFunction:
    """Response of the instrument for a target at a date, from a library of calibrators.

    Parameters
    ----------
    transfers : sequence of Transfer
    keys : Keys
        Of the target.
    days : (n,) float array
        Date of each calibrator, MJD.
    at : float
        Date of the target, MJD.

    Raises
    ------
    DataError
        Where fewer than `MIN_MEMBERS` calibrators see all that most of them see.
    """
    seen = np.array([t.seen for t in transfers])
    known = np.asarray(seen.mean(axis=0) >= 0.5)
    members = np.flatnonzero((seen | ~known).all(axis=1)).tolist()
    if len(members) < MIN_MEMBERS:
        raise DataError(
            f"{len(members)} calibrators of the library see all baselines of the target, and a "
            f"population takes {MIN_MEMBERS}",
            remedy="use a library of this instrument and filter, or --calibration hierarchical",
        )
    basis = _basis(keys, known)
    data = np.array([basis.T @ transfers[j].value for j in members])
    errors = [basis.T @ _covariance(transfers[j]) @ basis for j in members]
    kind = (np.abs(basis[: keys.n_vis2]).sum(axis=0) == 0.0).astype(np.intp)
    # Scatter of V² is no scatter of closure phases, even where their errors are correlated.
    middle = np.median(errors, axis=0) * (kind[:, None] == kind)
    lower = np.linalg.cholesky(middle + _ridge(errors))
    inverse = np.linalg.inv(lower)
    white = data @ inverse.T
    noise = np.array([np.diagonal(inverse @ e @ inverse.T) for e in errors])
    units = _units(white, noise, kind)
    white, noise, lower = white / units, noise / units**2, lower * units
    found = components(white, noise)
    made = predict(found, white, noise, np.asarray(days)[members], at)
    scale, unlike = inflation(white, noise, np.asarray(days)[members])
    back = basis @ lower
    covariance = csr_array(back @ (scale * made.covariance) @ back.T)
    named = tuple((members[j], chi2) for j, chi2 in unlike)
    return TransferFunction(back @ made.mean, covariance, known, unlike=named)


def unlike_the_others(source: str, chi2: float) -> str:
    """Tell of a calibrator of a population that the others do not predict."""
    return (
        f"calibrator {source} is not what the others predict (chi2 per datum {chi2:.1f}), which "
        "makes all errors larger: if it has a companion (amibayes vet), make the library without it"
    )


def _covariance(transfer: Transfer) -> FloatArray:
    covariance = transfer.covariance
    if transfer.shared is not None:  # one constant of the detector for all: part of the errors
        covariance = transfer.shared.added(covariance, 1.0)
    return np.asarray(covariance.toarray())


def _ridge(errors: Sequence[FloatArray]) -> FloatArray:
    """Keep the median of covariances, which is none itself, above zero."""
    middle = np.median([np.diagonal(e) for e in errors], axis=0)
    lowest = float(np.linalg.eigvalsh(np.median(errors, axis=0))[0])
    return np.diag(np.full(len(middle), max(1e-6 * middle.min() - lowest, 0.0)))


def _basis(keys: Keys, known: BoolArray) -> FloatArray:
    """From V² and kernel phases to keys, (n_keys, q), orthonormal."""
    vis2 = np.flatnonzero(known[: keys.n_vis2])
    columns = [np.eye(len(keys))[:, vis2]]
    for closures in closure_sets(keys, known):
        column = np.zeros((len(keys), closures.basis.shape[1]))
        column[closures.keys] = closures.basis
        columns.append(column)
    return np.concatenate(columns, axis=1)
