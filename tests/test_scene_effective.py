"""The effective scene is the scene; the committed schema is the schema; every config is a scene."""

import json
import tomllib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import create_model
from scenes import ball, body, box, polygon

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import estimate_particles, json_schema, load_scene, parse_scene, sample_bodies, scene_to_toml
from mpmcli.scene.expand import PRESETS
from mpmcli.scene.quantity import Table
from mpmcli.scene.schema import scene_model

CONFIGS = Path(__file__).parent.parent / "configs"
SCENES = sorted(CONFIGS.glob("*.toml"))
LAWS = parameter_models()

walls = st.sampled_from(["slip", "stick", "separate"])
# Taichi may have switched off the numbers below 2.2e-308.
finite = st.floats(-1e6, 1e6, allow_subnormal=False)
names = st.from_regex(r"[A-Za-zäß][A-Za-zäß0-9_ -]{0,10}", fullmatch=True)


@st.composite
def materials(draw):
    if draw(st.booleans()):
        preset = draw(st.sampled_from(list(PRESETS)))
        return draw(st.sampled_from([preset, {"preset": preset}, {"preset": preset, "density": 123.4}]))
    if draw(st.booleans()):
        modulus = draw(st.one_of(st.just("auto"), st.floats(1e-3, 1e12)))
        return {"law": "fluid", "density": draw(st.floats(1e-3, 1e5)), "bulk_modulus": modulus}
    ratio = draw(st.floats(0, 0.49, allow_subnormal=False))
    return {"law": "neo_hookean", "density": 1.0, "youngs_modulus": draw(st.floats(1, 1e12)), "poissons_ratio": ratio}


@st.composite
def scenes(draw):
    """Draw parsed TOML of scenes: one body of any shape in a cube of ten cells a side."""
    d = draw(st.sampled_from([2, 3]))
    vector = st.lists(finite, min_size=d, max_size=d)
    h = draw(st.floats(1e-3, 1e3))
    origin = draw(st.lists(st.floats(-10, 10, allow_subnormal=False), min_size=d, max_size=d))

    def at(*shares):
        return [o + share * 10 * h for o, share in zip(origin, shares, strict=False)]

    shapes = [
        box(at(0.1, 0.2, 0.3), at(0.4, 0.5, 0.6)),
        ball(at(0.5, 0.5, 0.5), 4.5 * h),
        polygon([at(0.1, 0.1), at(0.9, 0.2), at(0.8, 0.9), at(0.5, 0.5)])
        if d == 2
        else {"cylinder": {"base": at(0.5, 0.5, 0.1), "axis": [0.1, 0, 1], "radius": h, "height": 4 * h}},
    ]
    body = {"name": draw(names), "material": draw(materials()), "shape": draw(st.sampled_from(shapes))}
    optional = {
        "velocity": vector,
        "velocity_gradient": st.lists(vector, min_size=d, max_size=d),
        "sampling": st.sampled_from(["jittered", "turned"]),
        "relaxed": st.booleans(),
        "particles_per_cell": st.sampled_from([1, 2**d, 3**d]),
        "seed": st.integers(0, 2**63 - 1),
    }
    body |= {key: draw(value) for key, value in optional.items() if draw(st.booleans())}
    domain = {"size": [10 * h] * d, "origin": origin, "walls": draw(walls)}
    domain |= {"cells": [10] * d} if draw(st.booleans()) else {"spacing": h}
    if draw(st.booleans()):
        domain |= {"gravity": draw(vector), "walls": {"default": draw(walls), "y_max": draw(walls)}}
    data = {
        "title": draw(st.text(st.characters(exclude_categories=["Cs"]), max_size=20)),
        "domain": domain,
        "time": {
            "end": draw(st.floats(1e-6, 1e6)),
            "frames": draw(st.integers(1, 10**9)),
            "step": draw(st.floats(1e-9, 1)),
        },
        "bodies": [body],
    }
    if draw(st.booleans()):
        data |= {"output": {"fields": ["stress", "mass"], "compress": True}, "solver": {"precision": "f64"}}
    return data


@given(scenes())
def test_loading_the_effective_scene_gives_the_same_scene(data):
    scene = parse_scene(data, laws=LAWS).scene
    text = scene_to_toml(scene)
    again = parse_scene(tomllib.loads(text), laws=LAWS, text=text)
    assert again.scene == scene
    assert again.notes == ()  # nothing is left to choose
    assert scene_to_toml(again.scene) == text


def test_a_new_list_of_tables_is_written_without_a_change_here():
    """The layout follows the model: a list of tables that the schema gains is read back as it was."""

    class Gadget(Table):
        center: tuple[float, float]
        keys: tuple[dict[str, float], ...] = ()

    extended = create_model("Extended", __base__=scene_model(LAWS), gadgets=(tuple[Gadget, ...], ()))
    tables = [{"center": [0.5, 0.25], "keys": []}, {"center": [0.0, 1.0], "keys": [{"t": 0.0, "x": 1.0}]}]
    scene = parse_scene(tomllib.loads((CONFIGS / "mixed_2d.toml").read_text(encoding="utf-8")), laws=LAWS).scene
    gadgets = tuple(map(Gadget.model_validate, tables))
    found = tomllib.loads(scene_to_toml(extended.model_construct(**dict(scene), gadgets=gadgets)))
    assert found.pop("gadgets") == tables
    assert found == tomllib.loads(scene_to_toml(scene))


