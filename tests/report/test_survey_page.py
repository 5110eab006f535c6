"""``survey.html``: escaped, complete without a network, and sorted by its headings."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from amibayes.plots.survey import save_survey_pictures
from amibayes.report.survey_page import MAX_ROWS, write_survey_page


def content(n: int = 8) -> dict:
    rng = np.random.default_rng(1)
    targets = [
        {
            "name": f"HD {k}",
            "status": "done",
            "error": None,
            "detected": k == 3,
            "verdict": "companion" if k == 3 else "no companion",
            "false_alarm_probability": 1e-4 if k == 3 else float(rng.uniform(0.01, 1)),
            "false_discovery_rate": 0.5,
            "separation_mas": float(rng.uniform(80, 300)),
            "position_angle_deg": 45.0,
            "field_mas": [70.0, 400.0],
            "modes": [],
        }
        for k in range(n)
    ]
    targets.append({"name": "<b>", "status": "failed", "error": "x.fits: is <no> file"})
    return {
        "command": "search",
        "seed": 1,
        "n_targets": n + 1,
        "n_done": n,
        "n_failed": 1,
        "false_alarms": {
            "n_tested": n,
            "n_detected": 1,
            "expected_false_detections": 0.01,
            "smallest_probability": 1e-4,
            "survey_wide_probability": 8e-4,
            "false_discovery_level": 0.05,
            "discovered": ["HD 3"],
            "null_draws_needed": 159,
            "uniformity": {"above": 0.2, "n": n - 2, "p": 0.4},
        },
        "completeness": None,
        "completeness_au": None,
        "companion_frequency": None,
        "targets": targets,
    }


@pytest.fixture
def page(tmp_path: Path) -> Path:
    survey = content()
    drawn = save_survey_pictures(survey, tmp_path)
    assert drawn == ["survey.png", "survey_false_alarms.png"]
    write_survey_page(tmp_path / "survey.html", survey, drawn, "report.html")
    return tmp_path / "survey.html"


def test_the_page_needs_nothing_else(page: Path) -> None:
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 2
    assert not re.search(r"(src|href)=\"(https?:)?//", text)
    assert "is &lt;no&gt; file" in text
    assert 'href="HD%203/report.html"' in text
    assert text.index("&lt;b&gt;") < text.index("HD 3")  # failed ones first
    assert "1 of 8 targets is listed as a companion" in text
    assert "1 target has a companion detected" in page.read_text()


def test_rows_past_what_a_browser_sorts_are_in_the_table(tmp_path: Path) -> None:
    survey = content(MAX_ROWS + 4)
    write_survey_page(tmp_path / "survey.html", survey, [], "report.html")
    text = (tmp_path / "survey.html").read_text()
    assert "5 more rows are in survey.ecsv" in text
    assert text.count("<tr") == MAX_ROWS + 1


def test_headings_sort_in_a_browser(page: Path) -> None:
    chromium = shutil.which("chromium") or shutil.which("chromium-browser")
    driver = shutil.which("chromedriver")
    if not chromium or not driver:
        pytest.skip("no chromium with chromedriver on this machine: pages not seen in a browser")
    webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu"):
        options.add_argument(word)
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    try:
        browser.get(page.as_uri())
        buttons = {b.text: b for b in browser.find_elements("css selector", "th button")}
        number = (
            "return [...document.querySelectorAll('tbody tr')].map(r => r.cells[3].dataset.value)"
        )
        for reverse in (False, True):
            buttons["False alarm"].click()
            values = browser.execute_script(number)
            assert values[-1] is None  # the failed one has no value
            numbers = [float(v) for v in values[:-1]]
            assert numbers == sorted(numbers, reverse=reverse)
        field = browser.find_element("id", "filter")
        field.send_keys("HD 3")
        shown = "return [...document.querySelectorAll('tbody tr')].filter(r => !r.hidden).length"
        assert browser.execute_script(shown) == 1
        assert not browser.get_log("browser")
    finally:
        browser.quit()
