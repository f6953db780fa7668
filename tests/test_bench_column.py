"""The column of a law that the benchmark profiles."""

from typing import Annotated, Literal

import pytest
from pydantic import Field

from mpmcli.bench.cases import BenchCase
from mpmcli.bench.column import COLUMN_CASES, column_of, material_of
from mpmcli.errors import RunError
from mpmcli.materials.law import StateBound
from mpmcli.materials.registry import laws, parameter_models
from mpmcli.scene import estimate_particles, parse_scene
from mpmcli.scene.bounds import scene_bounds
from mpmcli.scene.material import Knob, MaterialParameters
from mpmcli.scene.quantity import Positive
from mpmcli.stability.limits import mode_limit


@pytest.mark.parametrize("case", COLUMN_CASES, ids=lambda case: case.name)
@pytest.mark.parametrize("law", sorted(laws()))
def test_the_step_is_far_from_the_limit_of_every_law_at_rest(law: str, case: BenchCase) -> None:
    """So that one step serves all, with room for what stiffens under load; and each has as many particles."""
    column = parse_scene(column_of(law, case, "f32"), laws=parameter_models(), source="bench").scene
    assert estimate_particles(column) == case.particles
    parameters, _ = column.bodies[0].material.resolve(scene_bounds(column))
    modes = laws()[law]((parameters,), case.dimension).modes(parameters, StateBound())
    limits = [
        mode_limit(column.domain.spacing, parameters.density, mode.stiffness, mode.viscosity)[0] for mode in modes
    ]
    assert 4 * case.step < min(limits) < 8 * case.step


def test_every_law_has_the_same_density_and_stiffness() -> None:
    found = [material_of(model) for model in parameter_models()]
    assert {material["density"] for material in found} == {1000}
    assert {material[key] for material in found for key in ("youngs_modulus", "bulk_modulus") if key in material} == {
        4e5
    }
    assert {material["law"] for material in found} == set(laws())


def test_a_parameter_that_must_be_given_is_taken_from_its_knob() -> None:
    class Parameters(MaterialParameters):
        law: Literal["slime"] = "slime"
        stickiness: Annotated[Positive, Field(description="Pa."), Knob("stick", 1.0, 100.0, "0 is dry")]

    assert material_of(Parameters) == {"law": "slime", "density": 1000.0, "stickiness": pytest.approx(10.0)}


def test_without_a_knob_the_law_is_named() -> None:
    class Parameters(MaterialParameters):
        law: Literal["slime"] = "slime"
        stickiness: Annotated[Positive, Field(description="Pa.")]

    with pytest.raises(RunError, match='The law "slime" needs stickiness'):
        material_of(Parameters)


def test_a_law_that_is_not_there() -> None:
    with pytest.raises(RunError, match="no law jam"):
        column_of("jam", COLUMN_CASES[0], "f32")
