"""Any boundary takes part in the node update: after momentum became velocity, before mirror images are written."""

from collections.abc import Callable

import numpy as np
import pytest
import taichi as ti
from solver_state import scene_of

from mpmcli.solver.engine.build import build_run
from mpmcli.solver.transfer.node_update import NodeUpdate
from mpmcli.solver.transfer.splines import PAD

CELLS, FROM = 16, 8


@ti.data_oriented
class Plate:
    """Holds all nodes from the plane of the FROM-th node along x on at rest."""

    @ti.func
    def constrain(self, node: ti.template(), velocity: ti.template()):
        """Return no velocity beyond the plane, and the velocity as it is elsewhere."""
        result = velocity
        if node[0] >= PAD + FROM:
            for a in ti.static(range(2)):
                result[a] = 0.0
        return result


class WithPlate(NodeUpdate):
    """A node update with the plate beside its own boundaries, in the view of each run, too."""

    @property
    def boundaries(self) -> tuple[object, ...]:
        """All boundaries."""
        return (*self._given, Plate())

    @boundaries.setter
    def boundaries(self, given: tuple[object, ...]) -> None:
        self._given = given


def test_a_boundary_acts_on_nodes_and_on_their_images(
    backend_of: Callable, monkeypatch: pytest.MonkeyPatch, own_kernels: None
) -> None:
    """Water slides along the floor into a plate: nodes and ghost nodes beyond it rest, and the others move."""
    monkeypatch.setattr("mpmcli.solver.engine.batch.NodeUpdate", WithPlate)
    water = {"law": "fluid", "density": 1000.0, "bulk_modulus": 2e4}
    box = {"min": [0.2, 0.0], "max": [0.8, 0.3]}
    scene = scene_of(
        domain={"size": [1.0, 1.0], "cells": [CELLS, CELLS], "walls": "slip"},
        time={"end": 1.0, "frames": 1},
        bodies=[{"name": "water", "material": water, "shape": {"box": box}, "velocity": [1.0, 0.0]}],
    )
    run = build_run(scene, backend_of("f32"))
    run.step(1e-3)
    nodes = run.grid.nodes.to_numpy().reshape(*run.grid.shape, -1)
    speed = np.linalg.norm(nodes[..., :2], axis=-1)
    # The nodes within the block, the ghost nodes behind the floor, and those on and above it.
    for rows in (slice(PAD - 2, PAD), slice(PAD, PAD + 4)):
        assert (speed[PAD + FROM : PAD + 12, rows] == 0).all()
        assert (speed[PAD + 4 : PAD + FROM, rows] > 0.9).all()
