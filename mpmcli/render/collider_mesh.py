"""The surface of a collider as triangles with normals, fine enough for light and shadow."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mpmcli.render.render_scene import RenderScene
from mpmcli.scene.collider_surface import collider_surface
from mpmcli.scene.colliders import Collider, Plane
from mpmcli.scene.form_surface import without_doubles
from mpmcli.scene.surface import Surface, poly_data

# Angle between triangles, degrees, from which on an edge is sharp.
SHARP = 30.0
# Edges of triangles that carry light, as a share of the longest side of the domain.
FINE = 1 / 60
# Thickness of the layer under a surface that takes light, in the same measure.
THICK = 1 / 88


@dataclass(frozen=True, eq=False)
class ColliderMesh:
    """The surface of one collider where its shape stands.

    Attributes:
        collider: that it is of; number: of this in the scene.
        surface: (n, 3) points, triangles with the material before them.
        side: longest of the domain, m.
    """

    collider: Collider
    number: int
    surface: Surface
    side: float

    @property
    def casts(self) -> bool:
        """Whether it throws shadows: the ground and containers do not."""
        return self.collider.side == "outside" and not isinstance(self.collider.form, Plane)

    def transform(self, time: float) -> np.ndarray:
        """Return the matrix (4, 4) that takes points, counted from the pivot, to where they are at a time, s."""
        matrix = np.eye(4)
        matrix[:3, 3], matrix[:3, :3] = self.collider.motion.pose(time)
        return matrix

    def shown(self, *, fine: bool = False) -> Any:
        """Return it as PyVista's, counted from the pivot, with normals that sharp edges part.

        Args:
            fine: whether long edges are divided.
        """
        import pyvista as pv

        surface = self._fine if fine else self.surface
        moved = Surface(surface.points - np.array(self.collider.motion.pivot), surface.cells)
        data = pv.PolyData(poly_data(moved))
        return data.compute_normals(
            cell_normals=False,
            split_vertices=True,
            feature_angle=SHARP,
            consistent_normals=False,
            auto_orient_normals=False,
        )

    def edges(self) -> Any:
        """Return its sharp edges and its rims as PyVista's lines, counted from the pivot."""
        import pyvista as pv

        moved = Surface(self.surface.points - np.array(self.collider.motion.pivot), self.surface.cells)
        return pv.PolyData(poly_data(moved)).extract_feature_edges(
            SHARP, boundary_edges=True, non_manifold_edges=False, feature_edges=True, manifold_edges=False
        )

    def shade(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return places (n, 3) under its surface that take light at a time, s, and their volumes (n,), m^3."""
        places, volumes = self._shade
        return self.collider.motion.placed(places, time), volumes

    @cached_property
    def _shade(self) -> tuple[np.ndarray, np.ndarray]:
        surface, thick = self._fine, THICK * self.side
        middle = surface.points[surface.cells].mean(axis=1)
        return middle - 0.5 * thick * surface.normals, thick * surface.sizes

    @cached_property
    def _fine(self) -> Surface:
        from vtkmodules.vtkFiltersModeling import vtkAdaptiveSubdivisionFilter

        from mpmcli.scene.surface import surface_of

        if len(self.surface.cells) == 0:
            return self.surface
        divide = vtkAdaptiveSubdivisionFilter()
        divide.SetInputData(poly_data(self.surface))
        divide.SetMaximumEdgeLength(FINE * self.side)
        divide.SetMaximumTriangleArea((FINE * self.side) ** 2)
        divide.SetMaximumNumberOfPasses(12)
        divide.Update()
        return without_doubles(surface_of(divide.GetOutput()))


def collider_meshes(scene: RenderScene) -> tuple[ColliderMesh, ...]:
    """Return the surfaces of the colliders of a 3D scene that have any extent in it."""
    lower, upper = np.array(scene.lower), np.array(scene.upper)
    side = float(np.max(upper - lower))
    found = []
    for number, collider in enumerate(scene.colliders):
        surface = collider_surface(collider, lower, upper)
        if len(surface.cells):
            found.append(ColliderMesh(collider, number, without_doubles(surface), side))
    return tuple(found)
