"""Presets and knobs: what they become, what is said of them, and what is refused."""

import itertools
import tomllib

import pytest

from mpmcli.errors import InputError
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import LoadedScene, parse_scene, scene_to_toml
from mpmcli.scene.expand import PRESETS
from mpmcli.scene.material import Knob, knobs_of, unit_of

LAWS = {str(model.model_fields["law"].default): model for model in parameter_models()}
KNOBS = [(law, name) for law in sorted(LAWS) for name in knobs_of(LAWS[law])]
# A preset of each law that has one.
SAMPLES = {preset.law: name for name, preset in PRESETS.items()}

# The material stands on line 6.
SCENE = """\
domain = {{ size = {size}, spacing = 0.1, gravity = {gravity} }}
time = {{ end = 1.0, frames = 10 }}
[[bodies]]
name = "pool"
shape.box = {{ min = {low}, max = {high} }}
material = {material}
"""


def load(material: str, *overrides: str, dimension: int = 2) -> LoadedScene:
    """Load a block of a material under gravity, as from a file scene.toml."""
    lists = {"size": 1.0, "low": 0.2, "high": 0.7}
    fill = {name: [value] * dimension for name, value in lists.items()}
    text = SCENE.format(material=material, gravity=[0.0] * (dimension - 1) + [-9.81], **fill)
    data = tomllib.loads(text)
    loaded = parse_scene(data, laws=parameter_models(), source="scene.toml", text=text, overrides=overrides)
    assert data == tomllib.loads(text), "the caller's data changed"
    return loaded


def material_of(*arguments: str, dimension: int = 2):
    return load(*arguments, dimension=dimension).scene.bodies[0].material


def refusal(*arguments: str) -> list[str]:
    with pytest.raises(InputError) as refused:
        load(*arguments)
    return str(refused.value).splitlines()


def test_there_are_ten_presets_of_the_laws_that_are_there():
    names = ["water", "honey", "lava", "mud", "jelly", "rubber", "snow", "sand", "clay", "metal"]
    assert list(PRESETS) == names
    assert {preset.law for preset in PRESETS.values()} <= LAWS.keys()


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_says_what_it_shows_and_where_each_value_comes_from(name):
    preset = PRESETS[name]
    assert "\n" not in preset.shows and 20 < len(preset.shows) < 120
    assert "density" in preset.values
    for parameter, value in preset.values.items():
        assert parameter in LAWS[preset.law].model_fields, parameter
        assert len(value.source) > 20 and "://" not in value.source, parameter


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_its_law_with_its_values(name, dimension):
    """All ways to write it are the same, no "auto" is left, and the effective scene is the same scene."""
    loaded = load(f'"{name}"', dimension=dimension)
    material = loaded.scene.bodies[0].material
    assert material.law == PRESETS[name].law
    for parameter, value in PRESETS[name].parameters.items():
        if value == "auto":
            assert isinstance(getattr(material, parameter), float)
            assert any(note.startswith(f"pool: {parameter} = ") for note in loaded.notes)
        else:
            assert getattr(material, parameter) == value
    assert "auto" not in material.model_dump().values()
    assert material == material_of(f'{{ preset = "{name}" }}', dimension=dimension)

    text = scene_to_toml(loaded.scene)
    written = tomllib.loads(text)["bodies"][0]["material"]
    assert written.keys() == type(material).model_fields.keys() - type(material).sets.keys()
    again = parse_scene(tomllib.loads(text), laws=parameter_models(), text=text)
    assert again.scene == loaded.scene and again.notes == ()


