"""Bodies with velocity fields of their own meet where their surfaces are, slide with friction, and part."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import contact_reference as contact
import mpm_reference as reference
import numpy as np
import pytest
from contact_scenes import DENSITY, LAMBDA, MU, NU, SEPARATE, E, G, H, body, jelly, scene
from rounding import farthest
from scenes import ball, block, box, collider, liquid, scene_of, slow
from solver_state import bodies_of
from test_batch import batch_of

from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.scene import Scene, sample_bodies
from mpmcli.scene.contact_table import ContactTable
from mpmcli.scene.forces import Contact
from mpmcli.solver.contact.layers import STICKS, Layers
from mpmcli.solver.contact.surfaces import rest_surface
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.refusals import require_possible
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import Run, build_run, frames_of_all
from mpmcli.solver.machine.backend import Backend
from mpmcli.validation.case import Setting
from mpmcli.validation.cases.two_disks import SPEED, SeparateDisks

# No gravity, as two expressions: a kernel of two bodies is then that of `on_slope`, and of test_check_loss.py.
NONE = {"gravity": ["0*t", "0*t*t"]}

# What bodies carry, and which of them have fields of their own.


def test_particles_carry_the_surface_of_their_shape() -> None:
    """Depth and normal of a box are those of its nearest face, of a ball those of its radius."""
    ball = {"name": "ball", "shape": {"ball": {"center": [1.5, 0.8], "radius": 0.3}}, "material": jelly()}
    both = scene([body("box", [2, 2], [12, 8]), ball])
    boxed, round_ = sample_bodies(both)
    found = rest_surface(both.bodies[0], boxed, H)
    to_faces = np.stack([boxed.position - 2 * H, np.array([12 * H, 8 * H]) - boxed.position], axis=2).reshape(-1, 4)
    assert found[:, 2] == pytest.approx(to_faces.min(axis=1), abs=1e-12)
    outwards = np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])[to_faces.argmin(axis=1)]
    nearest = np.sort(to_faces, axis=1)
    alone = nearest[:, 1] - nearest[:, 0] > 1e-9
    assert found[alone, :2] == pytest.approx(outwards[alone], abs=1e-9)
    found, away = rest_surface(both.bodies[1], round_, H), round_.position - [1.5, 0.8]
    assert found[:, 2] == pytest.approx(0.3 - np.linalg.norm(away, axis=1), abs=1e-9)
    assert found[:, :2] == pytest.approx(away / np.linalg.norm(away, axis=1)[:, None], abs=1e-3)


def test_a_body_that_starts_deformed_has_its_shape_then() -> None:
    """F^-T N / |F^-T N| is the normal of the shape, D / |F^-T N| the depth below it."""
    F = np.array([[1.2, 0.3], [-0.1, 0.8]])
    still, bent = (
        scene([body("a", [2, 2], [12, 8], **more), body("b", [20, 2], [30, 8])])
        for more in ({}, {"deformation": F.tolist()})
    )
    expected = rest_surface(still.bodies[0], sample_bodies(still)[0], H)
    found = rest_surface(bent.bodies[0], sample_bodies(bent)[0], H)
    carried = found[:, :2] @ np.linalg.inv(F)
    size = np.linalg.norm(carried, axis=1)
    assert carried / size[:, None] == pytest.approx(expected[:, :2], abs=1e-9)
    assert found[:, 2] / size == pytest.approx(expected[:, 2], abs=1e-12)


def test_elastic_bodies_have_layers_of_their_own() -> None:
    """All others share layer 0."""
    water = body("water", [2, 2], [4, 4], material={"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5})
    a, b = body("a", [6, 2], [8, 4]), body("b", [10, 2], [12, 4])
    mixed = scene([a, water, b], friction=0.3)
    assert Layers.of(mixed).numbers == (1, 0, 2)
    assert Layers.of(mixed).frictions(mixed)[np.tril_indices(3, -1)].tolist() == [0.0, 0.0, 0.3]
    assert Layers.of(scene([a, b])) == Layers(2, False, 2, False, (0, 1))
    welds = scene([a, b | {"material": metal(surface_friction="stick")}])
    assert Layers.of(scene([a, b | {"material": metal()}])).numbers == (0, 1) and Layers.of(welds).numbers == (1, 0)
    assert Layers.of(scene([a, water])) == Layers(2, True, 2, False, (1, 0))
    alone, glued = Layers.of(scene([a])), Layers.of(scene([a, b], contact={"default": "stick"}))
    assert (alone.count, alone.separate, glued.count, glued.separate) == (1, True, 1, False)


def test_elastic_bodies_separate_unless_they_meet_nothing_or_the_solver_has_one_field() -> None:
    """Without a word about contact, and with friction for those that separate."""
    water = body("water", [2, 2], [4, 4], material={"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5})
    a, b = (body(name, [x, 2], [x + 2, 4], material="jelly") for name, x in (("a", 6), ("b", 12)))
    assert Layers.of(scene([a], contact={})) == Layers(1, False, 2, False, (0,))
    assert not Layers.of(scene([a], contact={}, domain={"walls": "slip"})).separate
    assert Layers.of(scene([a, water], contact={})) == Layers(2, True, 2, False, (1, 0))
    assert Layers.of(scene([a, water], contact={}, domain={"walls": "slip"})) == Layers(2, True, 2, False, (1, 0))
    both = scene([a, b], contact={})
    assert Layers.of(both) == Layers.of(scene([a, b])) and ContactTable(both).between(0, 1)[0] == 0.02
    rough = scene([a, b], contact={"friction": 0.4})
    assert ContactTable(rough).between(0, 1) == (0.4, "contact.friction")
    raft = {"name": "raft", "density": 500.0, "shape": box([1.0, 0.5], [1.5, 0.7])}
    assert Layers.of(scene([a, b], contact={}, colliders=[raft])).separate
    for reason, tables in (
        ('solver.solids = "total"', {"solver": {"solids": "total"}, "domain": {"walls": "separate"}}),
        ('solver.grid = "sparse"', {"solver": {"grid": "sparse"}}),
        ("so many bodies", {"domain": {"size": [1600.0, 1600.0]}}),
    ):
        asked = scene([a, b], contact={}, **tables)
        assert ContactTable(asked).one_field == reason and not Layers.of(asked).separate
        require_possible(Resolved(asked), Backend("cpu", 1, "f32", False))


def test_the_plan_counts_layers() -> None:
    """Nodes and what finds walls once for each, and what bodies show; nodes keep volumes beside a liquid."""
    two = scene([body("a", [2, 2], [12, 8]), body("b", [20, 2], [30, 8])])
    one = two.model_copy(update={"contact": Contact(default="stick")})
    backend = Backend("cpu", 1, "f64", False)
    plans = [make_plan(asked, backend) for asked in (one, two)]
    assert plans[1].bytes_per_node == 2 * plans[0].bytes_per_node
    assert plans[1].laws[0].fields.keys() - plans[0].laws[0].fields.keys() == {"surface"}
    water = body("water", [2, 12], [12, 14], material={"law": "fluid", "density": DENSITY, "bulk_modulus": 1e5})
    for contact_, keeps in ((SEPARATE, True), ({"default": "stick"}, False)):
        mixed = scene([body("a", [2, 2], [12, 8]), body("b", [20, 2], [30, 8]), water], contact=contact_)
        assert Resolved(mixed).kind.keeps_filling is keeps


def test_pairs_do_what_they_say() -> None:
    """Only those that are named separate from each other, or all but those that stick."""
    a, b, c = (body(name, [x, 2], [x + 2, 4]) for name, x in (("a", 2), ("b", 6), ("c", 10)))
    s, slides = STICKS, {"between": ["a", "c"], "friction": 0.5}
    one = scene([a, b, c], contact={"default": "stick", "pairs": [slides]})
    assert Layers.of(one).numbers == (1, 0, 2)
    assert Layers.of(one).frictions(one).tolist() == [[s, s, s], [s, s, 0.5], [s, 0.5, s]]
    glued = {"default": "separate", "friction": 0.2, "pairs": [slides, {"between": ["b", "a"], "friction": "stick"}]}
    all_but = scene([a, b, c], contact=glued)
    assert Layers.of(all_but).numbers == (0, 1, 2)
    assert Layers.of(all_but).frictions(all_but).tolist() == [[s, s, 0.5], [s, s, 0.2], [0.5, 0.2, s]]


def test_friction_is_that_of_the_softer_body_where_none_is_given() -> None:
    """Presets have one; of bodies as soft as each other the lower counts."""
    stiff, soft, slick = jelly(surface_friction=0.2), jelly(surface_friction=0.5), jelly()
    stiff |= {"youngs_modulus": 2 * E}
    bodies = [
        body(name, [x, 2], [x + 2, 4], material=made)
        for name, x, made in zip("abc", (2, 6, 10), (stiff, soft, slick), strict=True)
    ]
    one = scene(bodies, contact={"default": "separate"})
    assert Layers.of(one).frictions(one)[np.tril_indices(3, -1)].tolist() == [0.5, 0.0, 0.0]
    presets = [body(name, [x, 2], [x + 2, 4], material=name) for name, x in (("jelly", 2), ("rubber", 6))]
    one = scene(presets, contact={"default": "separate"})
    assert ContactTable(one).between(0, 1) == (0.02, "surface_friction")
    assert one.bodies[1].material.surface_friction == 1.0


@pytest.mark.parametrize(
    ("pairs", "said"),
    [
        ([["a", "d"]], 'pairs[0].between: no body has the name "d"; the bodies are a, b, water and mud'),
        ([["a", "a"]], 'pairs[0].between: names "a" twice; a pair has two bodies'),
        ([["a", "b"], ["b", "a"]], "pairs[1].between: names the bodies of contact.pairs[0]; leave one of them out"),
        ([["mud", "water"]], 'pairs[0].between: "mud" and "water" cannot separate: one must be of an elastic law'),
    ],
)
def test_pairs_that_cannot_be_are_one_sentence(pairs: list, said: str) -> None:
    water = body("water", [2, 10], [4, 12], material={"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5})
    mud = body("mud", [2, 14], [4, 16], material="mud")
    listed = {"pairs": [{"between": pair, "friction": 0.1} for pair in pairs]}
    with pytest.raises(InputError) as raised:
        scene([body("a", [2, 2], [4, 4]), body("b", [6, 2], [8, 4]), water, mud], contact=listed)
    assert str(raised.value).count("\n") == 0 and said in str(raised.value)


@pytest.mark.parametrize(
    ("tables", "arch", "reason"),
    [
        ({}, "metal", "with --arch metal"),
        ({"solver": {"deterministic": True}}, "vulkan", "with solver.deterministic = true on a GPU"),
        ({"solver": {"solids": "total"}, "domain": {"walls": "separate"}}, "cpu", 'with solver.solids = "total"'),
        ({"solver": {"grid": "sparse"}}, "cpu", 'with solver.grid = "sparse"'),
    ],
)
def test_what_has_one_velocity_field_is_refused(tables: dict, arch: str, reason: str) -> None:
    two = scene([body("a", [2, 2], [8, 8]), body("b", [12, 2], [18, 8])], **tables)
    with pytest.raises(InputError, match=f"separating bodies are not available {reason}; change this, or set "):
        require_possible(Resolved(two), Backend(arch, 1, "f32", False))


# The exchange at nodes.


@pytest.mark.parametrize("dimension", [2, slow(3)])
def test_a_step_is_that_of_plain_numpy(backend_of: Callable, dimension: int) -> None:
    """One step of two bodies that move and are deformed at random, between a rough floor and a ball that moves.

    One is pressed into the other, and into the floor, the other into the ball; the ball takes what it gives.
    """
    d = dimension
    low, middle, high, top = ([x, y, z][:d] for x, y, z in ((6, 0, 6), (9, 2, 8), (7, 2, 6), (10, 4, 8)))
    centre, pace, spin = [8.2 * H, 5.2 * H, 7 * H][:d], [0.3, -3.0, 0.2][:d], 2.0
    both = scene(
        [body("a", low, middle), body("b", high, top)],
        0.3,
        domain={
            "size": [16 * H] * d,
            "gravity": [1.0, -9.0, 2.0][:d],
            "walls": {"default": "slip", "y_min": "separate"},
            "friction": {"y_min": 0.2},
        },
        colliders=[
            collider(
                "ball",
                {"ball": {"center": centre, "radius": 1.5 * H}},
                velocity=pace,
                angular_velocity=spin,
                friction=0.4,
            )
        ],
    )
    run = build_run(both, backend_of("f64", 1))
    group, rng = run.groups[0], np.random.default_rng(0)
    before = group.read()
    n = len(before["x"])
    x = before["x"] + rng.uniform(-0.1, 0.1, (n, d)) * H
    x[before["body"] == 1, 1] -= 0.15 * H
    v, C = rng.uniform(-1, 1, (n, d)), rng.uniform(-3, 3, (n, d, d))
    v[:, 1] -= np.where(before["body"] == 0, 0.5, 2.0)
    F = np.eye(d) + rng.uniform(-0.05, 0.05, (n, d, d))
    group.replace(x=x, v=v, C=C, deformation=F)
    run.state_was_replaced()
    carried = group.arrays.carried.to_numpy()[:n]
    dt = kick = 1e-3
    gravity = np.array(both.domain.gravity)
    box = reference.Box((16,) * d, H, gravity, [("slip", "slip"), ("open", "slip"), ("slip", "slip")][:d])
    stress = reference.neo_hookean_stress(np.full(n, MU), np.full(n, LAMBDA))
    bodies, surfaces, momenta, masses, numbers = [], [], [], [], (H / 2, LAMBDA + 2 * MU, DENSITY)
    for k, sample in enumerate(sample_bodies(both)):
        own = before["body"] == k
        full = [np.full(own.sum(), value) for value in (sample.mass, sample.volume)]
        bodies.append(reference.Particles(x[own], v[own], C[own], F[own], *full, stress))
        shown = carried[own]
        surfaces.append(contact.Surface.of(x[own], C[own], F[own], shown[:, :d], shown[:, d], *numbers))
        for kept, part in zip((momenta, masses), reference.scatter(bodies[-1:], box, kick / 2), strict=True):
            kept.append(part)
    assert contact.exchange(momenta, masses, surfaces, box, dt, 0.3) > 4

    up = np.eye(d)[1]
    floor = contact.Obstacle(lambda node: node[1], lambda _: up, lambda _: np.zeros(d), 0.2)
    # Chords of the circle that points of the ball go along in the step.
    turn = np.zeros((d, d))
    turn[:2, :2] = [[math.cos(dt * spin) - 1, -math.sin(dt * spin)], [math.sin(dt * spin), math.cos(dt * spin) - 1]]
    ball = contact.Obstacle(
        lambda node: np.linalg.norm(node - centre) - 1.5 * H,
        lambda node: contact.unit(node - centre),
        lambda node: pace + turn @ (node - centre) / dt,
        0.4,
    )
    taken = np.zeros(d)
    for k, obstacle in ((0, floor), (1, floor), (0, ball), (1, ball)):
        pushed, impulse = contact.stop(momenta[k], masses[k], surfaces[k], obstacle, box, dt, kick / 2 * gravity)
        assert pushed > 2 or (k == 0) == (obstacle is ball)
        taken += impulse if obstacle is ball else 0.0
    run.step(dt)
    found = bodies_of(run)
    for k, particles in enumerate(bodies):
        velocity = reference.update(momenta[k], masses[k], box, kick / 2)
        (after,) = reference.gather([particles], velocity, box, dt)
        state = found[both.bodies[k].name]
        assert np.abs(state.v - after.v).max() < 1e-12 * np.abs(after.v).max()
        assert np.abs(state.C - after.C).max() < 1e-11 * np.abs(after.C).max()
    booked = run.batch.device.features.colliders.loads.taken.to_numpy().sum(0)
    assert booked[:d] == pytest.approx(taken, rel=1e-12)


def test_short_steps_move_no_node_far(backend_of: Callable) -> None:
    """Of bodies that overlap by a quarter of a cell, in steps of 1e-7 s at 0.5 m/s: not a thousandth of a cell.

    The lowest particles of one end 1e-6 cells below a row of nodes, which have hardly any of its mass. With a push that
    falls with the step, not with its square, these would move as far in any step, and no step would be short enough.
    """
    tables = {"time": {"end": 1e-6, "frames": 1, "step": 1e-7}, "domain": {"walls": "separate"} | NONE}
    both = scene([body("a", [6, 0], [12, 2.5]), body("b", [8, 2.5], [10, 4.5])], **tables)
    run = build_run(both, backend_of("f64", 1))
    group = run.groups[0]
    state = group.read()
    second = state["body"][:, None] == 1
    group.replace(x=state["x"] - second * [0.0, (0.25 + 1e-6) * H], v=np.where(second, [0.0, -0.5], 0.0))
    run.state_was_replaced()
    rows = [row for _, row in run.frames()]
    assert rows[-1].contact_overlap > 0.1 and rows[-1].courant_max < 1e-3


# What bodies do.


def bars(shift: float, n: int) -> Scene:
    """Two bars of n x 6 cells that fly at each other at 0.02 m/s each, 4 cells apart; no lateral strain."""
    material = jelly(poissons_ratio=0.0)
    x, y = 8 + shift, 8 + shift
    return scene(
        [
            body("a", [x, y], [x + n, y + 6], material=material, velocity=[0.02, 0.0]),
            body("b", [x + n + 4, y], [x + 2 * n + 4, y + 6], material=material, velocity=[-0.02, 0.0]),
        ],
        end=2 * H / 0.02 + 3 * n * H / math.sqrt(E / DENSITY),
        frames=1500,
        domain=NONE | {"size": [(2 * n + 32) * H, 32 * H]},
    )


def falls_below(level: float, time: np.ndarray, values: np.ndarray) -> float:
    """Return when values do so first, between frames."""
    k = int(np.argmax(values < level))
    return float(np.interp(level, values[[k, k - 1]], time[[k, k - 1]]))


@pytest.mark.parametrize(
    ("shift", "n", "off", "lost"),
    [(0.3, 16, 0.03, 0.06), *(slow(*figures) for figures in ((0.0, 16, 0.03, 0.06), (0.3, 32, 0.03, 0.04)))],
)
def test_bars_meet_where_their_ends_are(backend_of: Callable, shift: float, n: int, off: float, lost: float) -> None:
    """They touch within 0.03 cells of their ends, stay for 2 L / c, and part at nearly the speed of approach."""
    frames = list(build_run(bars(shift, n), backend_of("f64", 1)).frames())
    time = np.array([row.time for _, row in frames])
    moves = np.array([frame.velocity[frame.body == 0, 0].mean() for frame, _ in frames]) / 0.02
    begins, ends = (falls_below(level, time, moves) for level in (0.95, moves[-1] + 0.05))
    length = 2 * n * H / math.sqrt(E / DENSITY)
    # A twentieth of the change is there after 0.025 of the time in contact.
    early = (2 * H / 0.02 + 0.025 * length - begins) * 2 * 0.02 / H
    assert abs(early) < 0.03
    assert (ends - begins) / (0.95 * length) == pytest.approx(1.0, abs=off)
    assert -1 < moves[-1] < lost - 1
    momentum = np.array([row.linear_momentum for _, row in frames])
    assert np.abs(momentum).max() < 1e-12 * frames[0][1].mass * 0.02


@pytest.mark.slow
def test_stress_is_uniform_up_to_a_surface_in_contact(backend_of: Callable) -> None:
    """A block between a floor and a lid that presses it by 2 %: layers of particles within 0.11 of the mean."""
    lid = {"name": "lid", "shape": box([4 * H, 18.3 * H], [28 * H, 24 * H])}
    press = lid | {"offset": ["0", f"{-0.32 * H!r} * clamp(t / 1.0, 0, 1)"]}
    material = jelly(poissons_ratio=0.0)
    tables = {"domain": {"size": [32 * H, 28 * H], "gravity": [0.0, 0.0]}, "colliders": [press]}
    block = body("block", [8, 2.3], [24, 18.3], material=material)
    floor = {"name": "floor", "shape": box([4 * H, -2 * H], [28 * H, 2.3 * H])}
    asked = scene([block], end=2.0, frames=40, **tables | {"colliders": [press, floor]})
    asked = asked.model_copy(update={"output": asked.output.model_copy(update={"fields": ("stress",)})})
    late = [frame for frame, _ in build_run(asked, backend_of("f64", 1)).frames()][20:]
    stress = np.mean([frame.fields["stress"].reshape(-1, 3, 3)[:, 1, 1] for frame in late], axis=0)
    rows = np.argsort(np.argsort(late[0].position[:, 1], kind="stable"), kind="stable") // 32
    means = np.array([stress[rows == row].mean() for row in range(32)])
    assert means.mean() == pytest.approx(-0.02 * E, rel=0.1)
    assert np.abs(means / means.mean() - 1).max() < 0.11


def on_slope(degrees: float, friction: float, shift: float = 0.3, time: float = 0.4) -> Scene:
    """A block on a base that a wall holds, gravity turned; the weight comes on in a quarter of the time."""
    slope, ramp = math.radians(degrees), f"clamp(t/{0.25 * time},0,1)"
    along = f"{G * math.sin(slope)!r}*clamp((t-{0.25 * time})*1e6,0,1)"
    down = f"{-G * math.cos(slope)!r}*{ramp}*{ramp}*(3-2*{ramp})"
    material = jelly(youngs_modulus=4e6)
    y = 6 + shift
    return scene(
        [
            body("base", [6 + shift, 0], [36 + shift, y], material=material),
            body("block", [10 + shift, y], [20 + shift, y + 6], material=material),
        ],
        friction,
        end=time,
        frames=50,
        domain={"gravity": [along, down]},
    )


def slides(run: object) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of frames, and the velocity of the block along the base."""
    frames = [(frame.time, frame.velocity[frame.body == 1, 0].mean()) for frame, _ in run.frames()]
    return tuple(np.array(frames).T)


