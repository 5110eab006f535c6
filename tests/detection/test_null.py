"""The reported false-alarm probability of noise made elsewhere is uniform."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
import pytest
from helpers import niriss
from noise_maker import Recipe
from scipy import linalg, stats
from scipy.sparse import csr_array

from amibayes.companion_search.grid import make_grid
from amibayes.companion_search.scan import scale_groups
from amibayes.companion_search.template_bank import TemplateBank
from amibayes.data.closure import closure_matrix, kernel_basis
from amibayes.data.covariance import dense_covariance
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.data.observables import Observables, join
from amibayes.data.shrinkage import shrunk_covariance
from amibayes.detection.false_alarm import significance
from amibayes.detection.rotations import Rotations
from amibayes.detection.statistic import BankStatistic, make_statistic
from amibayes.likelihood.likelihood import Likelihood
from amibayes.models.binary import BinaryModel

FIELD = (50.0, 400.0)
GAINS = Recipe(gain=0.004)
UNEVEN = Recipe(
    phase=np.radians(0.17) * np.exp(np.random.default_rng(3).normal(0.0, 0.4, 21)), gain=0.002
)


def made(data: Observables, step_mas: float, *, stated_errors: bool = False) -> BankStatistic:
    grid = make_grid(*FIELD, step_mas)
    return make_statistic(Likelihood(data), grid, np.empty(0), stated_errors=stated_errors)


def basis_of(data: Observables) -> np.ndarray:
    closures = kernel_basis(closure_matrix(data.closure_phase.stations)[0])
    return linalg.block_diag(np.eye(data.n_vis2), closures)


def probabilities(
    kind: str, n: int, rng: np.random.Generator, *, stated_errors: bool, step_mas: float = 23.5
) -> np.ndarray:
    """Reported probabilities of n null data sets whose covariance is known."""
    sheet = niriss(covariance="diagonal" if kind == "diagonal" else "assumed")
    if kind == "given":
        matrix = dense_covariance(GAINS.covariance(), basis_of(sheet))
        sheet = replace(sheet, covariance=matrix, covariance_kind="given")
    if kind == "kernel":
        sheet = sheet.only(("cp",))
    noise = {"diagonal": Recipe(), "given": GAINS}.get(kind, Recipe()).draw(rng, n)
    if kind == "diagonal":
        noise[21:] = rng.normal(0.0, np.radians(0.3), (35, n))
    test = made(sheet, step_mas, stated_errors=stated_errors)
    white = sheet.covariance.whiten(noise[-sheet.covariance.size :])
    found = test.evaluate(white)
    null = np.sort(test.draw_null(20_000, rng))
    return (1 + len(null) - np.searchsorted(null, found)) / (1 + len(null))


@dataclass(frozen=True)
class Estimated:
    """Null data whose covariance is measured; the extraction expects even, steady noise."""

    recipe: Recipe
    n_integrations: int
    kinds: tuple[str, ...] = ("cp",)
    step_mas: float = 60.0
    draws: int = 400

    def probabilities(self, n: int, rng: np.random.Generator) -> np.ndarray:
        """Reported probabilities (n, 2), each with its own covariance; errors on trust or not."""
        sheet = niriss().only(self.kinds)
        basis, used = basis_of(sheet), np.arange(56)[-sheet.covariance.size :]
        expected = Recipe().covariance()[np.ix_(used, used)]
        size = self.n_integrations
        out = np.empty((n, 2))
        for k in range(n):
            sample = self.recipe.draw(rng, size)[used]
            mean = sample.mean(axis=1)
            found = shrunk_covariance((sample - mean[:, None]).T, expected, basis, sheet.n_vis2)
            data = replace(
                with_values(sheet, mean),
                covariance=dense_covariance(found.matrix / size, basis),
                freedom=found.carried,
                scatter=csr_array(found.scatter / size) if found.carried else None,
            )
            out[k] = self._reported(data, rng)
        return out

    def _reported(self, data: Observables, rng: np.random.Generator) -> list[float]:
        tests = [made(data, self.step_mas, stated_errors=stated) for stated in (True, False)]
        return [significance(test, self.draws, rng, 0.05).probability for test in tests]


def with_values(sheet: Observables, noise: np.ndarray) -> Observables:
    """The sheet's data moved by noise."""
    n = sheet.n_vis2
    vis2 = replace(sheet.vis2, value=sheet.vis2.value + noise[:n])
    closure = replace(sheet.closure_phase, value=sheet.closure_phase.value + noise[n:])
    return replace(sheet, vis2=vis2, closure_phase=closure)


