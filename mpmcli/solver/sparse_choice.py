"""Whether a scene's grid is sparse."""

import math

from mpmcli.errors import InputError
from mpmcli.scene import Scene
from mpmcli.scene.sampling import estimate_body
from mpmcli.scene.schema import SolverSettings
from mpmcli.scene.sheets import sheets_of
from mpmcli.solver.backend import Backend

# Cells from which on a grid may be sparse by itself, and then the share of them that material fills at most.
MANY_CELLS, FILLED = 8_000_000, 0.05


def wants_sparse(scene: Scene) -> bool:
    """Return whether the grid of a scene is sparse on the CPU, whatever machine that is."""
    if scene.solver.grid != "auto":
        return scene.solver.grid == "sparse"
    cells = math.prod(scene.domain.cells)
    return cells >= MANY_CELLS and filled_cells(scene) <= FILLED * cells


def filled_cells(scene: Scene) -> float:
    """Return the number of cells that all material of a scene fills at rest."""
    bodies = sum(estimate_body(body, scene.domain.spacing) / body.particles_per_cell for body in scene.bodies)
    return bodies + sum(sheets_of(emitter, scene).particles / emitter.particles_per_cell for emitter in scene.emitters)


def require_cpu_if_sparse(settings: SolverSettings, backend: Backend) -> None:
    """Refuse a sparse grid on a GPU.

    Raises:
        InputError: the settings ask for one there.
    """
    if settings.grid == "sparse" and not backend.on_cpu:
        raise InputError('solver.grid = "sparse" is for the CPU; give "auto" or "dense", or --arch cpu.')