@pytest.mark.parametrize(("law", "name"), KNOBS, ids=str)
def test_a_knob_runs_from_end_to_end(law, name):
    """Exactly its two ends, always in one direction, and back from the value to the position."""
    parameter, knob = knobs_of(LAWS[law])[name]
    assert name not in LAWS[law].model_fields and parameter in LAWS[law].model_fields
    assert (knob.value(0), knob.value(1)) == (knob.low, knob.high)
    positions = [k / 20 for k in range(21)]
    values = [knob.value(position) for position in positions]
    assert values == sorted(values, reverse=knob.high < knob.low) and len(set(values)) == 21
    assert [knob.position(value) for value in values] == pytest.approx(positions, abs=1e-12)
    steps = [b / a if knob.scale == "logarithmic" else b - a for a, b in itertools.pairwise(values)]
    assert steps == pytest.approx([steps[0]] * 20)
    assert knob.position(2 * max(knob.low, knob.high)) is None


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize(("law", "name"), KNOBS, ids=str)
def test_every_position_of_a_knob_is_a_material(law, name, dimension):
    parameter, knob = knobs_of(LAWS[law])[name]
    for position in (0, 0.5, 1):
        loaded = load(f'{{ preset = "{SAMPLES[law]}", {name} = {position} }}', dimension=dimension)
        value = getattr(loaded.scene.bodies[0].material, parameter)
        assert value == knob.value(position)
        unit = unit_of(LAWS[law].model_fields[parameter].description)
        sentence = f"pool: {name} = {position:g} sets {parameter} = {value:.3g} {unit}".rstrip()
        assert loaded.notes[0] == f"{sentence} (preset {SAMPLES[law]})"


def test_the_knobs_are_those_that_are_promised():
    assert {law: sorted(knobs_of(model)) for law, model in LAWS.items()} == {
        "fixed_corotated": ["springiness"],
        "fluid": ["stiffness", "thickness"],
        "neo_hookean": ["springiness"],
        "sand": ["grip", "stiffness"],
        "snow": ["hardness", "stiffness"],
        "viscoplastic": ["stiffness", "strength", "thickness"],
        "von_mises": ["hardness", "stiffness", "strength"],
    }


def test_what_the_scene_says_itself_wins_over_the_preset():
    material = material_of('{ preset = "honey", thickness = 0.7, density = 1400 }')
    # 1e-3 (1e2 / 1e-3)^0.7
    assert material.viscosity == pytest.approx(10**0.5) and material.density == 1400
    assert material_of('{ preset = "honey", viscosity = 3, bulk_modulus = 2e5 }').viscosity == 3


def test_a_knob_works_with_a_law_too():
    loaded = load('{ law = "neo_hookean", density = 1000, springiness = 0.5 }')
    assert loaded.scene.bodies[0].material.youngs_modulus == pytest.approx(1e5)
    assert loaded.notes == ("pool: springiness = 0.5 sets youngs_modulus = 1e+05 Pa",)


def test_a_choice_for_several_bodies_is_said_once():
    text = SCENE.format(
        size=[1.0, 1.0],
        gravity=[0.0, 0.0],
        low=[0.0, 0.0],
        high=[0.1, 0.1],
        material='{ preset = "jelly", springiness = 0.5 }',
    )
    data = tomllib.loads(text)
    boxes = [{"box": {"min": [0.1 * k, 0.0], "max": [0.1 * k + 0.1, 0.1]}} for k in range(8)]
    data["bodies"] = [data["bodies"][0] | {"name": f"b{k}", "shape": box} for k, box in enumerate(boxes)]
    (note,) = parse_scene(data, laws=parameter_models()).notes
    assert note.startswith("b0, b1, b2, b3, b4 and 3 more: springiness = 0.5 sets youngs_modulus = ")


def test_stiffness_makes_a_fluid_less_compressible_and_slower():
    soft, stiff = (material_of(f'{{ preset = "water", stiffness = {k} }}') for k in (0, 1))
    assert (soft.compressibility, stiff.compressibility) == (0.1, 1e-4)
    assert stiff.bulk_modulus == pytest.approx(1000 * soft.bulk_modulus)


