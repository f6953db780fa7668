"""Forces that depend on the velocity: exact for linear drag at any step, stable, with the right terminal speed."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from scenes import body, box, scene_of

from mpmcli.errors import InputError
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import Scene
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend

G, H = 9.81, 0.05
SOFT = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e3, "poissons_ratio": 0.3}
BOX = box([0.4, 0.4], [0.7, 0.7])


def flying(forces: list[dict], *, velocity: list[float], gravity: float = 0.0, **tables: object) -> Scene:
    """Return a block far from all walls, and a rigid box beside it that does not meet it."""
    time = {"end": 0.4, "frames": 8} | tables.pop("time", {})
    domain = {"size": [4.0, 4.0], "origin": [-1.0, -3.0], "spacing": H, "gravity": [0.0, gravity]}
    rigid = {"name": "rigid", "density": 500.0, "shape": box([1.4, 0.4], [1.6, 0.6])}
    return scene_of(
        body("block", SOFT, BOX, velocity=velocity),
        domain=domain,
        time=time,
        colliders=[rigid | {"velocity": velocity}],
        forces=forces,
        precision="f64",
        **tables,
    )


def rows_of(asked: Scene, backend: Backend) -> list[LedgerRow]:
    # Forced, because the bound on the step counts the drag as it is at the start of a step.
    return [row for _, row in build_run(asked, backend, force=True).frames()]


def speeds(rows: list[LedgerRow]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the times of the velocities, s, and the velocity of the block and of the rigid box, (frames, 2), m/s."""
    times = np.array([row.time - 0.5 * row.step_max for row in rows])
    return (
        times,
        np.array([np.array(row.linear_momentum) / row.mass for row in rows]),
        np.array([row.rigid_motion[0][:2] for row in rows]),
    )


@pytest.mark.parametrize("rate", [2.0, 40.0, 4e4])
def test_linear_drag_decays_as_the_exponential(backend_of: Callable, rate: float) -> None:
    """At 0.02, 0.4 and 400 times the rate of a step: exp(-k t), towards the wind; nothing grows."""
    forces = [{"acceleration": [f"-{rate} * (vx - 0.5)", f"-{rate} * vy"]}]
    asked = flying(forces, velocity=[2.0, -1.0], time={"step": 0.01})
    rows = rows_of(asked, backend_of("f64", 1))
    times, *found = speeds(rows)
    exact = np.array([0.5, 0.0]) + np.exp(-rate * times)[:, None] * np.array([1.5, -1.0])
    for velocity in found:
        assert velocity[1:] == pytest.approx(exact[1:], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("drag", "terminal"),
    [(["-30 * vx", "-30 * vy"], G / 30), (["-8 * speed * vx", "-8 * speed * vy"], math.sqrt(G / 8))],
)
@pytest.mark.parametrize("step", [0.01, 0.0025])
def test_the_terminal_speed_is_where_drag_bears_the_weight(
    backend_of: Callable, drag: list[str], terminal: float, step: float
) -> None:
    """Of Stokes and of Newton, g / k and sqrt(g / c), whatever the step."""
    asked = flying([{"acceleration": drag}], velocity=[0.0, 0.0], gravity=-G, time={"end": 1.0, "step": step})
    _, block, rigid = speeds(rows_of(asked, backend_of("f64", 1)))
    assert block[-1] == pytest.approx([0.0, -terminal], rel=1e-6, abs=1e-9)
    assert rigid[-1] == pytest.approx([0.0, -terminal], rel=1e-6, abs=1e-9)


def test_a_spin_decays_with_the_velocity(backend_of: Callable) -> None:
    """Drag acts on each point of a body, so that a rotation slows down as a translation does."""
    rate, spin = 3.0, 1.0
    asked = flying([{"acceleration": [f"-{rate} * vx", f"-{rate} * vy"]}], velocity=[0.0, 0.0])
    body = asked.bodies[0].model_copy(update={"velocity_gradient": ((0.0, -spin), (spin, 0.0))})
    rows = rows_of(asked.model_copy(update={"bodies": (body,)}), backend_of("f64", 1))
    turning = np.array([row.angular_momentum[0] for row in rows])
    # It stays at its place.
    times, *_ = speeds(rows)
    assert turning[1:] / turning[0] == pytest.approx(np.exp(-rate * times[1:]), rel=2e-3)


def parsed(acceleration: list[str], **constants: object) -> object:
    """Return the acceleration of a force in a scene with constants."""
    more = {"constants": constants} if constants else {}
    forces = [{"acceleration": acceleration}]
    asked = scene_of(body("block", SOFT, BOX), size=[1.0, 1.0], spacing=0.1, forces=forces, contact={}, **more)
    return asked.forces[0].acceleration


def test_constants_come_before_the_names_of_the_velocity() -> None:
    """A scene that calls a number `speed` or `vx` means that number; vz is for 3D."""
    assert parsed(["2 * speed", "vx"], speed=3.0, vx=4.0) == (6.0, 4.0)
    assert parsed(["speed", "0"])[0].names == {"vx", "vy"}
    with pytest.raises(InputError, match="vz"):
        parsed(["vz", "0"])
