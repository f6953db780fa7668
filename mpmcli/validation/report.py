"""The report of a validation: cases, verdicts and costs, as JSON, as a table, and as a page with figures."""

import io
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpmcli.output.durable import sealed, write_text, writing
from mpmcli.plain_text import counted, markdown_table, text_table
from mpmcli.plot.style import LIGHT_SERIES, empty_figure
from mpmcli.validation.case import KNOBS, Case, Level, Setting
from mpmcli.validation.runs import FIGURES, PAGE, Results, variants
from mpmcli.validation.verdict import ROUND_OFF, Verdict, judge, order_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TEMPLATE = Path(__file__).parent / "page" / "report.md"
# Columns of the tables of cases and of settings, and of the table of runs before and after the measures.
CASES = ("case", "problem", "verdict", "error", "at n", "order (expected)", "seconds")
SETTINGS = ("setting", "error", "seconds", "runs that failed")
RUN, COSTS = ("setting", "n"), ("particles", "steps", "seconds", "M particle-steps/s", "compile s", "outcome")
# Size of the figures, inches, and their style.
SIZE = (10.0, 4.8)
STYLE = Path(__file__).parent / "page" / "figures.mplstyle"
# Ordinate of a zero error.
LOWEST = 1e-17
COURANT = "Courant fraction"
GREY = {"color": "#777777", "linewidth": 1.0, "linestyle": ":"}
VARIANTS = [variant.label for knob in KNOBS if knob != "safety" for variant in variants(knob)]
# Styles of the lines of settings, the same in every figure; single precision usually coincides with double.
LOOKS: dict[str, dict[str, Any]] = {Setting().label: {"color": "black", "marker": "o", "linewidth": 2.0, "zorder": 3}}
LOOKS |= {
    label: {"color": color, "marker": marker, "linewidth": 1.2}
    for label, color, marker in zip(VARIANTS, LIGHT_SERIES, "s^vDph<", strict=False)
}
LOOKS["f32"] |= {"markersize": 9, "markerfacecolor": "none", "linestyle": "--"}
LOOKS[COURANT] = {**GREY, "marker": "d"}


