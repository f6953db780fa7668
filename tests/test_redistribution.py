"""Particles are shifted out of crowds: by the formulas of docs/theory.md, 5.12, and so that crowds vanish.

The formulas are computed anew with numpy, where what lies behind a face is a copy of each particle, not of nodes.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from scenes import ball, block, body, box, scene_of
from test_batch import batch_of, outputs_of, same
from test_check_frames import header_of
from test_deterministic import on_gpu_path, twice

from mpmcli.check.result_check import check_kept
from mpmcli.scene import Scene
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.stability.transfer_factors import INTERVAL

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e5, "friction_angle": 30.0}
JELLY = {"law": "neo_hookean", "density": 900.0, "youngs_modulus": 5e4, "poissons_ratio": 0.3}
H = 0.1


def crowded(
    walls: dict, dimension: int = 2, materials: Sequence[dict] = (WATER,), per_cell: int = 0, **solver: object
) -> Scene:
    """Return bodies side by side that fill a domain, whose particles tests put elsewhere."""
    length = 1.0 if dimension == 2 else 0.6
    edges = np.linspace(0.0, length, len(materials) + 1)
    high, count = [1.0] if dimension == 2 else [0.5, 0.5], per_cell or 2**dimension
    bodies = [
        block(f"body {k}", material, [low, *[0.0] * len(high)], [edges[k + 1], *high], particles_per_cell=count)
        for k, (material, low) in enumerate(zip(materials, edges, strict=False))
    ]
    solver = {"precision": "f64", **solver}
    domain = {"size": [length, *high], "spacing": H, "walls": walls}
    return scene_of(*bodies, domain=domain, solver=solver)


def spline(r: np.ndarray, *, cubic: bool) -> np.ndarray:
    """Return the B-spline at distances r, in cells."""
    r = np.abs(r)
    if cubic:
        return np.where(r < 1, 2 / 3 - r**2 + r**3 / 2, np.where(r < 2, (2 - r) ** 3 / 6, 0.0))
    return np.where(r < 0.5, 0.75 - r**2, np.where(r < 1.5, (1.5 - r) ** 2 / 2, 0.0))


def weights(x: np.ndarray, spacing: float, size: Sequence[float], *, cubic: bool = False) -> np.ndarray:
    """Return the weights of all nodes for places x, (n, nodes)."""
    axes = [spline(x[:, a, None] / spacing - count_of(length, spacing), cubic=cubic) for a, length in enumerate(size)]
    result = axes[0]
    for axis in axes[1:]:
        result = (result[:, :, None] * axis[:, None, :]).reshape(len(x), -1)
    return result


def count_of(length: float, spacing: float) -> np.ndarray:
    return np.arange(-3, round(length / spacing) + 4)


def copies(x: np.ndarray, way: np.ndarray, faces: Sequence[Sequence[str]], size: Sequence[float]) -> tuple:
    """Return places and ways of particles and of all of their copies behind faces."""
    for a, pair in enumerate(faces):
        places, ways = [x], [way]
        for side, word in enumerate(pair):
            place, moved = x.copy(), way.copy()
            if word == "periodic":
                place[:, a] += size[a] * (1 - 2 * side)
            elif word != "open":
                place[:, a] = 2 * side * size[a] - place[:, a]
                moved[:, a] *= -1
            if word != "open":
                places.append(place)
                ways.append(moved)
        x, way = np.concatenate(places), np.concatenate(ways)
    return x, way


def shifted(scene: Scene, x: np.ndarray, C: np.ndarray, mass: np.ndarray, flows: np.ndarray, T: float) -> np.ndarray:
    """Return the places of particles after a shift; volume: that of a lattice."""
    d, size = x.shape[1], scene.domain.size
    per_cell = round(scene.bodies[0].particles_per_cell ** (1 / d))
    g, faces = H / per_cell, scene.domain.walls.faces(d)
    cubic = scene.solver.kernel == "cubic"

    def held(x: np.ndarray, way: np.ndarray) -> np.ndarray:
        for a, (low, high) in enumerate(faces):
            if low not in ("periodic", "open"):
                way[:, a] = np.maximum(way[:, a], -x[:, a] / 2)
            if high not in ("periodic", "open"):
                way[:, a] = np.minimum(way[:, a], (size[a] - x[:, a]) / 2)
        return way

    near, _ = copies(x, x, faces, size)
    excess = 2 * np.maximum(weights(near, g, size).sum(axis=0) - 1, 0)
    crowding = excess * np.minimum(excess**2, 1)
    # Central differences are exact for a spline of second order where no knot is near.
    steps = 1e-6 * g * np.eye(d)
    slope = np.stack(
        [(weights(x + step, g, size) - weights(x - step, g, size)) @ crowding / 2e-6 for step in steps], axis=1
    )
    D = (C + C.transpose(0, 2, 1)) / 2
    strain = 8 * T * np.sqrt(2 * ((D**2).sum((1, 2)) - np.trace(C, axis1=1, axis2=2) ** 2 / 3))
    way = -g * (strain / (1 + strain))[:, None] * slope
    way *= np.minimum(1, 0.2 * g / np.maximum(np.linalg.norm(way, axis=1), 1e-300))[:, None]
    way = held(x, way)
    near, ways = copies(x[flows], way[flows], faces, size)
    w = weights(near, H, size, cubic=cubic) * np.tile(mass[flows], len(near) // flows.sum())[:, None]
    mean = (w.T @ ways) / np.maximum(w.sum(axis=0), 1e-300)[:, None]
    after = x + way
    after += held(after, -weights(after, H, size, cubic=cubic) @ mean)
    return np.where(flows[:, None], after, x)


def one_shift(
    run: Run, x: Sequence[np.ndarray], C: Sequence[np.ndarray], T: float, v: float | Sequence[np.ndarray] = 0.0
) -> np.ndarray:
    """Return where particles are after a step so short that they only move by a shift for a time T, s."""
    step = 1e-12
    speeds = [np.full_like(place, v) for place in x] if isinstance(v, float) else v
    for group, place, gradient, speed in zip(run.groups, x, C, speeds, strict=True):
        group.replace(x=place, C=gradient, v=speed, id=np.sort(group.read()["id"]))
    run.state_was_replaced()
    run.state.unrelaxed, run.state.unrelaxed_steps = T - step, INTERVAL - 1
    run.step(step)
    run.state.unrelaxed_steps = 0
    found = []
    for group in run.groups:
        state = group.read()
        found.append(state["x"][np.argsort(state["id"])])
    return np.concatenate(found)


def random_state(run: Run, clear: float = 0.0) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return places, crowded towards two corners and `clear` from faces, and velocity gradients, for each group."""
    rng, size = np.random.default_rng(3), np.array(run.scene.domain.size)
    x, C = [], []
    for group in run.groups:
        u = rng.uniform(0, 1, (group.count, len(size)))
        u[::2], u[1::4] = u[::2] ** 2, 1 - u[1::4] ** 2
        x.append(clear + u * (size - 2 * clear))
        C.append(rng.uniform(-1, 1, (group.count, len(size), len(size))))
    return x, C


