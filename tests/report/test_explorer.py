"""The interactive part of a report: its numbers, and what a reader sees in a browser."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import DESKTOP, PHONE, browser, shown
from helpers import niriss, simulated

from amibayes import SearchOptions, SearchReport, search_companion, write_oifits
from amibayes.plots.maps import told_by_draws
from amibayes.report import Page, Section, Statement, explorer_data, write_page
from amibayes.report.page import Figure, page_html

__all__ = ["browser"]

TRUTH = [110.0, -75.0, 0.02]


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> SearchReport:
    path = tmp_path_factory.mktemp("explorer") / "target.oifits"
    write_oifits(path, simulated(niriss(), TRUTH, np.random.default_rng(1)))
    options = SearchOptions((50.0, 400.0), null_draws=3000, posterior=False, limits=False)
    return search_companion([path], options=options)


@pytest.fixture(scope="module")
def content(report: SearchReport) -> dict[str, Any]:
    return explorer_data(report)


def layer(content: dict[str, Any], kind: str, name: str) -> np.ndarray:
    side = 2 * content["half"] + 1
    raw = base64.b64decode(content["maps"][kind][name])
    return np.frombuffer(raw, "<f4").reshape(side, side)


def at(content: dict[str, Any], east: float, north: float) -> tuple[int, int]:
    row, column = (round(x / content["step_mas"]) + content["half"] for x in (north, east))
    return row, column


def test_maps_are_those_of_the_search(report: SearchReport, content) -> None:
    grid, result = report.result.grid, report.result
    for name, values in (("delta_chi2", result.bank_delta_chi2), ("error", result.bank_sigma)):
        np.testing.assert_allclose(layer(content, "all data", name), grid.image(values), rtol=1e-6)
    gain = layer(content, "all data", "delta_chi2")
    best = np.unravel_index(np.nanargmax(gain), gain.shape)
    assert np.hypot(*np.subtract(best, at(content, 110.0, -75.0))) <= 1.5
    chance = layer(content, "all data", "log_probability")
    least = np.log10(told_by_draws(report.significance))
    assert chance[best] == pytest.approx(least, abs=1e-5)
    assert np.nanmin(chance) >= least - 1e-5
    # Its sidelobes are no further detections: with it taken out what is left is noise.
    away = np.hypot(*np.subtract(np.indices(chance.shape), np.reshape(best, (2, 1, 1))))
    far = away * content["step_mas"] > 0.75 * content["fringe_mas"]
    assert np.nanmin(chance[far]) > np.log10(report.significance.alpha)
    assert np.nanmax(chance) <= 0.0


def test_each_kind_of_data_finds_the_companion_by_itself(content) -> None:
    assert list(content["maps"]) == ["all data", "V²", "closure phases"]
    near = at(content, 110.0, -75.0)
    mirror = at(content, -110.0, 75.0)
    vis2, closure = (layer(content, kind, "contrast") for kind in ("V²", "closure phases"))
    assert vis2[near] == pytest.approx(0.02, rel=0.3)
    assert vis2[near] == pytest.approx(vis2[mirror], rel=1e-4)
    assert closure[near] == pytest.approx(0.02, rel=0.3)
    assert closure[mirror] < 0.01


def test_data_and_models_are_those_of_the_fit(report: SearchReport, content) -> None:
    data, likelihood = report.result.likelihood.observables, report.result.likelihood
    vis2, closure = content["data"]
    np.testing.assert_allclose(vis2["y"], data.data[:21], rtol=1e-5)
    model = np.degrees(likelihood.predict(report.result.theta)[21:, 0])
    np.testing.assert_allclose(closure["models"]["with companion"], model, rtol=1e-4, atol=1e-5)
    assert closure["period"] == 360.0
    assert set(vis2["models"]) >= {"star alone", "with companion"}
    assert len(vis2["label"]) == len(vis2["x"]) == vis2["n"] == 21


def test_a_large_map_keeps_the_best_position_of_every_cell(report, monkeypatch) -> None:
    monkeypatch.setattr("amibayes.report.explorer.MAX_SIDE", 21)
    content = explorer_data(report)
    small = layer(content, "all data", "delta_chi2")
    assert small.shape[0] <= 23
    assert np.nanmax(small) == pytest.approx(report.result.bank_delta_chi2.max(), rel=1e-6)


def test_what_stands_in_the_page_cannot_leave_its_element() -> None:
    section = Section("Search", explorer={"data": [{"name": "</script><b>"}]})
    text = page_html(Page("amibayes", "t", "s", Statement("open", "l", "h"), sections=(section,)))
    assert "</script><b>" not in text
    embedded = re.search(r'<script type="application/json">(.*?)</script>', text, re.DOTALL)
    assert json.loads(embedded[1])["data"][0]["name"] == "</script><b>"


@pytest.fixture(scope="module")
def page(content, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page with the explorer and a picture: white with a black line, and red."""
    import io

    from PIL import Image

    picture = Image.new("RGB", (400, 300), "white")
    picture.paste((213, 94, 0), (200, 0, 400, 300))
    picture.paste((0, 0, 0), (50, 50, 150, 60))
    written = io.BytesIO()
    picture.save(written, "PNG")
    uri = "data:image/png;base64," + base64.b64encode(written.getvalue()).decode()
    figure = Figure("half", "Half", "Half and half.", uri, 400, 300)
    sections = (Section("Search", figures=(figure,), explorer=content),)
    path = tmp_path_factory.mktemp("page") / "report.html"
    write_page(path, Page("amibayes", "t", "s", Statement("found", "l", "h"), sections=sections))
    return path


