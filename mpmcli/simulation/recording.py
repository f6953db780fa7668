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


class Recorder:
    """Keeps the frames of a run while it goes on."""

    def __init__(self, engine: Engine, scene: Scene, backend: Backend) -> None:
        facts = {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}
        self._header = RunHeader.of(scene, scene_to_toml(scene), [laws()[name] for name in engine.laws], facts)
        self._engine = engine
        self._frames: list[Frame] = []
        self._ledger: list[LedgerRow] = []

    def take(self, frame: Frame, row: LedgerRow) -> None:
        """Keep a frame."""
        self._frames.append(frame)
        self._ledger.append(row)

    def finished(self) -> Recording:
        """Return the recording of a run that has reached its end."""
        check = check_kept(self._header, self._frames, self._ledger)
        return self._recording(check.verdict, _first(check.findings))

    def stopped(self, error: UnstableRunError) -> Recording:
        """Return the recording of a run that became unstable."""
        escaped = error.diagnosis.cause.startswith((LEFT, OUTRAN))
        return self._recording("escaped" if escaped else "unstable", str(error))

    def _recording(self, verdict: Verdict, reason: str) -> Recording:
        engine = self._engine
        return Recording(
            self._header, self._frames, self._ledger, engine.step_count, engine.particle_count, verdict, reason
        )


def record(engine: Engine, scene: Scene, backend: Backend, stop: Callable[[], bool] = lambda: False) -> Recording:
    """Run a scene to its end or to where it stops.

    Raises:
        KeyboardInterrupt: `stop` returned True.
    """
    recorder = Recorder(engine, scene, backend)
    try:
        for frame, row in engine.frames(stop):
            recorder.take(frame, row)
    except UnstableRunError as error:
        return recorder.stopped(error)
    return recorder.finished()


def _first(findings: Sequence[Finding]) -> str:
    """Return the gravest finding as a sentence, "" where there is none but notes."""
    return next((finding.what for finding in findings if finding.severity != "note"), "")
