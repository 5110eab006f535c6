"""The binary model and its likelihood against image sums, differences and dense algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers import NIRISS_HOLES, niriss, numerical_gradient, simulated

from amibayes.data.observables import join
from amibayes.data.point_source import point_source
from amibayes.errors import DataError, UsageError
from amibayes.likelihood.likelihood import Likelihood, joint_likelihood
from amibayes.models.bands import dates
from amibayes.models.binary import BinaryModel
from amibayes.models.uv_points import uv_points_of
from amibayes.units import MAS


def image_of_disc(diameter_mas: float, n: int = 801) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    axis = (np.arange(n) - n // 2) / n * diameter_mas * 1.02
    east, north = np.meshgrid(axis, axis)
    weight = (np.hypot(east, north) <= diameter_mas / 2).astype(float)
    return east.ravel(), north.ravel(), (weight / weight.sum()).ravel()


def direct_sum(u, v, wavelength, east_mas, north_mas, flux):
    """V of points: one sum, no formula of the package."""
    phase = -2j * np.pi * MAS * (np.outer(u, east_mas) + np.outer(v, north_mas)) / wavelength
    return np.exp(phase) @ flux


def test_model_against_a_direct_sum_over_an_image() -> None:
    wavelength, band = 2.0e-6, 0.1e-6
    stations = np.array([[0.0, 0.0], [60.0, 20.0], [10.0, 110.0], [-40.0, 70.0]])
    data = point_source(stations, wavelength, band, vis2_error=1.0, closure_error_rad=1.0)
    east, north, flux = image_of_disc(1.5)
    companion, background = 0.05, 0.1
    u, v = data.vis2.u_m[:, 0], data.vis2.v_m[:, 0]

    def visibility(u, v):
        # The companion's amplitude is averaged over wavelengths, phase linear across the channel.
        nodes, weights = np.polynomial.legendre.leggauss(40)
        lams = wavelength / (1 + 0.5 * band / wavelength * nodes)
        point = sum(
            w / 2 * direct_sum(u, v, lam, [12.0], [-5.0], [companion])
            for lam, w in zip(lams, weights, strict=True)
        )
        star = direct_sum(u, v, wavelength, east, north, flux)
        return (star + point) / (1 + companion + background)

    model = BinaryModel(diameter_mas=1.5, background=background)
    predicted = Likelihood(data, model).predict([[12.0, -5.0, companion]])[:, 0]
    np.testing.assert_allclose(predicted[:6], np.abs(visibility(u, v)) ** 2, atol=2e-4)
    cp = data.closure_phase
    legs = [visibility(cp.u_m[:, 0], cp.v_m[:, 0]), visibility(cp.u_m[:, 1], cp.v_m[:, 1])]
    legs.append(visibility(-cp.u_m.sum(axis=1), -cp.v_m.sum(axis=1)))
    np.testing.assert_allclose(predicted[6:], np.angle(legs[0] * legs[1] * legs[2]), atol=2e-4)


def test_bispectrum_convention_is_that_of_oifits() -> None:
    """V(1)·V(2)·V*(1+2) with V = Σ I exp(−2πi(uα + vδ)/λ), for one triangle, by hand."""
    data = niriss()
    cp = data.closure_phase
    east, north, c = 120.0, 50.0, 0.1
    lam = cp.wavelength_m[7]

    def v(u, w):
        return 1 + c * np.exp(-2j * np.pi * MAS * (u * east + w * north) / lam)

    (u1, u2), (v1, v2) = cp.u_m[7], cp.v_m[7]
    expected = np.angle(v(u1, v1) * v(u2, v2) * np.conj(v(u1 + u2, v1 + v2)))
    predicted = Likelihood(data, BinaryModel(smearing=False)).predict([[east, north, c]])
    np.testing.assert_allclose(predicted[21 + 7, 0], expected, rtol=1e-12)


def test_station_pairs_share_samples() -> None:
    assert len(uv_points_of(niriss())) == len(NIRISS_HOLES) * 3
    assert len(uv_points_of(niriss(channels=4))) == len(NIRISS_HOLES) * 12


MODELS = [
    (BinaryModel(), [140.0, -60.0, 0.02]),
    (BinaryModel(smearing=False), [140.0, -60.0, 0.5]),
    (BinaryModel(diameter_mas="free", background="free"), [-80.0, 150.0, 0.1, 20.0, 0.05]),
    (BinaryModel(companions=2), [140.0, -60.0, 0.02, -200.0, 10.0, 0.01]),
    (BinaryModel(companions=0, diameter_mas="free"), [15.0]),
]


@pytest.mark.parametrize(("model", "theta"), MODELS)
def test_gradient_against_finite_differences(model, theta, rng) -> None:
    data = simulated(niriss(vis2_error=0.01, closure_error_deg=0.5), [100.0, 100.0, 0.05], rng)
    likelihood = Likelihood(data, model)
    theta = np.array(theta)
    _, gradient = likelihood.log_prob_and_gradient(theta[None])
    numerical = numerical_gradient(likelihood, theta, 1e-5 * np.maximum(np.abs(theta), 0.01))
    np.testing.assert_allclose(
        gradient[0], numerical, rtol=2e-5, atol=1e-5 * np.abs(numerical).max()
    )
    residual = likelihood.residuals(theta)[:, 0]
    np.testing.assert_allclose(likelihood.jacobian(theta).T @ residual, gradient[0], rtol=1e-8)


def test_vectorised_likelihood_equals_one_at_a_time(rng) -> None:
    likelihood = Likelihood(simulated(niriss(), [100.0, 100.0, 0.05], rng))
    theta = np.column_stack([rng.uniform(-300, 300, (50, 2)), rng.uniform(0, 1, 50)])
    together = likelihood.log_prob(theta)
    assert together.shape == (50,)
    alone = [likelihood.log_prob(t[None])[0] for t in theta]
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def test_likelihood_is_the_gaussian_of_the_kernel_phases(rng) -> None:
    from scipy.stats import multivariate_normal

    from amibayes.data.closure import closure_matrix, kernel_basis

    data = simulated(niriss(), [100.0, 100.0, 0.05], rng)
    likelihood = Likelihood(data)
    theta = [[90.0, 110.0, 0.04]]
    difference = data.data - likelihood.predict(theta)[:, 0]
    basis = kernel_basis(closure_matrix(data.closure_phase.stations)[0])
    matrix = data.covariance.dense()
    expected = multivariate_normal(cov=np.diag(np.diag(matrix)[:21])).logpdf(difference[:21])
    kernel = basis.T @ difference[21:]
    expected += multivariate_normal(cov=basis.T @ matrix[21:, 21:] @ basis).logpdf(kernel)
    np.testing.assert_allclose(likelihood.log_prob(theta)[0], expected, rtol=1e-10)


def test_closure_phase_residuals_wrap() -> None:
    data = niriss()
    likelihood = Likelihood(data)
    np.testing.assert_allclose(likelihood.chi2([[100.0, 50.0, 0.0]]), 0.0, atol=1e-20)
    turned = simulated(data, [100.0, 50.0, 0.0], None, shift_closure=2 * np.pi)
    np.testing.assert_allclose(Likelihood(turned).chi2([[100.0, 50.0, 0.0]]), 0.0, atol=1e-18)


def test_one_data_set_is_wrapped_as_several_are() -> None:
    likelihood = Likelihood(niriss())
    change = np.linspace(-9.0, 9.0, len(likelihood.observables.data))
    several = likelihood.wrapped(np.column_stack([change, change]))
    np.testing.assert_array_equal(likelihood.wrapped(change.copy()), several[:, 0])
    n = likelihood.observables.n_vis2
    assert np.abs(several[n:]).max() <= np.pi
    np.testing.assert_array_equal(several[:n, 0], change[:n])


def test_theta_of_wrong_length_is_refused() -> None:
    with pytest.raises(UsageError, match=r"2 columns, not 3 .*east_mas, north_mas, contrast"):
        Likelihood(niriss()).log_prob([[1.0, 2.0]])


def test_a_companion_at_rest_is_where_it_was_at_every_date() -> None:
    parts = []
    for mjd in (60000.0, 60400.0):
        sheet = niriss()
        parts.append(
            replace(
                sheet,
                vis2=replace(sheet.vis2, mjd=np.full(len(sheet.vis2), mjd)),
                closure_phase=replace(
                    sheet.closure_phase, mjd=np.full(len(sheet.closure_phase), mjd)
                ),
            )
        )
    likelihood = Likelihood(join(parts))
    moving = joint_likelihood(likelihood, motion=True)
    places = np.array([[120.0, -60.0, 0.05], [-80.0, 10.0, 0.02]])
    still = likelihood.predict(places)
    np.testing.assert_allclose(moving.predict(moving.model.at_rest(places)), still, atol=1e-12)


def test_the_file_without_a_date_is_named() -> None:
    """One number of the second of three files."""
    parts = []
    for k in range(3):
        sheet = niriss()
        setups = (replace(sheet.setups[0], source=f"{k}.oifits"),)
        mjd = np.full(len(sheet.vis2), 60000.0 + k)
        closures = replace(sheet.closure_phase, mjd=np.full(len(sheet.closure_phase), mjd[0]))
        mjd[4] = 0.0 if k == 1 else mjd[4]
        vis2 = replace(sheet.vis2, mjd=mjd)
        parts.append(replace(sheet, setups=setups, vis2=vis2, closure_phase=closures))
    with pytest.raises(DataError, match="without a date") as caught:
        dates(join(parts))
    assert str(caught.value).startswith("1.oifits")
