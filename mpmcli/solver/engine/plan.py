"""Memory and passes of a scene before anything is allocated: those of a run that is built without a device."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import psutil

from mpmcli.errors import InputError
from mpmcli.materials.law import Law
from mpmcli.plain_text import size_text
from mpmcli.scene import Scene
from mpmcli.scene.sampling import has_expressions
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.device import Device
from mpmcli.solver.engine.refusals import require_possible
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.frames.columns import FrameColumns
from mpmcli.solver.grid.grid import Grid
from mpmcli.solver.machine.backend import LARGEST_INDEX, MEMORY_SHARE, Backend, free_memory
from mpmcli.solver.machine.dry_run import DryField, fields_of


@dataclass(frozen=True)
class LawPlan:
    """Memory of the particles of one law: their estimated number, and the bytes of each field per particle."""

    law: str
    particles: int
    fields: dict[str, int]


@dataclass(frozen=True)
class Plan:
    """Memory of a run and the passes of its time step.

    Attributes:
        nodes: number of grid nodes; on a sparse grid, those allocated at first.
        entries: entries of the longest array addressed by one index: a field, or the particle data of a frame.
        scratch_bytes: bytes of the sort buffers per particle.
        device_bytes: bytes of all fields on the device.
        host_bytes: see `host_bytes_of`.
        passes: loops of a step in order; loops over particles contain the name of their law.
    """

    laws: tuple[LawPlan, ...]
    nodes: int
    scratch_bytes: int
    bytes_per_node: int
    device_bytes: int
    host_bytes: int
    passes: tuple[str, ...]
    arch: str = "cpu"
    sparse: bool = False
    entries: int = 0

    @property
    def particles(self) -> int:
        return sum(law.particles for law in self.laws)

    @property
    def bytes_per_particle(self) -> int:
        """Bytes per particle of the law with the largest particles, including sort buffers."""
        return max(sum(law.fields.values()) for law in self.laws) + self.scratch_bytes

    @property
    def machine_bytes(self) -> int:
        """Bytes of main memory: all except the memory of a CUDA device."""
        return self.host_bytes + (0 if self.arch == "cuda" else self.device_bytes)

    def as_dict(self) -> dict:
        return {
            "particles": self.particles,
            "laws": {law.law: {"particles": law.particles, "bytes_per_particle": law.fields} for law in self.laws},
            "scratch_bytes_per_particle": self.scratch_bytes,
            "nodes": self.nodes,
            "sparse": self.sparse,
            "bytes_per_node": self.bytes_per_node,
            "device_bytes": self.device_bytes,
            "passes": list(self.passes),
        }


def make_plan(scene: Scene | Resolved, backend: Backend) -> Plan:
    """Return the plan of a scene.

    Raises:
        InputError: the scene combines what cannot be combined, or needs what the backend lacks.
    """
    asked = Resolved.of(scene)
    require_possible(asked, backend)
    scene, kind = asked.scene, asked.kind
    with fields_of(backend.precision) as made:
        batch = Batch(kind.padded(), backend)
    device, members = batch.device, kind.members
    grid, real = device.grid, 8 if backend.precision == "f64" else 4
    laws = tuple(
        LawPlan(group.law.name, count if scene.sources else 0, group.bytes_by_name)
        for group, count in zip(device.groups, kind.particles, strict=True)
    )
    rooms = [group.capacity for group in device.groups]
    buffers = [field for field in vars(batch.sort_buffers).values() if isinstance(field, DryField)]
    shown = sum(rooms) * _frame_columns(scene, members)
    return Plan(
        laws=laws,
        nodes=grid.node_count,
        scratch_bytes=sum(field.bytes for field in buffers) // max(rooms),
        bytes_per_node=sum(field.bytes for field in _fields_by_node(grid)) // grid.node_count,
        device_bytes=sum(field.bytes for field in made),
        host_bytes=host_bytes_of(scene, members, sum(law.particles for law in laws), real, on_cpu=backend.on_cpu),
        passes=_passes_of(device),
        arch=backend.arch,
        sparse=grid.sparse,
        entries=max(shown, *(field.length for field in made)),
    )


def _fields_by_node(grid: Grid) -> list[DryField]:
    """Return the fields with an entry for each node, or for each fine node."""
    sums = [] if grid.fixed is None else [*grid.fixed.kept, *([grid.fine.sums] if grid.fine else [])]
    found = [grid.nodes, grid.filling, *grid.means, *([grid.fine.fill] if grid.fine else [])]
    found += [field for each in sums for field in (each.high, each.low)]
    return [field for field in found if field is not None]


def _passes_of(device: Device) -> tuple[str, ...]:
    """Return the loops of one step in words."""
    laws = [group.law.name for group in device.groups]
    return tuple(phase.words.format(laws[phase.group]) for phase in device.phases if phase.words)


def host_bytes_of(scene: Scene, members: Sequence[Law], particles: int, real: int, *, on_cpu: bool) -> int:
    """Return the largest number of bytes of particles on the host: at the start, or while a frame is built and written.

    Python, Taichi and its compiler take about 200 MB more. `real` is the number of bytes of a real number on the
    device.
    """
    d = scene.dimension
    # Double precision: positions, and if they depend on the position, velocities, their gradients and deformations.
    start = 8 * (d + any(map(has_expressions, scene.bodies)) * (d + 2 * d * d))
    columns = _frame_columns(scene, members)
    widths = {"velocity": 0, "initial_position": d, "affine": d * d, "deformation_gradient": d * d, "stress": 9}
    fields = sum(widths.get(name, 1) for name in scene.output.fields)
    # The frame: positions, velocities and fields.
    frame = real * (2 * d + fields) + scene.particle_count_varies
    # The array that is being written: particle numbers, or in 2D a vector or matrix padded to 3D.
    frame += 4 if d == 3 else real * (3 if {"affine", "deformation_gradient"}.isdisjoint(scene.output.fields) else 9)
    if len(scene.sources) > 1:
        frame += 2 * np.dtype(np.int32).itemsize
    if "initial_position" in scene.output.fields:
        frame += real * d
    if not on_cpu:
        # The copied state and its NumPy arrays.
        return particles * (start + frame + 2 * 8 * (2 * d + d * d))
    return particles * max(start, real * columns + frame)


def _frame_columns(scene: Scene, members: Sequence[Law]) -> int:
    """Return how many numbers per particle a frame is built from."""
    internal = max(len(law.internal) for law in members)
    return FrameColumns(
        scene.dimension, internal, scene.output.fields, particle_count_varies=scene.particle_count_varies
    ).count


def require_memory(plan: Plan) -> None:
    """Raise an InputError if a plan exceeds the free memory of this machine or its device, or 32-bit indices."""
    total = plan.machine_bytes
    free = MEMORY_SHARE * psutil.virtual_memory().available
    on_device = free_memory(plan.arch)
    need = f"the scene needs {plan.particles:.3g} particles and {plan.nodes:.3g} grid nodes"
    cure = "use a larger domain.spacing or fewer particles_per_cell"
    if total > free:
        raise InputError(f"{need}, {size_text(total)} of memory, but at most {size_text(free)} may be used; {cure}.")
    if on_device is not None and plan.device_bytes > MEMORY_SHARE * on_device:
        raise InputError(
            f"{need}, {size_text(plan.device_bytes)} of memory on the {plan.arch} device, but at most "
            f"{size_text(MEMORY_SHARE * on_device)} may be used; {cure}."
        )
    if plan.entries > LARGEST_INDEX:
        raise InputError(f"{need}, more than 32-bit indices can address; {cure}.")
