"""Colliders of a sweep: placed apart from everything, varied by name, and all by one kernel."""

import json
from pathlib import Path

import numpy as np
import pytest
from good_sweep import BASE, LAWS, refusal, sweep_of
from scenes import plane
from test_placement import assert_well_placed, solids_of

from mpmcli.dataset.draw import draw, room_before
from mpmcli.scene import Scene
from mpmcli.scene.colliders import Collider
from mpmcli.simulation.runner import Runner
from mpmcli.solver.engine.resolved import Resolved

COLLIDERS = """\
[[colliders]]
name = "post"
shape = { ball = { center = [0.5, 0.5], radius = 0.05 } }
[[colliders]]
name = "bar"
shape = { box = { min = [0.3, 0.6], max = [0.4, 0.65] } }
[[colliders]]
name = "tank"
side = "inside"
shape = { ball = { center = [0.5, 0.5], radius = 0.6 } }
[[colliders]]
name = "slope"
shape = { plane = { point = [0.0, 0.05], normal = [0.1, 1.0] } }
"""
SWEEP = """\
base = "base.toml"
count = 20
seed = 3
[vary]
"colliders.slope.friction" = { uniform = [0.1, 0.4] }
"colliders.tank.wall" = { choice = ["slip", "stick"] }
[[place]]
collider = "post"
count = { integers = [1, 4] }
radius = { uniform = [0.03, 0.06] }
region = { min = [0.0, 0.0], max = [1.0, 1.0] }
min_distance = 0.02
[[place]]
body = "sand"
count = 1
size = [0.2, 0.2]
region = { min = [0.0, 0.0], max = [1.0, 1.0] }
min_distance = 0.02
"""
WITH = BASE + COLLIDERS


