"""Liquids and sand at colliders: they come down and lie where the surface is, wherever the nodes are, and stay out."""

from collections.abc import Callable

import numpy as np
import pytest
from scenes import block, body, box, plane, polygon, scene_of

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
    own = block("body", material, [0.0] * (dimension - 1) + [z + 3 * H], [*across, z + (3 + rows) * H])
    plate = box([-H] * (dimension - 1) + [z - thickness * H], [x + H for x in across] + [z])
    return scene_of(
        own,
        domain={"size": [*across, (20 + rows) * H], "spacing": H, "gravity": [0.0] * (dimension - 1) + [-G]},
        walls={"default": "slip", ("y_max", "z_max")[dimension - 2]: "separate"},
        time={"end": 4.0, "frames": 80},
        kernel=kernel,
        colliders=[{"name": "plate", "shape": plate}],
    ), z


@pytest.mark.parametrize(("material", "offset", "options"), [
    (WATER, 0.0, {}),
    (WATER, 0.3, {}),
    (WATER, 0.5, {}),
    (SAND, 0.0, {}),
    (SAND, 0.4, {}),
    pytest.param(WATER, 0.25, {"dimension": 3}, marks=pytest.mark.slow),
    pytest.param(SAND, 0.25, {"dimension": 3}, marks=pytest.mark.slow),
    pytest.param(WATER, 0.25, {"kernel": "cubic"}, marks=pytest.mark.slow),
])  # fmt: skip
def test_what_falls_lies_where_the_surface_is(
    backend_of: Callable, material: dict, offset: float, options: dict
) -> None:
    """Its centre half its height above the surface, to 0.2 cells; at nodes it was 0.6 to 1.5.

    Energy rises by less than 2e-3 of what is lost, where water settles.

    The momentum that it lacks is in the plate, but for what shifts of particles change (docs/theory.md, 5.12).
    """
    asked, z = falling(material, offset, **options)
    frames = list(build_run(asked, backend_of("f32", 1)).frames())
    heights = np.array([frame.position[:, -1].mean() for frame, _ in frames[-8:]])
    assert (heights.mean() - z) / H == pytest.approx(4, abs=0.21)
    assert min(frame.position[:, -1].min() for frame, _ in frames) > z - 0.05 * H
    energy = np.array([row.kinetic + row.potential + row.elastic for _, row in frames])
    assert (energy - np.minimum.accumulate(energy)).max() < 2e-3 * (energy[0] - energy[-1])
    # From frame 1 on: velocities are those of half a step before.
    rows, every = [row for _, row in frames[1:]], asked.time.end / asked.time.frames
    taken = np.cumsum([row.collider_force[0][-1] for row in rows]) * every
    momentum = [row.linear_momentum[-1] + row.mass * G * row.time for row in rows] + taken
    assert momentum == pytest.approx([momentum[0]] * len(rows), abs=8e-4 * rows[0].mass * G)


@pytest.mark.slow
@pytest.mark.parametrize(("material", "offset", "most"), [
    (WATER, 0.0, 0.32), (WATER, 0.25, 0.32), (WATER, 0.5, 0.52), (WATER, 0.75, 0.32), (SAND, 0.0, 0.32),
    (SAND, 0.25, 0.32),
])  # fmt: skip
def test_what_falls_meets_the_surface(
    backend_of: Callable, material: dict, offset: float, most: float, record_property: Callable
) -> None:
    """When 1.5 % of its momentum is gone, its lowest row is some tenths of a cell off; at nodes it was 1.0 to 1.8."""
    asked, z = falling(material, offset)
    asked = asked.model_copy(update={"time": asked.time.model_copy(update={"end": 0.25, "frames": 100})})
    times, forces, gaps = [], [], []
    for frame, row in build_run(asked, backend_of("f32", 1)).frames():
        times.append(row.time)
        forces.append(-row.collider_force[0][1] / (row.mass * G))
        gaps.append((frame.position[:, 1].min() - z) / H - 0.25)
    gone = np.cumsum(forces[1:]) * times[1] / times[1:]
    early = float(np.interp(0.015, gone, gaps[1:]))
    record_property("early, cells", early)
    assert -0.1 < early < most


