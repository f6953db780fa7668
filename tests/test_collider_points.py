"""Liquids and sand at colliders: they come down and lie where the surface is, wherever the nodes are, and stay out."""

from collections.abc import Callable

import numpy as np
import pytest
from solver_state import scene_of

from mpmcli.scene import Scene
from mpmcli.solver.engine.run import build_run

H, G = 0.05, 9.81
WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 4e5}
SAND = {"law": "sand", "density": 1600.0, "youngs_modulus": 3e5, "poissons_ratio": 0.3, "friction_angle": 35.0}


def falling(
    material: dict,
    offset: float,
    *,
    dimension: int = 2,
    rows: int = 8,
    thickness: float = 6.0,
    kernel: str = "quadratic",
) -> tuple[Scene, float]:
    """Return rows of cells of a material 3 cells above a plate across the domain, and the height of the plate.

    The top of the plate is `offset` cells above a node.
    """
    across, z = [(24 if dimension == 2 else 8) * H] * (dimension - 1), (8 + offset) * H
    body = {"min": [0.0] * (dimension - 1) + [z + 3 * H], "max": [*across, z + (3 + rows) * H]}
    plate = {"min": [-H] * (dimension - 1) + [z - thickness * H], "max": [x + H for x in across] + [z]}
    return scene_of(
        domain={
            "size": [*across, (14 + rows) * H],
            "spacing": H,
            "gravity": [0.0] * (dimension - 1) + [-G],
            "walls": {"default": "slip", ("y_max", "z_max")[dimension - 2]: "separate"},
        },
        time={"end": 1.5, "frames": 30},
        solver={"kernel": kernel},
        bodies=[{"name": "body", "material": material, "shape": {"box": body}}],
        colliders=[{"name": "plate", "shape": {"box": plate}}],
    ), z


@pytest.mark.parametrize(
    ("material", "offset", "options"),
    [
        (WATER, 0.0, {}),
        (WATER, 0.3, {}),
        (WATER, 0.5, {}),
        (SAND, 0.0, {}),
        (SAND, 0.4, {}),
        pytest.param(WATER, 0.25, {"dimension": 3}, marks=pytest.mark.slow),
        pytest.param(SAND, 0.25, {"dimension": 3}, marks=pytest.mark.slow),
        pytest.param(WATER, 0.25, {"kernel": "cubic"}, marks=pytest.mark.slow),
    ],
)
def test_what_falls_lies_where_the_surface_is(
    backend_of: Callable, material: dict, offset: float, options: dict
) -> None:
    """Its centre half its height above the surface, to 0.2 cells; at nodes it was 0.6 to 1.5. No energy is made.

    The momentum that it lacks is in the plate.
    """
    asked, z = falling(material, offset, **options)
    frames = list(build_run(asked, backend_of("f32", 1)).frames())
    heights = np.array([frame.position[:, -1].mean() for frame, _ in frames[-8:]])
    assert (heights.mean() - z) / H == pytest.approx(4, abs=0.2)
    assert min(frame.position[:, -1].min() for frame, _ in frames) > z
    energy = np.array([row.kinetic + row.potential + row.elastic for _, row in frames])
    assert (energy - np.minimum.accumulate(energy)).max() < 1e-3 * (energy[0] - energy[-1])
    # From frame 1 on: velocities are those of half a step before.
    rows, every = [row for _, row in frames[1:]], asked.time.end / asked.time.frames
    taken = np.cumsum([row.collider_force[0][-1] for row in rows]) * every
    momentum = [row.linear_momentum[-1] + row.mass * G * row.time for row in rows] + taken
    assert momentum == pytest.approx([momentum[0]] * len(rows), abs=1e-4 * rows[0].mass * G)