def test_a_body_may_be_overridden_down_to_its_knobs():
    assert material_of('{ law = "fluid", density = 1 }', 'bodies.pool.material="honey"').viscosity == 10
    assert material_of('{ law = "fluid", density = 1 }', "bodies.pool.material=honey").viscosity == 10
    turned = material_of('"honey"', "bodies.pool.material.thickness=0", "bodies.pool.material.density=1300")
    assert (turned.viscosity, turned.density) == (1e-3, 1300)
    assert material_of('{ preset = "honey", thickness = 0.2 }', "bodies.pool.material.thickness=1").viscosity == 100


# A material as it is written, and what is said at its line.
REFUSED = [
    ('"hony"', 'material: unknown preset "hony"; did you mean "honey"? The presets are "water", "honey", "lava", '),
    ('"fluid"', 'material: "fluid" is a law, and needs its parameters: { law = "fluid", density = ... }'),
    ("3", "material: must be a preset in quotes, or a table with a law or a preset; found 3"),
    ('["honey"]', 'material: must be a preset in quotes, or a table with a law or a preset; found ["honey"]'),
    ("{}", "material.law: missing key: the constitutive law, "),
    ('{ preset = "hony" }', 'material.preset: unknown preset "hony"; did you mean "honey"? The presets are "water", '),
    ('{ preset = "fluid" }', 'material.preset: "fluid" is a law, and needs its parameters: '),
    ("{ preset = 3 }", "material.preset: must be text in quotes; found 3"),
    ('{ prest = "honey" }', 'material.prest: unknown key; did you mean "preset"?'),
    ('{ law = "honey" }', 'material.law: "honey" is a preset: write preset = "honey"'),
    ('{ law = "fluyd" }', 'material.law: unknown law "fluyd"; did you mean "fluid"? The laws are "fixed_corotated", '),
    ("{ law = [] }", "material.law: must be text in quotes; found []"),
    ('{ law = "fluid", preset = "honey" }',
     "material.law: the preset has a law of its own; leave either the law or the preset out"),
    ('{ preset = "honey", thickness = 1.5 }', "material.thickness: must be a number from 0 to 1; found 1.5"),
    ('{ preset = "honey", thickness = -0.1 }', "material.thickness: must be a number from 0 to 1; found -0.1"),
    ('{ preset = "honey", thickness = nan }', "material.thickness: must be a number from 0 to 1; found nan"),
    ('{ preset = "honey", thickness = true }', "material.thickness: must be a number from 0 to 1; found true"),
    ('{ preset = "honey", thickness = "much" }', 'material.thickness: must be a number from 0 to 1; found "much"'),
    ('{ preset = "honey", thicknes = 0.5 }', 'material.thicknes: unknown key; did you mean "thickness"?'),
    ('{ preset = "honey", viscosty = 0.5 }', 'material.viscosty: unknown key; did you mean "viscosity"?'),
    ('{ preset = "honey", viscosity = -1 }', "material.viscosity: must be at least 0; found -1"),
    ('{ preset = "rubber", poissons_ratio = 0.5 }', "material.poissons_ratio: must be less than 0.5; found 0.5"),
    ('{ preset = "honey", thickness = 0.5, viscosity = 3 }',
     "material.thickness: sets viscosity, which is given as well; leave one of them out"),
    ('{ preset = "water", stiffness = 0.5, bulk_modulus = 2e6 }',
     "material.stiffness: sets compressibility, which bulk_modulus = 2000000.0 overrules; leave one of them out"),
    ('{ preset = "honey", springiness = 0.5 }',
     'material.springiness: the law fluid has no knob "springiness"; its knobs are "stiffness" and "thickness"'),
    ('{ preset = "rubber", thickness = 0.5 }',
     'material.thickness: the law neo_hookean has no knob "thickness"; its knob is "springiness"'),
    ('{ preset = "rubber", viscosity = 0.5 }',
     'material.viscosity: the law neo_hookean has no parameter "viscosity"; its parameters are "density", '
     '"poissons_ratio", "surface_friction" and "youngs_modulus"'),
    ('{ law = "neo_hookean", density = 1 }',
     "material.youngs_modulus: missing key: Young's modulus E, Pa; or its knob springiness, 0 to 1"),
]  # fmt: skip


