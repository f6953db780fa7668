"""Scenes for the tests of checks, in few words: one block of a material, loaded as a file would be."""

from typing import Any

from scenes import body, box
from solver_state import scene_of

from mpmcli.check.finding import Finding
from mpmcli.check.scene_check import SceneCheck, check_scene
from mpmcli.scene import LoadedScene, Scene
from mpmcli.scene.shapes import Form

FLUID = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e6}
SOLID = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e6}


def loaded(
    bodies: list[dict] | None = None, *, material: dict = FLUID, shape: dict | None = None, **keys: Any
) -> LoadedScene:
    """Return a scene: by default a block of 16 x 16 cells of fluid on the floor of 64 x 64 cells, h = 1/64 m.

    What is no table of a scene is a key of the block.
    """
    domain = {"size": [1.0, 1.0], "cells": [64, 64], "gravity": [0.0, -10.0], "walls": "slip"}
    asked = {name: keys.pop(name) or {} for name in Scene.model_fields if name in keys}
    domain, time = domain | asked.pop("domain", {}), {"end": 0.5, "frames": 10} | asked.pop("time", {})
    own = body("block", material, shape or box([0.25, 0.0], [0.5, 0.25]), **keys)
    scene = scene_of(*bodies or [own], domain=domain, time=time, **{"contact": {}} | asked)
    return LoadedScene(scene, (), "scene.toml")


def check(*arguments: Any, **keywords: Any) -> SceneCheck:
    """Return the check of such a scene."""
    return check_scene(loaded(*arguments, **keywords))


def found(rule: str, *arguments: Any, **keywords: Any) -> list[Finding]:
    """Return what one rule finds in such a scene."""
    return [finding for finding in check(*arguments, **keywords).findings if finding.rule == rule]


def forms_of(scene: Scene) -> list[Form]:
    """Return the shapes of the bodies of a scene."""
    return [body.shape.form for body in scene.bodies]
