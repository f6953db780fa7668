"""`solver.deterministic`: a GPU adds in fixed point, so that two runs have the same bytes.

The path of a GPU runs on software Vulkan, with two integers of 32 bits a sum, and on the CPU, with one of 64 bits.
"""

from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction

import numpy as np
import pytest
import taichi as ti
from rounding import farthest
from scenes import block, scene_of
from solver_state import masses_of
from test_batch import batch_of, outputs_of, same, scene_named

from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError, read_group
from mpmcli.solver.grid.fixed_point import DENSEST, FixedSums
from mpmcli.solver.machine.backend import Backend

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}
JELLY = {"law": "neo_hookean", "density": 900.0, "youngs_modulus": 5e4, "poissons_ratio": 0.47}
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e5, "friction_angle": 30.0}


class OfGpu(Backend):
    """The path of a GPU on the threads of the CPU."""

    on_cpu = False


def on_gpu_path(backend: Backend) -> Backend:
    # A GPU counts as one thread.
    return OfGpu("cpu", 1, backend.precision, backend.compile_cache, backend.optimisation)


def mixed(
    dimension: int, materials: Sequence[dict] = (WATER, JELLY, SAND), *, deterministic: bool = True, **solver: object
) -> Scene:
    """Return bodies that meet: water, a jelly that averages its volumes, and sand, or others."""
    d, low = dimension, ((0.0, 0.0, 0.0), (0.45, 0.1, 0.2), (0.1, 0.4, 0.1))
    high = (0.4, 0.3, 0.9), (0.65, 0.4, 0.7), (0.5, 0.7, 0.5)
    bodies = [
        block(f"body {k}", material, first[:d], last[:d], velocity=[speed, -0.5, 0.0][:d], sampling="jittered")
        for k, (material, first, last, speed) in enumerate(zip(materials, low, high, (1.0, -1.0, -1.0), strict=False))
    ]
    return scene_of(
        *bodies,
        domain={"size": [1.0] * d, "spacing": 0.1, "gravity": [0.0, -9.81, 0.0][:d], "walls": "separate"},
        time={"end": 0.12, "frames": 3},
        solver={"deterministic": deterministic, **solver},
    )


def twice(scene: Scene, backend: Backend) -> tuple[list, list]:
    """Return the frames and ledger rows of two runs, with kernels compiled once."""
    run = build_run(scene, backend)
    begin = run.save().copied()
    first = list(run.frames())
    run.load(begin)
    return first, list(run.frames())


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("dimension", "materials"),
    [(2, (WATER,)), *(pytest.param(d, (WATER, JELLY, SAND), marks=pytest.mark.slow) for d in (2, 3))],
    ids=["2D, water", "2D, all", "3D, all"],
)
def test_two_runs_on_vulkan_have_the_same_bytes(
    backend_of: Callable, dimension: int, materials: tuple[dict, ...]
) -> None:
    """Frames and ledger; and as far from the CPU as a sum in another order: some steps of round-off."""
    scene = mixed(dimension, materials)
    first, second = twice(scene, backend_of("f32", 1, "vulkan"))
    assert list(same(first, second)) == []
    assert first[-1][0].step > 12
    expected = list(build_run(scene, backend_of("f32", 1)).frames())
    own, other = first[-1][0], expected[-1][0]
    apart = farthest(other.position, other.velocity, other.step, other.time)
    assert np.abs(own.position - other.position).max() < apart


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_two_runs_on_threads_have_the_same_bytes(backend_of: Callable, precision: str) -> None:
    scene = mixed(2, precision=precision, transfer="aflip")
    first, second = twice(scene, on_gpu_path(backend_of(precision, 3)))
    assert list(same(first, second)) == []
    expected = list(build_run(scene, backend_of(precision, 1)).frames())
    error = np.abs(first[-1][0].position - expected[-1][0].position).max()
    assert error < {"f32": 1e-5, "f64": 1e-12}[precision]


