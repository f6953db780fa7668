"""The files of a report, of invented results: they parse, need nothing from elsewhere, and hide no failure."""

import json
import re
import sys
import xml.etree.ElementTree as ElementTree
from html.parser import HTMLParser
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from invented_case import CASE, SINGLE, results, second_order

from mpmcli.validation.case import Measure, Setting
from mpmcli.validation.figures import STYLES, draw_case, number_text, style_of
from mpmcli.validation.report import CaseReport, Report
from mpmcli.validation.report_page import write_report
from mpmcli.validation.runs import KNOBS, Run, runs_of, variants
from mpmcli.validation.study import describe_environment

LOST = [Run("invented", n, Setting(transfer="pic")) for n in (8, 16, 32)] + [Run("invented", 16, Setting(safety=0.95))]
SVG = "{http://www.w3.org/2000/svg}"
# Attributes that make a browser fetch something.
LOADING = {"src", "srcset", "data", "poster", "background", "action"}
VOID = {"meta", "img", "br", "hr"}


def law(run: Run) -> float | None:
    """The law of the case, but for a transfer and a Courant fraction that fail."""
    return None if run in LOST else second_order(run)


@pytest.fixture(scope="module")
def report() -> Report:
    return Report("default", describe_environment(2), (CASE,), results(law))


