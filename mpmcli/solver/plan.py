"""Memory and passes that a scene needs, known before anything is allocated."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import psutil

from mpmcli.boundaries.collider_kind import ColliderKind
from mpmcli.boundaries.rough_faces import rough_faces
from mpmcli.errors import InputError
from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.plain_text import size_text
from mpmcli.scene import Scene
from mpmcli.scene.sampling import estimate_body
from mpmcli.scene.sheets import sheets_of
from mpmcli.solver.backend import Backend
from mpmcli.solver.device_memory import LARGEST_INDEX, MEMORY_SHARE, free_memory
from mpmcli.solver.fixed_point import FixedPoint
from mpmcli.solver.forces import forces_on, needs_initial
from mpmcli.solver.grid import Grid, node_width, tile_edge
from mpmcli.solver.host_memory import host_bytes_of
from mpmcli.solver.ordering import TileOrder
from mpmcli.solver.particle_arrays import gradient_width
from mpmcli.solver.particle_contact import ParticleContact, bins_along
from mpmcli.solver.particle_friction import slips_in
from mpmcli.solver.sparse_choice import require_cpu_if_sparse, wants_sparse
from mpmcli.solver.sparse_grid import SparseGrid, room_for_blocks
from mpmcli.solver.transfer_scheme import scheme_of
from mpmcli.solver.volume_average import averages_volume
from mpmcli.solver.volume_relaxation import needs_filling

# A particle has at most 3 x 4 numbers in one field.
WIDEST_FIELD = 12


@dataclass(frozen=True)
class LawPlan:
    """Memory of the particles of one law.

    Attributes:
        law: its name.
        particles: number of them (an estimate for curved shapes before sampling).
        fields: bytes of each field per particle, by name.
    """

    law: str
    particles: int
    fields: dict[str, int]


@dataclass(frozen=True)
class Plan:
    """Memory of a run, and the passes of its time step.

    Attributes:
        laws: the particles, law by law.
        nodes: number of grid nodes, on a sparse grid those that there is memory for at first.
        sparse: whether the grid is.
        tiles: number of tiles of the domain, and of bins of bodies that meet.
        scratch_bytes: per particle, of the sort buffers.
        bytes_per_node: of the grid.
        grid_bytes: of all nodes, the tables of the sort, what is found at walls, and what colliders need.
        host_bytes: of a frame and what it is made of, or of the initial state, see `host_bytes_of`.
        passes: the loops of a step in order; loops over particles name their law.
        arch: the backend.
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
    tiles: int = 0

    @property
    def particles(self) -> int:
        """Number of particles."""
        return sum(law.particles for law in self.laws)

    @property
    def bytes_per_particle(self) -> int:
        """Bytes of a particle of the law that takes most, sort buffers included."""
        return max(sum(law.fields.values()) for law in self.laws) + self.scratch_bytes

    @property
    def device_bytes(self) -> int:
        """Bytes on the device; the sort buffers hold the largest group."""
        state = sum(law.particles * sum(law.fields.values()) for law in self.laws)
        return state + max(law.particles for law in self.laws) * self.scratch_bytes + self.grid_bytes

    @property
    def machine_bytes(self) -> int:
        """Bytes of the machine's own memory: all but those that a CUDA device has itself."""
        return self.host_bytes + (0 if self.arch == "cuda" else self.device_bytes)

    def as_dict(self) -> dict:
        """Return all of it as JSON can hold it."""
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


