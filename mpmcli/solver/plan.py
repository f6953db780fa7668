"""What a scene will take, known before anything is allocated."""

from dataclasses import dataclass

import psutil

from mpmcli.errors import InputError
from mpmcli.materials.registry import laws
from mpmcli.scene import Scene, estimate_particles
from mpmcli.solver.backend import Backend
from mpmcli.solver.grid import PAD, TILE, Grid, node_width

# Taichi counts particles and nodes with 32-bit integers.
MOST_PARTICLES = 2**31 - 1
# Share of the free memory that a run may plan for.
MEMORY_SHARE = 0.8


@dataclass(frozen=True)
class Plan:
    """Memory of a run.

    Attributes:
        particles: number of particles (an estimate for curved shapes before sampling).
        bytes_per_particle: of the device, sort buffers included; the largest over the laws.
        bytes_per_node: of the grid.
        grid_bytes: of all nodes and the tables of the sort.
        host_bytes: of the arrays of one frame and of the initial state.
    """

    particles: int
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
    state = dimension + width + gradient + (1 if deformation == "J" else dimension**2)
    labels = 2 if several_bodies else 1
    return (state + gradient) * real + 4 * labels + 8


def make_plan(scene: Scene, backend: Backend) -> Plan:
    """Return the memory that a scene needs.

    Raises:
        InputError: it is more than this machine has free.
    """
    dimension = scene.dimension
    real = 8 if backend.precision == "f64" else 4
    width = node_width(dimension, on_cpu=backend.on_cpu)
    particles = estimate_particles(scene)
    by_law: dict[str, int] = {}
    for body in scene.bodies:
        by_law[body.material.law] = by_law.get(body.material.law, 0) + 1
    per_particle = max(
        bytes_per_particle(laws()[law].deformation, dimension, backend, several_bodies=count > 1)
        for law, count in by_law.items()
    )
    tiles = 1
    for n in scene.domain.cells:
        tiles *= -(-(n + 1 + 2 * PAD) // TILE)
    grid_bytes = Grid.bytes_needed(scene.domain.cells, width, real) + 4 * tiles * (backend.threads + 1) * len(by_law)
    state_bytes = 8 * (2 * dimension + dimension**2)
    plan = Plan(particles, per_particle, real * width, grid_bytes, particles * 2 * state_bytes)
    total = plan.device_bytes + plan.host_bytes
    free = psutil.virtual_memory().available
    if total > MEMORY_SHARE * free or particles > MOST_PARTICLES:
        raise InputError(
            f"the scene needs {particles:.3g} particles and {tiles * TILE**dimension:.3g} grid nodes, "
            f"{_size(total)} of memory, and {_size(MEMORY_SHARE * free)} may be used here; a larger domain.spacing "
            "or fewer particles_per_cell needs less."
        )
    return plan


def _size(count: float) -> str:
    for unit in ("B", "kB", "MB", "GB", "TB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} PB"
