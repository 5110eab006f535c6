"""Published data sets give their published numbers, or the page says why not."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import script_of_docs

DOCS = Path(__file__).resolve().parents[2] / "docs"


PUBLISHED = script_of_docs("published_results")
CASES = [
    pytest.param(
        data,
        marks=[pytest.mark.slow] if data.slow or number > 1 else [],
        id=f"{data.name}: {data.model}".replace(" ", "_"),
    )
    for number, data in enumerate(PUBLISHED.DATA_SETS)
    if data.possible
]


@pytest.mark.parametrize("dataset", CASES)
def test_published_numbers(data: Path, dataset: object) -> None:
    found = PUBLISHED.compare(dataset, data)
    assert not [c.row() for c in found if c.fails]


def test_the_page_has_every_data_set() -> None:
    text = (DOCS / "published_results.md").read_text(encoding="utf-8")
    for dataset in PUBLISHED.DATA_SETS:
        if not dataset.needs:
            for quantity in dataset.published:
                assert f"| {dataset.name} | {dataset.model} | {quantity} |" in text


def test_a_difference_needs_a_reason() -> None:
    first = PUBLISHED.DATA_SETS[0]
    apart = PUBLISHED.Comparison(first, "east (mas)", (6.6, 0.06), (6.2, 0.06))
    assert apart.fails
    assert apart.sigma == pytest.approx(0.4 / (0.06 * 2**0.5))
    near = PUBLISHED.Comparison(first, "east (mas)", (6.3, 0.06), (6.2, 0.0))
    assert not near.fails
