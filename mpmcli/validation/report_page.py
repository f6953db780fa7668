"""The Markdown page of a report: a summary, then every case."""

from collections.abc import Collection, Iterable, Sequence

from mpmcli.plain_text import counted
from mpmcli.validation.choice import outcome, reason
from mpmcli.validation.comparison import Compared, Ratios
from mpmcli.validation.journal import FIGURES
from mpmcli.validation.matrix import label_of
from mpmcli.validation.report import SUMMARY, CaseReport, Report, RunRow, seconds_text, summary_row
from mpmcli.validation.setting import Setting

TITLE = "Speed against error"
GROUPS = {"solids": "Solids", "fluids": "Fluids", "plastic": "Plastic flow", "invariants": "Invariants"}
SETTINGS_FIGURE = "settings.svg"
# Properties of the settings that the errors of the cases do not show.
BEYOND = (
    "What these errors do not show counts as well. From a Courant fraction of 0.9 on a lone droplet that bounces along "
    "a wall gains energy, at 0.8 none did. A body of one particle per cell and axis comes apart where it is stretched "
    "to twice its length. AFLIP loses far less energy in waves and splashes than APIC, but keeps angular momentum to "
    "first order in the step only, where APIC keeps it to round-off."
)
INTRODUCTION = (
    "Each case is a problem whose answer is known: from a formula, a conservation law or an experiment. It is computed "
    "at several resolutions n and with several settings, and its error is what is between the answer computed and the "
    "one known. Errors are fractions where no unit stands beside them: 0.01 is 1 %."
)
READING = (
    "**Error against seconds, error against particle-steps.** A line is a setting, its points are resolutions, coarse "
    "ones on the left. Lower left is better: a smaller error for less time. Where two lines cross, the one that is "
    "lower on the right is the better choice for small errors. Both scales are logarithmic. Particle-steps are "
    "particles times time steps: the same on every machine, but blind to what one of them costs with a setting. "
    "Seconds are the processor time of stepping, on one thread; compilation, start and output are not in them.",
    "**Error against resolution.** A line that falls with the slope of the grey one has the order that theory expects: "
    "at order 2, twice the resolution means a quarter of the error. The black bars are the bounds that the default "
    "setting must keep.",
    "**Error against Courant fraction.** The time step is this fraction of the largest stable one, all else stays. A "
    "smaller step costs more and is not always better: each step moves velocities to the grid and back, which damps.",
    "**Crosses** are runs that did not come to their end, or were of no use: at the right edge, with their n, since no "
    "time is enough for them, and at the top where n or the Courant fraction is the axis.",
)


def report_page(report: Report) -> str:
    """Return the page as Markdown, with links to figures in the directory FIGURES."""
    blocks: list[str] = [
        _heading(1, TITLE),
        INTRODUCTION,
        _environment(report),
        _outcome(report),
        _summary(report),
        (
            "Error, n and order are of the default setting, the order between its two finest resolutions (of those "
            "before a floor, where a case says that it has one). "
            "The cheapest setting is the one that reaches an error of 1 % in the least seconds, interpolated between "
            "resolutions; ≤ where the coarsest run reaches it already. The default one is named where no other saves a "
            "tenth of its time. The default setting is "
            f"{_default_words()}."
        ),
        *_failures(report),
    ]
    if len(report.compared) > 1:
        blocks += _settings(report)
    blocks += [_heading(2, "How to read the figures"), _bullets(READING)]
    blocks.append(
        "Scenes that break solvers of this kind have no error to measure; how they end is in `docs/hard-cases.md`, "
        "and how far the largest stable step is from the true one in `docs/stable-step.md`."
    )
    group = None
    for entry in report.case_reports:
        if entry.case.group != group:
            group = entry.case.group
            blocks.append(_heading(2, GROUPS[group]))
        blocks += _case(entry)
    return "\n\n".join(blocks) + "\n"


def _picture(name: str, text: str) -> str:
    return f"![{text}]({FIGURES}/{name})"


def figure_name(entry: CaseReport) -> str:
    """Return the file name of the figure of a case."""
    return f"{entry.case.name}.svg"


