"""The table of what kernels cost: every law is in it, costs add up, and the cheaper kernels are taken."""

import pytest
from good_scene import GOOD, load
from scenes import body, scene_of

from mpmcli.check.scene_check import check_scene
from mpmcli.materials.registry import laws
from mpmcli.scene import LoadedScene, Scene
from mpmcli.solver.engine.run import backend_for
from mpmcli.solver.machine.costs import _table, cheapest, cost_of

WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e4}
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 1e7, "friction_angle": 30.0}
JET = """\
[[emitters]]
name = "jet"
material = "water"
shape = { box = { min = [2.0, 1.5], max = [2.2, 1.6] } }
velocity = [0.0, -2.0]
"""
POST = '[[colliders]]\nname = "post"\nshape = { ball = { center = [3.9, 0.1], radius = 0.05 } }\n'


def dam(*materials: dict, d: int = 2, n: int = 16) -> Scene:
    """Return blocks of these materials, side by side."""
    boxes = [{"min": [0.25 * k] + [0.0] * (d - 1), "max": [0.25 * (k + 1)] + [0.5] * (d - 1)} for k in range(2)]
    bodies = [
        body(f"b{k}", material, {"box": box}) for k, (material, box) in enumerate(zip(materials, boxes, strict=False))
    ]
    return scene_of(*bodies, domain={"size": [1.0] * d, "cells": [n] * d}, frames=10)


def test_every_law_is_in_the_table() -> None:
    table = _table()["laws"]
    assert table.keys() == laws().keys()
    for entry in table.values():
        for few, most in zip(entry["few"], entry["most"], strict=True):
            # More optimisation takes longer to compile, but for noise, and makes faster steps.
            assert 0 < few[0] < 1.1 * most[0] and 0 < most[1] <= few[1]


@pytest.mark.parametrize("d", [2, 3])
def test_a_step_costs_as_many_particles_as_there_are(d: int) -> None:
    one, finer, both = (
        cost_of(scene, "most") for scene in (dam(WATER, d=d), dam(WATER, d=d, n=32), dam(WATER, SAND, d=d))
    )
    assert finer.step == pytest.approx(2**d * one.step) and finer.compile == one.compile
    sand = cost_of(dam(SAND, d=d), "most")
    assert both.step == pytest.approx(one.step + sand.step)
    assert max(one.compile, sand.compile) < both.compile < one.compile + sand.compile


def test_what_stands_beside_costs_more() -> None:
    alike = GOOD + '[contact]\ndefault = "stick"\n'
    plain = cost_of(load(alike).scene, "most")
    for text in (alike + JET, alike + POST, alike + POST + "density = 1000.0\n"):
        cost = cost_of(load(text).scene, "most")
        assert cost.compile > plain.compile and cost.step > 0.9 * plain.step
    cubic = load(alike + '[solver]\nkernel = "cubic"\n')
    assert cost_of(cubic.scene, "most").step == pytest.approx(plain.step * 16 / 9)


def test_kernels_are_optimised_where_that_pays() -> None:
    """At the number of steps at which both take as long, and from there on, threads or not."""
    scene = dam(SAND, d=3)
    few, most = cost_of(scene, "few"), cost_of(scene, "most")
    even = (most.compile - few.compile) / (few.step - most.step)
    assert cheapest(scene, int(0.9 * even), 1) == "few" and cheapest(scene, int(1.1 * even) + 1, 1) == "most"
    assert cheapest(scene, int(1.1 * even) + 1, 4) == "few"
    assert backend_for(scene, lambda: 10, "cpu", 1).optimisation == "few"
    assert backend_for(scene, lambda: 10**6, "cpu", 1).optimisation == "most"


def test_a_forecast_is_the_cost_of_its_steps() -> None:
    scene = dam(WATER, SAND)
    check = check_scene(LoadedScene(scene, (), "dam.toml"), threads=1)
    forecast = check.forecast
    cost = cost_of(scene, cheapest(scene, forecast.steps, 1))
    assert forecast.step_seconds == cost.step and not forecast.measured
    assert forecast.seconds == pytest.approx(cost.seconds(forecast.steps, 1), abs=2.0)
    said, stored = check.outlook(stored=False), check.outlook(stored=True)
    assert f"{forecast.steps:,} steps of about" in said and "by the wave limit of" in said
    assert "s of it to compile" in said and "its kernels are stored" in stored
