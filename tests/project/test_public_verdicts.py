"""What the main job says, with no option, of public data whose object is known."""

from __future__ import annotations

from pathlib import Path

import pytest
from helpers import script_of_docs

DOCS = Path(__file__).resolve().parents[2] / "docs"


VERDICTS = script_of_docs("public_verdicts")
FAST = ("Canopus, MATISSE",)


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(
            case,
            id=case.name.replace(" ", "_"),
            marks=[] if case.name in FAST else [pytest.mark.slow],
        )
        for case in VERDICTS.CASES
    ],
)
def test_the_verdict_of_public_data_is_right(data: Path, case: object) -> None:
    assert not VERDICTS.faults(case, VERDICTS.searched(case, data))


def test_the_page_has_every_case() -> None:
    text = (DOCS / "public_verdicts.md").read_text(encoding="utf-8")
    assert not [c.name for c in VERDICTS.CASES if f"| {c.name} |" not in text]
