"""Tables of scenes that cases share, all in SI units, and reference data."""

import tomllib
from collections.abc import Sequence
from copy import deepcopy
from importlib.resources import files
from typing import Any

Tables = dict[str, Any]


def problem(domain: Tables, time: tuple[float, int], fields: str, bodies: Sequence[Tables], **more: Any) -> Tables:
    """Return the tables of a scene: `time` is the end and the number of frames, `fields` their names between blanks.

    They are copies: scenes share the table of a material, and a caller may change the scene that it got.
    """
    end, frames = time
    parts = {"domain": domain, "time": {"end": end, "frames": frames}, "output": {"fields": fields.split()}}
    return deepcopy({**parts, "bodies": [*bodies], **more})


def body(name: str, material: Tables, shape: Tables, **more: Any) -> Tables:
    """Return the table of a body."""
    return {"name": name, "material": material, "shape": shape, **more}


def box(low: Sequence[float], high: Sequence[float]) -> Tables:
    """Return the shape of a box between two corners."""
    return {"box": {"min": [*low], "max": [*high]}}


def ball(center: Sequence[float], radius: float) -> Tables:
    """Return the shape of a disc or a ball."""
    return {"ball": {"center": [*center], "radius": radius}}


def fluid(density: float, bulk_modulus: float | str, law: str = "fluid", **more: Any) -> Tables:
    """Return the table of a fluid, or of another law with a bulk modulus."""
    return {"law": law, "density": density, "bulk_modulus": bulk_modulus, **more}


def elastic(law: str, density: float, youngs_modulus: float, poissons_ratio: float, **more: float) -> Tables:
    """Return the table of a material with elastic moduli and further parameters."""
    moduli = {"youngs_modulus": youngs_modulus, "poissons_ratio": poissons_ratio}
    return {"law": law, "density": density, **moduli, **more}


def lame_moduli(youngs_modulus: float, poissons_ratio: float) -> tuple[float, float]:
    """Return mu and lambda: written here again, so that an error in the solver's does not cancel."""
    E, nu = youngs_modulus, poissons_ratio
    return E / (2 * (1 + nu)), E * nu / ((1 + nu) * (1 - 2 * nu))


def shaft(n: int, height: float, gravity: float | str, across: int = 5, room: int = 3) -> tuple[Tables, Tables]:
    """Return the domain of a shaft between slip walls and the shape of a column of n cells that fills its width.

    The grid has at least five cells per axis; a column that fills them stays one-dimensional. Gravity is along y, and
    `room` cells above the column are empty.
    """
    h = height / n
    size, cells = [across * h, height + room * h], [across, n + room]
    domain = {"size": size, "cells": cells, "gravity": [0.0, gravity], "walls": "slip"}
    return domain, box([0.0, 0.0], [across * h, height])


def free_blocks(n: int, edge: float, count: int, gaps: Sequence[int]) -> tuple[Tables, list[Tables]]:
    """Return the domain and the shapes of blocks of n cells along an edge, one above the other along the last axis.

    `gaps` are the empty cells beside the blocks along each axis, and between them along the last one.
    """
    h, (*beside, between) = edge / n, gaps
    cells = [n + 2 * gap for gap in beside] + [count * (n + between) + between]
    lows = [[gap * h for gap in beside] + [(between + k * (n + between)) * h] for k in range(count)]
    domain = {"size": [number * h for number in cells], "cells": cells, "walls": "separate"}
    return domain, [box(low, [x + edge for x in low]) for low in lows]


def smooth_ramp(duration: float) -> str:
    """Return the text of an expression of t that rises from 0 to 1 within `duration`, s, and stays there.

    s^4 (35 - 84 s + 70 s^2 - 20 s^3), s = t / duration: three derivatives vanish at both ends, so that a mode of
    frequency w is left swinging with 1680 / (w duration)^4 of its static part at most (integrals by parts of the slope
    140 s^3 (1 - s)^3, whose third derivative is 840 at both ends).
    """
    s = f"clamp(t / {duration!r}, 0, 1)"
    return f"({s} ** 4 * (35 - 84 * {s} + 70 * {s} ** 2 - 20 * {s} ** 3))"


def reference_data(name: str) -> dict[str, Any]:
    """Return a file of `data/`, which says where its figures come from."""
    return tomllib.loads(files("mpmcli.validation").joinpath(f"data/{name}.toml").read_text(encoding="utf-8"))
