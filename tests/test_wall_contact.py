"""Bodies with velocity fields of their own meet walls and colliders where their surfaces are, slide, roll and part."""

import math
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from contact_scenes import DENSITY, E, G, H, body, jelly, scene
from scenes import slow

from mpmcli.check.collider_work import work_of_colliders
from mpmcli.check.result_check import HELD_ENERGY, check_kept, energy_change
from mpmcli.frames.frame import Frame
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import Scene, scene_to_toml
from mpmcli.solver.contact.surfaces import BELOW_ALL
from mpmcli.solver.engine.run import build_run

C = math.sqrt(E / DENSITY)
STIFF = jelly(youngs_modulus=4e6)
# Where bodies fall on obstacles, cells.
MIDDLES = {"post": 30.0, "edge": 37.0, "wedge": 62.0, "corner": 74.0, "ball": 112.0}


def on_one(way: str, at: list[float], normal: list[float], friction: float = 0.0, **motion: object) -> dict:
    """Return the tables of a wall (the floor), or of a collider with a plane face through a place, in cells."""
    if way == "wall":
        walls = {"default": "slip", "y_min": "separate"}
        speed = {"wall_velocity": {"y_min": motion["velocity"]}} if motion else {}
        return {"domain": {"walls": walls, "friction": {"y_min": friction}, **speed}}
    place, n = H * np.array(at), np.array(normal)
    shape = {"plane": {"point": place.tolist(), "normal": normal}}
    if way == "box":
        along = np.array([n[1], -n[0]]) * 80 * H
        corners = [place - along, place + along, place + along - 40 * H * n, place - along - 40 * H * n]
        shape = {"polygon": {"vertices": [corner.tolist() for corner in corners]}}
    collider = {"name": "stop", "shape": shape, "friction": friction, **motion}
    return {"colliders": [collider], "domain": {"walls": "slip"}}


def speeds(run: object, way: list[float]) -> tuple[np.ndarray, np.ndarray]:
    """Return the times of the frames, and the mean velocity along a way at each."""
    found = [(frame.time, (frame.velocity @ np.array(way)).mean()) for frame, _ in run.frames()]
    return np.array(found).T


def falling(way: str, shift: float, n: int, speed: float = 2e-3, **tables: object) -> Scene:
    """A bar of 6 x n cells without lateral strain that flies at a floor, 4 cells away, at `speed` of its wave speed."""
    floor, pace = 0.0 if way == "wall" else 5.0 + shift, speed * C
    y = floor + 4 + (shift if way == "wall" else 0.0)
    bar = body("bar", [10.3, y], [16.3, y + n], material=jelly(poissons_ratio=0.0), velocity=[0.0, -pace])
    asked = on_one(way, [10, floor], [0.0, 1.0])
    gap = (y - floor) * H
    asked["domain"]["size"] = [64 * H, (2 * n + 16) * H]
    return scene([bar], end=gap / pace + 3 * n * H / C, frames=200, **asked, **tables)


@pytest.mark.parametrize(("way", "shift"), [("wall", 0.3), slow("wall", 0.0), ("plane", 0.3)])
def test_a_bar_meets_a_wall_where_it_is(backend_of: Callable, way: str, shift: float) -> None:
    """It touches within 0.03 cells, stays for 2 L / c, and leaves with nearly the speed that it came with."""
    n, pace = 16, 2e-3 * C
    asked = falling(way, shift, n)
    time, moves = speeds(build_run(asked, backend_of("f64", 1)), [0.0, 1.0])
    moves /= pace
    begins, ends = time[np.argmax(moves > -0.95)], time[np.argmax(moves > moves[-1] - 0.05)]
    length, gap = 2 * n * H / C, (4 + (shift if way == "wall" else 0.0)) * H
    assert abs(gap / pace + 0.025 * length - begins) * pace / H < 0.03
    assert (ends - begins) / (0.95 * length) == pytest.approx(1.0, abs=0.1)
    assert 0.93 < moves[-1] < 1.0


