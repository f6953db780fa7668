"""`check RESULT` counts particles of liquids and grains in cells: crowds, and holes that they leave."""

import numpy as np
import pytest
from solver_state import scene_of
from test_check_stretch import header_of

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_state import CrowdCheck
from mpmcli.frames.frame import Frame
from mpmcli.scene import Scene, sample_bodies

H = 0.1
WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}


def pool(per_cell: int = 4) -> Scene:
    """Return a pool of 20 x 8 cells between three walls."""
    body = {"name": "pool", "material": WATER, "shape": {"box": {"min": [0.0, 0.0], "max": [2.0, 0.8]}}}
    return scene_of(
        domain={"size": [2.0, 1.6], "spacing": H, "walls": "separate"},
        time={"end": 1.0, "frames": 1},
        bodies=[body | {"particles_per_cell": per_cell}],
    )


def checked(scene: Scene, places: list[np.ndarray], law: str = "fluid") -> tuple[CrowdCheck, list]:
    findings = FrameFindings()
    check = CrowdCheck(header_of(scene, law), findings, len(places) - 1)
    for k, x in enumerate(places):
        label = np.zeros(len(x), np.int32)
        check.check(Frame(k, 0.1 * k, 10 * k, x, np.zeros_like(x), label, label))
    return check, list(findings.found())


@pytest.mark.parametrize("sampling", ["lattice", "jittered"])
def test_a_pool_at_rest_has_no_crowds(sampling: str) -> None:
    scene = pool()
    scene = scene.model_copy(update={"bodies": (scene.bodies[0].model_copy(update={"sampling": sampling}),)})
    check, found = checked(scene, [sample_bodies(scene)[0].position])
    assert (check.figures, found) == ({"densest_cell": 1.0, "empty_cells": 0.0}, [])


def test_rows_that_pile_up_are_told() -> None:
    """Five columns of cells on one: five times as full, and of five inside four are empty, at walls too.

    What only closes up by a half, or lies a lattice apart elsewhere, is none of it.
    """
    scene = pool()
    x = sample_bodies(scene)[0].position
    piled = x.copy()
    piled[:, 0] = (np.floor(x[:, 0] / (5 * H)) + 0.4 + 0.2 * (x[:, 0] / H % 1)) * 5 * H
    check, found = checked(scene, [x, piled])
    assert check.figures["densest_cell"] == pytest.approx(5.0)
    # Windows of five cells are as full as before.
    assert check.figures["empty_cells"] == pytest.approx(0.8, abs=0.02)
    assert [(one.rule, one.severity, one.frame) for one in found] == [("crowd", "note", 1)]
    assert checked(scene, [x * [0.6, 1.0] + [0.3, 0.03]])[1] == []
    assert checked(scene, [piled], "neo_hookean")[1] == []


@pytest.mark.parametrize(("viscosity", "mean", "fires"), [(1.0, 1.25, True), (1.0, 1.15, False), (0.0, 1.25, False)])
def test_a_viscous_liquid_that_sprays_is_told(viscosity: float, mean: float, fires: bool) -> None:
    scene = pool()
    material = scene.bodies[0].material.model_copy(update={"viscosity": viscosity})
    scene = scene.model_copy(update={"bodies": (scene.bodies[0].model_copy(update={"material": material}),)})
    x, findings = sample_bodies(scene)[0].position, FrameFindings()
    label, J = np.zeros(len(x), np.int32), np.full(len(x), 1.0)
    J[::2] += 2 * (mean - 1)
    frame = Frame(0, 0.0, 0, x, x, label, label, {"volume_ratio": J})
    CrowdCheck(header_of(scene, "fluid"), findings, 0).check(frame)
    assert [one.rule for one in findings.found()] == ["spray"] * fires


def test_a_few_frames_and_the_last_are_counted() -> None:
    scene = pool()
    x = sample_bodies(scene)[0].position
    piled = np.where([True, False], np.floor(x / H) * H + 0.5 * H * 0.9, x)
    piled[:, 0] = 0.55
    assert checked(scene, [x] * 30 + [piled])[1][0].frame == 30
    assert checked(scene, [piled] * 2)[1][0].frame == 0
    assert checked(pool(per_cell=1), [piled])[1] == []
