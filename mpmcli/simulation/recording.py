"""One run kept in memory: its frames, its ledger, and whether it stayed stable."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from mpmcli.check.finding import Verdict
from mpmcli.check.result_check import check_kept
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import Scene, scene_to_toml
from mpmcli.solver.engine.run import Run
from mpmcli.solver.frames.diagnosis import LEFT, OUTRAN, UnstableRunError
from mpmcli.solver.machine.backend import Backend


@dataclass(frozen=True)
class Recording:
    """A run with T frames and rows, fewer where it stopped, its verdict, and why that is not "stable"."""

    header: RunHeader
    frames: Sequence[Frame]
    ledger: Sequence[LedgerRow]
    steps: int
    particles: int
    verdict: Verdict
    reason: str


class Recorder:
    """Keeps the frames of a run while it goes on."""

    def __init__(self, run: Run, scene: Scene, backend: Backend) -> None:
        facts = {"arch": backend.arch, "threads": backend.threads, "precision": backend.precision}
        self._header = RunHeader.of(scene, scene_to_toml(scene), [laws()[name] for name in run.laws], facts)
        self._run = run
        self._frames: list[Frame] = []
        self._ledger: list[LedgerRow] = []

    def take(self, frame: Frame, row: LedgerRow) -> None:
        """Keep a frame."""
        self._frames.append(frame)
        self._ledger.append(row)

    def finished(self) -> Recording:
        """Return the recording of a run that has reached its end."""
        check = check_kept(self._header, self._frames, self._ledger)
        return self._recording(check.verdict, next((f.what for f in check.findings if f.severity != "note"), ""))

    def stopped(self, error: UnstableRunError) -> Recording:
        """Return the recording of a run that became unstable."""
        escaped = error.diagnosis.cause.startswith((LEFT, OUTRAN))
        return self._recording("escaped" if escaped else "unstable", str(error))

    def _recording(self, verdict: Verdict, reason: str) -> Recording:
        counts = self._run.step_count, self._run.particle_count
        return Recording(self._header, self._frames, self._ledger, *counts, verdict, reason)


def record(run: Run, scene: Scene, backend: Backend, stop: Callable[[], bool] = lambda: False) -> Recording:
    """Run a scene to its end or to where it stops; KeyboardInterrupt where `stop` returned True."""
    recorder = Recorder(run, scene, backend)
    try:
        for frame, row in run.frames(stop):
            recorder.take(frame, row)
    except UnstableRunError as error:
        return recorder.stopped(error)
    return recorder.finished()