def test_points_that_do_not_act_are_counted_in_their_step(backend_of: Callable) -> None:
    """Water falls past walls a cell off, whose points in all steps of the fall together would not fit.

    Then no point acted any more, and the water entered the tilted floor by a cell within 50 ms.
    """
    slope, middle = np.radians(10.0), np.array([16.0, 6.1]) * H
    normal = np.array([-np.sin(slope), np.cos(slope)])
    z = middle[1] + (12 * np.tan(slope) + 3) * H
    planes = {"floor": (middle, normal), "left": ([4 * H, 0], [1, 0]), "right": ([28 * H, 0], [-1, 0])}
    asked = scene_of(
        block("body", WATER, [5 * H, z], [27 * H, z + 6 * H]),
        domain={"size": [32 * H, 24 * H], "spacing": H, "gravity": [0.0, -G], "walls": {"default": "slip"}},
        time={"end": 0.24, "frames": 12, "safety": 0.25},
        colliders=[{"name": name, "shape": plane(map(float, y), map(float, n))} for name, (y, n) in planes.items()],
    )
    frames = [frame for frame, _ in build_run(asked, backend_of("f32", 1)).frames()]
    assert min(((frame.position - middle) @ normal).min() for frame in frames) > 0


@pytest.mark.parametrize(("thickness", "above"), [(0.5, 0.15), (1.0, 0.15), (1.0, 0.4)])
def test_a_sheet_of_water_flies_past_an_edge(backend_of: Callable, thickness: float, above: float) -> None:
    """Along a face and past its end, without gravity, at its speed: nothing has drifted into the face behind the edge.

    The points there see less than a thousandth of the mass of full nodes.
    """
    face, top, speed = 8.15 * H, (8 + above) * H, 5.0
    sheet = {"min": [face, 2 * H], "max": [face + thickness * H, 6 * H]}
    asked = scene_of(
        body("sheet", WATER, {"box": sheet}, velocity=[0.0, speed]),
        domain={"size": [20 * H, 20 * H], "spacing": H, "gravity": [0.0, 0.0]},
        walls={"default": "slip", "y_max": "separate"},
        time={"end": 0.12, "frames": 3},
        colliders=[{"name": "post", "shape": box([4 * H, -H], [face, top])}],
    )
    for frame, _ in build_run(asked, backend_of("f32", 1)).frames():
        assert frame.velocity == pytest.approx(np.tile([0.0, speed], (len(frame.velocity), 1)), abs=1e-3)


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
        block("body", WATER, low, [y + 9 * H for y in low]),
        domain={"size": [24 * H, 22 * H], "spacing": H, "gravity": [0.0, -G]},
        walls={"default": "slip", "y_max": "separate"},
        time={"end": 0.6, "frames": 60},
        colliders=[{"name": "slope", "shape": plane(middle.tolist(), normal.tolist())}],
    )
    frames = [frame for frame, _ in build_run(asked, backend_of("f32", 1)).frames()]
    assert min(((frame.position - middle) @ normal).min() for frame in frames) > -0.2 * H


def vessel(
    thickness: float, offset: float, end: float, *, outline: bool = False, **water: object
) -> tuple[Scene, np.ndarray, np.ndarray]:
    """Return water 10 cells deep in a vessel 12 cells wide with walls of some cells, and the corners of its inside.

    The vessel is a box without another one, or an outline.
    """
    low, high = np.array([6.0, 4.0]) + offset, np.array([18.0, 24.0]) + offset
    outside, inside, filled = (
        box((low - wall) * H, [(high[0] + wall) * H, top * H])
        for wall, top in ((thickness, high[1]), (0, high[1] + 1), (0, low[1] + 10))
    )
    shape = outside | {"subtract": [inside]}
    if outline:
        (x, y), (right, top) = (low - thickness) * H, high * H + [thickness * H, 0.0]
        (a, b), c = low * H, high[0] * H
        shape = polygon([[x, y], [right, y], [right, top], [c, top], [c, b], [a, b], [a, top], [x, top]])
    return (
        scene_of(
            body("water", WATER, filled, sampling="turned") | water,
            domain={"size": [24 * H, 28 * H], "spacing": H, "gravity": [0.0, -G], "walls": "open"},
            time={"end": end, "frames": 20},
            colliders=[{"name": "vessel", "shape": shape}],
        ),
        low * H,
        high * H,
    )