KINDS = {
    "2D, beside jelly": ({"default": "slip"}, {"materials": (WATER, JELLY)}),
    "2D": ({"default": "separate", "y_max": "stick"}, {}),
    "periodic, two laws": ({"default": "slip", "x_min": "periodic", "x_max": "periodic"}, {"materials": (SAND, WATER)}),
    "open, cubic, 9 a cell": ({"default": "slip", "x_max": "open"}, {"kernel": "cubic", "per_cell": 9}),
    "3D, beside jelly": ({"default": "slip", "y_max": "open"}, {"dimension": 3, "materials": (WATER, JELLY)}),
}

USUAL = {("2D, beside jelly", "cpu"), ("3D, beside jelly", "cpu"), ("periodic, two laws", "gpu in fixed point")}


@pytest.mark.parametrize(
    ("kind", "path"),
    [
        pytest.param(kind, path, marks=[pytest.mark.slow] * ((kind, path) not in USUAL))
        for path in ("cpu", "gpu in fixed point")
        for kind in KINDS
    ],
)
def test_a_shift_is_that_of_its_formulas(backend_of: Callable, kind: str, path: str) -> None:
    """To the rounding of places, and of sums in fixed point."""
    walls, options = KINDS[kind]
    backend = backend_of("f64", 1)
    scene = crowded(walls, deterministic=path != "cpu", **options)
    run = build_run(scene, backend if path == "cpu" else on_gpu_path(backend))
    laws = [group.law for group in run.groups]
    for T in (0.05, 1.0):
        x, C = random_state(run, clear=0.01)
        counts = [group.count for group in run.groups]
        mass = np.concatenate([np.full(n, law.members[0].density) for n, law in zip(counts, laws, strict=True)])
        flows = np.repeat([law.shifts for law in laws], counts)
        expected = shifted(scene, np.concatenate(x), np.concatenate(C), mass, flows, T)
        found = one_shift(run, x, C, T)
        way = np.abs(expected - np.concatenate(x)).max()
        # Of the periodic images one is inside.
        error = np.abs(found - expected)
        assert np.minimum(error, np.abs(error - scene.domain.size[0])).max() < 1e-7 * H
        assert 0.05 * H / 3 < way < 0.2 * H


