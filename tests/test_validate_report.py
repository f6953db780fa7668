"""The page of a report and its figures, of invented results: they parse, and hide no failure."""

import re
import sys
import xml.etree.ElementTree as ElementTree
from importlib.machinery import SourceFileLoader
from importlib.util import module_from_spec, spec_from_loader
from pathlib import Path

import pytest
from conftest import ROOT
from invented_case import CASE, SINGLE, results, second_order

from mpmcli.bench.report import describe_machine
from mpmcli.validation.case import KNOBS, Measure, Setting
from mpmcli.validation.report import COURANT, LOOKS, Report, draw_case, write_report
from mpmcli.validation.runs import CaseRun, RunResult, variants

LOST = [CaseRun("invented", n, Setting(transfer="aflip")) for n in (8, 16, 32)] + [
    CaseRun("invented", 16, Setting(safety=0.95))
]


def law(run: CaseRun) -> float | None:
    """The law of the case, but for a transfer and a Courant fraction that fail."""
    return None if run in LOST else second_order(run)


def report_of(level: str, found: dict[CaseRun, RunResult]) -> Report:
    environment = {**describe_machine(), "workers": 2, "date": "2026-11-25"}
    return Report(level, environment, [CASE], found)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("report")
    write_report(report_of("default", results(law)), directory)
    return directory


def test_the_page_links_figures_that_are_there_and_its_tables_are_whole(written: Path) -> None:
    text = (written / "report.md").read_text(encoding="utf-8")
    figures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text)
    assert figures == ["figures/invented.svg"] and (written / figures[0]).exists()
    tables = [block.splitlines() for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE)]
    assert len(tables) == 3
    for table in tables:
        assert len({len(re.findall(r"(?<!\\)\|", line)) for line in table}) == 1
    assert "Source: nobody | nowhere." in text and "A note." in text
    assert text.count("| unstable: It was <lost>. |") == len(LOST)
    assert "22 runs, of which 4 did not finish." in text


def test_the_page_the_table_and_the_json_say_the_same(written: Path) -> None:
    report = report_of("default", results(law))
    (case,) = report.as_dict()["cases"]
    assert (case["verdict"], case["order"], case["expected_order"]) == ("pass", pytest.approx(2.0), 2.0)
    assert len(case["runs"]) == len(report.results)
    run = next(run for run in case["runs"] if (run["n"], run["setting"]) == (32, "default"))
    assert (run["error"], run["verdict"]) == (0.5 / 16, "pass")
    assert run["particle_steps_per_s"] == pytest.approx(1e6)
    row = ["3.12e-02", "32", "2.00 (2)", "0.0328"]
    line = next(line for line in report.text().splitlines() if line.startswith("invented"))
    assert line.split()[-5:] == " ".join(row).split()
    assert f"| pass | {' | '.join(row)} |" in (written / "report.md").read_text(encoding="utf-8")


def test_settings_are_set_against_the_default_one() -> None:
    """A cubic kernel of a quarter of the error at twice the cost; runs that failed are counted."""
    found = results(law)
    for run, usual in list(found.items()):
        if run.setting == Setting(kernel="cubic"):
            values = {**usual.values, "error": usual.values["error"] / 4}
            found[run] = RunResult("finished", "", values, usual.particles, usual.steps, 2 * usual.seconds)
    rows = report_of("default", found).settings().splitlines()
    assert "| cubic kernel | 0.25 (0.25 to 0.25) | 2 (2 to 2) | 0 |" in rows
    assert "| AFLIP |  |  | 3 |" in rows and "| f32 | 1 (1 to 1) | 1 (1 to 1) | 0 |" in rows


@pytest.mark.parametrize("level", ["coarse", "default"])
def test_a_figure_is_always_the_same_and_tells_of_failures(level: str) -> None:
    found = results(law, level)
    figure = draw_case(CASE, found)
    assert figure == draw_case(CASE, found)
    text = figure.decode()
    ElementTree.fromstring(text)
    assert not re.search(r"20\d\d-\d\d-\d\d", text)
    for word in ("default", "f32", "Error against resolution", "n, cells", "slope of order 2, observed 2.00"):
        assert f">{word}<" in text
    for word in ("AFLIP (3 failed)", f"{COURANT} (1 failed)"):
        assert (f">{word}<" in text) == (level == "default")


@pytest.mark.parametrize("error", [0.0, 1e-300, 1e30, None], ids=str)
def test_odd_errors_are_drawn_too(error: float | None) -> None:
    ElementTree.fromstring(draw_case(CASE, results(lambda run: error)))


def test_one_resolution_makes_a_report(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(type(CASE), "levels", {"coarse": (8,)})
    monkeypatch.setattr(type(CASE), "measures", (Measure("error (m): A length."), CASE.measures[1]))
    report = report_of("coarse", results(level="coarse"))
    write_report(report, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figures", "report.md"]
    # One resolution has no order.
    row = next(line for line in report.text().splitlines() if line.startswith("invented"))
    assert row.split()[-4:] == ["5.00e-01", "m", "8", "0.000512"]


def test_a_failed_case_says_why_before_the_cases(tmp_path: Path) -> None:
    report = report_of("coarse", results(lambda run: 1.0, "coarse"))
    assert not report.passed and "0 of 1 cases pass" in report.text()
    top = report.page()[: report.page().index("## Settings")]
    assert "| fail |" in top and "* invented: At n = 8 the error is 1, beyond its bound of 0.6." in top


def test_settings_are_told_apart_by_colour_and_by_marker() -> None:
    """Everything that a figure shows side by side; the Courant fractions are one line."""
    shown = [Setting(), *(variant for knob in KNOBS if knob != "safety" for variant in variants(knob))]
    assert set(LOOKS) == {*(setting.label for setting in shown), COURANT}
    looks = [LOOKS[setting.label] for setting in shown]
    assert len({look["color"] for look in looks}) == len({look["marker"] for look in looks}) == len(shown)
    assert LOOKS[SINGLE.label]["markerfacecolor"] == "none"


def test_the_tables_and_figures_go_into_the_documents(
    written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / "scripts")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    loader = SourceFileLoader("validation_report", str(ROOT / "scripts" / "validation_report"))
    script = module_from_spec(spec_from_loader("validation_report", loader))
    loader.exec_module(script)
    sections = {}
    monkeypatch.setattr(script, "replace_section", sections.__setitem__)
    monkeypatch.setattr(script, "DOCS", tmp_path)
    monkeypatch.setattr(script, "FIGURES", ("invented",))
    (tmp_path / "validation").mkdir()
    script.write_page(written, "0123abcd")
    machine, passed, cases, settings = sections["validation"].split("\n\n")
    assert ", commit 0123abcd, level default, " in machine and passed.startswith("**1 of 1 cases pass. 22 runs")
    assert cases.splitlines()[-1].startswith("| invented |") and "| cubic kernel |" in settings
    assert (tmp_path / "validation" / "invented.svg").read_bytes() == (written / "figures/invented.svg").read_bytes()
