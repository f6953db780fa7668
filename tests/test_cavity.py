"""Lid-driven cavities: the flow in the middle, and the liquid in the corners that a moving wall runs into.

The reference is a finite difference solution of the same incompressible flow, by streamfunction and vorticity.
"""

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scenes import block, scene_of, slow

from mpmcli.frames.frame import Frame
from mpmcli.solver.engine.run import build_run

DENSITY, SPEED = 1000.0, 1.0
# The stress in a corner grows as 1/r. What is crushed has a J that falls without end, to 1e-6 in ten seconds.
UNCRUSHED = 0.25


def reference(reynolds: float, n: int = 64) -> np.ndarray:
    """Return u at (1/2, j/n) of the steady flow in a unit square under a lid of velocity 1.

    Second order in 1/n; the vorticity on walls is Thom's. With n = 64 and a Reynolds number of 100 it is within
    0.003 of the values of Ghia, Ghia and Shin (1982).
    """
    h, modes = 1 / n, np.arange(1, n)
    sines = np.sqrt(2 * h) * np.sin(np.pi * h * np.outer(modes, modes))
    laplacian = np.add.outer(*[(2 - 2 * np.cos(np.pi * h * modes)) / h**2] * 2)
    psi, w = np.zeros((2, n + 1, n + 1))
    inside, east, west = np.s_[1:-1, 1:-1], np.s_[2:, 1:-1], np.s_[:-2, 1:-1]
    north, south = np.s_[1:-1, 2:], np.s_[1:-1, :-2]
    dt = min(0.2 * h**2 * reynolds, h / 2, 1.6 / reynolds)
    for _ in range(round(0.5 * min(reynolds, 30) / dt)):
        psi[inside] = sines @ ((sines @ w[inside] @ sines) / laplacian) @ sines
        w[0], w[-1], w[:, 0], w[:, -1] = (-2 / h**2 * side for side in (psi[1], psi[-2], psi[:, 1], psi[:, -2] + h))
        u, v = (psi[north] - psi[south]) / (2 * h), (psi[west] - psi[east]) / (2 * h)
        spread = (w[east] + w[west] + w[north] + w[south] - 4 * w[inside]) / (h**2 * reynolds)
        w[inside] += dt * (spread - u * (w[east] - w[west]) / (2 * h) - v * (w[north] - w[south]) / (2 * h))
    return np.array([0.0, *(psi[n // 2, 2:] - psi[n // 2, :-2]) / (2 * h), 1.0])


def cavity(reynolds: float, n: int, end: float, velocity: Mapping[str, list[float]], walls: object = "stick"):
    """Return the scene of a box of n cells along each axis, full of liquid."""
    d = len(next(iter(velocity.values())))
    material = {"law": "fluid", "density": DENSITY, "viscosity": DENSITY * SPEED / reynolds}
    return scene_of(
        block("liquid", material, [0.0] * d, [1.0] * d),
        domain={"size": [1.0] * d, "spacing": 1 / n, "walls": walls, "wall_velocity": velocity},
        time={"end": end, "frames": round(8 * end)},
        fields=["velocity", "volume_ratio"],
    )


def profile(frames: list[Frame], n: int) -> np.ndarray:
    """Return the mean over frames of u at (1/2, j/n), 0 < j < n: linear least squares within a cell."""
    found = np.zeros((len(frames), n - 1))
    for row, frame in zip(found, frames, strict=True):
        for j in range(1, n):
            away = frame.position * n - [n / 2, j]
            weight = np.prod(np.maximum(1 - np.abs(away), 0), axis=1) ** 0.5
            near = weight > 0
            plane = np.column_stack([np.ones(near.sum()), away[near]]) * weight[near, None]
            row[j - 1] = np.linalg.lstsq(plane, frame.velocity[near, 0] * weight[near])[0][0]
    return found.mean(0)


@pytest.mark.parametrize(
    ("reynolds", "n", "end", "bound"), [(10.0, 16, 4.0, 0.5), slow(100.0, 32, 15.0, 1.5), slow(100.0, 64, 15.0, 1.5)]
)
def test_a_lid_drives_the_flow_below(
    backend_of: Callable, record_property: Callable, reynolds: float, n: int, end: float, bound: float
) -> None:
    """u on the vertical line in the middle is that of finite differences, to first order."""
    frames = [
        frame for frame, _ in build_run(cavity(reynolds, n, end, {"y_max": [SPEED, 0.0]}), backend_of("f32")).frames()
    ]
    right = reference(reynolds)[:: 64 // n][1:-1]
    largest = float(np.abs(profile(frames[-16:], n) - right).max())
    record_property("largest error of u", largest)
    record_property("least J", least := min(frame.fields["volume_ratio"].min() for frame in frames))
    assert largest < bound * SPEED / n
    assert least > UNCRUSHED


@pytest.mark.parametrize(("velocity", "walls"), [
    pytest.param({"y_max": [SPEED, 0.0], "y_min": [-SPEED, 0.0]}, "stick", id="opposite"),
    pytest.param({"y_max": [SPEED, 0.0], "x_max": [0.0, SPEED]}, "stick", id="meet"),
    pytest.param({"x_min": [0.0, SPEED]}, {"default": "slip", "x_min": "stick"}, id="slip"),
    pytest.param({"y_max": [SPEED, 0.0, 0.7 * SPEED]}, "stick", id="3D"),
    pytest.param(
        {"y_max": [SPEED, 0.0, 0.0]}, {"default": "stick", "z_min": "periodic", "z_max": "periodic"}, id="periodic"
    ),
])  # fmt: skip
@pytest.mark.slow
def test_nothing_is_crushed_in_a_corner(
    backend_of: Callable, record_property: Callable, velocity: Mapping[str, list[float]], walls: object
) -> None:
    scene = cavity(100.0, 16, 8.0, velocity, walls)
    frames = [frame for frame, _ in build_run(scene, backend_of("f32")).frames()]
    record_property("least J", least := min(frame.fields["volume_ratio"].min() for frame in frames))
    assert frames[-1].time == scene.time.end
    assert least > UNCRUSHED


@pytest.mark.parametrize("d", [2, slow(3)])
def test_a_lid_drives_nothing_through_other_walls(backend_of: Callable, d: int) -> None:
    """The normal velocity on a wall is zero, up to and in the corners."""
    n = 8
    run = build_run(cavity(10.0, n, 1.0, {"y_max": [SPEED, 0.0, 0.7 * SPEED][:d]}), backend_of("f32"))
    (group,) = run.groups
    x = group.read()["x"]
    for side, wall in ((x.min(), 0.0), (x.max(), 1.0)):
        x[x == side] = wall
    group.replace(x=x)
    run.state_was_replaced()
    for _ in range(3):
        run.step(1e-3)
        state = group.read()
        touches = (state["x"] == 0) | (state["x"] == 1)
        assert (touches.sum(0) == 2 * (2 * n) ** (d - 1)).all()
        assert np.abs(state["v"][touches]).max() < 1e-6 * SPEED
    assert np.abs(state["v"]).max() > 0.1 * SPEED