@pytest.mark.parametrize(("material", "sentence"), REFUSED, ids=[material for material, _ in REFUSED])
def test_each_bad_material_has_its_sentence(material, sentence):
    (line,) = refusal(material)
    assert line.startswith(f"scene.toml:6: bodies[0].{sentence}")


def test_all_faults_of_a_material_come_at_once_each_at_its_line():
    text = '"honey"\n[[bodies]]\nname = "b"\nshape.ball = { center = [0.8, 0.8], radius = 0.1 }\n[bodies.material]\n'
    text += 'preset = "honey"\nthicknes = 2\nviscosity = 1\ndensty = -1\nstiffness = 7'
    assert refusal(text) == [
        'scene.toml:12: bodies[1].material.thicknes: unknown key; did you mean "thickness"?',
        'scene.toml:14: bodies[1].material.densty: unknown key; did you mean "density"?',
        "scene.toml:15: bodies[1].material.stiffness: must be a number from 0 to 1; found 7",
    ]


def test_a_fault_of_an_override_names_the_override():
    assert refusal('"honey"', "bodies.pool.material.thickness=3") == [
        "--set bodies.pool.material.thickness=3: bodies[0].material.thickness: must be a number from 0 to 1; found 3"
    ]
    (line,) = refusal('"water"', "bodies.pool.material=hony")
    assert line.startswith('--set bodies.pool.material=hony: bodies[0].material: unknown preset "hony"; did you mean')
    assert refusal('{ preset = "honey", viscosity = 1 }', "bodies.pool.material.thickness=0.3") == [
        "--set bodies.pool.material.thickness=0.3: bodies[0].material.thickness: sets viscosity, which is given as "
        "well; leave one of them out"
    ]
    assert refusal('{ preset = "honey" }', "bodies.pool.material.density=0") == [
        "--set bodies.pool.material.density=0: bodies[0].material.density: must be greater than 0; found 0"
    ]


def test_a_fault_of_the_parameter_that_a_knob_set_is_told_at_the_knob():
    """Should a law refuse what a knob gives, in 2D say, the user is not told of a key that he never wrote."""
    from typing import Annotated, Literal

    from pydantic import Field

    from mpmcli.scene.material import MaterialParameters

    class Narrow(MaterialParameters):
        law: Literal["narrow"] = "narrow"
        width: Annotated[float, Field(lt=5, description="Width, m."), Knob("breadth", 1, 10, "0 is narrow")] = 1.0

    data = tomllib.loads(
        SCENE.format(
            material='{ law = "narrow", density = 1, breadth = 1 }',
            size=[1.0, 1.0],
            gravity=[0.0, 0.0],
            low=[0.2, 0.2],
            high=[0.7, 0.7],
        )
    )
    with pytest.raises(InputError) as refused:
        parse_scene(data, laws=(Narrow,))
    assert str(refused.value) == "<scene>: bodies[0].material.breadth: must be less than 5; found 10.0"


def test_a_logarithmic_knob_has_no_end_at_zero():
    with pytest.raises(ValueError, match="both of its ends must be greater than 0"):
        Knob("wrong", 0.0, 1.0, "0 is nothing")


@pytest.mark.parametrize(("description", "unit"), [
    ("Young's modulus E, Pa.", "Pa"),
    ("Viscosity, Pa s; water 1e-3.", "Pa s"),
    ("Consistency, Pa s^n: the stress at unit rate.", "Pa s^n"),
    ("Density at rest, kg/m^3.", "kg/m^3"),
    ('Angle, degrees; "auto" is none.', "degrees"),
    ("Speed, m/s", "m/s"),
    ("Rate, 1/s (engineering).", ""),
    ("A fraction, 0 to 1.", ""),
    ("Poisson's ratio, between -1 and 0.5, both excluded.", ""),
    (None, ""),
])  # fmt: skip
def test_units_are_read_from_descriptions(description, unit):
    assert unit_of(description) == unit
