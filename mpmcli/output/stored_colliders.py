"""The colliders of a stored scene."""

import tomllib
from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from pydantic import ValidationError

from mpmcli.scene.colliders import Collider, ColliderShape
from mpmcli.scene.constants import definitions
from mpmcli.scene.mesh import Mesh
from mpmcli.scene.triangles import Surface


class ColliderFacts:
    """What a header says of colliders.

    Attributes:
        stored: entries of the header; dimension: of the scene.
    """

    stored: dict[str, Any]
    dimension: int

    @cached_property
    def collider_names(self) -> tuple[str, ...]:
        """Names of the colliders, in the order of the ledger's columns."""
        return tuple(str(table.get("name", "")) for table in self._tables)

    @cached_property
    def colliders(self) -> tuple[Collider, ...]:
        """The colliders that the scene tells all of; one whose mesh is not found is left out."""
        return tuple(collider for collider in self.read_colliders({}) if collider is not None)

    @cached_property
    def moved(self) -> bool:
        """Whether a collider moves, which does work; also where it is not known."""
        return any(collider is None or collider.motion.moves for collider in self.read_colliders({}))

    def read_colliders(self, surfaces: Mapping[int, Surface]) -> tuple[Collider | None, ...]:
        """Read the colliders; None for one that cannot be read.

        Args:
            surfaces: in place of those in files, by number; where the shapes stand.
        """
        constants, _ = definitions(self._scene.get("constants"), self.dimension)
        context = {"dimension": self.dimension, "constants": constants}
        return tuple(_collider(table, context, surfaces.get(k)) for k, table in enumerate(self._tables))

    @cached_property
    def _scene(self) -> Mapping[str, Any]:
        try:
            return tomllib.loads(self.stored.get("scene", ""))
        except (ValueError, RecursionError):
            return {}

    @property
    def _tables(self) -> Sequence[Mapping[str, Any]]:
        tables = self._scene.get("colliders", [])
        return [table for table in tables if isinstance(table, Mapping)] if isinstance(tables, list) else []


def _collider(table: Mapping[str, Any], context: dict[str, Any], surface: Surface | None) -> Collider | None:
    try:
        if surface is None:
            return Collider.model_validate(table, context=context)
        box = {"box": {name: corner.tolist() for name, corner in zip(("min", "max"), surface.bounds(), strict=True)}}
        found = Collider.model_validate({**table, "shape": box}, context=context)
    except ValidationError:
        return None
    mesh = Mesh.model_construct(file="", scale=1.0, rotate=None, translate=(0.0,) * len(surface.vertices[0]))
    mesh._surface = surface
    return found.model_copy(update={"shape": ColliderShape.model_construct(mesh=mesh)})


def triangles_of(collider: Collider) -> tuple[np.ndarray, np.ndarray] | None:
    """Return vertices and triangles of a collider whose shape is read from files, None of any other."""
    if not collider.shape.files:
        return None
    from mpmcli.scene.form_surface import form_surface

    surface = form_surface(collider.form)
    return surface.points, surface.cells
