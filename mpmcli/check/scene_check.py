"""Check of a scene before the run: safe step and its cause, findings, and a forecast; as data and as text."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import SEVERITIES, Finding, gravest_first, merged, passes
from mpmcli.check.forecast import LOAD_SECONDS, Forecast, Probe, forecast_of, output_findings
from mpmcli.check.material_rules import material_findings
from mpmcli.check.scene_limits import SceneLimit
from mpmcli.check.shape_rules import drive_findings, shape_findings
from mpmcli.check.step_rules import loss_findings, rounding_findings, step_findings
from mpmcli.check.unit_rules import unit_findings
from mpmcli.cores import available_cores
from mpmcli.errors import InputError
from mpmcli.plain_text import counted, size_text, text_table
from mpmcli.scene import LoadedScene
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.problem import several
from mpmcli.solver.engine.plan import Plan, make_plan
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.machine.costs import useful_threads

# A scene of more steps is rejected; the counts of a forecast are exact below 2^53.
MOST_STEPS = 1e15
# Largest number of rows in the table of limits; the largest limits are left out.
MOST_ROWS = 16
# Largest number of findings of one rule in the text.
MOST_ALIKE = 5


@dataclass(frozen=True)
class SceneCheck:
    """Result of the check of a scene: its facts with bounds on the step, findings by severity, plan, and forecast."""

    loaded: LoadedScene
    facts: SceneFacts
    findings: tuple[Finding, ...]
    plan: Plan
    forecast: Forecast

    def passes(self, *, strict: bool = False) -> bool:
        """Return whether there is no error; with `strict` no warning either."""
        return passes(self.findings, strict=strict)

    def text(self) -> str:
        """Return the check as text: contact, limits, findings, plan, forecast, and the outcome."""
        facts, first, later = self.facts, self.facts.binding_at_start, self.facts.binding
        steps = [f"Step that is safe throughout: {facts.step:.4g} s. {later.why} {later.fix}"]
        if first is not later:
            same = (first.name, first.body) == (later.name, later.body)
            why = ", by the same limit." if same else f". {first.why} {first.fix}"
            steps.append(f"Step at the start: {facts.step_at_start:.4g} s{why}")
        findings = merged(self.findings)
        counts = Counter(finding.severity for finding in findings)
        counted_findings = [counted(counts[word], word) for word in SEVERITIES if counts[word]]
        parts = [
            "\n".join(filter(None, [self.loaded.scene.title, *self.loaded.notes])),
            _contact_text(facts.contacts),
            _limits_text(facts),
            "\n".join(steps),
            _findings_text(findings),
            _plan_text(self.plan),
            _forecast_text(self.forecast),
            f"{'ok' if self.passes() else 'not ok'}: {', '.join(counted_findings) or 'nothing found'}",
        ]
        return "\n\n".join(part for part in parts if part)

    def outlook(self, *, stored: bool) -> str:
        """Return a line for the start of a run: steps, cause, frames, disk, time; `stored`: its kernels are."""
        forecast, limit, step = self.forecast, self.facts.binding, self.facts.taken(self.facts.step_expected)
        if stored and forecast.seconds is not None:
            seconds = forecast.seconds - forecast.compile_seconds + LOAD_SECONDS
            forecast = replace(forecast, seconds=seconds, compile_seconds=0.0)
        cause = f"by the {limit.name} limit" + (f' of "{limit.body}"' if limit.body else "")
        if step < self.facts.step_expected:
            cause = "as the scene asks"
        return (
            f"{forecast.steps:,} steps of about {step:.3g} s, {cause}; {counted(forecast.frames, 'frame')}, "
            f"{size_text(forecast.file_bytes)}{_took_text(forecast)}"
        )

    def as_dict(self) -> dict:
        """Return the check as a dictionary for JSON; `ok` is whether it passes."""
        facts, (always, at_start) = self.facts, (self.facts.binding, self.facts.binding_at_start)
        return {
            "ok": self.passes(),
            "scene": self.loaded.source,
            "title": self.loaded.scene.title,
            "step": facts.step,
            "step_at_start": facts.step_at_start,
            "contacts": [dict(vars(row)) for row in facts.contacts.rows()],
            "limits": [
                {**limit.as_dict(), "binds": limit is always, "binds_at_start": limit is at_start}
                for limit in facts.limits
            ],
            "findings": [dict(vars(finding)) for finding in self.findings],
            "plan": {**self.plan.as_dict(), "bytes_per_particle": self.plan.bytes_per_particle},
            "forecast": vars(self.forecast),
            "notes": list(self.loaded.notes),
        }


def check_scene(
    loaded: LoadedScene,
    *,
    facts: SceneFacts | None = None,
    plan: Plan | None = None,
    probe: Probe | None = None,
    directory: Path = Path(),
    threads: int | None = None,
) -> SceneCheck:
    """Check a scene, without Taichi; the plan is by default that of the CPU, the probe measures the cost of a step.

    `facts` are those of the scene, `directory` is the place of results, `threads` those of the run: None for as many as
    the scene can use.
    InputError: no step is stable, or more than MOST_STEPS are needed.
    """
    scene = loaded.scene
    facts = facts or SceneFacts(scene)
    if not scene.time.end <= MOST_STEPS * facts.taken(facts.step):
        raise InputError(
            f"{loaded.source}: no run is possible: with speeds up to {facts.bounds.speed:.3g} m/s and accelerations up "
            f"to {facts.bounds.gravity:.3g} m/s^2 the largest stable step is {facts.step:.3g} s, in a run of "
            f"{scene.time.end:.3g} s. {facts.binding.why}"
        )
    if plan is None:
        cores = threads or available_cores()
        plan = make_plan(scene, Backend("cpu", cores, scene.solver.precision, compile_cache=True))
    threads = threads or useful_threads(plan.particles, available_cores())
    forecast = forecast_of(facts, plan, probe, threads)
    rules = (step_findings, shape_findings, material_findings, drive_findings, loss_findings, rounding_findings)
    findings = [finding for rule in (*rules, unit_findings) for finding in rule(facts)]
    findings += output_findings(facts, plan, forecast, directory)
    if probe is not None and probe.failure:
        unstable = f"The run became unstable within {probe.steps} steps of the probe"
        what = f"{unstable}: {probe.failure.rstrip('.')}."
        fix = "Use slower bodies, a stiffer material, or a lower time.safety."
        findings.append(Finding("error", "probe", what, fix, probe.steps))
    return SceneCheck(loaded, facts, gravest_first(findings), plan, forecast)


def _contact_text(contacts: ContactTable) -> str:
    """Return one row for each kind of contact."""
    rows = []
    for row in contacts.rows():
        second = "each other" if row.second == row.first else several(list(row.second), 2)
        friction = "sticks" if row.friction is None else f"{row.friction:g}"
        rows.append((several(list(row.first), 2), second, row.method, friction, row.source))
    return text_table(("contact of", "with", "at", "friction", "by"), rows, left={0, 1, 2, 4}) if rows else ""


def _limits_text(facts: SceneFacts) -> str:
    """Return one row for each bound, in the order of the scene; one for bodies, or states, that have the same."""
    at_rest = {(limit.name, limit.body): limit.value for limit in facts.limits if limit.state == "rest"}
    told = [
        limit
        for limit in facts.limits
        if limit.state == "rest" or limit.value != at_rest.get((limit.name, limit.body)) or limit is facts.binding
    ]
    nearest = sorted(told, key=lambda limit: limit.value)[:MOST_ROWS]
    alike: dict[tuple[str, ...], list[SceneLimit]] = {}
    for limit in told:
        if limit in nearest:
            alike.setdefault((limit.name, limit.meaning, f"{limit.value:.4g} s"), []).append(limit)
    rows, marks = [], {"binds at the start": facts.binding_at_start, "binds throughout": facts.binding}
    for cells, limits in alike.items():
        said = [word for word, binding in marks.items() if binding in limits]
        bodies = several([limit.body or "any" for limit in limits], 2)
        rows.append((bodies, *cells, "binds" if len(said) == 2 else " ".join(said)))
    table = text_table(("body", "limit", "state", "largest step", ""), rows, left={0, 1, 2, 4})
    left_out = len(told) - len(nearest)
    return table + (f"\nand {left_out} that bind less" if left_out else "")


def _findings_text(findings: Iterable[Finding]) -> str:
    """Return one line for each finding, and of each rule the first MOST_ALIKE only."""
    lines, told = [], Counter[str]()
    for finding in findings:
        told[finding.rule] += 1
        if told[finding.rule] <= MOST_ALIKE:
            lines.append(finding.line)
    more = [f"{count - MOST_ALIKE} more of {rule}" for rule, count in told.items() if count > MOST_ALIKE]
    return "\n".join([*lines, *([f"and {', '.join(more)}"] if more else [])])


def _plan_text(plan: Plan) -> str:
    lines = [
        f"{law.law}: {law.particles:,} particles of {sum(law.fields.values()) + plan.scratch_bytes} bytes "
        f"({', '.join(law.fields)}, and {plan.scratch_bytes} bytes for the sort)"
        for law in plan.laws
        if law.particles
    ]
    extent = ", sparse, with room for more" if plan.sparse else ""
    lines.append(f"grid: {plan.nodes:,} nodes of {plan.bytes_per_node} bytes{extent}")
    lines.append(f"passes of a step: {', '.join(plan.passes)}")
    return "\n".join(lines)


def _forecast_text(forecast: Forecast) -> str:
    low, high = sorted(forecast.steps_range)
    steps = f"{forecast.steps:,} steps" + (f" ({low:,} to {high:,})" if low != high else "")
    return (
        f"{steps}, {forecast.frames:,} frames{_took_text(forecast)}\n"
        f"{size_text(forecast.device_bytes)} on the device, {size_text(forecast.host_bytes)} for frames beside it, "
        f"{size_text(forecast.file_bytes)} on the disk before "
        f"compression ({size_text(forecast.vtk_bytes)} more with --format vtk)"
    )


def _took_text(forecast: Forecast) -> str:
    if forecast.seconds is None:
        return ""
    compiling = f"{forecast.compile_seconds:.2g} s of it to compile"
    if not forecast.compile_seconds:
        compiling = "its kernels are stored"
    elif not forecast.measured:
        compiling += ", unless a run of this kind did; by a table of measured kinds"
    seconds = forecast.seconds
    length, unit = (1, "s") if seconds < 120 else (60, "min") if seconds < 7200 else (3600, "h")
    return f", about {seconds / length:.2g} {unit} ({compiling})"
