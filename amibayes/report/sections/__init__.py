"""Sections of `report.html`, each made of the content of ``result.json``."""
