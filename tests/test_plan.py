"""The memory that a scene is said to take is the memory that its fields take."""

import tracemalloc
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
from scenes import block, scene_of, slow

from mpmcli.errors import InputError
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.output import SegmentStore
from mpmcli.quick_taichi import ti
from mpmcli.scene import Scene, load_scene, sample_bodies, sampling
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.engine.plan import LawPlan, Plan, make_plan, require_memory
from mpmcli.solver.engine.resolved import Resolved
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend, choose_backend, has_cuda_device, start, stop_backend

MATERIALS = {
    "fluid": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5},
    "solid": {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5},
    "sand": {"law": "sand", "density": 1600.0, "youngs_modulus": 1e5, "friction_angle": 30.0},
}


CONFIGS = Path(__file__).parents[1] / "configs"


@pytest.mark.parametrize(("name", "solver"), [
    ("dam_break_2d", {}),
    # Deformation gradients, layers of bodies, rigid bodies, emitters with expressions, and meshes of colliders.
    ("mixed_2d", {"precision": "f64"}),
    ("rolling_3d", {}),
    ("stirred_tank_2d", {"grid": "sparse"}),
    ("fountain_2d", {}),
    ("jelly_drop_2d", {"solids": "total"}),
])  # fmt: skip
def test_the_plan_is_what_taichi_allocates(backend_of: Callable, name: str, solver: dict) -> None:
    """Bytes of its trees of nodes, but for the alignment of each."""
    scene = load_scene(CONFIGS / f"{name}.toml", laws=parameter_models()).scene
    scene = scene.model_copy(update={"solver": scene.solver.model_copy(update=solver)})
    backend = backend_of(scene.solver.precision, 2)
    plan = make_plan(scene, backend)
    Batch(Resolved(scene).kind.padded(), backend)
    runtime = ti.lang.impl.get_runtime()
    runtime.materialize()
    trees = range(runtime.prog.get_snode_tree_size())
    sizes = [runtime.prog.get_snode_root(k).cell_size_bytes for k in trees]
    assert plan.device_bytes == pytest.approx(sum(sizes), abs=8 * len(sizes) + 8)


