"""Set-ups that tests of whole runs share: scenes in few words, starts of their own, and runs."""

import math
from collections.abc import Iterable, Sequence
from os import PathLike

import numpy as np
import pytest

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import BodyParticles, Scene, parse_scene
from mpmcli.solver.engine.run import Run
from mpmcli.solver.frames.builder import FilledCells

GRAVITY = 9.81
# The table of each key that only one of them has, or `domain` before `contact`.
TABLES = {
    key: table
    for table in ("domain", "time", "output", "solver")
    for key in Scene.model_fields[table].annotation.model_fields
}


def slow(*values: object, **more: object) -> object:
    """Return a parameter of a test whose tests with it are slow."""
    return pytest.param(*values, marks=pytest.mark.slow, **more)


def box(low: Iterable, high: Iterable) -> dict:
    """Return the shape of a box."""
    return {"box": {"min": list(low), "max": list(high)}}


def ball(center: Iterable, radius: float) -> dict:
    """Return the shape of a ball."""
    return {"ball": {"center": list(center), "radius": radius}}


def plane(point: Iterable, normal: Iterable) -> dict:
    """Return the shape of a half-space."""
    return {"plane": {"point": list(point), "normal": list(normal)}}


def polygon(vertices: Iterable) -> dict:
    """Return the shape of a polygon."""
    return {"polygon": {"vertices": list(vertices)}}


def solid(youngs_modulus: float, /, **more: object) -> dict:
    """Return an elastic material, by default as dense as water."""
    return {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": youngs_modulus} | more


def liquid(bulk_modulus: object, /, **more: object) -> dict:
    """Return a liquid, by default as dense as water."""
    return {"law": "fluid", "density": 1000.0, "bulk_modulus": bulk_modulus} | more


def body(name: str, material: object, shape: dict, /, **more: object) -> dict:
    """Return the table of a body."""
    return {"name": name, "material": material, "shape": shape, **more}


def block(name: str, material: object, low: Iterable, high: Iterable, /, **more: object) -> dict:
    """Return the table of a body that is a box."""
    return body(name, material, box(low, high), **more)


def collider(name: str, shape: dict, /, **more: object) -> dict:
    """Return the table of a collider."""
    return {"name": name, "shape": shape, **more}


def tables_of(*bodies: dict, **keys: object) -> dict:
    """Return the tables of a scene of 1 s and one frame; `spacing` stands for that of `domain`, `end` for `time.end`.

    `cells` with a spacing give the size. Bodies share one velocity field, unless `contact` is given.
    """
    tables = {"domain": {}, "time": {"end": 1.0, "frames": 1}, "contact": {"default": "stick"}, "bodies": [*bodies]}
    for key, value in keys.items():
        if key in TABLES:
            tables[TABLES[key]] = tables.get(TABLES[key], {}) | {key: value}
        else:
            tables[key] = tables.get(key, {}) | value if key in TABLES.values() else value
    domain = tables["domain"]
    if {"cells", "spacing"} <= domain.keys():
        domain["size"] = [n * domain["spacing"] for n in domain.pop("cells")]
    return tables


def scene_of(*bodies: dict, directory: str | PathLike[str] = ".", **keys: object) -> Scene:
    """Return the scene of the tables of these words."""
    return parse_scene(tables_of(*bodies, **keys), laws=parameter_models(), directory=directory).scene


def scene(cells: Sequence[int], spacing: float, bodies: Sequence[dict], end: float, **keys: object) -> Scene:
    """Return a scene with a number of cells."""
    return scene_of(*bodies, **{"cells": cells, "spacing": spacing, "end": end, "fields": ["velocity"]} | keys)


def tilted(degrees: float) -> list[float]:
    """Return gravity in the axes of a slope: x down the slope, y away from it."""
    theta = math.radians(degrees)
    return [GRAVITY * math.sin(theta), -GRAVITY * math.cos(theta)]


def row_means(values: np.ndarray, rows: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Return the mean of the chosen values in each row of particles; rows (n,) are their heights at the start."""
    keys = np.round(rows, 9)
    return np.array([values[chosen & (keys == key)].mean(0) for key in np.unique(keys)])


def stresses(fields: dict[str, np.ndarray]) -> np.ndarray:
    """Return the Cauchy stress of a frame as matrices, (n, 3, 3), Pa."""
    return fields["stress"].reshape(-1, 3, 3)


def restart(run: Run, samples: Sequence[BodyParticles], end: float) -> None:
    """Begin a run of a scene with one body of each law again, with other particles, as many: kernels stay compiled."""
    for group in run.groups:
        (body,) = group.bodies
        sample, n = samples[body], group.count
        group.replace(
            x=sample.position - run.scene.domain.origin,
            v=sample.velocity,
            C=sample.affine,
            deformation=np.ones(n) if group.law.deformation == "J" else np.tile(np.eye(group.dimension), (n, 1, 1)),
            internal=np.tile([variable.at_rest for variable in group.law.internal], (n, 1)),
            id=np.arange(n) + sum(s.count for s in samples[:body]),
        )
    run.scene = run.scene.model_copy(update={"time": run.scene.time.model_copy(update={"end": end})})
    run.restart()


def volume_errors(
    x: np.ndarray, volume: np.ndarray, flows: np.ndarray, spacing: float, cells: Sequence[int], periodic: Sequence[bool]
) -> np.ndarray:
    """Return the volume errors of (T, n, d) places, the particles added in two parts, which change no bit."""
    halves, whole = (FilledCells(x, spacing, cells, periodic) for _ in range(2))
    for rows in (slice(0, len(flows) // 3), slice(len(flows) // 3, None)):
        halves.add(x[:, rows], volume[:, rows], flows[rows])
    whole.add(x, volume, flows)
    assert np.array_equal(halves.errors(), whole.errors())
    return whole.errors()