@pytest.mark.parametrize("way", ["wall", slow("plane")])
def test_nothing_passes_at_the_speed_of_waves(backend_of: Callable, way: str) -> None:
    """What is too fast for the spring of contact is stopped less than a cell behind; no energy is made."""
    asked = falling(way, 0.3, 16, 1.0)
    frames = list(build_run(asked, backend_of("f64", 1)).frames())
    floor = 0.0 if way == "wall" else 5.3 * H
    assert min(frame.position[:, 1].min() for frame, _ in frames) > floor - 0.75 * H
    assert frames[-1][0].velocity[:, 1].mean() > 0.2 * C
    energy = np.array([row.kinetic + row.elastic for _, row in frames])
    assert energy.max() <= energy[0] * (1 + 1e-6)


@pytest.mark.parametrize("way", ["wall", slow("plane")])
def test_what_shows_no_surface_is_stopped(backend_of: Callable, way: str) -> None:
    """As what was torn or crushed, it is stopped within a cell, and flies back."""
    run = build_run(falling(way, 0.3, 8, 0.1), backend_of("f64", 1))
    carried = run.groups[0].arrays.carried
    values = carried.to_numpy()
    values[:, 2] = BELOW_ALL
    carried.from_numpy(values)
    floor = 0.0 if way == "wall" else 5.3 * H
    frames = [frame for frame, _ in run.frames()]
    assert abs(min(frame.position[:, 1].min() for frame in frames) - floor) < H
    assert frames[-1].velocity[:, 1].mean() > 0.05 * C


def turned_block(way: str, degrees: float, friction: float, shift: float, time: float = 0.4) -> tuple[Scene, list]:
    """A block on a floor that is turned, with gravity 30 degrees to it, which comes on in a quarter of the time."""
    angle, slope = math.radians(degrees), math.radians(30)
    t, n = np.array([math.cos(angle), -math.sin(angle)]), np.array([math.sin(angle), math.cos(angle)])
    start = np.array([16 + shift, 0.0 if way == "wall" else 24 + shift])
    corners = [start + a * t + b * n for a, b in ((0, 0), (16, 0), (16, 8), (0, 8))]
    ramp = f"clamp(t/{0.25 * time},0,1)"
    rise = f"{ramp}*{ramp}*(3-2*{ramp})"
    step = f"clamp((t-{0.25 * time})*1e6,0,1)"
    pulls = zip((G * math.sin(slope) * t).tolist(), (-G * math.cos(slope) * n).tolist(), strict=True)
    asked = on_one(way, start.tolist(), n.tolist(), friction)
    asked["domain"]["gravity"] = [f"{along!r}*{step}+{down!r}*{rise}" for along, down in pulls]
    asked["domain"]["size"] = [64 * H, 64 * H]
    block = {"name": "block", "shape": {"polygon": {"vertices": [(H * x).tolist() for x in corners]}}}
    return scene([block | {"material": STIFF}], end=time, frames=40, **asked), t.tolist()


@pytest.mark.parametrize(
    ("way", "degrees", "friction", "off"),
    [
        ("wall", 0.0, 0.3, 3e-3),
        *(
            slow(*how)
            for how in (
                ("wall", 0.0, 0.0, 1e-3),
                ("plane", 0.0, 0.3, 3e-3),
                ("box", 17.0, 0.3, 5e-3),
                ("plane", 17.0, 0.0, 2e-3),
            )
        ),
    ],
)
def test_a_block_slides_with_the_friction_of_the_floor(
    backend_of: Callable, way: str, degrees: float, friction: float, off: float
) -> None:
    asked, along = turned_block(way, degrees, friction, 0.3)
    time, speed = speeds(build_run(asked, backend_of("f64", 1)), along)
    late = time > 0.2
    acceleration = np.polyfit(time[late], speed[late], 1)[0]
    slope = math.radians(30)
    assert (math.sin(slope) - acceleration / G) / math.cos(slope) == pytest.approx(friction, abs=off)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.5, 0.05])