@pytest.mark.parametrize(("friction", "shift"), [(0.3, 0.3), (0.0, 0.3), *(slow(0.3, shift) for shift in (0.0, 0.5))])
def test_a_block_slides_with_the_friction_that_was_asked_for(
    backend_of: Callable, friction: float, shift: float
) -> None:
    """On 30 degrees: g (sin - mu cos)."""
    time, speed = slides(build_run(on_slope(30, friction, shift), backend_of("f64", 1)))
    late = time > 0.16
    acceleration = np.polyfit(time[late], speed[late], 1)[0]
    slope = math.radians(30)
    found = (G * math.sin(slope) - acceleration) / (G * math.cos(slope))
    assert found == pytest.approx(friction, abs=0.002 if friction else 5e-4)


@pytest.mark.slow
def test_a_block_below_the_angle_of_friction_stays(backend_of: Callable) -> None:
    """It creeps by less than 1e-4 of its length in a second."""
    frames = [frame for frame, _ in build_run(on_slope(12, 0.3, time=2.0), backend_of("f64", 1)).frames()]
    late = [(frame.time, frame.position[frame.body == 1, 0].mean()) for frame in frames if frame.time > 0.7]
    assert abs(np.polyfit(*np.array(late).T, 1)[0]) < 1e-4 * 10 * H


