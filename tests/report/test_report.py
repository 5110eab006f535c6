"""report.html: what it says, that it says it safely, and how a real browser shows it."""

from __future__ import annotations

import argparse
import base64
import copy
import hashlib
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import DESKTOP, PHONE, browser, shown
from helpers import niriss, simulated
from trial_answers import PLAN, answers

from amibayes.cli import main
from amibayes.cli.options import common
from amibayes.companion_search.search import search
from amibayes.data.degrees_of_freedom import Freedom
from amibayes.errors import DataError
from amibayes.likelihood.likelihood import Likelihood
from amibayes.oifits import write_oifits
from amibayes.pipeline.options import SearchOptions
from amibayes.pipeline.report_types import Stages
from amibayes.plots.pictures import PICTURES, picture_names
from amibayes.plots.style import save
from amibayes.report import Column, Page, Section, Statement, Table, captioned, search_page
from amibayes.report.page import Sky, page_html, read_figure
from amibayes.report.search_page import SECTIONS
from amibayes.report.sections.joint import RESIDUALS
from amibayes.report.statement import sky_of, statement_of
from amibayes.report.summary import _detection
from amibayes.report.validation import validation_page, validation_pictures
from amibayes.report.words import chance, count, measured, plain
from amibayes.validation.tally import tally

__all__ = ["browser"]

HOSTILE = "<b>bold</b>&\"'<img src=x onerror=alert(1)>.oifits".replace("/", "")
TRUTH = [110.0, -75.0, 0.02]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A search of a file with a hostile name, with calibrators."""
    base = tmp_path_factory.mktemp("report")
    target, cals = base / HOSTILE, [base / f"cal{k}.oifits" for k in range(2)]
    write_oifits(target, simulated(niriss(), TRUTH, np.random.default_rng(1)))
    for k, path in enumerate(cals):
        write_oifits(path, simulated(niriss(), [0.0, 0.0, 0.0], np.random.default_rng(5 + k)))
    words = ["search", str(target), "--cal", *map(str, cals), "--separation", "50:400"]
    out = base / "out"
    assert main([*words, "--null-draws", "3000", "--out", str(out), "--quiet"]) == 0
    return out


@pytest.fixture(scope="module")
def content(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "result.json").read_text())


class Reader(HTMLParser):
    """Collects what a page links to, loads, names and says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: list[str] = []
        self.links: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.tags: set[str] = set()
        self.said = ""
        self._silent = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.tags.add(tag)
        self._silent = tag in ("style", "script")
        if values.get("id"):
            self.ids.append(str(values["id"]))
        if tag == "a":
            self.links.append(str(values["href"]))
        if tag == "img":
            self.images.append(values)

    def handle_data(self, data: str) -> None:
        self.said += "" if self._silent else data


@pytest.fixture(scope="module")
def page(folder: Path) -> Reader:
    return Reader((folder / "report.html").read_text())


@pytest.mark.parametrize(
    ("value", "error", "written"),
    [
        (151.8588, 2.825, "151.9 ± 2.8"),
        (0.0097167, 0.00028957, "0.00972 ± 0.00029"),
        (1234.5, 99.6, "1234 ± 100"),
        (-28.506, 0.0996, "−28.51 ± 0.10"),
        (5e-9, 1.2e-10, "(5.00 ± 0.12) × 10⁻⁹"),
        (3.0, math.nan, "3"),
        (None, 1.0, "–"),
        (math.nan, 1.0, "–"),
    ],
)
def test_as_many_digits_as_the_error_leaves(value, error, written) -> None:
    assert measured(value, error).replace("\u00a0", " ") == written


@pytest.mark.parametrize(
    ("value", "written"),
    [(0.0, "0"), (752.62, "753"), (9.9999e-5, "0.0001"), (3.21e-7, "3.21 × 10⁻⁷"),
     (1e6, "1 × 10⁶"), (-2.5, "−2.5"), (math.inf, "–"), (0.99999, "1"), (100.0, "100")],
)  # fmt: skip
def test_plain_numbers(value, written) -> None:
    assert plain(value).replace("\u00a0", " ") == written


