"""What a scene may say about periodic faces and walls that move, and the sentences for what it may not."""

import pytest
from scenes import block, scene_of

from mpmcli.errors import MpmcliError
from mpmcli.scene import Scene

ROD = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}


def scene(cells: int = 10, solver: dict | None = None, **domain: object) -> Scene:
    return scene_of(
        block("rod", ROD, [0.0, 0.0], [0.1 * cells, 0.5]),
        domain={"size": [0.1 * cells, 1.0], "spacing": 0.1, **domain},
        solver=solver or {},
    )


def test_faces_have_their_velocities() -> None:
    domain = scene(walls="stick", wall_velocity={"y_max": [3.0, 0.0], "x_min": [0.0, -4.0]}).domain
    assert domain.wall_velocities == (((0.0, -4.0), (0.0, 0.0)), ((0.0, 0.0), (3.0, 0.0)))
    assert domain.wall_speed == 4.0 and domain.periodic == (False, False)
    assert scene(walls={"default": "slip", "x_min": "periodic", "x_max": "periodic"}).domain.periodic == (True, False)


@pytest.mark.parametrize(("domain", "said"), [
    ({"walls": {"default": "slip", "x_min": "periodic"}},
     'domain.walls.x_min: is "periodic" and x_max is "slip": material that leaves through one face enters '
     'through the other, so that both need "periodic"'),
    ({"walls": {"y_max": "periodic"}}, 'domain.walls.y_max: is "periodic" and y_min is "separate"'),
    ({"walls": "periodic", "cells": 6}, 'domain.walls: has "periodic" for faces with 6 cells between them; they'),
    ({"walls": "periodic", "friction": 0.5},
     'domain.friction: is for walls that can slip, and domain.walls has "per'),
    ({"walls": {"default": "periodic", "y_min": "slip", "y_max": "slip"}, "friction": {"x_min": 0.5}},
     'domain.friction.x_min: is for a wall that can slip, and domain.walls has "periodic" for x_min'),
    ({"walls": "stick", "wall_velocity": {"y_max": [1.0]}}, "domain.wall_velocity.y_max: needs two numbers"),
    ({"walls": "stick", "wall_velocity": {"y_max": [1.0, 0.5]}},
     "domain.wall_velocity.y_max: is along the wall, so that its entry 2, through it, must be 0; found 0.5"),
    ({"walls": "slip", "wall_velocity": {"y_max": [1.0, 0.0]}},
     'domain.wall_velocity.y_max: acts on nothing: domain.walls has "slip" for y_max, without friction'),
    ({"walls": "periodic", "wall_velocity": {"x_max": [0.0, 1.0]}},
     'domain.wall_velocity.x_max: is for a wall, and domain.walls has "periodic" for x_max; leave it out'),
    ({"wall_velocity": {"z_max": [0.0, 1.0]}}, "domain.wall_velocity.z_max: is a face of a 3D scene"),
    ({"wall_velocity": {"lid": [0.0, 1.0]}}, "domain.wall_velocity.lid: unknown key"),
    ({"walls": "periodic", "solver": {"solids": "total"}},
     'solver.solids: "total" keeps bodies whole on a grid that does not repeat'),
], ids=lambda value: None if isinstance(value, dict) else value[:40])  # fmt: skip
def test_faults_are_named(domain: dict, said: str) -> None:
    with pytest.raises(MpmcliError) as caught:
        scene(**domain)
    assert said in str(caught.value)
