"""Gravity of time, forces, initial states: against sums and closed forms, in both precisions."""

import numpy as np
import pytest
from scenes import block, body, scene_of, stresses
from solver_state import bodies_of

from mpmcli.solver.engine.run import build_run

# So soft that nothing but what drives it moves it.
CLOUD = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e-6, "poissons_ratio": 0.3}
JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e4, "poissons_ratio": 0.3}


def disc(name="disc", center=(0.5, 0.5), radius=0.15, material=CLOUD, **more):
    ball = {"center": list(center), "radius": radius}
    return body(name, dict(material), {"ball": ball}, **more)


def driven(bodies, *, precision="f64", origin=(0.0, 0.0), gravity=(0.0, 0.0), forces=(), **more):
    return scene_of(
        *bodies,
        domain={"size": [1.0, 1.0], "spacing": 0.05, "gravity": list(gravity), "origin": list(origin)},
        forces=list(forces),
        precision=precision,
        **more,
    )


def stepped(scene, backend, dt, count):
    run = build_run(scene, backend)
    for _ in range(count):
        run.step(dt)
    return run, bodies_of(run)


@pytest.fixture(scope="module", params=["f64", pytest.param("f32", marks=pytest.mark.slow)])
def precision(request):
    return request.param


@pytest.fixture(scope="module")
def backend(precision, backend_of):
    return backend_of(precision)


@pytest.fixture(scope="module")
def rounding(precision):
    """Rounding of a sum over some hundred steps."""
    return 1e-13 if precision == "f64" else 2e-6


def test_the_impulse_of_gravity_of_time_is_exact(backend, precision, rounding):
    """v = integral of g to the middle of the last step, to rounding, for steps of any size, and x = sum of dt v."""
    scene = driven([disc()], precision=precision, gravity=("2 * cos(5 * t)", "-3 + t"))
    run = build_run(scene, backend)
    before = bodies_of(run)["disc"].x
    x, rng = np.zeros(2), np.random.default_rng(0)
    for _ in range(200):
        dt = rng.uniform(1e-3, 2e-3)
        run.step(dt)
        t = run.state.velocity_time
        v = np.array([0.4 * np.sin(5 * t), -3 * t + 0.5 * t**2])
        x += dt * v
    body, t = bodies_of(run)["disc"], run.time
    np.testing.assert_allclose(body.momentum() / body.mass.sum(), v, atol=rounding)
    np.testing.assert_allclose(body.v, np.broadcast_to(v, body.v.shape), atol=10 * rounding)
    np.testing.assert_allclose(body.x - before, np.broadcast_to(x, body.x.shape), atol=10 * rounding)
    exact = np.array([2 * (1 - np.cos(5 * t)) / 25, -1.5 * t**2 + t**3 / 6])
    # Second order: a'' is at most 50 m/s^4.
    assert np.abs(x - exact).max() < 50 * 2e-3**2 * t**2


def test_a_linear_force_swings_a_cloud(backend, precision, rounding):
    """a = -K (x - c): after half a step from rest v = -dt/2 K (x - c) and C = -dt/2 K, at the surface as inside.

    Momentum takes m a(x_p), so that the centre of mass follows leapfrog exactly, and the cosine to second order.
    """
    k, dt, count = 40.0, 1e-3, 150
    force = {"acceleration": [f"-{k} * (x - 2.5) + 7 * (y + 0.5)", f"-{k} * (y + 0.5)"]}
    cloud = disc(center=(2.6, -0.5))
    run = build_run(driven([cloud], precision=precision, origin=(2.0, -1.0), forces=[force]), backend)
    place = bodies_of(run)["disc"].x - 0.5
    run.step(dt)
    body = bodies_of(run)["disc"]
    slope = np.array([[-k, 7], [0, -k]])
    np.testing.assert_allclose(body.v, dt / 2 * place @ slope.T, atol=rounding)
    np.testing.assert_allclose(body.C, np.broadcast_to(dt / 2 * slope, body.C.shape), atol=50 * rounding)
    for _ in range(count - 1):
        run.step(dt)
    body = bodies_of(run)["disc"]
    u, v = 0.1, 0.0
    for n in range(count):
        v -= (dt if n else dt / 2) * k * u
        u += dt * v
    np.testing.assert_allclose(body.x.mean(0), [0.5 + u, 0.5], atol=10 * rounding)
    assert abs(u - 0.1 * np.cos(np.sqrt(k) * dt * count)) < 0.1 * (k * dt**2) * (np.sqrt(k) * dt * count)


def test_a_tether_to_the_start_moves_a_body_as_one(backend, precision, rounding):
    """a = -k (x - X) is the same for all particles of a body that has moved as one, and stays so."""
    force = {"acceleration": ["-40 * (x - X)", "-40 * (y - Y)"]}
    body = stepped(driven([disc(velocity=[0.5, 0.2])], precision=precision, forces=[force]), backend, 2e-3, 200)[1][
        "disc"
    ]
    u, v = 0.0, 0.5
    for n in range(200):
        v -= (2e-3 if n else 1e-3) * 40 * u
        u += 2e-3 * v
    np.testing.assert_allclose(body.v, np.broadcast_to([v, 0.4 * v], body.v.shape), atol=5 * rounding)
    assert v == pytest.approx(0.5 * np.cos(np.sqrt(40) * 0.4), abs=0.5 * np.sqrt(40) * 2e-3)


