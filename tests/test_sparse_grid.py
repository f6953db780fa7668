"""A sparse grid: the nodes that particles need are there, and results are those of a dense grid up to rounding."""

import itertools
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import ball, block, body, scene, slow
from test_batch import SCENES, scene_named
from test_emitters import SPACING, jet_scene

from mpmcli.boundaries.walls import IMAGE_DEPTH
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.scene import Scene, sample_bodies
from mpmcli.scene.forces import Contact
from mpmcli.solver.engine import batch
from mpmcli.solver.engine.plan import make_plan, require_memory
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.grid.sparse_grid import first_nodes_of, reach_along, tiles_reached, wants_sparse
from mpmcli.solver.machine.backend import Backend
from mpmcli.solver.transfer.splines import PAD
from mpmcli.stability.transfer_factors import INTERVAL

FLUID = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e4}
# Every part of a step that reads or writes nodes: images, friction, faces that repeat and move, colliders, volumes that
# are averaged, or relaxed with two densities, and velocities from before the step.
NAMES = ("position", "velocity")
USUAL = ("periodic, a wall moves, AFLIP",)


def changed(start: Scene, **solver: object) -> Scene:
    """Return a scene with other settings of the solver."""
    return start.model_copy(update={"solver": start.solver.model_copy(update=solver)})


def frames_of(start: Scene, backend: Backend) -> list[Frame]:
    """Run a scene."""
    run = build_run(start, backend, sample_bodies(start))
    return [frame for frame, _row in run.frames()]


def largest_difference(found: Sequence[Frame], expected: Sequence[Frame]) -> float:
    """Return the largest difference of positions and velocities, relative to the largest of each."""
    assert len(found) == len(expected) > 1
    arrays = [[np.stack([getattr(frame, name) for frame in one]) for one in (found, expected)] for name in NAMES]
    return max(float(np.abs(a - b).max() / np.abs(b).max()) for a, b in arrays)


def drop(cells: int = 24, **more: object) -> Scene:
    """Return a drop that falls to pieces on a floor, in a domain that is nearly empty."""
    drop = body("drop", FLUID, ball([0.6, 0.3], 0.1))
    return changed(
        scene((cells, cells), 1 / cells, [drop | {"velocity": [3.0, -4.0]}], 0.1, frames=4, gravity=(0, -9.81)),
        **{"grid": "sparse"} | more,
    )