def fields_of(
    law: type[Law],
    dimension: int,
    backend: Backend,
    *,
    several_bodies: bool,
    keeps_initial: bool = False,
    averaged: bool = False,
    slips: bool = False,
    comes_and_goes: bool = False,
) -> dict[str, int]:
    """Return the bytes of each field of one particle of a law, by name."""
    real = 8 if backend.precision == "f64" else 4
    matrix = dimension * dimension * real
    fields = {"position": dimension * real, "velocity": dimension * real}
    fields["velocity_gradient"] = dimension * real * gradient_width(dimension, backend.precision)
    if law.deformation == "F":
        fields["deformation_gradient"] = matrix
    else:
        fields["volume_ratio"] = real
    fields |= {variable.name: real for variable in law.parameters.internal_in(dimension)}
    fields |= {"initial_position": dimension * real} if keeps_initial else {}
    fields |= {"volume_to_mean": real, "cell": 4} if averaged else {}
    fields |= {"slip": dimension * real} if slips else {}
    fields |= {"id": 4} | ({"body": 4} if several_bodies else {})
    return fields | ({"activity": 4} if comes_and_goes else {})


def passes_of(members: Sequence[Law], scene: Scene, *, deterministic: bool = False) -> tuple[str, ...]:
    """Return the loops of one step: the particles of each law, and the grid.

    Args:
        deterministic: whether P2G is in fixed point.
    """
    names = [law.name for law in members]
    separate = bool(_separating_axes(scene))
    rough = scene.solver.walls != "zeroed" and bool(_rough_axes(scene))
    pushed = {name for name in names if forces_on(scene, members_of(scene, name))}
    return (
        "clear grid",
        *(f"average volumes of {law.name}" for law in members if averages_volume(scene.solver, law)),
        *(f"scatter {name}" + (" with forces" if name in pushed else "") for name in names),
        *(("read sums in fixed point",) if deterministic else ()),
        *(("find contact",) if separate else ()),
        *(("find friction",) if rough else ()),
        "update grid" + (" with colliders" if scene.colliders else ""),
        *(("add up loads",) if deterministic and scene.colliders else ()),
        *(f"gather {name}" for name in names),
    )


def members_of(scene: Scene, law: str) -> list[int]:
    """Return the indices of the bodies that follow a law."""
    return [i for i, body in enumerate(scene.sources) if body.material.law == law]


