"""Memory, passes and time of a scene, computed before anything is allocated.

Array sizes are rounded to few values, because they are part of compiled kernels: other scenes then reuse cached
kernels. CPU times of the compilation and of a step follow from a table of measurements on one machine
(`scripts/measure_costs`). The table determines which of Taichi's optimisations pay off, which depends only on ratios,
and predicts the time of a run to a factor of two.
"""

import math
import tomllib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import psutil

from mpmcli.boundaries.colliders import ColliderKind
from mpmcli.boundaries.loads import Loads
from mpmcli.boundaries.walls import rough_faces
from mpmcli.errors import InputError
from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.plain_text import size_text
from mpmcli.scene import Scene
from mpmcli.scene.sampling import count_body, estimate_body, has_expressions
from mpmcli.scene.sheets import sheets_of
from mpmcli.solver.contact.body_contact import BodyContact
from mpmcli.solver.contact.collider_points import ColliderPoints
from mpmcli.solver.contact.layers import Layers, require_contact_possible, touched
from mpmcli.solver.contact.surfaces import BodySurfaces
from mpmcli.solver.contact.total_solids import ParticleContact, bins_along, slips_in
from mpmcli.solver.drive.forces import forces_on, names_of, needs_initial
from mpmcli.solver.engine.step import step_phases
from mpmcli.solver.frames.columns import FrameColumns
from mpmcli.solver.grid.fixed_point import FixedPoint
from mpmcli.solver.grid.grid import Grid, node_width, tile_edge
from mpmcli.solver.grid.sparse_grid import SparseGrid, require_cpu_if_sparse, room_for_blocks, wants_sparse
from mpmcli.solver.machine.backend import LARGEST_INDEX, MEMORY_SHARE, Backend, Optimisation, free_memory
from mpmcli.solver.particles.arrays import particle_fields
from mpmcli.solver.particles.sort import TileOrder
from mpmcli.solver.transfer.kept_motion import keeps_motion
from mpmcli.solver.transfer.redistribution import fine_nodes
from mpmcli.solver.transfer.splines import scheme_of
from mpmcli.solver.transfer.volume import averages_volume, levels_volume, needs_filling

# Smallest numbers of entries and of colliders for which arrays have space.
FEWEST, FEWEST_COLLIDERS = 1024, 4
# Up to FEW_CELLS cells along an axis, their number is a multiple of FEW_TIMES in 2D and 3D; above, at least of CELLS.
FEW_CELLS, FEW_TIMES, CELLS = 64, {2: 64, 3: 8}, 4
# Entries added to larger sizes, which are multiples of powers of two: consecutive arrays of such sizes would begin in
# the same cache set, and steps in 2D take a fifth longer.
SKEW = 336


def power_of_two(count: int) -> int:
    """Return the next power of two, at least 1."""
    return 1 << max(0, count - 1).bit_length()


