"""Colliders in the solver: distances, what a step takes, slopes, weight, buoyancy, and nothing that passes them."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import taichi as ti
from rounding import farthest
from scenes import ball, block, body, box, collider, plane, polygon, scene_of
from solver_state import bodies_of, with_colliders
from test_batch import scene_named

from mpmcli.boundaries.colliders import BLEND, BLEND_NEAR, ColliderKind, ColliderMotion, Colliders, corners_of
from mpmcli.boundaries.loads import Loads
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider
from mpmcli.scene.shapes import clauses_of
from mpmcli.solver.engine.run import build_run

G = 10.0
JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e6, "poissons_ratio": 0.3}
SHAPES_2D = [
    plane([0.3, 0.4], [1.0, 2.0]),
    box([0.3, 0.4], [0.6, 0.5]),
    ball([0.5, 0.4], 0.2),
    {"capsule": {"start": [0.3, 0.3], "end": [0.5, 0.6], "radius": 0.1}},
    polygon([[0.2, 0.2], [0.8, 0.3], [0.5, 0.4], [0.4, 0.8]]),
    polygon([[0.4, 0.8], [0.5, 0.4], [0.8, 0.3], [0.2, 0.2]]),
    {"ball": {"center": [0.5, 0.5], "radius": 0.4}, "subtract": [ball([0.5, 0.5], 0.2)]},
]
SHAPES_3D = [
    plane([0.3, 0.4, 0.5], [1.0, 2.0, -1.0]),
    box([0.3, 0.4, 0.2], [0.6, 0.5, 0.7]),
    ball([0.5, 0.4, 0.6], 0.2),
    {"capsule": {"start": [0.3, 0.3, 0.3], "end": [0.5, 0.6, 0.7], "radius": 0.1}},
    {"cylinder": {"base": [0.4, 0.4, 0.4], "axis": [1.0, 1.0, 0.3], "radius": 0.15, "height": 0.3}},
    {"box": {"min": [0.3, 0.4, 0.2], "max": [0.6, 0.5, 0.7]}, "rotation": {"axis": [1.0, 2.0, 0.5], "angle": 25.0}},
    {"ball": {"center": [0.5] * 3, "radius": 0.4}, "subtract": [ball([0.5] * 3, 0.2)]},
]


def run(scene: Scene, backend: object) -> list[tuple[Frame, LedgerRow]]:
    """Return the frames of a scene, run as `mpmcli simulate` does on the CPU."""
    return list(build_run(scene, backend).frames())


@ti.kernel
def evaluate(colliders: ti.template(), points: ti.types.ndarray(), found: ti.types.ndarray()):
    """Fill found (n, k, d + 1) with distances and normals of all colliders at the points (n, d).

    There may be d more columns, for the normals that turn around corners.
    """
    for p in range(points.shape[0]):
        for k in range(found.shape[1]):
            x = ti.Vector.zero(float, ti.static(colliders.dimension))
            for a in ti.static(range(colliders.dimension)):
                x[a] = points[p, a]
            phi, normal = colliders.distance(k, x - colliders.place[k], 0)
            found[p, k, 0] = phi
            for a in ti.static(range(colliders.dimension)):
                found[p, k, 1 + a] = normal[a]
            if found.shape[2] > 1 + colliders.dimension:
                _, turned = colliders.distance(k, x - colliders.place[k], 0, True)
                for a in ti.static(range(colliders.dimension)):
                    found[p, k, 1 + colliders.dimension + a] = turned[a]


H = 0.05


def measured(
    colliders: list[dict], dimension: int, points: np.ndarray, normals: int = 1
) -> tuple[tuple[Collider, ...], np.ndarray]:
    """Return colliders, and as kernels find them their distances and normals at points, see `evaluate`; cells of H."""
    corner = box([0.9] * dimension, [0.95] * dimension)
    scene = scene_of(body("b", "jelly", corner), size=[1.0] * dimension, origin=[0.0] * dimension, spacing=H)
    scene = with_colliders(scene, [{"name": f"c{k}"} | collider for k, collider in enumerate(colliders)])
    device = Colliders(ColliderKind.of(scene), dimension, (27,) * dimension, 3, 1, on_cpu=True)
    device.spacing = H
    device.write(scene)
    found = np.zeros((len(points), len(colliders), 1 + normals * dimension))
    evaluate(device, points, found)
    return scene.colliders, found


@pytest.mark.parametrize("dimension", [2, 3])
def test_distances_are_those_of_the_shapes(backend_of: Callable, dimension: int) -> None:
    """As numpy computes them, also turned and as containers; normals are their gradients. f64, to 1e-12 and 1e-4."""
    backend_of("f64", 1)
    shapes = SHAPES_2D if dimension == 2 else SHAPES_3D
    colliders = [{"shape": shape, "angle": 0.3 * k} for k, shape in enumerate(shapes)]
    colliders[2]["side"] = "inside"
    points = np.random.default_rng(0).uniform(0.02, 0.98, (400, dimension))
    made, found = measured(colliders, dimension, points)
    step = 1e-6
    for k, one in enumerate(made):
        expected = one.signed_distance(points)
        around = np.stack(
            [
                (one.signed_distance(points + step * e) - one.signed_distance(points - step * e)) / (2 * step)
                for e in np.eye(dimension)
            ],
            axis=1,
        )
        # Where the gradient is that of an edge or a middle plane, no direction is right.
        smooth = np.abs(np.linalg.norm(around, axis=1) - 1) < 1e-4
        assert smooth.sum() > 300
        # In the corners of a polygon that is not convex they are those of both edges.
        exact = np.abs(found[:, k, 0] - expected) < 1e-12
        assert exact.all() or (corners_of(one)[0] and exact.mean() > 0.99)
        assert np.abs(found[:, k, 0] - expected).max() <= BLEND / 8 * H
        assert np.abs(found[smooth & exact, k, 1:] - around[smooth & exact]).max() < 1e-4


@pytest.mark.parametrize("dimension", [2, 3])
def test_normals_turn_around_a_corner(backend_of: Callable, dimension: int) -> None:
    """From face to face of a box, 0.2 h inside and outside: continuously, that of a corner is its bisector.

    Also where the box is made of two.
    """
    backend_of("f64", 1)
    whole = box([0.2] * dimension, [0.7] * dimension)
    halves = box([0.2] * dimension, [0.7] * (dimension - 1) + [0.5])
    halves |= {"add": [box([0.2] * (dimension - 1) + [0.5], [0.7] * dimension)]}
    along = np.linspace(-2 * H, 2 * H, 801)
    for off in (-0.2 * H, 0.0, 0.2 * H):
        # Along one face, around the corner, and along the other.
        points = np.full((len(along), dimension), 0.45)
        points[:, 0] = 0.7 + np.minimum(-along + off, off)
        points[:, 1] = 0.7 + np.minimum(along + off, off)
        _, found = measured([{"shape": whole}, {"shape": halves}], dimension, points, 2)
        found = found[:, :, 1 + dimension :]
        for normal in (found[:, 0], found[:, 1]):
            assert np.abs(normal[[0, -1], :2] - [[1, 0], [0, 1]]).max() < 1e-9
            assert np.abs(normal[400, :2] - 0.5**0.5).max() < 0.01
            assert np.linalg.norm(np.diff(normal, axis=0), axis=1).max() < 0.02
            assert (normal[:, :2] > -1e-9).all()


def composites(d: int) -> list[dict]:
    """Return forms added and subtracted, one in another, with faces that overlap, meet and end together."""
    wide, across = [0.5] * d, [0.3] * (d - 2)
    bar = {"capsule": {"start": [0.1, 0.5, *across], "end": [0.9, 0.6, *across], "radius": 0.15}}
    lower = box([0.0, 0.0, *across], [1.0, 0.5, *([0.7] * (d - 2))])
    ring = ball(wide, 0.4) | {"subtract": [ball(wide, 0.2)]}
    half = ball(wide, 0.4) | {"subtract": [ball(wide, 0.2), box([0.0, 0.5, *[0.0] * (d - 2)], [1.0] * d)]}
    legs = [box([x, 0.5, *across], [x + 0.2, 0.9, *[0.7] * (d - 2)]) for x in (0.1, 0.7)]
    return [
        box([0.2] * d, [0.7] * d) | {"add": [ball([0.7] * d, 0.2)]},
        box([0.1] * d, [0.6] * d) | {"subtract": [ball([0.6] * d, 0.3)]},
        # An arch: two legs that meet half a ring.
        legs[0] | {"add": [legs[1], half]},
        # A cup: the hole ends with the box.
        box([0.2] * d, [0.8] * d) | {"subtract": [box([*[0.3] * (d - 1), 0.4], [*[0.7] * (d - 1), 0.8])]},
        # Boxes that form one, and a plate with a bar taken away that has a ring of its own.
        box([0.2] * d, [0.5, *[0.7] * (d - 1)]) | {"add": [box([0.5, *[0.2] * (d - 1)], [0.8, *[0.7] * (d - 1)])]},
        lower | {"subtract": [bar | {"add": [ring]}]},
        ring | {"add": [bar | {"subtract": [ball(wide, 0.1)]}]},
    ]


@pytest.mark.parametrize("dimension", [2, 3])
def test_composites_have_the_distances_of_their_surface(backend_of: Callable, dimension: int) -> None:
    """To 1e-3 h and 0.6 degrees, away from edges.

    A point x with the distance phi and the normal n is tested by the inside test of the shape alone. The surface passes
    between y - e n and y + e n, where y = x - phi n and e = 1e-3 h, and between places 0.05 h beside these, and nowhere
    through the ball of radius |phi| - e about x.
    """
    backend_of("f64", 1)
    shapes, random = composites(dimension), np.random.default_rng(1)
    points = random.uniform(0.03, 0.97, (3000, dimension))
    around = random.normal(size=(400, dimension))
    around *= random.uniform(0.0, 1.0, (400, 1)) ** 0.3 / np.linalg.norm(around, axis=1, keepdims=True)
    made, found = measured(
        [{"shape": shape, "side": side} for shape in shapes for side in ("outside", "inside")], dimension, points
    )
    tight = 1e-3 * H
    for k, one in enumerate(made):
        form, sign = one.form, -1.0 if one.side == "inside" else 1.0
        phi, normal = sign * found[:, k, 0], sign * found[:, k, 1:]
        assert ((phi < 0) == form.contains(points))[np.abs(phi) > BLEND / 8 * H].all()
        some = np.flatnonzero(np.abs(phi) < 1.2 * H)
        y = points[some] - phi[some, None] * normal[some]
        ways = []
        for _ in range(3):
            beside = random.normal(size=y.shape)
            beside -= (beside * normal[some]).sum(axis=1, keepdims=True) * normal[some]
            beside *= 0.05 * H / np.linalg.norm(beside, axis=1, keepdims=True)
            ways += [beside, -beside]
        # Away from the edges of a part, and from where two parts meet; corners around the material are rounded.
        parts = [part for clause in clauses_of(form) for part, _ in clause]
        close = np.abs(phi[some]) < BLEND_NEAR * H
        apart = np.ones(len(some), dtype=bool)
        for way in ways:
            beside, far = (
                np.sort([np.abs(part.signed_distance(y + k * way)) for part in parts], axis=0) for k in (3, 25)
            )
            apart &= (beside[0] < 0.02 * H) & (beside[1] > np.where(close, 1.0, 0.15) * H)
            apart &= ~close | (far[0] < 0.3 * H)
        assert apart.sum() > 200
        some, y = some[apart], y[apart]
        for way in (0.0 * y, *(way[apart] for way in ways)):
            assert form.contains(y + way - tight * normal[some]).all()
            assert not form.contains(y + way + tight * normal[some]).any()
        for x, size in zip(points[some[:200]], np.abs(phi[some[:200]]), strict=True):
            assert len(set(form.contains(x + max(size - tight, 0.0) * around))) == 1


def test_a_composite_of_many_forms_is_sampled(backend_of: Callable) -> None:
    """A row of 70 balls: to 0.05 h within a cell of the surface, where two of them do not meet."""
    backend_of("f64", 1)
    row = [ball([0.1 + 0.01 * k, 0.5], 0.1) for k in range(70)]
    points = np.random.default_rng(4).uniform([0.15, 0.3], [0.75, 0.7], (1000, 2))
    (made,), found = measured([{"shape": {**row[0], "add": row[1:]}}], 2, points)
    expected = made.signed_distance(points)
    near = np.abs(expected) < H
    assert np.abs(found[near, 0, 0] - expected[near]).max() < 0.05 * H


@pytest.mark.parametrize("composite", [False, True])
def test_the_normals_of_a_mesh_are_those_of_the_ball(backend_of: Callable, tmp_path: Path, composite: bool) -> None:
    """Of 8 cells across, also with a hole: to 1 degree and 0.01 h within a cell of the surface."""
    import pyvista as pv

    backend_of("f64", 1)
    radius, center = 4 * H, np.array([0.51, 0.48, 0.5])
    pv.Icosphere(radius=radius, center=center, nsub=5).save(tmp_path / "ball.stl")
    shape = {"mesh": {"file": str(tmp_path / "ball.stl")}}
    if composite:
        shape["subtract"] = [box([0.0] * 3, [1.0, 1.0, 0.4])]
    ways = np.random.default_rng(2).normal(size=(2000, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    phi = np.random.default_rng(3).uniform(-1, 1, 2000) * H
    points = center + (radius + phi)[:, None] * ways
    found = measured([{"shape": shape}], 3, points)[1][:, 0]
    upper = points[:, 2] > 0.52
    assert np.abs(found[upper, 0] - phi[upper]).max() < 0.01 * H
    assert np.degrees(np.arccos(np.clip((found[upper, 1:] * ways[upper]).sum(axis=1), -1, 1))).max() < 1.0


def block_on_plane(
    slope: float, tilt: float, friction: float, end: float, *, offset: float, speed: float = 0.0, cells: int = 4
) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Return a flat block on a plane tilted against the grid, with its direction down the slope and its normal.

    Gravity is turned so that the plane has a slope, degrees; it sets in over 0.4 s where the block begins at rest.
    The plane begins `offset` cells from a node. Angles in degrees. All such scenes share a kernel.
    """
    length, height = 1.0, 0.25
    h, turn, angle = height / cells, math.radians(tilt), math.radians(slope)
    down, normal = np.array([math.cos(turn), math.sin(turn)]), np.array([-math.sin(turn), math.cos(turn)])
    pull = G * (math.sin(angle) * down - math.cos(angle) * normal)
    point = np.array([0.5 + 6 * h * bool(tilt), 6 * h + offset * h])
    corner = point + 0.1 * down
    corners = [corner, corner + length * down, corner + length * down + height * normal, corner + height * normal]
    slowly = " + 0*t" if speed else "*(0.5 - 0.5*cos(pi*min(t/0.4, 1)))"
    # What it begins in: the stress of its weight, along the normal.
    strain = [
        [f"{int(i == j)} - {normal[i] * normal[j] * 1000 * G / 1e6} * ({height} - s)" for j in (0, 1)] for i in (0, 1)
    ]
    place = f"({normal[0]}*(X - {corner[0]}) + {normal[1]}*(Y - {corner[1]}))"
    weight = {"deformation": [[entry.replace("s)", f"{place})") for entry in row] for row in strain]} if speed else {}
    material = JELLY | ({"poissons_ratio": 0.0} if speed else {})
    scene = scene_of(
        body("block", material, polygon([list(c) for c in corners]), velocity=list(speed * down), **weight),
        domain={"size": [64 * h, 48 * h], "spacing": h, "gravity": [f"{x}{slowly}" for x in pull]},
        time={"end": end, "frames": 40},
        precision="f64",
        colliders=[{"name": "slope", "shape": plane(point, normal), "friction": friction}],
    )
    return scene, down, normal


