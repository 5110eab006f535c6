"""When the groups of a ramp were read, and how noise correlates their differences."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from amibayes.cube.header import number
from amibayes.units import FloatArray


@dataclass(frozen=True)
class GroupTiming:
    """Times of the reads of a ramp.

    Parameters
    ----------
    n_groups : int
    group_s : float
        From one group to the next.
    frame_s : float
        From one read to the next.
    n_frames : int
        Reads averaged into a group.
    first_s : float
        From the reset to the first read: a frame, or 0 where the read after the reset is kept.
    """

    n_groups: int
    group_s: float
    frame_s: float
    n_frames: int = 1
    first_s: float = 0.0

    @property
    def n_differences(self) -> int:
        """Of successive groups."""
        return self.n_groups - 1

    @cached_property
    def read_s(self) -> FloatArray:
        """(n_groups, n_frames) times of the reads from the reset."""
        group = self.first_s + self.group_s * np.arange(self.n_groups)
        return np.asarray(group[:, None] + self.frame_s * np.arange(self.n_frames))

    @cached_property
    def middle_s(self) -> FloatArray:
        """(n_differences,) times in the middle of each difference."""
        group = self.read_s.mean(axis=1)
        return np.asarray(0.5 * (group[1:] + group[:-1]))

    @cached_property
    def photon_covariance(self) -> FloatArray:
        """Covariance (m, m) of the differences, by photons, of which one comes in a group's time.

        Diagonal where a group is one read; averaged reads share photons with the next group.
        """
        time = self.read_s.ravel() / self.group_s
        return self._of_differences(np.minimum.outer(time, time))

    @cached_property
    def read_covariance(self) -> FloatArray:
        """Covariance (m, m) of the differences, by a noise of variance 1 in every group."""
        return self._of_differences(self.n_frames * np.eye(self.read_s.size))

    def _of_differences(self, of_reads: FloatArray) -> FloatArray:
        n, k = self.read_s.shape
        of_groups = of_reads.reshape(n, k, n, k).mean(axis=(1, 3))
        difference = np.eye(n - 1, n, 1) - np.eye(n - 1, n)
        return np.asarray(difference @ of_groups @ difference.T)


def timing_of(
    header: Mapping[str, Any], n_groups: int, group_s: float, source: str = "ramps"
) -> GroupTiming:
    """Timing from the keywords TFRAME, NFRAMES and, of simulated ramps, ZEROREAD.

    Where they are absent a group is one read, and the first one frame after the reset.

    Raises
    ------
    DataError
        Where one of them is no number.
    """
    frame, count = (number(header, key, source) for key in ("TFRAME", "NFRAMES"))
    n_frames = max(int(count or 1), 1)
    frame_s = frame if frame is not None and frame > 0.0 else group_s / n_frames
    frame_s = min(frame_s, group_s / n_frames)
    first = 0.0 if header.get("ZEROREAD") is True else frame_s
    return GroupTiming(n_groups, group_s, frame_s, n_frames, first)
