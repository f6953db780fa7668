"""Check of a scene before the run: the safe step and its cause, findings, and a forecast; as data and as text."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import SEVERITIES, Finding, gravest_first, passes
from mpmcli.check.forecast import Forecast, forecast_of
from mpmcli.check.loss_rules import loss_findings
from mpmcli.check.material_rules import material_findings
from mpmcli.check.output_rules import output_findings
from mpmcli.check.probe import Probe
from mpmcli.check.rounding_rules import rounding_findings
from mpmcli.check.scene_limits import SceneLimit
from mpmcli.check.shape_rules import shape_findings
from mpmcli.check.step_rules import step_findings
from mpmcli.cores import available_cores
from mpmcli.errors import InputError
from mpmcli.plain_text import counted, size_text, text_table
from mpmcli.scene import LoadedScene
from mpmcli.solver.backend import Backend
from mpmcli.solver.plan import Plan, make_plan

# A scene of more steps is rejected; the counts of a forecast are exact below 2^53.
MOST_STEPS = 1e15
# Largest number of rows in the table of limits; the largest limits are left out.
MOST_ROWS = 16
# Largest number of findings of one rule in the text.
MOST_ALIKE = 5


@dataclass(frozen=True)
class SceneCheck:
    """Result of the check of a scene.

    Attributes:
        source: file of the scene.
        title: title of the scene.
        limits: all bounds on the step, in the order of the bodies, those of motion last.
        binding, binding_at_start: smallest bound in any state, and at the start.
        step, step_at_start: safety times these, s.
        findings: by decreasing severity.
        plan: fields and passes.
        forecast: steps, time, memory and disk space.
        notes: values chosen for "auto" when the scene was loaded.
    """

    source: str
    title: str
    limits: tuple[SceneLimit, ...]
    binding: SceneLimit
    binding_at_start: SceneLimit
    step: float
    step_at_start: float
    findings: tuple[Finding, ...]
    plan: Plan
    forecast: Forecast
    notes: tuple[str, ...]

    def passes(self, *, strict: bool = False) -> bool:
        """Return whether there is no error; with `strict` no warning either."""
        return passes(self.findings, strict=strict)

    def text(self) -> str:
        """Return the check as text: limits, findings, plan, forecast, and the outcome."""
        return scene_text(self)

    def as_dict(self) -> dict:
        """Return the check as a dictionary for JSON; `ok` is whether it passes."""
        return {
            "ok": self.passes(),
            "scene": self.source,
            "title": self.title,
            "step": self.step,
            "step_at_start": self.step_at_start,
            "limits": [
                {**limit.as_dict(), "binds": limit is self.binding, "binds_at_start": limit is self.binding_at_start}
                for limit in self.limits
            ],
            "findings": [finding.as_dict() for finding in self.findings],
            "plan": {**self.plan.as_dict(), "bytes_per_particle": self.plan.bytes_per_particle},
            "forecast": self.forecast.as_dict(),
            "notes": list(self.notes),
        }


def check_scene(
    loaded: LoadedScene, *, plan: Plan | None = None, probe: Probe | None = None, directory: Path = Path()
) -> SceneCheck:
    """Check a scene; Taichi is not started and nothing is written.

    Args:
        plan: plan of the run or of the probe; None for a run on all cores of the CPU.
        probe: measured cost of a step, for the forecast of time.
        directory: where results would be written, for the free space of its disk.

    Raises:
        InputError: no step is stable, for example because gravity is infinite at some time, or more than MOST_STEPS are
            needed.
    """
    scene = loaded.scene
    facts = SceneFacts(scene)
    if not scene.time.end <= MOST_STEPS * facts.taken(facts.step):
        raise InputError(
            f"{loaded.source}: no run is possible: with speeds up to {facts.bounds.speed:.3g} m/s and accelerations up "
            f"to {facts.bounds.gravity:.3g} m/s^2 the largest stable step is {facts.step:.3g} s, in a run of "
            f"{scene.time.end:.3g} s. {facts.binding.why}"
        )
    if plan is None:
        plan = make_plan(scene, Backend("cpu", available_cores(), scene.solver.precision, compile_cache=True))
    forecast = forecast_of(facts, plan, probe)
    findings = [
        *step_findings(facts),
        *shape_findings(facts),
        *material_findings(facts),
        *loss_findings(facts),
        *rounding_findings(facts),
        *output_findings(facts, plan, forecast, directory),
    ]
    if probe is not None and probe.failure:
        findings.append(
            Finding(
                "error",
                "probe",
                f"The run became unstable within {probe.steps} steps of the probe: {probe.failure.rstrip('.')}.",
                "Use slower bodies, a stiffer material, or a lower time.safety.",
                probe.steps,
            )
        )
    return SceneCheck(
        source=loaded.source,
        title=scene.title,
        limits=facts.limits,
        binding=facts.binding,
        binding_at_start=facts.binding_at_start,
        step=facts.step,
        step_at_start=facts.step_at_start,
        findings=gravest_first(findings),
        plan=plan,
        forecast=forecast,
        notes=loaded.notes,
    )


def scene_text(check: SceneCheck) -> str:
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


def _limits(check: SceneCheck) -> str:
    """Return one row for each bound, in the order of the scene; one row only if the stiffest state has the same."""
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


def _rows(check: SceneCheck) -> tuple[list[SceneLimit], int]:
    at_rest = {(limit.name, limit.body): limit.value for limit in check.limits if limit.state == "rest"}
    told = [
        limit
        for limit in check.limits
        if limit.state == "rest" or limit.value != at_rest.get((limit.name, limit.body)) or limit is check.binding
    ]
    nearest = sorted(told, key=lambda limit: limit.value)[:MOST_ROWS]
    return [limit for limit in told if limit in nearest], len(told) - len(nearest)


def _mark(check: SceneCheck, limit: SceneLimit) -> str:
    marks = [(check.binding_at_start, "binds at the start"), (check.binding, "binds throughout")]
    said = [word for binding, word in marks if binding is limit]
    return "binds" if len(said) == 2 else " ".join(said)


def _steps(check: SceneCheck) -> str:
    first, later = check.binding_at_start, check.binding
    lines = [f"Step that is safe throughout: {check.step:.4g} s. {later.why} {later.fix}"]
    if first is not later:
        lines.append(f"Step at the start: {check.step_at_start:.4g} s. {first.why} {first.fix}")
    return "\n".join(lines)


def _findings(check: SceneCheck) -> str:
    """Return one line for each finding, and of each rule the first MOST_ALIKE only."""
    lines, told = [], Counter[str]()
    for finding in check.findings:
        told[finding.rule] += 1
        if told[finding.rule] <= MOST_ALIKE:
            lines.append(finding.line)
    more = [f"{count - MOST_ALIKE} more of {rule}" for rule, count in told.items() if count > MOST_ALIKE]
    return "\n".join([*lines, *([f"and {', '.join(more)}"] if more else [])])


def _plan(check: SceneCheck) -> str:
    plan = check.plan
    lines = [
        f"{law.law}: {law.particles:,} particles of {sum(law.fields.values()) + plan.scratch_bytes} bytes "
        f"({', '.join(law.fields)}, and {plan.scratch_bytes} bytes for the sort)"
        for law in plan.laws
    ]
    extent = ", sparse, with room for more" if plan.sparse else ""
    lines.append(f"grid: {plan.nodes:,} nodes of {plan.bytes_per_node} bytes{extent}")
    lines.append(f"passes of a step: {', '.join(plan.passes)}")
    return "\n".join(lines)


def _forecast(check: SceneCheck) -> str:
    forecast = check.forecast
    low, high = sorted(forecast.steps_range)
    steps = f"{forecast.steps:,} steps" + (f" ({low:,} to {high:,})" if low != high else "")
    took = ""
    if forecast.seconds is not None:
        took = f", {_time(forecast.seconds)} here, {forecast.compile_seconds:.2g} s of it compilation"
    return (
        f"{steps}, {forecast.frames:,} frames{took}\n"
        f"{size_text(forecast.device_bytes)} on the device, {size_text(forecast.host_bytes)} for frames beside it, "
        f"{size_text(forecast.file_bytes)} on the disk before "
        f"compression ({size_text(forecast.vtk_bytes)} as .vtu series)"
    )


def _outcome(check: SceneCheck) -> str:
    counts = Counter(finding.severity for finding in check.findings)
    found = [counted(counts[word], word) for word in SEVERITIES if counts[word]]
    return ("ok" if check.passes() else "not ok") + (f": {', '.join(found)}" if found else ": nothing found")


def _time(seconds: float) -> str:
    if seconds < 120:
        return f"about {seconds:.2g} s"
    return f"about {seconds / 60:.2g} min" if seconds < 7200 else f"about {seconds / 3600:.2g} h"