def check(p: np.ndarray, least: float, low: float = 0.01) -> None:
    """Kolmogorov–Smirnov, and the rate below ``low`` against binomial chance."""
    assert stats.kstest(p, "uniform").pvalue > least
    hits = int((p < low).sum())
    assert stats.binomtest(hits, len(p), low).pvalue > least, hits


KNOWN = ["kernel", "assumed", "diagonal", "given"]


@pytest.mark.parametrize("stated_errors", [True, False])
@pytest.mark.parametrize("kind", KNOWN)
def test_probability_is_uniform_in_400_null_sets(kind: str, stated_errors: bool) -> None:
    rng = np.random.default_rng([1, KNOWN.index(kind), not stated_errors])
    check(probabilities(kind, 400, rng, stated_errors=stated_errors, step_mas=31.0), 1e-4, 0.05)


def test_probability_is_uniform_with_estimated_covariance() -> None:
    """80 sets of 50 integrations of uneven baselines, which the expected noise takes for even."""
    for column in Estimated(UNEVEN, 50).probabilities(80, np.random.default_rng(2)).T:
        check(column, 1e-4, 0.05)


@pytest.mark.slow
@pytest.mark.parametrize("stated_errors", [True, False])
@pytest.mark.parametrize("kind", KNOWN)
def test_probability_is_uniform_in_2000_null_sets(kind: str, stated_errors: bool) -> None:
    rng = np.random.default_rng([3, KNOWN.index(kind), not stated_errors])
    check(probabilities(kind, 2000, rng, stated_errors=stated_errors), 0.01)


ESTIMATED = {
    "right, N = 1.3 p": Estimated(Recipe(), 20),
    "right, N = 3.3 p": Estimated(Recipe(), 50),
    "right, N = 0.7 p": Estimated(Recipe(), 10),
    "wrong, N = 3.3 p": Estimated(UNEVEN, 50),
    "wrong, N = 10 p": Estimated(UNEVEN, 150),
    "wrong, N = 1.3 p": Estimated(UNEVEN, 20),
}


@pytest.mark.parametrize(
    ("case", "n"),
    [
        pytest.param("right, N = 0.7 p", 300, marks=pytest.mark.slow),
        pytest.param("wrong, N = 3.3 p", 300, marks=pytest.mark.slow),
        *(pytest.param(case, 2000, marks=pytest.mark.release) for case in ESTIMATED),
    ],
)
def test_probability_is_uniform_whatever_noise_is_expected(case: str, n: int) -> None:
    """2000 null sets: the rate below 0.01 has a Monte Carlo error of 0.0022, of 0.5 of 0.011.

    The expected noise is right, or takes baselines for even that differ by 0.4 in ln σ.
    """
    rng = np.random.default_rng([4, list(ESTIMATED).index(case)])
    found = ESTIMATED[case].probabilities(n, rng)
    for name, column in zip(("errors on trust", "scale free"), found.T, strict=True):
        rates = ", ".join(f"{(column < level).mean():.4f}" for level in (0.5, 0.1, 0.05, 0.01))
        ks = stats.kstest(column, "uniform").pvalue
        logging.getLogger("null").info("%s, %s: KS p %.3f, rates %s", case, name, ks, rates)
        check(column, 1e-3 if n == 2000 else 1e-4, 0.01 if n == 2000 else 0.05)


def scaled(n: int, vis2: float, closure: float, rng: np.random.Generator) -> np.ndarray:
    """Reported probabilities of null sets whose kinds of data have noise of other sizes.

    Where V² are too high everywhere no contrast gains: such ties are shared out evenly.
    """
    sheet, noise = niriss(), Recipe().draw(rng, n)
    noise[:21] *= vis2
    noise[21:] *= closure
    out = np.empty(n)
    for k in range(n):
        data = with_values(sheet, noise[:, k])
        test = made(data, 47.0)
        statistic, null = test.value, test.draw_null(400, rng)
        above, ties = (null > statistic).sum(), (null == statistic).sum()
        out[k] = (1 + above + rng.random() * ties) / 401
    return out


