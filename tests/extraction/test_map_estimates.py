"""The mask's map: estimates put together, and how far one image's is known."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from amibayes.extraction.fourier.fine_image import fine_image
from amibayes.extraction.image_plane import FringeModel, weighted_fit
from amibayes.extraction.mask_map import (
    MapEstimate,
    MaskMap,
    combined,
    estimate_map,
    far_from_stated,
)
from amibayes.extraction.view import View
from amibayes.instrument import Distortion, load_instrument
from amibayes.units import FloatArray

NIRISS = load_instrument("niriss", "F480M")


def test_the_map_of_a_visit_is_the_best_fit_of_all_estimates_and_the_prior() -> None:
    rng = np.random.default_rng(1)
    prior = Distortion(np.array([[1.01, 0.02], [-0.01, 0.99]]), 0.007)
    estimates = []
    for k in range(2):
        root = rng.normal(size=(4, 6)) * (0.003 + 0.002 * k)
        estimates.append(MapEstimate(np.eye(2).ravel() + 0.01 * rng.normal(size=4), root @ root.T))
    roots = [np.linalg.inv(np.linalg.cholesky(e.covariance)) for e in estimates]

    def pulls(matrix: FloatArray) -> FloatArray:
        own = [r @ (matrix - e.value) for r, e in zip(roots, estimates, strict=True)]
        return np.concatenate([*own, (matrix - prior.matrix.ravel()) / prior.error])

    best = least_squares(pulls, np.zeros(4))
    found = combined([None, *estimates, None], prior)
    np.testing.assert_allclose(found.matrix.ravel(), best.x, atol=1e-8)
    errors = np.sqrt(np.diag(np.linalg.inv(best.jac.T @ best.jac)))
    np.testing.assert_allclose(found.error.ravel(), errors, rtol=1e-6)
    alone = combined([None], prior)
    np.testing.assert_allclose(alone.matrix, prior.matrix)
    np.testing.assert_allclose(alone.error, prior.error)


@pytest.mark.parametrize("error", [0.002, 0.01])
def test_maps_far_from_the_stated_one_cast_doubt(error: float) -> None:
    """Farther than a percent, and than three errors, in any of the four numbers."""
    stated = Distortion(np.array([[1.01, 0.02], [-0.01, 0.99]]), error)
    allowed = max(0.01, 3.0 * error)
    for entry, sign in (((0, 0), 1.0), ((0, 1), -1.0), ((1, 0), 1.0), ((1, 1), -1.0)):
        for share, told in ((0.97, False), (1.03, True)):
            matrix = stated.matrix.copy()
            matrix[entry] += sign * share * allowed
            notes = far_from_stated(MaskMap(matrix, np.full((2, 2), 1e-4)), stated)
            assert len(notes) == told
            if told:
                assert f"is {100.0 * share * allowed:.1f} % off" in notes[0]


def imaged(matrix: FloatArray, visibility: FloatArray) -> tuple[View, FloatArray]:
    """A view of the drawing, and an image (30, 34) of the mask under a map, not quite centred."""
    view = View(NIRISS, NIRISS.bandpass.channels(n=2), slice(0, 30), slice(0, 34), (0.3, -0.2))
    seen = view.mapped(matrix).moved(np.array([0.02, -0.01]))
    image = seen.basis().matrix @ np.concatenate([[1.0], visibility]) + 2e-6
    return view, np.asarray(image.reshape(view.shape))


@pytest.mark.parametrize("star", [True, False])
def test_an_image_tells_its_map_to_its_noise_and_what_a_companion_may_be(star: bool) -> None:
    n, rng = NIRISS.mask.n_baselines, np.random.default_rng(2)
    parts = np.concatenate([np.ones(n), np.zeros(n)])
    if not star:
        parts = np.concatenate([rng.uniform(0.8, 1.0, n), 0.1 * rng.normal(size=n)])
    truth = np.array([[1.004, -0.003], [0.006, 0.997]])
    view, image = imaged(truth, parts)
    weight = rng.uniform(0.5, 1.5, image.size) * 1e14
    weight[rng.uniform(size=image.size) < 0.05] = 0.0
    found = estimate_map(view, image, weighted_fit(FringeModel.of(view.basis()), weight))
    assert found is not None
    np.testing.assert_allclose(found.value, truth.ravel(), atol=2e-5)
    unlike = np.mean((parts[:n] - 1.0) ** 2 + parts[n:] ** 2)
    # What is left is of noise: slopes with every coefficient of the fit, and the centre, free.
    known = found.covariance - 0.02**2 * unlike * np.eye(4)
    seen = view.mapped(truth).moved(np.array([0.02, -0.01]))
    fringes = np.concatenate([[1.0], parts])
    steps = []
    for step in 1e-4 * np.eye(6):
        sides = [
            seen.mapped((np.eye(2) + s * step[:4].reshape(2, 2)) @ truth).moved(s * step[4:])
            for s in (1.0, -1.0)
        ]
        up, down = (side.basis().matrix @ fringes for side in sides)
        steps.append((up - down) / 2e-4)
    design = np.column_stack([*steps, seen.basis().matrix, np.ones(image.size)])
    scale = np.linalg.norm(design, axis=0)
    normal = (design / scale).T @ ((design / scale) * weight[:, None])
    exact = (np.linalg.inv(normal) / np.outer(scale, scale))[:4, :4]
    np.testing.assert_allclose(np.diag(known), np.diag(exact), rtol=0.05, atol=1e-10)


def test_an_image_of_another_mask_tells_no_map() -> None:
    n = NIRISS.mask.n_baselines
    view, image = imaged(np.diag([1.0, 1.07]), np.concatenate([np.ones(n), np.zeros(n)]))
    fit = weighted_fit(FringeModel.of(view.basis()), np.ones(image.size))
    assert estimate_map(view, image, fit) is None
    near = imaged(np.diag([1.0, 1.045]), np.concatenate([np.ones(n), np.zeros(n)]))[1]
    found = estimate_map(view, near, fit)
    assert found is not None
    np.testing.assert_allclose(found.value, [1.0, 0.0, 0.0, 1.045], atol=1e-4)


def test_fine_images_are_the_fringe_model_moved() -> None:
    n = NIRISS.mask.n_baselines
    numbers = np.random.default_rng(3).normal(size=1 + 2 * n)
    view = View(
        NIRISS, NIRISS.bandpass.channels(n=2), slice(0, 20), slice(0, 24), (0.3, -0.2), 0.01
    )
    shifts = np.array([[0.4, -0.3], [0.0, 0.0]])
    found = fine_image(view, numbers, 0.5).moved(shifts)
    for image, shift in zip(found, shifts, strict=True):
        exact = view.moved(shift).basis().matrix @ numbers
        np.testing.assert_allclose(image.ravel(), exact, atol=2e-5 * np.abs(exact).max())
