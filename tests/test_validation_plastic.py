"""What the validation cases of sand and snow compare with, against independent numbers."""

from collections.abc import Callable

import numpy as np
import pytest

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene
from mpmcli.solver.solver import Solver
from mpmcli.validation.cases import all_cases
from mpmcli.validation.cases.snow_oedometer import DENSITY, DEPTH, PULL, confined_height, confined_stress
from mpmcli.validation.setting import Setting


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


@pytest.mark.slow
def test_steep_sand_is_rejected_by_the_band_of_the_column(backend_of: Callable, record_property: Callable) -> None:
    """A friction angle of 63 degrees runs out to half of the lower end of the band (docs/theory.md, 10)."""
    case, setting = all_cases()["sand_column_2"], Setting()
    n = case.levels["coarse"][0]
    tables = case.scene_tables(n, setting)
    tables["bodies"][0]["material"]["friction_angle"] = 63.0
    asked = parse_scene(tables, laws=parameter_models()).scene
    found = case.measure(n, asked, Solver(asked, backend_of("f64")).frames())
    record_property("run-out", found["run-out"])
    error = case.measures[0]
    assert found["run-out"] < 1.5
    assert abs(found[error.name]) > error.bound(n)
