"""`mpmcli materials`: every law and preset with its units, ranges, defaults, sources and knobs."""

import json

import pytest
from command import run_here

from mpmcli.materials.registry import laws
from mpmcli.scene.expand import PRESETS


def facts(*arguments: str) -> dict:
    outcome = run_here("materials", *arguments, "--json")
    assert outcome.status == 0 and outcome.stderr == ""
    return json.loads(outcome.stdout)


def text(*arguments: str) -> str:
    outcome = run_here("materials", *arguments)
    assert outcome.status == 0 and outcome.stderr == ""
    return outcome.stdout


def test_everything_is_listed():
    everything = facts()
    assert [law["name"] for law in everything["laws"]] == sorted(laws())
    assert [preset["name"] for preset in everything["presets"]] == list(PRESETS)
    told = text()
    for law in everything["laws"]:
        assert f"\n{law['name']}: {law['summary']}\n" in told
        assert law["summary"] and law["parameters"][0] == {
            "name": "density",
            "unit": "kg/m^3",
            "range": "> 0",
            "default": None,
            "description": "Density at rest, kg/m^3.",
        }
        for parameter in law["parameters"]:
            assert parameter["range"] != "any" and parameter["description"], parameter["name"]
            assert f"\n{parameter['name']} " in told
    for preset in everything["presets"]:
        assert f"\n{preset['name']} " in told and preset["shows"] in told


def test_parameters_have_the_units_of_their_descriptions():
    units = {
        (law["name"], parameter["name"]): parameter["unit"]
        for law in facts()["laws"]
        for parameter in law["parameters"]
        if parameter["unit"]
    }
    by_name: dict[str, set[str]] = {}
    for (_, name), unit in units.items():
        by_name.setdefault(name, set()).add(unit)
    assert by_name == {
        "density": {"kg/m^3"},
        "bulk_modulus": {"Pa"},
        "viscosity": {"Pa s"},
        "bulk_viscosity": {"Pa s"},
        "youngs_modulus": {"Pa"},
        "shear_modulus": {"Pa"},
        "yield_stress": {"Pa"},
        "hardening_modulus": {"Pa"},
        "cohesion": {"Pa"},
        "consistency": {"Pa s^n"},
        "friction_angle": {"degrees"},
        "friction_delay": {"s"},
        "repose_angle": {"degrees"},
    }


def test_ranges_are_written_as_formulas():
    (fluid,) = facts("fluid")["laws"]
    ranges = {parameter["name"]: (parameter["range"], parameter["default"]) for parameter in fluid["parameters"]}
    assert ranges["bulk_modulus"] == ('> 0 or "auto"', "auto")
    assert ranges["compressibility"] == ("> 0, <= 0.1", 0.01)
    assert ranges["viscosity"] == (">= 0", 0.0)
    assert ranges["tension_cutoff"] == ("true or false", True)
    thickness = next(knob for knob in fluid["knobs"] if knob["name"] == "thickness")
    expected = {"sets": "viscosity", "unit": "Pa s", "low": 1e-3, "high": 1e2, "scale": "logarithmic"}
    assert {key: thickness[key] for key in expected} == expected


def test_one_preset_is_shown_with_its_sources():
    shown = facts("honey")
    assert shown["laws"] == []
    (honey,) = shown["presets"]
    assert (honey["law"], honey["shows"]) == ("fluid", PRESETS["honey"].shows)
    values = {value["name"]: value for value in honey["values"]}
    assert (values["viscosity"]["value"], values["viscosity"]["unit"]) == (10.0, "Pa s")
    assert all(value["source"] for value in values.values())
    # 1e-3 (1e5)^0.8 = 10
    assert {knob["name"]: knob["position"] for knob in honey["knobs"]}["thickness"] == pytest.approx(0.8)
    told = text("honey")
    assert told.startswith("\npreset honey, of the law fluid: ") and "White 1975" in told
    assert not any(line.endswith(" ") for line in told.splitlines())


def test_a_name_of_both_a_law_and_a_preset_shows_both():
    shown = facts("sand")
    assert [law["name"] for law in shown["laws"]] == [preset["name"] for preset in shown["presets"]] == ["sand"]
    told = text("sand")
    assert "\nsand: " in told and "\npreset sand, of the law sand: " in told


def test_internal_variables_are_told_as_output_fields():
    (law,) = facts("von_mises")["laws"]
    assert [(field["name"], field["dimensions"]) for field in law["fields"]] == [
        ("plastic_strain", [2, 3]),
        ("elastic_strain_zz", [2]),
    ]
    assert "output field elastic_strain_zz (2D only): " in text("von_mises")


@pytest.mark.parametrize(
    ("name", "sentence"),
    [
        ("hony", 'there is no law or preset "hony"; did you mean "honey"?'),
        ("neo_hokean", 'there is no law or preset "neo_hokean"; did you mean "neo_hookean"?'),
        ("porridge", 'there is no law or preset "porridge"; there are "fixed_corotated", '),
    ],
)
def test_an_unknown_name_is_refused(name, sentence):
    outcome = run_here("materials", name)
    assert outcome.status == 2 and outcome.stdout == ""
    assert outcome.stderr.startswith(f"error: {sentence}") and outcome.stderr.count("\n") == 1


def test_the_command_explains_itself():
    outcome = run_here("materials", "--help")
    assert outcome.status == 0 and outcome.stdout.startswith("Usage: mpmcli materials")
