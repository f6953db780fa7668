"""Builds what acts at the faces of a domain, as the settings of the solver ask for it."""

from collections.abc import Sequence

from mpmcli.boundaries.mirror_images import MirrorImages
from mpmcli.boundaries.moving_faces import MovingFaces
from mpmcli.boundaries.rough_faces import RoughFaces
from mpmcli.boundaries.walls import Walls, faces_on_grid
from mpmcli.boundaries.zeroed_walls import ZeroedWalls
from mpmcli.scene import SolverSettings
from mpmcli.scene.wall_rules import PERIODIC


def build_walls(
    faces: Sequence[tuple[str, str]],
    settings: SolverSettings,
    first: int,
    cells: Sequence[int],
    shape: Sequence[int],
    on_node: float,
    friction: RoughFaces,
    moving: MovingFaces,
    runs: int = 1,
    *,
    on_cpu: bool,
) -> tuple[Walls | ZeroedWalls, MirrorImages | None]:
    """Return the boundary, and the images of nodes behind it, None where there are none.

    Args:
        faces: words of the walls, per axis.
        first: index of the wall's node plane at the lower faces; cells: of the domain; shape: nodes of the grid, per
            axis.
        on_node: weight of a node for a point on it.
        friction, moving: coefficients and velocities of all runs.
        on_cpu: whether nodes are updated on the CPU.
    """
    mirroring = faces_on_grid(faces, settings)
    if settings.walls != "zeroed":
        walls = Walls(mirroring, first, cells, shape, runs, friction, moving)
        return walls, MirrorImages(walls, on_node, on_cpu=on_cpu)
    zeroed = ZeroedWalls(faces, first, cells, friction, moving)
    if not any(PERIODIC in pair for pair in faces):
        return zeroed, None
    return zeroed, MirrorImages(Walls(mirroring, first, cells, shape, runs), on_node, on_cpu=on_cpu)
