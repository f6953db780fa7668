"""Columns and waves of water, and a viscous film, against their closed forms (verification: 6.1, 6.2, 6.5)."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import GRAVITY, block, column_start, moved, period_of, row_means, scene, tilted

from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.solver import Solver

DENSITY = 1000.0
# The column of verification 6.1: c = 10 sqrt(2 g H).
DEPTH, MODULUS = 1.0, 1.962e6
PERIOD = 4 * DEPTH / np.sqrt(MODULUS / DENSITY)
BASE = DENSITY * GRAVITY * DEPTH
CELLS = 32


def column(periods: float) -> Scene:
    """Return a column of water in a shaft of slip walls, with 40 frames per period."""
    h = DEPTH / CELLS
    water = {"law": "fluid", "density": DENSITY, "bulk_modulus": MODULUS}
    return scene(
        [8, CELLS + 4],
        h,
        [block("water", water, [0, 0], [8 * h, DEPTH])],
        periods * PERIOD,
        frames=round(40 * periods),
        gravity=[0, -GRAVITY],
        walls="slip",
        fields=["velocity", "pressure"],
    )


def test_a_column_let_go_swings_about_its_weight(backend_of: Callable, record_property: Callable) -> None:
    """Gravity switched on at t = 0: the base pressure is a triangle between 0 and 2 rho g H, of period 4 H / c.

    d'Alembert's solution of the linear column (verification: 4.2 and 6.1). The weight compresses it by 0.5 % at
    the base, and waves run faster by as much: 1 % for the period. The lowest particles lie h/4 above the base, and
    the tip of the triangle is rounded: 3 % for the peak.
    """
    asked = column(2.3)
    Y = sample_bodies(asked)[0].position[:, 1]
    solver = Solver(asked, backend_of("f32"))
    lowest = asked.domain.spacing / 2 > Y
    frames = [(frame.time, frame.fields["pressure"][lowest].mean() / BASE) for frame, _ in solver.frames()]
    times, pressure = np.array(frames).T
    period = period_of(times[1:], pressure[1:] - 1) / PERIOD
    record_property("period / (4 H / c)", period)
    record_property("peak / (rho g H)", float(pressure.max()))
    assert period == pytest.approx(1, abs=0.01)
    assert pressure.max() == pytest.approx(2, rel=0.03)
    assert pressure.min() >= 0
    # It swings on: what is lost in a period is what the tip's high harmonics held.
    assert pressure[times > 1.3 * PERIOD].max() > 1.85


@pytest.mark.parametrize("periods", [6, pytest.param(22, marks=pytest.mark.slow)], ids=["0.5 s", "2 s"])
def test_a_column_in_balance_stays_still(backend_of: Callable, periods: int, record_property: Callable) -> None:
    """Compressed to J(Y) from the start: p = rho g (H - Y), and no motion (verification: 6.1 b and H14).

    max|v| < 1e-3 sqrt(g H) at all times, and the relative L2 error of p, taken 1.5 h below the surface, < 1 %: the
    issue asks for 5 %, and verification expects 1 % with folded walls. The tension cut-off is on, as by default.
    """
    asked = column(periods)
    sample = sample_bodies(asked)[0]
    X, Y = sample.position.T
    y, J = column_start(Y, DENSITY * GRAVITY, MODULUS, DEPTH)
    solver = Solver(asked, backend_of("f32"), [moved(sample, np.stack([X, y], 1))])
    solver.groups[0].set_deformation(J)
    exact = DENSITY * GRAVITY * (DEPTH - Y)
    inner = DEPTH - 1.5 * asked.domain.spacing > Y
    speeds, errors = [], []
    for frame, _ in solver.frames():
        speeds.append(np.abs(frame.velocity).max() / np.sqrt(GRAVITY * DEPTH))
        error = frame.fields["pressure"] - exact
        errors.append(np.linalg.norm(error[inner]) / np.linalg.norm(exact[inner]))
    record_property("max|v| / sqrt(g H)", float(max(speeds)))
    record_property("L2 of p", float(max(errors)))
    assert max(speeds) < 1e-3
    assert max(errors) < 0.01


@pytest.mark.parametrize(
    ("cells", "periods"), [(32, 2.1), pytest.param(48, 5.1, marks=pytest.mark.slow)], ids=["L/32", "L/48"]
)
def test_sloshing_has_the_period_of_the_linear_wave(
    backend_of: Callable, cells: int, periods: float, record_property: Callable
) -> None:
    """The centre of mass swings as -(2 a L / (pi^2 d)) cos(w t), w^2 = g k tanh(k d), k = pi / L (verification: 6.2).

    A tank L = 1 by d = 0.5 with slip walls starts from the standing wave at its turning point: particles moved by
    its displacement field, (-sin kx cosh ky, cos kx sinh ky) a / sinh kd, under its pressure, which is the hydrostatic
    one for long waves. The issue allows 2 % of the period; (k a)^2 alone makes 0.4 %.
    """
    length, depth, amplitude = 1.0, 0.5, 0.02
    k = np.pi / length
    w = np.sqrt(GRAVITY * k * np.tanh(k * depth))
    water = {"law": "fluid", "density": DENSITY, "bulk_modulus": DENSITY * 100 * 2 * GRAVITY * depth}
    asked = scene(
        [cells, cells * 5 // 8],
        length / cells,
        [block("water", water, [0, 0], [length, depth])],
        periods * 2 * np.pi / w,
        frames=round(40 * periods),
        gravity=[0, -GRAVITY],
        walls="slip",
    )
    sample = sample_bodies(asked)[0]
    X, Y = sample.position.T
    modulus = water["bulk_modulus"]
    wave = amplitude * np.cos(k * X) * np.cosh(k * Y) / np.cosh(k * depth)
    y, _ = column_start(Y, DENSITY * GRAVITY, modulus, depth)
    x = X - amplitude * np.sin(k * X) * np.cosh(k * Y) / np.sinh(k * depth)
    y += amplitude * np.cos(k * X) * np.sinh(k * Y) / np.sinh(k * depth)
    solver = Solver(asked, backend_of("f32"), [moved(sample, np.stack([x, y], 1))])
    solver.groups[0].set_deformation(1 / (1 + DENSITY * GRAVITY * (depth - Y + wave) / modulus))
    times, signal = np.array(
        [(frame.time, frame.position[:, 0].astype(np.float64).mean() - length / 2) for frame, _ in solver.frames()]
    ).T
    swing = 2 * amplitude * length / (np.pi**2 * depth)
    period = period_of(times, signal) * w / (2 * np.pi)
    kept = np.abs(signal[times > (periods - 0.8) * 2 * np.pi / w]).max() / swing
    record_property("period / exact", period)
    record_property("amplitude kept", float(kept))
    assert signal[0] == pytest.approx(-swing, rel=0.01)
    assert period == pytest.approx(1, abs=0.02)
    # Some 2 % are lost in the first period at L/32, most of it at the surface.
    assert 0.9 < kept < 1.02


def test_a_viscous_film_runs_down_with_its_profile(backend_of: Callable, record_property: Callable) -> None:
    """u = g sin(theta) (2 H y - y^2) / (2 nu) in the end, and the start-up series before it (verification: 6.5).

    A film H deep on a stick wall at theta = 45 degrees, at rest under its own pressure, judged in the middle third of
    its length L = 20 H while neither end has come near. From rest the flow misses its end by the modes
    (2 / (nu H m^3)) g sin(theta) sin(m y) exp(-nu m^2 t), m = (j + 1/2) pi / H. Re = u(H) H / nu = 1/2. At h = H/8 the
    second-order error of the parabola is h^2 / 8 H^2 = 0.2 %: 1 % in L2.
    """
    cells, length, theta, reynolds = 8, 20, np.radians(45), 0.5
    H = 0.1
    h, pull = H / cells, GRAVITY * np.sin(theta)
    nu = np.sqrt(pull * H**3 / (2 * reynolds))
    surface = pull * H**2 / (2 * nu)
    modulus = DENSITY * 100 * GRAVITY * H
    oil = {"law": "fluid", "density": DENSITY, "bulk_modulus": modulus, "viscosity": DENSITY * nu}
    asked = scene(
        [cells * (length + 3), cells + 4],
        h,
        [block("oil", oil, [0, 0], [length * H, H])],
        2 * H**2 / nu,
        frames=4,
        gravity=tilted(45),
        walls={"default": "slip", "y_min": "stick"},
    )
    X, Y = sample_bodies(asked)[0].position.T
    solver = Solver(asked, backend_of("f32"))
    solver.groups[0].set_deformation(1 / (1 + DENSITY * GRAVITY * np.cos(theta) * (H - Y) / modulus))
    step, limit = solver.stable_step()
    assert (limit.name, limit.body) == ("viscosity", "oil")
    # That of shear, which sound has no part in (verification: 10.1).
    assert step == pytest.approx(asked.time.safety * h**2 / (4 * nu))
    middle = (length * H / 3 < X) & (2 * length * H / 3 > X)
    y = np.unique(np.round(Y, 9))
    m = (np.arange(100)[:, None] + 0.5) * np.pi / H
    for frame, _ in solver.frames():
        late = np.sum(np.sin(m * y) * np.exp(-nu * m**2 * frame.time) / m**3, axis=0)
        exact = pull / (2 * nu) * (2 * H * y - y**2) - 2 * pull / (nu * H) * late
        if frame.index > 0:
            u = row_means(frame.velocity[:, 0], Y, middle)
            error = np.linalg.norm(u - exact) / np.linalg.norm(exact)
            record_property(f"L2 at {frame.index / 2:.1f} H^2/nu", float(error))
            assert error < 0.01
    record_property("surface velocity / steady", float(u[-1] / surface))
    assert u[-1] == pytest.approx(surface, rel=0.02)