@pytest.mark.slow
def test_a_disc_rolls_or_slides_down_an_elastic_slope(backend_of: Callable) -> None:
    """On 20 degrees: 2/3 g sin where it rolls; with mu = 0.05 it slides with g (sin - mu cos), and spins by mu."""
    slope, y, r = math.radians(20), 6.3, 8
    along, down = f"{G * math.sin(slope)!r}*clamp((t-0.3)*1e6,0,1)", f"{-G * math.cos(slope)!r}*clamp(t/0.18,0,1)"
    shape = ball([18.3 * H, (y + r) * H], r * H)
    base = body("base", [6, 0], [66, y], material=jelly(youngs_modulus=4e6))
    disc = {"name": "disc", "shape": shape, "material": jelly(youngs_modulus=4e6)}
    for friction in (0.5, 0.05):
        asked = scene([base, disc], friction, 0.7, 70, domain={"size": [76 * H, 32 * H], "gravity": [along, down]})
        found = []
        for frame, _ in build_run(asked, backend_of("f64", 1)).frames():
            x, v = (
                values[frame.body == 1] - values[frame.body == 1].mean(axis=0)
                for values in (frame.position, frame.velocity)
            )
            spin = (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() / (x**2).sum()
            found.append((frame.time, frame.velocity[frame.body == 1, 0].mean(), spin))
        time, speed, spin = np.array(found).T
        late = time > 0.42
        acceleration, turning = (np.polyfit(time[late], values[late], 1)[0] for values in (speed, spin))
        if friction == 0.5:
            assert acceleration / (2 / 3 * G * math.sin(slope)) == pytest.approx(1.0, abs=0.03)
        else:
            # The friction is right to 1 %; it acts at nodes, on average 0.25 cells above the lowest point of the disc.
            assert (math.sin(slope) - acceleration / G) / math.cos(slope) == pytest.approx(0.05, rel=0.02)
            assert -turning * r * H / (2 * G * math.cos(slope)) == pytest.approx(0.05 * (1 - 0.25 / r), rel=0.02)


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_bodies_that_touch_are_left_alone(backend_of: Callable, shift: float) -> None:
    """Their gap is 0 to 5e-4 h, beside edges too: the energy that they get is 1e-5 of that of a gap of h at most."""
    x, y = 20 + shift, 8 + shift
    touch = scene(
        [body("a", [x, y], [x + 10, y + 6]), body("b", [x, y + 6], [x + 10, y + 12])], 0.3, 0.05, 5, domain=NONE
    )
    rows = [row for _, row in build_run(touch, backend_of("f64", 1)).frames()]
    assert max(row.kinetic + row.elastic for row in rows) < 1e-5 * (LAMBDA + 2 * MU) * H**2


@pytest.mark.slow
def test_cubes_that_touch_anywhere_are_left_alone(backend_of: Callable) -> None:
    """At a corner over an edge mean normals look along neither face: from rest they reached 0.05 of the wave speed."""
    low, high = (
        body("a", [6.08, 6.86, 5.86], [12.83, 12.8, 11.41]),
        body("b", [4.11, 7.44, 11.41], [9.55, 13.11, 15.97]),
    )
    touch = scene_of(
        low, high, size=[20 * H] * 3, spacing=H, gravity=[0.0] * 3, end=0.005, contact=SEPARATE, precision="f64"
    )
    frame, row = list(build_run(touch, backend_of("f64", 1)).frames())[-1]
    assert np.abs(frame.velocity).max() < 5e-4 * math.sqrt((LAMBDA + 2 * MU) / DENSITY)
    assert row.contact_overlap < 0.01


@pytest.mark.slow
def test_single_precision_bears_nodes_of_hardly_any_mass(backend_of: Callable) -> None:
    """The product of the masses of two bodies at a node is 0 there, and what they do to each other finite."""
    tables = SeparateDisks().scene_tables(80, Setting(precision="f32"))
    frames = list(build_run(scene_of(**tables), backend_of("f32", 1)).frames())
    momentum = np.array([row.linear_momentum for _, row in frames])
    assert np.abs(momentum).max() < 1e-5 * frames[0][1].mass * SPEED


def thrown(
    mirrored: bool = False, turned: bool = False, names: str = "abc", safety: float = 0.8, contact: dict | None = None
) -> Scene:
    """Boxes that meet in the air at a third of their wave speed; `turned`: in another order."""

    def place(x: float) -> float:
        return 64 - x if mirrored else x

    sign = -1 if mirrored else 1
    made = [
        body(name, [min(place(x), place(x + 6)), y], [max(place(x), place(x + 6)), y + 6], velocity=[sign * u, w])
        for name, x, y, u, w in (("a", 10, 12, 4.0, 0.0), ("b", 17.3, 15.4, 0.0, -1.0), ("c", 18, 8.5, -2.0, 2.0))
    ]
    made = [one for one in made if one["name"] in names] + ([body("far", [54, 24], [60, 30])] if "far" in names else [])
    time = {"end": 0.15, "frames": 6, "safety": safety}
    output = {"fields": ["velocity", "affine", "mass"]}
    asked = made[::-1] if turned else made
    return scene(asked, 0.3, time=time, contact=contact or SEPARATE, output=output, domain=NONE)


def test_half_the_step_changes_little(backend_of: Callable) -> None:
    """By then they have flown apart by several cells."""
    (_, whole), (_, half) = (
        [frame for frame, _ in build_run(thrown(names="ac", safety=safety), backend_of("f64", 1)).frames()][::6]
        for safety in (0.8, 0.4)
    )
    for k in range(2):
        centres = [frame.position[frame.body == k].mean(axis=0) for frame in (whole, half)]
        assert centres[1] == pytest.approx(centres[0], abs=0.04 * H)


def test_a_bystander_changes_nothing(backend_of: Callable) -> None:
    """Two bodies do the same beside a third one far away, whether they separate, or stick as on one velocity field."""
    stick = SEPARATE | {"pairs": [{"between": ["a", "c"], "friction": "stick"}]}
    for alone, beside in ((SEPARATE, SEPARATE), ({"default": "stick"}, stick)):
        asked = thrown(names="ac", contact=alone), thrown(names="ac far", contact=beside)
        ends = [list(build_run(one, backend_of("f64", 1)).frames())[-1][0] for one in asked]
        for k in range(2):
            found, expected = (frame.position[frame.body == k] for frame in reversed(ends))
            assert found == pytest.approx(expected, abs=1e-9)


def momenta_of(frame: Frame) -> np.ndarray:
    """Return the momentum and the angular momentum of each of three bodies in 2D, (3, 3)."""
    mass, C, v = frame.fields["mass"], frame.fields["affine"].reshape(-1, 2, 2), frame.velocity
    x = frame.position
    turning = x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0] + H**2 / 4 * (C[:, 1, 0] - C[:, 0, 1])
    own = mass[:, None] * np.column_stack([v, turning])
    return np.array([own[frame.body == k].sum(axis=0) for k in range(3)])