@pytest.fixture(scope="module")
def pool() -> Scene:
    return crowded({"default": "slip"}, materials=(WATER, JELLY))


def test_what_does_not_strain_is_not_shifted(backend_of: Callable, pool: Scene) -> None:
    """At rest, in rigid motion, and of solids; a common velocity changes nothing."""
    run = build_run(pool, backend_of("f64", 1))
    x, C = random_state(run)
    before = np.concatenate(x)
    rest = [np.zeros_like(own) for own in C]
    assert (one_shift(run, x, rest, 1.0) == before).all()
    turning = [own - own.transpose(0, 2, 1) for own in C]
    assert np.abs(one_shift(run, x, turning, 1.0) - before).max() < 1e-6 * H
    sheared = one_shift(run, x, C, 1.0)
    solid = np.repeat([not group.law.shifts for group in run.groups], [group.count for group in run.groups])
    assert np.abs(sheared - before)[~solid].max() > 0.05 * H
    # Their step of 1e-12 s alone.
    assert np.abs(sheared - before)[solid].max() < 1e-9 * H
    moving = one_shift(run, x, C, 1.0, v=3.0)
    assert np.abs(moving - sheared).max() < 1e-9 * H


def test_the_velocity_of_a_place_stays(backend_of: Callable, pool: Scene) -> None:
    """v = C (x - c) holds where particles are after a shift as before it, as v changes by C times the way."""
    run = build_run(pool, backend_of("f64", 1))
    x, _ = random_state(run, clear=0.25)
    C, middle = np.array([[1.0, -0.5], [2.0, -1.0]]), np.array([0.5, 0.5])
    rates = [np.tile(C, (len(own), 1, 1)) for own in x]
    after = one_shift(run, x, rates, 1.0, v=[(own - middle) @ C.T for own in x])
    assert np.abs(after - np.concatenate(x)).max() > 0.05 * H
    v = np.concatenate([(state := group.read())["v"][np.argsort(state["id"])] for group in run.groups])
    assert np.abs(v - (after - middle) @ C.T).max() < 1e-6 * H


def test_momenta_stay_where_drops_collide(backend_of: Callable) -> None:
    """Of two drops that meet off centre, far from walls: P to 1e-6 of M v, L to 2e-4.

    Where they lie between the nodes does not matter: moved by 0.3 of a cell they spread by as much, to 0.5 %. Nodes and
    particles are then no images of each other, and P is kept to 5e-5, L to 2e-3.
    """
    backend, spread = backend_of("f64", 1), []
    for moved in (0.0, 0.3 * 0.02):
        drops = [
            body(f"drop {1 + sign}", WATER, ball(center, 0.2), velocity=[-1.0 * sign, 0.0])
            for sign in (-1, 1)
            for center in [[1.5 + 0.25 * sign + moved, 1.5 + 0.05 * sign - moved]]
        ]
        scene = scene_of(*drops, size=[3.0, 3.0], spacing=0.02, walls="separate", end=0.35, precision="f64")
        (_, before), (frame, after) = build_run(scene, backend).frames()
        change = np.subtract(after.linear_momentum, before.linear_momentum)
        assert np.abs(change).max() < (5e-5 if moved else 1e-6) * before.mass
        assert after.angular_momentum == pytest.approx(before.angular_momentum, rel=2e-3 if moved else 2e-4)
        spread.append([frame.position[frame.body == k].std(axis=0) for k in (0, 1)])
    assert np.abs(np.divide(*spread) - 1).max() < 0.005


