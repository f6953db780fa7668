"""What walls do to material, beyond the step-by-step comparison with plain numpy in test_solver_paths.py.

A slip wall is a mirror: material against it moves as its half of a mirrored pair that has no wall. A separating wall
only pushes. A sticking wall holds.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scenes import ball, block, body, scene_of, slow
from solver_state import BodyState, bodies_of

from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.engine.run import build_run

H = 0.1
SOLID = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 2e4, "poissons_ratio": 0.3}
# One law is enough in 3D, where a second one would double the compile time.
BODIES = {2: ("solid", "liquid"), 3: ("solid",)}
# With suction: without it the answer jumps where rounding decides whether a particle is open or closed.
LIQUID = {"law": "fluid", "density": 800.0, "bulk_modulus": 2e4, "tension_cutoff": False}


def two_bodies(dimension: int, cells: int, walls: object) -> Scene:
    """Return a scene with the bodies of `BODIES`, whose particles tests put where they want."""
    d = dimension
    low, high = [0.3] * d, [0.5] * d
    bodies = [block("solid", SOLID, low, high), block("liquid", LIQUID, [0.7, *low[1:]], [0.9, *high[1:]])]
    return scene_of(
        domain={"size": [cells * H] * d, "spacing": H, "walls": walls},
        time={"end": 1.0, "frames": 1},
        # A shift goes half of the way to a wall at most, and to a mirror image as far as to any other particle.
        solver={"precision": "f64", "redistribute": False},
        bodies=[body for body in bodies if body["name"] in BODIES[d]],
    )


def against_corner(dimension: int) -> list[BodyParticles]:
    """Return the bodies of `BODIES` with random particles that fly into the corner at the origin."""
    random = np.random.default_rng(dimension)
    d, n = dimension, 12 * dimension
    found = []
    for name, low, high in (("solid", 0.0, 0.28), ("liquid", 0.3, 0.5))[: len(BODIES[d])]:
        position = random.uniform(0.0, 0.3, (n, d))
        position[:, 0] = random.uniform(low, high, n)
        velocity = np.full(d, -0.8) + random.normal(0, 0.2, (n, d))
        affine = random.normal(0, 1.0, (n, d, d))
        density = (SOLID if name == "solid" else LIQUID)["density"]
        volume = 0.28 * 0.3 ** (d - 1) / n
        found.append(BodyParticles(name, position, velocity, affine, volume, density * volume))
    return found


def mirrored(body: BodyParticles, about: Sequence[float], axes: Sequence[tuple[float, ...]]) -> BodyParticles:
    """Return one body of copies of this one, each turned over along the axes where its sign is -1.

    x -> about + R (x - 0), v -> R v and C -> R C R with R = diag(signs); `about` is where x = 0 lies.
    """
    parts = []
    for signs, origin in zip(axes, about, strict=True):
        R = np.diag(signs)
        parts.append((np.asarray(origin) + body.position @ R, body.velocity @ R, R @ body.affine @ R))
    position, velocity, affine = (np.concatenate(p) for p in zip(*parts, strict=True))
    return replace(body, position=position, velocity=velocity, affine=affine)


def run(
    backend_of: Callable, scene: Scene, particles: list[BodyParticles], steps: int, dt: float
) -> dict[str, BodyState]:
    """Return the bodies after some steps."""
    run = build_run(scene, backend_of("f64"), particles)
    for _ in range(steps):
        run.step(dt)
    return bodies_of(run)


@pytest.mark.parametrize("dimension", [2, slow(3)])
def test_a_slip_corner_is_its_mirror_image(backend_of: Callable, dimension: int, record_property: Callable) -> None:
    """A body in each corner of a box moves as its part of 2^d mirrored bodies around a point, to 1e-10.

    All lower and upper faces, edges and corners are in it, and in 2D both laws.
    """
    d = dimension
    signs = list(itertools.product((1.0, -1.0), repeat=d))
    base = against_corner(d)
    steps, dt = 120, 0.004
    size = 16 * H
    corners = [[0.0 if s > 0 else size for s in sign] for sign in signs]
    boxed = run(backend_of, two_bodies(d, 16, "slip"), [mirrored(body, corners, signs) for body in base], steps, dt)
    far = 24 if d == 3 else 32
    centre = [[far * H / 2] * d] * len(signs)
    free = run(backend_of, two_bodies(d, far, "separate"), [mirrored(body, centre, signs) for body in base], steps, dt)
    largest = 0.0
    for name in BODIES[d]:
        n = len(base[0].position)
        for k, sign in enumerate(signs):
            rows = slice(k * n, (k + 1) * n)
            expected = (free[name].x[:n] - np.array(centre[0])) * np.array(sign)
            found = boxed[name].x[rows] - np.array(corners[k])
            largest = max(largest, float(np.abs(found - expected).max()))
            # No body meets one of another corner: those have no image in the mirrored scene.
            assert np.abs(found).max() < size / 2 - 1.5 * H
            speed = (boxed[name].v[rows] - free[name].v[:n] * np.array(sign)) / 0.8
            largest = max(largest, float(np.abs(speed).max()))
        assert np.abs(boxed[name].v - np.concatenate([mirrored_v(base, name, s) for s in signs])).max() > 0.1
    record_property("largest difference", largest)
    assert largest < 1e-10


def mirrored_v(base: list[BodyParticles], name: str, signs: tuple[float, ...]) -> np.ndarray:
    """Return the initial velocities of one copy."""
    return next(body for body in base if body.name == name).velocity * np.array(signs)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_slip_wall_mirrors_a_separating_floor_too(backend_of: Callable, seed: int, record_property: Callable) -> None:
    """Where a slip wall meets a separating floor, the half scene is still half of the mirrored one, to 1e-10.

    The floor decides at each node whether it is pressed: next to the slip wall from the momentum of both
    halves, so that random velocities, which differ in sign from node to node, must lead to the same answer.
    """
    random = np.random.default_rng(seed)
    base = [
        replace(body, position=body.position * [1.0, 0.5], velocity=random.normal(0, 1, body.velocity.shape))
        for body in against_corner(2)
    ]
    steps, dt = 5, 0.004
    half = run(backend_of, two_bodies(2, 16, {"default": "separate", "x_min": "slip"}), base, steps, dt)
    centre = [[1.6, 0.0]] * 2
    signs = [(1.0, 1.0), (-1.0, 1.0)]
    whole = run(backend_of, two_bodies(2, 32, "separate"), [mirrored(body, centre, signs) for body in base], steps, dt)
    n = len(base[0].position)
    largest = max(float(np.abs(half[name].v - whole[name].v[:n]).max()) for name in BODIES[2])
    record_property("largest difference", largest)
    assert largest < 1e-10


def block_scene(walls: object, gravity: Sequence[float], **body: object) -> Scene:
    """Return a scene with an elastic block of 4 x 3 cells on the floor."""
    return scene_of(
        block("block", SOLID, [0.6, 0.0], [1.0, 0.3], **body),
        domain={"size": [2.0, 1.2], "spacing": H, "walls": walls, "gravity": list(gravity)},
        precision="f64",
    )


def test_slip_walls_leave_motion_along_them_alone(backend_of: Callable) -> None:
    """A block pressed on a slip floor falls sideways freely: v_cm = g_x (t - dt/2), whatever it does upwards."""
    scene = block_scene("slip", [0.5, -2.0])
    samples = sample_bodies(scene)
    steps, dt = 200, 0.004
    block = run(backend_of, scene, samples, steps, dt)["block"]
    start = samples[0].position
    assert np.average(block.v[:, 0], weights=block.mass) == pytest.approx(0.5 * (steps - 0.5) * dt, rel=1e-12)
    fallen = 0.5 * (steps * dt) ** 2 / 2
    assert (block.x - start)[:, 0].mean() == pytest.approx(fallen, rel=1e-12)
    # And it does not fall through: the floor carries it, at most twice the static strain rho g H / E lower.
    sunk = (start - block.x)[:, 1].mean()
    assert 0 < sunk < 2 * 1000.0 * 2.0 * 0.3**2 / 2e4


def test_sticking_walls_hold(backend_of: Callable) -> None:
    """The same block on a sticking floor stays: what hangs on shear moves at most twice the static amount.

    u_x = rho g_x (H y - y^2/2) / mu, its mean rho g_x H^2 / (3 mu), some more for bending; the first cell's
    particles move by a few per cent of a cell.
    """
    scene = block_scene("stick", [0.5, -2.0])
    samples = sample_bodies(scene)
    start = samples[0].position
    mu = 2e4 / 2.6
    run = build_run(scene, backend_of("f64"), samples)
    most = lowest = 0.0
    for _ in range(200):
        run.step(0.004)
        moved = np.abs((bodies_of(run)["block"].x - start)[:, 0])
        most, lowest = max(most, moved.mean()), max(lowest, moved[start[:, 1] < H / 2].max())
    static = 1000.0 * 0.5 * 0.3**2 / (3 * mu)
    assert static / 2 < most < 4 * static
    assert lowest < 0.02 * H


@pytest.mark.parametrize("walls", ["separate", "slip"])
def test_only_separating_walls_let_go_without_a_pull(backend_of: Callable, walls: str) -> None:
    """A block that rests on the floor and moves up and along: a separating floor does not touch it.

    v stays uniform and F = I to round-off; a slip floor, which is a mirror, pulls back.
    """
    scene = block_scene(walls, [0.0, 0.0], velocity=[0.3, 0.5])
    samples = sample_bodies(scene)
    steps, dt = 60, 0.004
    block = run(backend_of, scene, samples, steps, dt)["block"]
    if walls == "separate":
        assert np.abs(block.v - [0.3, 0.5]).max() < 1e-12
        assert np.abs(block.deformation - np.eye(2)).max() < 1e-12
    else:
        assert (block.mass @ block.v)[1] < 0.9 * block.mass.sum() * 0.5


def test_balls_leave_the_walls_that_they_hit(backend_of: Callable, record_property: Callable) -> None:
    """Four elastic balls, thrown at the four faces, come back with their energy but for what the impact cost.

    The scene is the same under a quarter turn, so the four do the same to 1e-10.
    """
    size, radius, speed = 2.4, 0.25, 1.0
    scene = scene_of(
        body("ball", SOLID, ball([size / 2, 0.4], radius), velocity=[0.0, -speed]),
        domain={"size": [size, size], "spacing": H / 2, "walls": "separate"},
        precision="f64",
    )
    sample = sample_bodies(scene)[0]
    n, middle = sample.count, size / 2
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    turns = [np.linalg.matrix_power(turn, k) for k in range(4)]
    balls = replace(
        sample,
        position=np.concatenate([(sample.position - middle) @ R.T + middle for R in turns]),
        velocity=np.concatenate([sample.velocity @ R.T for R in turns]),
        affine=np.tile(sample.affine, (4, 1, 1)),
    )
    run = build_run(scene, backend_of("f64"), [balls])
    nearest = np.inf
    dt = 0.5 * run.stable_step()[0]
    steps = round(0.7 / dt)
    for _ in range(steps):
        run.step(dt)
        nearest = min(nearest, bodies_of(run)["ball"].x[:n, 1].min())
    after = bodies_of(run)["ball"]
    # It touched the floor and is well clear of it now.
    assert nearest < H / 2
    assert after.x[:n, 1].min() > 1.5 * H
    back = float(after.v[:n, 1].mean() / speed)
    record_property("restitution", back)
    assert 0.7 < back < 1.0
    for k, R in enumerate(turns):
        x = (after.x[k * n : (k + 1) * n] - middle) @ R + middle
        assert np.abs(x - after.x[:n]).max() < 1e-10


@pytest.mark.slow
def test_resting_fluid_stays_on_a_separating_floor(backend_of: Callable, record_property: Callable) -> None:
    """A column that starts with its pressure, p = rho g (H - Y), stays as it is (6.1 b).

    After 20 periods of its slowest wave, 4 H / c, it has moved by a small part of a cell, its speed is far
    below sqrt(g H), and its pressure is within 5 % (relative L2).
    """
    height, g, rho, K, h = 1.0, 9.81, 1000.0, 1.962e6, 1 / 32
    scene = scene_of(
        block("column", {"law": "fluid", "density": rho, "bulk_modulus": K}, [0.0, 0.0], [8 * h, height]),
        domain={"size": [8 * h, 1.25], "spacing": h, "gravity": [0.0, -g], "walls": "separate"},
        precision="f64",
    )
    sample = sample_bodies(scene)[0]
    Y = sample.position[:, 1]
    pressure = rho * g * (height - Y)
    run = build_run(scene, backend_of("f64"), [sample])
    run.groups[0].replace(deformation=1 / (1 + pressure / K))
    c = np.sqrt(K / rho)
    dt = run.stable_step()[0]
    fastest = 0.0
    steps = round(20 * 4 * height / c / dt)
    for n in range(steps):
        run.step(dt)
        if n > steps // 2:
            fastest = max(fastest, float(np.abs(bodies_of(run)["column"].v).max()))
    column = bodies_of(run)["column"]
    moved = np.abs(column.x - sample.position).max() / h
    found = K * (1 / column.deformation - 1)
    error = float(np.sqrt(((found - pressure) ** 2).sum() / (pressure**2).sum()))
    record_property("max speed / sqrt(gH)", fastest / np.sqrt(g * height))
    record_property("displacement / h", float(moved))
    record_property("pressure error", error)
    record_property("steps", steps)
    assert fastest < 0.01 * np.sqrt(g * height)
    assert moved < 0.25
    assert error < 0.05


@pytest.mark.parametrize(
    ("rows", "sampling", "safety"),
    [(8, "lattice", 0.8), (1, "lattice", 0.8), (8, "jittered", 0.8), (8, "lattice", 0.4)],
)
@pytest.mark.parametrize(
    "material",
    [
        {"law": "fluid", "density": 1000.0, "bulk_modulus": 8e5},
        slow({"law": "sand", "density": 1600.0, "youngs_modulus": 6e5, "poissons_ratio": 0.3, "friction_angle": 35.0}),
    ],
    ids=["water", "sand"],
)
def test_what_falls_on_a_separating_wall_meets_it_where_it_is(
    backend_of: Callable, material: dict, rows: int, sampling: str, safety: float
) -> None:
    """Rows of cells that fall three cells fall freely to a third of a cell, and then lie on the wall.

    Neither the sample nor the step matters. The lowest particles start a quarter of a cell above the lower side.
    Material that acted on the wall as soon as its kernel reached it was stopped 0.8 to 0.95 cells above it, and a
    single row stayed 0.65 cells above.
    """
    g, size = 9.81, 2.4
    asked = scene_of(
        domain={
            "size": [size, 1.5],
            "spacing": H,
            "gravity": [0.0, -g],
            "walls": {"default": "slip", "y_min": "separate"},
        },
        # A row of two particles bounces like one.
        time={"end": 2.4 if rows > 1 else 4.0, "frames": 480 if rows > 1 else 800, "safety": safety},
        bodies=[block("body", material, [0.0, 3 * H], [size, (3 + rows) * H], sampling=sampling)],
    )
    frames = [frame for frame, _ in build_run(asked, backend_of("f32", 1)).frames()]
    gap = {frame.time: frame.position[:, 1].min() / H - 0.25 for frame in frames}
    slowed = next(f.time for f in frames if f.time > 0.1 and f.velocity[:, 1].mean() > -0.985 * g * f.time)
    assert -0.1 < gap[slowed] < 1 / 3
    level = np.mean([frame.position[:, 1].mean() for frame in frames[-80:]]) / H
    # A single row has no weight on it that would press it down.
    assert level == pytest.approx(rows / 2, abs=0.12 if rows > 1 else 1 / 3)
