"""The check of a scene before it runs: which step is safe and why, what will go wrong, and what it will take."""

from dataclasses import dataclass
from pathlib import Path

from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding, gravest_first, passes
from mpmcli.check.forecast import Forecast, forecast_of
from mpmcli.check.material_rules import material_findings
from mpmcli.check.output_rules import output_findings
from mpmcli.check.probe import Probe
from mpmcli.check.rounding_rules import rounding_findings
from mpmcli.check.scene_limits import SceneLimit
from mpmcli.check.scene_table import scene_text
from mpmcli.check.shape_rules import shape_findings
from mpmcli.check.step_rules import step_findings
from mpmcli.cores import available_cores
from mpmcli.errors import InputError
from mpmcli.scene import LoadedScene
from mpmcli.solver.backend import Backend
from mpmcli.solver.plan import Plan, make_plan

# Steps that no run will ever take; the counts of a forecast are exact below 2^53.
MOST_STEPS = 1e15


@dataclass(frozen=True)
class SceneCheck:
    """What the check of a scene found.

    Attributes:
        source: the file; title: of the scene.
        limits: every bound on the step, in the order of the bodies, those of motion last.
        binding, binding_at_start: the smallest of them, in any state and at the start.
        step, step_at_start: safety times these, s: the step that is safe throughout, and the first one.
        findings: the gravest first.
        plan: fields and passes; forecast: steps, time, memory and disk.
        notes: what was chosen for the scene as it was loaded.
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
        """Return it as text for people: limits, findings, plan, forecast, and the outcome."""
        return scene_text(self)

    def as_dict(self) -> dict:
        """Return all of it as JSON can hold it; `ok` is whether it passes."""
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
        plan: of the run, or of the probe; that of a run on all cores of the CPU where None.
        probe: what a moment of the run cost, for the forecast of time.
        directory: where results would go, for the room on its disk.

    Raises:
        InputError: no step is stable, as where gravity is infinite at some time.
    """
    scene = loaded.scene
    facts = SceneFacts(scene)
    if not scene.time.end <= MOST_STEPS * facts.taken(facts.step):
        raise InputError(
            f"{loaded.source}: no run is possible: with speeds up to {facts.bounds.speed:.3g} m/s and accelerations up "
            f"to {facts.bounds.gravity:.3g} m/s^2 the largest stable step is {facts.step:.3g} s. {facts.binding.why}"
        )
    if plan is None:
        plan = make_plan(scene, Backend("cpu", available_cores(), scene.solver.precision, compile_cache=True))
    forecast = forecast_of(facts, plan, probe)
    findings = [
        *step_findings(facts),
        *shape_findings(facts),
        *material_findings(facts),
        *rounding_findings(facts),
        *output_findings(facts, plan, forecast, directory),
    ]
    if probe is not None and probe.failure:
        findings.append(
            Finding(
                "error",
                "probe",
                f"The run broke down within {probe.steps} steps of the probe: {probe.failure.rstrip('.')}.",
                "Start it nearer to rest: with slower bodies, a stiffer material, or a lower time.safety.",
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