READ = "return document.querySelector('.sky-map output').textContent"


def pixel(browser: Any, selector: str, x: float, y: float) -> list[int]:
    """Colour of a canvas or image, at parts of its width and height."""
    return browser.execute_async_script(
        "const [name, x, y, done] = arguments, e = document.querySelector(name);"
        "const c = document.createElement('canvas');"
        "c.width = e.naturalWidth || e.width; c.height = e.naturalHeight || e.height;"
        "const g = c.getContext('2d'); g.drawImage(e, 0, 0);"
        "done([...g.getImageData(x * c.width, y * c.height, 1, 1).data].slice(0, 3))",
        selector, x, y,
    )  # fmt: skip


@pytest.mark.parametrize("size", [PHONE, DESKTOP])
def test_the_map_is_read_and_switched(browser: Any, page: Path, size) -> None:
    shown(browser, page, size)
    first = browser.execute_script(READ)
    assert first.startswith("134.5 mas at 125.0°")
    assert "false-alarm probability anywhere in the field below 0.0012" in first
    assert "contrast 1.934 ± 0.037 %" in first
    wide = "return [document.scrollingElement.scrollWidth, innerWidth]"
    assert browser.execute_script(wide)[0] <= size[0]
    pick = "const s = document.querySelector(arguments[0]); s.value = arguments[1]; s.onchange()"
    browser.execute_script(pick, ".sky-map .kind", "closure phases")
    assert "false-alarm" not in browser.execute_script(READ)
    assert len(browser.find_elements("css selector", ".layer option:disabled")) == 1
    before = browser.execute_script("return document.querySelector('.sky-map canvas').toDataURL()")
    browser.execute_script(pick, ".sky-map .layer", "contrast")
    after = browser.execute_script("return document.querySelector('.sky-map canvas').toDataURL()")
    assert before != after
    assert browser.get_log("browser") == []


def test_moving_and_zooming(browser: Any, page: Path) -> None:
    from selenium.webdriver import ActionChains, Keys

    shown(browser, page, DESKTOP)
    canvas = browser.find_element("css selector", ".sky-map canvas")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", canvas)
    first = browser.execute_script(READ)
    ActionChains(browser).move_to_element_with_offset(canvas, 60, 60).perform()
    assert browser.execute_script(READ) != first
    canvas.send_keys(Keys.ARROW_UP)
    whole = browser.execute_script("return document.querySelector('.sky-map canvas').toDataURL()")
    browser.find_element("css selector", ".zoom .in").click()
    near = browser.execute_script("return document.querySelector('.sky-map canvas').toDataURL()")
    assert near != whole
    browser.find_element("css selector", ".zoom .whole").click()
    again = browser.execute_script("return document.querySelector('.sky-map canvas').toDataURL()")
    assert again == whole
    assert browser.get_log("browser") == []


def test_a_datum_says_its_stations_and_models_are_switched(browser: Any, page: Path) -> None:
    from selenium.webdriver import Keys

    shown(browser, page, DESKTOP)
    told = "return document.querySelector('.data-plot output').textContent"
    assert "Largest residual: star alone" in browser.execute_script(told)
    sheet = browser.find_element("css selector", ".data-plot canvas")
    sheet.send_keys(Keys.ARROW_RIGHT)
    text = browser.execute_script(told)
    assert re.match(r"\S+-\S+, 4\.\d+ µm: ", text)
    assert "with companion" in text
    browser.execute_script("document.querySelector('.models input[value=\"star alone\"]').click()")
    assert "star alone" not in browser.execute_script(told)
    pick = "const s = document.querySelector('.observable'); s.selectedIndex = 1; s.onchange()"
    browser.execute_script(pick)
    assert browser.execute_script(told).startswith("35 closure phases.")
    assert browser.get_log("browser") == []


def test_pictures_are_dark_in_dark_mode_and_keep_their_colours(browser: Any, page: Path) -> None:
    from selenium.webdriver.support.ui import WebDriverWait

    shown(browser, page, DESKTOP, "dark")
    browser.execute_script("document.querySelector('.figures img').scrollIntoView()")
    wait = WebDriverWait(browser, 10)
    wait.until(lambda b: b.execute_script("return document.querySelectorAll('img.dark').length"))
    wait.until(lambda b: b.execute_script("return document.querySelector('img.dark').complete"))
    places = (0.1, 0.9), (0.25, 0.18), (0.9, 0.5)
    ground, line, red = (pixel(browser, "img.dark", x, y) for x, y in places)
    assert max(ground) < 60
    assert min(line) > 200
    np.testing.assert_allclose(red, (213, 94, 0), atol=3)
    light = [{"name": "prefers-color-scheme", "value": "light"}]
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": light})
    wait.until(lambda b: not b.find_elements("css selector", "img.dark"))
    assert min(pixel(browser, ".figures img", 0.1, 0.9)) > 200
    assert browser.get_log("browser") == []