def test_chances_and_counts() -> None:
    assert [chance(p) for p in (0.0, 1.0, 0.343, 0.0013)] == ["0", "1", "34\u00a0%", "0.0013"]
    assert chance(8e-254) == "8\u00a0×\u00a010⁻²⁵⁴"
    assert count(1, "mode") == "1 mode"
    assert count(10000, "draw") == "10\u202f000 draws"


def test_the_answer_stands_in_words(page: Reader, content) -> None:
    fit = content["fit"]
    said = page.said.replace("\u00a0", " ")
    place = f"A companion at {fit['separation_mas']:.1f} ± {fit['errors']['separation_mas']:.1f}"
    assert place in said
    assert "Not one of 3\u202f000 data sets simulated without a companion has anything as" in said
    assert "the chance of this by noise is below 0.0012, with 95" in said
    for entry in content["inputs"]:
        assert entry["sha256"] in said
        assert entry["path"] in said
    for title in ("Data and calibration", "Search", "Significance", "Posterior", "Evidence",
                  "Detection limits", "How to run it again"):  # fmt: skip
        assert title in said
    assert "--null-draws 3000" in said
    assert "--seed 1" in said
    for warning in content["warnings"]:
        assert warning[1:] in page.said
        said = said.replace(warning[1:], "")
    assert not re.search(r"\b(nan|None|inf)\b", said)


def test_the_page_is_whole_and_safe(page: Reader, folder: Path) -> None:
    text = (folder / "report.html").read_text()
    assert not page.tags & {"b", "iframe", "object", "embed"}
    runs_only_its_own_script(text)
    assert not re.search(r"(?:src|href)=\"(?!data:|#)", text)
    assert "url(" not in text
    assert "@import" not in text
    assert "srcset" not in text
    assert len(page.ids) == len(set(page.ids))
    assert {link.removeprefix("#") for link in page.links} <= set(page.ids)
    names = [p.stem for p in folder.glob("*.png")]
    assert sorted(i.removeprefix("figure-") for i in page.ids if i.startswith("figure-")) == sorted(
        names
    )
    assert all(str(i["src"]).startswith("data:image/png;base64,") for i in page.images)
    assert all(i["alt"] and int(str(i["width"])) > 300 for i in page.images)


def runs_only_its_own_script(text: str) -> None:
    """One script, named by its digest in the policy of the page; JSON beside it is never run."""
    (policy,) = re.findall(r"script-src 'sha256-([^']*)'", text)
    scripts = re.findall(r"<script( type=\"application/json\")?>(.*?)</script>", text, re.DOTALL)
    (script,) = [content for is_data, content in scripts if not is_data]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy == digest
    assert "unsafe-eval" not in text
    assert "http" not in script


def test_every_picture_stands_in_a_section_and_is_drawn_by_some_run() -> None:
    full = Stages(*[True] * 8)
    assert len({p.name for p in PICTURES}) == len(PICTURES)
    for picture in PICTURES:
        assert picture.section in SECTIONS
        assert picture.title
        assert picture.text.endswith(".")
        assert picture.when(full)
    assert "files.png" not in picture_names(SearchOptions(), calibrated=True)


