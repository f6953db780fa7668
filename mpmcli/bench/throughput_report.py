"""The report of `mpmcli bench --dataset`, as a text table and as a dictionary for JSON."""

import statistics
from dataclasses import dataclass, field

from mpmcli.bench.report import describe_machine
from mpmcli.plain_text import counted, text_table

# The generator of the GNS project takes this processor time, s, for a trajectory on one core, measured on a machine
# where mpm88, with the particles and cells of the case 2d-64 and on two threads, made so many particle-steps/s. Their
# product carries the time over to the present machine.
GENERATOR_SECONDS = 8.4
GENERATOR_PEER_RATE = 6.5e6
PEER_THREADS = 2


@dataclass(frozen=True)
class ThroughputResult:
    """The blocks of one number of workers.

    Attributes:
        workers: processes, of one thread each.
        per_hour: trajectories per hour of each block, stored ones, from when the workers were there.
        seconds: wall time of each block.
        trajectories: of all blocks; accepted: of these.
        steps: mean number of a trajectory.
    """

    workers: int
    per_hour: tuple[float, ...]
    seconds: tuple[float, ...]
    trajectories: int
    accepted: int
    steps: float

    @property
    def rate(self) -> float:
        """Median of the blocks, trajectories per hour."""
        return statistics.median(self.per_hour)


@dataclass(frozen=True)
class ThroughputReport:
    """One run of the benchmark.

    Attributes:
        results: per number of workers, 1 first.
        peer_rates: particle-steps/s of mpm88 at 2d-64 on PEER_THREADS threads, of each block.
        particles, frames: of a trajectory; frames after the first.
        seconds: length of a block as asked, s, None where the number of trajectories was given.
        machine: see `describe_machine`.
    """

    results: tuple[ThroughputResult, ...]
    peer_rates: tuple[float, ...]
    particles: int
    frames: int
    seconds: float | None
    machine: dict = field(default_factory=describe_machine)

    @property
    def peer_rate(self) -> float:
        """Median of the blocks of mpm88, particle-steps/s."""
        return statistics.median(self.peer_rates)

    @property
    def generator_seconds(self) -> float:
        """Time that the generator of the GNS project would take for a trajectory on one core of this machine, s."""
        return GENERATOR_SECONDS * GENERATOR_PEER_RATE / self.peer_rate

    def ratio(self, result: ThroughputResult, per_hour: float | None = None) -> float:
        """Return how many times as fast it is as one process of the generator for each worker, each on its core.

        Args:
            per_hour: rate of a block in place of the median.
        """
        return (per_hour or result.rate) * self.generator_seconds / 3600 / result.workers

    def as_dict(self) -> dict:
        """Return everything measured, ready for JSON."""
        return {
            "machine": self.machine,
            "particles": self.particles,
            "frames": self.frames,
            "block_s": self.seconds,
            "peer_name": "mpm88",
            "peer_case": "2d-64",
            "peer_threads": PEER_THREADS,
            "peer_particle_steps_per_s": self.peer_rate,
            "peer_particle_steps_per_s_blocks": list(self.peer_rates),
            "generator_s": self.generator_seconds,
            "results": [
                {
                    "workers": result.workers,
                    "trajectories_per_hour": result.rate,
                    "trajectories_per_hour_blocks": list(result.per_hour),
                    "blocks_s": list(result.seconds),
                    "trajectories": result.trajectories,
                    "accepted": result.accepted,
                    "steps": result.steps,
                    "ratio": self.ratio(result),
                    "ratio_min": self.ratio(result, min(result.per_hour)),
                    "ratio_max": self.ratio(result, max(result.per_hour)),
                }
                for result in self.results
            ],
        }

    def table(self) -> str:
        """Return the report as text: one line per number of workers, then what the columns mean."""
        head = ("workers", "trajectories", "steps of each", "per hour", "range", "s per core", "ratio", "range")
        rows = [self._row(result) for result in self.results]
        machine = self.machine
        title = f"{machine['processor']}, cpu, f32, taichi {machine['taichi']}"
        scene = f"A block of sand: {self.particles:,} particles, 64 x 64 cells, {counted(self.frames, 'frame')}."
        notes = [
            "per hour: trajectories computed and stored, median of the blocks, once every worker has ended a task.",
            "s per core: time of a trajectory on each core.",
            "ratio: to the GNS project's generator, one process on each core, with"
            f" {self.generator_seconds:.1f} s for a trajectory. It took {GENERATOR_SECONDS} s",
            f"where mpm88 at 2d-64 on {PEER_THREADS} threads made {GENERATOR_PEER_RATE / 1e6:.1f} million"
            f" particle-steps/s; here mpm88 makes {self.peer_rate / 1e6:.2f}.",
        ]
        refused = [
            f"Beware: with {counted(result.workers, 'worker')} {result.trajectories - result.accepted} of"
            f" {counted(result.trajectories, 'trajectory')} were not accepted."
            for result in self.results
            if result.accepted < result.trajectories
        ]
        return "\n".join([title, scene, "", text_table(head, rows, left=set()), "", *notes, *refused])

    def _row(self, result: ThroughputResult) -> tuple[str, ...]:
        low, high = min(result.per_hour), max(result.per_hour)
        return (
            f"{result.workers}",
            f"{result.trajectories:,}",
            f"{result.steps:,.0f}",
            f"{result.rate:,.0f}",
            f"{low:,.0f}-{high:,.0f}",
            f"{3600 * result.workers / result.rate:.2f}",
            f"{self.ratio(result):.1f}",
            f"{self.ratio(result, low):.1f}-{self.ratio(result, high):.1f}",
        )