def test_the_effective_scene_reads_well():
    scene = load_scene(CONFIGS / "dam_break_2d.toml", laws=LAWS).scene
    assert scene_to_toml(scene) == (
        """\
title = "Dam break, Martin and Moyce 1952, n^2 = 2"

[domain]
size = [6.0, 3.0]
origin = [0.0, 0.0]
spacing = 0.02
gravity = [0.0, -9.81]
walls = { default = "separate" }
friction = { default = 0.0 }

[time]
end = 1.5
frames = 150
step = "auto"
safety = 0.8

[[bodies]]
name = "column"
shape = { box = { min = [0.0, 0.0], max = [1.0, 2.0] } }
velocity = [0.0, 0.0]
sampling = "lattice"
relaxed = false
particles_per_cell = 4
seed = 0

[bodies.material]
law = "fluid"
density = 1000.0
bulk_modulus = 3924000.0
compressibility = 0.01
exponent = 1.0
viscosity = 0.0
bulk_viscosity = 0.0
tension_cutoff = true
volume_correction = true

[contact]
default = "auto"
pairs = []

[output]
fields = ["velocity", "density", "pressure"]
drop_retired = false
compress = false

[solver]
precision = "f32"
kernel = "quadratic"
transfer = "apic"
solids = "updated"
f_bar = "auto"
grid = "auto"
redistribute = "auto"
deterministic = false
"""
    )


def test_long_lists_are_one_entry_a_line():
    vertices = [[0.1 + 0.01 * i, 0.1 + 0.3 * (i % 2)] for i in range(20)] + [[0.5, 0.05]]
    data = {
        "domain": {"size": [1, 1], "spacing": 0.1},
        "time": {"end": 1, "frames": 1},
        "bodies": [body("saw", {"law": "fluid", "density": 1}, polygon(vertices))],
    }
    text = scene_to_toml(parse_scene(data, laws=LAWS).scene)
    assert max(map(len, text.splitlines())) < 110
    assert tomllib.loads(text)["bodies"][0]["shape"]["polygon"]["vertices"] == vertices


def test_there_are_scenes():
    assert {path.stem for path in SCENES} >= {
        "dam_break_2d",
        "dam_break_3d",
        "elliptical_drop_2d",
        "jelly_drop_2d",
        "jelly_drop_3d",
    }


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_every_config_loads(path):
    scene = load_scene(path, laws=LAWS).scene
    assert scene.title
    assert f"{scene.dimension}d" in path.stem
    particles = sum(body.count for body in sample_bodies(scene))
    assert 1000 < particles <= 100_000
    assert particles == pytest.approx(estimate_particles(scene), rel=0.01)


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_every_config_tells_editors_and_people_what_it_is(path):
    text = path.read_text(encoding="utf-8")
    assert text.startswith("#:schema ./scene.schema.json\n#\n# ")
    for heading in ("What you will see: ", "How long it takes: ", "Where it comes from: "):
        assert f"\n# {heading}" in text


def test_the_committed_schema_is_the_generated_one():
    committed = json.loads((CONFIGS / "scene.schema.json").read_text(encoding="utf-8"))
    assert committed == json_schema(LAWS), "run: mpmcli schema > configs/scene.schema.json"


def test_every_key_of_the_schema_is_described():
    schema = json_schema(LAWS)
    for table in (schema, *schema["$defs"].values()):
        assert table["additionalProperties"] is False
        for key, value in table["properties"].items():
            assert value.get("description") or "const" in value, f"{table['title']}.{key}"
    text = json.dumps(schema)
    # None of Python's own words: no null, and no range that pydantic could not translate.
    assert not any(f'"{word}"' in text for word in ("null", "gt", "ge", "lt", "le"))
    assert schema["$defs"]["FluidParameters"]["required"] == ["law", "density"]


def test_the_schema_takes_presets_laws_and_knobs():
    """A material is exactly one of: a preset's name, a law's table, a table of a preset of that law."""
    definitions = json_schema(LAWS)["$defs"]
    word, *tables = definitions["Body"]["properties"]["material"]["oneOf"]
    assert [one["const"] for one in word["oneOf"]] == list(PRESETS)
    assert all(one["description"] == PRESETS[one["const"]].shows for one in word["oneOf"])
    names = [table["$ref"].removeprefix("#/$defs/") for table in tables]
    assert {f"{law.__name__}" for law in LAWS} <= set(names)
    offered = [
        one["const"]
        for name in names
        if name.endswith("Presets")
        for one in definitions[name]["properties"]["preset"]["oneOf"]
    ]
    assert sorted(offered) == sorted(PRESETS)

    fluid, fluids = definitions["FluidParameters"], definitions["FluidPresets"]
    assert fluid["properties"].keys() - {"law"} == fluids["properties"].keys() - {"preset"}
    assert {"required": ["viscosity", "thickness"]} in [rule["not"] for rule in fluid["allOf"]]
    assert fluids["required"] == ["preset"] and fluids["allOf"] == fluid["allOf"]
    assert "0.001 to 100 Pa s, logarithmic" in fluid["properties"]["thickness"]["description"]
    # What a law needs may come from its knob, and a preset has it.
    solid, solids = definitions["NeoHookeanParameters"], definitions["NeoHookeanPresets"]
    assert solid["required"] == ["law", "density"]
    assert solid["allOf"] == [{"oneOf": [{"required": ["youngs_modulus"]}, {"required": ["springiness"]}]}]
    assert solids["allOf"] == [{"not": {"required": ["youngs_modulus", "springiness"]}}]


def test_scenes_of_the_same_laws_have_one_type():
    assert scene_model(LAWS) is scene_model(LAWS)