def test_no_detection_states_a_limit(content) -> None:
    none = copy.deepcopy(content)
    none["significance"] |= {
        "detected": False, "false_alarm_probability": 0.34, "false_alarm_interval": [0.32, 0.36],
    }  # fmt: skip
    none["posterior"]["upper_limit"] = {
        "level": 0.95, "contrast": 0.001, "delta_mag": 7.5, "prior": "contrast uniform",
        "contrast_stated_prior": 0.002,
    }  # fmt: skip
    said = statement_of(none)
    assert said.kind == "none"
    assert said.headline.startswith("No companion is detected at 50 to 400 mas")
    words = " ".join(said.sentences).replace("\u00a0", " ")
    assert "34 %" in words
    assert "more than 7.50 mag fainter" in words
    assert "would be found 95 % of the time" in words
    first, *excluded = search_page(none).facts
    assert first.value == "34\u00a0%"
    assert [fact.value for fact in excluded][1:] == ["0.001"]
    mags = [m for m in none["limits"]["delta_mag"] if m is not None]
    assert excluded[0].value == f"{min(mags):.1f} to {max(mags):.1f}"
    assert "Separation" not in " ".join(fact.name for fact in search_page(none).facts)
    none |= {"posterior": None, "limits": None}
    assert [fact.value for fact in search_page(none).facts] == ["34\u00a0%"]


def test_a_companion_that_another_star_replaces_is_not_stated(content) -> None:
    """Noise alone does not give it, and a star that changes with wavelength does."""
    other = copy.deepcopy(content)
    other["significance"]["detected"] = True
    because = "a star whose diameter changes with wavelength, from 1 to 2 mas, fits as well"
    other["verdict"] = {"statement": "no companion", "because": because, "note": ""}
    said = statement_of(other)
    assert (said.kind, said.label) == ("none", "No companion detected")
    assert said.headline == f"No companion is stated: {because}."
    assert [mark.kind for mark in sky_of(other).marks] == ["candidate"] + ["mode"] * (
        len(sky_of(other).marks) - 1
    )
    assert "Separation" not in " ".join(fact.name for fact in search_page(other).facts)
    other["verdict"]["statement"] = "model rejected"
    assert "Separation" not in " ".join(fact.name for fact in search_page(other).facts)


def test_what_the_data_leave_open_has_no_error(content) -> None:
    open_place = copy.deepcopy(content)
    open_place["significance"]["detected"] = True
    open_place["verdict"] = None
    open_place["fit"]["errors"] |= {"separation_mas": 1913.0, "position_angle_deg": 85346.0}
    words = statement_of(open_place).headline.replace("\u00a0", " ")
    assert "mas (undetermined), position angle" in words
    assert "° (undetermined)" in words
    assert not {"1913", "85346"} & set(words.split())
    facts = {fact.name: fact.value for fact in search_page(open_place).facts}
    assert facts["Separation"].endswith(" mas (undetermined)")


def test_the_place_of_a_companion_that_moves_has_a_date(content) -> None:
    moving = copy.deepcopy(content)
    moving["fit"]["reference_mjd"] = 60000.25
    still, dated = (statement_of(one).headline.replace("\u00a0", " ") for one in (content, moving))
    assert dated == still.replace("the star", "the star (at MJD 60000.25)", 1)


def test_a_posterior_without_a_detection_is_no_measurement(content) -> None:
    none = copy.deepcopy(content)
    none["significance"]["detected"] = False
    none["modes"] = [none["modes"][0]] * 12
    none["posterior"]["position_angle_deg"] |= {
        "median": 350.0, "lower": 283.0, "upper": 417.0, "lower_95": 187.0, "upper_95": 513.0,
    }  # fmt: skip
    said = Reader(page_html(search_page(none))).said
    assert "if there is one, and not a measurement" in said
    assert "283 to 57" in said
    assert "to 513" not in said
    assert "4 more in result.json" in said
    assert "not a measurement" not in Reader(page_html(search_page(content))).said