@pytest.fixture(autouse=True)
def empty_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sweeps are loaded from the present directory."""
    monkeypatch.chdir(tmp_path)


def test_placed_colliders_are_apart_from_bodies_colliders_walls_and_containers() -> None:
    sweep, counts, rubs = sweep_of(SWEEP, WITH), set(), set()
    context = {"dimension": 2, "constants": {}}
    for number in range(20):
        drawn = draw(sweep, number)
        posts, sand = drawn.values["place.colliders.post"], drawn.values["place.sand"]
        counts.add(len(posts))
        names = [collider["name"] for collider in drawn.data["colliders"]]
        assert names == [*(f"post_{k + 1}" for k in range(len(posts))), "bar", "tank", "slope"]
        assert drawn.collider_origins == (*[0] * len(posts), 1, 2, 3)
        assert drawn.origins == (0, 1)
        stone, bar = ("ball", [0.7, 0.2], 0.1), ("box", [0.3, 0.6], [0.4, 0.65])
        solids = solids_of([*posts, *sand])
        assert_well_placed(solids, ([0.0, 0.0], [1.0, 1.0]), 0.02, [stone, bar])
        walls = [Collider.model_validate(table, context=context) for table in drawn.data["colliders"][-2:]]
        for wall in walls:
            for kind, first, second in solids:
                low, high = np.array(first), np.array(second)
                corners = [[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])] if kind == "box" else [first]
                away = wall.signed_distance(np.array(corners)).min() - (0.0 if kind == "box" else second)
                assert away >= 0.02 - 1e-12
        rubs.add((drawn.scene(LAWS).scene.colliders[-1].friction, drawn.scene(LAWS).scene.colliders[-2].wall))
        json.dumps(drawn.values)
    assert counts == {1, 2, 3, 4}
    assert len({friction for friction, _ in rubs}) == 20 and {wall for _, wall in rubs} == {"slip", "stick"}


def test_bodies_lie_where_they_would_without_placed_colliders() -> None:
    """What is drawn of a key depends on it alone: more places to keep from change a place only where it is taken."""
    bare = SWEEP.replace(SWEEP[SWEEP.index("[[place]]") : SWEEP.rindex("[[place]]")], "")
    with_posts, without = (sweep_of(text, WITH) for text in (SWEEP, bare))
    same = [draw(with_posts, n).values["place.sand"] == draw(without, n).values["place.sand"] for n in range(20)]
    assert 10 < sum(same) <= 20


def test_room_before_a_wall_is_that_of_the_nearest_corner() -> None:
    centers = np.array([[0.5, 0.5], [0.1, 0.5]])
    wall = Collider.model_validate(
        {"name": "w", "shape": plane([0.0, 0.0], [1.0, 0.0])}, context={"dimension": 2, "constants": {}}
    )
    assert room_before(centers, np.array([0.05, 0.3]), 0.0, wall.signed_distance) == pytest.approx([0.45, 0.05])
    assert room_before(centers, np.zeros(2), 0.2, wall.signed_distance) == pytest.approx([0.3, -0.1])


@pytest.mark.parametrize(("old", "new", "said"), [
    ('collider = "post"', 'collider = "pots"',
     'no collider of the base scene has the name "pots"; did you mean "post"?'),
    ('collider = "post"', 'collider = "slope"', 'must be a box or a ball; "slope" is a plane'),
    ('collider = "post"', 'collider = "post"\nbody = "sand"', "must be the name of a body, or collider that of a"),
    ("count = { integers = [1, 4] }", "count = { integers = [-1, 4] }", "must be whole numbers from 0 to 1000"),
    ("[0.1, 0.4]", "[-0.1, 0.4]", "must be at least 0; found -0.1"),
    ('"colliders.slope.friction"', '"colliders.slope"', "a collider or a force holds"),
    ('"colliders.slope.friction"', '"colliders.post.shape.ball.radius"', 'the placement of "post" sets as well'),
    ("radius = { uniform = [0.03, 0.06] }", "radius = 0.4\nsize = [0.1, 0.1]",
     '"post" is a ball, which has no size'),
])  # fmt: skip
def test_a_faulty_placement_of_a_collider_is_named(old: str, new: str, said: str) -> None:
    assert said in "\n".join(refusal(SWEEP.replace(old, new, 1), WITH))


def test_no_collider_is_a_number_of_them() -> None:
    drawn = draw(sweep_of(SWEEP.replace("{ integers = [1, 4] }", "0"), WITH), 0)
    assert [collider["name"] for collider in drawn.data["colliders"]] == ["bar", "tank", "slope"]


def scenes_by_count() -> dict[int, Scene]:
    """Return a scene of the sweep for each number of posts."""
    base = WITH.replace("end = 0.1", "end = 0.004")
    sweep = sweep_of(SWEEP.replace('{ choice = ["slip", "stick"] }', '"slip"'), base)
    scenes: dict[int, Scene] = {}
    for number in range(20):
        drawn = draw(sweep, number)
        scenes.setdefault(len(drawn.values["place.colliders.post"]), drawn.scene(LAWS).scene)
    return scenes


def test_numbers_and_places_of_colliders_make_one_kind() -> None:
    scenes = scenes_by_count()
    kinds = {count: Resolved(scene).kind for count, scene in scenes.items()}
    joined = kinds[1].joined(kinds[4])
    assert joined is not None and joined.colliders == kinds[4].colliders
    assert kinds[4].joined(kinds[2]) == kinds[4].joined(kinds[1])


@pytest.mark.slow
def test_numbers_and_places_of_colliders_share_a_kernel() -> None:
    """What an earlier trajectory left in the room of the kernel changes no byte of a later one."""
    scenes = scenes_by_count()
    runner = Runner("cpu")
    runner.expect(scenes.values())
    found = {}
    for count in (4, 1, 2):
        found[count] = runner.run(scenes[count])
        assert len(runner._batches) == 1
        assert len(found[count].ledger[-1].collider_force) == count + 3
    alone = Runner("cpu").run(scenes[1])
    for own, shared in zip(alone.frames, found[1].frames, strict=True):
        assert own.position.tobytes() == shared.position.tobytes()
        assert own.velocity.tobytes() == shared.velocity.tobytes()
    assert repr(alone.ledger) == repr(found[1].ledger)
