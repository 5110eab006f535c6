"""The response to light off the axis: splines, the centre of a binary's image, derivatives."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import NIRISS_HOLES
from scipy import interpolate, optimize

from amibayes.data.observables import Observables, join
from amibayes.data.off_axis_response import OffAxisResponse, bspline_weights
from amibayes.data.point_source import point_source
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.models.companion import point_visibility
from amibayes.models.off_axis import OffAxis
from amibayes.oifits import read_oifits, write_oifits
from amibayes.optics.sampling import lattice_products, shifted_images
from amibayes.units import MAS

STEP_MAS = 40.0


def with_lattice(rng: np.random.Generator, mjd: float = 60000.0) -> Observables:
    """A point source, seen through a random response and pointed at beside the axis."""
    data = point_source(NIRISS_HOLES, 4.8e-6, 0.3e-6, vis2_error=0.005, closure_error_rad=0.005)
    x, y = np.meshgrid(*[np.linspace(-1.0, 1.0, 25)] * 2, indexing="ij")
    a, b, c, d, e = rng.normal(0.0, 0.3, (5, 7, 7, 1, 1))
    response = np.exp(-(x**2 + y**2) + a * x * y + 1j * (b * x + c * y + d * x**3 + e * y**3))
    response[np.arange(7), np.arange(7)] = np.exp(-0.8 * x**2 - 0.5 * y**2)
    lower = np.tril_indices(7, -1)
    response[lower] = response.conj()[lower[::-1]]
    turn = np.array([[-0.8, 0.6], [0.6, 0.8]]) / (STEP_MAS * MAS)
    lattice = OffAxisResponse(response, turn, np.array([3.0, -2.0]) * MAS)
    vis2, closure = (replace(m, mjd=m.mjd + mjd) for m in (data.vis2, data.closure_phase))
    setups = (replace(data.setups[0], response=lattice),)
    return replace(data, vis2=vis2, closure_phase=closure, setups=setups)


def test_splines_are_those_of_scipy(rng: np.random.Generator) -> None:
    coefficients = rng.standard_normal((11, 11))
    knots = np.arange(-7.0, 8.0)
    known = interpolate.NdBSpline((knots, knots), coefficients, 3)
    place = rng.uniform(-4.0, 4.0, (2, 200))
    index, weight = bspline_weights(place, 11)
    for k, nu in enumerate([(0, 0), (1, 0), (0, 1)]):
        values = (coefficients.ravel()[index] * weight[:, k]).sum(axis=1)
        np.testing.assert_allclose(values, known(place.T, nu=nu), atol=1e-12)


def test_the_edge_goes_on_for_ever() -> None:
    index, weight = bspline_weights(np.array([[4.0, 30.0], [1.0, 1.0]]), 11)
    np.testing.assert_array_equal(index[0], index[1])
    np.testing.assert_allclose(weight[0, [0, 2]], weight[1, [0, 2]])
    assert not weight[1, 1].any()
    assert weight[0, 0].sum() == pytest.approx(1.0)


def test_no_places_have_no_response(rng: np.random.Generator) -> None:
    """A limit may leave none whose aliases have to be looked for."""
    seen = Likelihood(with_lattice(rng)).samples.off_axis
    assert seen is not None
    fringe, flux = seen.at((np.empty(0), np.empty(0)))
    assert fringe.shape[1] == flux.shape[1] == 0


@pytest.mark.parametrize("step", [1, 2, 3])
def test_lattice_products_are_those_of_shifted_images(rng: np.random.Generator, step: int) -> None:
    """Of cells that hold no frequency beyond what the interpolation is made for."""
    grid = np.hypot(*np.meshgrid(np.arange(150) - 70.3, np.arange(156) - 80.1))
    cells = np.exp(-0.5 * (grid / 6.0) ** 2).astype(np.float32)
    operator = rng.normal(size=(5, 20, 18)).astype(np.float32)
    found = lattice_products(cells, 3, operator, (0.3, -0.2), step, 4)
    side = (np.arange(9) - 4) * step / 3
    places = np.array([(0.3 + x, -0.2 + y) for x in side for y in side])
    images = shifted_images(cells, 3, (20, 18), places)
    expected = np.einsum("pyx,nyx->pn", operator, images.astype(float)).reshape(5, 9, 9)
    np.testing.assert_allclose(found, expected, atol=2e-6 * np.abs(expected).max())


def test_centre_is_where_the_phases_have_no_slope(rng: np.random.Generator) -> None:
    """As a minimiser finds it that moves a binary under phases it wraps by itself."""
    samples = Likelihood(with_lattice(rng)).samples
    assert samples.off_axis is not None
    theta = np.array([[60.0, -30.0, 0.4], [-200.0, 90.0, 0.1]])
    wave = point_visibility(samples, *theta[:, :2].T, smearing=False)
    light = (1.0 + theta[:, 2] * wave) / (1.0 + theta[:, 2])
    east, north = samples.off_axis.centre(light)
    for k in range(2):

        def left(place: np.ndarray, k: int = k) -> np.ndarray:
            turn = np.exp(2j * np.pi * MAS * (samples.u * place[0] + samples.v * place[1]))
            return np.abs(light[:, k]) * np.angle(light[:, k] * turn)

        best = optimize.least_squares(left, [0.0, 0.0], xtol=1e-12).x
        np.testing.assert_allclose([east[0, k], north[0, k]], best - [3.0, -2.0], atol=1e-6)


@pytest.mark.parametrize("companions", [1, 2])
def test_derivatives_against_differences(companions: int, rng: np.random.Generator) -> None:
    """Bright companions, whose place moves the centre of the image and with it the response."""
    data = join([with_lattice(rng), with_lattice(rng, 60010.0)])
    model = BinaryModel(companions, diameter_mas="free", background="free")
    likelihood = Likelihood(data, model)
    places = [90.0, -60.0, 0.3, -150.0, 20.0, 0.2]
    theta = np.array([*places[: 3 * companions], 30.0, 0.05])
    step = np.full(len(theta), 1e-3)
    step[2 : 3 * companions : 3] = step[-1] = 1e-6
    value = model.visibility(
        likelihood.samples, np.vstack([theta + np.diag(step), theta - np.diag(step)])
    )
    n = len(theta)
    numerical = (value[:, :n] - value[:, n:]) / (2.0 * step)
    central, slopes = model.gradient(likelihood.samples, theta[None])
    np.testing.assert_allclose(central, model.visibility(likelihood.samples, theta[None]))
    np.testing.assert_allclose(slopes[..., 0].T, numerical, rtol=1e-5, atol=1e-7)


def test_a_lone_star_is_a_point(rng: np.random.Generator) -> None:
    """Whatever the response, and wherever it was pointed at: that has been calibrated away."""
    likelihood = Likelihood(with_lattice(rng))
    seen = likelihood.model.visibility(likelihood.samples, np.array([[80.0, 20.0, 0.0]]))
    np.testing.assert_allclose(seen, 1.0, atol=1e-12)


def test_exposures_have_centres_of_their_own(rng: np.random.Generator) -> None:
    """Joined data are predicted as each is alone."""
    parts = [with_lattice(rng), with_lattice(rng, 60010.0)]
    theta = [70.0, 40.0, 0.3]
    alone = [Likelihood(p).predict([theta])[:, 0] for p in parts]
    together = Likelihood(join(parts)).predict([theta])[:, 0]
    n = parts[0].n_vis2
    expected = [a[s] for s in (slice(0, n), slice(n, None)) for a in alone]
    np.testing.assert_allclose(together, np.concatenate(expected), atol=1e-12)
    assert np.abs(alone[0] - alone[1]).max() > 1e-3


def of_no_symmetry(rng: np.random.Generator) -> Observables:
    """A response of which nothing is alike at opposite places."""
    data = with_lattice(rng)
    lattice = data.setups[0].response
    assert lattice is not None
    more = 0.1 * rng.normal(size=(7, 7, 25, 25)) * (1.0 + 1.0j)
    more[np.arange(7), np.arange(7)] = more[np.arange(7), np.arange(7)].real
    lower = np.tril_indices(7, -1)
    more[lower] = more.conj()[lower[::-1]]
    changed = replace(lattice, coefficients=lattice.coefficients + more)
    return replace(data, setups=(replace(data.setups[0], response=changed),))


def test_templates_take_what_opposite_places_share(rng: np.random.Generator) -> None:
    """The mean of a response and of the conjugate of that at the opposite place."""
    samples = Likelihood(of_no_symmetry(rng)).samples
    assert samples.off_axis is not None
    east, north = rng.uniform(-300.0, 300.0, (2, 40))
    (fringe, flux), (other, dark) = (samples.off_axis.at((s * east, s * north)) for s in (1, -1))
    found, light = samples.off_axis.symmetrised.at((east, north))
    np.testing.assert_allclose(found, 0.5 * (fringe + other.conj()), atol=1e-12)
    np.testing.assert_allclose(light, 0.5 * (flux + dark), atol=1e-12)
    assert np.abs(fringe - found).max() > 0.05
    alike = Likelihood(with_lattice(rng)).samples.off_axis
    assert alike is not None
    assert alike.symmetrised.exposures == alike.exposures


@pytest.mark.parametrize("made", [with_lattice, of_no_symmetry])
def test_file_keeps_the_response(made, tmp_path, rng: np.random.Generator) -> None:
    data = made(rng)
    write_oifits(tmp_path / "x.oifits", data)
    after = read_oifits(tmp_path / "x.oifits").setups[0].response
    before = data.setups[0].response
    assert after is not None
    assert before is not None
    assert after.symmetric == before.symmetric == (made is with_lattice)
    # Where opposite places are conjugate, to rounding, half of them are written.
    np.testing.assert_allclose(after.coefficients, before.coefficients, rtol=1e-6)
    np.testing.assert_allclose(after.to_node, before.to_node, rtol=1e-12)
    np.testing.assert_allclose(after.pointing, before.pointing, rtol=1e-12)
    assert after.single


@pytest.mark.parametrize("axis", [0, 1])
def test_baselines_on_one_line_move_the_centre_along_it_alone(axis: int) -> None:
    """A shift by s turns the phases by −2π u·s; across the line nothing is known, nothing moves."""
    uv = np.zeros((3, 2))
    uv[:, axis] = [1.0, 2.0, -3.0]
    exposure = SimpleNamespace(rows=np.arange(3), uv=uv, pointing=np.zeros(2))
    shift = np.array([0.02, 0.03])
    seen = np.exp(-2j * np.pi * uv @ shift)[:, None]
    found = np.array(OffAxis(3, (exposure,)).centre(seen))[:, 0, 0]
    assert abs(found[axis]) == pytest.approx(shift[axis], rel=1e-6)
    assert found[1 - axis] == pytest.approx(0.0, abs=1e-9)