def test_three_bodies_keep_what_they_have(backend_of: Callable) -> None:
    """Momentum and angular momentum stay; energy does not grow; a mirror changes nothing, the order little.

    The momenta of each body change by what the ledger says of its pairs.
    """
    runs = [
        list(build_run(thrown(**how), backend_of("f64", 1)).frames())
        for how in ({}, {"mirrored": True}, {"turned": True})
    ]
    frames = runs[0]
    first, speeds = frames[0][1], [frame.velocity[frame.body == 0].mean(axis=0) for frame, _ in frames]
    assert np.linalg.norm(speeds[-1] - speeds[0]) > 0.5
    momenta = np.array([row.linear_momentum for _, row in frames])
    turns = np.array([row.angular_momentum for _, row in frames])
    assert np.abs(momenta - momenta[0]).max() < 1e-12 * first.mass * 4
    assert np.abs(turns - turns[0]).max() < 1e-12 * first.mass * 4 * 3
    energy = np.array([row.kinetic + row.elastic for _, row in frames])
    assert energy.max() <= energy[0] * (1 + 1e-9)
    assert ContactTable(thrown()).pairs == (("a", "b"), ("a", "c"), ("b", "c"))
    for (before, _), (after, row) in pairwise(frames):
        on_first = np.hstack([row.contact_force, row.contact_torque]) * (after.time - before.time)
        changes = np.array([on_first[0] + on_first[1], on_first[2] - on_first[0], -on_first[1] - on_first[2]])
        assert momenta_of(after) - momenta_of(before) == pytest.approx(changes, abs=1e-11 * first.mass)
    assert 0.05 < max(row.contact_overlap for _, row in frames) < 1.0
    for (frame, _), (mirror, _), (other, _) in zip(*runs, strict=True):
        for k in range(3):
            centre = frame.position[frame.body == k].mean(axis=0)
            image = mirror.position[mirror.body == k].mean(axis=0) * [-1, 1] + [64 * H, 0]
            assert image == pytest.approx(centre, abs=1e-9)
            # At nodes of three bodies pairs come one after the other.
            assert other.position[other.body == 2 - k].mean(axis=0) == pytest.approx(centre, abs=0.08 * H)


