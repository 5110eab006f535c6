"""What a run says: ``result.json``, and the summary on the terminal."""

from amibayes.report.result import Json, limits_json, number, result_json
from amibayes.report.summary import summary

__all__ = ["Json", "limits_json", "number", "result_json", "summary"]