@pytest.mark.parametrize(("share", "stated"), [(0.001, True), (0.25, False)])
def test_probability_is_uniform_where_few_integrations_were_calibrated(share, stated) -> None:
    """Four integrations of a target and of three calibrators, of noise that was expected.

    They scatter in twelve directions, and are worth five degrees of freedom together; this share
    of the estimate is by their scatter.
    """
    rng, n = np.random.default_rng(9), 100
    basis, colour = basis_of(niriss()), linalg.pinv(niriss().covariance.whitening.toarray())
    found = []
    for _ in range(n):
        target, calibrators = rng.standard_normal((3, 36)), rng.standard_normal((9, 36))
        scatter = 0.75 * (target.T @ target / 3.0 + calibrators.T @ calibrators / 27.0)
        estimate = colour @ ((1.0 - share) * np.eye(36) + share * scatter) @ colour.T
        sheet = replace(
            with_values(niriss(), niriss().covariance.draw(rng, 1)[:, 0]),
            covariance=dense_covariance(estimate, basis),
            freedom=Freedom(2.0 + 5.1 / share, 5.1),
            scatter=csr_array(colour @ scatter @ colour.T),
        )
        test = made(sheet, 60.0, stated_errors=stated)
        found.append(significance(test, 300, rng).probability)
    # No test of this kind is exact: small probabilities must not come too often.
    assert stats.binomtest(int((np.array(found) < 0.1).sum()), n, 0.1, "greater").pvalue > 1e-3
    assert 0.4 < np.mean(found) < 0.65


def test_probability_is_uniform_where_one_kind_of_error_is_wrong() -> None:
    """200 null sets whose closure phases scatter by a third of what is stated."""
    check(scaled(200, 1.0, 0.33, np.random.default_rng(8)), 1e-4, 0.05)


SCALES = [(1.0, 1.0), (0.5, 1.0), (1.0, 0.33), (1.0, 1.5), (1.5, 1.0), (3.0, 1.0)]


@pytest.mark.parametrize(
    ("vis2", "closure"),
    [
        *(pytest.param(*s, marks=pytest.mark.slow) for s in SCALES[-2:]),
        *(pytest.param(*s, marks=pytest.mark.release) for s in SCALES[:-2]),
    ],
)
def test_probability_is_uniform_whatever_the_kinds_scatter(vis2: float, closure: float) -> None:
    """2000 null sets; Monte Carlo error of the rate below 0.01: 0.0022."""
    found = scaled(2000, vis2, closure, np.random.default_rng([9, SCALES.index((vis2, closure))]))
    rates = ", ".join(f"{(found < level).mean():.4f}" for level in (0.5, 0.1, 0.05, 0.01))
    ks = stats.kstest(found, "uniform").pvalue
    logging.getLogger("null").info("V2 x %g, CP x %g: KS p %.3f, %s", vis2, closure, ks, rates)
    check(found, 1e-3)


def test_kinds_are_weighed_by_their_own_scatter(rng) -> None:
    """Against the same written down with dense templates, and the map of the statistic."""
    data, free = niriss(), BinaryModel(background="free")
    grid = make_grid(*FIELD, 31.0)
    test = make_statistic(Likelihood(data, free), grid, np.array([0.05]))
    bank = test.bank
    white = rng.standard_normal((36, 4)) * np.repeat([1.0, 0.2], [21, 15])[:, None]
    found = test.evaluate(white)
    templates = np.hstack([units for _, (units,) in bank.by_band()])
    residual, count = bank.project(white), np.array([21.0, 15.0]) * 35.0 / 36.0
    for k in range(4):
        r = residual[:, k]
        weight = np.repeat(count / [r[:21] @ r[:21], r[21:] @ r[21:]], [21, 15])
        match = np.maximum(templates.T @ (weight * r), 0.0)
        gain = (match**2 / (weight @ templates**2)).max()
        assert found[k] == pytest.approx(-35.0 * np.log1p(-gain / 35.0), rel=1e-4)
        field = test.field(white[:, k])
        assert field.max() == pytest.approx(found[k], rel=1e-4)