# Periodic walls.


def compare(scenes: Sequence[Scene], shift: Sequence[float], start: Callable[[], Backend]) -> tuple[float, Frame]:
    """Run a scene, and the same moved by `shift` cells.

    Return by how many cells their particles differ, up to periods of the domain, and the last frame of the second.
    """
    one, other = ([frame for frame, _ in build_run(each, start()).frames()] for each in scenes)
    size = np.array(scenes[0].domain.size)
    away = [after.position - before.position - H * np.array(shift) for before, after in zip(one, other, strict=True)]
    return max(np.abs(way - size * np.round(way / size)).max() for way in away) / H, other[-1]


def discs(shift: Sequence[float], precision: str) -> Scene:
    """Balls that meet off their centres, in a domain that is periodic along all axes."""
    cells = np.array([64, 32, 16][: len(shift)])

    def ball(name: str, centre: list[float], velocity: list[float]) -> dict:
        place = (np.array(centre[: len(cells)]) + shift) % cells
        shape = {"ball": {"center": list(H * place), "radius": 3 * H}}
        return {"name": name, "shape": shape, "material": jelly(), "velocity": velocity[: len(cells)]}

    both = [ball("a", [26, 13, 6.3], [0.9, 0.4, 0.1]), ball("b", [38, 20, 7.0], [-0.9, -0.6, 0.1])]
    domain = {"size": list(H * cells), "walls": "periodic", "gravity": [0.0] * len(cells)}
    return scene(both, 0.3, end=0.5, frames=10, domain=domain, solver={"precision": precision})


