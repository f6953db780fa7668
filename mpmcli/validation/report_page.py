"""The page of a report, a summary and then every case: report.json, report.md with its figures, and report.html.

page/ has the texts that are the same in every report, and the style.
"""

import base64
import html
import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path

from markdown_it import MarkdownIt

from mpmcli.errors import RunError
from mpmcli.output.durable import sealed, write_text
from mpmcli.plain_json import finite_json
from mpmcli.plain_text import counted
from mpmcli.validation.case import Setting
from mpmcli.validation.comparison import Ratios, outcome, reason
from mpmcli.validation.figures import draw_case, draw_settings
from mpmcli.validation.journal import FIGURES
from mpmcli.validation.report import SUMMARY, CaseReport, Report, RunRow, seconds_text, summary_row

PAGE = Path(__file__).parent / "page"
TITLE = "Speed against error"
GROUPS = {"solids": "Solids", "fluids": "Fluids", "plastic": "Plastic flow", "invariants": "Invariants"}
SETTINGS_FIGURE = "settings.svg"
# Escaped tags of headings and tables in `report_page`, and their HTML.
TAGS = {
    r"<p>&lt;a id=&quot;(\w+)&quot;&gt;&lt;/a&gt;</p>": r'<a id="\1"></a>',
    r"<p>&lt;details&gt;\n&lt;summary&gt;(.*)&lt;/summary&gt;</p>": r"<details>\n<summary>\1</summary>",
    r"<p>&lt;/details&gt;</p>": "</details>",
}


def write_report(report: Report, directory: Path) -> None:
    """Write the report into an existing directory, each file atomically; RunError where that fails."""
    pictures = {figure_name(entry): draw_case(entry) for entry in report.case_reports}
    if len(report.compared) > 1:
        pictures[SETTINGS_FIGURE] = draw_settings(report.compared)
    page = report_page(report)
    texts = {
        "report.json": json.dumps(finite_json(report.as_dict()), indent=1, ensure_ascii=False, allow_nan=False) + "\n",
        "report.md": page,
        "report.html": to_html(TITLE, page, {f"{FIGURES}/{name}": picture for name, picture in pictures.items()}),
    }
    try:
        (directory / FIGURES).mkdir(exist_ok=True)
        for name, content in pictures.items():
            with sealed(directory / FIGURES / name) as temporary:
                temporary.write_bytes(content)
        for name, text in texts.items():
            write_text(directory / name, text)
    except OSError as error:
        raise RunError(f"The report could not be written to {directory} ({error.strerror or error}).") from error


def report_page(report: Report) -> str:
    """Return the page as Markdown, with links to figures in the directory FIGURES."""
    lines = [f"**{e.case.name}** {text}" for e in report.case_reports for text in e.verdict.reasons]
    cases: list[str] = []
    group = None
    for entry in report.case_reports:
        if entry.case.group != group:
            group = entry.case.group
            cases.append(f"## {GROUPS[group]}")
        cases += _case(entry)
    setting = Setting()
    template = (PAGE / "report.md").read_text(encoding="utf-8")
    return template.format(
        environment=_environment(report),
        outcome=_outcome(report),
        summary=_summary(report),
        default=f"{setting.precision}, {setting.kernel} kernel, {setting.transfer.upper()}, {setting.walls} walls, "
        f"{setting.per_axis} particles per cell and axis, Courant fraction {setting.safety:g}",
        failures=f"## What failed\n\n{_bullets(lines)}\n\n" if lines else "",
        settings=_settings(report) if len(report.compared) > 1 else "",
        cases="\n\n".join(cases),
    )


def _picture(name: str, text: str) -> str:
    return f"![{text}]({FIGURES}/{name})"


def figure_name(entry: CaseReport) -> str:
    """Return the file name of the figure of a case."""
    return f"{entry.case.name}.svg"


def _environment(report: Report) -> str:
    facts = report.environment
    commit = f", commit {facts['commit']}" if facts["commit"] else ""
    workers = f"{counted(facts['workers'], 'run')} at a time"
    return (
        f"mpmcli {facts['mpmcli']}{commit}, level {report.level}, {facts['date']}. {facts['processor']}, "
        f"{facts['arch']}, {facts['threads']} thread per run, {workers}; Python {facts['python']}, Taichi "
        f"{facts['taichi']}, {facts['system']}."
    )


def _outcome(report: Report) -> str:
    entries = report.case_reports
    passed = sum(entry.verdict.passed for entry in entries)
    runs = list(report.results.values())
    ended = sum(not result.finished for result in runs)
    failed = f"; {ended} did not finish: {'a cross' if ended == 1 else 'crosses'} in the figures" if ended else ""
    return f"**{passed} of {len(entries)} cases pass.** {len(runs)} runs{failed}."


