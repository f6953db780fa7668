"""The check of a scene as text for people."""

from collections import Counter
from typing import TYPE_CHECKING

from mpmcli.check.finding import SEVERITIES
from mpmcli.check.scene_limits import SceneLimit
from mpmcli.plain_text import size_text, text_table

if TYPE_CHECKING:
    from mpmcli.check.scene_check import SceneCheck

# Rows of the table of limits; of more, those that bind least are left out.
MOST_ROWS = 16
# Findings of one rule that are told.
MOST_ALIKE = 5


def scene_text(check: "SceneCheck") -> str:
    """Return the limits, the findings, the plan and the forecast, and a last line with the outcome."""
    parts = [
        "\n".join(filter(None, [check.title, *check.notes])),
        _limits(check),
        _steps(check),
        _findings(check),
        _plan(check),
        _forecast(check),
        _outcome(check),
    ]
    return "\n\n".join(part for part in parts if part)


def _limits(check: "SceneCheck") -> str:
    """One row for each bound, in the order of the scene; a bound that the stiffest state leaves alone has one row."""
    shown, left_out = _rows(check)
    table = text_table(
        ("body", "limit", "state", "largest step", ""),
        [
            (limit.body or "any", limit.name, limit.meaning, f"{limit.value:.4g} s", _mark(check, limit))
            for limit in shown
        ],
        left={0, 1, 2, 4},
    )
    more = f"\nand {left_out} that bind less" if left_out else ""
    return table + more


def _rows(check: "SceneCheck") -> tuple[list[SceneLimit], int]:
    at_rest = {(limit.name, limit.body): limit.value for limit in check.limits if limit.state == "rest"}
    told = [
        limit
        for limit in check.limits
        if limit.state == "rest" or limit.value != at_rest.get((limit.name, limit.body)) or limit is check.binding
    ]
    nearest = sorted(told, key=lambda limit: limit.value)[:MOST_ROWS]
    return [limit for limit in told if limit in nearest], len(told) - len(nearest)


def _mark(check: "SceneCheck", limit: SceneLimit) -> str:
    marks = [(check.binding_at_start, "binds at the start"), (check.binding, "binds throughout")]
    said = [word for binding, word in marks if binding is limit]
    return "binds" if len(said) == 2 else " ".join(said)


def _steps(check: "SceneCheck") -> str:
    first, later = check.binding_at_start, check.binding
    lines = [f"Step that is safe throughout: {check.step:.4g} s. {later.why} {later.fix}"]
    if first is not later:
        lines.append(f"Step at the start: {check.step_at_start:.4g} s. {first.why} {first.fix}")
    return "\n".join(lines)


def _findings(check: "SceneCheck") -> str:
    """One line each; of many that one rule has found, the first ones."""
    lines, told = [], Counter[str]()
    for finding in check.findings:
        told[finding.rule] += 1
        if told[finding.rule] <= MOST_ALIKE:
            lines.append(finding.line)
    more = [f"{count - MOST_ALIKE} more of {rule}" for rule, count in told.items() if count > MOST_ALIKE]
    return "\n".join([*lines, *([f"and {', '.join(more)}"] if more else [])])


def _plan(check: "SceneCheck") -> str:
    plan = check.plan
    lines = [
        f"{law.law}: {law.particles:,} particles of {sum(law.fields.values()) + plan.scratch_bytes} bytes "
        f"({', '.join(law.fields)}, and {plan.scratch_bytes} bytes for the sort)"
        for law in plan.laws
    ]
    lines.append(f"grid: {plan.nodes:,} nodes of {plan.bytes_per_node} bytes")
    lines.append(f"passes of a step: {', '.join(plan.passes)}")
    return "\n".join(lines)


def _forecast(check: "SceneCheck") -> str:
    forecast = check.forecast
    low, high = sorted(forecast.steps_range)
    steps = f"{forecast.steps:,} steps" + (f" ({low:,} to {high:,})" if low != high else "")
    took = ""
    if forecast.seconds is not None:
        took = f", {_time(forecast.seconds)} here, {forecast.compile_seconds:.2g} s of it compilation"
    return (
        f"{steps}, {forecast.frames:,} frames{took}\n"
        f"{size_text(forecast.device_bytes)} on the device, {size_text(forecast.file_bytes)} on the disk before "
        f"compression ({size_text(forecast.vtk_bytes)} as .vtu series)"
    )


def _outcome(check: "SceneCheck") -> str:
    counts = Counter(finding.severity for finding in check.findings)
    found = [f"{counts[word]} {word}{'s' if counts[word] > 1 else ''}" for word in SEVERITIES if counts[word]]
    return ("ok" if check.passes() else "not ok") + (f": {', '.join(found)}" if found else ": nothing found")


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"about {seconds:.2g} s"
    return f"about {seconds / 60:.2g} min" if seconds < 7200 else f"about {seconds / 3600:.2g} h"
