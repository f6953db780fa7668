"""What the check makes of bodies that start deformed, against the first step of the run."""

from collections.abc import Callable

import numpy as np
import pytest
from check_scenes import FLUID, SOLID, box, check, loaded

from mpmcli.check.facts import SceneFacts
from mpmcli.check.scene_limits import Start, starts_of
from mpmcli.solver.engine.run import build_run

# The kernels are those of test_check_scene.py: that of a fluid without viscosity is of the shape of mpm88.
WATER = FLUID | {"viscosity": 1e-3}
SUCKING = FLUID | {"tension_cutoff": False}
WALLS = {"gravity": [0.0, 0.0], "walls": "separate"}
FREE = {"domain": WALLS, "shape": box([0.3, 0.3], [0.5, 0.5])}
MPM88 = box([0.2, 0.2], [0.6, 0.6])
CASES = {
    "a stretched solid": {"material": SOLID, "deformation": [[4.0, 0.0], [0.0, 0.25]]},
    "a solid pressed unevenly": {"material": SOLID, "deformation": [["0.9 - 0.2 * X", 0.0], [0.1, 0.8]]},
    "compressed gas": {"material": WATER, "deformation": 0.2},
    "a fluid let go under tension": {"material": SUCKING, "shape": MPM88, "deformation": "1.1 + 0.1 * sin(40 * X)"},
    "a column at rest": {
        "material": WATER,
        "initial_pressure": "hydrostatic",
        "domain": WALLS | {"gravity": [0.0, -10.0]},
    },
}


@pytest.mark.parametrize("name", CASES)
def test_the_first_step_is_the_run_s(name: str, backend_of: Callable) -> None:
    """The check's step at the start is that of the solver, which measures every particle."""
    asked = FREE | CASES[name]
    checked = check(**asked)
    backend = backend_of("f64", 1)
    run = build_run(loaded(**asked, solver={"precision": "f64"}).scene, backend)
    assert checked.facts.step_at_start == pytest.approx(run.stable_step()[0], rel=1e-9)
    assert checked.facts.step <= checked.facts.step_at_start
    assert "at-rest" not in [finding.rule for finding in checked.findings]


def test_deformation_is_found_where_particles_are() -> None:
    """A narrow peak of J on a single row of particles: the lattice of the check is that of the sampling."""
    start = starts_of(loaded(**FREE, material=SUCKING, deformation="3 if abs(X - 0.30390625) < 1e-4 else 1").scene)[0]
    assert (start.bound.volume_ratio_min, start.bound.volume_ratio_max) == (1.0, 3.0)
    nowhere = starts_of(loaded(**FREE, material=SUCKING, deformation="3 if abs(X - 0.3) < 1e-4 else 1").scene)[0]
    assert nowhere == Start()


def test_stored_energy_becomes_speed() -> None:
    """(1/2) density v^2 = W; for p = K (1/J - 1), W = K (J - 1 - ln J)."""
    facts = SceneFacts(loaded(**FREE, material=FLUID, deformation=0.2).scene)
    expected = np.sqrt(2 * FLUID["bulk_modulus"] * (0.2 - 1 - np.log(0.2)) / FLUID["density"])
    assert facts.bounds.speed == pytest.approx(expected)
    assert min(body.arrival.time for body in facts.bodies) == 0.0