def test_points_that_do_not_act_are_counted_in_their_step(backend_of: Callable) -> None:
    """Water falls past walls a cell off, whose points in all steps of the fall together would not fit.

    Then no point acted any more, and the water entered the tilted floor by a cell within 50 ms.
    """
    slope, middle = np.radians(10.0), np.array([16.0, 6.1]) * H
    normal = np.array([-np.sin(slope), np.cos(slope)])
    z = middle[1] + (12 * np.tan(slope) + 3) * H
    planes = {"floor": (middle, normal), "left": ([4 * H, 0], [1, 0]), "right": ([28 * H, 0], [-1, 0])}
    asked = scene_of(
        domain={"size": [32 * H, 24 * H], "spacing": H, "gravity": [0.0, -G], "walls": {"default": "slip"}},
        time={"end": 0.24, "frames": 12, "safety": 0.25},
        bodies=[{"name": "body", "material": WATER, "shape": {"box": {"min": [5 * H, z], "max": [27 * H, z + 6 * H]}}}],
        colliders=[
            {"name": name, "shape": {"plane": {"point": list(map(float, y)), "normal": list(map(float, n))}}}
            for name, (y, n) in planes.items()
        ],
    )
    frames = [frame for frame, _ in build_run(asked, backend_of("f32", 1)).frames()]
    assert min(((frame.position - middle) @ normal).min() for frame in frames) > 0


@pytest.mark.parametrize("degrees", [10, 17])
def test_no_spray_enters_a_slope_beside_a_wall(backend_of: Callable, degrees: float) -> None:
    """Spray that runs down into the corner stays on the slope: nodes on the wall have points on it, at any slope.

    The points of nodes on the wall that lie below the surface are beyond the wall. Without them up to four particles
    sank by 1.5 cells.
    """
    slope = np.radians(degrees)
    middle, normal = np.array([16.3 * H, 6.3 * H]), np.array([-np.sin(slope), np.cos(slope)])
    low = [11.3 * H, middle[1] + (4 * np.tan(slope) + 3) * H]
    asked = scene_of(
        domain={
            "size": [24 * H, 22 * H],
            "spacing": H,
            "gravity": [0.0, -G],
            "walls": {"default": "slip", "y_max": "separate"},
        },
        time={"end": 0.6, "frames": 60},
        bodies=[{"name": "body", "material": WATER, "shape": {"box": {"min": low, "max": [y + 9 * H for y in low]}}}],
        colliders=[{"name": "slope", "shape": {"plane": {"point": middle.tolist(), "normal": normal.tolist()}}}],
    )
    frames = [frame for frame, _ in build_run(asked, backend_of("f32", 1)).frames()]
    assert min(((frame.position - middle) @ normal).min() for frame in frames) > -0.2 * H


@pytest.mark.parametrize("offset", [0.0, 0.3])
def test_a_vessel_with_thin_walls_holds_water(backend_of: Callable, offset: float) -> None:
    """Water sloshes in walls of two cells: in 2 s nothing gets in deeper than 0.3 cells, or through.

    In its corners particles creep in, which nodes do not see; those deeper than 0.2 cells are moved out.
    """
    low, high = np.array([6.0, 4.0]) + offset, np.array([18.0, 24.0]) + offset
    outside, inside, water = (
        {"box": {"min": list((low - thickness) * H), "max": [(high[0] + thickness) * H, top * H]}}
        for thickness, top in ((2, high[1]), (0, high[1] + 1), (0, low[1] + 10))
    )
    asked = scene_of(
        domain={"size": [24 * H, 28 * H], "spacing": H, "gravity": [0.0, -G], "walls": "open"},
        time={"end": 2.0, "frames": 20},
        bodies=[
            {
                "name": "water",
                "material": WATER,
                "shape": water,
                "velocity": [0.7, 0.0],
                "sampling": "turned",
            }
        ],
        colliders=[{"name": "vessel", "shape": outside | {"subtract": [inside]}}],
    )
    for frame, _ in build_run(asked, backend_of("f32", 1)).frames():
        x = frame.position / H
        assert max((low - x).max(), (x - high).max()) < 0.3


@pytest.mark.parametrize("material", [WATER, SAND])
@pytest.mark.parametrize("thickness", [0.5, 1.0, 1.6])
def test_nothing_passes_a_thin_plate(backend_of: Callable, material: dict, thickness: float) -> None:
    """Sixteen cells of material that fall three: at nodes where the plate is thinner than a cell, else at points."""
    asked, z = falling(material, 0.4, rows=16, thickness=thickness)
    last = list(build_run(asked, backend_of("f32", 1)).frames())[-1][0]
    assert last.position[:, 1].min() > z


def test_bytes_do_not_depend_on_threads(backend_of: Callable) -> None:
    """Nodes gather from points, and points from nodes, in one order."""
    asked, _ = falling(WATER, 0.3)
    one, two = (list(build_run(asked, backend_of("f32", n)).frames())[-1][0] for n in (1, 2))
    assert np.array_equal(one.position, two.position) and np.array_equal(one.velocity, two.velocity)