def test_nothing_is_claimed_without_null_draws_and_absent_stages_are_absent(content) -> None:
    bare = copy.deepcopy(content)
    bare["significance"] |= {
        "detected": None, "false_alarm_probability": None, "false_alarm_interval": None,
        "n_null_draws": 0,
    }  # fmt: skip
    bare |= {"posterior": None, "limits": None, "evidence": None, "calibration": None}
    bare["warnings"] = []
    bare["fit"]["errors"] = dict.fromkeys(bare["fit"]["errors"])
    for mode in bare["modes"]:
        mode.pop("probability", None)
    reader = Reader(page_html(search_page(bare)))
    assert "its chance is not known" in reader.said
    assert not {"posterior", "evidence", "detection-limits"} & set(reader.ids)
    assert not re.search(r"\b(nan|None|inf)\b", reader.said)
    bare["fit"] |= {"contrast": 0.0, "delta_mag": None}
    assert "improves the fit" in statement_of(bare).headline


def test_noise_and_outliers_are_told(content) -> None:
    noisy = copy.deepcopy(content)
    interval = {"median": 0.01, "lower": 0.005, "upper": 0.02, "lower_95": 0.0, "upper_95": 0.03}
    noisy["noise"] = {
        "extra_vis2": 0.012, "extra_closure_phase_deg": 0.0,
        "posterior": {"extra_vis2": interval | {"probability_errors_right": 0.02}},
    }  # fmt: skip
    outlier = {
        "kind": "closure_phase", "stations": ["A1", "B2", "C3"], "wavelength_m": 4.3e-6,
        "mjd": 60000.5, "source": "x/night.fits", "weight": 0.04, "residual": -7.25,
    }  # fmt: skip
    noisy["robust"] = {"degrees_of_freedom": 4.0, "outliers": [outlier] * 25}
    said = Reader(page_html(search_page(noisy))).said
    assert "noise of 0.012 in V² and 0° in closure phase was added" in said
    noisy["noise"]["files"] = [
        {"path": f"x/{name}.fits", "extra_vis2": v, "extra_closure_phase_deg": 0.0}
        for name, v in (("a", 0.02), ("b", 0.0))
    ]
    each = Reader(page_html(search_page(noisy))).said
    assert "noise of 0.02 in V² and 0° in closure phase to a.fits was added" in each
    assert "0.012 in V²" not in each
    assert "0.005 to 0.02" in said
    assert "25 data lost most of it" in said
    assert said.count("A1-B2-C3") == 20
    assert "5 more in result.json" in said
    assert "night.fits" in said
    assert "−7.2" in said
    quiet = copy.deepcopy(content) | {"robust": None}
    assert "no noise was added" in Reader(page_html(search_page(quiet))).said


def test_every_free_parameter_is_shown_by_a_name(content) -> None:
    """Disc and colour of a companion beside the fit, rates in the table of the posterior."""
    rich = copy.deepcopy(content)
    rich["fit"] |= {
        "companion_diameter_mas": 12.5, "contrast_slope": -2.5, "reference_wavelength_um": 4.5,
    }  # fmt: skip
    rich["fit"]["errors"] |= {"companion_diameter_mas": 1.5, "contrast_slope": 0.5}
    width = rich["posterior"]["east_mas"]
    rich["posterior"] |= {"contrast_slope": width, "east_rate_mas_yr": width}
    said = " ".join(Reader(page_html(search_page(rich))).said.split())
    assert "Diameter of the companion12.5 ± 1.5mas" in said
    assert "Slope of the contrast (exponent of the wavelength)−2.50 ± 0.50" in said
    assert "Contrast (flux ratio) at 4.500 µm" in said
    assert "East rate (mas/yr)" in said
    assert "contrast_slope" not in said
    assert "Slope of the contrast" not in Reader(page_html(search_page(content))).said


def test_any_command_can_make_a_page() -> None:
    table = Table("<i>t</i>", (Column("a", "text"), Column("b")), (("<u>x</u>", "1"),))
    page = Page("amibayes validate", "Validation", "", Statement("open", "l", "<b>h</b>"),
                sections=(Section("A & B", ("<script>",), tables=(table,)),))  # fmt: skip
    reader = Reader(page_html(page))
    assert not reader.tags & {"i", "u", "b"}
    runs_only_its_own_script(page_html(page))
    assert "a-b" in reader.ids
    assert "Warnings" not in reader.said
    with pytest.raises(ValueError, match="one text for each column"):
        Table("t", (Column("a"),), (("1", "2"),))


