"""What a run writes: ``result.json``, ``limits.json``, summaries, and ``report.html``."""

from amibayes.report.common import Json, number
from amibayes.report.explorer import explorer_data
from amibayes.report.limits import (
    limits_json,
    limits_report_json,
    limits_summary,
    limits_table,
    write_limits_table,
)
from amibayes.report.page import Column, Fact, Figure, Page, Section, Statement, Table, write_page
from amibayes.report.result import result_json
from amibayes.report.search_page import captioned, search_page
from amibayes.report.summary import summary

__all__ = [
    "Column",
    "Fact",
    "Figure",
    "Json",
    "Page",
    "Section",
    "Statement",
    "Table",
    "captioned",
    "explorer_data",
    "limits_json",
    "limits_report_json",
    "limits_summary",
    "limits_table",
    "number",
    "result_json",
    "search_page",
    "summary",
    "write_limits_table",
    "write_page",
]