@pytest.mark.slow
@pytest.mark.gpu
@pytest.mark.parametrize("name", ["colliders", "rough walls", "periodic, a wall moves", "periodic, 3D, f_bar"])
def test_every_sum_has_the_same_bytes(backend_of: Callable, name: str) -> None:
    """What colliders take, friction, images, and means of volume over periodic faces."""
    scene = scene_named(name)
    scene = scene.model_copy(update={"solver": scene.solver.model_copy(update={"deterministic": True})})
    first, second = twice(scene, backend_of("f32", 1, "vulkan"))
    assert list(same(first, second)) == []
    expected = list(build_run(scene, backend_of("f32", 1)).frames())
    for (frame, row), (other, other_row) in zip(first, expected, strict=True):
        apart = farthest(other.position, other.velocity, expected[-1][0].step, other.time)
        assert np.abs(frame.position - other.position).max() < apart
        assert np.allclose(row.collider_force, other_row.collider_force, rtol=1e-3, atol=1e-3)


@pytest.fixture
def sums_of(backend_of: Callable) -> Iterator[Callable[[np.ndarray, bool], tuple[np.ndarray, ...]]]:
    backend_of("f32", 3)

    def add(numbers: np.ndarray, wide: bool) -> tuple[np.ndarray, ...]:
        sums = FixedSums(1, 2, wide=wide)
        source, found = ti.field(ti.f32, shape=len(numbers)), ti.field(ti.f32, shape=())
        source.from_numpy(numbers)

        @ti.kernel
        def run():
            for k in range(source.shape[0]):
                sums.add(1, ti.Vector([source[k]]))

        @ti.kernel
        def read():
            found[None] = sums.value(1)[0]

        run()
        read()
        low = np.zeros((2, 1), np.int64) if wide else sums.low.to_numpy()
        return sums.high.to_numpy()[:, 0], low[:, 0], np.float32(found[None])

    yield add


@pytest.mark.parametrize("wide", [True, False], ids=["64 bits", "2 x 32 bits"])
def test_sums_are_those_of_rounded_numbers_in_any_order(sums_of: Callable, wide: bool) -> None:
    """In rational arithmetic, to the last bit; so that a sum is off by at most half a unit a number."""
    rng = np.random.default_rng(1)
    # Sums stay below `largest`, and numbers reach from it to far below a unit.
    numbers = (rng.uniform(-1, 1, 20_000) * 2.0 ** rng.uniform(-20, 13, 20_000)).astype(np.float32)
    unit = Fraction(1) if wide else Fraction(1, 2**15)
    # Which way halves are rounded is up to the device.
    numbers = np.array([x for x in numbers if (Fraction(float(x)) / unit).denominator != 2], np.float32)
    high, low, value = sums_of(numbers, wide)
    exact = int(high[1]) + int(low[1]) * unit
    assert exact == sum(round(Fraction(float(x)) / unit) * unit for x in numbers)
    assert abs(exact - sum(Fraction(float(x)) for x in numbers)) <= len(numbers) * unit / 2
    assert value == pytest.approx(float(exact), rel=2**-22)
    again = sums_of(rng.permutation(numbers), wide)
    assert (high[1], low[1]) == (again[0][1], again[1][1])
    assert high[0] == low[0] == 0


def test_momentum_is_kept_to_the_rounding_of_the_sums(backend_of: Callable) -> None:
    """Bodies collide in the void: each of the 9 shares of a particle is off by half a unit of the sums a step."""
    scene = mixed(2, (WATER, WATER), precision="f64")
    domain = scene.domain.model_copy(update={"gravity": (0.0, 0.0)})
    lifted = [
        BodyParticles(b.name, 0.6 * b.position + 0.2, b.velocity, b.affine, 0.36 * b.volume, 0.36 * b.mass)
        for b in sample_bodies(scene)
    ]
    still = scene.model_copy(update={"domain": domain})
    run = build_run(still, on_gpu_path(backend_of("f64")), lifted)
    before = momentum_of(run)
    for _ in range(20):
        run.step(1e-3)
    run.measure()
    unit = run.grid.fixed.pace[0][1]
    change = np.abs(momentum_of(run) - before)
    scale = sum(float((body.mass * np.linalg.norm(body.velocity, axis=1)).sum()) for body in lifted)
    # Besides, round-off of G2P: a few units in the last place of the momentum of each particle.
    assert (change <= 20 * (9 * run.particle_count * unit / 2 + 8 * np.finfo(float).eps * scale)).all()
    assert scale > 50


