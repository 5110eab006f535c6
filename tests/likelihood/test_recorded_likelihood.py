"""Numbers of likelihoods and noise models as they were recorded: a change of any of them is seen.

`pytest tests/likelihood/test_recorded_likelihood.py --force-regen` records them anew.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from channel_sets import pionier, share, with_draw
from helpers import niriss, simulated
from recorded_numbers import numbers_of

from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables, join
from amibayes.data.systematics import Systematics
from amibayes.likelihood.averaged_noise import averaged_noise
from amibayes.likelihood.channel_noise import noise_with_channels
from amibayes.likelihood.channel_rows import channel_layout
from amibayes.likelihood.chi2 import (
    candid_n_sigma,
    chi2_of_part,
    chi2_survival,
    log_chi2_survival,
    log_peak,
    restricted_loss,
)
from amibayes.likelihood.exposure_rows import SeriesAxes, drift_of, series_of
from amibayes.likelihood.extra_noise import (
    ExtraNoise,
    FileNoise,
    NoisePrior,
    add_noise,
    mean_of_files,
    with_noise,
)
from amibayes.likelihood.likelihood import Likelihood, joint_likelihood, single_likelihood
from amibayes.likelihood.linear_response import (
    companions_beside,
    linear_response,
    nuisance_directions,
)
from amibayes.likelihood.noise_fit import fit_noise
from amibayes.likelihood.quadrature import Marginal
from amibayes.likelihood.rotation_null import rotation_null
from amibayes.likelihood.smooth_basis import smooth_basis
from amibayes.likelihood.student import (
    Robustness,
    averaged_student_noise,
    normal_moments,
    reweighted,
    scales,
    scores,
    student_terms,
    symmetric_whitening,
    weights_of,
)
from amibayes.models.binary import BinaryModel

TOLERANCE = {"rtol": 0.0, "atol": 1e-5}
THETA = np.array([150.0, -80.0, 0.02])
STAR = BinaryModel(diameter_mas="free", background="free")


def with_source(data: Observables, source: str) -> Observables:
    return replace(data, setups=tuple(replace(s, source=source) for s in data.setups))


def of_two_files(factor: float = 2.5) -> Observables:
    """Two files whose errors are understated, one of them by more."""
    rng, parts = np.random.default_rng(3), []
    for k, name in enumerate(("a", "b")):
        noisy = niriss(0.005 * factor * (1.0 + k), 0.3 * factor * (1.0 + 0.5 * k))
        data = simulated(noisy, THETA, rng)
        parts.append(with_source(replace(data, covariance=niriss().covariance), name))
    return join(parts)


def of_channels() -> Observables:
    """Six channels that share half of their variance, five exposures."""
    sheet = pionier(5)
    noise = noise_with_channels(sheet, [share(0.5, 0.3, 0.4)])
    return with_draw(sheet, noise.draw(1, np.random.default_rng(4))[:, 0])


def of_gains() -> Observables:
    """Ten exposures whose gains and closure phases are off by more than their floors."""
    sheet, rng, off = pionier(10), np.random.default_rng(5), []
    for table, size in ((sheet.vis2, 0.1), (sheet.closure_phase, 0.06)):
        key = np.stack([table.setup, table.row], axis=1)
        row = np.unique(key, axis=0, return_inverse=True)[1].ravel()
        off.append(size * rng.standard_normal(row.max() + 1)[row])
    return with_draw(sheet, np.concatenate(off) + sheet.covariance.draw(rng, 1)[:, 0])


def estimated(data: Observables) -> Observables:
    return replace(data, freedom=Freedom(30.0, 28.0))


def of_noise(likelihood: Likelihood, theta: np.ndarray) -> dict[str, Any]:
    """What a noise model says of residuals, its turn of the axes left out."""
    noise = likelihood.noise
    sets = np.stack([theta, 1.1 * theta])
    difference, white = likelihood.difference(sets), likelihood.residuals(sets)
    chi2, gains = (white**2).sum(axis=0), np.array([0.5, 4.0, 30.0])
    pairs = np.array([[True, False], [True, True]])
    return {
        "products": white.T @ white,
        "solved": noise.solve(difference),
        "log_prob": likelihood.log_prob(sets),
        "of_sums": noise.log_prob_of_sums(difference, 0.1 * difference, pairs),
        "deviance": noise.deviance(chi2),
        "inflation": noise.inflation(chi2),
        "delta_chi2": noise.delta_chi2(gains),
        "log_loss": noise.log_loss(gains),
        "norm": noise.log_norm,
        "n": noise.n_independent,
        "variance": noise.covariance.variance,
        "errors": likelihood.errors(theta),
        "gradient": likelihood.log_prob_and_gradient(sets),
    }


def test_likelihoods_and_their_slopes(num_regression) -> None:
    rng = np.random.default_rng(1)
    data = simulated(niriss(channels=2), THETA, rng, shift_closure=3.0)
    numbers = {}
    for name, observables, model, theta in (
        ("point", data, BinaryModel(), THETA),
        ("star", data, STAR, np.append(THETA, [0.5, 0.1])),
        ("estimated", estimated(data), STAR, np.append(THETA, [40.0, 0.1])),
        ("vis2", data.only(["vis2"]), BinaryModel(), THETA),
        ("turned", data.with_data(data.data * 3.0 + 2.0), BinaryModel(), THETA),
        ("small", data, BinaryModel(diameter_mas="free"), np.append(THETA, 0.0)),
        ("dense", niriss(covariance="diagonal"), BinaryModel(), THETA),
    ):
        likelihood = Likelihood(observables, model)
        expecting = likelihood.expecting(theta).observables
        found = of_noise(likelihood, theta) | {
            "predicted": likelihood.predict(theta),
            "difference": likelihood.difference(theta),
            "chi2": likelihood.chi2(theta),
            "slopes": likelihood.model_and_slopes(theta),
            "expected": expecting.vis2.expected,
            "coherent": expecting.vis2.coherent_slope,
            "closure": expecting.closure_phase.coherent_slope,
        }
        numbers |= numbers_of(**{name: found})
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_linear_responses(num_regression) -> None:
    data = simulated(niriss(channels=2), THETA, np.random.default_rng(1))
    numbers = {}
    for name, options in (
        ("grey", {}),
        ("coloured", {"contrast_slope": 1.5, "companion_diameter_mas": 30.0}),
    ):
        likelihood = Likelihood(data, replace(STAR, **options))
        star = np.array([40.0, 0.1])
        response = linear_response(likelihood, star)
        basis = nuisance_directions(likelihood, star)
        beside = np.array([[150.0, -80.0, 0.02], [-50.0, 90.0, 0.5], [-50.0, 90.0, 0.1]])
        waves = np.cos(np.outer(1.0 + np.arange(len(response.star)), [0.3, 0.7]))
        even, odd = response.even.matrix @ waves, response.odd.matrix @ waves
        numbers |= numbers_of(
            **{
                name: {
                    "star": response.star,
                    "disc": response.disc,
                    "offset": response.offset,
                    "even": even.T @ even,
                    "odd": odd.T @ odd,
                    "along": even.T @ response.offset,
                    "shape": basis.shape,
                    "seen": companions_beside(likelihood, star, beside),
                }
            }
        )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


FLOORS = (Systematics("", 0.01, 0.004, 0.003),)


def test_fitted_noise(num_regression) -> None:
    two = Likelihood(of_two_files())
    channels = Likelihood(of_channels())
    star = np.array([10.0, 5.0, 0.0])
    prior = NoisePrior(floors=FLOORS)
    wide = NoisePrior(0.3, 0.3, floors=(Systematics("", 0.05, 0.03),))
    fits = {
        "together": (two, THETA, {}),
        "per_file": (two, THETA, {"per_file": True}),
        "narrow": (two, THETA, {"prior": NoisePrior(0.004, 0.002)}),
        "channels": (channels, star, {}),
        "gains": (Likelihood(of_gains()).expecting(star), star, {"prior": wide}),
        "floors": (channels.expecting(star), star, {"prior": prior}),
        "estimated": (Likelihood(estimated(of_two_files())), THETA, {}),
    }
    numbers = {}
    for name, (likelihood, theta, options) in fits.items():
        found = fit_noise(likelihood, theta, **options)
        noisy = with_noise(likelihood, found)
        more = of_noise(noisy, theta)
        kept = {key: more[key] for key in ("products", "solved", "log_prob", "variance", "errors")}
        numbers |= numbers_of(**{name: found, f"{name} noise": kept})
    # By bounded minimisation, to a thousandth of ln σ.
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-4})


def test_noise_averaged_over_its_amount(num_regression) -> None:
    numbers = {}
    for name, data, options in (
        ("two", of_two_files(), {"per_file": True}),
        ("one", of_two_files(), {"prior": NoisePrior(0.01, 0.01)}),
        ("channels", of_channels(), {"noise": ExtraNoise(channels=(share(0.4, 0.3),))}),
        ("estimated", estimated(of_two_files()), {}),
    ):
        likelihood = Likelihood(data)
        theta = THETA if name != "channels" else np.array([10.0, 5.0, 0.01])
        fits = [(likelihood, theta), (single_likelihood(likelihood), np.empty(0))]
        noise = averaged_noise(likelihood.noise, data, fits, **options)
        difference = likelihood.difference(theta)
        posterior = {k: p.interval(0.68) for k, p in noise.posterior(difference).items()}
        none = {k: p.probability_none for k, p in noise.posterior(difference).items()}
        terms = [(t.node, t.edges, t.log_prior, t.log_det, t.degrees) for t in noise.terms]
        pairs = np.array([[True, True]])
        found = {
            "log_prob": likelihood.with_noise(noise).log_prob(np.stack([theta, 1.01 * theta])),
            "of_sums": noise.log_prob_of_sums(
                difference, np.hstack([0.1 * difference, 0.2 * difference]), pairs
            ),
            "delta_chi2": noise.delta_chi2(np.array([0.5, 30.0])),
            "log_loss": noise.log_loss(np.array([0.5, 30.0])),
            "posterior": posterior,
            "none": none,
            "terms": terms,
        }
        numbers |= numbers_of(**{name: found})
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-4})


def test_robust_residuals(num_regression) -> None:
    data = of_two_files(1.0)
    values = data.data.copy()
    values[[3, 30, 60]] += np.array([0.1, 0.15, -0.2])
    data = data.with_data(values)
    likelihood = Likelihood(data)
    symmetric = symmetric_whitening(data)
    standard = symmetric.residuals(likelihood.residuals(THETA))
    fitted = scales(symmetric, standard, 3.0)
    weights = weights_of(standard[:, 0] / fitted)
    base = reweighted(data, 1.0 / np.sqrt(weights))
    fits = [(likelihood, THETA)]
    numbers = {}
    for scope in (False, True):
        noise = averaged_student_noise(likelihood.noise, data, fits, per_file=scope)
        stated = averaged_student_noise(
            likelihood.noise, data, fits, free_scale=False, per_file=scope
        )
        nodes = [t.node for t in noise.terms]
        sets = np.stack([THETA, 1.01 * THETA])
        numbers |= numbers_of(
            **{
                f"log_prob {scope}": likelihood.with_noise(noise).log_prob(sets),
                f"stated {scope}": likelihood.with_noise(stated).log_prob(sets),
                f"nodes {scope}": nodes,
                f"best {scope}": [t.best(likelihood.difference(THETA)[:, 0]) for t in noise.terms],
                f"terms {scope}": [(t.share, t.log_det) for t in student_terms(data)],
            }
        )
    robust = Robustness(base, data, data.covariance, weights, standard[:, 0])
    numbers |= numbers_of(
        share=symmetric.share,
        standard=standard,
        scales=fitted,
        weights=weights,
        variance=base.covariance.variance,
        chi2=Likelihood(base).chi2(THETA),
        scores=(scores(symmetric, likelihood.residuals(THETA))[0] ** 2).sum(),
        moments=normal_moments(),
        outliers=robust.outliers,
    )
    num_regression.check(numbers, default_tolerance={"rtol": 0.0, "atol": 1e-4})


def test_rows_of_channels_and_exposures(num_regression) -> None:
    data = of_channels()
    layout = channel_layout(data)
    noise = noise_with_channels(data, [share(0.4, 0.3, 0.5)], FLOORS)
    alone = noise_with_channels(data, [], FLOORS)
    series = series_of(data, layout)
    both = Likelihood(data).residuals([[10.0, 5.0, 0.0]])
    drift = drift_of(
        SeriesAxes.of(series), np.hstack([both, np.cos(np.arange(len(both)))[:, None]])
    )
    lasting = replace(share(0.4, 0.3), vis2=replace(share(0.4, 0.3).vis2, lasting=drift.lasting))
    turned = noise_with_channels(data, [lasting])
    basis = smooth_basis(np.linspace(0.5, 1.5, 40))
    dense = np.zeros((40, 40))
    dense[basis.row, basis.column] = basis.value
    numbers = numbers_of(
        layout=layout,
        sigma=noise.rows.sigma,
        floor=noise.rows.floor,
        covariance=noise.covariance.dense(),
        logdet=noise.covariance.logdet(),
        alone=alone.covariance.dense(),
        turned=turned.covariance.dense(),
        turned_logdet=turned.covariance.logdet(),
        selected=noise.covariance.select(np.arange(4, 30)).dense(),
        hours=[one.hours for one in series],
        drift=drift,
        share=drift.share,
        drift_hours=drift.hours,
        nodes=list(drift.nodes(5).T),
        basis=np.abs(dense[:2]),
        slope_share=basis.slope_share,
    )
    num_regression.check(numbers, default_tolerance=TOLERANCE)


def test_laws_of_chi2_and_quadrature(num_regression) -> None:
    data = of_two_files()
    likelihood = Likelihood(data)
    difference = likelihood.difference(THETA)[:, 0]
    x = np.array([0.5, 20.0, 300.0, 2000.0, 5000.0])
    marginal = Marginal(np.array([0.0, 1.0, 1.5]), np.array([1.0, 2.0, 1.5]), np.array([1, 2, 0.5]))
    product = np.array([[50.0, 3.0, 1.0], [3.0, 2.0, 0.5], [1.0, 0.5, 4.0]])
    files = [FileNoise("a", 0.01, 0.02), FileNoise("b", 0.03, 0.005)]
    mean = mean_of_files(data, files)
    small = estimated(data.only(["vis2"]))
    numbers = numbers_of(
        survival=[log_chi2_survival(x, dof) for dof in (1.0, 30.0, 200.0)],
        n_sigma=candid_n_sigma(x + 50.0, 50.0, 30.0),
        degrees=[float(chi2_survival(40.0, 30.0, degrees)) for degrees in (np.inf, 12.0)],
        peak=[log_peak(30, np.inf), log_peak(30, 12.0)],
        part=chi2_of_part(data.covariance, np.arange(5, 20), difference),
        loss=restricted_loss(product, 20, 3.0),
        cdf=marginal.cdf(np.linspace(-0.5, 2.5, 9)),
        quantile=marginal.quantile([0.0, 0.1, 0.5, 0.9, 1.0]),
        files=mean,
        added=add_noise(data, mean).covariance.variance,
        rotation=[
            (null.degrees, null.rows, (null.factor**2).sum())
            for null in [rotation_null(Likelihood(small).noise, np.ones(small.n_vis2))]
        ],
        freedom=add_noise(small, ExtraNoise(0.01)).freedom,
    )
    rng = np.random.default_rng(6)
    whole = estimated(data)
    scatter = data.covariance.sparse * 0.7
    for name, one in (("plain", whole), ("measured", replace(whole, scatter=scatter))):
        noise = Likelihood(one).noise
        null = rotation_null(noise, np.ones(noise.n_independent))
        assert null is not None
        drawn = null.draw(np.cos(np.outer(np.arange(noise.n_independent), [1.0, 2.0])), rng)
        found = (null.degrees, null.rows, (null.factor**2).sum(), (drawn**2).sum(axis=0))
        numbers |= numbers_of(**{f"turned {name}": found})
    turned = data.with_data(np.where(np.arange(len(data.data)) > 50, 3.3, 1.0) * (1.0 + data.data))
    numbers |= numbers_of(wrapped=Likelihood(turned).difference(THETA))
    joined = joint_likelihood(Likelihood(pionier(3)), motion=True)
    numbers |= numbers_of(fastest=joined.model.fastest_mas_yr, mjd=joined.model.reference_mjd)
    num_regression.check(numbers, default_tolerance=TOLERANCE)