def test_a_force_on_one_body_leaves_the_other_alone(backend, precision):
    """Two bodies of one law, and so of one kernel; forces add up on the one that has two."""
    two = [disc("left", (0.25, 0.5)), disc("right", (0.75, 0.5))]
    forces = [{"body": "left", "acceleration": ["sin(t) + X", "-y"]}, {"body": "left", "acceleration": [0, "y"]}]
    state = stepped(driven(two, precision=precision, forces=forces), backend, 1e-3, 50)[1]
    still = bodies_of(build_run(driven(two, precision=precision, forces=forces), backend))
    for name in ("x", "v", "C", "deformation"):
        np.testing.assert_array_equal(getattr(state["right"], name), getattr(still["right"], name))
    # sum dt (sin t_n + X), the mean of X being the centre; the first step is a half one.
    gained = 1e-3 * np.sin(1e-3 * np.arange(50)).sum() + 0.0495 * 0.25
    left = state["left"].momentum() / state["left"].mass.sum()
    np.testing.assert_allclose(left, [gained, 0.0], atol=1e-6)


def test_steps_know_of_forces(backend, precision):
    """Before anything moves: dt^2 a = h / 2 with the margin of 1.5 on a, and dt^2 |da/dx| = 1 with the same."""
    h = 0.05
    weak = build_run(driven([disc()], precision=precision, forces=[{"acceleration": ["30", 0]}]), backend)
    limit = weak.nearest_limit
    assert (limit.name, limit.value) == ("speed", pytest.approx(np.sqrt(0.5 * h / 45), rel=1e-5))
    steep = build_run(driven([disc()], precision=precision, forces=[{"acceleration": ["-9e4 * (x - X)", 0]}]), backend)
    limit = steep.nearest_limit
    assert (limit.name, limit.value) == ("force", pytest.approx(1 / np.sqrt(1.5 * 9e4), rel=1e-3))
    # A pulse to come is seen before it comes, at one of the instants up to the next measurement.
    sudden = driven([disc()], precision=precision, forces=[{"acceleration": ["1e4 if t > 0.05 else 0", 0]}])
    assert build_run(sudden, backend).nearest_limit.value == pytest.approx(np.sqrt(0.5 * h / 1.5e4), rel=1e-5)


def test_initial_deformation_is_a_stress(backend, precision, rounding):
    """Neo-Hookean, F = diag(a, 1): tau_xx = mu (a^2 - 1) + lambda ln a, tau_yy = lambda ln a; sigma = tau / a."""
    body = block("bar", JELLY, (0.25, 0.25), (0.75, 0.5), deformation=[["1 + X / 10", 0], [0, 1]])
    scene = driven([body], precision=precision, output={"fields": ["velocity", "stress", "initial_position"]})
    frame, _ = build_run(scene, backend).frame()
    a = 1 + frame.fields["initial_position"][:, 0] / 10
    mu, lam = 1e4 / 2.6, 1e4 * 0.3 / (1.3 * 0.4)
    sigma = stresses(frame.fields)
    np.testing.assert_allclose(sigma[:, 0, 0], (mu * (a * a - 1) + lam * np.log(a)) / a, rtol=10 * rounding)
    np.testing.assert_allclose(sigma[:, 1, 1], lam * np.log(a) / a, rtol=100 * rounding)
    np.testing.assert_array_equal(frame.position, frame.fields["initial_position"])


@pytest.mark.parametrize("exponent", [pytest.param(1.0, marks=pytest.mark.slow), 7.0])
def test_a_hydrostatic_column_stays_at_rest(backend, precision, exponent):
    """It carries its own weight from the start: max |v| < 1e-3 sqrt(g H), where it is 0.06 to 0.14 without."""
    g, H = 9.81, 0.5
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e5, "exponent": exponent}
    body = block("pool", water, (0.0, 0.0), (1.0, H), initial_pressure="hydrostatic")
    scene = driven([body], precision=precision, gravity=(0.0, -g), output={"fields": ["velocity", "pressure"]})
    run = build_run(scene, backend)
    frame, _ = run.frame()
    # J p = density g depth.
    J = bodies_of(run)["pool"].deformation
    np.testing.assert_allclose(J * frame.fields["pressure"], 1000.0 * g * (H - frame.position[:, 1]), atol=1e-6 * 2e5)
    fastest = 0.0
    for _ in range(30):
        for _ in range(10):
            run.step(run.stable_step()[0])
        fastest = max(fastest, np.abs(bodies_of(run)["pool"].v).max())
    assert fastest < 2e-4 * np.sqrt(g * H)
