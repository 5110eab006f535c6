"""Noise as the residuals of a fit show it: extra variance, and what channels share."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from scipy import optimize

from amibayes.data.blocks import BlockCovariance
from amibayes.data.covariance import Covariance
from amibayes.data.observables import Observables
from amibayes.data.systematics import Systematics
from amibayes.likelihood.channel_noise import (
    COMMON,
    ChannelCovariance,
    ChannelShare,
    Correlation,
    channel_rows,
    correlation_of,
    noise_rows,
)
from amibayes.likelihood.channel_rows import (
    CURVE,
    OFFSET,
    SLOPE,
    ChannelLayout,
    channel_layout,
)
from amibayes.likelihood.chi2 import chi2_survival
from amibayes.likelihood.exposure_rows import SeriesAxes, drift_of, series_of
from amibayes.likelihood.extra_noise import (
    BOUND,
    UNLIKELY,
    ExtraNoise,
    FileNoise,
    NoisePrior,
    covariance_of,
    mean_of_files,
    with_noise,
)
from amibayes.likelihood.likelihood import Likelihood
from amibayes.likelihood.residuals import groups_of
from amibayes.units import BoolArray, FloatArray

ROUNDS = 3
"""Extra variance and share of the channels in turn; they hardly depend on each other."""


def fit_noise(
    likelihood: Likelihood,
    theta: FloatArray,
    *,
    per_file: bool = False,
    prior: NoisePrior | None = None,
) -> ExtraNoise:
    """Find the noise that makes the residuals of a fit most likely.

    Each kind of observable by itself: it gets extra variance only where its χ² has a
    probability below `UNLIKELY`, as much as is most probable under the prior and at most
    `BOUND` times its width. The likelihood is the restricted one: the parameters of the fit
    take their share of the degrees of freedom.

    Parameters
    ----------
    likelihood : Likelihood
        With the stated errors.
    theta : (n_dim,) float array
        The fit.
    per_file : bool
        Every file has noise of its own.
    prior : NoisePrior, optional
    """
    prior, data = prior or NoisePrior(), likelihood.observables
    work = _Fit(likelihood, theta, prior)
    vis2 = np.arange(data.covariance.size) < data.n_vis2
    found, shares = [], []
    for source, here in groups_of(data, per_file=per_file):
        v, v_share = work.of_kind(here & vis2, "vis2")
        c, c_share = work.of_kind(here & ~vis2, "closure_phase_rad")
        found.append(FileNoise(source, v, c))
        shares.append(ChannelShare(v_share, c_share, source))
    if len(found) == 1:
        extra = ExtraNoise(found[0].vis2, found[0].closure_phase_rad)
    else:
        extra = mean_of_files(data, found)
    told = any(np.isfinite(c.error) or c.any for s in shares for c in (s.vis2, s.closure_phase))
    return replace(extra, channels=tuple(shares) if told else (), floors=prior.floors)


def noise_beside(
    stated: Likelihood,
    theta: FloatArray,
    *,
    per_file: bool = False,
    prior: NoisePrior | None = None,
) -> tuple[ExtraNoise, Likelihood]:
    """Fit the noise beside a model of parameters (n_dim,), and give the likelihood with it.

    ``stated`` has the stated errors; see `fit_noise` for the others.
    """
    expecting = stated.expecting(theta)
    noise = fit_noise(expecting, theta, per_file=per_file, prior=prior)
    return noise, with_noise(expecting, noise)


class _Fit:
    """Residuals of a fit, and what is asked of their noise."""

    def __init__(self, likelihood: Likelihood, theta: FloatArray, prior: NoisePrior) -> None:
        self.data, self.prior = likelihood.observables, prior
        self.difference = likelihood.difference(theta)[:, 0]
        self.jacobian = likelihood.slopes(theta)
        self.share = 1.0 - len(theta) / likelihood.n_independent

    def of_kind(self, which: BoolArray, kind: str) -> tuple[float, Correlation]:
        """Extra noise of some data, and what channels of an exposure share."""
        amount, shared = 0.0, Correlation()
        if not which.any():
            return amount, shared
        n = self.data.n_vis2
        part = self.data.select(which[:n], which[n:])
        floors = self.prior.floors
        one = _Kind(part, self.difference[which], self.jacobian[which], self.share, kind, floors)
        for _ in range(ROUNDS):
            before, smooth = amount, shared.smooth
            if self.prior.channels and self.data.freedom is None:
                shared = one.correlation(amount, smooth)
                shared = one.with_larger_floors(amount, shared, self.prior)
                shared = one.with_smooth(amount, shared, self.prior)
                shared = one.with_exposures(amount, shared)
            amount = one.amount(shared, self.prior.width(part, kind))
            if abs(amount - before) <= 1e-2 * amount and _some(shared.smooth) == _some(smooth):
                break
        return amount, shared


@dataclass(frozen=True, eq=False)
class _Kind:
    """Data of one kind whose noise is one: residuals, slopes of the fit, and layout."""

    data: Observables
    residual: FloatArray
    jacobian: FloatArray
    share: float
    kind: str
    floors: tuple[Systematics, ...]

    def covariance(self, amount: float, shared: Correlation) -> Covariance:
        """With an amount of extra noise, and channels that share some of the noise."""
        base = self._with(amount)
        if not (shared.any or self.floors):
            return base
        shares = [ChannelShare(shared, shared)]
        layout = self._layout(amount)
        return ChannelCovariance(base, noise_rows(self.data, layout, shares, self._own_floors))

    def _with(self, amount: float) -> BlockCovariance:
        """With an amount of extra noise, channels independent."""
        return self._grown(amount**2) if amount > 0.0 else self.data.covariance

    @cached_property
    def _grown(self) -> Callable[[float], BlockCovariance]:
        """The covariance with extra noise of a variance."""
        return self.data.covariance.growing(covariance_of(self.data, self._extra(1.0)))

    def _extra(self, amount: float) -> ExtraNoise:
        if self.kind == "vis2":
            return ExtraNoise(vis2=amount)
        return ExtraNoise(closure_phase_rad=amount)

    @property
    def _own_floors(self) -> list[Systematics]:
        return [f for f in self.floors if f.source in self._layout(0.0).names]

    def _layout(self, amount: float) -> ChannelLayout:
        """With an amount of extra noise: floors are smaller in units of the errors then."""
        if amount not in self._layouts:
            self._layouts[amount] = channel_layout(
                replace(self.data, covariance=self._with(amount))
            )
        return self._layouts[amount]

    @cached_property
    def _layouts(self) -> dict[float, ChannelLayout]:
        return {}

    @cached_property
    def _axes(self) -> SeriesAxes | None:
        """Of exposures that may err alike: no amount of noise changes which they are."""
        series = series_of(self.data, self._layout(0.0))
        return SeriesAxes.of(series) if series else None

    def explained(self, shared: Correlation) -> bool:
        """Whether the stated errors explain the residuals, for any share within 2σ."""
        near = [-2.0, 0.0, 2.0] if np.isfinite(shared.error) else [0.0]
        degrees, dof = self.data.degrees_of_freedom, self.share * self.data.covariance.rank
        for sigmas in near:
            common = float(np.clip(shared.common + sigmas * shared.error, 0.0, COMMON[-1]))
            tried = replace(shared, common=common) if sigmas else shared
            chi2 = _chi2(self.covariance(0.0, tried), self.residual)
            if chi2_survival(chi2, dof, degrees) > UNLIKELY:
                return True
        return False

    def amount(self, shared: Correlation, width: float) -> float:
        """Extra noise; none where the stated errors explain the residuals."""
        if self.explained(shared):
            return 0.0
        stated = self.covariance(0.0, shared)
        chi2, dof = _chi2(stated, self.residual), self.share * stated.rank
        typical = float(np.sqrt(np.median(self.data.covariance.variance)))
        largest = typical * np.sqrt(chi2 / dof)

        fit = self._misfit(shared)

        def loss(log_sigma: float) -> float:
            sigma = float(np.exp(log_sigma))
            return fit(sigma) + (sigma / width) ** 2

        low, high = 1e-2 * typical, min(10.0 * largest, BOUND * width)
        if high <= low:  # the stated errors are beyond what the prior allows already
            return 0.0
        # Where errors of channels are unequal, what these share changes with the amount, and there
        # may be another minimum next to no noise.
        tried = np.linspace(np.log(low), np.log(high), TRIED)
        k = int(np.argmin([loss(x) for x in tried]))
        bounds = float(tried[max(k - 1, 0)]), float(tried[min(k + 1, TRIED - 1)])
        best = optimize.minimize_scalar(
            loss, bounds=bounds, method="bounded", options={"xatol": 1e-3}
        )
        return float(np.exp(best.x))

    def _misfit(self, shared: Correlation) -> Callable[[float], float]:
        """−2 ln of the restricted likelihood of an amount of extra noise, but for a constant."""
        if not (shared.any or self.floors):
            return self._misfit_of_independent
        return partial(self._misfit_of_shared, shared)

    def _misfit_of_shared(self, shared: Correlation, amount: float) -> float:
        noisy = self.covariance(amount, shared)
        return _chi2(noisy, self.residual) + self.share * noisy.logdet()

    def _misfit_of_independent(self, amount: float) -> float:
        size, along = self._spectrum
        grown = 1.0 + amount**2 * size
        return float((along**2 / grown).sum() + self.share * np.log(grown).sum())

    @cached_property
    def _spectrum(self) -> tuple[FloatArray, FloatArray]:
        """Extra noise of unit amount against the stated errors: eigenvalues, residuals along."""
        added = covariance_of(self.data, self._extra(1.0))
        return self.data.covariance.against(added, self.residual)

    def correlation(self, amount: float, smooth: tuple[float, float, float]) -> Correlation:
        """What channels share, given an amount of extra noise and `Correlation.smooth`."""
        base = self._with(amount)
        white, slopes = base.whiten(self.residual), base.whiten(self.jacobian)
        layout = self._layout(amount)
        return correlation_of(layout, white, slopes, self._own_floors, changing=_some(smooth))

    def with_larger_floors(
        self, amount: float, shared: Correlation, prior: NoisePrior
    ) -> Correlation:
        """The same with floors as large as the residuals show them, and not smaller.

        Gains and slopes of single exposures tell their size, which is that of a good night in a
        table. By restricted likelihood, the excess with the prior of extra noise.
        """
        floor, width = self._floor, self._width(prior)
        if not floor or not width:
            return shared
        base = self._with(amount)
        layout = self._layout(amount)
        rows = channel_rows(layout, [ChannelShare(shared, shared)], self._own_floors)
        square = (rows.rotation @ base.whiten(self.residual)) ** 2
        found = [
            self._growth(square[at], rows.sigma[at] ** 2, rows.floor[at], floor / width)
            for at in (rows.level == OFFSET, rows.level == SLOPE)
        ]
        return replace(shared, offset=found[0], slope=found[1])

    def with_smooth(self, amount: float, shared: Correlation, prior: NoisePrior) -> Correlation:
        """The same with errors that are smooth over channels, where no floor has any.

        Those of single exposures tell their variance, as they do of a floor. They are beside what
        details show of the size of all errors, of which the amount of extra noise is found next.
        """
        width = self._width(prior)
        if self._floor or not width:
            return shared
        base = self._with(amount)
        layout = self._layout(amount)
        rows, with_one = (
            channel_rows(layout, [ChannelShare(own, own)])
            for own in (replace(shared, smooth=(size, size, size)) for size in (NEXT_TO_NONE, 1.0))
        )
        square, details = (rows.rotation @ base.whiten(self.residual)) ** 2, rows.level == 0
        if not details.any():
            return shared
        square /= max(float((square / rows.sigma**2)[details].mean()) / self.share, 1.0)
        added = with_one.sigma**2 - rows.sigma**2
        ratio = 1.0 / (float(np.median(layout.unit)) * width)
        offset, slope, curve = (
            self._growth(square[at], rows.sigma[at] ** 2, added[at], ratio) - 1.0
            for at in (rows.level == level for level in (OFFSET, SLOPE, CURVE))
        )
        return replace(shared, smooth=(offset, slope, curve))

    @property
    def _floor(self) -> float:
        """The largest one of this kind."""
        vis2 = self.kind == "vis2"
        return max((f.vis2 if vis2 else f.closure_phase_rad for f in self._own_floors), default=0.0)

    def _width(self, prior: NoisePrior) -> float:
        """Width of the prior of this kind's extra noise."""
        return prior.vis2 if self.kind == "vis2" else prior.closure_phase_rad

    def with_exposures(self, amount: float, shared: Correlation) -> Correlation:
        """The same with what exposures that follow each other share, as the residuals show."""
        if self._axes is None:
            return shared
        alone = replace(shared, lasting=())
        rows = channel_rows(self._layout(amount), [ChannelShare(alone, alone)], self._own_floors)
        noise = ChannelCovariance(self._with(amount), rows)
        white = noise.whiten(np.column_stack([self.residual, self.jacobian]))
        return replace(shared, lasting=drift_of(self._axes, white).lasting)

    def _growth(
        self, square: FloatArray, variance: FloatArray, floor: FloatArray, ratio: float
    ) -> float:
        """Factor of a floor's variance, of squares of rows (n,); ``ratio`` of it to the prior."""
        most = (BOUND / ratio) ** 2
        if len(square) < MIN_ROWS or most <= 1.0:
            return 1.0

        def loss(log_growth: float) -> float:
            more = float(np.expm1(log_growth))
            total = variance + more * floor
            fit = (square / total + self.share * np.log(total)).sum()
            return float(fit + more * ratio**2)

        best = optimize.minimize_scalar(
            loss, bounds=(0.0, float(np.log(most))), method="bounded", options={"xatol": 1e-3}
        )
        growth = float(np.exp(best.x))
        return growth if loss(0.0) - best.fun > CLEARLY_LARGER else 1.0


NEXT_TO_NONE = 1e-9
"""Variance of smooth errors beside which all others are what they are beside larger ones."""

TRIED = 16
"""Amounts of extra noise, of equal ratios, about the best of which it is sought."""

MIN_ROWS = 6
"""Gains (of baselines in exposures) from which on their scatter is known to a third."""

CLEARLY_LARGER = 4.0
"""2Δln L by which a floor has to be exceeded: two standard deviations."""


def _some(smooth: tuple[float, float, float]) -> tuple[bool, bool]:
    """Whether errors change across channels, evenly and by a curve."""
    return smooth[1] > 0.0, smooth[2] > 0.0


def _chi2(covariance: Covariance, residual: FloatArray) -> float:
    return float((covariance.whiten(residual) ** 2).sum())