def test_a_shift_moves_no_centre_of_mass(backend_of: Callable, pool: Scene) -> None:
    """The mean motion is taken back: what is left is of second order in the way, as nodes are then those of there."""
    run = build_run(pool, backend_of("f64", 1))
    x, C = random_state(run, clear=0.2)
    ways = []
    for T in (4e-3, 1e-3):
        way = (one_shift(run, x, C, T) - np.concatenate(x))[: run.groups[0].count]
        ways.append((np.abs(way).mean(), np.linalg.norm(way.mean(axis=0))))
    (way, mean), (less, less_mean) = ways
    assert mean < 0.02 * way
    assert math.log(mean / less_mean) == pytest.approx(2 * math.log(way / less), rel=0.1)


def column(*, redistribute: object, spacing: float = 0.05, frames: int = 2, **more: object) -> Scene:
    """Return a dam break of 2 x 1 m that has met the far wall, 800 particles."""
    body = {"name": "column", "material": WATER | {"bulk_modulus": "auto"}}
    return scene_of(
        body | {"shape": box([0.0, 0.0], [1.0, 1.0])} | more,
        domain={"size": [3.0, 2.0], "spacing": spacing, "gravity": [0.0, -9.81], "walls": "separate"},
        time={"end": 1.4, "frames": frames},
        solver={"redistribute": redistribute, "precision": "f64"},
    )


def densest(x: np.ndarray, h: float) -> int:
    return int(np.unique((x / h).astype(int), axis=0, return_counts=True)[1].max())


def test_a_broken_dam_has_no_crowds(backend_of: Callable) -> None:
    """4 particles a cell are meant; without shifts rows pile up. They take no energy: the grid sees none of them."""
    backend = backend_of("f64", 1)
    found = {}
    for redistribute in (False, "auto"):
        scene = column(redistribute=redistribute, frames=100)
        frames = list(build_run(scene, backend).frames())
        frame, row = frames[-1]
        # Particles move farther than their velocities take them, and the check knows by how much.
        check = check_kept(header_of(scene, "fluid"), *zip(*frames, strict=True))
        assert check.verdict == "stable"
        assert [one.rule for one in check.findings if one.rule == "crowd"] == ["crowd"] * (not redistribute)
        found[redistribute] = densest(frame.position, 0.05), row.kinetic + row.elastic + row.potential
    assert found["auto"][0] <= 8 < 14 < found[False][0]
    assert found["auto"][1] > 0.99 * found[False][1]


@pytest.mark.slow
def test_two_liquids_have_no_crowds(backend_of: Callable) -> None:
    """Lock exchange: 8 particles at most in a cell meant for 4, where 28 are without shifts; these take no energy."""
    backend, found = backend_of("f64", 1), {}
    for redistribute in (False, "auto"):
        bodies = [
            block(name, {"law": "fluid", "density": density, "bulk_modulus": 2e5}, [low, 0.0], [low + 0.5, 0.40625])
            for name, density, low in (("salt", 1000.0, 0.0), ("fresh", 800.0, 0.5))
        ]
        scene = scene_of(
            *bodies,
            domain={"size": [1.0, 0.5], "spacing": 1 / 64, "gravity": [0.0, -9.81], "walls": "slip"},
            time={"end": 2.0, "frames": 4},
            solver={"redistribute": redistribute, "precision": "f64"},
        )
        frames = list(build_run(scene, backend).frames())
        found[redistribute] = max(densest(frame.position, 1 / 64) for frame, _ in frames), frames[-1][1].energy
    (crowd, lost), (most, energy) = found[False], found["auto"]
    assert most <= 8 < 16 < crowd
    assert energy > lost


@pytest.mark.slow
def test_runs_have_the_same_bytes_alone_and_together(backend_of: Callable) -> None:
    """In a batch, on two threads."""
    scenes = [column(redistribute="auto", sampling=sampling) for sampling in ("lattice", "jittered")]
    alone = [list(build_run(scene, backend_of("f64", 1)).frames()) for scene in scenes]
    for found, expected in zip(outputs_of(batch_of(scenes, backend_of("f64", 2)), scenes), alone, strict=True):
        assert list(same(found, expected)) == []