@settings(max_examples=60, deadline=None)
@given(
    cells=st.integers(8, 40), kind=st.sampled_from([(4, 1, 3), (6, 2, 3), (5, 1, 4), (7, 2, 4)]), repeats=st.booleans()
)
def test_what_particles_of_a_tile_write_is_reached(cells: int, kind: tuple[int, int, int], repeats: bool) -> None:
    """Nodes of every stencil that drifted as far as it may, and their images behind walls or across the domain."""
    tile, drift, stencil = kind
    table = reach_along(cells, tile, (drift, drift + stencil - 1), repeats=repeats)
    last = cells + PAD
    for t, reached in enumerate(table):
        for first in range(max(t * tile - drift, 0), min((t + 1) * tile - 1 + drift, last + 1) + 1):
            for node in range(first, min(first + stencil, len(table) * tile)):
                images = [node]
                if repeats:
                    images += [node + cells] * (node <= 2 * PAD) + [node - cells] * (node >= last - PAD)
                else:
                    images += [2 * PAD - node] * (abs(node - PAD) <= IMAGE_DEPTH)
                    images += [2 * last - node] * (abs(node - last) <= IMAGE_DEPTH)
                assert {i // tile for i in images} <= set(reached.tolist())


def test_tiles_reached_are_those_around_particles() -> None:
    """Against every combination of what is reached along the axes."""
    reach = [reach_along(n, 4, (1, 3), repeats=False) for n in (9, 30, 14)]
    nodes = np.random.default_rng(0).integers(2, [12, 33, 17], (20, 3))
    shape = [len(table) for table in reach]
    expected = {
        int(np.ravel_multi_index(place, shape))
        for node in nodes // 4
        for place in itertools.product(*([k for k in table[i] if k >= 0] for table, i in zip(reach, node, strict=True)))
    }
    assert tiles_reached(nodes, 4, reach).tolist() == sorted(expected)


def test_the_kernel_numbers_the_same_tiles(backend_of: Callable) -> None:
    """As numpy does, from the positions of the sort, in the order of the domain."""
    start = drop(cells=48)
    run = build_run(start, backend_of("f32"), sample_bodies(start))
    grid = run.batch.device.grid
    before = grid.occupied()
    run.advance(1)
    position = np.concatenate([body.position for body in sample_bodies(start)])
    assert np.array_equal(grid.occupied(), tiles_reached(first_nodes_of(position, start), grid.tile, grid.reach))
    assert np.array_equal(grid.occupied(), before)
    # Every node that has mass is stored.
    nodes = grid.nodes.to_numpy()
    volumes = [body.volume * body.count for body in sample_bodies(start)]
    assert nodes[:, 2].sum() == pytest.approx(1000.0 * sum(volumes), rel=1e-5)
    run.advance(2 * INTERVAL)
    assert not np.array_equal(grid.occupied(), before)
    # Particles were shifted too, and nothing was written to the nodes that stand for all others.
    for nodes, size in ((grid.nodes, grid.block), (grid.fine.fill, grid.fine.block)):
        assert nodes.to_numpy()[size:].any()
        assert not nodes.to_numpy()[:size].any()


@pytest.mark.parametrize("name", [*USUAL, *(slow(name) for name in SCENES if name not in USUAL)])
def test_results_are_those_of_a_dense_grid(backend_of: Callable, name: str) -> None:
    """Sums are in another order, in double precision."""
    start = changed(scene_named(name), precision="f64")
    dense, sparse = (frames_of(changed(start, grid=grid), backend_of("f64")) for grid in ("dense", "sparse"))
    assert 0 < largest_difference(sparse, dense) < 1e-9


def test_a_grid_grows_with_what_particles_reach(backend_of: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that begins with little room, on two threads, ends with the bytes of one with room enough on one thread."""
    expected = frames_of(drop(cells=48), backend_of("f32", 1))
    monkeypatch.setattr(batch, "room_for_blocks", lambda particles: 5)
    monkeypatch.setattr(batch, "GROWTH", 1)
    grown: list[int] = []
    grow = batch.Batch.grow
    monkeypatch.setattr(batch.Batch, "grow", lambda self, blocks: (grown.append(blocks), grow(self, blocks)))
    assert largest_difference(frames_of(drop(cells=48), backend_of("f32", 2)), expected) == 0
    # For the first positions, and again for what reaches more later.
    assert len(grown) >= 2


@pytest.mark.parametrize("room", [slow(5), 5_000])
def test_a_loaded_run_goes_on_with_the_same_bytes(
    backend_of: Callable, monkeypatch: pytest.MonkeyPatch, room: int
) -> None:
    """In a run with more or less room for blocks, and another number of threads."""
    start = drop(cells=48)
    run = build_run(start, backend_of("f32"), sample_bodies(start))
    run.advance(30)
    saved = run.save().copied()
    # Particles are shifted on the way.
    run.advance(INTERVAL)
    expected = run.frame()[0]
    monkeypatch.setattr(batch, "room_for_blocks", lambda particles: room)
    other = build_run(start, backend_of("f32", 2), sample_bodies(start))
    other.load(saved)
    other.advance(INTERVAL)
    found = other.frame()[0]
    assert (found.time, found.step) == (expected.time, expected.step)
    assert all(np.array_equal(getattr(found, name), getattr(expected, name)) for name in NAMES)
    blocks = saved.arrays["grid.blocks"]
    for other_blocks in (blocks[::-1], blocks + 10_000, blocks[None]):
        with pytest.raises(InputError, match="another scene"):
            other.load(type(saved)(saved.numbers, {**saved.arrays, "grid.blocks": other_blocks}))


@pytest.mark.slow
def test_what_an_emitter_lets_in_has_nodes(backend_of: Callable) -> None:
    """A jet that crosses an empty domain and meets a wall; when particles retire depends on sorts, so none does."""
    domain = {"size": [1.0, 0.5], "spacing": 2 * SPACING, "gravity": [0.0, -9.81], "walls": "separate"}
    start = changed(jet_scene(domain=domain), precision="f64")
    dense, sparse = (frames_of(changed(start, grid=grid), backend_of("f64")) for grid in ("dense", "sparse"))
    assert largest_difference(sparse, dense) < 1e-9
    assert (sparse[-1].fields["status"] == 1).sum() > (sparse[0].fields["status"] == 1).sum()


def test_scenes_choose_their_grid() -> None:
    """A large domain that is nearly empty has a sparse one, unless asked otherwise, and any other a dense one.

    Bodies that separate need a dense one.
    """
    ball = body("ball", FLUID, {"ball": {"center": [0.5] * 3, "radius": 0.06}})
    large = scene((512,) * 3, 1 / 512, [ball], 0.1)
    assert wants_sparse(large)
    assert not wants_sparse(changed(large, grid="dense"))
    assert not wants_sparse(scene((512,) * 3, 1 / 512, [block("sea", FLUID, (0, 0, 0), (1, 0.2, 1))], 0.1))
    jelly = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
    elastic = scene((512,) * 3, 1 / 512, [ball | {"material": jelly}], 0.1)
    assert wants_sparse(elastic)
    assert not wants_sparse(elastic.model_copy(update={"contact": Contact(default="separate")}))
    assert not wants_sparse(drop(grid="auto"))
    assert wants_sparse(drop())


def test_memory_is_that_of_what_is_occupied() -> None:
    """A million particles in 1024^3 cells take less than 1 GiB, fine nodes included; a dense grid would take 17 GB."""
    ball = body("ball", FLUID, {"ball": {"center": [0.5] * 3, "radius": 31 / 1024}})
    plans = [
        make_plan(scene_in, Backend("cpu", 2, "f32", False))
        for scene_in in (changed(scene((1024,) * 3, 1 / 1024, [ball], 0.1), grid=grid) for grid in ("sparse", "dense"))
    ]
    assert plans[0].particles == pytest.approx(1e6, rel=0.02)
    assert plans[0].machine_bytes < 0.7 * 2**30
    require_memory(plans[0])
    # Momentum and mass, and 8 fine nodes for each node.
    assert plans[0].bytes_per_node == 4 * (4 + 8)
    assert plans[1].device_bytes > 17e9
    assert [plan.as_dict()["sparse"] for plan in plans] == [True, False]


def test_a_gpu_has_none() -> None:
    with pytest.raises(InputError, match="sparse grids are not available with --arch vulkan; use --arch cpu"):
        make_plan(drop(), Backend("vulkan", 1, "f32", False))
    assert not make_plan(changed(drop(), grid="auto"), Backend("vulkan", 1, "f32", False)).sparse
