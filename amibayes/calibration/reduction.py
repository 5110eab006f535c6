"""What may be done to data before they are calibrated or fitted: flag, average, merge."""

from __future__ import annotations

from collections.abc import Sequence

from amibayes.calibration.binning import average_polarisations, bin_channels, merge_epochs
from amibayes.calibration.flagging import flag_by_rule
from amibayes.data.observables import Observables


def reduce_data(
    observables: Observables,
    *,
    flag: Sequence[str] = (),
    polarisations: bool = False,
    channels: int = 1,
    epochs_days: float | None = None,
) -> Observables:
    """Flag by rules, then average polarisations, channels and exposures, in this order.

    Parameters
    ----------
    flag : sequence of str
        Rules of `flag_by_rule`.
    polarisations : bool
        Average setups that differ in a last P1, P2 of INSNAME.
    channels : int
        Adjacent channels that become one.
    epochs_days : float, optional
        Average exposures within this time, while (u, v) stays.

    Raises
    ------
    UsageError, DataError
        As those functions.
    """
    if flag:
        observables = flag_by_rule(observables, flag)
    if polarisations:
        observables = average_polarisations(observables)
    if channels != 1:
        observables = bin_channels(observables, channels)
    return observables if epochs_days is None else merge_epochs(observables, epochs_days)
