"""The knobs of [solver]: how a scene says them, what they cost in memory, and what a run with them conserves."""

import tomllib
from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, scene_of, solid
from solver_state import bodies_of
from test_solver_conservation import free_scene

from mpmcli.check.scene_limits import scene_limits
from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, SolverSettings, parse_scene, scene_bounds, scene_to_toml
from mpmcli.scene.schema import USUAL_FLIP
from mpmcli.solver.engine.plan import make_plan
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.frames.diagnosis import read_group
from mpmcli.solver.machine.backend import Backend
from mpmcli.stability.transfer_factors import step_inertia

H = 0.1


def small_scene(**knobs: object) -> Scene:
    """Return a block of jelly on the floor of a box."""
    return scene_of(
        block("block", solid(1e5), [3 * H, 0.0], [7 * H, 4 * H]),
        domain={"size": [11 * H, 9 * H], "spacing": H, "gravity": [0.0, -9.81]},
        solver=knobs,
    )


def test_a_scene_that_chooses_nothing_has_nothing_of_it(backend_of: Callable) -> None:
    """No share of FLIP in the settings, and on the grid no momentum from before and no wider stencil."""
    assert small_scene().solver == SolverSettings(precision="f32", kernel="quadratic", transfer="apic", flip=None)
    run = build_run(small_scene(), backend_of("f32", 1))
    assert not run.grid.scheme.keeps_flip_velocity and run.grid.tile == 6
    assert run.grid.scheme.spline.nodes == 3 and run.grid.nodes.n == 4


def test_flip_belongs_to_aflip() -> None:
    """It has a default there, which the effective scene says; elsewhere it is one sentence."""
    scene = small_scene(transfer="aflip")
    assert scene.solver.flip == USUAL_FLIP
    assert f"flip = {USUAL_FLIP:g}" in scene_to_toml(scene)
    assert "flip" not in scene_to_toml(small_scene())
    assert small_scene(transfer="aflip", flip=0.0).solver.flip == 0.0
    with pytest.raises(InputError, match=r'solver\.flip.*transfer = "aflip".*leave it out') as error:
        small_scene(flip=0.9)
    assert len(str(error.value).splitlines()) == 1
    with pytest.raises(InputError, match=r"solver\.flip"):
        small_scene(transfer="aflip", flip=1.5)


@pytest.mark.parametrize(("key", "value", "right"), [("kernel", "linear", "cubic"), ("transfer", "flip", "aflip")])
def test_other_words_are_refused(key: str, value: str, right: str) -> None:
    with pytest.raises(InputError, match=rf"solver\.{key}.*{right}"):
        small_scene(**{key: value})


def test_the_effective_scene_says_every_knob() -> None:
    scene = small_scene(kernel="cubic", transfer="aflip", flip=0.5)
    again = parse_scene(tomllib.loads(scene_to_toml(scene)), laws=parameter_models()).scene
    assert again.solver == scene.solver


@pytest.mark.parametrize(
    "knobs", [{}, {"kernel": "cubic"}, {"transfer": "aflip"}], ids=lambda knobs: "-".join(knobs.values()) or "usual"
)
def test_the_plan_follows_the_knobs(backend_of: Callable, knobs: dict) -> None:
    """Nodes, their bytes and the passes, counted from the solver's own fields."""
    scene, backend = small_scene(**knobs), backend_of("f32", 2)
    plan, run = make_plan(scene, backend), build_run(scene, backend)
    assert plan.nodes == run.grid.node_count
    assert plan.bytes_per_node == 4 * run.grid.nodes.n
    assert "find contact" in plan.passes


def test_check_and_solver_take_the_same_step(backend_of: Callable) -> None:
    """The bound at rest goes with the root of the inertia that the scheme has, in the report and in the run."""
    usual, scene = spinning(), spinning(kernel="cubic", redistribute=False)
    factor = np.sqrt(step_inertia(scene.solver))
    before, told = (
        {
            limit.body: limit
            for limit in scene_limits(s, scene_bounds(s))
            if limit.name == "wave" and limit.state == "rest"
        }
        for s in (usual, scene)
    )
    for name, limit in told.items():
        assert limit.value == pytest.approx(factor * before[name].value, rel=1e-12)
        assert f"{factor:.3g} times that step" in limit.why
    taken = {limit.body: limit for limit in build_run(scene, backend_of("f64", 1)).limits() if limit.name == "wave"}
    assert set(taken) == set(told) == {"block", "drop"}
    for name, limit in taken.items():
        assert limit.value == pytest.approx(told[name].value, rel=1e-4)