@pytest.mark.parametrize(("thickness", "offset", "share"), [
    (2, 0.0, 0.0),
    # One particle of 480 was at 0.31 cells.
    (2, 0.3, 0.0025),
    pytest.param(1, 0.0, 0.005, marks=pytest.mark.slow),
    # A wall of one cell between nodes leaks: 0.146 here, and 0.45 at 0.5.
    pytest.param(1, 0.3, 0.2, marks=pytest.mark.slow),
    # Two particles of 480 were at 0.33 cells.
    pytest.param(2.5, 0.0, 0.005, marks=pytest.mark.slow),
    pytest.param(3, 0.0, 0.0, marks=pytest.mark.slow),
    pytest.param(4, 0.0, 0.0, marks=pytest.mark.slow),
])  # fmt: skip
def test_a_vessel_with_thin_walls_holds_water(
    backend_of: Callable, thickness: float, offset: float, share: float, record_property: Callable
) -> None:
    """Water sloshes for 2 s: nothing gets in deeper than 0.3 cells, or through; of walls of one cell on nodes 0.5 %.

    In its corners particles creep in, which nodes do not see; those deeper than 0.2 cells are moved out.
    """
    asked, low, high = vessel(thickness, offset, 2.0, velocity=[0.7, 0.0])
    depths = []
    for frame, _ in build_run(asked, backend_of("f32", 1)).frames():
        depths.append(np.maximum(low - frame.position, frame.position - high).max(axis=1) / H)
    record_property("share deeper than 0.3 cells", max(float(np.mean(depth > 0.3)) for depth in depths))
    record_property("deepest, cells", max(float(depth.max()) for depth in depths))
    assert max(np.mean(depth > 0.3) for depth in depths) <= share


def test_a_vessel_given_by_its_outline_holds_water(backend_of: Callable) -> None:
    """Walls of two cells, on nodes: 4 % of the particles passed the corners before both faces counted there."""
    asked, low, high = vessel(2, 0.0, 2.0, outline=True, velocity=[0.7, 0.0])
    for frame, _ in build_run(asked, backend_of("f32", 1)).frames():
        assert np.maximum(low - frame.position, frame.position - high).max() < 0.3 * H


@pytest.mark.slow
def test_water_in_a_vessel_rests(backend_of: Callable, record_property: Callable) -> None:
    """In 4 s its height, twice that of its middle, falls by 1.1 %; by 5 % before points began with their impulses."""
    asked, low, _ = vessel(3, 0.0, 4.0, initial_pressure="hydrostatic")
    frames = build_run(asked, backend_of("f32", 1)).frames()
    heights = np.array([2 * (frame.position[:, 1].mean(dtype=float) - low[1]) / H for frame, _ in frames])
    record_property("height, cells", heights.tolist())
    assert heights == pytest.approx(heights[0], rel=0.015)


@pytest.mark.parametrize("material", [WATER, SAND])
@pytest.mark.parametrize("thickness", [0.5, 1.0, 1.6])
def test_nothing_passes_a_thin_plate(backend_of: Callable, material: dict, thickness: float) -> None:
    """Sixteen cells of material that fall three: at nodes where the plate is thinner than a cell, else at points."""
    asked, z = falling(material, 0.4, rows=16, thickness=thickness)
    last = list(build_run(asked, backend_of("f32", 1)).frames())[-1][0]
    # Particles that are less than 0.2 cells inside are not moved out.
    assert last.position[:, 1].min() > z - 0.25 * H


def test_bytes_do_not_depend_on_threads(backend_of: Callable) -> None:
    """Nodes gather from points, and points from nodes, in one order."""
    asked, _ = falling(WATER, 0.3)
    one, two = (list(build_run(asked, backend_of("f32", n)).frames())[-1][0] for n in (1, 2))
    assert np.array_equal(one.position, two.position) and np.array_equal(one.velocity, two.velocity)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5, 0.75])
