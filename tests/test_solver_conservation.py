"""What one step, and ten thousand, conserve away from walls (docs/theory.md, 9)."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scenes import ball, block, body, liquid, restart, scene_of, slow, solid
from solver_state import BodyState, bodies_of

from mpmcli.scene import BodyParticles, Scene, sample_bodies
from mpmcli.solver.engine.run import Run, build_run

STEPS = 10_000
# The block turns by some radians; the drop, which nothing holds together but its pressure, stays one drop.
SECONDS = 5.0
H = 0.1
EPSILON = {"f32": 2.0**-24, "f64": 2.0**-53}
PRECISIONS = ["f64", slow("f32")]


def free_scene(dimension: int, precision: str, gravity: list[float] | None = None) -> Scene:
    """Return an elastic block and a fluid drop, both spinning and drifting slowly, far apart and far from walls."""
    d = dimension
    size = 3.0 if d == 2 else 2.4
    half = 0.25 if d == 2 else 0.15
    spin = np.zeros((d, d))
    for i in range(d):
        for j in range(i):
            spin[i, j] = 1.5 - 0.5 * j
            spin[j, i] = -spin[i, j]
    middle = [size / 2] * (d - 1)
    low, high = ([0.7 - 0.4 + side, *(m - 0.4 + side for m in middle)] for side in (-half, half))
    # Suction holds the drop together for the ten thousand steps.
    drop, at = liquid(1e4, density=900.0, tension_cutoff=False), [size - 0.4 - 0.7, *(m - 0.4 for m in middle)]
    motion = {"velocity": [-0.003, 0.004, 0.001][:d], "velocity_gradient": (-0.25 * spin).tolist()}
    return scene_of(
        block("block", solid(1e4), low, high, velocity=[0.004, -0.003, 0.002][:d], velocity_gradient=spin.tolist()),
        body("drop", drop, ball(at, 1.2 * half), **motion),
        domain={"size": [size] * d, "spacing": H, "origin": [-0.4] * d, **({"gravity": gravity} if gravity else {})},
        # A shift changes momenta, by what is of second order in its way (test_redistribution.py).
        solver={"precision": precision, "redistribute": False},
    )


@pytest.fixture(scope="module")
def spinning(backend_of: Callable) -> Callable[..., Run]:
    """Return `start(precision, dimension, bodies)`: a run of the free scene, the last one where it is of that kind.

    The bodies are other particles than those of the scene, as many.
    """
    last: dict[tuple[str, int], Run] = {}

    def start(precision: str, dimension: int, bodies: list[BodyParticles] | None = None) -> Run:
        kind = (precision, dimension)
        if kind not in last:
            last.clear()
            last[kind] = build_run(free_scene(dimension, precision), backend_of(precision, 1))
        restart(last[kind], bodies or sample_bodies(last[kind].scene), 1.0)
        return last[kind]

    return start


def drift(before: BodyState, after: BodyState) -> tuple[float, float]:
    """Return the change of linear and of angular momentum over sum m |v| and over sum m |x| |v|."""
    speed = np.linalg.norm(before.v, axis=1)
    linear = np.abs(after.momentum() - before.momentum()).max() / (before.mass @ speed)
    reach = np.linalg.norm(before.x, axis=1)
    angular = np.abs(after.angular_momentum(H) - before.angular_momentum(H)).max()
    return float(linear), float(angular / (before.mass @ (reach * speed)))


@pytest.mark.parametrize("precision", PRECISIONS)
def test_free_fall(backend_of: Callable, precision: str) -> None:
    """x = x0 + v0 t + g t^2/2 and v = v0 + g (t - dt/2), exact for leapfrog; P = P0 + M g (t - dt/2)."""
    gravity = [0.5, -2.0]
    scene = free_scene(2, precision, gravity)
    resting = [
        replace(s, velocity=np.full_like(s.velocity, 0.1), affine=np.zeros_like(s.affine)) for s in sample_bodies(scene)
    ]
    run = build_run(scene, backend_of(precision), resting)
    before = bodies_of(run)
    n, dt = 300, 0.002
    for _ in range(n):
        run.step(dt)
    g = np.array(gravity)
    # Each step rounds x, v and the sums behind them; round-off adds up over n steps.
    tolerance = 4 * n * EPSILON[precision]
    for name, state in bodies_of(run).items():
        start = before[name]
        fallen = start.x + start.v * n * dt + g * (n * dt) ** 2 / 2
        speed = np.abs(g).max() * n * dt
        assert np.abs(state.x - fallen).max() < tolerance * np.abs(fallen).max()
        assert np.abs(state.v - (start.v + g * (n - 0.5) * dt)).max() < tolerance * speed
        gained = start.momentum() + start.mass.sum() * g * (n - 0.5) * dt
        assert np.abs(state.momentum() - gained).max() < tolerance * start.mass.sum() * speed
        rest = np.eye(2) if state.deformation.ndim == 3 else 1.0
        assert np.abs(state.deformation - rest).max() < tolerance


@pytest.mark.parametrize(
    ("precision", "dimension"), [("f64", 2), *(slow(*case) for case in (("f64", 3), ("f32", 2), ("f32", 3)))]
)
def test_momenta_over_ten_thousand_steps(
    spinning: Callable, precision: str, dimension: int, record_property: Callable
) -> None:
    """P and L stay, per body, to 1e-12 in f64 and 1e-5 in f32; so does the number of particles (9.1 to 9.3)."""
    run = spinning(precision, dimension)
    before = bodies_of(run)
    dt = SECONDS / STEPS
    assert dt < run.stable_step()[0]
    for _ in range(STEPS):
        run.step(dt)
    after = bodies_of(run)
    tolerance = {"f64": 1e-12, "f32": 1e-5}[precision]
    for name in ("block", "drop"):
        assert len(after[name].mass) == len(before[name].mass)
        assert after[name].mass.sum() == before[name].mass.sum()
        linear, angular = drift(before[name], after[name])
        record_property(f"{name} dP", linear)
        record_property(f"{name} dL", angular)
        assert linear < tolerance
        assert angular < tolerance


@pytest.mark.parametrize("precision", PRECISIONS)
def test_rigid_translation(spinning: Callable, precision: str) -> None:
    """v = (1, 0.37): x = x0 + v t to the round-off of n sums, F = I and J = 1, KE constant (9.4)."""
    scene = free_scene(2, precision)
    velocity = np.array([1.0, 0.37])
    moving = [
        replace(s, velocity=np.tile(velocity, (s.count, 1)), affine=np.zeros_like(s.affine))
        for s in sample_bodies(scene)
    ]
    run = spinning(precision, 2, moving)
    before = bodies_of(run)
    n, dt = 100, 0.002
    for _ in range(n):
        run.step(dt)
    # x changes by dt v in numbers as large as the domain: half a unit in the last place per step (9.7).
    size = max(scene.domain.size)
    tolerance = 4 * n * EPSILON[precision]
    for name, state in bodies_of(run).items():
        assert np.abs(state.x - before[name].x - velocity * n * dt).max() < n * EPSILON[precision] * size * 2
        rest = np.eye(2) if state.deformation.ndim == 3 else 1.0
        assert np.abs(state.deformation - rest).max() < max(tolerance, 1e-13)
        energy, start = state.kinetic_energy(H), before[name].kinetic_energy(H)
        assert abs(energy - start) < tolerance * start


@pytest.mark.parametrize("dimension", [2, slow(3)])
def test_affine_fields_are_transferred_exactly(spinning: Callable, dimension: int) -> None:
    """v = v0 + L (x - c) with C = L, without stress: one step changes neither v nor C, for any L (Jiang 2015).

    So a rotation loses no kinetic energy and no angular momentum to the transfers.
    """
    random = np.random.default_rng(3)
    scene = free_scene(dimension, "f64")
    L = random.normal(0, 1, (dimension, dimension))
    bodies = []
    for sample in sample_bodies(scene):
        offset = sample.position - sample.position.mean(0)
        bodies.append(
            replace(
                sample, velocity=random.normal(0, 1, dimension) + offset @ L.T, affine=np.tile(L, (sample.count, 1, 1))
            )
        )
    run = spinning("f64", dimension, bodies)
    before = bodies_of(run)
    dt = 0.01
    run.step(dt)
    for name, state in bodies_of(run).items():
        assert np.abs(state.v - before[name].v).max() < 1e-13
        assert np.abs(state.C - L).max() < 1e-12
        if state.deformation.ndim == 3:
            assert np.abs(state.deformation - (np.eye(dimension) + dt * L)).max() < 1e-13
        else:
            assert np.abs(state.deformation - np.linalg.det(np.eye(dimension) + dt * L)).max() < 1e-13