def test_a_disc_rolls_or_slides_down_a_wall(backend_of: Callable, friction: float) -> None:
    """16 cells across, on 20 degrees: it rolls with 2/3 g sin, or slides with 2 mu g cos / R of spin; 3 % and 8 %."""
    slope, r = math.radians(20), 8.0
    asked = on_one("wall", [0, 0], [0.0, 1.0], friction)
    asked["domain"] |= {
        "size": [160 * H, 32 * H],
        "gravity": [f"{G * math.sin(slope)!r}*clamp((t-0.4)*10,0,1)", f"{-G * math.cos(slope)!r}*clamp(t/0.4,0,1)"],
    }
    disc = {"name": "disc", "shape": {"ball": {"center": [16.3 * H, r * H], "radius": r * H}}, "material": STIFF}
    found = []
    for frame, _ in build_run(scene([disc], end=1.2, frames=60, **asked), backend_of("f64", 1)).frames():
        x, v = (values - values.mean(axis=0) for values in (frame.position, frame.velocity))
        spin = (x[:, 0] * v[:, 1] - x[:, 1] * v[:, 0]).sum() / (x**2).sum()
        found.append((frame.time, frame.velocity[:, 0].mean(), spin))
    time, speed, spin = np.array(found).T
    late = time > 0.6
    acceleration, turning = (np.polyfit(time[late], values[late], 1)[0] for values in (speed, spin))
    if friction == 0.5:
        assert acceleration / (2 / 3 * G * math.sin(slope)) == pytest.approx(1.0, abs=0.03)
        assert -turning * r * H / acceleration == pytest.approx(1.0, abs=0.03)
    else:
        assert (math.sin(slope) - acceleration / G) / math.cos(slope) == pytest.approx(0.05, rel=0.08)
        assert -turning * r * H / (2 * G * math.cos(slope)) == pytest.approx(0.05, rel=0.08)


@pytest.mark.parametrize("way", [slow("wall"), "box"])
def test_a_belt_carries_a_block(backend_of: Callable, way: str) -> None:
    """It slides with mu g until it has the velocity of the belt, and keeps that."""
    friction, pace = 0.4, 0.8
    floor = 0.0 if way == "wall" else 6.3
    asked = on_one(way, [20, floor], [0.0, 1.0], friction, velocity=[pace, 0.0])
    asked["domain"] |= {"gravity": [0.0, -G], "size": [64 * H, 32 * H]}
    block = body("block", [10.3, floor], [20.3, floor + 5], material=STIFF)
    time, speed = speeds(build_run(scene([block], end=0.4, frames=40, **asked), backend_of("f64", 1)), [1.0, 0.0])
    slides = (time > 0.02) & (time < 0.8 * pace / (friction * G))
    assert np.polyfit(time[slides], speed[slides], 1)[0] == pytest.approx(friction * G, rel=0.03)
    assert speed[time > 0.35] == pytest.approx(pace, rel=0.01)


def thrown_into_a_corner(mirrored: bool = False, safety: float = 0.8) -> Scene:
    """A block that hits the floor, and then a wall, both rough; or its mirror image."""
    low, pace = (7.7, -3.0) if mirrored else (50.3, 3.0)
    block = body("block", [low, 4.3], [low + 6, 10.3], velocity=[pace, -3.0])
    domain = {"walls": "separate", "friction": 0.3, "gravity": [0.0, -G]}
    return scene([block], time={"end": 0.3, "frames": 10, "safety": safety}, domain=domain)


def test_a_mirror_image_does_the_same_and_half_the_step_nearly(backend_of: Callable) -> None:
    ends = []
    for how in ({}, {"mirrored": True}, {"safety": 0.4}):
        frames = list(build_run(thrown_into_a_corner(**how), backend_of("f64", 1)).frames())
        energy = np.array([row.kinetic + row.elastic + row.potential for _, row in frames])
        assert energy.max() <= energy[0] * (1 + 1e-9)
        ends.append((frames[-1][0].position.mean(axis=0), frames[-1][0].velocity.mean(axis=0)))
    (place, speed), (image, its_speed), (half, _) = ends
    # It has met both.
    assert speed[0] < 0
    assert image == pytest.approx(place * [-1, 1] + [64 * H, 0], abs=1e-9)
    assert its_speed == pytest.approx(speed * [-1, 1], abs=1e-8)
    assert half == pytest.approx(place, abs=0.5 * H)


