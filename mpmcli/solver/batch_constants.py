"""What does not change during a run of a batch, as the kernel reads it."""

import math
from collections.abc import Sequence

from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.batch import Batch
from mpmcli.solver.batch_emission import begin_emission
from mpmcli.solver.batch_layout import Row


def write_constants(batch: Batch, slot: int, scene: Scene, particles: Sequence[BodyParticles]) -> None:
    """Store the constants of a run: domain, walls, colliders, emitters and bounds on the step.

    Args:
        slot: place of the run.
        particles: one entry per source.
    """
    h, device = scene.domain.spacing, batch.device
    for data in (device.friction, device.moving, device.grid.period, device.colliders, device.motion):
        if data is not None:
            data.write(scene, slot)
    numbers, counts, real, count = batch.numbers[slot], batch.counts[slot], batch.layout.real, batch.layout.count
    gravity = scene.domain.gravity_at(0.0)
    for a, n in enumerate(scene.domain.cells):
        numbers[real.gravity[a]] = gravity[a]
        numbers[real.extent[a]] = n * h
        counts[count.cells[a]] = n
    Row(batch.layout, numbers, counts).set(
        spacing=h,
        inverse_spacing=1 / h,
        gradient_scale=device.grid.scheme.spline.inverse_moment / h,
        safety=scene.time.safety,
        maximum=math.inf if scene.time.step == "auto" else scene.time.step,
        end=scene.time.end,
        force=math.inf,
        wall_speed=scene.domain.wall_speed,
    )
    begin_emission(batch, slot, scene, particles)
