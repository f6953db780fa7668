"""What the validation cases of sand and snow compare with, against independent numbers."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene
from mpmcli.solver.engine.run import build_run
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.cases import plastic_blocks as paths
from mpmcli.validation.cases.snow_oedometer import (
    COMPRESSION,
    DENSITY,
    DEPTH,
    HARDENING,
    PULL,
    confined_height,
    confined_stress,
)


def test_the_closed_form_of_confined_snow_is_the_table() -> None:
    """Rows of the table of Stomakhin's law, Pa."""
    stretch = np.array([0.99, 0.97, 0.95, 0.90, 0.80])
    assert confined_stress(stretch) == pytest.approx(
        [-1555.5556, -4114.6219, -5157.7953, -9092.0187, -28526.1446], rel=1e-6
    )


def test_snow_under_its_own_weight_is_as_high_as_the_sum_of_its_stretches() -> None:
    """Each of 4000 layers is compressed until it carries the rest, found by bisection."""
    layers = 4000
    height = 0.0
    for k in range(layers):
        load = DENSITY * PULL * DEPTH * (1 - (k + 0.5) / layers)
        low, high = 0.7, 1.0
        for _ in range(50):
            middle = (low + high) / 2
            low, high = (middle, high) if -confined_stress(np.array(middle)) > load else (low, middle)
        height += middle * DEPTH / layers
    assert confined_height(DEPTH) == pytest.approx(height, rel=1e-6)


@pytest.mark.parametrize("strain", [-0.03, 0.05])
def test_hardened_metal_is_that_of_small_increments(strain: float) -> None:
    """d tau = 2 mu (d e - d e_p) beyond yield, d e_p along the deviator with H d a = d q, in 20,000 Euler steps."""
    total = math.log1p(strain)
    e = np.array([0.0, 0.0, total]) / 20000
    s, a, mu = np.zeros(3), 0.0, paths.MU
    for _ in range(20000):
        trial = s + 2 * mu * (e - e.mean())
        q = math.sqrt(1.5) * float(np.linalg.norm(trial))
        over = max(q - paths.YIELD - paths.HARDENING * a, 0.0) / (3 * mu + paths.HARDENING)
        a += over
        s = trial * (1 - 3 * mu * over / q)
    tau = s + (paths.LAMBDA + 2 / 3 * mu) * total
    assert np.diag(paths.hardened(np.diag([1, 1, 1 + strain]))) == pytest.approx(tau, rel=1e-9)
    assert np.diag(paths.hardened(np.diag([1, 1 + strain]))) == pytest.approx(tau[1:], rel=1e-9)


def test_damp_sand_is_at_the_limit_of_mohr_and_coulomb() -> None:
    """In the plane (t1 - t2)/2 = c cos(phi) - (t1 + t2)/2 sin(phi), also where it is torn; nothing shears that."""
    phi = math.radians(paths.FRICTION)
    for tau in (paths.pressed(np.diag([1, 0.99])), paths.at_the_tip(np.diag([1.01, 1.01]))):
        low, high = sorted(np.diag(tau))
        strength = paths.COHESION * math.cos(phi) - (high + low) / 2 * math.sin(phi)
        assert (high - low) / 2 == pytest.approx(strength, abs=1e-12 * paths.MU)


@pytest.mark.parametrize("stretch", [0.99, 0.95])
def test_packed_snow_is_that_of_the_shaft(stretch: float) -> None:
    """J sigma along the axis over 2 mu + lambda: the shaft has the same law with other moduli."""
    assert (paths.COMPRESSION, paths.SNOW_HARDENING) == (COMPRESSION, HARDENING)
    known = confined_stress(np.array(stretch)) * stretch / confined_modulus()
    found = paths.snow(np.diag([1, stretch]))[-1, -1] / (2 * paths.MU + paths.LAMBDA)
    assert found == pytest.approx(float(known), rel=1e-6)


def confined_modulus() -> float:
    """Return 2 mu + lambda of the shaft, from its stress at a small strain, Pa."""
    small = 1e-7
    return float(-confined_stress(np.array(1 - small)) / small)


@pytest.mark.slow
def test_steep_sand_is_rejected_by_the_band_of_the_column(backend_of: Callable, record_property: Callable) -> None:
    """A friction angle of 63 degrees runs out to half of the lower end of the band (docs/theory.md, 10)."""
    case, setting = all_cases()["sand_column_2"], Setting()
    n = case.levels["coarse"][0]
    tables = case.scene_tables(n, setting)
    del tables["bodies"][0]["material"]["repose_angle"]
    tables["bodies"][0]["material"]["friction_angle"] = 63.0
    asked = parse_scene(tables, laws=parameter_models()).scene
    found = case.measure(n, asked, build_run(asked, backend_of("f64")).frames())
    record_property("run-out", found["run-out"])
    error = case.measures[0]
    assert found["run-out"] < 1.5
    assert abs(found[error.name]) > error.bound(n)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [27.5, 32.5])
def test_sand_of_another_angle_of_repose_runs_out_otherwise(backend_of: Callable, angle: float) -> None:
    """8 % of the angle change the run-out by 12 %, which is beyond the bound about its first-order law."""
    case, setting = all_cases()["sand_column_2"], Setting()
    n = case.levels["coarse"][0]
    tables = case.scene_tables(n, setting)
    tables["bodies"][0]["material"]["repose_angle"] = angle
    asked = parse_scene(tables, laws=parameter_models()).scene
    found = case.measure(n, asked, build_run(asked, backend_of("f64")).frames())
    refined = next(measure for measure in case.measures if measure.name == "run-out against refinement")
    assert abs(found[refined.name]) > refined.bound(n)
