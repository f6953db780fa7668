"""A body in the form of points from a file, each of which is a particle."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, PrivateAttr, ValidationInfo, model_validator

from mpmcli.scene.mesh import file_version, scene_file
from mpmcli.scene.point_file import PointFileError, read_points
from mpmcli.scene.quantity import Positive, Table, Vector, flaw, scene_dimension


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points, (n, d), m, and their velocities, (n, d), m/s, or None."""

    position: np.ndarray
    velocity: np.ndarray | None

    @cached_property
    def tree(self) -> Any:
        """A tree of the points."""
        from scipy.spatial import KDTree

        return KDTree(self.position)


class Points(Table):
    """Points from a file: the particles of the body as they are."""

    file: Annotated[str, Field(description="The file, relative to the scene: CSV, NPY, PLY, VTU, ...")]
    spacing: Annotated[
        Positive | None,
        Field(description="Distance between neighbours, m: a particle has its square or cube as volume."),
    ] = None
    total_volume: Annotated[
        Positive | None, Field(description="Volume of the whole body, m^3 (m^2 in 2D), in place of spacing.")
    ] = None
    velocity: Annotated[
        str | tuple[str, ...] | None,
        Field(
            description='Velocities in the file, added to that of the body: names of columns, such as ["vx", "vy"], of '
            "CSV and NPY, else the name of an array. Default: none."
        ),
    ] = None
    scale: Annotated[Positive, Field(description="Metres per unit of the file; velocities are taken as they are.")] = (
        1.0
    )
    translate: Annotated[
        Vector, Field(validate_default=True, description="What is added to all points after scaling, m.")
    ] = None  # type: ignore[assignment]
    _cloud: Cloud = PrivateAttr()

    @model_validator(mode="after")
    def _read(self, info: ValidationInfo) -> "Points":
        path, d = scene_file(self.file, info), scene_dimension(info) or len(self.translate)
        try:
            self._cloud = _cloud_of(path.absolute(), file_version(path), d, self.velocity, self.scale, self.translate)
        except PointFileError as error:
            raise flaw(f"{path}: {error}", "file") from None
        if (self.spacing is None) == (self.total_volume is None):
            usual = self._usual_spacing()
            hint = f"; its points are some {usual:.3g} m apart" if usual else ""
            raise flaw(f"needs either spacing or total_volume, which the mass of the body follows from{hint}")
        return self

    def _usual_spacing(self) -> float:
        """Return the median distance of a point to the nearest other one, m; 0 where there is none."""
        if len(self._cloud.position) < 2:
            return 0.0
        return float(np.median(self._cloud.tree.query(self._cloud.position[:10_000], k=2)[0][:, 1]))

    @property
    def position(self) -> np.ndarray:
        """The points, (n, d), m."""
        return self._cloud.position

    @property
    def file_velocity(self) -> np.ndarray | None:
        """The velocities in the file, (n, d), m/s."""
        return self._cloud.velocity

    @property
    def volume(self) -> float:
        """Volume of the body, m^3 (m^2 in 2D)."""
        n, d = self.position.shape
        return n * self.spacing**d if self.total_volume is None else self.total_volume

    @property
    def edge(self) -> float:
        """Edge of the square or cube that a particle stands for, m."""
        n, d = self.position.shape
        return (self.volume / n) ** (1 / d)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and the upper corner of the bounding box of the points, (d,) each, m."""
        return self.position.min(axis=0), self.position.max(axis=0)

    def contains(self, points: np.ndarray, inset: float = 0.0) -> np.ndarray:
        """Say of each point (n, d) whether it lies within half an edge of a particle, less `inset` metres."""
        return self.signed_distance(points) <= -inset

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        """Return the distance of each point (n, d) from the particles, balls whose diameter is an edge, (n,), m."""
        return self._cloud.tree.query(points)[0] - self.edge / 2


@lru_cache(maxsize=32)
def _cloud_of(
    path: Path,
    version: tuple[int, int],
    d: int,
    velocity: str | tuple[str, ...] | None,
    scale: float,
    translate: tuple[float, ...],
) -> Cloud:
    """Return the points in a file; `version` tells versions of the file apart."""
    position, velocities = read_points(path, d, velocity)
    return Cloud(position * scale + np.array(translate), velocities)