def make_plan(scene: Scene, backend: Backend) -> Plan:
    """Return the plan of a scene."""
    dimension = scene.dimension
    cells = scene.domain.cells
    real = 8 if backend.precision == "f64" else 4
    width = node_width(dimension, on_cpu=backend.on_cpu)
    bodies = Counter(body.material.law for body in scene.sources)
    counts = Counter[str]()
    for body in scene.bodies:
        counts[body.material.law] += estimate_body(body, scene.domain.spacing)
    for emitter in scene.emitters:
        counts[emitter.material.law] += sheets_of(emitter, scene).particles
    members = [
        laws()[name]([scene.sources[i].material for i in members_of(scene, name)], dimension) for name in sorted(bodies)
    ]
    averaged = [averages_volume(scene.solver, law) for law in members]
    groups = tuple(
        LawPlan(
            name,
            counts[name],
            fields_of(
                laws()[name],
                dimension,
                backend,
                several_bodies=bodies[name] > 1,
                keeps_initial=scene.solver.solids == "total" or needs_initial(scene, members_of(scene, name)),
                averaged=shares,
                slips=slips_in(scene.solver, rough_faces(scene)),
                comes_and_goes=scene.comes_and_goes,
            ),
        )
        for name, shares in zip(sorted(bodies), averaged, strict=True)
    )
    # The widest field is a matrix; sources and keys are integers.
    widest = max(size for group in groups for size in group.fields.values())
    scheme = scheme_of(scene.solver)
    tile = tile_edge(scheme.spline.nodes, dimension, on_cpu=backend.on_cpu)
    all_nodes = nodes = Grid.nodes_needed(cells, tile)
    sparse = wants_sparse(scene) and backend.on_cpu
    require_cpu_if_sparse(scene.solver, backend)
    if sparse:
        blocks = room_for_blocks(sum(counts.values()))
        nodes = blocks * tile**dimension
    filling, deterministic = needs_filling(scene, members), scene.solver.deterministic and not backend.on_cpu
    node_bytes = real * (width * (1 + scheme.keeps_before + filling) + 2 * sum(averaged))
    if deterministic:
        node_bytes += FixedPoint.bytes_needed(
            width, before=scheme.keeps_before, filling=filling, averaged=sum(averaged)
        )
        # In their place.
        node_bytes -= real * 2 * sum(averaged)
    all_tiles = all_nodes // tile**dimension
    tables = len(groups) * TileOrder.bytes_needed(blocks if sparse else all_tiles, backend.threads)
    if sparse:
        tables += SparseGrid.table_bytes(all_tiles, blocks, dimension)
    tables += _contact_bytes(scene, all_nodes, tile, real)
    if scene.solver.solids == "total" and len(scene.sources) > 1:
        tables += ParticleContact.bytes_needed(cells, sum(counts.values()))
        all_tiles = max(all_tiles, 2 * math.prod(bins_along(cells)))
    tables += ColliderKind.of(scene).bytes_needed(dimension, all_nodes // (tile * Grid.tile_counts(cells, tile)[-1]))
    if deterministic:
        tables += nodes * len(scene.colliders) * dimension * real
    host_bytes = host_bytes_of(scene, members, sum(counts.values()), real, on_cpu=backend.on_cpu)
    passes = passes_of(members, scene, deterministic=deterministic)
    grid_bytes = nodes * node_bytes + tables
    return Plan(groups, nodes, widest + 8, node_bytes, grid_bytes, host_bytes, passes, backend.arch, sparse, all_tiles)


def _separating_axes(scene: Scene) -> list[int]:
    """Return the axis of every face that needs contact flags: separating ones of the grid, unless walls are zeroed."""
    if scene.solver.walls == "zeroed" or scene.solver.solids == "total":
        return []
    faces = scene.domain.walls.faces(scene.dimension)
    return [axis for axis, pair in enumerate(faces) for wall in pair if wall == "separate"]


def _rough_axes(scene: Scene) -> list[int]:
    """Return the axis of every face of the grid that has friction, unless walls are zeroed."""
    if scene.solver.walls == "zeroed":
        return []
    total, faces = scene.solver.solids == "total", scene.domain.walls.faces(scene.dimension)
    return [axis for axis, side in rough_faces(scene) if not (total and faces[axis][side] == "separate")]


def _contact_bytes(scene: Scene, nodes: int, tile: int, real: int) -> int:
    """Return the bytes of what is found at walls, per face and node of the largest plane of its kind.

    Those of separating walls have an integer, those with friction a vector.
    """
    tiles = Grid.tile_counts(scene.domain.cells, tile)
    separating, rough = (
        [nodes // (tile * tiles[axis]) for axis in axes] for axes in (_separating_axes(scene), _rough_axes(scene))
    )
    contact = 4 * len(separating) * max(separating, default=0)
    return contact + real * scene.dimension * len(rough) * max(rough, default=0)


def require_room(plan: Plan) -> None:
    """Refuse a plan that does not fit this machine.

    Raises:
        InputError: it takes more memory than this machine or its device has free, or more than 32-bit indices reach.
    """
    total = plan.machine_bytes
    free = MEMORY_SHARE * psutil.virtual_memory().available
    on_device = free_memory(plan.arch)
    need = f"the scene needs {plan.particles:.3g} particles and {plan.nodes:.3g} grid nodes"
    cure = "a larger domain.spacing or fewer particles_per_cell needs less"
    if total > free:
        raise InputError(f"{need}, {size_text(total)} of memory, and {size_text(free)} may be used here; {cure}.")
    if on_device is not None and plan.device_bytes > MEMORY_SHARE * on_device:
        raise InputError(
            f"{need}, {size_text(plan.device_bytes)} of memory on the {plan.arch} device, and "
            f"{size_text(MEMORY_SHARE * on_device)} may be used there; {cure}."
        )
    # The widest field of the sort is addressed by one index.
    if max(plan.nodes, plan.particles * WIDEST_FIELD, plan.tiles) > LARGEST_INDEX:
        raise InputError(f"{need}, more than 32-bit indices can address; {cure}.")