@pytest.mark.parametrize(
    ("arch", "precision", "shift", "error"),
    [
        ("cpu", "f64", (32, 16), 1e-8),
        slow("cpu", "f64", (32, 16, 5), 1e-8),
        pytest.param("vulkan", "f32", (32, 16), 1e-4, marks=[pytest.mark.slow, pytest.mark.gpu]),
    ],
)
def test_bodies_meet_through_the_corner_of_a_periodic_domain(
    backend_of: Callable, arch: str, precision: str, shift: tuple[int, ...], error: float
) -> None:
    """They do what they do in its middle, and rebound."""
    scenes = [discs(by, precision) for by in ([0] * len(shift), shift)]
    found, last = compare(scenes, shift, lambda: backend_of(precision, 1, arch))
    assert found < error
    assert last.velocity[last.body == 0, 0].mean() == pytest.approx(-0.72, abs=0.04)


@pytest.mark.slow
def test_a_block_pushes_another_through_a_periodic_face(backend_of: Callable) -> None:
    """On a rough floor, beside water."""

    def pushed(shift: float) -> Scene:
        def place(x: float) -> float:
            return (x + shift) % 32

        low = {name: place(x) for name, x in (("a", 14), ("b", 21), ("w", 27))}
        water = {"law": "fluid", "density": DENSITY, "bulk_modulus": 2e4}
        bodies = [
            body("a", [low["a"], 0], [low["a"] + 6, 4], velocity=[1.5, 0.0]),
            body("b", [low["b"], 0], [low["b"] + 4, 4]),
            body("w", [low["w"], 0], [low["w"] + 3, 3], material=water),
        ]
        walls = {"x_min": "periodic", "x_max": "periodic", "y_min": "separate"}
        domain = {"size": [32 * H, 16 * H], "walls": walls, "gravity": [0.0, -G], "friction": {"y_min": 0.1}}
        return scene(bodies, 0.2, end=0.3, frames=6, domain=domain)

    found, last = compare((pushed(0), pushed(11)), (11, 0), lambda: backend_of("f64", 1))
    assert found < 1e-8
    assert last.velocity[last.body == 1, 0].mean() > 0.3


