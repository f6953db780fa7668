"""The scene of a picture: the domain of a run, its bodies and the appearance of their materials."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.output.header import BodyHeader
from mpmcli.output.result import Result
from mpmcli.plain_text import one_line
from mpmcli.render.appearance import OTHERS, Appearance, appearance_of
from mpmcli.scene.colliders import Collider
from mpmcli.scene.lattice import usual_particles_per_cell


@dataclass(frozen=True)
class RenderScene:
    """Facts of a run; b bodies, m materials. Everything is in three dimensions: z = 0 in 2D.

    Attributes:
        title: of the scene.
        dimension: 2 or 3.
        lower, upper: corners of the domain, (3,), m.
        spacing: of the grid, m.
        up: direction against gravity, along an axis, (3,).
        bodies: b names.
        appearances: m appearances, of materials that differ; two of one kind differ in their names.
        material_of: (b,) index into `appearances`.
        distances: (b,) between neighbouring particles at the start, m.
        densities: (b,) at rest, kg/m^3.
        fields: names of the stored fields, without position, velocity, body and material.
        colliders: that are drawn; collider_frames: the frame that each is in, by its number, None where all are in all.
        clear: whether things in 3D show their far sides only, as containers do, so that they hide nothing.
    """

    title: str
    dimension: int
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    spacing: float
    up: tuple[float, ...]
    bodies: tuple[str, ...]
    appearances: tuple[Appearance, ...]
    material_of: tuple[int, ...]
    distances: tuple[float, ...]
    densities: tuple[float, ...]
    fields: tuple[str, ...]
    colliders: tuple[Collider, ...] = ()
    collider_frames: tuple[int, ...] | None = None
    clear: bool = False

    def shows(self, number: int, frame: Frame) -> bool:
        """Say whether a collider is in a frame."""
        return self.collider_frames is None or self.collider_frames[number] == frame.index


def render_scene_of(result: Result) -> RenderScene:
    """Read the facts off the header of a result.

    Raises:
        InputError: the header lacks the domain.
    """
    header, d = result.header, result.dimension
    if header.origin is None or not header.spacing:
        raise InputError(f"{result.path} does not say what its domain is, so that no picture can be framed.")
    bodies = header.bodies or (BodyHeader("all", {}, None, usual_particles_per_cell(d)),)
    names = tuple(one_line(body.name) for body in bodies)
    appearances, material_of = _materials(names, [body.material for body in bodies])
    flat = [0.0] * (3 - d)
    return RenderScene(
        title=one_line(header.title),
        dimension=d,
        lower=(*header.origin.tolist(), *flat),
        upper=(*header.upper.tolist(), *flat),
        spacing=header.spacing,
        up=_up(header.steady_gravity, d),
        bodies=names,
        appearances=appearances,
        material_of=material_of,
        distances=tuple(header.spacing / body.particles_per_cell ** (1 / d) for body in bodies),
        densities=tuple(body.density or 1000.0 for body in bodies),
        fields=result.field_names,
        colliders=result.colliders,
        collider_frames=result.collider_frames,
    )


def _up(gravity: np.ndarray | None, d: int) -> tuple[float, ...]:
    """Return the axis against gravity; in 2D, and where there is none, the last one."""
    up = np.zeros(3)
    if d == 3 and gravity is not None and gravity.any():
        axis = int(np.argmax(np.abs(gravity)))
        up[axis] = -np.sign(gravity[axis])
    else:
        up[d - 1] = 1.0
    return tuple(up.tolist())


def _materials(
    bodies: Sequence[str], tables: Sequence[Mapping[str, Any]]
) -> tuple[tuple[Appearance, ...], tuple[int, ...]]:
    """Return the appearances of the distinct materials, and the index of each body's material."""
    kinds: list[Mapping[str, Any]] = []
    firsts: list[str] = []
    appearances: list[Appearance] = []
    material_of = []
    for body, table in zip(bodies, tables, strict=True):
        if table not in kinds:
            others = sum(appearance.ink in OTHERS for appearance in appearances)
            appearances.append(appearance_of(table.get("law", "material"), table, others))
            kinds.append(table)
            firsts.append(body)
        material_of.append(kinds.index(table))
    names = [appearance.name for appearance in appearances]
    told = [
        appearance if names.count(appearance.name) == 1 else replace(appearance, name=f"{appearance.name} ({body})")
        for appearance, body in zip(appearances, firsts, strict=True)
    ]
    return tuple(told), tuple(material_of)