def test_particles_that_the_plan_counts_are_found_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Their positions go to the run, and are not kept; only those of MOST_COUNTED particles are until then."""
    scene = load_scene(CONFIGS / "mixed_2d.toml", laws=parameter_models()).scene
    expected, searched, find = sample_bodies(scene), [], sampling.particle_places
    monkeypatch.setattr(sampling, "particle_places", lambda body, *how: searched.append(body.name) or find(body, *how))
    asked = Resolved(scene)
    assert sum(asked.kind.particles) == sum(body.count for body in expected)
    found = asked.sampled()
    assert searched == [body.name for body in scene.bodies] and not asked._places
    assert found.sampled() is found and found.kind == asked.kind
    for one, same in zip(found.particles, expected, strict=True):
        assert (one.position == same.position).all() and (one.velocity == same.velocity).all()
    # The positions of all are more than is kept.
    places: dict = {}
    monkeypatch.setattr(sampling, "MOST_COUNTED", max(body.count for body in expected))
    counts = sampling.count_sources(scene, places)
    assert counts == [body.count for body in expected] and sum(map(len, places.values())) <= sampling.MOST_COUNTED


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_plan_has_the_bytes_of_a_particle_and_of_a_node(backend_of: Callable, dimension: int) -> None:
    """Of a fluid in f32: x, v, C with the remainder of x, J, share, label; the sort; and the filling of fine cells."""
    d, scene = dimension, scene_with("fluid", dimension=dimension)
    plan = make_plan(scene, backend_of("f32"))
    state, widest = 2 * d + d * (d + 1) + 2, d * (d + 1)
    assert plan.bytes_per_particle == 4 * (state + 1 + widest + 2) <= 160
    assert plan.particles == 4**d
    # Momentum and mass, padded to four numbers, and the fine cells.
    assert plan.bytes_per_node == 4 * (4 + 2**d)


@pytest.mark.parametrize("fields", [["stress", "pressure", "initial_position"], slow(["density"])])
def test_the_plan_counts_what_the_host_holds(tmp_path: Path, fields: list[str]) -> None:
    """The most that numpy holds from the first particle to the last frame, beside 4 MB of parts and tables."""
    h = 1 / 800
    scene = scene_of(
        block("block", MATERIALS["fluid"], [0.2, 0.2], [0.6, 0.6]),
        domain={"size": [1.0, 1.0], "spacing": h, "gravity": [0.0, -9.81]},
        time={"end": 4e-6, "frames": 2, "step": 2e-6},
        fields=fields,
    )
    stop_backend()
    backend = replace(choose_backend("cpu", 1, "f32"), optimisation="few")
    plan = make_plan(scene, start(backend))
    assert plan.particles == 409_600
    tracemalloc.start()
    try:
        run = build_run(scene, backend)
        store = SegmentStore(tmp_path, {"scene": "", "bodies": [], "materials": []})
        for frame, row in run.frames():
            store.write(frame, row)
            del frame
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
        stop_backend()
    assert 0.8 * plan.host_bytes < peak < plan.host_bytes + 4e6


def scene_with(*materials: str, dimension: int = 2) -> Scene:
    """Return a scene of one small block for each material, side by side."""
    d, h = dimension, 0.1
    return scene_of(
        *(
            block(
                f"body {k}",
                MATERIALS[material],
                [h + 4 * h * k] + [h] * (d - 1),
                [3 * h + 4 * h * k] + [3 * h] * (d - 1),
            )
            for k, material in enumerate(materials)
        ),
        domain={"size": [h * (2 + 4 * len(materials))] + [8 * h] * (d - 1), "spacing": h, "gravity": [0.0] * d},
    )


def test_a_scene_of_fluid_plans_nothing_of_other_laws(backend_of: Callable) -> None:
    """No deformation gradient, no internal variable, and no pass but the fluid's; with sand beside it, sand's too."""
    backend = backend_of("f32")
    plan = make_plan(scene_with("fluid", "fluid"), backend)
    (fluid,) = plan.laws
    names = {"position", "velocity", "velocity_gradient", "volume_ratio", "borne", "id", "body"}
    assert fluid.fields.keys() == names
    assert plan.passes == ("clear grid", "scatter fluid", "find contact", "update grid", "gather fluid")
    mixed = make_plan(scene_with("fluid", "sand", "fluid"), backend)
    names = [law.law for law in mixed.laws]
    assert names == ["fluid", "sand"]
    assert mixed.laws[0].fields == fluid.fields
    assert {"deformation_gradient", "plastic_volume_strain"} <= mixed.laws[1].fields.keys()
    assert [name for name in mixed.passes if "sand" in name] == ["scatter sand", "gather sand"]
    assert "body" not in mixed.laws[1].fields
    run = build_run(scene_with("fluid", "sand", "fluid"), backend)
    for group, law in zip(run.groups, mixed.laws, strict=True):
        assert len(group.arrays.moved) == len(law.fields)
        assert group.count == law.particles


@pytest.mark.filterwarnings("ignore:.*Calling non-taichi function:SyntaxWarning")
def test_a_law_is_compiled_once_for_all_its_bodies_and_not_at_all_without_one(
    backend_of: Callable, monkeypatch: pytest.MonkeyPatch, own_kernels: None
) -> None:
    """The times that each law's response is traced into kernels: those of one body of fluid, whatever the bodies."""
    traced = Counter[str]()
    for name, law in laws().items():
        original = law.respond

        def counted(self: object, *arguments: object, name: str = name, original: Callable = original) -> object:
            traced[name] += 1
            return original(self, *arguments)

        monkeypatch.setattr(law, "respond", counted)

    def compiled(*materials: str) -> Counter[str]:
        traced.clear()
        run = build_run(scene_with(*materials), backend_of("f32", 1))
        next(run.frames())
        run.step(1e-5)
        return Counter(traced)

    alone = compiled("fluid")
    assert alone.keys() == {"fluid"}
    together = compiled("fluid", "sand", "fluid", "sand")
    assert together.keys() == {"fluid", "sand"}
    assert together["fluid"] == together["sand"] == alone["fluid"]