def metal(**more: object) -> dict:
    """Return a metal whose particles carry its surface."""
    own = {"law": "von_mises", "density": DENSITY, "youngs_modulus": 1e7, "poissons_ratio": NU, "yield_stress": 2.5e4}
    return own | {"hardening_modulus": 5e3, "surface_friction": 0.1} | more


def bar_and_block(end: float, **moves: object) -> Scene:
    """A bar of 20 x 8 cells, and a block of 20 x 16 cells two cells behind it."""
    bar = body("bar", [10.3, 12], [30.3, 20], material=metal(), **moves)
    return scene([bar, body("block", [32.3, 8], [52.3, 24], material=metal())], 0.1, end=end, frames=20)


def test_metal_dents_and_parts(backend_of: Callable) -> None:
    """At 0.04 of its wave speed, 8 times that at yield: it leaves with the little that stays elastic, 0.02 to 0.12."""
    pace = 4.0
    frames = list(build_run(bar_and_block(0.2, velocity=[pace, 0.0]), backend_of("f64", 1)).frames())
    found = np.array([[frame.velocity[frame.body == k, 0].mean() for k in (0, 1)] for frame, _ in frames])
    assert 0.02 * pace < found[-1, 1] - found[-1, 0] < 0.12 * pace
    assert found[-1] == pytest.approx(found[-4], abs=1e-6 * pace)
    assert found @ [1, 2] == pytest.approx(np.full(len(frames), pace), rel=1e-9)
    energy = np.array([row.energy for _, row in frames])
    assert energy.max() <= energy[0] * (1 + 1e-6) and energy[-1] < 0.5 * energy[0]
    place, whose = frames[-1][0].position, frames[-1][0].body
    assert place[whose == 1, 0].min() - place[whose == 0, 0].max() > 0.1 * H