def momentum_of(run: Run) -> np.ndarray:
    found = np.zeros(run.scene.dimension)
    for group in run.groups:
        snapshot = read_group(group)
        found += masses_of(snapshot) @ snapshot.v
    return found


def lone_pool() -> Scene:
    """Return 256 cells of water, at rest."""
    return scene_of(
        block("pool", WATER, [0.2, 0.2], [1.8, 1.8]),
        domain={"size": [2.0, 2.0], "spacing": 0.1, "gravity": [0.0, 0.0]},
        deterministic=True,
    )


def test_what_the_sums_have_no_room_for_stops_the_run(backend_of: Callable) -> None:
    """A particle that would cross all of the domain in a step, and all particles in one place, 0.56 of them on a node.

    Sums have room for DENSEST to twice as many times the mass of a full cell.
    """
    assert 2 * DENSEST < 0.75**2 * 256
    run = build_run(lone_pool(), on_gpu_path(backend_of("f32")))
    (group,), begin = run.groups, run.save().copied()
    run.step(1e-3)
    state = group.read()
    state["v"][state["id"] == 7] = 1e6
    group.replace(v=state["v"])
    with pytest.raises(UnstableRunError, match=r"particle 7 of .* received more momentum in one step than the sums of"):
        run.step(1e-3)
    run.load(begin)
    run.step(1e-4)
    run.measure()
    group.replace(x=np.full((group.count, 2), 0.5))
    run.state_was_replaced()
    with pytest.raises(UnstableRunError, match=r"at \(0\.5, 0\.5\) m is at a node with more mass than the sums"):
        run.step(1e-4)


def test_on_the_cpu_nothing_changes(backend_of: Callable) -> None:
    """The same bytes, plan and fields."""
    backend = backend_of("f32")
    with_it, without = (mixed(2, (WATER,), deterministic=asked) for asked in (True, False))
    assert make_plan(with_it, backend) == make_plan(without, backend)
    run = build_run(with_it, backend)
    assert run.grid.fixed is None and not run.grid.deterministic
    assert list(same(list(run.frames()), list(build_run(without, backend).frames()))) == []


def test_a_gpu_without_it_has_nothing_of_it(backend_of: Callable) -> None:
    """And with it a node needs 8 bytes a number more, in place of the means of volume."""
    backend = on_gpu_path(backend_of("f32"))
    plain, asked = (mixed(2, (JELLY,), deterministic=asked) for asked in (False, True))
    assert build_run(plain, backend).grid.fixed is None
    grid = build_run(asked, backend).grid
    bytes_of = 8 * sum(sums.width for sums in grid.fixed.kept) - 4 * 4
    assert make_plan(asked, backend).bytes_per_node - make_plan(plain, backend).bytes_per_node == bytes_of
    passes = make_plan(asked, backend).passes
    assert [name for name in passes if name not in make_plan(plain, backend).passes] == ["read sums in fixed point"]


@pytest.mark.slow
def test_deterministic_runs_of_a_batch_have_the_bytes_that_they_have_alone(backend_of: Callable) -> None:
    """Two runs on the path of a GPU, in which all numbers differ: each has scales of its own."""
    scenes = [scene_named("sand"), scene_named("sand", other=True)]
    scenes = [
        scene.model_copy(update={"solver": scene.solver.model_copy(update={"deterministic": True})}) for scene in scenes
    ]
    backend = on_gpu_path(backend_of("f32"))
    found = outputs_of(batch_of(scenes, backend), scenes)
    for output, scene in zip(found, scenes, strict=True):
        assert list(same(output, list(build_run(scene, backend).frames()))) == []
        assert output[-1][0].step > 15
