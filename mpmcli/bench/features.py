"""The pool in which the cost of features is measured: deep water at rest, and the same scene with one feature more."""

from dataclasses import dataclass
from math import pi
from pathlib import Path
from tempfile import TemporaryDirectory

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.materials import GRAVITY, material_of
from mpmcli.bench.ours import Ours
from mpmcli.materials.registry import laws

# Depth of the pool in a unit box: 72 cells of 128, and 18 of 32.
DEPTH = 0.5625
# Centre of colliders, the radius of the ball, and that of the octahedron, m.
CENTER = (0.5, 0.35, 0.5)
BALL, OCTAHEDRON = 0.2, 0.25
# Bars of the cross that stands for the mesh in 2D, (half width, half height), m.
BARS = ((0.2, 0.05), (0.05, 0.2))
FRICTION = 0.5
# About a quarter of the step that the stiffness at rest allows, with 4 (2D) and 8 (3D) particles per cell.
FEATURE_CASES = (
    BenchCase(dimension=2, cells=128, particles=36_864, step=1e-4),
    BenchCase(dimension=3, cells=32, particles=147_456, step=4e-4),
)
# Start of the measured interval, s: what moves has set the water in motion, and the emitter has emitted all.
SETTLING = 0.1


@dataclass(frozen=True)
class Feature:
    """A scene, and the same scene without a feature.

    Attributes:
        name: of the scene.
        base: name of the scene without the feature; None for those that others are compared with.
        limit: largest ratio of their costs, None where none is set.
    """

    name: str
    base: str | None
    limit: float | None = None


FEATURES = (
    Feature("plain", None),
    Feature("plain again", "plain", 1.02),
    Feature("moving ball", "plain", 1.10),
    Feature("friction of the ball", "moving ball", 1.03),
    Feature("moving mesh", "plain", 1.15),
    Feature("friction of walls", "plain", 1.03),
    Feature("moving wall", "friction of walls"),
    Feature("periodic faces", "plain"),
    Feature("force", "plain"),
    Feature("force with exp", "plain"),
    Feature("sparse grid", "plain", 1.30),
    Feature("jet", None),
    Feature("emitter", "jet", 1.03),
    Feature("jelly", None),
    Feature("f_bar", "jelly"),
)


