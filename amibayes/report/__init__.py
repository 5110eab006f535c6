"""What a run says: ``result.json``, the summary on the terminal, and ``report.html``."""

from amibayes.report.captions import captioned
from amibayes.report.page import Column, Fact, Figure, Page, Section, Statement, Table, write_page
from amibayes.report.result import Json, limits_json, number, result_json
from amibayes.report.search_page import search_page
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
    "limits_json",
    "number",
    "result_json",
    "search_page",
    "summary",
    "write_page",
]
