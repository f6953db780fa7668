"""Impulses of gravity where the step falls: nothing is lost, and no kick is longer than what is stable."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, scene, scene_of
from solver_state import bodies_of

from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.engine.run_state import Layout, RunState
from mpmcli.solver.engine.step_size import HOLD_STEPS, RISE, StepSize
from mpmcli.solver.transfer.splines import SPLINES, TransferScheme

# So soft that nothing but gravity moves it.
CLOUD = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e-6, "poissons_ratio": 0.3}
GRAVITY = (3.0, -9.81)


def falling(backend: object, **more: object) -> Run:
    """Return a cloud in free fall, in double precision."""
    body = block("cloud", CLOUD, [0.4, 0.5], [0.6, 0.7])
    return build_run(scene([10, 10], 0.1, [body], 1.0, gravity=GRAVITY, precision="f64", **more), backend)


def test_a_step_that_falls_tenfold_drops_no_impulse(backend_of: Callable) -> None:
    """v = g (t - dt/2) to rounding, once what the fall left is given: (10 - 1)/2 dt in shares of (1/safety - 1) dt.

    No kick is longer than dt/safety: what is stable for viscosity, where 2 kick V <= density h^2.
    """
    run = falling(backend_of("f64"))
    kicks = []

    def step(dt: float) -> None:
        since = run.state.velocity_time
        run.step(dt)
        kicks.append((run.state.velocity_time - since) / dt)

    for dt in [1e-3] * 5 + [1e-4] * 25 + [1e-3] * 2 + [1e-4] * 5:
        step(dt)
    assert run.state.kick_carry > 0, "the second fall has not left anything"
    for _ in range(25):
        step(1e-4)
    body = bodies_of(run)["cloud"]
    expected = np.array(GRAVITY) * (run.time - 0.5e-4)
    assert run.state.kick_carry == 0.0
    np.testing.assert_allclose(body.v, np.broadcast_to(expected, body.v.shape), rtol=1e-12)
    safety = run.scene.time.safety
    assert max(kicks) == pytest.approx(1 / safety)


def test_what_a_step_owes_is_saved(backend_of: Callable) -> None:
    """A run that is saved after a fall of the step and continued has the velocities of one that was not."""
    run = falling(backend_of("f64"))
    for dt in (1e-3, 1e-3, 1e-4):
        run.step(dt)
    owed, saved = run.state.kick_carry, run.save().copied()
    assert owed == pytest.approx(0.55e-3 - 0.125e-3)
    run.step(1e-4)
    first = bodies_of(run)["cloud"].v
    run.load(saved)
    assert run.state.kick_carry == owed
    run.step(1e-4)
    np.testing.assert_array_equal(bodies_of(run)["cloud"].v, first)


def test_a_bound_rises_late_and_never_with_an_oscillation() -> None:
    """It falls at once, stays through an oscillation, and rises within two series after its cause ended."""
    layout = Layout(2, [0])
    run = RunState(layout, np.zeros((1, layout.widths["numbers"])), np.zeros((1, layout.widths["counts"]), np.int32), 0)
    run.reset()
    step_size = StepSize(layout, [], None, TransferScheme(SPLINES["quadratic"]), drifts=True)

    def after(bound: float) -> float:
        """Return the bound that is held after a step whose own bound was this one."""
        step_size.limit_rise(run, bound)
        return run.held

    seen = [after(1.0 + 0.2 * np.cos(angle)) for angle in 1.9 * np.arange(20 * HOLD_STEPS)]
    assert min(seen) >= 0.8
    assert np.ptp(seen[HOLD_STEPS:]) < 1e-3
    for n in range(2 * HOLD_STEPS):
        assert after(2.0) == seen[-1] or n >= HOLD_STEPS
    assert run.held == 2.0
    for _ in range(3 * HOLD_STEPS):
        assert after(2.0 * RISE * 0.99) == 2.0
    assert after(1.0) == 1.0


PULSE = "t > 0.0123 and t < 0.01232"


@pytest.mark.parametrize("step", [1e-3, 3e-3])
def test_no_step_skips_a_pulse(step: float, backend_of: Callable) -> None:
    """Gravity of 5000 m/s^2 for 20 us gives 0.1 m/s to 1e-9, whether a step lands on it or not.

    A force of time and place gives each particle the impulse of the place where the step finds it.
    """
    gravity = (0.0, f"-5000 if {PULSE} else -9.81")
    force = {"acceleration": [f"3000 if {PULSE} and x < 0.5 else 0", 0.0]}
    asked = scene_of(
        block("cloud", CLOUD, [0.4, 0.5], [0.6, 0.7]),
        domain={"size": [1.0, 1.0], "spacing": 0.1, "gravity": list(gravity)},
        forces=[force],
        precision="f64",
    )
    run = build_run(asked, backend_of("f64"))
    while run.time < 0.03:
        run.step(step)
    body, t = bodies_of(run)["cloud"], run.state.velocity_time
    expected = -9.81 * t - (5000 - 9.81) * 2e-5
    np.testing.assert_allclose(body.v[:, 1], expected, rtol=1e-9)
    assert body.momentum()[0] == pytest.approx(3000 * 2e-5 * body.mass.sum() / 2, rel=1e-9)