def _summary(report: Report) -> str:
    rows = []
    for entry in report.case_reports:
        name, verdict, *rest = summary_row(entry)
        rows.append((f"[{name}](#{name})", entry.case.title, verdict if verdict == "pass" else f"**{verdict}**", *rest))
    return _table((SUMMARY[0], "problem", *SUMMARY[1:]), rows, {3, 4, 5, 7, 8})


def _settings(report: Report) -> str:
    rows = []
    for entry in report.compared:
        failed = f"{entry.failed} of {entry.runs}" if entry.failed else "0"
        rows.append((entry.setting.label, *map(_ratio, (entry.error, entry.seconds, entry.to_equal)), failed))
    head = ("setting", "error at equal n", "seconds at equal n", "seconds to an equal error", "runs that failed")
    template = (PAGE / "settings.md").read_text(encoding="utf-8")
    return template.format(
        ratios=_table(head, rows, {1, 2, 3, 4}),
        picture=_picture(SETTINGS_FIGURE, "Ratios of error and time of every setting to those of the default one"),
        rule=outcome(report.compared),
        reasons=_bullets(reason(entry) for entry in report.compared),
    )


def _ratio(ratios: Ratios | None) -> str:
    if ratios is None:
        return ""
    return f"**{ratios.mean:.2g}** ({ratios.low:.2g} to {ratios.high:.2g})"


def _case(entry: CaseReport) -> list[str]:
    case = entry.case
    measures = [f"**{m.name}**{f' ({m.unit})' if m.unit else ''}: {m.text}" for m in case.measures]
    named = [f"{m.name}{f', {m.unit}' if m.unit else ''}" for m in case.measures]
    costs = ("order", "particles", "steps", "seconds", "M particle-steps/s", "compile s")
    rows = tuple(_run(row, [m.name for m in case.measures]) for row in entry.rows)
    right = range(1, 2 + len(named) + len(costs))
    head = ("setting", "n", *named, *costs, "outcome")
    return [
        f'<a id="{case.name}"></a>',
        f"### {case.title}",
        f"`mpmcli validate {case.name}`; {entry.verdict.word}. Source: {case.source}. n counts {case.resolution}.",
        _bullets(measures),
        *([case.note] if case.note else []),
        *entry.verdict.reasons,
        _picture(figure_name(entry), f"{case.title}: error against cost, resolution and Courant fraction"),
        _checks(entry),
        _table(head, rows, right, folded=f"All {len(rows)} runs of {case.name}"),
    ]


def _checks(entry: CaseReport) -> str:
    rows = [
        (
            check.subject,
            check.setting.label,
            "" if check.n is None else str(check.n),
            "none" if check.figure is None else f"{check.figure:.3g}",
            "none" if check.bound == "inf" else check.bound,
            "pass" if check.passed else "**fail**",
        )
        for check in entry.verdict.checks
    ]
    head = ("measure", "setting", "n", "value", "bound", "verdict")
    return _table(head, rows, {2, 3, 4})


def _run(row: RunRow, measures: Sequence[str]) -> tuple[str, ...]:
    result = row.result
    outcome = result.status if result.finished else f"{result.status}: {result.message}"
    return (
        row.run.setting.label,
        str(row.run.n),
        *(f"{result.values[name]:.3e}" if result.finished else "" for name in measures),
        "" if row.order is None else f"{row.order:.2f}",
        f"{result.particles:,}" if result.particles else "",
        f"{result.steps:,}" if result.steps else "",
        seconds_text(result.seconds) if result.seconds else "",
        f"{result.rate / 1e6:.1f}" if result.finished else "",
        f"{result.compile_seconds:.1f}" if result.compile_seconds else "",
        outcome if row.verdict is None or not result.finished else row.verdict,
    )


def _bullets(lines: Iterable[str]) -> str:
    """Return a bullet list."""
    return "\n".join(f"* {line}" for line in lines)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], right: Collection[int], folded: str = "") -> str:
    """Return a table, collapsed under the summary `folded`, if any; columns in `right` are aligned to the right."""
    rule = ["---:" if column in right else "---" for column in range(len(head))]
    lines = (" | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in (head, rule, *rows))
    text = "\n".join(f"| {line} |" for line in lines)
    return f"<details>\n<summary>{folded}</summary>\n\n{text}\n\n</details>" if folded else text


def to_html(title: str, markdown: str, pictures: Mapping[str, bytes]) -> str:
    """Return a Markdown page as self-contained HTML, with its pictures, SVG files by their links, embedded."""
    # All tags are escaped except for those of `report_page`.
    body = MarkdownIt("commonmark", {"html": False, "xhtmlOut": False}).enable("table").render(markdown)
    for escaped, tag in TAGS.items():
        body = re.sub(escaped, tag, body)
    for link, picture in pictures.items():
        body = body.replace(f'src="{link}"', f'src="data:image/svg+xml;base64,{base64.b64encode(picture).decode()}"')
    style = (PAGE / "style.css").read_text(encoding="utf-8")
    page = (PAGE / "report.html").read_text(encoding="utf-8")
    return page.format(title=html.escape(title), style=style, body=body)