def test_couette_flow_ends_at_a_surface_that_sticks(
    backend_of: Callable, offset: float, record_property: Callable
) -> None:
    """The profile between it and a wall that moves is 0 at the surface, to 0.12 cells (0.27 off at nodes)."""
    z, speed, top = (8 + offset) * H, 1.0, 24 * H
    rate = speed / (top - z)
    motion = {"velocity": [speed / 2, 0.0], "velocity_gradient": [[0.0, rate], [0.0, 0.0]]}
    asked = scene_of(
        block("body", WATER | {"viscosity": 100.0}, [0.0, z], [8 * H, top], **motion),
        domain={"size": [8 * H, top], "spacing": H},
        walls={"default": "periodic", "y_min": "stick", "y_max": "stick"},
        wall_velocity={"y_max": [speed, 0.0]},
        time={"end": 1.5, "frames": 15},
        colliders=[{"name": "plate", "shape": plane([0.0, z], [0.0, 1.0]), "wall": "stick"}],
    )
    places = []
    for frame, _ in list(build_run(asked, backend_of("f32", 1)).frames())[8:]:
        x, v = frame.position[:, 1].astype(float), frame.velocity[:, 0].astype(float)
        inner = np.abs(x - (z + top) / 2) < (top - z) / 4
        slope, at_zero = np.polyfit(x[inner], v[inner], 1)
        places.append((-at_zero / slope - z) / H)
    record_property("place, cells", float(np.mean(places)))
    assert np.mean(places) == pytest.approx(0.0, abs=0.12)


@pytest.mark.slow
def test_a_jet_presses_with_its_momentum(backend_of: Callable, record_property: Callable) -> None:
    """A jet of 8 cells on a plate with free ends: rho U^2 b, to 2 %."""
    speed, width = 2.0, 8 * H
    mouth = box([28 * H, 28 * H], [36 * H, 30 * H])
    asked = scene_of(
        domain={"size": [64 * H, 36 * H], "spacing": H, "walls": "open"},
        time={"end": 2.0, "frames": 40},
        emitters=[body("jet", WATER, mouth, velocity=[0.0, -speed])],
        colliders=[{"name": "plate", "shape": box([12 * H, 4 * H], [52 * H, 8 * H])}],
    )
    force = [row.collider_force[0][1] for frame, row in build_run(asked, backend_of("f32", 1)).frames() if row.time > 1]
    share = -np.mean(force) / (1000 * speed**2 * width)
    record_property("force over rho U^2 b", float(share))
    record_property("its deviation", float(np.std(force) / (1000 * speed**2 * width)))
    assert share == pytest.approx(1.0, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("cells", [6, 12])
def test_sand_runs_out_of_a_hopper(backend_of: Callable, cells: int, record_property: Callable) -> None:
    """Through a slot of D = 6 and 12 cells, 1.03 rho sqrt(g) D^1.5 in a second, of the mass from 10 to 30 %.

    0.73, 1.02, 1.13 of it at 6, 12 and 24 cells before sand kept a share of its motion; 1.19, 1.21 and 1.23 now. So the
    constant is that of other grains and funnels, and what counts is that it does not depend on the grid.
    """
    slot, x = 0.06, np.array([[0.28, 0.6], [0.3, 0.6], [0.3, 0.42], [0.37, 0.35], [0.37, 0.32], [0.28, 0.4]])
    sides = {"left": x, "right": [0.8, 0.0] + [-1.0, 1.0] * x}
    asked = scene_of(
        block("sand", "sand", [0.3, 0.42], [0.5, 0.56]),
        domain={"size": [0.8, 0.6], "spacing": slot / cells, "gravity": [0.0, -G], "friction": 0.6},
        time={"end": 0.6, "frames": 60},
        colliders=[
            {"name": name, "shape": polygon(np.asarray(y).tolist()), "friction": 0.4} for name, y in sides.items()
        ],
    )
    frames = list(build_run(asked, backend_of("f32", 1)).frames())
    share = np.array([np.mean(frame.position[:, 1] < 0.32) for frame, _ in frames])
    times, own = np.array([frame.time for frame, _ in frames]), (share > 0.1) & (share < 0.3)
    rate = np.polyfit(times[own], share[own], 1)[0] * frames[0][1].mass / (1.03 * 1600 * np.sqrt(G) * slot**1.5)
    record_property("rate over the formula's", float(rate))
    assert rate == pytest.approx(1.23, abs=0.1)


def dam(wall: float, face: float | None) -> Scene:
    """Return water of 12 x 24 cells at the left wall, and the other wall or, `face` cells from the left, a pillar."""
    pillar = box([(face or 0.0) * H, -2 * H], [((face or 0.0) + 10) * H, 90 * H])
    return scene_of(
        block("body", WATER, [0.0, 0.0], [12 * H, 24 * H]),
        domain={"size": [wall * H, 88 * H], "spacing": H, "gravity": [0.0, -G], "walls": "separate"},
        time={"end": 2.0, "frames": 80},
        colliders=[] if face is None else [{"name": "pillar", "shape": pillar}],
    )


def at_face(asked: Scene, face: float, backend: object) -> tuple[float, float]:
    """Return the gap of the lowest six rows of cells, mean of the frames with water there, and the run-up, in cells.

    The run-up is below 95 % of what is within three cells, at its highest. No energy is made.
    """
    gaps, heights, energy = [], [0.0], []
    for frame, row in build_run(asked, backend).frames():
        energy.append(row.energy)
        x, y = frame.position.astype(float).T / H
        near = (x > face - 3) & (x < face + 0.5)
        if near.sum() > 50:
            heights.append(np.quantile(y[near], 0.95))
            rows = [face - x[near & (y.astype(int) == row)] for row in range(6)]
            gaps.append(np.mean([row.min() if len(row) else np.nan for row in rows]))
    assert (energy - np.minimum.accumulate(energy)).max() < 1e-3 * energy[0]
    return float(np.nanmean(gaps)), max(heights)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 0.5])
