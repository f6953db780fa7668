"""A process of a contestant of the benchmark, whose steps take a known time, and the figures of one."""

from typing import Self

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.side import Setting, Side


class FakeWorker:
    """Answers as `mpmcli.bench.side.Worker` does, and notes in `log` what it was asked.

    Args:
        step_seconds: processor time of a step; wall: its wall time over that.
        smallest_step: time step that it took.
    """

    start_seconds = 0.5

    def __init__(
        self,
        who: str,
        step_seconds: float,
        particles: int,
        smallest_step: float,
        *,
        log: list[tuple[str, str]] | None = None,
        wall: float = 1.0,
        peak_memory: int = 10**8,
    ) -> None:
        self.who, self.step_seconds, self.wall, self.log = who, step_seconds, wall, [] if log is None else log
        self.ready = {"particles": particles, "bytes_per_particle": 100, "threads": 1}
        self.end = {"sound": True, "smallest_step": smallest_step, "peak_memory": peak_memory}
        self.closed = False

    def ask(self, command: str) -> dict:
        self.log.append((self.who, command))
        match command.split():
            case ["first"]:
                return {"seconds": 2.0 + self.step_seconds}
            case ["run", _]:
                return self.steps(100)
            case ["finish"]:
                return self.end
        return {}

    def steps(self, count: int) -> dict:
        busy = count * self.step_seconds
        return {"steps": count, "seconds": self.wall * busy, "processor_seconds": busy}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True


def figures_of(who: str, case: BenchCase, costs: tuple[float, ...], threads: int = 1, **others: object) -> dict:
    """Return the figures of a contestant whose blocks took these times, in s per particle and step."""
    side = Side(who, case, Setting(threads))
    side.worker, side.first_seconds = FakeWorker(who, 0.0, case.particles, case.step), 2.0
    side.answers = [{"steps": 1, side.clock: cost * case.particles} for cost in costs]
    return side.finish() | others