@dataclass(frozen=True)
class CaseReport:
    """One case in the report: its runs and verdict."""

    case: Case
    results: Results

    @cached_property
    def verdict(self) -> Verdict:
        """The checks of the case."""
        return judge(self.case, self.results)

    def summary(self) -> tuple[str, ...]:
        """Return the row of the case in the table of cases, for its finest finished run with the default setting."""
        measure = self.case.measures[0]
        observed = order_of(measure, self.results)
        order = "" if observed is None else f"{observed:.2f}"
        if measure.expected is not None:
            order = f"{order or '-'} ({measure.expected:g})"
        error = n = seconds = ""
        for run, result in self.results.items():
            if run.setting == Setting() and result.finished:
                error, n = f"{result.error(measure.name):.2e}{measure.unit_suffix}", str(run.n)
                seconds = f"{result.seconds:.3g}"
        return self.case.name, self.case.title, self.verdict.word, error, n, order, seconds

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON."""
        case = self.case
        return {
            "case": case.name,
            **{name: getattr(case, name) for name in ("title", "group", "source", "note", "resolution")},
            "measures": [{name: getattr(m, name) for name in ("name", "unit", "text")} for m in case.measures],
            "verdict": self.verdict.word,
            "reasons": self.verdict.reasons,
            "order": order_of(case.measures[0], self.results),
            "expected_order": case.measures[0].expected,
            "checks": [{**asdict(check), "setting": check.setting.label} for check in self.verdict.checks],
            "runs": [
                {
                    "n": run.n,
                    "setting": run.setting.label,
                    "error": result.error(case.measures[0].name),
                    "particle_steps_per_s": result.rate,
                    "verdict": self.verdict.of_run(run),
                    **asdict(result),
                }
                for run, result in self.results.items()
            ],
        }

    def page(self) -> str:
        """Return the section of the case as Markdown."""
        case = self.case
        rows = []
        for run, result in self.results.items():
            values = [f"{result.values[m.name]:.3e}{m.unit_suffix}" if result.finished else "" for m in case.measures]
            costs = f"{result.particles:,}", f"{result.steps:,}", f"{result.seconds:.3g}"
            speed = f"{result.rate / 1e6:.1f}", f"{result.compile_seconds:.1f}"
            outcome = self.verdict.of_run(run) if result.finished else f"{result.status}: {result.message}"
            rows.append((run.setting.label, str(run.n), *values, *costs, *speed, outcome))
        head = (*RUN, *(measure.name for measure in case.measures), *COSTS)
        blocks = [
            f"## {case.title}",
            f"`mpmcli validate {case.name}`; {self.verdict.word}. Source: {case.source}. n counts {case.resolution}.",
            bullets(f"**{m.name}**{f' ({m.unit})' if m.unit else ''}: {m.text}" for m in case.measures),
            case.note,
            *self.verdict.reasons,
            f"![{case.title}: error against resolution and time]({FIGURES}/{case.name}.svg)",
            markdown_table(head, rows, left={0, len(head) - 1}),
        ]
        return "\n\n".join(filter(None, blocks))


@dataclass(frozen=True)
class Report:
    """A report on cases. `environment` has the machine, the versions, the number of workers and the date."""

    level: Level
    environment: dict[str, Any]
    cases: Sequence[Case]
    results: Results

    @cached_property
    def case_reports(self) -> list[CaseReport]:
        """One per case."""
        return [
            CaseReport(case, {run: result for run, result in self.results.items() if run.case == case.name})
            for case in self.cases
        ]

    @property
    def passed(self) -> bool:
        """Whether every case passes."""
        return not self.reasons()

    def reasons(self) -> list[str]:
        """Return the sentences of the failed checks, each preceded by the name of its case."""
        return [f"{entry.case.name}: {reason}" for entry in self.case_reports for reason in entry.verdict.reasons]

    def as_dict(self) -> dict[str, Any]:
        """Return a dictionary for JSON."""
        cases = [entry.as_dict() for entry in self.case_reports]
        return {"level": self.level, "environment": self.environment, "passed": self.passed, "cases": cases}

    def outcome(self) -> str:
        """Return a sentence with the numbers of cases that pass and of runs that did not finish."""
        passed = sum(not entry.verdict.reasons for entry in self.case_reports)
        unfinished = sum(not result.finished for result in self.results.values())
        failed = f", of which {unfinished} did not finish" if unfinished else ""
        return f"{passed} of {len(self.cases)} cases pass. {counted(len(self.results), 'run')}{failed}."

    def text(self) -> str:
        """Return a text table with a line per case, followed by the failed checks."""
        table = text_table(CASES, [entry.summary() for entry in self.case_reports], left={0, 1, 2})
        failed = "\n".join(self.reasons())
        closing = f"{self.outcome()} Errors, orders and seconds are those of the default setting."
        return "\n\n".join(filter(None, [table, failed, closing]))

    def settings(self) -> str:
        """Return a Markdown table of the ratios of error and time of each setting to the default one at equal n."""
        rows = []
        measure = {case.name: case.measures[0].name for case in self.cases}
        for setting in dict.fromkeys(run.setting for run in self.results if run.setting != Setting()):
            mine = {run: result for run, result in self.results.items() if run.setting == setting}
            pairs = [(run, result, self.results[replace(run, setting=Setting())]) for run, result in mine.items()]
            both = [(measure[run.case], a, b) for run, a, b in pairs if a.finished and b.finished]
            # Ratios of round-off errors are meaningless.
            errors = _ratios([(a.error(name), b.error(name)) for name, a, b in both], ROUND_OFF)
            seconds = _ratios([(a.seconds, b.seconds) for _, a, b in both], 0.0)
            rows.append((setting.label, errors, seconds, str(sum(not result.finished for result in mine.values()))))
        return markdown_table(SETTINGS, rows, left={0})

    def page(self) -> str:
        """Return the page as Markdown, with links to figures in the directory FIGURES."""
        facts = self.environment
        machine = (
            f"mpmcli {facts['mpmcli']}, level {self.level}, {facts['date']}. {facts['processor']}, 1 thread per run, "
            f"{counted(facts['workers'], 'run')} at a time; Python {facts['python']}, Taichi {facts['taichi']}, "
            f"{facts['system']}."
        )
        failed = f"## Failed checks\n\n{bullets(self.reasons())}\n\n" if self.reasons() else ""
        return TEMPLATE.read_text(encoding="utf-8").format(
            machine=machine,
            outcome=self.outcome(),
            summary=markdown_table(CASES, [entry.summary() for entry in self.case_reports], left={0, 1, 2}),
            failed=failed,
            settings=self.settings(),
            cases="\n\n".join(entry.page() for entry in self.case_reports),
        )


def write_report(report: Report, directory: Path) -> None:
    """Write the page and its figures into an existing directory, each file atomically. Raises RunError on failure."""
    with writing("The report", to=directory):
        (directory / FIGURES).mkdir(exist_ok=True)
        for entry in report.case_reports:
            with sealed(directory / FIGURES / f"{entry.case.name}.svg", unique=True) as temporary:
                temporary.write_bytes(draw_case(entry.case, entry.results))
        write_text(directory / PAGE, report.page())


def _ratios(pairs: Iterable[tuple[float, float]], least: float) -> str:
    """Return the geometric mean, minimum and maximum of the ratios of pairs with both values above `least`."""
    ratios = [a / b for a, b in pairs if min(a, b) > least]
    if not ratios:
        return ""
    mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
    return f"{mean:.2g} ({min(ratios):.2g} to {max(ratios):.2g})"


def bullets(lines: Iterable[str]) -> str:
    """Return a list in Markdown."""
    return "\n".join(f"* {line}" for line in lines)


def draw_case(case: Case, results: Results) -> bytes:
    """Return the figure of a case as SVG: error against resolution and processor time. The bytes are reproducible."""
    measure = case.measures[0]
    with empty_figure(SIZE, STYLE, {}, (0.1, 0.1)) as figure:
        order, cost = figure.subplots(1, 2, sharey=True, subplot_kw={"xscale": "log", "yscale": "log"})
        for label, runs in _lines(results).items():
            finished = {run: result for run, result in runs.items() if result.finished}
            errors = [max(result.error(measure.name), LOWEST) for result in finished.values()]
            failed = len(runs) - len(finished)
            named = f"{label} ({failed} failed)" if failed else label
            cost.plot([result.seconds for result in finished.values()], errors, label=named, **LOOKS[label])
            if label != COURANT:
                order.plot([run.n for run in finished], errors, **LOOKS[label])
        _draw_bounds(order, case, results)
        named = f"{measure.name} ({measure.unit})" if measure.unit else measure.name
        order.set(title="Error against resolution", xlabel=f"n, {case.resolution}", ylabel=named)
        resolutions = sorted({run.n for run in results})
        order.set_xticks(resolutions, [str(n) for n in resolutions])
        order.xaxis.minorticks_off()
        cost.set(title="Error against processor time", xlabel="seconds of stepping, one thread")
        figure.legend(loc="outside lower center", ncols=4)
        content = io.BytesIO()
        figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    return content.getvalue()


def _lines(results: Results) -> dict[str, Results]:
    """Return the results of each line of the figure by label; all Courant fractions share a line."""
    lines: dict[str, Results] = {}
    for run, result in results.items():
        label = COURANT if run.setting.label.startswith(COURANT) else run.setting.label
        lines.setdefault(label, {})[run] = result
    return lines


def _draw_bounds(axes: "Axes", case: Case, results: Results) -> None:
    """Draw the bounds of the default setting, and the slope of the expected order below its finest error."""
    measure, observed = case.measures[0], order_of(case.measures[0], results)
    usual = {run.n: result for run, result in results.items() if run.setting == Setting()}
    bounds = [(n, measure.bound(n)) for n in usual if 0 < measure.bound(n) < float("inf")]
    if bounds:
        axes.plot(*zip(*bounds, strict=True), "_", color="#444444", markersize=16, label="bound of the default setting")
    finished = [(n, max(result.error(measure.name), LOWEST)) for n, result in usual.items() if result.finished]
    if measure.expected is not None and len(finished) > 1:
        finest, error = finished[-1]
        slope = [error * (finest / n) ** measure.expected / 2 for n in usual]
        label = f"slope of order {measure.expected:g}" + ("" if observed is None else f", observed {observed:.2f}")
        axes.plot([*usual], slope, label=label, **GREY)
