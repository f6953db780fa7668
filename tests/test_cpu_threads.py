"""Threads that share a run: no part is done before one is published, and no number of parts is too large."""

from collections.abc import Callable

import numpy as np
from scenes import block, scene

from mpmcli.quick_taichi import ti
from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.cpu_launch import CpuLaunch
from mpmcli.solver.engine.cpu_phases import FrameBuffer, RunInts, RunReals
from mpmcli.solver.engine.cpu_threads import RESPECT
from mpmcli.solver.engine.run import build_run

FLUID = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e4}


@ti.data_oriented
class EarlyThread:
    """A thread that comes to a launch before the first one has published a phase."""

    def __init__(self, launch: CpuLaunch) -> None:
        self.team = launch.team

    @ti.kernel
    def come(self, numbers: RunReals, counts: RunInts, frame_buffer: FrameBuffer) -> int:
        """Return what it finds to do, see `CpuThreads.process_part`."""
        found = 0
        ti.loop_config(serialize=True)
        for _ in range(1):
            self.team.open(0)
            self.team.enter(0)
            found = self.team.process_part(0, 1, RESPECT, numbers, counts, frame_buffer)
        return found


def test_nothing_is_to_be_done_before_the_first_phase(backend_of: Callable) -> None:
    """It would count as a part of the first phase, which would then end before its last part is done."""
    start = scene((16, 16), 1 / 16, [block("pool", FLUID, (0, 0), (1, 0.5))], 0.01)
    run = build_run(start, backend_of("f32", 2), sample_bodies(start))
    batch = run.batch
    frame_buffer = np.zeros((run.particle_count, 16), np.float32)
    early = EarlyThread(batch.cpu)
    assert early.come(batch.numbers, batch.counts, frame_buffer) == 0
    # Nor after a launch, whatever its last phase was.
    run.step(1e-4)
    assert early.come(batch.numbers, batch.counts, frame_buffer) == 0


def test_a_region_may_have_any_number_of_pencils(backend_of: Callable) -> None:
    """One thread has all particles, at one end of a long domain, and the other 100,000 pencils of a colour."""
    start = scene((840_000, 7), 1.0, [block("drop", FLUID, (0, 0), (3, 2))], 1.0, gravity=(0.0, 0.0))
    assert start.solver.grid == "auto"
    start = start.model_copy(update={"solver": start.solver.model_copy(update={"grid": "dense"})})
    run = build_run(start, backend_of("f32", 2), sample_bodies(start))
    run.step(1e-3)
    assert run.step_count == 1
    assert largest_region(run) > 2**16


def largest_region(run: object) -> int:
    """Return the largest number of pencils of a colour in a region."""
    work = run.batch.device.orders[0].work.to_numpy()
    return int(np.diff(work, axis=1).max())