def _default_words() -> str:
    setting = Setting()
    return (
        f"{setting.precision}, {setting.kernel} kernel, {setting.transfer.upper()}, {setting.walls} walls, "
        f"{setting.per_axis} particles per cell and axis, Courant fraction {setting.safety:g}"
    )


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


def _failures(report: Report) -> list[str]:
    lines = [f"**{e.case.name}** {reason}" for e in report.case_reports for reason in e.verdict.reasons]
    return [_heading(2, "What failed"), _bullets(lines)] if lines else []


def _settings(report: Report) -> list[str]:
    rows = [
        (entry.label, _ratio(entry.error), _ratio(entry.seconds), _ratio(entry.to_equal), _failed(entry))
        for entry in report.compared
    ]
    head = ("setting", "error at equal n", "seconds at equal n", "seconds to an equal error", "runs that failed")
    return [
        _heading(2, "What each setting does"),
        (
            "Each setting changes one thing of the default. Figures are ratios to the default setting, below 1 is "
            "better: the geometric mean over the cases, and in brackets the best and the worst case. An equal error is "
            "the smallest one that both reach; where one is better than that at its coarsest, or the other never gets "
            "there, the true ratio is larger still. Errors of nothing but round-off are left out. The Courant "
            "fraction is varied at one resolution only. In the figure a dot is a case, the marker is the mean."
        ),
        _table(head, rows, {1, 2, 3, 4}),
        _picture(SETTINGS_FIGURE, "Ratios of error and time of every setting to those of the default one"),
        _heading(2, "Why the defaults are what they are"),
        outcome(report.compared),
        _bullets(reason(entry) for entry in report.compared),
        BEYOND,
    ]


def _ratio(ratios: Ratios | None) -> str:
    if ratios is None:
        return ""
    return f"**{ratios.mean:.2g}** ({ratios.low:.2g} to {ratios.high:.2g})"


def _failed(entry: Compared) -> str:
    return f"{entry.failed} of {entry.runs}" if entry.failed else "0"


def _case(entry: CaseReport) -> list[str]:
    case = entry.case
    measures = [
        f"**{measure.name}**{f' ({measure.unit})' if measure.unit else ''}: {measure.text}" for measure in case.measures
    ]
    blocks: list[str] = [
        _heading(3, case.title, case.name),
        f"`mpmcli validate {case.name}`; {entry.verdict.word}. Source: {case.source}. n counts {case.resolution}.",
        _bullets(measures),
    ]
    if case.note:
        blocks.append(case.note)
    blocks += entry.verdict.reasons
    blocks.append(_picture(figure_name(entry), f"{case.title}: error against cost, resolution and Courant fraction"))
    blocks.append(_checks(entry))
    named = [f"{measure.name}{f', {measure.unit}' if measure.unit else ''}" for measure in case.measures]
    costs = ("order", "particles", "steps", "seconds", "M particle-steps/s", "compile s")
    rows = tuple(_run(row, [measure.name for measure in case.measures]) for row in entry.rows)
    right = range(1, 2 + len(named) + len(costs))
    head = ("setting", "n", *named, *costs, "outcome")
    blocks.append(_table(head, rows, right, folded=f"All {len(rows)} runs of {case.name}"))
    return blocks


def _checks(entry: CaseReport) -> str:
    rows = [
        (
            check.subject,
            label_of(check.setting),
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
        row.label,
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


def _heading(level: int, text: str, anchor: str = "") -> str:
    """Return a heading of level 1, 2 or 3, preceded by an HTML anchor if one is given."""
    return (f'<a id="{anchor}"></a>\n\n' if anchor else "") + f"{'#' * level} {text}"


def _bullets(lines: Iterable[str]) -> str:
    """Return a bullet list."""
    return "\n".join(f"* {line}" for line in lines)


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], right: Collection[int], folded: str = "") -> str:
    """Return a table; the columns numbered in `right` are aligned to the right.

    Args:
        folded: summary of a collapsed table; "" for a visible one.
    """
    rule = ["---:" if column in right else "---" for column in range(len(head))]
    lines = (" | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) for row in (head, rule, *rows))
    text = "\n".join(f"| {line} |" for line in lines)
    return f"<details>\n<summary>{folded}</summary>\n\n{text}\n\n</details>" if folded else text