@pytest.mark.parametrize(
    ("fields", "edge", "cells", "threads", "fits"),
    [
        # 1.3e8 particles with 8 numbers each in a frame, and with 32.
        (["velocity"], 254, 256, 1, True),
        (["velocity", "affine", "deformation_gradient", "stress"], 254, 256, 1, False),
        # As many nodes, and counts of the tiles of each thread: 64 nodes each.
        (["velocity"], 10, 1200, 64, True),
        (["velocity"], 10, 1200, 128, False),
    ],
)
def test_more_than_an_index_reaches_is_refused(
    monkeypatch: pytest.MonkeyPatch, fields: list[str], edge: int, cells: int, threads: int, fits: bool
) -> None:
    """Whatever array it is; frames and tables of the sort are the longest ones."""
    monkeypatch.setattr("mpmcli.solver.engine.plan.MEMORY_SHARE", 1e6)
    scene = scene_of(
        block("block", {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5}, [1.0] * 3, [1.0 + edge] * 3),
        domain={"size": [float(cells)] * 3, "spacing": 1.0},
        fields=fields,
        grid="dense",
    )
    plan = make_plan(scene, Backend("cpu", threads, "f32", False))
    if fits:
        require_memory(plan)
    else:
        with pytest.raises(InputError, match="more than 32-bit indices can address"):
            require_memory(plan)


class FakeDriver:
    """A CUDA driver of a device with some free memory, which counts the uses of its context."""

    def __init__(self, free: int, *, present: bool = True) -> None:
        self.free, self.present, self.uses = free, present, 0

    def cuInit(self, flags: int) -> int:
        return 0 if self.present else 100

    def cuDeviceGetCount(self, count: object) -> int:
        count._obj.value = 1
        return 0

    def cuDeviceGet(self, device: object, number: int) -> int:
        return 0

    def cuDevicePrimaryCtxRetain(self, context: object, device: object) -> int:
        self.uses += 1
        return 0

    def cuDevicePrimaryCtxRelease_v2(self, device: object) -> int:
        self.uses -= 1
        return 0

    def cuCtxPushCurrent_v2(self, context: object) -> int:
        return 0

    def cuCtxPopCurrent_v2(self, context: object) -> int:
        return 0

    def cuMemGetInfo_v2(self, free: object, total: object) -> int:
        free._obj.value, total._obj.value = self.free, 2 * self.free
        return 0


def test_a_run_on_cuda_needs_the_memory_of_the_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """10.1 GB on the device with its room: not of 10 GB that are free there, nor of the 1 GB that this machine has."""
    plan = Plan((LawPlan("fluid", 10**8, {"position": 100}),), 1000, 0, 16, 10_100_000_000, 1, (), "cuda")
    driver = FakeDriver(10 * 10**9)
    monkeypatch.setattr("mpmcli.solver.machine.backend.ctypes.CDLL", lambda name: driver)
    monkeypatch.setattr("mpmcli.solver.engine.plan.psutil.virtual_memory", lambda: SimpleNamespace(available=10**9))
    with pytest.raises(InputError, match=r"10\.1 GB of memory on the cuda device, but at most 8 GB may be used;"):
        require_memory(plan)
    driver.free *= 2
    require_memory(plan)
    assert driver.uses == 0
    with pytest.raises(InputError, match=r"10\.1 GB of memory, but at most 800 MB may be used;"):
        require_memory(replace(plan, arch="cpu"))
    monkeypatch.setattr("mpmcli.solver.machine.backend.ctypes.CDLL", lambda name: FakeDriver(0, present=False))
    require_memory(plan)


def test_a_device_is_there_if_the_driver_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mpmcli.solver.machine.backend.Path", lambda name: SimpleNamespace(glob=lambda pattern: []))
    monkeypatch.setattr("mpmcli.solver.machine.backend.os.path.exists", lambda name: False)
    for present in (True, False):
        monkeypatch.setattr(
            "mpmcli.solver.machine.backend.ctypes.CDLL", lambda name, present=present: FakeDriver(1, present=present)
        )
        assert has_cuda_device() is present
