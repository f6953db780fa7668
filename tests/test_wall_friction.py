"""Coulomb friction of walls: what a step takes, and blocks that slide, stick, and come to rest on a floor."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, scene_of, slow
from solver_state import BodyState, bodies_of

from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.engine.run import build_run

G, DENSITY = 10.0, 1000.0
# Of the block: its length and height, m.
LENGTH, HEIGHT = 1.0, 0.25
JELLY = {"law": "neo_hookean", "density": DENSITY, "youngs_modulus": 1e6, "poissons_ratio": 0.3}
# Hardly any friction: as none to what is measured, and with it the kernel is that of rough faces.
HARDLY = 1e-9


def on_all(value: float, dimension: int = 2, **others: float) -> dict:
    """Return the friction of all faces, so that their kernel is one, with other values of some."""
    return {f"{axis}_{side}": value for axis in "xyz"[:dimension] for side in ("min", "max")} | others


def thrown(friction: object, faces: object, dimension: int, **solver: object) -> Scene:
    """Return a block in the middle of a floor, with room around it, in f64 and without gravity."""
    low, high = [0.8, 0.0, 0.8][:dimension], [1.2, 0.35, 1.2][:dimension]
    return scene_of(
        block("block", JELLY, low, high),
        domain={"size": [2.0] * dimension, "spacing": 0.1, "walls": faces, "friction": friction},
        solver={"precision": "f64", **solver},
    )


def stepped(backend: object, scene: Scene, velocity: list[float], shear: float = 0.0) -> tuple[np.ndarray, BodyState]:
    """Return what a step adds to the momentum of particles at random, and the state after it.

    They have one velocity, or with `shear`, 1/s, that of a flow along a floor at rest, v_x = shear y, as well.
    """
    d, random = scene.dimension, np.random.default_rng(0)
    n = 60 * 3 ** (d - 2)
    low, high = (np.array(getattr(scene.bodies[0].shape.form, side)) for side in ("min", "max"))
    zero, volume = np.zeros((n, d, d)), float(np.prod(high - low)) / n
    x, v = random.uniform(low, high, (n, d)), np.tile(velocity, (n, 1))
    v[:, 0] += shear * x[:, 1]
    zero[:, 0, 1] = shear
    run = build_run(scene, backend, [BodyParticles("block", x, v, zero, volume, DENSITY * volume)])
    before = bodies_of(run)["block"].momentum()
    run.step(1e-4)
    after = bodies_of(run)["block"]
    return after.momentum() - before, after


@pytest.mark.parametrize(
    ("dimension", "walls", "settings"),
    [
        (2, "slip", {}),
        (2, "separate", {"transfer": "aflip"}),
        slow(2, "separate", {"kernel": "cubic"}),
        slow(3, "separate", {}),
    ],
)
def test_a_sliding_body_loses_friction_times_push(
    backend_of: Callable, dimension: int, walls: str, settings: dict
) -> None:
    """Without other forces, Delta p_t = -mu Delta p_n v_t / |v_t|, to f64 round-off, while nothing comes to rest.

    Of a push that AFLIP gives back to what it keeps, the wall rubs by nothing.
    """
    velocity = [3.0, -0.1, -4.0][:dimension]
    scene = thrown(on_all(0.2, dimension, y_min=0.35), walls, dimension, **settings)
    change, _ = stepped(backend_of("f64", 1), scene, velocity)
    along = [0, 2][: dimension - 1]
    direction = np.array(velocity)[along] / np.linalg.norm(np.array(velocity)[along])
    assert change[1] > 0
    assert change[along] == pytest.approx(-0.35 * change[1] * direction, rel=1e-9)


def test_what_cannot_slip_moves_as_on_a_wall_that_sticks(backend_of: Callable) -> None:
    """With more friction than it takes, a body that hits the floor has the same particles after a step, to 1e-12."""
    velocity = [0.5, -2.0]
    _, found = stepped(backend_of("f64", 1), thrown(on_all(1e4), "slip", 2), velocity)
    _, expected = stepped(backend_of("f64", 1), thrown(0.0, {"default": "slip", "y_min": "stick"}, 2), velocity)
    _, slipping = stepped(backend_of("f64", 1), thrown(on_all(HARDLY), "slip", 2), velocity)
    assert np.abs(slipping.v - expected.v).max() > 0.1
    assert np.abs(found.v - expected.v).max() < 1e-12
    assert np.abs(found.C - expected.C).max() < 1e-10


def test_a_flow_along_a_floor_keeps_its_shear(backend_of: Callable) -> None:
    """Where friction sticks, v_x = gamma y is a flow without slip: a step without stress keeps it, to round-off.

    Mirrored as on a wall that slips, the motion that AFLIP keeps would add up to 0.2 gamma h in every step.
    """
    gamma = 2.0
    _, found = stepped(backend_of("f64", 1), thrown(on_all(1e4), "separate", 2, transfer="aflip"), [0.0, -0.1], gamma)
    assert np.abs(found.v[:, 1]).max() > 0.01
    assert np.abs(found.v[:, 0] - gamma * found.x[:, 1]).max() < 1e-4 * gamma * 0.1 + 1e-12


def test_friction_takes_energy(backend_of: Callable) -> None:
    """A body that spins into a corner of two rough walls has in each step no more energy than with mirrors only."""
    scene = thrown(on_all(0.4), "slip", 2)
    random = np.random.default_rng(1)
    low = np.array([0.0, 0.0])
    n, volume = 80, 0.16 / 80
    particles = BodyParticles(
        "block",
        random.uniform(low, low + 0.4, (n, 2)),
        np.tile([-1.0, -1.5], (n, 1)) + random.normal(0, 0.3, (n, 2)),
        random.normal(0, 3.0, (n, 2, 2)),
        volume,
        DENSITY * volume,
    )
    energies = []
    for asked in (scene, thrown(on_all(HARDLY), "slip", 2)):
        run = build_run(asked, backend_of("f64", 1), [particles])
        run.step(1e-4)
        energies.append(bodies_of(run)["block"].kinetic_energy(scene.domain.spacing))
    assert energies[0] < energies[1]


def block_on_floor(
    degrees: float, friction: float, walls: str, end: float, *, speed: float = 0.0, cells: int = 4, **solver: object
) -> Scene:
    """Return a flat block on a floor, x down the slope; gravity sets in over 0.4 s where the block begins at rest.

    One that moves begins in the stress of its weight. Its height is a number of cells. Gravity is an expression in any
    case, for one kernel.
    """
    theta, h = np.radians(degrees), HEIGHT / cells
    pull = [G * np.sin(theta), -G * np.cos(theta)]
    slowly = " + 0*t" if speed else "*(0.5 - 0.5*cos(pi*min(t/0.4, 1)))"
    material = JELLY | ({"poissons_ratio": 0.0} if speed else {})
    weight = {"deformation": [[1, 0], [0, f"1 - {DENSITY * G / 1e6} * ({HEIGHT} - Y)"]]}
    return scene_of(
        block("block", material, [0.5, 0.0], [0.5 + LENGTH, HEIGHT], velocity=[speed, 0.0])
        | (weight if speed and solver.get("solids") != "total" else {}),
        size=[4 * LENGTH, 8 * h],
        spacing=h,
        gravity=[f"{a}{slowly}" for a in pull],
        walls=walls,
        friction={"y_min": friction},
        end=end,
        solver={"precision": "f64", **solver},
    )


def history(backend: object, scene: Scene) -> np.ndarray:
    """Return t, and the mean of x and of v_x, after each step."""
    run, found = build_run(scene, backend), []
    while run.time < scene.time.end - 1e-12:
        run.step(min(run.stable_step()[0], scene.time.end - run.time))
        block = bodies_of(run)["block"]
        found.append((run.time, block.x[:, 0].mean(), block.v[:, 0].mean()))
    return np.array(found).T


@pytest.mark.parametrize(("walls", "degrees", "friction", "solids"), [
    ("separate", 30.0, 0.3, "updated"),
    slow("separate", 20.0, 0.2, "updated"),
    slow("slip", 30.0, 0.1, "updated"),
    ("separate", 30.0, 0.3, "total"),
    slow("slip", 30.0, 0.1, "total"),
])  # fmt: skip
def test_a_block_slides_down_an_incline(
    backend_of: Callable, walls: str, degrees: float, friction: float, solids: str, record_property: Callable
) -> None:
    """a = g (sin(theta) - mu cos(theta)), to 1 %.

    With mu = 0.3 waves grow along the floor, as of brakes that squeal. A wall that slips pulls at their crests, where
    there is no friction, and so the block has more than mu on the whole (docs/theory.md, 3.4).
    """
    t, _, v = history(backend_of("f64", 1), block_on_floor(degrees, friction, walls, 0.9, solids=solids))
    theta, late = np.radians(degrees), t > 0.45
    expected = G * (np.sin(theta) - friction * np.cos(theta))
    found = np.polyfit(t[late], v[late], 1)[0]
    record_property("error", float(found / expected - 1))
    assert found == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize(("walls", "solids"), [slow("slip", "updated"), ("separate", "updated"), ("separate", "total")])
def test_a_block_stays_on_an_incline(backend_of: Callable, walls: str, solids: str, record_property: Callable) -> None:
    """mu >= tan(theta): it drifts by less than 1e-4 of its length in a second, and by nothing but its vibration."""
    degrees = 30.0
    asked = block_on_floor(degrees, float(np.tan(np.radians(degrees + 1))), walls, 1.8, solids=solids)
    t, x, _ = history(backend_of("f64", 1), asked)
    late = t > 0.8
    drift = np.polyfit(t[late], x[late], 1)[0]
    record_property("drift / L", float(drift / LENGTH))
    assert abs(drift) < 1e-4 * LENGTH


@pytest.mark.parametrize("settings", [{}, slow({"transfer": "aflip"})], ids=["apic", "aflip"])
def test_a_block_comes_to_rest(backend_of: Callable, settings: dict, record_property: Callable) -> None:
    """A block thrown along a floor stops after v^2 / (2 mu g), to 1 %, and stays."""
    speed, friction = 2.0, 0.3
    stop = speed / (friction * G)
    t, x, v = history(
        backend_of("f64", 1), block_on_floor(0, friction, "separate", 1.3 * stop, speed=speed, **settings)
    )
    late = t > 1.1 * stop
    distance = x[late].mean() - (0.5 + LENGTH / 2)
    expected = speed**2 / (2 * friction * G)
    record_property("error", float(distance / expected - 1))
    assert distance == pytest.approx(expected, rel=0.01)
    assert abs(v[late].mean()) < 1e-3 * speed


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [2, 3])
def test_faces_have_coefficients_of_their_own(backend_of: Callable, dimension: int) -> None:
    """A body thrown at one upper face slides by its number, and another face's number changes no byte of it."""
    backend = backend_of("f64", 1)
    d, change = dimension, {}
    for friction in ({"x_max": 0.2}, {"x_max": 0.2, "y_min": 0.9}, {"x_max": 0.4}):
        scene = thrown(friction, "separate", d)
        low, high = [1.65, 0.8, 0.8][:d], [2.0, 1.2, 1.2][:d]
        box = scene.bodies[0].shape.form.model_copy(update={"min": tuple(low), "max": tuple(high)})
        shape = scene.bodies[0].shape.model_copy(update={"box": box})
        scene = scene.model_copy(update={"bodies": (scene.bodies[0].model_copy(update={"shape": shape}),)})
        change[str(friction)], _ = stepped(backend, scene, [0.1, 3.0, 0.0][:d])
    first, again, more = change.values()
    assert np.array_equal(first, again)
    assert first[1] == pytest.approx(0.2 * first[0], rel=1e-9)
    assert more[1] == pytest.approx(0.4 * more[0], rel=1e-9)