def test_a_dam_meets_a_pillar_as_it_meets_a_wall(
    backend_of: Callable, offset: float, record_property: Callable
) -> None:
    """The water touches it, and runs up as high as at a wall of the domain there, to 5 % (2.1 and 3.1 % less)."""
    backend, face = backend_of("f32", 1), 36 + offset
    gap, height = at_face(dam(60, face), face, backend)
    twins = [at_face(dam(wall, None), wall, backend) for wall in ([36] if offset == 0 else [36, 37])]
    twin_gap, twin_height = np.mean(twins, axis=0)
    record_property("gap, of the twin, run-up, of the twin", (gap, twin_gap, height, twin_height))
    assert gap < twin_gap + 0.2
    assert height == pytest.approx(twin_height, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("offset", [0.0, 0.25, 0.5])
def test_sand_slumps_beside_a_collider_as_beside_a_wall(
    backend_of: Callable, offset: float, record_property: Callable
) -> None:
    """The rows of a column of 12 x 12 cells end 0.25 cells off its face, as they began, to 0.1; the heaps are alike."""
    found = []
    for face in (8 + offset, 0.0):
        plane = {"plane": {"point": [face * H, 0.0], "normal": [1.0, 0.0]}}
        asked = scene_of(
            block("body", SAND | {"youngs_modulus": 3e6}, [face * H, 0.0], [(face + 12) * H, 12 * H]),
            domain={"size": [60 * H, 20 * H], "spacing": H, "gravity": [0.0, -G]},
            friction={"x_min": 0.5, "y_min": 0.5},
            time={"end": 2.0, "frames": 10},
            colliders=[{"name": "face", "shape": plane, "friction": 0.5}] if face else [],
        )
        *_, (last, _) = build_run(asked, backend_of("f32", 1)).frames()
        x, y = last.position.astype(float).T / H - [[face], [0.0]]
        gap = np.mean([x[y.astype(int) == row].min() for row in range(8)])
        found.append((gap, np.quantile(x, 0.99), y.max(), x.mean(), y.mean()))
    record_property("gap, front, height, middle; of the twin", np.array(found).tolist())
    (gap, *own), (_, *twin) = found
    assert gap == pytest.approx(0.25, abs=0.1)
    assert own == pytest.approx(twin, rel=0.05)