def momenta_lost(scene: Scene, backend: Backend, step: float, steps: int) -> tuple[float, float]:
    """Return by how much linear and angular momentum change, as the ledger sums them, over sum m |v| and m |x| |v|."""
    run = build_run(scene, backend)
    states = bodies_of(run).values()
    linear = sum(s.mass @ np.linalg.norm(s.v, axis=1) for s in states)
    angular = sum(s.mass @ (np.linalg.norm(s.x, axis=1) * np.linalg.norm(s.v, axis=1)) for s in states)
    first = run.frame()[1]
    for _ in range(steps):
        run.step(step)
    last = run.frame()[1]
    pushed = np.subtract(last.linear_momentum, first.linear_momentum)
    turned = np.subtract(last.angular_momentum, first.angular_momentum)
    return float(np.abs(pushed).max() / linear), float(np.abs(turned).max() / angular)


def spinning(**knobs: object) -> Scene:
    """Return two small bodies that spin, one of jelly and one of fluid."""
    return free_scene(2, "f64").model_copy(update={"solver": SolverSettings(precision="f64", **knobs)})


def test_cubic_splines_keep_both_momenta(backend_of: Callable) -> None:
    """To round-off, with C's own angular momentum m h^2/3 axl(C); with the h^2/4 of quadratic ones it is not kept."""
    linear, angular = momenta_lost(spinning(kernel="cubic", redistribute=False), backend_of("f64", 1), 0.01, 300)
    assert linear < 1e-13 and angular < 1e-13


@pytest.mark.slow
@pytest.mark.parametrize("knobs", [{"transfer": "aflip"}, {"transfer": "aflip", "kernel": "cubic"}], ids=str)
def test_what_bodies_keep_takes_neither_momentum(backend_of: Callable, knobs: dict) -> None:
    """To round-off, as C takes up what positions that follow the nodes turn; in long and short steps."""
    for step, steps in ((0.012, 100), (0.003, 400)):
        linear, angular = momenta_lost(spinning(**knobs, redistribute=False), backend_of("f64", 2), step, steps)
        assert linear < 1e-13 and angular < 1e-13


def pulled(acceleration: object, gravity: float = 0.0, **knobs: object) -> Scene:
    """Return a free block of soft jelly that a force pulls along y, and gravity along x; all such have a kernel."""
    return scene_of(
        block("block", solid(1e3), [3 * H, 3 * H], [7 * H, 7 * H]),
        domain={"size": [11 * H, 11 * H], "spacing": H, "gravity": [gravity, 0.0]},
        solver={"transfer": "aflip", "precision": "f64", **knobs},
        forces=[{"acceleration": [0.0, acceleration]}],
    )


@pytest.mark.parametrize("knobs", [{}, pytest.param({"flip": 1.0}, marks=pytest.mark.slow)], ids=str)
def test_pull_reaches_the_own_velocities_of_aflip(backend_of: Callable, knobs: dict) -> None:
    """Gravity and a force of the particles alike: a free block falls by (g + a) t, and every particle of it."""
    scene = pulled("2 if X > 0 else 0", -1.0, **knobs)
    run = build_run(scene, backend_of("f64", 1, fully_optimised=True))
    # Velocities live half a step behind.
    dt, steps = 1e-3, 50
    for _ in range(steps):
        run.step(dt)
    v = read_group(run.groups[0]).v
    assert v == pytest.approx(np.tile([-1.0, 2.0], (len(v), 1)) * dt * (steps - 0.5), rel=1e-9)


@pytest.mark.parametrize("kernel", ["quadratic", pytest.param("cubic", marks=pytest.mark.slow)])
@pytest.mark.parametrize("acceleration", ["-1 if X > 0.5 else 0", pytest.param("-y", marks=pytest.mark.slow)])
def test_a_force_of_any_kind_pulls_with_every_scheme(backend_of: Callable, acceleration: str, kernel: str) -> None:
    """Momentum after three steps is the sum of the pushes on particles that hardly move; leapfrog's first is a half.

    Forces with branches and with slopes take other paths through the kernel than those without. Taichi 1.7.4 lost such
    a force when it optimised the kernel.
    """
    run = build_run(pulled(acceleration, kernel=kernel), backend_of("f64", 1, fully_optimised=True))
    block, dt = bodies_of(run)["block"], 1e-4
    for _ in range(3):
        run.step(dt)
    X, y = block.x.T
    push = -y if acceleration == "-y" else -1.0 * (X > 0.5)
    assert bodies_of(run)["block"].momentum()[1] == pytest.approx(2.5 * dt * block.mass @ push, rel=1e-6)
