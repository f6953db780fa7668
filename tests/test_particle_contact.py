"""Contact between elastic bodies on the grids of their states at rest (docs/theory.md, 2.7)."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from elastic_bodies import DENSITY, E, bars, stirred

from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.run import build_run


@pytest.mark.parametrize("shift", [0.0, pytest.param(0.25, marks=pytest.mark.slow)])
def test_bars_collide_for_as_long_as_a_wave_takes(backend_of: Callable, shift: float) -> None:
    """They meet within 0.3 cells of touching, stay for 2 L / c, and part at nearly the speed of approach."""
    n, speed = 32, 0.05
    scene = bars(n, shift)
    found = list(build_run(scene, backend_of("f64", 1)).frames())
    times = np.array([row.time for _, row in found])
    moving = np.array([frame.velocity[frame.body == 0, 0].mean() / speed for frame, _ in found])
    energy = np.array([row.kinetic + row.elastic for _, row in found])
    touch = 4 / n / (2 * speed)
    assert 0 < (touch - times[np.argmax(moving < 0.999)]) * 2 * speed * n < 0.3
    contact = times[np.argmax(moving < moving[-1] + 0.02)] - times[np.argmax(moving < 0.98)]
    assert contact == pytest.approx(2 / math.sqrt(E / DENSITY), rel=0.1)
    assert -1 <= moving[-1] < -0.95
    assert energy.max() <= energy[0] * (1 + 1e-9)
    momentum = np.array([row.linear_momentum for _, row in found])
    assert np.abs(momentum).max() < 1e-12 * found[0][1].mass * speed
    # The forces are central; the bars' own part is of second order.
    turning = np.array([row.angular_momentum[0] for _, row in found])
    assert np.abs(turning - turning[0]).max() < 1e-6 * found[0][1].mass * speed


def test_particles_of_two_bodies_push_as_the_formula_says(backend_of: Callable) -> None:
    """What stirred bodies that overlap gain in a step, each in sum, against all pairs of particles in plain numpy."""
    scene = bars(8, 0.3)
    spacing = scene.domain.spacing

    def speeds(gap: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
        run = build_run(scene, backend_of("f64", 1))
        stirred(run, 2)
        group = run.groups[0]
        x = group.read()["x"]
        x[group.read()["body"] == 1, 0] += gap
        group.replace(x=x)
        run.state_was_replaced()
        before = group.read()
        run.step(1e-4)
        after = group.read()
        return before, (after["v"] - before["v"])[np.argsort(after["id"])]

    before, near = speeds(-4.3 * spacing)
    _, far = speeds(0.0)
    sample = sample_bodies(scene)[0]
    s, k = sample.volume**0.5, (E * sample.volume) / (2 * sample.volume**0.5 * spacing)
    force = np.zeros_like(before["x"])
    for p in range(len(force)):
        for q in np.flatnonzero(before["body"] != before["body"][p]):
            line = before["x"][p] - before["x"][q]
            n = line / np.linalg.norm(line)
            reach = sum(s * np.linalg.norm(before["deformation"][i].T @ n) for i in (p, q))
            force[p] += k * max(0.75 * reach - np.linalg.norm(line), 0.0) * n
    assert (np.abs(force).max(axis=1) > 0).sum() > 10
    # What the grid does with an impulse is linear: the difference is that of the impulses, spread by the transfers.
    impulse = force / sample.mass * 0.5e-4
    order = np.argsort(before["id"])
    total = (near - far).sum(axis=0)
    assert np.abs(total).max() < 1e-9 * np.abs(impulse).sum()
    own = before["body"][order] == 0
    assert np.allclose((near - far)[own].sum(axis=0), impulse[order][own].sum(axis=0), rtol=1e-9)