def test_metal_carries_its_surface_along(backend_of: Callable) -> None:
    """A bar that turns by a radian turns the normals of its particles, and keeps their depths below its faces."""
    asked = bar_and_block(0.25, velocity_gradient=[[0.0, -4.0], [4.0, 0.0]])
    run = build_run(asked, backend_of("f64", 1))
    *_, (frame, _) = run.frames()
    arrays = run.groups[0].arrays
    at_rest = rest_surface(asked.bodies[0], sample_bodies(asked)[0], H)
    found = arrays.carried.to_numpy()[np.argsort(arrays.id.to_numpy()[: len(frame.position)])][: len(at_rest)]
    places = [
        x[frame.body == 0] - x[frame.body == 0].mean(axis=0)
        for x in (np.concatenate([own.position for own in sample_bodies(asked)]), frame.position)
    ]
    (x, y), (u, v) = places[0].T, places[1].T
    angle = math.atan2((x * v - y * u).sum(), (x * u + y * v).sum())
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    assert angle == pytest.approx(1.0, abs=0.02)
    assert found[:, :2] == pytest.approx(at_rest[:, :2] @ turn.T, abs=0.02)
    assert found[:, 2] == pytest.approx(at_rest[:, 2], rel=0.02)


def pushed(dimension: int, friction: float = 0.3, **tables) -> Scene:
    """Return two blocks of jelly that fly at each other above a floor, one of them beside water and against a ball."""
    d = dimension
    # In 3D they have the same depth everywhere.
    bodies = [
        ("left", jelly(), [0.2, 0.02, 0.3], [0.45, 0.3, 0.6], 2.0),
        ("right", jelly(youngs_modulus=2e5), [0.48, 0.02, 0.3], [0.7, 0.3, 0.6], -2.0),
        *[("water", liquid(1e5), [0.72, 0.02], [0.9, 0.2], -1.0)] * (d == 2),
    ]
    return scene_of(
        *(
            block(name, material, low[:d], high[:d], velocity=[speed, -2.0, 0.0][:d])
            for name, material, low, high, speed in bodies
        ),
        domain={"size": [1.0] * d, "cells": [20 if d == 2 else 14] * d, "gravity": [0.0, -9.81, 0.0][:d]},
        friction=0.2,
        time={"end": 0.02, "frames": 2},
        colliders=[collider("ball", ball([0.1, 0.15, 0.45][:d], 0.08), velocity=[5.0, 0.0, 0.0][:d], friction=0.4)],
        contact={"default": "separate", "friction": friction},
        precision="f32",
        **tables,
    )


@pytest.mark.gpu
@pytest.mark.parametrize("dimension", [2, slow(3)])
def test_contact_on_a_gpu_follows_that_on_the_cpu(backend_of: Callable, dimension: int) -> None:
    """Positions to round-off, forces and overlaps to 1e-3, across a saved state; a frame forgets what it has told."""
    found, steps = [], 100 if dimension == 2 else 50
    for arch in ("vulkan", "cpu"):
        run = build_run(pushed(dimension), backend_of("f32", 1, arch))
        for k in range(steps):
            run.step(2e-4)
            if k == steps // 2 and arch == "vulkan":
                run.load(run.save().copied())
        frame, row = run.frame()
        told = np.array([*row.contact_force, *row.collider_force])
        assert np.abs(run.frame()[1].contact_force).max() == 0.0
        found.append((frame, told, row.contact_overlap))
    (own, told, overlap), (other, expected_told, expected_overlap) = found
    apart = farthest(other.position, other.velocity, steps, other.time)
    assert np.abs(own.position - other.position).max() < apart
    assert (np.abs(expected_told[[-2, -1], 0]) > 5).all()
    assert np.abs(told - expected_told).max() < 1e-3 * np.abs(expected_told).max()
    assert overlap == pytest.approx(expected_overlap, rel=1e-3)


@pytest.mark.gpu
@pytest.mark.slow
def test_runs_of_a_batch_do_what_they_do_alone(backend_of: Callable) -> None:
    """Each with friction of its own."""
    scenes = [pushed(2), pushed(2, friction=0.0)]
    backend = backend_of("f32", 1, "vulkan")
    batch, last = batch_of(scenes, backend), {}
    for slot, event in frames_of_all({k: Run(batch, k, one) for k, one in enumerate(scenes)}):
        if isinstance(event, tuple):
            last[slot] = event[0].position
    *_, (alone, _) = build_run(scenes[1], backend).frames()
    assert np.abs(last[0] - last[1]).max() > 1e-4
    assert np.abs(last[1] - alone.position).max() < 1e-5