def test_jelly_stays_out_of_a_wedge(backend_of: Callable) -> None:
    """The edge, of 53 degrees, dents a block of 16 cells that falls on it, and no particle is half a cell inside."""
    wedge = [[24 * H, 0.0], [36 * H, 0.0], [30 * H, 12 * H]]
    block = body("block", [22.3, 14], [38.3, 24], material=jelly(youngs_modulus=5e4), velocity=[0.0, -2.0])
    collider = {"name": "wedge", "shape": {"polygon": {"vertices": wedge}}, "friction": 0.3}
    asked = scene([block], end=0.2, frames=20, domain={"gravity": [0.0, -G]}, colliders=[collider])
    frames = [frame for frame, _ in build_run(asked, backend_of("f64", 1)).frames()]
    form = asked.colliders[0].form
    assert min(form.signed_distance(frame.position).min() for frame in frames) > -0.5 * H
    # It has come down around the edge.
    assert min(frame.position[:, 1].min() for frame in frames) < 11.5 * H


def on_an_edge(way: str, friction: float, youngs_modulus: float, shift: float, fine: int = 1) -> Scene:
    """A block of 16 cells that falls on a narrower post, its edge, a wedge or a ball, or a disc between two wedges.

    All is `shift` cells off the grid; with `fine` the same on a finer grid.
    """
    shift /= fine
    material, middle = jelly(youngs_modulus=youngs_modulus), MIDDLES[way]
    low = [middle - 8 + shift, shift + (10.5 if way == "post" else 10.2)]
    block = body("block", low, [x + 16 for x in low], material=material)
    if way == "corner":
        block["shape"] = {"ball": {"center": [(middle + shift) * H, (12.2 + shift) * H], "radius": 9 * H}}
    corners = np.array([[38.0, -10.0], [86.0, -10.0], [62.0, 10.0]])
    wedges = (((corners + place + shift) * H).tolist() for place in ([0, 0], [24, 0]))
    shapes = {
        "post": {"box": {"min": [(26 + shift) * H, -2 * H], "max": [(34 + shift) * H, (10 + shift) * H]}},
        **{f"wedge_{k}": {"polygon": {"vertices": wedge}} for k, wedge in enumerate(wedges)},
        "ball": {"ball": {"center": [(MIDDLES["ball"] + shift) * H, (2 + shift) * H], "radius": 8 * H}},
    }
    colliders = [{"name": name, "shape": shape, "friction": friction} for name, shape in shapes.items()]
    tables = {"gravity": [0.0, -G], "size": [128 * H, 48 * H], "spacing": H / fine}
    # From the edge it tips.
    end = 0.45 if way == "edge" else 1.0
    return scene([block], end=end, frames=50, domain=tables, colliders=colliders)


def between_jaws(way: str, friction: float, youngs_modulus: float, shift: float, fine: int = 1) -> Scene:
    """A block of 16 cells that jaws half as high squeeze, move a little, and keep; or lift, carry, set down and leave.

    The way of the jaws is one formula, so that kernels are the same.
    """
    shift /= fine
    heavy = way == "gripper"
    far, down, opens = (12 * H, 1.1, 1.5) if heavy else (H, 9.0, 9.0)
    low = np.array([22 + shift, 0.0 if heavy else 10 + shift])
    block = body("block", low.tolist(), (low + 16).tolist(), material=jelly(youngs_modulus=youngs_modulus))
    squeeze = f"{0.8 * H}*(clamp(t/0.3,0,1)-clamp((t-{opens})/0.2,0,1))"
    up = f"{far}*(clamp((t-0.4)/0.3,0,1)-clamp((t-{down})/0.3,0,1))"
    colliders = [
        {
            "name": name,
            "shape": {"box": {"min": (H * (low + at)).tolist(), "max": (H * (low + at + [10, 8])).tolist()}},
            "friction": friction,
            "offset": [f"{0.5 * far}*clamp((t-0.7)/0.4,0,1){sign}{squeeze}", up],
        }
        for name, at, sign in (("left", [-10, 4], "+"), ("right", [16, 4], "-"))
    ]
    tables = {"gravity": [0.0, -G if heavy else 0.0], "size": [64 * H, 48 * H], "walls": "separate"}
    tables["spacing"] = H / fine
    return scene([block], end=2.0, frames=100, domain=tables, colliders=colliders)


