"""A viscous film against its closed form (docs/theory.md, 10)."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import GRAVITY, block, row_means, scene, tilted

from mpmcli.scene import sample_bodies
from mpmcli.solver.engine.run import build_run

DENSITY = 1000.0


def test_a_viscous_film_runs_down_with_its_profile(backend_of: Callable, record_property: Callable) -> None:
    """u = g sin(theta) (2 H y - y^2) / (2 nu) in the end, and the start-up series before it (docs/theory.md, 10).

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
    run = build_run(asked, backend_of("f32"))
    run.groups[0].replace(deformation=1 / (1 + DENSITY * GRAVITY * np.cos(theta) * (H - Y) / modulus))
    step, limit = run.stable_step()
    assert (limit.name, limit.body) == ("viscosity", "oil")
    # That of shear, which sound has no part in (docs/theory.md, 6.2).
    assert step == pytest.approx(asked.time.safety * h**2 / (4 * nu))
    middle = (length * H / 3 < X) & (2 * length * H / 3 > X)
    y = np.unique(np.round(Y, 9))
    m = (np.arange(100)[:, None] + 0.5) * np.pi / H
    for frame, _ in run.frames():
        late = np.sum(np.sin(m * y) * np.exp(-nu * m**2 * frame.time) / m**3, axis=0)
        exact = pull / (2 * nu) * (2 * H * y - y**2) - 2 * pull / (nu * H) * late
        if frame.index > 0:
            u = row_means(frame.velocity[:, 0], Y, middle)
            error = np.linalg.norm(u - exact) / np.linalg.norm(exact)
            record_property(f"L2 at {frame.index / 2:.1f} H^2/nu", float(error))
            assert error < 0.01
    record_property("surface velocity / steady", float(u[-1] / surface))
    assert u[-1] == pytest.approx(surface, rel=0.02)
