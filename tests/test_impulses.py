"""Impulses: the momentum that they give is their integral over what they reach."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, scene_of

from mpmcli.scene import sample_bodies
from mpmcli.scene.entry import value_of
from mpmcli.solver.engine.run import build_run
from mpmcli.solver.machine.backend import Backend

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e4, "poissons_ratio": 0.3}
PUSH = {"start": 0.0107, "center": [0.5, 0.5], "radius": 0.1}


def test_the_momentum_is_the_integral(backend_of: Callable[..., Backend]) -> None:
    """Of what is at rest, sum m w(|X - c|): to 1e-9, the way that it goes in a thousandth of a frame's interval."""
    scene = scene_of(
        solver={"precision": "f64"},
        domain={"size": [1.0, 1.0], "cells": [40, 40]},
        time={"end": 0.02, "frames": 2},
        bodies=[block("b", JELLY, [0.3, 0.3], [0.7, 0.7])],
        impulses=[
            {**PUSH, "strength": 1.0, "direction": [2.0, 0.0]},
            {**PUSH, "strength": -0.5, "direction": [0.0, 1.0], "falloff": "gaussian", "body": "b"},
            # From the centre: none in all.
            {**PUSH, "strength": 0.3, "falloff": "none"},
        ],
    )
    (body,) = sample_bodies(scene)
    r = np.linalg.norm(body.position - 0.5, axis=1) / 0.1
    linear, gauss = np.clip(1 - r, 0, None), np.exp(-4.5 * r**2) * (r < 1)
    rows = [row for _, row in build_run(scene, backend_of("f64", 1)).frames()]
    assert rows[1].linear_momentum == (0.0, 0.0)
    expected = body.mass * np.array([linear.sum(), -0.5 * gauss.sum()])
    assert np.array(rows[2].linear_momentum) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("direction", [[3.0, 4.0], [-5.0, 12.0, 2.0], [0.0, 1e-3]])
def test_a_direction_of_any_length_pushes_by_the_strength(direction: list[float]) -> None:
    d = len(direction)
    place = [0.5] * d
    scene = scene_of(
        block("b", JELLY, [0.3] * d, [0.7] * d),
        domain={"size": [1.0] * d, "cells": [8] * d},
        frames=2,
        impulses=[{**PUSH, "end": 0.5, "center": place, "strength": 2.0, "direction": direction, "falloff": "none"}],
    )
    at = dict(zip("xyz", place, strict=False)) | {"t": 0.2}
    found = [float(value_of(entry, **at)) for entry in scene.pushes[0].acceleration]
    expected = 2.0 / (0.5 - PUSH["start"]) * np.array(direction) / np.linalg.norm(direction)
    assert found == pytest.approx(expected, rel=1e-12)