def on_a_post_in_3d() -> Scene:
    """A cube of 8 cells on a post half as wide, off the grid."""
    post = {"box": {"min": [6.3 * H, 6.3 * H, -2 * H], "max": [10.3 * H, 10.3 * H, 4.3 * H]}}
    domain = {"size": [16 * H] * 3, "gravity": [0.0, 0.0, -G], "walls": {"default": "separate", "z_min": "stick"}}
    colliders = [{"name": "post", "shape": post, "friction": 0.5}]
    return scene([body("cube", [4.3] * 3, [12.3] * 3)], end=0.6, frames=60, domain=domain, colliders=colliders)


def worked(asked: Scene, backend: object) -> tuple[np.ndarray, np.ndarray, list]:
    """Return energy less the work of colliders, and the work of contact, over what is turned over, and the ledger."""
    rows = [row for _, row in build_run(asked, backend).frames()]
    energy = np.array([row.energy for row in rows]) - work_of_colliders(rows, asked.colliders)
    turned = max(row.kinetic + row.elastic for row in rows)
    return (energy - energy[0]) / turned, np.cumsum([row.contact_work for row in rows]) / turned, rows


@pytest.mark.parametrize("how", [
    ("post", 0.5, E, 0.0), ("post", 0.0, 30 * E, 0.3), ("wedge", 0.0, 30 * E, 0.0), ("ball", 0.5, 30 * E, 0.3),
    ("edge", 0.5, E, 0.3), ("corner", 0.5, E, 0.3), slow(("corner", 0.0, 30 * E, 0.0)),
    slow(("post", 0.5, E, 0.3, 2)), slow(("3D",)),
])  # fmt: skip
def test_an_obstacle_makes_no_energy(backend_of: Callable, how: tuple) -> None:
    """Neither does contact give more than it has taken, at any time."""
    asked = on_a_post_in_3d() if how == ("3D",) else on_an_edge(*how)
    kept, contact, _ = worked(asked, backend_of("f64", 1))
    assert kept.max() < 1e-6 and contact.max() < 1e-6
    assert kept.min() < -1e-2 and contact.min() < -1e-3


@pytest.mark.parametrize(
    "how",
    [
        ("jaws", 0.5, E, 0.3),
        ("gripper", 1.0, 5 * E, 0.3),
        slow(("jaws", 0.0, 10 * E, 0.0)),
        slow(("jaws", 0.5, E, 0.3, 2)),
    ],
)
def test_jaws_give_no_more_energy_than_their_work(backend_of: Callable, how: tuple) -> None:
    """Where they stand still, the block comes to rest, and keeps most of what they have done."""
    kept, contact, rows = worked(between_jaws(*how), backend_of("f64", 1))
    assert kept.max() < 1e-3 and contact.max() < 1e-3
    assert contact.min() < -1e-2
    if how[0] == "gripper":
        # It was lifted by 12 cells, and then set down.
        height = np.array([row.potential for row in rows]) / (rows[0].mass * G * H)
        assert height.max() - height[0] > 10 and abs(height[-1] - height[0]) < 1
    else:
        assert rows[-1].kinetic < 0.1 * max(row.kinetic for row in rows)
        assert kept[-1] > -0.15


