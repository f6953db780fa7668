"""Room in few sizes: enough, little more than that, and no new kernel for a scene that is edited."""

import math
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import ball, block, body, box, liquid, scene_of, solid

from mpmcli.solver.engine import kernel_store
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import choose_backend, start, stop_backend
from mpmcli.solver.machine.costs import FEWEST, in_steps, padded_cells, power_of_two


@given(st.integers(1, 2**31))
def test_room_is_enough_and_little_more(count: int) -> None:
    room = in_steps(count)
    assert count <= room <= max(FEWEST, count * 9 / 8)
    assert in_steps(room) == room
    assert power_of_two(count) / 2 < count <= power_of_two(count)


@given(st.integers(FEWEST, 2**30))
def test_there_are_few_sizes(count: int) -> None:
    """Eight between a number and its double, and some where sizes begin to be off from powers of two."""
    sizes, room = set(), in_steps(count)
    while room <= 2 * count:
        sizes.add(room)
        room = in_steps(room + 1)
    assert len(sizes) <= 12
    assert in_steps(0) == 0


@given(st.lists(st.integers(5, 3000), min_size=2, max_size=3))
def test_a_grid_grows_by_a_sixteenth_along_an_axis_at_most(cells: list[int]) -> None:
    """Or to the next multiple of four cells: 15 % in 2D and 25 % in 3D at most from 65 cells on; of 64 or 8 below."""
    padded = padded_cells(cells)
    few = {2: 63, 3: 7}[len(cells)]
    assert all(n <= r <= max(n + (few if n <= 64 else 3), n * 17 / 16) for n, r in zip(cells, padded, strict=True))
    if min(cells) > 64:
        assert math.prod(padded) <= math.prod(cells) * {2: 1.15, 3: 1.25}[len(cells)]


SCENE = {
    "domain": {"size": [2.0, 1.5], "spacing": 0.05, "gravity": [0.0, -9.81], "walls": "separate"},
    "time": {"end": 0.002, "frames": 1},
    "output": {"fields": ["velocity"]},
    "bodies": [
        block("water", liquid(1e5, viscosity=0.1), [0.1, 0.1], [0.8, 0.6], velocity=[0.1, 0.0]),
        body("ball", solid(1e5, density=800.0), ball([1.3, 0.9], 0.21)),
    ],
    "colliders": [{"name": "stone", "shape": ball([1.0, 0.2], 0.1)}],
}


def set_(*path: str | int, to: object) -> Callable[[dict], None]:
    """Return an edit that puts a value in a place of the tables."""

    def edit(tables: dict) -> None:
        for key in path[:-1]:
            tables = tables[key]
        tables[path[-1]] = to

    return edit


def stones(count: int) -> Callable[[dict], None]:
    """Return an edit to so many colliders."""
    shapes = [ball([0.9 + 0.2 * k, 0.2], 0.05) for k in range(count)]
    return set_("colliders", to=[{"name": f"stone {k}", "shape": shape} for k, shape in enumerate(shapes)])


EDITS = {
    "place of a box": set_("bodies", 0, "shape", "box", to={"min": [0.2, 0.1], "max": [0.9, 0.6]}),
    "size of a box": set_("bodies", 0, "shape", "box", "max", to=[0.81, 0.6]),
    "place of a ball": set_("bodies", 1, "shape", "ball", "center", to=[1.4, 0.8]),
    "radius of a ball": set_("bodies", 1, "shape", "ball", "radius", to=0.205),
    "shape of a body": set_("bodies", 1, "shape", to=box([1.1, 0.7], [1.45, 1.07])),
    "velocity": set_("bodies", 0, "velocity", to=[0.0, 0.3]),
    "density": set_("bodies", 1, "material", "density", to=900.0),
    "modulus": set_("bodies", 1, "material", "youngs_modulus", to=2e5),
    "bulk modulus": set_("bodies", 0, "material", "bulk_modulus", to=2e5),
    "viscosity": set_("bodies", 0, "material", "viscosity", to=0.5),
    "gravity": set_("domain", "gravity", to=[1.0, -8.0]),
    "size of the domain": set_("domain", "size", to=[1.95, 1.45]),
    "end and frames": set_("time", to={"end": 0.004, "frames": 3}),
    "fields": set_("output", "fields", to=["velocity", "pressure", "stress"]),
    "place of a collider": set_("colliders", 0, "shape", "ball", "center", to=[1.2, 0.3]),
    "a second collider": stones(2),
    "a fourth collider": stones(4),
    # These change what is computed.
    "walls": set_("domain", "walls", to="stick"),
    "law": set_("bodies", 1, "material", "law", to="fixed_corotated"),
    "transfer": set_("solver", to={"transfer": "aflip"}),
}
ANEW = ("walls", "law", "transfer")


@pytest.mark.parametrize("runs", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_edits_of_a_scene_compile_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, runs: bool) -> None:
    """Of twenty edits three change what is computed. The others find the files of all kernels; see `kernel_key`."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def compiled(tables: dict) -> set[str]:
        """Return the key of the scene's kernel, and Taichi's files, after it was built or has run."""
        scene = scene_of(**tables)
        stop_backend()
        backend = start(choose_backend("cpu", 1, "f32", optimisation="few"))
        run = build_run(scene, backend)
        if runs:
            list(run.frames())
        key = kernel_store.kernel_key(run.batch.kind, backend, 1)
        stop_backend()
        return {key, *(path.name for path in tmp_path.rglob("*.tic"))}

    known, anew = compiled(SCENE), []
    for name, edit in EDITS.items():
        tables = deepcopy(SCENE)
        edit(tables)
        found = compiled(tables)
        if found - known:
            anew.append(name)
        known |= found
    assert len(EDITS) == 20 and anew == list(ANEW)


def test_a_larger_kind_is_roomy_itself() -> None:
    scene = scene_of(**SCENE)
    kind = Resolved(scene).kind.padded()
    assert kind.padded() == kind
    assert kind.joined(Resolved(scene).kind) == kind