def slid(scene: Scene, down: np.ndarray, backend: object) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times, mean places and mean velocities of the block down the slope."""
    frames = [frame for frame, _ in run(scene, backend)]
    return (
        np.array([frame.time for frame in frames]),
        np.array([(frame.position.astype(float) @ down).mean() for frame in frames]),
        np.array([(frame.velocity.astype(float) @ down).mean() for frame in frames]),
    )


SLOW = [pytest.param(tilt, offset, marks=pytest.mark.slow) for tilt in (0.0, 45.0) for offset in (0.3, 0.5)]
PLACES = [(0.0, 0.0), (17.0, 0.3), *SLOW]


@pytest.mark.parametrize(("tilt", "offset"), [pytest.param(*PLACES[0], marks=pytest.mark.slow), *PLACES[1:]])
def test_a_block_slides_down_a_slope(
    backend_of: Callable, tilt: float, offset: float, record_property: Callable
) -> None:
    """a = g (sin - mu cos), to 1 %, along the grid and across it (asked 5 % there)."""
    scene, down, _ = block_on_plane(30.0, tilt, 0.3, 0.9, offset=offset)
    t, _, v = slid(scene, down, backend_of("f64", 1))
    late = t > 0.45
    found = np.polyfit(t[late], v[late], 1)[0]
    expected = G * (math.sin(math.radians(30)) - 0.3 * math.cos(math.radians(30)))
    record_property("error", found / expected - 1)
    assert found == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("tilt", "offset"), [PLACES[0], pytest.param(*PLACES[1], marks=pytest.mark.slow), *PLACES[2:]])
def test_a_block_stays_on_a_slope(backend_of: Callable, tilt: float, offset: float, record_property: Callable) -> None:
    """mu = 0.7 > tan(30 degrees): it drifts by less than 1e-4 of its length in a second."""
    scene, down, _ = block_on_plane(30.0, tilt, 0.7, 1.6, offset=offset)
    t, x, _ = slid(scene, down, backend_of("f64", 1))
    late = t > 0.8
    drift = np.polyfit(t[late], x[late], 1)[0]
    record_property("drift / L", drift)
    assert abs(drift) < 1e-4
    assert abs(x[-1] - x[0]) < 1e-3


@pytest.mark.parametrize(("tilt", "offset"), [PLACES[0], pytest.param(17.0, 0.3, marks=pytest.mark.slow)])
def test_a_block_comes_to_rest(backend_of: Callable, tilt: float, offset: float, record_property: Callable) -> None:
    """Thrown along a floor it stops after v^2 / (2 mu g), to 1 %."""
    scene, down, _ = block_on_plane(0.0, tilt, 0.4, 0.7, offset=offset, speed=2.0)
    _, x, v = slid(scene, down, backend_of("f64", 1))
    expected = 2.0**2 / (2 * 0.4 * G)
    record_property("error", (x[-4:].mean() - x[0]) / expected - 1)
    assert x[-4:].mean() - x[0] == pytest.approx(expected, rel=0.01)
    assert abs(v[-4:].mean()) < 4e-3 * 2.0


@pytest.mark.parametrize("parts", [1, 5, pytest.param(50, marks=pytest.mark.slow)])
def test_a_sliding_block_slows_down_as_fast_at_any_step(backend_of: Callable, parts: int) -> None:
    """At steps of 1, 1/5 and 1/50 its speed falls by mu (g t + v_y)."""
    scene, _, _ = block_on_plane(0.0, 0.0, 0.3, 1.0, offset=0.3, speed=2.0)
    solver = build_run(scene, backend_of("f64", 1))
    step = solver.stable_step()[0] / parts
    while solver.time < 0.1:
        solver.step(step)
    block = bodies_of(solver)["block"]
    along, up = block.momentum() / block.mass.sum()
    assert 2.0 - along == pytest.approx(0.3 * (G * solver.state.velocity_time + up), rel=1e-9)


def test_momentum_goes_to_the_colliders(backend_of: Callable) -> None:
    """Momentum and angular momentum of the particles and what colliders took are constant, to round-off in f64."""
    centers = np.array([[1.0, 0.6], [1.35, 0.95]])
    scene = scene_of(
        block("b", JELLY, [0.8, 0.9], [1.2, 1.2], velocity=[1.0, -1.0]),
        domain={"size": [2.0, 2.0], "spacing": 0.05},
        time={"end": 0.5, "frames": 5},
        precision="f64",
        colliders=[
            {"name": "ball", "shape": ball(centers[0], 0.25), "friction": 0.3},
            collider(
                "paddle", box([1.3, 0.6], [1.4, 1.3]), angular_velocity="2 + 0*t", velocity=["0*t", 0.0], wall="stick"
            ),
        ],
    )
    rows = [row for _, row in run(scene, backend_of("f64", 1))]
    momentum = np.array([row.linear_momentum for row in rows])
    turning = np.array([row.angular_momentum[0] for row in rows])
    force, torque = (np.array([getattr(row, f"collider_{name}") for row in rows]) for name in ("force", "torque"))
    assert (np.abs(force[1:]).max(axis=(0, 2)) > 100).all()
    taken = np.cumsum(0.1 * force.sum(axis=1), axis=0)
    assert np.abs(momentum + taken - momentum[0]).max() < 1e-12 * np.abs(momentum[0]).max()
    arms = centers[None, :, 0] * force[:, :, 1] - centers[None, :, 1] * force[:, :, 0]
    turned = np.cumsum(0.1 * (torque[:, :, 0] + arms).sum(axis=1))
    assert np.abs(turning + turned - turning[0]).max() < 1e-12 * abs(turning[0])


def still_water(n: int, colliders: list[dict], shape: dict, *, side: str = "slip") -> Scene:
    """Return water in the state of its own weight, in a box of n cells."""
    return scene_of(
        body("water", "water", shape, initial_pressure="hydrostatic"),
        domain={"size": [1.0, 1.0], "cells": [n, n], "gravity": [0.0, -9.81], "walls": side},
        frames=20,
        colliders=colliders,
    )


def floor_at(height: float) -> dict:
    """Return a floor across the domain."""
    return {"name": "floor", "shape": plane([0.0, height], [0.0, 1.0])}


@pytest.mark.parametrize("offset", [0.0, pytest.param(0.3, marks=pytest.mark.slow)])
def test_a_floor_carries_the_weight(backend_of: Callable, offset: float, record_property: Callable) -> None:
    """The force on a plane under water at rest, to 1 %."""
    low = (8 + offset) / 32
    # The slab and its motion, which is none, are those of the tank below: both share a kernel.
    slab = {"name": "slab", "shape": box([0.4, 0.8], [0.6, 0.9]), "velocity": ["0*t", 0.0]}
    scene = still_water(32, [floor_at(low), slab], box([0.0, low], [1.0, low + 0.25]))
    rows = [row for _, row in run(scene, backend_of("f32", 1))]
    force = np.mean([row.collider_force[0] for row in rows[10:]], axis=0)
    weight = rows[0].mass * 9.81
    record_property("error", float(-force[1] / weight - 1))
    assert force[1] == pytest.approx(-weight, rel=0.01)
    assert abs(force[0]) < 1e-3 * weight


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_archimedes(backend_of: Callable, offset: float, record_property: Callable) -> None:
    """Water at rest lifts a fixed disk of 10 cells with the weight of what it displaces, to 2 %."""
    n, radius = 64, 0.16
    center = [0.5 + offset / n, 0.3 + offset / n]
    disk = ball(center, radius)
    shape = {"box": {"min": [0.0, 0.0], "max": [1.0, 0.6]}, "subtract": [disk]}
    rows = [row for _, row in run(still_water(n, [{"name": "disk", "shape": disk}], shape), backend_of("f32", 1))]
    force = np.mean([row.collider_force[0] for row in rows[5:]], axis=0)
    weight = 1000 * math.pi * radius**2 * 9.81
    record_property("error", float(force[1] / weight - 1))
    assert force[1] == pytest.approx(weight, rel=0.02)


@pytest.mark.parametrize("speed", [4.0, pytest.param(40.0, marks=pytest.mark.slow)])
def test_nothing_passes_a_collider_that_moves(backend_of: Callable, speed: float) -> None:
    """A slab sweeps a tank: all water stays before it, whatever its speed; steps are at most half a cell of it."""
    h = 1 / 32
    slab = collider("slab", box([0.0, -0.5], [0.15, 2.0]), velocity=[f"{speed} if t < {0.6 / speed} else 0", 0.0])
    end, low = 0.65 / speed, 2 * h
    water = box([0.15 + h, low], [0.5, low + 0.3])
    scene = scene_of(
        body("w", "water", water),
        domain={"size": [1.0, 1.0], "spacing": h, "gravity": [0.0, -9.81], "walls": "slip"},
        time={"end": end, "frames": 6},
        colliders=[floor_at(low), slab],
    )
    frames = run(scene, backend_of("f32", 1))
    for frame, row in frames:
        face = 0.15 + min(frame.time * speed, 0.6)
        assert frame.position[:, 0].min() > face - 0.5 * h
        assert row.step_max <= 0.8 * 0.5 * h / speed * (1 + 1e-6)
    assert frames[-1][0].position[:, 0].min() > 0.7


def test_a_collider_at_speed_limits_the_step(backend_of: Callable) -> None:
    """Half a cell of the fastest point of a blade at most, though nothing is near it; the ledger says what binds."""
    blade = collider(
        "blade", box([0.5, 0.7], [0.9, 0.75]), angular_velocity="60 + 0*t", velocity=["0*t", 0.0], pivot=[0.5, 0.7]
    )
    # With the ball the kernel is that of the scene above.
    ball = {"name": "ball", "shape": {"ball": {"center": [1.5, 1.5], "radius": 0.2}}}
    scene = scene_of(
        block("b", JELLY, [0.1, 0.1], [0.2, 0.2]),
        domain={"size": [2.0, 2.0], "spacing": 0.05},
        end=0.002,
        precision="f64",
        colliders=[ball, blade],
    )
    solver = build_run(scene, backend_of("f64", 1))
    limit = {one.name: one for one in solver.limits()}["collider"]
    assert limit.value == pytest.approx(0.5 * 0.05 / (60 * math.hypot(0.4, 0.05)))
    assert list(solver.frames())[-1][1].limit == "collider"
    assert "collider" in limit.why


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_turning_colliders_are_where_their_motion_says(backend_of: Callable, dimension: int) -> None:
    """A body that is held by a shape that turns and moves goes with it: each particle to 1e-3 of a cell in f64."""
    h, d = 0.1, dimension
    turn = {"angular_velocity": "3 + 4*t", "velocity": ["0.2*cos(5*t)", *[0.1] * (d - 1)], "pivot": [0.9] * d}
    if d == 3:
        turn["axis"] = [1.0, -2.0, 0.5]
    ball = {"ball": {"center": [1.0] * d, "radius": 2.6 * h}}
    held = {"name": "c", "shape": {"ball": {"center": [1.0] * d, "radius": 5 * h}}, "wall": "hold"} | turn
    # In 2D, with the post, the kernel is that of the scenes above.
    post = {"name": "post", "shape": box([0.0] * d, [0.1] * d)}
    scene = scene_of(
        body("b", JELLY, ball), size=[4.0] * d if d == 2 else [2.0] * d, spacing=h, end=0.5, precision="f64"
    )
    scene = with_colliders(scene, [post, held])
    frames = run(scene, backend_of("f64", 1))
    start, end = (frame.position.astype(float) for frame, _ in (frames[0], frames[-1]))
    expected = scene.colliders[1].motion.placed(start, 0.5)
    assert np.abs(end - start).max() > 3 * h
    assert np.abs(end - expected).max() < 0.02 * h


@ti.kernel
def begin_step(motion: ti.template()):
    motion.advance(0, ti.cast(1e-3, ti.f64))


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_collider_stands_as_it_should_after_many_turns(backend_of: Callable, dimension: int) -> None:
    """To the 1e-10 of a turn that its two parts in the kernel leave, in f64; from 0.8 of a turn to 1,000 back."""
    backend_of("f64", 1)
    d, axis = dimension, {"axis": [1.0, -2.0, 0.5]} if dimension == 3 else {}
    box = {"box": {"min": [0.4] * d, "max": [0.5] * d}}
    body = {"name": "b", "material": {"law": "fluid", "density": 1e3, "bulk_modulus": 1e4}, "shape": box}
    scene = scene_of(body, domain={"size": [1.0] * d, "spacing": 0.1})
    turns = [0.8, 1.3, 12.6, -7.2, -1000.4]
    scene = with_colliders(
        scene,
        [{"name": f"c{k}", "shape": box, "angle": f"{2 * math.pi * n} + 3*t", **axis} for k, n in enumerate(turns)],
    )
    device = Colliders(ColliderKind.of(scene), d, (17,) * d, 3, 1, on_cpu=True)
    motion = ColliderMotion(device, 1)
    device.write(scene)
    motion.write(scene)
    begin_step(motion)
    for k, (one, n) in enumerate(zip(scene.colliders, turns, strict=True)):
        expected = one.motion.pose(0.0)[1]
        assert np.abs(device.turned[k].to_numpy() - expected).max() < 1e-9 * max(1.0, abs(n)), n


@ti.kernel
def book(loads: ti.template(), impulses: ti.types.ndarray(), arms: ti.types.ndarray()):
    """Book all impulses (n, d) at their arms (n, d), each in a row of nodes of its own."""
    ti.loop_config(serialize=True)
    for p in range(impulses.shape[0]):
        d = ti.static(loads.dimension)
        impulse, arm, node = ti.Vector.zero(float, d), ti.Vector.zero(float, d), ti.Vector.zero(int, d)
        node[d - 2] = p
        for a in ti.static(range(d)):
            impulse[a], arm[a] = impulses[p, a], arms[p, a]
        loads.take(0, node, 0, impulse, arm)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_torque_is_the_arm_times_the_force(backend_of: Callable, dimension: int) -> None:
    backend_of("f64", 1)
    d, rng = dimension, np.random.default_rng(0)
    loads = Loads(1, (17,) * d, 1, on_cpu=True)
    impulses, arms = rng.uniform(-1, 1, (2, 10, d))
    book(loads, impulses, arms)
    found = loads.taken.to_numpy()[:10]
    # In 2D that about the axis out of the plane.
    full_arms, full_impulses = (np.pad(vectors, ((0, 0), (0, 3 - d))) for vectors in (arms, impulses))
    torque = np.cross(full_arms, full_impulses)[:, [2] if d == 2 else [0, 1, 2]]
    assert np.abs(found - np.hstack([impulses, torque])).max() < 1e-14


@pytest.mark.gpu
def test_a_run_on_a_gpu_follows_the_cpu(backend_of: Callable) -> None:
    """Equal steps between colliders at rest and moving: positions to round-off, forces after twenty to 1e-5.

    Later, rounding decides where grains go: after sixty steps one in ten may be elsewhere, by less than 1e-3 m.
    """
    scene = scene_named("colliders")
    found = []
    for arch in ("vulkan", "cpu"):
        run = build_run(scene, backend_of("f32", 1, arch))
        for _ in range(20):
            run.step(2e-4)
        _, row = run.frame()
        for _ in range(40):
            run.step(2e-4)
        found.append((run.frame()[0], np.array(row.collider_force), np.array(row.collider_torque)))
    (own, force, torque), (other, expected_force, expected_torque) = found
    apart = np.abs(own.position - other.position).max(axis=1)
    assert np.quantile(apart, 0.9) < farthest(other.position, other.velocity, 60, other.time)
    assert apart.max() < 1e-3
    scale = np.abs(expected_force).max()
    assert scale > 10
    assert np.abs(force - expected_force).max() < 1e-5 * scale
    assert np.abs(torque - expected_torque).max() < 1e-5 * np.abs(expected_torque).max()