@pytest.mark.slow
@pytest.mark.parametrize(
    ("right", "wrong"),
    [
        # Springs that act with the velocity before the step; the lever of a point reversed.
        ("IMPLICIT = 0.5", "IMPLICIT = 0.0"),
        ("weight * (1.0 + lever)", "weight * (1.0 - lever)"),
    ],
)
def test_a_planted_force_that_makes_energy_is_found(
    tmp_path: Path, run_python: Callable, right: str, wrong: str
) -> None:
    """The wedge of the test above finds it."""
    shutil.copytree(ROOT / "mpmcli", tmp_path / "mpmcli", ignore=shutil.ignore_patterns("__pycache__"))
    file = tmp_path / "mpmcli" / "solver" / "contact" / "body_contact.py"
    text = file.read_text(encoding="utf-8")
    assert text.count(right) == 1
    file.write_text(text.replace(right, wrong), encoding="utf-8")
    test = ["-m", "pytest", "-q", "-p", "no:cacheprovider", f"{__file__}::test_an_obstacle_makes_no_energy[how2]"]
    done = run_python(test, environment={"PYTHONPATH": str(tmp_path)}, check=False)
    assert "contact.max() < 1e-6" in done.stdout and "1 failed" in done.stdout


def test_contact_that_makes_energy_is_found(backend_of: Callable) -> None:
    """A tenth of the energy turned over, in the swings after the first contact."""
    asked = on_an_edge("post", 0.5, E, 0.0)
    run = build_run(asked, backend_of("f64", 1))
    frames, rows = zip(*run.frames(), strict=True)
    header = RunHeader.of(asked, scene_to_toml(asked), [laws()[name] for name in run.laws], {"precision": "f64"})
    turned = max(row.kinetic + row.elastic for row in rows)
    for made, found in ((0.0, set()), (0.1, {"energy"})):
        more = [replace(row, elastic=row.elastic + made * turned * min(2 * row.time, 1.0)) for row in rows]
        assert {"energy"} & {finding.rule for finding in check_kept(header, frames, more).findings} == found


def test_an_edge_of_a_body_makes_no_energy(backend_of: Callable) -> None:
    """A soft block falls on a post half as wide, and swings there ever less."""
    post = body("post", [26, 0], [34, 10], material=jelly(youngs_modulus=10 * E))
    asked = scene([body("block", [22, 10], [38, 26]), post], 0.5, end=1.8, frames=90, domain={"gravity": [0.0, -G]})
    rows = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()]
    energy = np.array([row.energy for row in rows]) - rows[0].energy
    turned = max(row.kinetic + row.elastic for row in rows)
    assert energy.max() < 1e-3 * turned
    assert energy[-30:].max() < 0.0


def test_the_ledger_lacks_a_part_of_the_energy_of_contact(backend_of: Callable) -> None:
    """A block of 10 cells that swings on a floor seems to gain it; without the work of contact nothing is gained."""
    block = body("block", [10, 0], [25, 10])
    asked = scene([block], end=0.5, frames=50, domain={"walls": "separate", "friction": 0.3, "gravity": [0.0, -G]})
    rows = [row for _, row in build_run(asked, backend_of("f64", 1)).frames()]
    parts = [np.array([getattr(row, name) for row in rows]) for name in ("kinetic", "potential", "elastic")]
    work = np.cumsum([row.contact_work for row in rows])
    assert 1e-2 < energy_change(*parts)[0].max() < 0.8 * HELD_ENERGY
    assert energy_change(*parts, work)[0].max() < 1e-3
    assert work.min() < 0.0 and work.max() < 1e-3 * np.ptp(parts[2])


