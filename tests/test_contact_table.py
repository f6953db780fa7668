"""One table says who meets whom, by which method, and with which friction; `mpmcli check` prints it."""

from check_scenes import SOLID
from command import run_here
from scenes import box, scene_of

from mpmcli.scene import Scene
from mpmcli.scene.contact_table import NODES, PARTICLES, POINTS, SURFACE, ContactTable
from mpmcli.solver.contact.layers import Layers

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e6, "friction_angle": 30.0}


def body(name: str, x: float, material: dict = SOLID) -> dict:
    return {"name": name, "material": material, "shape": box([x, 0.3], [x + 0.4, 0.7])}


def collider(name: str, x: float, **more: object) -> dict:
    return {"name": name, "shape": box([x, 1.0], [x + 0.4, 1.4])} | more


def table(bodies: list[dict], colliders: tuple[dict, ...] = (), walls: object = "separate", **more: object) -> Scene:
    domain = {"size": [6.0, 2.0], "spacing": 0.05, "walls": walls, "friction": more.pop("friction", 0.0)}
    contact = {"contact": {"default": "auto"}} | more
    time = {"end": 0.1, "frames": 1}
    return scene_of(*bodies, domain=domain, time=time, colliders=list(colliders), **contact)


def rows(scene: Scene) -> list[tuple]:
    return [(row.first, row.second, row.method, row.friction) for row in ContactTable(scene).rows()]


def test_each_pair_of_what_a_scene_contains_has_one_row() -> None:
    """Bodies, a shared field, colliders of each word, a rigid body, and walls of two kinds."""
    bodies = [body("left", 0.3), body("water", 1.0, WATER), body("right", 2.0), body("sand", 3.0, SAND)]
    rough, held = collider("rough", 1.0, friction=0.3), collider("held", 2.0, wall="hold")
    raft = collider("raft", 3.0, density=500.0, friction=0.2)
    scene = table(bodies, (rough, held, raft), {"default": "separate", "y_min": "stick"}, friction=0.1)
    scene = scene.model_copy(update={"contact": scene.contact.model_copy(update={"friction": 0.5})})
    own, shared, faces = ("left", "right"), ("water", "sand"), ("x_min", "x_max", "y_max")
    assert set(rows(scene)) == {
        (("water",), ("sand",), NODES, None),
        (shared, own, SURFACE, 0.0),
        (("left",), ("right",), SURFACE, 0.5),
        (own, ("rough",), SURFACE, 0.3),
        (shared, ("rough",), POINTS, 0.3),
        (("left", "water", "right", "sand"), ("held",), NODES, None),
        (own, ("raft",), SURFACE, 0.2),
        (shared, ("raft",), POINTS, 0.2),
        (own, faces, SURFACE, 0.1),
        (shared, faces, NODES, 0.1),
        (("left", "water", "right", "sand"), ("y_min",), NODES, None),
        (("raft",), ("rough",), POINTS, 0.3),
        (("raft",), ("x_min", "x_max", "y_min", "y_max"), POINTS, 0.2),
    }


def test_bodies_that_meet_each_other_alike_have_one_row() -> None:
    scene = table([body(name, 0.5 + k) for k, name in enumerate("abcde")])
    assert rows(scene) == [(tuple("abcde"), tuple("abcde"), SURFACE, 0.0), (tuple("abcde"), ("walls",), SURFACE, 0.0)]


def test_a_pair_with_a_friction_of_its_own_has_its_own_row() -> None:
    pairs = [{"between": ["a", "c"], "friction": "stick"}]
    scene = table([body(name, 0.5 + k) for k, name in enumerate("abc")], contact={"default": "auto", "pairs": pairs})
    found = [(row.first, row.second, row.friction, row.source) for row in ContactTable(scene).rows()]
    assert (("a",), ("c",), None, "contact.pairs[0]") in found
    assert {(("a",), ("b",)), (("b",), ("c",))} <= {row[:2] for row in found}


def test_what_excludes_surfaces_is_the_source_of_sticking() -> None:
    sparse = table([body("a", 0.5), body("b", 1.5)], solver={"grid": "sparse"})
    assert next((row.method, row.source) for row in ContactTable(sparse).rows()) == (NODES, 'solver.grid = "sparse"')
    total = table([body("a", 0.5), body("b", 1.5)], solver={"solids": "total"})
    assert {row.method for row in ContactTable(total).rows()} == {PARTICLES}
    glued = table([body("a", 0.5), body("b", 1.5)], contact={"default": "stick"})
    assert next((row.friction, row.source) for row in ContactTable(glued).rows()) == (None, "contact.default")


def test_the_solver_has_a_layer_for_each_field_of_the_table() -> None:
    """Whatever the order of the bodies; surfaces are those of bodies with their own layer."""
    bodies = [body("left", 0.3), body("water", 1.0, WATER), body("right", 2.0)]
    for order in (bodies, bodies[::-1], bodies[1:], bodies[:1], bodies[1:2]):
        scene = table(order, (collider("post", 4.0),))
        layers, own = (
            Layers.of(scene),
            {name for row in rows(scene) if row[2] == SURFACE and row[1] == ("post",) for name in row[0]},
        )
        assert {one.name for k, one in enumerate(scene.bodies) if layers.has_own(k)} == own
        assert layers.count == len(ContactTable(scene).fields) and layers.by_points == any(
            row[2] == POINTS for row in rows(scene)
        )


def test_check_prints_the_table(tmp_path) -> None:
    file = tmp_path / "scene.toml"
    file.write_text(
        "[domain]\nsize = [1.0, 1.0]\nspacing = 0.05\ngravity = [0.0, -9.81]\nfriction = { y_min = 0.5 }\n"
        "[time]\nend = 0.1\nframes = 1\n"
        '[[bodies]]\nname = "block"\nmaterial = "jelly"\nshape = { box = { min = [0.2, 0.2], max = [0.6, 0.6] } }\n'
    )
    done = run_here("check", file)
    row = ["block", "y_min", "surface", "0.5", "friction", "of", "the", "wall"]
    assert row in [line.split() for line in done.stdout.splitlines()]