def test_groups_are_kinds_and_files_that_share_no_errors() -> None:
    sheet = niriss()
    one, other = (replace(sheet, setups=(replace(sheet.setups[0], source=name),)) for name in "ab")
    apart = scale_groups(join([one, other]), 0)
    assert sorted(apart.sums(np.ones(72)).tolist()) == [15.0, 15.0, 21.0, 21.0]
    assert sorted(scale_groups(join([one, one]), 0).sums(np.ones(72)).tolist()) == [30.0, 42.0]
    matrix = Recipe().covariance()
    matrix[:21, 21:] = 1e-7
    matrix[21:, :21] = 1e-7
    mixed = replace(sheet, covariance=dense_covariance(matrix, basis_of(sheet)))
    assert not scale_groups(mixed, 0).several
    assert not scale_groups(replace(sheet, freedom=Freedom(60.0, 40.0)), 0).several
    few = np.arange(21) < 5
    small = join([one, other.select(few, np.zeros(35, dtype=bool))])
    assert sorted(scale_groups(small, 0).sums(np.ones(41)).tolist()) == [5.0, 15.0, 21.0]


@pytest.mark.parametrize("freedom", [Freedom(60.0, 30.0), Freedom(30.0, 26.0), Freedom(25.0, 60.0)])
def test_simulated_data_have_the_distribution_of_the_likelihood(freedom: Freedom) -> None:
    """Where the scatter is all there is, χ² ν/((ν − 2) p) is F(p, ν): Hotelling's theorem.

    So it is where nothing is known of the scatter: the prior then counts as scatter.
    """
    rng = np.random.default_rng(5)
    sheet = replace(niriss(), freedom=freedom)
    sheet = with_values(sheet, sheet.covariance.draw(rng, 1)[:, 0])
    nu, p = freedom.degrees, sheet.n_independent
    if freedom.scatter == nu + p - 1.0:
        share = (nu - 2.0) / freedom.scatter
        sheet = replace(sheet, scatter=share * sheet.covariance.sparse)
    test = made(sheet, 60.0)
    assert isinstance(test.treatment, Rotations)
    normals = rng.standard_normal((p, 4000))
    noise = test.treatment.noise_of(normals, rng)
    chi2 = test.treatment.search_simulated(test.bank, noise).chi2
    law = stats.f(p, nu)
    assert stats.kstest(chi2 * nu / ((nu - 2.0) * p), law.cdf).pvalue > 1e-4


def test_each_data_set_is_searched_with_its_own_covariance() -> None:
    """Against a bank made of each estimate, nuisance directions and all."""
    rng = np.random.default_rng(6)
    sheet = replace(niriss(), freedom=Freedom(170.0, 24.0))
    colour = np.linalg.pinv(sheet.covariance.whitening.toarray())
    rows = rng.standard_normal((24, 36)) * np.exp(rng.normal(0.0, 0.4, 36))
    scatter = csr_array(colour @ rows.T @ rows @ colour.T / 24.0)
    sheet = with_values(replace(sheet, scatter=scatter), sheet.covariance.draw(rng, 1)[:, 0])
    model, grid = BinaryModel(background="free"), make_grid(*FIELD, 31.0)
    test = make_statistic(Likelihood(sheet, model), grid, np.array([0.05]))
    bank = test.bank
    noise, signal = rng.standard_normal((2, bank.n_data, 4))
    assert isinstance(test.treatment, Rotations)
    means = test.treatment.noise_of(noise, np.random.default_rng(7))
    found = test.treatment.search_simulated(bank, means, signal)
    own = test.treatment.null.residual
    for k in range(4):
        outer = np.outer(own, own) - np.outer(means[:, k], means[:, k])
        # The whitening rows of the sheet are V², then closures: its own factor undoes them.
        matrix = colour @ (np.eye(36) + outer / 168.0) @ colour.T
        alone = replace(
            sheet,
            covariance=dense_covariance(matrix, basis_of(sheet)),
            freedom=None,
            scatter=None,
        )
        other = TemplateBank(Likelihood(alone, model), grid, np.array([0.05]))
        white = alone.covariance.whiten(colour @ (signal[:, k] + means[:, k]))
        data = other.project(white)
        gain, where = other.largest_gain(data.astype(np.float32)[:, None])
        assert found.gain[k] == pytest.approx(gain[0], rel=1e-3)
        assert found.chi2[k] == pytest.approx((data**2).sum(), rel=1e-6)
        assert found.position[k] == where[0]