@pytest.fixture(scope="module")
def written(report: Report, tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("report")
    write_report(report, directory)
    return directory


class Page(HTMLParser):
    """Collects what a page holds, and checks that its tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict]] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


def test_the_page_is_whole_and_loads_nothing(written: Path) -> None:
    page = Page()
    page.feed((written / "report.html").read_text(encoding="utf-8"))
    page.close()
    assert page.open == []
    loaded = [(tag, value) for tag, attrs in page.tags for name, value in attrs.items() if name in LOADING]
    assert len(loaded) == 2 and all(value.startswith("data:image/svg+xml;base64,") for _, value in loaded)
    assert not {"script", "link", "iframe", "object", "embed"} & {tag for tag, _ in page.tags}
    targets = {attrs["href"] for tag, attrs in page.tags if tag == "a" and "href" in attrs}
    assert targets == {"#invented"} and "invented" in {attrs.get("id") for _, attrs in page.tags}
    # Text of cases and errors is text, whatever stands in it.
    assert "An invented <problem> & its answer" in page.text and "It was <lost>." in page.text


def test_the_markdown_links_figures_that_are_there(written: Path) -> None:
    text = (written / "report.md").read_text(encoding="utf-8")
    figures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert figures == ["figures/settings.svg", "figures/invented.svg"]
    assert all((written / figure).exists() for figure in figures)
    tables = [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)]
    assert len(tables) == 4
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table}) == 1
    assert "Source: nobody | nowhere." in text and "A note." in text


def test_the_report_on_top_and_in_json_says_the_same(written: Path, report: Report) -> None:
    """error = 0.5 (8/n)^2 reaches 1 % at n = 8 sqrt(50) = 56.6: not up to 32, so nothing does."""
    facts = json.loads((written / "report.json").read_text(encoding="utf-8"))
    (case,) = facts["cases"]
    assert (case["verdict"], case["finest_n"], case["error"]) == ("pass", 32, 0.5 / 16)
    assert case["order"] == pytest.approx(2.0) and case["expected_order"] == 2.0
    assert case["cheapest_to_1_percent"] is None
    assert len(case["runs"]) == len(runs_of(CASE, "default"))
    first = case["runs"][0]
    assert (first["setting"], first["n"], first["verdict"], first["order"]) == ("default", 8, "pass", None)
    assert first["particle_steps"] == 64 * 9 and first["particle_steps_per_s"] == pytest.approx(1e6)
    assert {(run["setting"], run["n"]) for run in case["runs"] if run["status"] == "unstable"} == {
        *(("PIC", n) for n in (8, 16, 32)),
        ("Courant fraction 0.95", 16),
    }
    row = next(line for line in report.table().splitlines() if line.startswith("invented"))
    assert row.split() == ["invented", "pass", "3.12e-02", "32", "2.00", "(2)", "none"]
    assert "1 of 1 cases pass" in report.table()


def test_every_failure_is_a_cross_in_every_panel() -> None:
    """Two panels of cost with all four, one over n with three, one over the Courant fraction with one; and a legend."""

    def crosses(report: CaseReport) -> int:
        root = ElementTree.fromstring(draw_case(report))
        groups = {
            path.get("id"): path.get("d").split() for path in root.iter(f"{SVG}path") if path.get("id", "").strip()
        }
        diagonal = {name for name, words in groups.items() if words[0::3] == list("MLML")}
        used = [use.get("{http://www.w3.org/1999/xlink}href")[1:] for use in root.iter(f"{SVG}use")]
        return sum(name in diagonal for name in used)

    assert crosses(CaseReport(CASE, results(law))) == 2 * 4 + 3 + 1 + 1
    assert crosses(CaseReport(CASE, results())) == 0


@pytest.mark.parametrize("level", ["coarse", "default"])
def test_a_figure_is_always_the_same_and_small(level: str) -> None:
    report = CaseReport(CASE, results(law, level))
    figure = draw_case(report)
    assert figure == draw_case(report) and len(figure) < 80_000
    text = figure.decode()
    ElementTree.fromstring(text)
    assert not re.search(r"20\d\d-\d\d-\d\d", text)
    for word in ("default", "f32", "Error against seconds of stepping", "n, cells", "slope of order 2"):
        assert f">{word}<" in text
    assert ("Error against Courant fraction" in text) == (level == "default")


@pytest.mark.parametrize("error", [0.0, 1e-300, 1e30], ids=str)
def test_odd_errors_are_drawn_too(error: float) -> None:
    ElementTree.fromstring(draw_case(CaseReport(CASE, results(lambda run: error))))
    ElementTree.fromstring(draw_case(CaseReport(CASE, results(lambda run: None))))


def test_one_resolution_makes_a_report(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(type(CASE), "levels", {"coarse": (8,)})
    monkeypatch.setattr(type(CASE), "measures", (Measure("error (m): A length."), CASE.measures[1]))
    report = Report("coarse", describe_environment(1), (CASE,), results(level="coarse"))
    write_report(report, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figures", "report.html", "report.json", "report.md"]
    # A length has no 1 %, and one resolution no order.
    row = next(line for line in report.table().splitlines() if line.startswith("invented"))
    assert row.split() == ["invented", "pass", "5.00e-01", "m", "8"]
    assert "What each setting does" not in (tmp_path / "report.md").read_text(encoding="utf-8")


def test_a_failed_case_says_why_on_top(tmp_path: Path) -> None:
    report = Report("coarse", describe_environment(1), (CASE,), results(lambda run: 1.0, "coarse"))
    assert not report.passed and "0 of 1 cases pass" in report.table()
    write_report(report, tmp_path)
    text = (tmp_path / "report.md").read_text(encoding="utf-8")
    top = text[: text.index("## How to read")]
    assert "**fail**" in top and "At n = 8 the error is 1, beyond its bound of 0.6." in top


def test_settings_are_told_apart_by_colour_and_by_marker() -> None:
    """Everything that a figure shows side by side; the Courant fractions are one line."""
    shown = [Setting(), *(variant for knob in KNOBS for variant in variants(knob))]
    styles = {style_of(setting) for setting in shown}
    assert len(styles) == len(shown) - 3
    assert len({style.color for style in styles}) == len({style.marker for style in styles}) == len(styles)
    assert {(knob, value) for knob in KNOBS if knob != "safety" for value in KNOBS[knob]} == {
        *STYLES,
        ("precision", "f64"),
    }
    assert not style_of(SINGLE).filled


@given(digit=st.sampled_from([1, 2, 5]), power=st.integers(-17, 12))
def test_ticks_are_written_as_numbers(digit: int, power: int) -> None:
    """Read as people read it, the text is the number again."""
    text = number_text(digit * 10.0**power)
    plain = text.translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789"))
    if text == plain:
        value = float(text)
    else:
        factor, exponent = re.fullmatch(r"(?:(\d)·)?10(-?\d+)", plain).groups()
        value = float(factor or 1) * 10.0 ** int(exponent)
    assert value == pytest.approx(digit * 10.0**power)


def test_the_copy_in_the_documents_says_the_same_in_less(written: Path, tmp_path: Path, report: Report) -> None:
    """Every run is a line of its JSON, and docs/validation.md gets the table on top, with links into the copy."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "scripts")
        patch.setattr(sys, "dont_write_bytecode", True)
        loader = SourceFileLoader("validation_report", str(ROOT / "scripts" / "validation_report"))
        script = module_from_spec(spec_from_loader("validation_report", loader))
        loader.exec_module(script)
    script.copy_report(written, tmp_path)
    short = json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))
    full = json.loads((written / "report.json").read_text(encoding="utf-8"))
    assert short == script.shortened(full)
    lines = (tmp_path / "report.json").read_text(encoding="utf-8").splitlines()
    assert sum('"knobs"' in line for line in lines) == len(report.results)
    page = (tmp_path / "report.md").read_text(encoding="utf-8")
    assert "[docs/hard-cases.md](../hard-cases.md)" in page
    assert sorted(path.name for path in (tmp_path / "figures").iterdir()) == ["invented.svg", "settings.svg"]
    told = script.headline(page).split("\n\n")
    assert [block.split()[0] for block in told] == ["mpmcli", "**1", "|"]
    assert "[invented](validation/report.md#invented)" in told[2]