def test_slip_is_saved(backend_of: Callable) -> None:
    """With solids = "total" a run that is loaded half-way goes on with the bytes of one that never stopped."""
    run = build_run(block_on_floor(30.0, 0.3, "separate", 1.0, speed=1.0, solids="total"), backend_of("f64", 1))

    def ahead() -> bytes:
        for _ in range(30):
            run.step(1e-4)
        block = bodies_of(run)["block"]
        return block.x.tobytes() + block.v.tobytes()

    ahead()
    saved = run.save().copied()
    expected = ahead()
    run.load(saved)
    assert ahead() == expected
    assert np.abs(run.groups[0].arrays.slip.to_numpy()).max() > 0


@pytest.mark.parametrize("parts", [1, 5, slow(50)])
def test_a_sliding_block_slows_down_as_fast_at_any_step(backend_of: Callable, parts: int) -> None:
    """At steps of 1, 1/5 and 1/50 its speed falls by mu (g t + v_y); with nu = 0 sliding excites no waves."""
    speed, friction = 2.0, 0.3
    run = build_run(block_on_floor(0, friction, "separate", 1.0, speed=speed), backend_of("f64", 1))
    step = run.stable_step()[0] / parts
    while run.time < 0.1:
        run.step(step)
    block = bodies_of(run)["block"]
    along, up = block.momentum() / block.mass.sum()
    assert speed - along == pytest.approx(friction * (G * run.state.velocity_time + up), rel=1e-6)
