"""What a picture needs to know of a run: its domain, its bodies and their materials."""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mpmcli.errors import InputError
from mpmcli.output.result import Result
from mpmcli.plain_text import one_line
from mpmcli.render.look import OTHERS, Look, look_of

# Particles to a cell where the scene does not say, in 2D and 3D.
USUAL_PER_CELL = {2: 4, 3: 8}


@dataclass(frozen=True)
class Subject:
    """Facts of a run; b bodies, m materials. Everything is in three dimensions: z = 0 in 2D.

    Attributes:
        title: of the scene.
        dimension: 2 or 3.
        lower, upper: corners of the domain, (3,), m.
        spacing: of the grid, m.
        up: direction against gravity, along an axis, (3,).
        bodies: b names.
        looks: m looks, of materials that differ; two of one kind differ in their names.
        material_of: (b,) index into `looks`.
        distances: (b,) between neighbouring particles at the start, m.
        densities: (b,) at rest, kg/m^3.
        fields: names of what is stored of each particle, beside position, velocity, body and material.
    """

    title: str
    dimension: int
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    spacing: float
    up: tuple[float, ...]
    bodies: tuple[str, ...]
    looks: tuple[Look, ...]
    material_of: tuple[int, ...]
    distances: tuple[float, ...]
    densities: tuple[float, ...]
    fields: tuple[str, ...]


def subject_of(result: Result) -> Subject:
    """Read the facts off the header of a result.

    Raises:
        InputError: it does not say what the domain is.
    """
    header, d = result.header, result.dimension
    scene = _parsed(header.get("scene", ""))
    domain, tables = scene.get("domain", {}), scene.get("bodies", [])
    try:
        spacing = float(header.get("spacing") or domain["spacing"])
        lower = np.array(header.get("origin") or domain.get("origin") or [0.0] * d, dtype=np.float64)
        upper = lower + np.array(header.get("size") or domain["size"], dtype=np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{result.path} does not say what its domain is, so that no picture can be framed.") from error
    bodies = tuple(one_line(str(name)) for name in header.get("bodies", ())) or ("all",)
    tables = tables if len(tables) == len(bodies) else [{} for _ in bodies]
    looks, material_of = _materials(bodies, [table.get("material", {}) for table in tables])
    flat = [0.0] * (3 - d)
    return Subject(
        title=one_line(str(header.get("title") or "")),
        dimension=d,
        lower=(*lower.tolist(), *flat),
        upper=(*upper.tolist(), *flat),
        spacing=spacing,
        up=_up(domain.get("gravity"), d),
        bodies=bodies,
        looks=looks,
        material_of=material_of,
        distances=tuple(spacing / table.get("particles_per_cell", USUAL_PER_CELL[d]) ** (1 / d) for table in tables),
        densities=tuple(float(table.get("material", {}).get("density", 1000.0)) for table in tables),
        fields=result.field_names,
    )


def _parsed(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return {}


def _up(gravity: object, d: int) -> tuple[float, ...]:
    """Return the axis against gravity; the last one where there is none, or where it turns with time."""
    up = np.zeros(3)
    up[d - 1] = 1.0
    if isinstance(gravity, list) and len(gravity) == d and d == 3:
        known = np.array([entry if isinstance(entry, int | float) else 0.0 for entry in gravity])
        axis = int(np.argmax(np.abs(known)))
        if known[axis] != 0.0:
            up = np.zeros(3)
            up[axis] = -np.sign(known[axis])
    return tuple(up.tolist())


def _materials(bodies: Sequence[str], tables: Sequence[dict[str, Any]]) -> tuple[tuple[Look, ...], tuple[int, ...]]:
    """Find the materials that differ, and which each body has."""
    kinds: list[dict[str, Any]] = []
    firsts: list[str] = []
    looks: list[Look] = []
    material_of = []
    for body, table in zip(bodies, tables, strict=True):
        if table not in kinds:
            others = sum(look.ink in OTHERS for look in looks)
            looks.append(look_of(table.get("law", "material"), table, others))
            kinds.append(table)
            firsts.append(body)
        material_of.append(kinds.index(table))
    names = [look.name for look in looks]
    told = [
        look if names.count(look.name) == 1 else replace(look, name=f"{look.name} ({body})")
        for look, body in zip(looks, firsts, strict=True)
    ]
    return tuple(told), tuple(material_of)
