"""One run kept in memory: its frames, its ledger, and whether it stayed stable."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mpmcli.check.finding import Finding, Verdict
from mpmcli.check.result_check import check_kept
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import Scene, scene_to_toml
from mpmcli.solver.backend import Backend
from mpmcli.solver.diagnosis import LEFT, OUTRAN, UnstableRunError
from mpmcli.solver.engine import Engine


@dataclass(frozen=True)
class Recording:
    """A run with all its frames.

    Attributes:
        header: facts about the run.
        frames, ledger: T each; fewer than the scene asks for where the run stopped.
        steps, particles: counts.
        verdict: of `mpmcli check`; "escaped" where a particle left the domain.
        reason: why the verdict is not "stable", one sentence; "" where it is.
    """

    header: RunHeader
    frames: Sequence[Frame]
    ledger: Sequence[LedgerRow]
    steps: int
    particles: int
    verdict: Verdict
    reason: str


def record(engine: Engine, scene: Scene, backend: Backend, stop: Callable[[], bool] = lambda: False) -> Recording:
    """Run a scene to its end or to where it stops.

    Raises:
        KeyboardInterrupt: `stop` returned True.
    """
    facts = {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}
    header = RunHeader.of(scene, scene_to_toml(scene), [laws()[name] for name in engine.laws], facts)
    frames: list[Frame] = []
    ledger: list[LedgerRow] = []
    verdict: Verdict
    try:
        for frame, row in engine.frames(stop):
            frames.append(frame)
            ledger.append(row)
    except UnstableRunError as error:
        verdict = "escaped" if error.diagnosis.cause.startswith((LEFT, OUTRAN)) else "unstable"
        reason = str(error)
    else:
        check = check_kept(header, frames, ledger)
        verdict, reason = check.verdict, _first(check.findings)
    return Recording(header, frames, ledger, engine.step_count, engine.particle_count, verdict, reason)


def _first(findings: Sequence[Finding]) -> str:
    """Return the gravest finding as a sentence, "" where there is none but notes."""
    return next((finding.what for finding in findings if finding.severity != "note"), "")
