"""Two companions: numbered by brightness, found where one alone is not, with their own noise."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import niriss, simulated
from scipy.special import logsumexp
from test_comparison import STAR, base_of, cube_of

from amibayes.companion_search.search import search
from amibayes.companion_search.with_extra_noise import search_with_noise
from amibayes.comparison.best_fits import NoiseSetting
from amibayes.comparison.compare import compare_sky_models
from amibayes.comparison.fit_models import fit_model
from amibayes.comparison.hypotheses import Hypothesis, hypotheses, split_settings
from amibayes.comparison.integral import Effort, integrate
from amibayes.errors import UsageError
from amibayes.likelihood.extra_noise import NoisePrior
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel
from amibayes.posterior.priors import PriorSetting


def polar(separation: float, angle: float, contrast: float) -> list[float]:
    turn = np.radians(angle)
    return [separation * np.sin(turn), separation * np.cos(turn), contrast]


def test_evidence_counts_both_numberings_and_numbers_by_brightness() -> None:
    """Against the mean likelihood of plain draws of the prior, of data that tell little."""
    base = base_of("two", [100.0, 40.0, 4e-4, -120.0, 60.0, 2e-4])
    model = cube_of("two", base)
    data = base.observables.data
    rng = np.random.default_rng(5)
    plain = model.log_prob(rng.random((60_000, model.n_dim)), data)
    expected = logsumexp(plain) - np.log(len(plain))
    weight = np.exp(plain - expected)
    error = float(weight.std() / np.sqrt(len(weight)))
    star = fit_model(cube_of("star", base), (), rng)
    one = fit_model(cube_of("companion", base), [star], rng)
    fit = fit_model(model, [one], rng)
    found = integrate(model, data, fit.cube, fit.chi2, rng, effort=Effort(4000, 4000))
    log_z, own = (found.diagnostics[k] for k in ("log_z", "log_z_error"))
    # Half of the numberings would be wrong by ln 2 = 0.69.
    assert np.hypot(error, own) < 0.12
    assert log_z == pytest.approx(expected, abs=4.0 * np.hypot(error, own))
    assert (found.samples[:, 2] >= found.samples[:, 5]).all()


def test_two_companions_are_found_where_one_is_not() -> None:
    """On opposite sides and equally bright: one companion alone lies on an alias of either."""
    truth = [*polar(140.0, 40.0, 0.03), *polar(140.0, 220.0, 0.03)]
    model = Hypothesis("two").model(BinaryModel())
    data = simulated(niriss(), truth, np.random.default_rng(3), model)
    prior = NoisePrior(0.05, np.radians(3.0))
    result, noise = search_with_noise(Likelihood(data), (60.0, 400.0), prior=prior)
    assert noise.any  # one companion leaves what looks like noise
    found = compare_sky_models(
        result, STAR, np.random.default_rng(1), models=("star", "companion", "two"),
        stated=data, noise=NoiseSetting(noise, prior), confusion_draws=0,
    )  # fmt: skip
    assert found.best.name == "two"
    # The noise of the best model: 36 data less six parameters.
    assert found.best.chi2 < 70.0
    assert found.noise.closure_phase_rad < np.radians(0.3)
    places = found.best.theta[[0, 1, 3, 4]].reshape(2, 2)
    expected = np.array([truth[:2], truth[3:5]])
    apart = np.linalg.norm(places[:, None] - expected, axis=-1).min(axis=1)
    assert (apart < 6.0).all()


def test_light_of_all_kinds_goes_with_wavelength_where_that_is_asked_for() -> None:
    model = Hypothesis("ring+companion").model(BinaryModel(contrast_slope="free"))
    names = model.parameters.names
    assert {"contrast_slope", "ring_slope"} <= set(names)


@pytest.mark.parametrize(
    "names", [("ring+companion", "companion+ring"), ("companion", "star+companion")]
)
def test_one_model_by_two_names_is_refused(names: tuple[str, str]) -> None:
    with pytest.raises(UsageError, match="one model"):
        hypotheses(names)


@pytest.mark.parametrize(
    ("name", "bounds"),
    [
        ("ring_diameter", (0.0, 300.0)),
        ("ring_axis_ratio", (0.5, 2.0)),
        ("ring_flux", (20.0, 30.0)),
        ("background", (-1.0, 0.2)),
    ],
)
def test_impossible_ranges_are_refused(name: str, bounds: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="impossible"):
        split_settings([PriorSetting(name, bounds=bounds)], ("ring", "halo"), background=False)


def test_the_flux_of_a_halo_has_a_prior_by_its_name() -> None:
    own = PriorSetting("background", bounds=(0.0, 0.2))
    assert split_settings([own], ("halo",), background=False) == ((), (own,))
    assert split_settings([own], ("halo",), background=True) == ((own,), ())


def test_the_innermost_of_aliases_is_the_best_fit() -> None:
    """Two places that NIRISS cannot tell apart: the far one may fit better by less than 1 in χ²."""
    base = base_of("companion", [*polar(150.0, 40.0, 0.01)], seed=None)
    found = search(base, (60.0, 750.0))
    compared = compare_sky_models(
        found, STAR, np.random.default_rng(1), models=("star", "companion"), confusion_draws=0
    )
    best = compared.models[1].theta
    assert np.hypot(*best[:2]) == pytest.approx(150.0, abs=2.0)
