"""What a scene will take, known before anything is allocated."""

from collections import Counter
from dataclasses import dataclass

import psutil

from mpmcli.errors import InputError
from mpmcli.materials.registry import laws
from mpmcli.scene import Scene, estimate_particles
from mpmcli.solver.backend import Backend
from mpmcli.solver.grid import Grid, node_width
from mpmcli.solver.ordering import TileOrder

# Taichi addresses fields with 32-bit integers, and a particle has at most 3 x 4 numbers in one field.
LARGEST_INDEX = 2**31 - 1
WIDEST_FIELD = 12
# Share of the free memory that a run may plan for.
MEMORY_SHARE = 0.8


@dataclass(frozen=True)
class Plan:
    """Memory of a run.

    Attributes:
        particles: number of particles (an estimate for curved shapes before sampling).
        nodes: number of grid nodes.
        bytes_per_particle: of the device, sort buffers included; the largest over the laws.
        bytes_per_node: of the grid.
        grid_bytes: of all nodes and the tables of the sort.
        host_bytes: of the arrays of one frame and of the initial state.
    """

    particles: int
    nodes: int
    bytes_per_particle: int
    bytes_per_node: int
    grid_bytes: int
    host_bytes: int

    @property
    def device_bytes(self) -> int:
        """Bytes on the device."""
        return self.particles * self.bytes_per_particle + self.grid_bytes


def bytes_per_particle(deformation: str, dimension: int, backend: Backend, *, several_bodies: bool) -> int:
    """Return the device bytes of one particle of a law that stores `deformation`, sort buffers included."""
    real = 8 if backend.precision == "f64" else 4
    width = node_width(dimension, on_cpu=True) if backend.on_cpu else dimension
    gradient = dimension * width
    state = dimension + width + gradient + (1 if deformation == "J" else dimension * width)
    labels = 2 if several_bodies else 1
    return (state + gradient) * real + 4 * labels + 8


def make_plan(scene: Scene, backend: Backend) -> Plan:
    """Return the memory that a scene needs."""
    dimension = scene.dimension
    cells = scene.domain.cells
    real = 8 if backend.precision == "f64" else 4
    width = node_width(dimension, on_cpu=backend.on_cpu)
    particles = estimate_particles(scene)
    by_law = Counter(body.material.law for body in scene.bodies)
    per_particle = max(
        bytes_per_particle(laws()[law].deformation, dimension, backend, several_bodies=count > 1)
        for law, count in by_law.items()
    )
    nodes = Grid.nodes_needed(cells)
    tables = len(by_law) * TileOrder.bytes_needed(cells, backend.threads)
    # Twice a particle's state in double precision: the initial state, and a frame with what it is made from.
    host_bytes = 2 * particles * 8 * (2 * dimension + dimension**2)
    return Plan(particles, nodes, per_particle, real * width, nodes * real * width + tables, host_bytes)


def require_room(plan: Plan) -> None:
    """Refuse a plan that cannot be carried out.

    Raises:
        InputError: it takes more memory than this machine has free, or more than 32-bit indices reach.
    """
    total = plan.device_bytes + plan.host_bytes
    free = MEMORY_SHARE * psutil.virtual_memory().available
    need = f"the scene needs {plan.particles:.3g} particles and {plan.nodes:.3g} grid nodes"
    cure = "a larger domain.spacing or fewer particles_per_cell needs less"
    if total > free:
        raise InputError(f"{need}, {_size(total)} of memory, and {_size(free)} may be used here; {cure}.")
    # The widest field of the sort is addressed by one index.
    if max(plan.nodes, plan.particles * WIDEST_FIELD) > LARGEST_INDEX:
        raise InputError(f"{need}, more than 32-bit indices can address; {cure}.")


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"