def test_a_run_that_goes_on_has_the_same_bytes(backend_of: Callable) -> None:
    """On three threads as on one, and gone on with from the middle of an interval."""
    scene = column(redistribute="auto", sampling="jittered")
    alone = list(build_run(scene, backend_of("f64", 1)).frames())
    run = build_run(scene, backend_of("f64", 3))
    stepped = run.frames()
    first = [next(stepped), next(stepped)]
    assert 0 < run.state.unrelaxed_steps < INTERVAL - 1
    saved = run.save().copied()
    assert list(same(first + list(stepped), alone)) == []
    run.load(saved)
    assert list(same(first + list(run.frames()), alone)) == []


def far_apart(dimension: int, grid: str) -> Scene:
    """Return water in two corners of a domain that is nearly empty, sheared, at walls and a face that repeats."""
    d, walls = dimension, {"default": "slip", "x_min": "periodic", "x_max": "periodic"}
    strip = box([0.0, 0.0, 0.5][:d], [0.12, 0.12, 0.62][:d])
    corner = box([0.88, 0.86, 0.6][:d], [1.0, 1.0, 0.7][:d])
    bodies = [
        {"name": "strip", "shape": strip, "velocity": ["-1.0", "0.5 - 8.0 * X", "-3.0 * Y"][:d]},
        {"name": "corner", "shape": corner, "velocity": ["5.0 * (Y - 0.9)", "1.0", "4.0 * (X - 0.9)"][:d]},
    ]
    return scene_of(
        *(body | {"material": WATER, "sampling": "jittered"} for body in bodies),
        domain={"size": [1.0] * d, "spacing": 1 / 60 if d == 2 else 1 / 36, "walls": walls},
        end=0.18,
        solver={"precision": "f64", "grid": grid, "kernel": "cubic" if d == 2 else "quadratic"},
    )


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_a_sparse_grid_shifts_as_a_dense_one(backend_of: Callable, dimension: int) -> None:
    """Over several intervals, with images behind walls and across the domain in blocks of their own, to rounding."""
    found = []
    for grid in ("dense", "sparse"):
        run = build_run(far_apart(dimension, grid), backend_of("f64"))
        assert run.batch.device.grid.sparse == (grid == "sparse")
        found.append([frame for frame, _ in run.frames()][-1])
    assert found[0].step == found[1].step > 2 * INTERVAL
    assert np.abs(found[1].position - found[0].position).max() < 1e-9 * run.scene.domain.spacing


@pytest.mark.slow
@pytest.mark.gpu
def test_a_gpu_shifts_as_the_cpu_does(backend_of: Callable) -> None:
    """Over two intervals to rounding, and with equal bytes where it adds in fixed point."""
    scene = column(redistribute="auto", velocity=[1.0, 1.0])
    scene = scene.model_copy(update={"time": scene.time.model_copy(update={"end": 0.1})})
    settings = scene.solver.model_copy(update={"precision": "f32", "deterministic": True})
    scene = scene.model_copy(update={"solver": settings})
    expected = list(build_run(scene, backend_of("f32")).frames())[-1][0]
    assert expected.step > 2 * INTERVAL
    first, second = twice(scene, backend_of("f32", 1, "vulkan"))
    assert list(same(first, second)) == []
    assert np.abs(first[-1][0].position - expected.position).max() < 1e-4


def test_colliders_hold_particles_back(backend_of: Callable) -> None:
    """None that is outside goes farther than half of the way to the surface, in a shift and on its way back."""
    ball = {"name": "ball", "shape": {"ball": {"center": [0.5, 0.4], "radius": 0.2}}}
    water, domain = block("b", WATER, [0, 0], [1, 0.15]), {"size": [1.0, 1.0], "spacing": H, "walls": "slip"}
    scene = scene_of(water, domain=domain, colliders=[ball], precision="f64")
    run = build_run(scene, backend_of("f64", 1))
    rng = np.random.default_rng(1)
    angle, distance = rng.uniform(0, 2 * np.pi, run.groups[0].count), rng.uniform(0, 1, run.groups[0].count) ** 2 / 20
    x = np.array([0.5, 0.4]) + (0.2 + distance)[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    after = one_shift(run, [x], [rng.uniform(-1, 1, (len(x), 2, 2))], 1.0)
    assert np.abs(after - x).max() > 0.02 * H
    assert (np.linalg.norm(after - [0.5, 0.4], axis=1) - 0.2 > distance / 4 - 1e-9).all()