def in_steps(count: int) -> int:
    """Return the padded number of entries, in eighths of a power of two; at least `FEWEST`, or 0 for 0."""
    if count > FEWEST:
        return _multiple(count - SKEW, power_of_two(count - SKEW) // 16) + SKEW
    return FEWEST if count else 0


def padded_cells(cells: Sequence[int]) -> tuple[int, ...]:
    """Return the padded cells per axis of a dense grid, in sixteenths of a power of two above 64."""
    few = FEW_TIMES[len(cells)]
    return tuple(_multiple(n, few if n <= FEW_CELLS else max(CELLS, power_of_two(n) // 32)) for n in cells)


def padded_colliders(kind: ColliderKind) -> ColliderKind:
    count = max(FEWEST_COLLIDERS, power_of_two(kind.count)) if kind.count else 0
    sizes = {name: in_steps(getattr(kind, name)) for name in ("numbers", "samples", "points")}
    return replace(kind, count=count, **sizes)


def _multiple(count: int, step: int) -> int:
    return -(-count // max(1, step)) * max(1, step)


TABLE = Path(__file__).with_name("costs.toml")
# Seconds of compilation shared by all laws.
SHARED = 1.0
# Exponent of the speed-up by threads. Particles per thread from which a thread is useful.
WORTH, WORTH_A_THREAD = 0.9, 2_500


@dataclass(frozen=True)
class Cost:
    """Seconds of the compilation, and of a step on one thread."""

    compile: float
    step: float

    def step_on(self, threads: int) -> float:
        """Return the seconds of a step on a number of threads."""
        return self.step / threads**WORTH

    def seconds(self, steps: int, threads: int) -> float:
        """Return the seconds of a number of steps, including compilation."""
        return self.compile + steps * self.step_on(threads)


@cache
def _table() -> dict:
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


def cost_of(scene: Scene, optimisation: Optimisation) -> Cost:
    """Return the cost of a scene at a level of optimisation; a plugin law costs as much as the most expensive law."""
    table, axis, h = _table(), scene.dimension - 2, scene.domain.spacing
    how = "few" if optimisation == "few" else "most"
    known = {law: entry[how][axis] for law, entry in table["laws"].items()}
    costs = {s.material.law: known.get(s.material.law, max(known.values())) for s in scene.sources}
    seconds = SHARED + sum(compiling - SHARED for compiling, _ in costs.values())
    counts = [estimate_body(body, h) for body in scene.bodies]
    counts += [sheets_of(emitter, scene).particles for emitter in scene.emitters]
    step = 1e-9 * sum(n * costs[s.material.law][1] for s, n in zip(scene.sources, counts, strict=True))
    beside = {
        "colliders": any(not collider.free for collider in scene.colliders),
        "rigid": any(collider.free for collider in scene.colliders),
        "emitters": bool(scene.emitters),
        "separate": Layers.of(scene).separate,
    }
    for name in (name for name, there in beside.items() if there):
        more, factor = table["beside"][name][axis]
        seconds, step = seconds + more, step * factor
    if scene.solver.kernel == "cubic":
        step *= (4 / 3) ** scene.dimension
    return Cost(seconds, step)


def useful_threads(particles: int, threads: int) -> int:
    """Return how many of these threads are useful to a run with this number of particles."""
    return min(threads, max(1, particles // WORTH_A_THREAD))


def cheapest(scene: Scene, steps: int, threads: int) -> Optimisation:
    """Return the level of optimisation with the shortest total time of a run with this number of steps."""
    return min(("few", "most"), key=lambda how: cost_of(scene, how).seconds(steps, threads))


def host_bytes_of(scene: Scene, members: Sequence[Law], particles: int, real: int, *, on_cpu: bool) -> int:
    """Return the largest number of bytes of particles on the host: at the start, or while a frame is built and written.

    Python, Taichi and its compiler take about 200 MB more. `real` is the number of bytes of a real number on the
    device.
    """
    d = scene.dimension
    # Double precision: positions, and if they depend on the position, velocities, their gradients and deformations.
    start = 8 * (d + any(map(has_expressions, scene.bodies)) * (d + 2 * d * d))
    columns = frame_columns(scene, members)
    widths = {"velocity": 0, "initial_position": d, "affine": d * d, "deformation_gradient": d * d, "stress": 9}
    fields = sum(widths.get(name, 1) for name in scene.output.fields)
    # The frame: positions, velocities and fields.
    frame = real * (2 * d + fields) + scene.comes_and_goes
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


def frame_columns(scene: Scene, members: Sequence[Law]) -> int:
    """Return how many numbers per particle a frame is built from."""
    internal = max(len(law.internal) for law in members)
    return FrameColumns(scene.dimension, internal, scene.output.fields, comes_and_goes=scene.comes_and_goes).count


# Names of the phases of every step in messages; the phases that relax volumes, which run in some steps only, are left
# out.
WORDS = {
    "clear": "clear grid",
    "average": "average volumes of {}",
    "scatter": "scatter {}",
    "to_float": "read sums in fixed point",
    "find_bodies": "find bodies that meet",
    "exchange": "let bodies push each other",
    "find_contact": "find contact",
    "find_friction": "find friction",
    "find_points": "find points of colliders",
    "weigh_points": "find impulses of colliders",
    "push_points": "let colliders push",
    "meet": "meet rigid bodies",
    "move_bodies": "move rigid bodies",
    "add_loads": "add up loads",
    "advance": "gather {}",
}


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
        entries: entries of the longest array addressed by one index: particle data of a frame or of the sort, counts
            per tile and thread, nodes, fine nodes, or bins of colliding bodies.
        scratch_bytes: bytes of the sort buffers per particle.
        grid_bytes: bytes of all nodes, of the tables of the sort, and of the data for walls and colliders.
        host_bytes: see `host_bytes_of`.
        passes: loops of a step in order; loops over particles contain the name of their law.
    """

    laws: tuple[LawPlan, ...]
    nodes: int
    scratch_bytes: int
    bytes_per_node: int
    grid_bytes: int
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
    def device_bytes(self) -> int:
        """Bytes on the device; the sort buffers have the size of the largest group."""
        rooms = [in_steps(law.particles) for law in self.laws]
        state = sum(room * sum(law.fields.values()) for law, room in zip(self.laws, rooms, strict=True))
        return state + max(rooms) * self.scratch_bytes + self.grid_bytes

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


def bytes_of_fields(law: type[Law], dimension: int, precision: str, **asked: bool) -> dict[str, int]:
    """Return the bytes of each field of one particle of a law, by name; for `asked` see `particle_fields`."""
    real, internal = 8 if precision == "f64" else 4, law.parameters.internal_in(dimension)
    fields = particle_fields(law.deformation, [v.name for v in internal], dimension, precision, **asked)
    return {name: rows * columns * (real if kind is float else 4) for name, (kind, rows, columns) in fields.items()}


def passes_of(members: Sequence[Law], scene: Scene, *, deterministic: bool = False) -> tuple[str, ...]:
    """Return the loops of one step; `deterministic` is whether P2G is in fixed point."""
    layers = Layers.of(scene)
    phases = step_phases(
        members,
        [averages_volume(scene.solver, law) or levels_volume(scene.solver, law) for law in members],
        [levels_volume(scene.solver, law) for law in members],
        contact=layers.shares and bool(_separating_axes(scene)),
        friction=bool(_rough_axes(scene)),
        deterministic=deterministic,
        loads=deterministic and bool(scene.colliders),
        separates=layers.separate,
        rigid=any(collider.free for collider in scene.colliders),
        points=touched(scene, layers),
    )
    forces = [" with forces" * bool(forces_on(scene, names_of(scene, members_of(scene, law.name)))) for law in members]
    words = WORDS | {"update": "update grid" + " with colliders" * bool(scene.colliders)}
    return tuple(
        words[phase.name].format(members[phase.group].name) + forces[phase.group] * (phase.name == "scatter")
        for phase in phases
        if phase.name in words
    )


def members_of(scene: Scene, law: str) -> list[int]:
    return [i for i, body in enumerate(scene.sources) if body.material.law == law]


def law_objects(scene: Scene) -> tuple[Law, ...]:
    """Return the laws of a scene; without material one of any parameters, which no particle has."""
    materials = [[scene.sources[i].material for i in members_of(scene, name)] for name in scene.laws]
    if not scene.sources:
        materials = [[laws()[name].parameters(density=1.0, youngs_modulus=1.0) for name in scene.laws]]
    return tuple(laws()[name](own, scene.dimension) for name, own in zip(scene.laws, materials, strict=True))


def make_plan(scene: Scene, backend: Backend) -> Plan:
    dimension = scene.dimension
    sparse = wants_sparse(scene) and backend.on_cpu
    cells = scene.domain.cells if sparse else padded_cells(scene.domain.cells)
    real = 8 if backend.precision == "f64" else 4
    width = node_width(dimension, on_cpu=backend.on_cpu)
    bodies = Counter(body.material.law for body in scene.sources)
    counts = Counter(dict.fromkeys(scene.laws, 0))
    for index, body in enumerate(scene.bodies):
        counts[body.material.law] += count_body(body, index, scene.domain.spacing)
    for emitter in scene.emitters:
        counts[emitter.material.law] += sheets_of(emitter, scene).particles
    members = law_objects(scene)
    averaged = [averages_volume(scene.solver, law) for law in members]
    summed = sum(averaged) + sum(levels_volume(scene.solver, law) for law in members)
    require_contact_possible(scene, backend)
    _require_rigid_possible(scene)
    fields_of = Layers.of(scene)
    separate, layers, pairs = fields_of.separate, fields_of.count, fields_of.pairs
    groups = tuple(
        LawPlan(
            name,
            counts[name],
            bytes_of_fields(
                laws()[name],
                dimension,
                backend.precision,
                many_bodies=bodies[name] > 1,
                keeps_initial=scene.solver.solids == "total"
                or needs_initial(scene, names_of(scene, members_of(scene, name))),
                uses_f_bar=shares,
                levels=levels_volume(scene.solver, member),
                total=scene.solver.solids == "total",
                has_wall_friction=slips_in(scene.solver, rough_faces(scene)),
                comes_and_goes=scene.comes_and_goes,
                surfaced=separate and member.surfaced,
            ),
        )
        for name, member, shares in zip(scene.laws, members, averaged, strict=True)
    )
    # The widest field is a matrix; sources and keys are integers.
    widest = max(size for group in groups for size in group.fields.values())
    scheme = scheme_of(scene.solver, keeps_flip_velocity=keeps_motion(scene, members))
    tile = tile_edge(scheme.spline.nodes, dimension, on_cpu=backend.on_cpu)
    all_nodes = nodes = Grid.nodes_needed(cells, tile)
    require_cpu_if_sparse(scene.solver, backend)
    if sparse:
        blocks = room_for_blocks(sum(map(in_steps, counts.values())))
        nodes = blocks * tile**dimension
    filling, deterministic = needs_filling(scene, members, fields_of), scene.solver.deterministic and not backend.on_cpu
    numbers = layers * width * (1 + scheme.keeps_flip_velocity + filling)
    node_bytes = real * (numbers + layers * 4 * summed)
    # 0 without shifts.
    fine = fine_nodes(scene, members) ** dimension
    node_bytes += real * fine
    if deterministic:
        node_bytes += FixedPoint.bytes_needed(numbers, summed) + FixedPoint.bytes_needed(1, 0) * fine
        # The fixed-point means replace the floating-point ones.
        node_bytes -= real * 4 * summed
    all_tiles, bins = all_nodes // tile**dimension, 0
    tables = len(groups) * TileOrder.bytes_needed(blocks if sparse else all_tiles, backend.threads)
    if sparse:
        tables += SparseGrid.table_bytes(all_tiles, blocks, dimension)
    surfaced = [in_steps(counts[law.name]) for law in members if separate and law.surfaced]
    if surfaced:
        shown_bytes = real * (2 * dimension + 1)
        tables += BodySurfaces.bytes_needed(nodes, all_tiles, surfaced, shown_bytes, on_cpu=backend.on_cpu)
        if not backend.on_cpu:
            tables += BodyContact.gpu_bytes(scheme.spline.nodes, fields_of, dimension, real)
    tables += layers * _contact_bytes(scene, all_nodes, tile, Grid.tile_counts(cells, tile), real)
    if scene.solver.solids == "total" and len(scene.sources) > 1:
        tables += ParticleContact.bytes_needed(cells, sum(map(in_steps, counts.values())))
        bins = 2 * math.prod(bins_along(cells))
    rows = all_nodes // (tile * Grid.tile_counts(cells, tile)[-1])
    tables += Loads.bytes_needed(max(1, pairs), dimension, rows) if separate else 0
    at_rest = scene.solver.solids == "total"
    tables += padded_colliders(ColliderKind.of(scene)).bytes_needed(dimension, rows, real, at_rest=at_rest)
    met = touched(scene, fields_of)
    tables += ColliderPoints.bytes_needed(nodes, rows, dimension, real) if met else 0
    if deterministic:
        tables += nodes * padded_colliders(ColliderKind.of(scene)).count * dimension * real
    host_bytes = host_bytes_of(scene, members, sum(counts.values()), real, on_cpu=backend.on_cpu)
    passes = passes_of(members, scene, deterministic=deterministic)
    grid_bytes = nodes * node_bytes + tables
    shown = sum(map(in_steps, counts.values())) * frame_columns(scene, members)
    sorted_entries = max(map(in_steps, counts.values())) * max(len(groups), widest // real)
    counted = (blocks if sparse else all_tiles) * backend.threads
    weights = ColliderPoints.room(nodes, dimension) * 3**dimension if met else 0
    entries = max(nodes * max(fine, layers), weights, all_tiles, bins, shown, sorted_entries, counted)
    return Plan(groups, nodes, widest + 8, node_bytes, grid_bytes, host_bytes, passes, backend.arch, sparse, entries)


def _require_rigid_possible(scene: Scene) -> None:
    """Raise an error for a scene that combines freely moving colliders with an unsupported feature.

    Raises:
        InputError: names the feature.
    """
    domain = scene.domain
    reasons = {
        "in a domain with periodic walls": any(domain.periodic),
        "with moving walls": bool(domain.wall_velocity),
        "with separating bodies": Layers.of(scene).separate,
    }
    for reason, applies in reasons.items():
        if applies and any(collider.free for collider in scene.colliders):
            raise InputError(f"colliders with a density are not available {reason}; omit their density.")


def _separating_axes(scene: Scene) -> list[int]:
    """Return the axis of each separating face of the grid, which needs contact flags."""
    if scene.solver.solids == "total":
        return []
    faces = scene.domain.walls.faces(scene.dimension)
    return [axis for axis, pair in enumerate(faces) for wall in pair if wall == "separate"]


def _rough_axes(scene: Scene) -> list[int]:
    """Return the axis of each face of the grid with friction."""
    total, faces = scene.solver.solids == "total", scene.domain.walls.faces(scene.dimension)
    return [axis for axis, side in rough_faces(scene) if not (total and faces[axis][side] == "separate")]


def _contact_bytes(scene: Scene, nodes: int, tile: int, tiles: Sequence[int], real: int) -> int:
    """Return the bytes of data at walls: an integer per node of a separating plane, a vector per node with friction."""
    separating, rough = (
        [nodes // (tile * tiles[axis]) for axis in axes] for axes in (_separating_axes(scene), _rough_axes(scene))
    )
    contact = 4 * len(separating) * max(separating, default=0)
    return contact + real * scene.dimension * len(rough) * max(rough, default=0)


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