def scene_of(name: str, case: BenchCase, precision: str) -> dict:
    """Return the scene of a feature as the dictionary of a scene file; a mesh is "mesh.obj" beside it.

    A collider displaces water: there is as much of it as without the collider, and it stands higher.
    """
    d, center = case.dimension, [*CENTER[: case.dimension]]
    law = "neo_hookean" if name in ("jelly", "f_bar") else "fluid"
    body = {"name": "pool", "material": material_of(laws()[law].parameters), "particles_per_cell": 2**d}
    shape, displaced = {"box": {"min": [0.0] * d, "max": [1.0, DEPTH, 1.0][:d]}}, 0.0
    data = {
        "title": f"Pool, {name}, {case.name}",
        "domain": {
            "size": [1.0] * d,
            "cells": [case.cells] * d,
            "gravity": [0.0, -GRAVITY, 0.0][:d],
            "walls": "separate",
        },
        "time": {"end": 100.0, "frames": 1, "step": case.step},
        "bodies": [body | {"shape": shape}],
        "solver": {"precision": precision},
    }
    if name in ("moving ball", "friction of the ball"):
        displaced, form = (pi * BALL**2, 4 / 3 * pi * BALL**3)[d - 2], {"ball": {"center": center, "radius": BALL}}
        data["colliders"] = [{"name": "ball", "shape": form, "velocity": ["0.5 * cos(10 * t)", *[0.0] * (d - 1)]}]
        if name != "moving ball":
            data["colliders"][0]["friction"] = FRICTION
    elif name == "moving mesh":
        displaced, form = 4 / 3 * OCTAHEDRON**3, {"mesh": {"file": "mesh.obj", "translate": center}}
        if d == 2:
            first, second = ({"box": _box(center, half)} for half in BARS)
            displaced, form = 0.07, first | {"add": [second]}
        data["colliders"] = [{"name": "mesh", "shape": form, "angular_velocity": 2.0}]
    elif name in ("friction of walls", "moving wall"):
        data["domain"]["friction"] = FRICTION
        if name == "moving wall":
            data["domain"]["wall_velocity"] = {"y_min": [0.5, 0.0, 0.0][:d]}
    elif name == "periodic faces":
        data["domain"]["walls"] = {"default": "separate", "x_min": "periodic", "x_max": "periodic"}
    elif name.startswith("force"):
        near = " * exp(-((x - 0.5)**2 + (y - 0.3)**2) / 0.1**2)" if "exp" in name else ""
        swirl = [f"-3 * sin(9 * t) * (y - 0.3){near}", f"3 * sin(9 * t) * (x - 0.5){near}"]
        data["forces"] = [{"body": "pool", "acceleration": [*swirl, 0][:d]}]
    elif name in ("jet", "emitter"):
        down, radius = [0.0, -2.0, 0.0][:d], (0.1, 0.14)[d - 2]
        # Sheets of about 51 (2D) and 250 particles (3D), which all enter within SETTLING.
        count = case.particles // (16, 50)[d - 2]
        mouth = (2 * radius, pi * radius**2)[d - 2]
        if name == "emitter":
            form = {"ball": {"center": [0.5, 0.85, 0.5][:d], "radius": radius}}
            common = {key: body[key] for key in ("material", "particles_per_cell")}
            data["emitters"] = [common | {"name": "jet", "shape": form, "velocity": down, "particles": count}]
        else:
            # As much, which falls from where it is after SETTLING as well.
            height, half = count / (2 * case.cells) ** d / mouth, mouth ** (1 / (d - 1)) / 2
            form = {
                "box": {"min": [0.5 - half, 0.8, 0.5 - half][:d], "max": [0.5 + half, 0.8 + height, 0.5 + half][:d]}
            }
            data["bodies"].append(body | {"name": "jet", "shape": form, "velocity": down})
    elif name == "sparse grid":
        data["solver"]["grid"] = "sparse"
    elif law != "fluid":
        data["solver"]["f_bar"] = name == "f_bar"
    if displaced:
        shape["box"]["max"][1] += displaced
        shape["subtract"] = [form] if "add" not in form else [first, second]
    return data


def _box(center: list[float], half: tuple[float, ...]) -> dict:
    low, high = ([c + sign * e for c, e in zip(center, half, strict=True)] for sign in (-1, 1))
    return {"min": low, "max": high}


def octahedron(radius: float) -> str:
    """Return a regular octahedron about the origin as the text of an OBJ file, faces outward."""
    corners = [[radius * sign * (a == axis) for a in range(3)] for axis in range(3) for sign in (1, -1)]
    lines = [f"v {x} {y} {z}" for x, y, z in corners]
    # Corners 1 to 6 are at +x, -x, +y, -y, +z, -z. An odd number of negative ones turns a face round.
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                face = [1 + i, 3 + j, 5 + k]
                lines.append("f " + " ".join(map(str, face if (i + j + k) % 2 == 0 else face[::-1])))
    return "\n".join(lines) + "\n"


class Pool(Ours):
    """What `mpmcli simulate` computes with, on the scene of a feature, which goes on from block to block."""

    def __init__(self, name: str, case: BenchCase, *, threads: int, precision: str, arch: str) -> None:
        data = scene_of(name, case, precision)
        with TemporaryDirectory() as directory:
            Path(directory, "mesh.obj").write_text(octahedron(OCTAHEDRON), encoding="utf-8")
            options = {"threads": threads, "precision": precision, "arch": arch}
            super().__init__(data, case.step, batched=True, directory=directory, **options)

    def rewind(self) -> None:
        """Do nothing: all scenes go on from the same time, and differ by what their feature does."""
