"""The faces of the domain that move along themselves, and their velocities (docs/theory.md, 3.7)."""

from collections.abc import Sequence

import taichi as ti

from mpmcli.scene import Scene


def moving_faces(scene: Scene) -> tuple[tuple[int, int], ...]:
    """Return (axis, side) of every face of a scene that moves."""
    found = scene.domain.wall_velocities
    return tuple((a, side) for a, pair in enumerate(found) for side in (0, 1) if any(pair[side]))


@ti.data_oriented
class MovingFaces:
    """Velocities of the faces that move. They are data: runs that differ in them share kernels.

    Attributes:
        faces: (axis, side) of every such face.
        velocity: of each run and face, m/s; first: row of the first face of a run.
    """

    def __init__(self, faces: Sequence[tuple[int, int]], dimension: int = 0, runs: int = 1) -> None:
        self.faces = tuple(faces)
        self.first = 0
        if faces:
            self.velocity = ti.Vector.field(dimension, float, shape=runs * len(self.faces))

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the velocities of a run."""
        for f, (axis, side) in enumerate(self.faces):
            self.velocity[run * len(self.faces) + f] = scene.domain.wall_velocities[axis][side]

    @ti.func
    def of(self, face: ti.template()):
        """Return the velocity of a face, by its number in `faces`."""
        return self.velocity[self.first + face]


STILL = MovingFaces(())
