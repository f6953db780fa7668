"""The stable time step: predicted to a few per cent, for one particle and in deformed states (docs/theory.md, 6)."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import body, box, liquid, scene_of, slow, solid
from solver_state import bodies_of

from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.run import Run, build_run
from mpmcli.solver.frames.diagnosis import UnstableRunError
from mpmcli.stability.limits import COURANT, DEFORMATION, FIX, WHY, Limit, deformation_limit, mode_limit, speed_limit

H, RHO = 0.1, 1000.0
E, NU = 1e5, 0.3
MU, LAMBDA = E / (2 * (1 + NU)), E * NU / ((1 + NU) * (1 - 2 * NU))
START = 1e-6


def lone_particles(dimension: int) -> object:
    """Return a scene of one fluid and one elastic particle, far apart, whose limits are equal.

    h sqrt(rho / (d K)) for the fluid and h sqrt(rho / (d lambda + 2 mu)) for the solid: K = lambda + 2 mu / d.
    """
    d = dimension
    side = {"particles_per_cell": 1}

    def cell(x: float) -> dict:
        low = [x] + [0.33] * (d - 1)
        return box(low, [c + H for c in low])

    return scene_of(
        body("solid", solid(E, density=RHO, poissons_ratio=NU), cell(0.32), **side),
        # With the cut-off half of its oscillation would be free.
        body("liquid", liquid(LAMBDA + 2 * MU / d, density=RHO, tension_cutoff=False), cell(1.07), **side),
        domain={"size": [1.6] + [0.8] * (d - 1), "spacing": H},
        precision="f64",
    )


def started(backend_of: Callable, dimension: int) -> Run:
    """Return a solver of the lone particles with C0 = START I, their most unstable mode."""
    scene = lone_particles(dimension)
    mode = START * np.eye(dimension)
    samples = [replace(s, affine=np.tile(mode, (s.count, 1, 1))) for s in sample_bodies(scene)]
    assert [s.count for s in samples] == [1, 1]
    return build_run(scene, backend_of("f64", 1), samples)


def predicted(dimension: int) -> float:
    """h / sqrt((d lambda + 2 mu) / rho) (10.1)."""
    return H / np.sqrt((dimension * LAMBDA + 2 * MU) / RHO)


@pytest.mark.parametrize(("dimension", "steps"), [(2, 10_000), slow(3, 10_000), slow(2, 100_000), slow(3, 100_000)])
def test_a_lone_particle_is_stable_just_below_its_limit(
    backend_of: Callable, dimension: int, steps: int, record_property: Callable
) -> None:
    """At 0.98 of the limit C stays of its size, for the fluid and the solid (10.3 T1).

    The step is a rotation in (C, tau dt / C scale) with trace 2 - 4 r^2 and determinant 1, so |C| stays below
    C0 / sqrt(1 - r^2) = 5.0 C0 at r = 0.98.
    """
    run = started(backend_of, dimension)
    dt = 0.98 * predicted(dimension)
    for limit in run.limits():
        if limit.name == "wave":
            assert limit.value == pytest.approx(predicted(dimension), rel=1e-6)
    largest = {"solid": 0.0, "liquid": 0.0}
    for n in range(steps):
        run.step(dt)
        if n % 997 < 16 or n > steps - 50:
            for name, body in bodies_of(run).items():
                largest[name] = max(largest[name], float(np.abs(body.C).max()))
    for name, value in largest.items():
        record_property(f"{name} max |C|/C0", value / START)
        assert START / 2 < value < 1.05 * START / np.sqrt(1 - 0.98**2)


@pytest.mark.parametrize("dimension", [2, slow(3)])
def test_a_lone_particle_grows_just_above_its_limit(
    backend_of: Callable, dimension: int, record_property: Callable
) -> None:
    """At 1.02 of the limit |C| grows by |lambda| = 2 r^2 - 1 + 2 r sqrt(r^2 - 1) = 1.49 per step, past 1e3 (10.3)."""
    run = started(backend_of, dimension)
    r = 1.02
    growth = 2 * r * r - 1 + 2 * r * np.sqrt(r * r - 1)
    n = 10
    # Within these the state stays far inside the linear range: 1e-6 x 1.49^25 dt = 1e-4.
    for _ in range(25 - n):
        run.step(r * predicted(dimension))
    middle = {name: float(np.abs(state.C).max()) for name, state in bodies_of(run).items()}
    for _ in range(n):
        run.step(r * predicted(dimension))
    for name, state in bodies_of(run).items():
        largest = float(np.abs(state.C).max())
        record_property(f"{name} growth/step", (largest / middle[name]) ** (1 / n))
        assert largest > 1e3 * START
        assert (largest / middle[name]) ** (1 / n) == pytest.approx(growth, rel=0.01)


def test_an_unstable_particle_stops_the_run(backend_of: Callable) -> None:
    """Growth beyond the limit ends in an error that names a body, and never in numbers that are not finite."""
    run = started(backend_of, 2)
    with pytest.raises(UnstableRunError) as stopped:
        for _ in range(2000):
            run.step(1.1 * predicted(2))
    assert stopped.value.diagnosis.body in ("solid", "liquid")


def test_bounds_are_their_formulas() -> None:
    """h sqrt(rho / stiffness), v dt + g dt^2 = COURANT h and DEFORMATION / |grad v|; nothing moving bounds nothing."""
    wave, cause = mode_limit(0.02, 1000.0, 2 * 2.25e9)
    assert (wave, cause) == (pytest.approx(0.02 / np.sqrt(2) / 1500.0), "wave")
    assert mode_limit(0.02, 1000.0, 0.0) == (np.inf, "wave")
    assert speed_limit(0.1, 4.0, 0.0) == pytest.approx(COURANT * 0.1 / 4.0)
    assert speed_limit(0.1, 0.0, 0.0) == np.inf
    for speed in (0.0, 1e-9, 2.0):
        dt = speed_limit(0.1, speed, 9.81)
        assert speed * dt + 9.81 * dt**2 == pytest.approx(COURANT * 0.1)
    assert deformation_limit(5.0) == pytest.approx(DEFORMATION / 5.0)
    assert deformation_limit(0.0) == np.inf


@given(c=st.floats(0.1, 3e3), nu=st.floats(1e-6, 10.0), h=st.floats(1e-3, 1.0), d=st.sampled_from([2, 3]))
def test_waves_and_viscosity_share_the_step(c: float, nu: float, h: float, d: int) -> None:
    """d (c dt/h)^2 + 4 nu dt/h^2 = 1 (10.1), and the larger term names the bound; h^2/(4 nu) for viscosity alone."""
    rho = 800.0
    step, cause = mode_limit(h, rho, d * rho * c**2, 2 * rho * nu)
    wave, viscous = d * (c * step / h) ** 2, 4 * nu * step / h**2
    assert wave + viscous == pytest.approx(1.0)
    assert cause == ("wave" if wave >= viscous else "viscosity")
    assert mode_limit(h, rho, 0.0, 2 * rho * nu) == (pytest.approx(h**2 / (4 * nu)), "viscosity")


def test_every_bound_says_why_and_what_helps() -> None:
    """Each name has its two sentences, and limits sort by their value."""
    assert WHY.keys() == FIX.keys()
    assert all(WHY[name] and FIX[name] for name in WHY)
    first, second = Limit(1e-3, "wave", "a"), Limit(2e-3, "speed", "")
    assert min(second, first) is first
    assert first.why == WHY["wave"]
    assert first.fix == FIX["wave"]


def test_mpm88_is_stable_at_128_cells_and_not_at_200() -> None:
    """Taichi's mpm88 takes C = c dt / h = 0.512 at 128 cells and 0.80 at 200: the limit is 1/sqrt(2) (section 0.3)."""
    E_88, rho, dt = 400.0, 1.0, 2e-4
    for cells, stable in ((128, True), (200, False)):
        limit, _ = mode_limit(1 / cells, rho, 2 * E_88)
        assert limit * np.sqrt(E_88 / rho) * cells == pytest.approx(1 / np.sqrt(2))
        assert (dt < limit) == stable
