"""Pinned parts (colliders that hold) and loads (forces in newtons): against Newton's laws and bent beams."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from good_scene import refusal
from rounding import farthest
from scenes import ball, body, box, scene_of, solid
from scipy.optimize import brentq
from solver_state import bodies_of

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene
from mpmcli.solver.engine.run import build_run
from mpmcli.validation.cases.cantilever import BELOW, LENGTH, THICKNESS, SmallBend

JELLY = {"law": "fixed_corotated", "density": 1000.0, "youngs_modulus": 2e4, "poissons_ratio": 0.2}
H = 0.05


def block(**tables: object) -> Scene:
    """Return a block of 8 x 6 cells of jelly in free space."""
    shape = box([0.4, 0.4], [0.8, 0.7])
    return scene_of(
        body("block", JELLY, shape),
        domain={"size": [2.0, 1.2], "spacing": H} | tables.pop("domain", {}),
        time={"end": 0.2, "frames": 4},
        precision="f64",
        **tables,
    )


def held(**more: object) -> dict:
    """Return what holds the left end of the block, three cells wide, and moves it; one kernel is for all of these."""
    shape = box([0.3, 0.3], [0.55, 0.8])
    return {"name": "clamp", "wall": "hold", "shape": shape, "offset": ["0.2 * t", "0.0"], **more}


def run(scene: Scene, backend_of: Callable) -> tuple[Frame, Frame, list[LedgerRow]]:
    """Return the first and the last frame, and the ledger."""
    frames = list(build_run(scene, backend_of("f64", 1)).frames())
    return frames[0][0], frames[-1][0], [row for _, row in frames]


# Where a force acts on each of three blocks: all of it, its right half, and a disk in its middle.
LOWS = {"whole": (0.2, 0.15), "half": (0.2, 0.7), "disk": (0.8, 0.4)}
REGIONS = {"whole": {}, "half": {"region": box([0.4, 0.0], [0.8, 1.2])}, "disk": {"region": ball([1.0, 0.55], 0.1)}}


def pushed() -> Scene:
    """Return three blocks and a rigid ball that forces push, far from each other, in one scene for one kernel."""
    return scene_of(
        *(body(name, JELLY, box([x, y], [x + 0.4, y + 0.3])) for name, (x, y) in LOWS.items()),
        domain={"size": [2.0, 1.2], "spacing": H},
        time={"end": 0.2, "frames": 4},
        colliders=[{"name": "ball", "density": 500.0, "shape": ball([1.6, 0.6], 0.15)}],
        forces=[
            *({"body": name, "force": [60.0, -20.0], **region} for name, region in REGIONS.items()),
            {"body": "ball", "force": [30.0, 0.0]},
        ],
        precision="f64",
    )


def test_a_force_accelerates_a_body_by_its_size_over_the_mass(backend_of: Callable) -> None:
    """Momentum is force times time, to rounding, wherever it acts; velocities are those half a step before a frame."""
    solver = build_run(pushed(), backend_of("f64", 1))
    rows = [row for _, row in solver.frames()]
    lag = 0.5 * rows[-1].step_min
    assert rows[-1].step_min == pytest.approx(rows[-1].step_max)
    gained = np.array([60.0, -20.0]) * (0.2 - lag)
    for state in bodies_of(solver).values():
        assert state.momentum() == pytest.approx(gained, rel=1e-9)
    assert rows[-1].linear_momentum == pytest.approx(len(LOWS) * gained, rel=1e-9)


def test_a_force_on_a_rigid_body_is_one(backend_of: Callable) -> None:
    *_, rows = run(pushed(), backend_of)
    lag = 0.5 * rows[-1].step_min
    gained = 30.0 * (0.2 - lag) / (500.0 * np.pi * 0.15**2)
    assert rows[-1].rigid_motion[0][0] == pytest.approx(gained, rel=1e-5)


def test_what_holds_takes_what_the_body_lacks(backend_of: Callable) -> None:
    """The momentum that gravity gave is in the body or in the clamp, which the ledger tells; its inside sinks nowhere.

    So is what the clamp gives as it moves aside.
    """
    gravity = {"gravity": [0.0, -9.81]}
    start, frame, rows = run(block(domain=gravity, colliders=[held()]), backend_of)
    took = sum(np.array(b.collider_force[0]) * (b.time - a.time) for a, b in pairwise(rows))
    lag = 0.5 * rows[-1].step_min
    weight = rows[0].mass * 9.81
    there = np.array(rows[-1].linear_momentum) - np.array(rows[0].linear_momentum)
    # What the clamp takes is counted to the end of the last step.
    assert there + took == pytest.approx([0.0, -weight * (0.2 - lag)], abs=0.01 * weight * 0.2)
    # Some of the block sinks; two cells inside of the clamp nothing does.
    moved = frame.position - start.position
    inside = start.position[:, 0] < 0.55 - 2 * H
    assert np.abs(moved[inside] - [0.04, 0.0]).max() < 1e-12 and moved[:, 1].min() < -0.01


def gripped(first: dict, second: dict) -> Scene:
    """Return a bar of 16 x 4 cells on the grid of its state at rest, with a clamp at each end, 11 cells apart.

    Their faces are half a cell from nodes: what is held then ends at the faces, and elsewhere up to half a cell off.
    """
    ends = box([0.3, 0.3], [0.7251, 0.9]), box([1.2749, 0.3], [1.8, 0.9])
    return scene_of(
        body("bar", solid(2e4, poissons_ratio=0.3), box([0.6, 0.5], [1.4, 0.7])),
        domain={"size": [2.0, 1.2], "spacing": H},
        frames=4,
        colliders=[
            {"name": f"clamp {k}", "wall": "hold", "shape": end, **more}
            for k, (end, more) in enumerate(zip(ends, (first, second), strict=True))
        ],
        solver={"precision": "f64", "solids": "total"},
    )


def test_a_bar_of_total_solids_is_pulled_to_twice_its_length(backend_of: Callable) -> None:
    """P = mu (F - F^-T) + lambda ln J F^-T, free across: its force to a fifth of a cell in 11."""
    pull = "0.275 * (t - sin(2*pi*t) / (2*pi))"
    one, other = ({"axes": ["x"], "offset": [f"{sign}{pull}", "0.0"]} for sign in ("-", ""))
    start, frame, rows = run(gripped(one, other), backend_of)
    mu, lame = 2e4 / 2.6, 2e4 * 0.3 / (1.3 * 0.4)
    stretch = 2.0
    across = brentq(lambda b: mu * (b - 1 / b) + lame * np.log(stretch * b) / b, 0.2, 1.0)
    force = 0.2 * (mu * (stretch - 1 / stretch) + lame * np.log(stretch * across) / stretch)
    left, right = (row[0] for row in rows[-1].collider_force)
    assert (left - right) / 2 == pytest.approx(force, rel=0.02)
    free = np.abs(start.position[:, 0] - 1.0) < 0.2
    assert np.diff([frame.position[free, 0].min(), frame.position[free, 0].max()]) == pytest.approx(
        2 * np.ptp(start.position[free, 0]), rel=0.05
    )


def test_a_bar_of_total_solids_turns_with_its_clamps(backend_of: Callable) -> None:
    """By a right angle: both ends as a rigid body, and the middle nearly, without a change of its volume."""
    turn = {"pivot": [1.0, 0.6], "angular_velocity": "pi/2 * (1 - cos(2*pi*t))"}
    start, frame, rows = run(gripped(turn, turn), backend_of)
    away = start.position - [1.0, 0.6]
    turned = np.stack([1.0 - away[:, 1], 0.6 + away[:, 0]], axis=1)
    held = np.abs(start.position[:, 0] - 1.0) > 0.25 + 2 * H
    assert frame.position[held] == pytest.approx(turned[held], abs=1e-9)
    assert frame.position == pytest.approx(turned, abs=0.2 * H)
    assert rows[-1].volume_ratio_min == pytest.approx(1.0, abs=0.02)


def test_it_moves_along_a_path_and_lets_go_of_axes(backend_of: Callable) -> None:
    """A part moves with its clamp, and one that holds y alone slides along x as if free."""
    start, frame, _ = run(block(colliders=[held()]), backend_of)
    moved = frame.position - start.position
    inside = start.position[:, 0] < 0.55 - 2 * H
    assert moved[inside] == pytest.approx(np.tile([0.04, 0.0], (inside.sum(), 1)), abs=1e-12)
    whole = held(axes=["y"]) | {"shape": box([0.0, 0.0], [2.0, 1.2])}
    start, frame, rows = run(block(domain={"gravity": [1.0, -9.81]}, colliders=[whole]), backend_of)
    moved = frame.position - start.position
    assert moved == pytest.approx(np.tile([0.5 * 0.2**2, 0.0], (len(moved), 1)), rel=1e-6, abs=1e-12)
    assert rows[-1].collider_force[0][1] == pytest.approx(-9.81 * rows[0].mass, rel=1e-6)


@pytest.mark.gpu
def test_a_gpu_holds_as_the_cpu_does(backend_of: Callable) -> None:
    scene = block(domain={"gravity": [0.0, -9.81]}, colliders=[held(axes=["y"])])
    found = []
    for arch, precision in (("vulkan", "f32"), ("cpu", "f64")):
        steps = build_run(scene, backend_of(precision, 1, arch))
        for _ in range(100):
            steps.step(5e-4)
        frame, row = steps.frame()
        found.append((frame, np.array(row.collider_force[0])))
    (own, force), (other, expected_force) = found
    apart = farthest(other.position, other.velocity, 100, other.time)
    assert np.abs(own.position - other.position).max() < apart
    assert force == pytest.approx(expected_force, rel=1e-3, abs=1e-3 * np.abs(expected_force).max())
    assert np.abs(expected_force[0]) < 1e-3 * np.abs(expected_force[1])


@pytest.mark.parametrize("shift", [0.0, 0.3, 0.6])
def test_a_beam_bends_as_one_that_a_wall_holds(backend_of: Callable, shift: float) -> None:
    """To first order: what holds ends half a cell off at most, and the cube of the length counts."""
    case, n = SmallBend(), 4
    tables = case.tables(n)
    domain = tables["domain"]
    domain["origin"], domain["size"][0] = [-1.0 - shift * domain["spacing"], -BELOW], domain["size"][0] + 1.0
    del domain["walls"]
    tables["bodies"][0]["shape"] = box([-0.75, 0.0], [LENGTH, THICKNESS])
    clamp = {"min": [-0.9, -0.5], "max": [0.0, THICKNESS + 0.5]}
    tables["colliders"] = [{"name": "clamp", "wall": "hold", "shape": {"box": clamp}}]
    tables["solver"] = {"precision": "f64"}
    scene = parse_scene(tables, laws=parameter_models()).scene
    error = case.measure(n, scene, list(build_run(scene, backend_of("f64", 1)).frames()))["tip error"]
    off = (1 + min(shift, 1 - shift) / n / LENGTH) ** 3 - 1
    assert error < 0.045 + off


HOLD = """\
domain = { size = [2.0, 1.0], spacing = 0.05 }
time = { end = 0.2, frames = 4 }
[[bodies]]
name = "block"
material = "jelly"
shape = { box = { min = [0.2, 0.3], max = [0.6, 0.6] } }
[[colliders]]
name = "clamp"
wall = "hold"
shape = { box = { min = [0.1, 0.2], max = [0.3, 0.7] } }
[[forces]]
body = "block"
force = [1.0, 0.0]
"""


@pytest.mark.parametrize(("good", "bad", "said"), [
    ('wall = "hold"', 'wall = "stick"\naxes = ["x"]', 'axes: is for wall = "hold", and wall is "stick"'),
    ('wall = "hold"', 'wall = "hold"\naxes = []', "axes: must be some of x, y; found []"),
    ('wall = "hold"', 'wall = "hold"\naxes = ["z"]', "axes: must be some of x, y; found ['z']"),
    ('wall = "hold"', 'wall = "hold"\nfriction = 0.3', 'friction: is for a surface that slips or separates'),
    ('wall = "hold"', 'wall = "hold"\ndensity = 10.0', 'wall: is "hold", which is for the inside'),
    ('body = "block"\n', "", "body: missing key: the body that the force is spread over"),
    ("force = [1.0, 0.0]", "", "acceleration: missing key: m/s^2, one entry per axis; or give force, N"),
    ("force = [1.0, 0.0]", "force = [1.0, 0.0]\nregion = { ball = { center = [1.5, 0.5], radius = 0.1 } }",
     "region: no particle starts there; move it or make it larger"),
    ("force = [1.0, 0.0]", "force = [1.0, 0.0]\nregion = {}", "region: must be one of box and ball"),
])  # fmt: skip
def test_each_bad_one_has_its_sentence(good: str, bad: str, said: str) -> None:
    (line,) = refusal(HOLD.replace(good, bad))
    assert said in line
