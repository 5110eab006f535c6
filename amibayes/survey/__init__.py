"""Many targets, one after the other: the table that names them, and what came of all."""

from amibayes.survey.summary import (
    Outcome,
    summary_json,
    summary_lines,
    summary_picture,
    write_summary,
)
from amibayes.survey.targets import SurveyTarget, read_targets

__all__ = [
    "Outcome",
    "SurveyTarget",
    "read_targets",
    "summary_json",
    "summary_lines",
    "summary_picture",
    "write_summary",
]
