"""The bound on deformation in a step: `check` has it from the scene, the solver from its particles."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, scene

from mpmcli.check.scene_limits import deformation_rate, scene_limits
from mpmcli.scene import scene_bounds
from mpmcli.solver.engine.run import build_run

# The kernels in 2D are those of test_check_scene.py.
CELLS = {2: 64, 3: 8}
MATERIALS = {
    "fluid": {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5, "viscosity": 1e-3},
    "neo_hookean": {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5},
}


@pytest.mark.parametrize(
    ("dimension", "law"),
    [(2, "fluid"), (2, "neo_hookean"), *(pytest.param(3, law, marks=pytest.mark.slow) for law in MATERIALS)],
)
def test_check_and_solver_count_deformation_alike(backend_of: Callable, dimension: int, law: str) -> None:
    """Spin, and gradients of all signs: the bound of a scene that starts with them is the one that its run takes."""
    random = np.random.default_rng(dimension)
    for L in random.normal(0.0, 50.0, (2, dimension, dimension)):
        # The second run finds the stored kernel of the first one.
        backend = backend_of("f64", 1)
        body = block("body", MATERIALS[law], [0.3] * dimension, [0.5] * dimension, velocity_gradient=L.tolist())
        asked = scene([CELLS[dimension]] * dimension, 0.1, [body], end=1.0, precision="f64")
        told, taken = (
            next(limit for limit in limits if limit.name == "deformation")
            for limits in (scene_limits(asked, scene_bounds(asked)), build_run(asked, backend).limits())
        )
        assert told.state == "rest" and told.value == pytest.approx(taken.value, rel=1e-12)


def test_a_rotation_deforms_nothing_and_a_fluid_in_strain_does() -> None:
    """det(I + dt diag(a, -a)) = 1 - (a dt)^2, though the trace is 0; and in shear det(I + dt C) = 1."""
    spin, strain, shear = np.array([[[0, -7], [7, 0]], [[3, 0], [0, -3]], [[0, 4], [0, 0]]], dtype=float)
    assert deformation_rate(np.array([spin, strain, shear]), keeps_J=False).tolist() == [0.0, 3.0, 2.0]
    assert deformation_rate(np.array([spin, strain, shear]), keeps_J=True).tolist() == [0.0, 3.0, 0.0]
