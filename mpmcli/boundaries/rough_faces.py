"""The faces of the domain that have friction, and their coefficients (docs/theory.md, 3.4)."""

from collections.abc import Sequence

import taichi as ti

from mpmcli.scene import Scene


def rough_faces(scene: Scene) -> tuple[tuple[int, int], ...]:
    """Return (axis, side) of every face of a scene that has friction."""
    found = scene.domain.frictions
    return tuple((a, side) for a, pair in enumerate(found) for side in (0, 1) if pair[side] > 0)


@ti.data_oriented
class RoughFaces:
    """Coefficients of friction of the faces that have any. They are data: runs that differ in them share kernels.

    Attributes:
        faces: (axis, side) of every such face.
        coefficient: of each run and face; first: row of the first face of a run.
    """

    def __init__(self, faces: Sequence[tuple[int, int]], runs: int = 1) -> None:
        self.faces = tuple(faces)
        self.first = 0
        if faces:
            self.coefficient = ti.field(float, shape=runs * len(self.faces))

    def write(self, scene: Scene, run: int = 0) -> None:
        """Set the coefficients of a run."""
        for f, (axis, side) in enumerate(self.faces):
            self.coefficient[run * len(self.faces) + f] = scene.domain.frictions[axis][side]

    @ti.func
    def of(self, face: ti.template()):
        """Return the coefficient of a face, by its number in `faces`."""
        return self.coefficient[self.first + face]
