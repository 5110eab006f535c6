"""One calibrator against the others: what the response of the instrument differs by.

Calibrators that agree are draws from one population (`amibayes.calibration.hierarchical`). How
far one of them may lie from the rest is drawn from that population, whose scatter only the rest
have determined: a calibrator with a companion does not excuse itself. All that is compared is
linear in what the calibrators see, so that the same numbers serve the data and the draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from amibayes.calibration.matching import Keys
from amibayes.calibration.scatter_likelihood import Group, Population, population_of
from amibayes.calibration.scatter_posterior import ScatterGrid
from amibayes.calibration.transfer import Diameter, Transfer, on_one_branch, transfer_of
from amibayes.data.observables import Observables
from amibayes.units import BoolArray, FloatArray, IntArray


@dataclass(frozen=True, eq=False)
class LeftOut:
    """A calibrator and the others that see the same baselines.

    Parameters
    ----------
    keys : (n,) bool array
        Those that all of them see: only there are they compared.
    response : (n_keys,) float array
        Mean of all of them.
    population : Population
        The calibrator, then the others.
    tau, weight : (m, 2) and (m,) float arrays
        Scatters between calibrators and their posterior by the others; 0 where there is one.
    changes : (n_names, n_calibrators, n_keys) float array
        One standard deviation of errors that the detector makes in all data alike.
    """

    keys: BoolArray
    response: FloatArray
    population: Population
    tau: FloatArray
    weight: FloatArray
    changes: FloatArray

    @property
    def n_others(self) -> int:
        """Calibrators that the one is compared with."""
        return int(self.population.groups[0].data.shape[1]) - 1

    @property
    def n_independent(self) -> int:
        """Independent numbers that each of them gives."""
        return int(sum(group.data[:, 0].size for group in self.population.groups))

    @property
    def measured(self) -> list[FloatArray]:
        """What the calibrators see, one (1, g, J, r) array for each group of the population."""
        return [group.data[None] for group in self.population.groups]

    def draw(self, n: int, rng: np.random.Generator) -> list[FloatArray]:
        """Draw calibrators of the population as in `measured`, n of each, the response taken out.

        The scatter between calibrators of each draw is one of its posterior.
        """
        counts = rng.multinomial(n, self.weight)
        drawn: list[list[FloatArray]] = [[] for _ in self.population.groups]
        for tau, count in zip(self.tau, counts, strict=True):
            if not count:
                continue
            common = rng.standard_normal((count, len(self.changes)))
            for group, out in zip(self.population.groups, drawn, strict=True):
                white = rng.standard_normal((count, *group.data.shape, 1))
                own = (np.linalg.cholesky(_spread(group, tau)) @ white)[..., 0]
                shared = np.einsum("nm,mgjr->ngjr", common, _on_group(self.changes, group))
                out.append(own + shared)
        return [np.concatenate(parts) for parts in drawn]

    def against(self, templates: FloatArray, free: IntArray) -> Comparison:
        """Prepare the comparison by what changes of some parameters do to the response.

        Parameters
        ----------
        templates : (p, n_keys) float array
            Change of the response that has the effect of a unit change of each parameter.
        free : int array
            Parameters that may differ.
        """
        tau = np.sqrt(self.weight @ self.tau**2)
        combine, inverse, fisher = [], [], np.zeros((len(templates), len(templates)))
        for group in self.population.groups:
            inverse.append(np.asarray(np.linalg.inv(_spread(group, tau)), dtype=float))
            # Covariance of the first less the mean of the others.
            apart = np.linalg.inv(inverse[-1][:, 0]) + np.linalg.inv(inverse[-1][:, 1:].sum(axis=1))
            onto = _on_group(templates[:, None], group)[:, :, 0].swapaxes(0, 1)
            combine.append(np.asarray(onto @ np.linalg.inv(apart), dtype=float))
            fisher += (combine[-1] @ onto.swapaxes(1, 2)).sum(axis=0)
        without = _without(fisher, free)
        made = Comparison(
            tuple(without @ c for c in combine), tuple(inverse), without @ fisher @ without.T
        )
        common = made.score([_on_group(self.changes, g) for g in self.population.groups])
        return replace(made, covariance=made.covariance + common.T @ common)


@dataclass(frozen=True, eq=False)
class Comparison:
    """What parameters the first calibrator asks for, less what the mean of the others does.

    Sums over the keys of their difference by the inverse of its covariance, the score.

    Parameters
    ----------
    combine : tuple of (g, p, r) float array
        For each group of the population.
    inverse : tuple of (g, J, r, r) float array
        Of the covariance of each calibrator about the response.
    covariance : (p, p) float array
        Of the score.
    """

    combine: tuple[FloatArray, ...]
    inverse: tuple[FloatArray, ...]
    covariance: FloatArray

    def score(self, seen: Sequence[FloatArray]) -> FloatArray:
        """The score (n, p) of what calibrators see, (n, g, J, r) for each group."""
        parts = zip(self.combine, self.inverse, seen, strict=True)
        return np.asarray(
            sum(
                np.einsum("gpr,ngr->np", c, z[:, :, 0] - _mean(inverse[:, 1:], z[:, :, 1:]))
                for c, inverse, z in parts
            )
        )

    def scatter(self, seen: Sequence[FloatArray]) -> FloatArray:
        """χ² (n,) of the others about their mean."""
        return self._chi2(seen, slice(1, None))

    def whole(self, seen: Sequence[FloatArray]) -> FloatArray:
        """χ² (n,) of all of them about their mean."""
        return self._chi2(seen, slice(None))

    def _chi2(self, seen: Sequence[FloatArray], some: slice) -> FloatArray:
        total = np.zeros(len(seen[0]))
        for inverse, z in zip(self.inverse, seen, strict=True):
            weight, ours = inverse[:, some], z[:, :, some]
            off = ours - _mean(weight, ours)[:, :, None]
            total += np.einsum("ngjr,gjrs,ngjs->n", off, weight, off, optimize=True)
        return total


def _mean(weight: FloatArray, seen: FloatArray) -> FloatArray:
    """Mean (n, g, r) of calibrators by inverse covariances (g, J, r, r)."""
    moment = np.einsum("gjrs,ngjs->ngr", weight, seen)
    return np.asarray(np.einsum("grs,ngs->ngr", np.linalg.inv(weight.sum(axis=1)), moment))


def _without(fisher: FloatArray, free: IntArray) -> FloatArray:
    """Take out of a score what parameters that may differ explain, (p − n_free, p)."""
    rest = np.setdiff1d(np.arange(len(fisher)), free)
    out = np.eye(len(fisher))[rest]
    scale = np.sqrt(np.diag(fisher)[free])
    scale = np.where(scale > 0.0, scale, 1.0)
    own = np.linalg.pinv(fisher[np.ix_(free, free)] / np.outer(scale, scale), hermitian=True)
    out[:, free] = -(fisher[np.ix_(rest, free)] / scale) @ own / scale
    return np.asarray(out)


def _spread(group: Group, tau: FloatArray) -> FloatArray:
    """Covariance (g, J, r, r) of each calibrator about the response."""
    return np.asarray(group.noise + np.tensordot(tau**2, group.scatter, 1))


def _on_group(changes: FloatArray, group: Group) -> FloatArray:
    """Changes of the keys (m, J, n_keys) as a group holds them, (m, g, J, r)."""
    places = zip(group.keys, group.basis, strict=True)
    return np.stack([changes[:, :, keys] @ basis for keys, basis in places], axis=1)


def leave_out(
    one: int, calibrators: Sequence[tuple[Observables, Diameter]], keys: Keys
) -> LeftOut | None:
    """Lay one calibrator and the others out; None where no other sees what it sees.

    Parameters
    ----------
    one : int
        Its number.
    calibrators : sequence of (Observables, (diameter, error))
        With their uniform discs in mas.
    keys : Keys
        Of the target.
    """
    seen = on_one_branch([transfer_of(c, keys, d) for c, d in calibrators], keys)
    first = seen.pop(one)
    others = [t for t in seen if (t.seen & first.seen).any()]
    common = np.all([t.seen for t in (first, *others)], axis=0)
    if not others or not common.any():
        return None
    both = [_restricted(t, common) for t in (first, *others)]
    if len(others) == 1:
        tau, weight = np.zeros((1, 2)), np.ones(1)
    else:
        tau, weight = ScatterGrid.of(population_of(both[1:], keys, common)).posterior
    names = dict.fromkeys(n for t in both if t.shared is not None for n in t.shared.names)
    nothing = np.zeros(len(keys))
    changes = [[nothing if t.shared is None else t.shared.change(n) for t in both] for n in names]
    return LeftOut(
        common,
        np.mean([t.value for t in both], axis=0),
        population_of(both, keys, common),
        tau,
        weight,
        np.array(changes).reshape(len(names), len(both), len(keys)),
    )


def _restricted(transfer: Transfer, keys: BoolArray) -> Transfer:
    """What a calibrator sees of some keys; 0 elsewhere."""
    return replace(transfer, value=np.where(keys, transfer.value, 0.0), seen=keys)


__all__ = ["Comparison", "LeftOut", "leave_out"]
