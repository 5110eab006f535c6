"""Results in common: what depends on the same is made once, and nothing else is shared."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np

from amibayes.support.shared_results import SharedResults, shared, shared_of_file, sharing


class Maker:
    """Counts how often it is asked."""

    def __init__(self, size: int = 10) -> None:
        self.calls, self.size = 0, size

    def __call__(self) -> np.ndarray:
        self.calls += 1
        return np.full(self.size, float(self.calls))


def test_equal_content_is_made_once_and_cannot_be_changed() -> None:
    results, make = SharedResults(), Maker()
    first = results.of(make, "kind", np.arange(5.0), 3)
    again = results.of(make, "kind", np.arange(5.0), 3)
    np.testing.assert_array_equal(first, again)
    again[:] = 7.0
    np.testing.assert_array_equal(results.of(make, "kind", np.arange(5.0), 3), first)
    assert (make.calls, results.made, results.found) == (1, 1, 2)


def test_content_that_differs_in_anything_is_another() -> None:
    results, make = SharedResults(), Maker()
    seed = np.random.SeedSequence(1)
    contents = [
        ("kind", np.arange(5.0)),
        ("other kind", np.arange(5.0)),
        ("kind", np.arange(5.0).astype(np.float32)),
        ("kind", np.nextafter(np.arange(5.0), 9.0)),
        ("kind", np.arange(5.0), seed.spawn(1)[0]),
        ("kind", np.arange(5.0), seed.spawn(1)[0]),
    ]
    for content in contents:
        results.of(make, *content)
    assert make.calls == len(contents)


def test_the_latest_used_stay_within_the_memory() -> None:
    results, make = SharedResults(30_000), Maker(1000)  # of 8 kB each: three of them
    for k in (0, 1, 2, 0, 3):
        results.of(make, k)
    assert make.calls == 4
    results.of(make, 0)
    assert make.calls == 4
    results.of(make, 1)  # the longest unused went first
    assert make.calls == 5
    results.of(Maker(100_000), "large")
    results.of(make, 0)
    assert make.calls == 5


def test_nothing_is_shared_outside_of_the_block() -> None:
    make = Maker()
    with sharing(SharedResults()):
        shared(make, 1)
        shared(make, 1)
    assert make.calls == 1
    shared(make, 1)
    assert make.calls == 2
    with sharing(SharedResults()):
        shared(make, 1)
    assert make.calls == 3


def test_what_is_read_of_a_file_is_shared_by_its_bytes(tmp_path: Path) -> None:
    file, other, make = tmp_path / "a.txt", tmp_path / "b.txt", Maker()
    file.write_text("one")
    other.write_text("one")
    with sharing(SharedResults()):
        for path in (file, file, other):  # messages name the file
            shared_of_file(make, path, "reading")
        assert make.calls == 2
        file.write_text("two")
        shared_of_file(make, file, "reading")
        assert make.calls == 3
        shared_of_file(make, tmp_path / "none", "reading")  # it has its own error to give
        shared_of_file(make, tmp_path / "none", "reading")
    assert make.calls == 5


def test_threads_of_a_worker_share() -> None:
    results, made = SharedResults(), []

    def target(seed: int) -> None:
        with sharing(results):
            for k in range(20):
                rng = np.random.default_rng([seed % 2, k])
                made.append((seed % 2, k, shared(lambda rng=rng: rng.random(), seed % 2, k)))

    threads = [threading.Thread(target=target, args=(s,)) for s in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 120
    assert all(value == np.random.default_rng([s, k]).random() for s, k, value in made)
    assert results.found + results.made == 120