@pytest.mark.parametrize("way", ["wall", slow("plane")])
def test_jelly_rests_on_the_floor(backend_of: Callable, way: str) -> None:
    """Its lowest row is as far above it as when surfaces touch, 0.03 cells off; 0.15 at its corners.

    Water beside it changes nothing, and meets the floor as water does.
    """
    floor = 0.0 if way == "wall" else 6.3
    asked = on_one(way, [20, floor], [0.0, 1.0], 0.3)
    asked["domain"] |= {"gravity": [0.0, f"{-G}*clamp(t/0.3,0,1)"], "size": [64 * H, 32 * H]}
    block = body("block", [10.3, floor], [18.3, floor + 8])
    liquid = {"law": "fluid", "density": DENSITY, "bulk_modulus": 1e5}
    water = body("water", [40, floor + 1], [64, floor + 5], material=liquid)
    places = []
    for bodies in ([block], [block, water]):
        *_, (frame, _) = build_run(scene(bodies, end=0.6, **asked), backend_of("f64", 1)).frames()
        own = frame.position[frame.body == 0]
        row = np.sort(own[:, 1])[:16] / H - floor
        assert np.median(row) == pytest.approx(0.25, abs=0.03) and row.min() > 0.1
        places.append(own.mean(axis=0))
        if len(bodies) == 2:
            assert frame.position[frame.body == 1, 1].min() / H - floor < 1.0
    assert places[1] == pytest.approx(places[0], abs=1e-3 * H)


def piled(low: np.ndarray, size: np.ndarray, youngs_modulus: float, end: float) -> Scene:
    """Light boxes, (n, 2) in cells, with friction, in a trough of 80 cells."""
    material = jelly(density=300.0, youngs_modulus=youngs_modulus)
    boxes = [
        body(f"b{k}", a.tolist(), (a + b).tolist(), material=material)
        for k, (a, b) in enumerate(zip(low, size, strict=True))
    ]
    domain = {"size": [80 * H, 120 * H], "walls": "separate", "friction": 0.4, "gravity": [0.0, -G]}
    return scene(boxes, 0.4, end=end, frames=50, domain=domain, solver={"precision": "f32"})


def middles(frame: Frame) -> np.ndarray:
    """Return where bodies are, cells."""
    return np.array([frame.position[frame.body == k].mean(axis=0) for k in range(frame.body.max() + 1)]) / H


@pytest.mark.slow
def test_a_tower_of_five_cubes_stands(backend_of: Callable) -> None:
    """It bounces, and loses that in seconds; it sags by rho g H^2 / 2 E, and nothing slides or tilts."""
    low = np.array([[20 + 0.15 * (-1) ** k, 10 * k] for k in range(5)])
    frames = list(build_run(piled(low, np.full((5, 2), 10), 1e6, 5.0), backend_of("f32")).frames())
    moved = middles(frames[-1][0]) - middles(frames[0][0])
    assert np.abs(moved[:, 0]).max() < 0.2
    assert -1.3 * 300 * G * (50 * H) ** 2 / 2e6 / H < moved[-1, 1] < 0.0


@pytest.mark.slow
def test_thirty_boxes_come_to_rest(backend_of: Callable) -> None:
    """Energy is never above its start; in the last second nothing moves by a tenth of a box."""
    rng = np.random.default_rng(0)
    size = rng.uniform(7, 10, (30, 2))
    low = np.array([[5 + 15 * (k % 5), 5 + 17.5 * (k // 5)] for k in range(30)]) + rng.uniform(0, 3, (30, 2))
    frames = list(build_run(piled(low, size, 2.5e5, 6.0), backend_of("f32")).frames())
    energy = np.array([row.energy for _, row in frames])
    assert energy.argmax() == 0
    assert np.abs(middles(frames[-1][0]) - middles(frames[-10][0])).max() < 0.8
    assert np.sqrt(2 * frames[-1][1].kinetic / frames[0][1].mass) < 0.05


def test_springs_return_what_they_take_up_at_a_corner(backend_of: Callable) -> None:
    """A square lands on its corner: at most 2 % of its energy is missing when it has left the floor."""
    square = body("square", [26, 5], [38, 17], velocity=[0.0, -3.0])
    square["shape"]["rotation"] = 20.0
    time, domain = {"end": 0.6, "frames": 30}, {"walls": "separate", "gravity": [0.0, 0.0]}
    rows = [row for _, row in build_run(scene([square], time=time, domain=domain), backend_of("f64", 1)).frames()]
    assert rows[-1].contact_overlap == 0.0 and max(row.contact_overlap for row in rows) > 0.2
    assert abs(sum(row.contact_work for row in rows)) < 0.02 * rows[0].energy
