"""When two amounts of extra noise are the same to a search, and when two shares of channels are."""

from __future__ import annotations

from dataclasses import replace

import pytest

from amibayes.companion_search.with_extra_noise import _same, _same_shares
from amibayes.data.systematics import Systematics
from amibayes.likelihood.channel_noise import ChannelShare, Correlation
from amibayes.likelihood.extra_noise import ExtraNoise, FileNoise

KINDS = ("vis2", "closure_phase")
ONE = Correlation(0.3, 0.2, 0.5, 0.04, 1.5, 2.0, (0.1, 0.2))


def of_two_files(**changes: Correlation) -> ExtraNoise:
    """Channels of two files that share the same, but for kinds of the second."""
    both = [ChannelShare(ONE, ONE, "a"), replace(ChannelShare(ONE, ONE, "b"), **changes)]
    return ExtraNoise(0.01, 0.02, channels=tuple(both))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("change", "same"),
    [
        ({}, True),
        ({"value": 0.5199}, True),  # two hundredths, whatever it is uncertain by
        ({"value": 0.5201}, False),
        ({"value": 0.4801}, True),
        ({"value": 0.4799}, False),
        ({"value": 0.5299, "error": 0.12}, True),  # a quarter of its error
        ({"value": 0.5301, "error": 0.12}, False),
        ({"value": 0.4701, "error": 0.12}, True),
        ({"value": 0.5199, "error": float("nan")}, True),
        ({"value": 0.5201, "error": float("nan")}, False),
        ({"offset": 1.5 * 1.10}, True),  # ln 1.10 is 0.095
        ({"offset": 1.5 * 1.11}, False),
        ({"offset": 1.5 / 1.10}, True),
        ({"offset": 1.5 / 1.11}, False),
        ({"slope": 2.0 * 1.10}, True),
        ({"slope": 2.0 * 1.11}, False),
        ({"slope": 2.0 / 1.11}, False),
        ({"offset": 1.5 * 1.05, "slope": 2.0 * 1.04}, True),
        ({"offset": 1.5 * 1.06, "slope": 2.0 / 1.06}, False),
        ({"lasting": (0.15, 0.1999)}, True),
        ({"lasting": (0.15, 0.2001)}, False),
        ({"lasting": (0.05, 0.1999)}, False),
        ({"lasting": (0.2, 0.1)}, True),
    ],
)
def test_shares_of_channels(kind: str, change: dict, same: bool) -> None:
    other = of_two_files(**{kind: replace(ONE, **change)})
    assert _same_shares(of_two_files(), other) is same
    assert _same(of_two_files(), other) is same
    if "error" not in change:
        assert _same_shares(other, of_two_files()) is same


def test_shares_of_more_files_are_not_the_same() -> None:
    none = ExtraNoise(0.01, 0.02)
    assert not _same_shares(of_two_files(), none)
    assert not _same_shares(none, of_two_files())
    assert _same_shares(none, none)


@pytest.mark.parametrize("kind", ["vis2", "closure_phase_rad"])
def test_amounts_of_noise(kind: str) -> None:
    """To a hundredth of the larger, in all and in every file."""
    files = (FileNoise("a", 0.01, 0.02), FileNoise("b", 0.03, 0.04))
    one = ExtraNoise(0.02, 0.03, files)
    for factor, same in ((1.0101, True), (1.0102, False), (0.9901, True), (0.9899, False)):
        other = replace(one, **{kind: getattr(one, kind) * factor})
        assert _same(one, other) is same
        assert _same(other, one) is same
        changed = replace(files[1], **{kind: getattr(files[1], kind) * factor})
        assert _same(one, replace(one, files=(files[0], changed))) is same
        assert _same(one, replace(one, files=(changed, files[1]))) is False
    assert _same(one, replace(one, files=()))
    assert _same(ExtraNoise(), ExtraNoise())
    assert not _same(ExtraNoise(), replace(ExtraNoise(), **{kind: 1e-9}))


def test_noise_on_other_floors_is_not_the_same() -> None:
    floors = (Systematics("", 0.01, 0.004, 0.003),)
    assert _same(ExtraNoise(0.01, floors=floors), ExtraNoise(0.01, floors=floors))
    assert not _same(ExtraNoise(0.01, floors=floors), ExtraNoise(0.01))