def test_pictures_that_are_none_are_refused(tmp_path: Path) -> None:
    (tmp_path / "map.png").write_text("no picture")
    with pytest.raises(DataError, match="is no PNG"):
        captioned(tmp_path, ["map.png", "maps.fits"])
    with pytest.raises(DataError, match="cannot be read"):
        captioned(tmp_path, ["gone.png"])


@pytest.mark.parametrize(("outer", "bar"), [(752.6, 200.0), (1.2, 0.5), (50.0, 20.0), (9.0, 2.0)])
def test_scale_bar_is_a_round_number(outer: float, bar: float) -> None:
    assert Sky(0.1, outer, (), "").bar_mas == pytest.approx(bar)


@pytest.mark.parametrize("size", [PHONE, DESKTOP])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_in_a_browser(browser: Any, folder: Path, size, scheme) -> None:
    looks_right(browser, folder / "report.html", size, scheme, len(list(folder.glob("*.png"))))


@pytest.mark.parametrize("size", [PHONE, pytest.param(DESKTOP, marks=pytest.mark.slow)])
def test_other_pages_in_a_browser(browser: Any, content, tmp_path: Path, size) -> None:
    """Nothing detected, two bands in motion, and a validation."""
    none, joint = copy.deepcopy(content), copy.deepcopy(content)
    none["significance"]["detected"] = False
    none["modes"] = [none["modes"][0]] * 12
    band = {key: joint["fit"][key] for key in ("contrast", "delta_mag", "errors")}
    bands = [band | {"band": f"NIRISS_{w}um", "wavelength_um": w} for w in (4.29, 4.82)]
    joint["fit"] |= {"contrast_kind": "per-filter", "contrasts": bands, "reference_mjd": 6e4,
                     "fastest_mas_yr": 9.0, "east_rate_mas_yr": 1.2,
                     "north_rate_mas_yr": -3.0}  # fmt: skip
    joint["residuals"] = [{"path": f"{k}/target_of_a_long_name_calints.oifits"}
                          | dict.fromkeys(RESIDUALS, 1.0) for k in range(3)]  # fmt: skip
    trials = tally(PLAN, 1, list(answers(PLAN)))
    figures = {}
    for name, drawing in validation_pictures(trials).items():
        save(drawing, tmp_path / f"{name}.png")
        figures[name] = read_figure(tmp_path / f"{name}.png", name, name)
    pages = [(search_page(none), 0), (search_page(joint), 0)]
    pages += [(validation_page(trials, figures, "out"), len(figures))]
    for page, n_pictures in pages:
        (tmp_path / "page.html").write_text(page_html(page), encoding="utf-8")
        looks_right(browser, tmp_path / "page.html", size, "light", n_pictures)


def looks_right(browser: Any, path: Path, size, scheme: str, n_pictures: int) -> None:
    """Nothing wider than the screen, every picture there, every link leads somewhere, no errors."""
    shown(browser, path, size, scheme)
    wide = browser.execute_script(
        "return [document.scrollingElement.scrollWidth, window.innerWidth]"
    )
    assert wide[0] <= wide[1] == size[0]
    images = loaded(browser)
    assert len(images) == n_pictures
    captions = "return [...document.querySelectorAll('caption')].map(c => c.clientWidth)"
    assert max(browser.execute_script(captions)) <= size[0]
    assert all(natural > 300 and seen > 200 for _, natural, seen in images)
    loose = browser.execute_script(
        "return [...document.querySelectorAll('a')].map(a => a.hash)"
        ".filter(h => !document.getElementById(decodeURIComponent(h.slice(1))))"
    )
    assert loose == []
    assert browser.get_log("browser") == []


def loaded(browser: Any) -> list[list[Any]]:
    """Every picture's completeness, width and width on the screen, when all have arrived.

    In dark mode the page exchanges its pictures, and one that is being exchanged has no width.
    """
    from selenium.webdriver.support.ui import WebDriverWait

    sizes = "return [...document.images].map(i => [i.complete, i.naturalWidth, i.clientWidth])"
    images: list[list[Any]] = []

    def arrived(driver: Any) -> bool:
        images[:] = driver.execute_script(sizes)
        return all(done for done, _, _ in images)

    WebDriverWait(browser, 30).until(arrived)
    return images


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_stands_out_from_its_ground(browser: Any, folder: Path, scheme) -> None:
    """WCAG AA: a contrast of 4.5 for text of every colour the page uses."""
    shown(browser, folder / "report.html", DESKTOP, scheme)
    names = ("paper", "card", "ink", "soft", "accent", "found", "open")
    colours = browser.execute_script(
        "const s = getComputedStyle(document.documentElement);"
        "return arguments[0].map(n => s.getPropertyValue('--' + n).trim())",
        list(names),
    )
    light = {n: luminance(c) for n, c in zip(names, colours, strict=True)}
    for ground in ("paper", "card"):
        for text in names[2:]:
            high, low = sorted((light[ground], light[text]), reverse=True)
            assert (high + 0.05) / (low + 0.05) >= 4.5, (scheme, ground, text)


def luminance(colour: str) -> float:
    """Relative luminance of #rrggbb (WCAG 2)."""
    channels = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    linear = np.where(channels <= 0.04045, channels / 12.92, ((channels + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def test_a_link_leads_to_its_section(browser: Any, folder: Path) -> None:
    shown(browser, folder / "report.html", PHONE)
    browser.find_element("link text", "Significance").click()
    top = "return document.getElementById('significance').getBoundingClientRect().top"
    assert 0 <= browser.execute_script(top) < 60


def test_it_prints(browser: Any, folder: Path) -> None:
    shown(browser, folder / "report.html", DESKTOP)
    pdf = base64.b64decode(browser.execute_cdp_cmd("Page.printToPDF", {})["data"])
    assert pdf.startswith(b"%PDF")
    assert 3 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 20
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    hidden = "return getComputedStyle(document.querySelector('nav')).display"
    assert browser.execute_script(hidden) == "none"
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})


def test_the_command_line_keeps_what_decides_the_numbers() -> None:
    words = ["search", "a b.oifits", "--out", "x", "--seed", "3", "--workers=4", "--cal", "c", "d",
             "--json", "--no-limits", "--resume"]  # fmt: skip
    arguments = argparse.Namespace(words=words, seed=3)
    kept = "amibayes search 'a b.oifits' --seed 3 --cal c d --no-limits"
    assert common.command_line(arguments) == kept
    assert common.without(words, {"--cal": 99}) == [
        w for w in words if w not in ("--cal", "c", "d")
    ]
    plain = argparse.Namespace(words=["search", "t"], seed=1)
    assert common.command_line(plain) == "amibayes search t --seed 1"


def test_a_gain_that_is_no_difference_of_two_chi2_says_why(rng) -> None:
    """With 40 integrations χ² fell by 180 000 and "delta chi2" was 657, without a word."""
    truth = [150.0, -80.0, 0.02]
    sheet = niriss()
    known = search(Likelihood(simulated(sheet, truth, rng)), (50.0, 400.0))
    assert "2 ln L" not in _detection(known)
    few = replace(sheet, freedom=Freedom(40.0, 39.0), covariance_kind="estimated")
    found = search(Likelihood(simulated(few, truth, rng)), (50.0, 400.0))
    assert found.delta_chi2 < 0.99 * (found.chi2_single - found.chi2_binary)
    line = _detection(found)
    assert f"delta chi2 {found.delta_chi2:.1f} (2 ln L, as errors are estimated" in line
