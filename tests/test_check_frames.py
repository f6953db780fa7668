"""What `check RESULT` looks for in frames: crowds and sprays, neighbours that part, and momentum that drifts.

An elastic body that is pulled until its particles stand a cell apart is named before the run, too.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from check_scenes import SOLID, box
from made_result import made_row
from solver_state import scene_of

from mpmcli.check.finding import Finding, FrameFindings
from mpmcli.check.result_check import ResultCheck, check_kept
from mpmcli.check.result_state import CrowdCheck, FrameCheck, MomentumCheck, RestCheck, StateCheck, StretchCheck
from mpmcli.check.scene_check import check_scene
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import LoadedScene, Scene, sample_bodies, scene_to_toml
from mpmcli.solver.engine.run import build_run

H, LENGTH = 0.1, 0.8
SOUND = math.sqrt(SOLID["youngs_modulus"] / SOLID["density"])
RUBBER = SOLID | {"poissons_ratio": 0.3}
WATER = {"law": "fluid", "density": 1000.0, "bulk_modulus": 1e5}


def header_of(scene: Scene, law: str = "neo_hookean", precision: str = "f64") -> RunHeader:
    """Return the header of a run of a scene whose bodies follow one law."""
    backend = {"arch": "cpu", "threads": 1, "precision": precision}
    return RunHeader.of(scene, scene_to_toml(scene), [laws()[law]], backend)


def seen(
    kind: Callable[..., FrameCheck],
    header: RunHeader,
    places: Sequence[np.ndarray],
    *more: int,
    v: np.ndarray | float = 0.0,
    rows: Sequence[LedgerRow] = (),
    **fields: np.ndarray,
) -> tuple[dict[str, float | None], list[Finding]]:
    """Return the figures and the findings of a check of particles of one body at several places."""
    findings = FrameFindings()
    check = kind(header, findings, *more)
    for k, x in enumerate(places):
        label = np.zeros(len(x), np.int32)
        check.check(Frame(k, 0.1 * k, 10 * k, x, np.zeros_like(x) + v, label, label, fields), *rows[k : k + 1])
    return check.figures, list(findings.found())


def pool(low: Sequence[float] = (0.0, 0.0), **more: object) -> Scene:
    """Return water of 20 x 8 cells in a box of 24 x 16; at the origin it lies between three walls of another of 20."""
    size, high = [2.0 if low[0] == 0 else 2.4, 1.6], [low[0] + 2.0, low[1] + 0.8]
    body = {"name": "pool", "material": WATER, "shape": {"box": {"min": list(low), "max": high}}} | more
    domain = {"size": size, "spacing": H, "walls": "separate"}
    return scene_of(domain=domain, time={"end": 1.0, "frames": 1}, bodies=[body])


def crowds(scene: Scene, places: Sequence[np.ndarray], law: str = "fluid", **fields: np.ndarray) -> tuple[dict, list]:
    return seen(CrowdCheck, header_of(scene, law), places, len(places) - 1, **fields)


POOL = sample_bodies(pool())[0].position
# Five columns of cells on one; and the columns of one cell on one place.
PILED = POOL.copy()
PILED[:, 0] = (np.floor(POOL[:, 0] / (5 * H)) + 0.4 + 0.2 * (POOL[:, 0] / H % 1)) * 5 * H
HEAP = np.where([True, False], 0.55, POOL)


@pytest.mark.parametrize(
    ("low", "sampling"), [((0.0, 0.0), "lattice"), ((0.0, 0.0), "jittered"), ((0.2, 0.4), "lattice")]
)
def test_a_pool_at_rest_has_no_crowds(low: Sequence[float], sampling: str) -> None:
    """Between walls, and far from all of them."""
    scene = pool(low, sampling=sampling)
    found = crowds(scene, [sample_bodies(scene)[0].position])
    assert found == ({"densest_cell": 1.0, "empty_cells": 0.0}, [])


@pytest.mark.parametrize(
    ("places", "law", "per_cell", "first"),
    [
        ([POOL, PILED], "fluid", 4, 1),
        ([PILED, PILED], "fluid", 4, 0),
        ([POOL] * 30 + [HEAP], "fluid", 4, 30),
        # What only closes up by a half, or lies a lattice apart elsewhere, is none of it.
        ([POOL * [0.6, 1.0] + [0.3, 0.03]], "fluid", 4, None),
        ([PILED], "neo_hookean", 4, None),
        ([HEAP], "fluid", 1, None),
    ],
)
def test_rows_that_pile_up_are_told(places: Sequence[np.ndarray], law: str, per_cell: int, first: int | None) -> None:
    """In a few frames and the last: five times as full, and of five inside four are empty, at walls too."""
    figures, found = crowds(pool(particles_per_cell=per_cell), places, law)
    told = [("crowd", "note", first)] if first is not None else []
    assert [(one.rule, one.severity, one.frame) for one in found] == told
    if places[-1] is PILED and told:
        # Windows of five cells are as full as before.
        assert figures == {"densest_cell": pytest.approx(5.0), "empty_cells": pytest.approx(0.8, abs=0.02)}


@pytest.mark.parametrize(
    ("law", "share", "J", "fires"),
    [
        ("fluid", 0.02, 0.89, True),
        ("fluid", 0.02, 0.91, False),
        ("fluid", 0.005, 0.3, False),
        ("viscoplastic", 0.02, 0.5, True),
        # Spray; grains, which compact; a solid, which may be compressed on purpose.
        ("fluid", 0.5, 2.0, False),
        ("sand", 0.5, 0.5, False),
        ("neo_hookean", 0.5, 0.5, False),
    ],
)
def test_a_liquid_that_loses_its_volume_is_found(law: str, share: float, J: float, fires: bool) -> None:
    """Once more than 1 % of its mass has had a J below 0.9 for longer than sound crosses it, sqrt(1.6) m / (10 m/s)."""
    values = np.where(np.arange(len(POOL)) < share * len(POOL), J, 1.0)
    _, found = seen(StateCheck, header_of(pool(), law), [POOL] * 4, volume_ratio=values)
    assert [(one.rule, one.severity, one.body, one.value) for one in found] == [
        ("compressed", "warning", "pool", J)
    ] * fires
    assert seen(StateCheck, header_of(pool(), law), [POOL] * 2, volume_ratio=values)[1] == []
    if fires:
        assert f"In frame 2 {100 * share:g} % of the mass" in found[0].what and "as since 0 s" in found[0].what
        assert "its bulk modulus of 1e+05 Pa is too low" in found[0].what


@pytest.mark.parametrize(("viscosity", "mean", "fires"), [(1.0, 1.25, True), (1.0, 1.15, False), (0.0, 1.25, False)])
def test_a_viscous_liquid_that_sprays_is_told(viscosity: float, mean: float, fires: bool) -> None:
    J = np.where(np.arange(len(POOL)) % 2, 1.0, 2 * mean - 1)
    scene = pool(material=WATER | {"viscosity": viscosity})
    assert [one.rule for one in crowds(scene, [POOL], volume_ratio=J)[1]] == ["spray"] * fires


PHASE = np.linspace(0, 4 * np.pi, 21)
TURNS = np.minimum(PHASE, 2.0)


@pytest.mark.parametrize("by", ["sand", "raft"])
@pytest.mark.parametrize(("cells", "fires"), [(0.5, True), (2.0, False)])
def test_water_that_something_else_drives_does_not_turn(by: str, cells: float, fires: bool) -> None:
    """Sand that has slid into it, or a rigid body, by more than a cell."""
    bodies = [
        {"name": "water", "material": WATER, "shape": box([0.0, 0.0], [2.0, 0.8])},
        {"name": "sand", "material": {"preset": "sand"}, "shape": box([0.0, 0.8], [2.0, 1.0])},
    ]
    domain = {"size": [2.0, 1.6], "spacing": H, "walls": "separate", "gravity": [0.0, -9.81]}
    scene = scene_of(domain=domain, time={"end": 1.0, "frames": 20}, bodies=bodies)
    backend = {"arch": "cpu", "threads": 1, "precision": "f64"}
    header = RunHeader.of(scene, scene_to_toml(scene), [laws()["fluid"], laws()["sand"]], backend)
    x = np.concatenate([sample.position for sample in sample_bodies(scene)])
    label, findings = (x[:, 1] > 0.8).astype(np.int32), FrameFindings()
    check = RestCheck(header, findings, 20)
    for k in range(21):
        # Water moves three cells in the last half; what drives it has moved before.
        moved = np.where(label == 0, 3.0 * max(k - 10, 0) / 10, cells * (k > 0) * (by == "sand"))
        place = x + H * moved[:, None] * [1.0, 0.0]
        pose = ((0.5 + cells * H * (k > 0), 0.9, 0.0),) if by == "raft" else ()
        energies = {"kinetic": TURNS[k], "potential": 6000.0 - 0.02 * PHASE[k], "elastic": 0.0}
        row = made_row(k, 2, mass=1600.0, rigid_pose=pose, **energies)
        check.check(Frame(k, 0.05 * k, 10 * k, place, 0 * place, label, label), row)
    assert [one.rule for one in findings.found()] == ["turns"] * fires


@pytest.mark.parametrize(
    ("kinetic", "released", "cells", "law", "more", "fires"),
    [
        (TURNS, 0.02 * PHASE, 3.0, "fluid", {}, True),
        (TURNS, -PHASE, 3.0, "fluid", {}, True),
        # It hardly moves, swings, moved from the start, is driven by what it releases, or fell; it is honey, or sand.
        (TURNS, 0.1 * PHASE, 0.8, "fluid", {}, False),
        (1 - np.cos(PHASE), 0.1 * PHASE, 3.0, "fluid", {}, False),
        (TURNS[::-1] + 1.0, 0.1 * PHASE, 3.0, "fluid", {}, False),
        (PHASE, PHASE, 3.0, "fluid", {}, False),
        (TURNS, 300 * PHASE, 3.0, "fluid", {}, False),
        (TURNS, 0.1 * PHASE, 3.0, "fluid", {"material": WATER | {"viscosity": 10.0}}, False),
        (TURNS, 0.1 * PHASE, 3.0, "sand", {}, False),
    ],
)
@pytest.mark.parametrize("up", [-1.0, 1.0])
def test_water_that_turns_at_rest_is_told(
    kinetic: np.ndarray, released: np.ndarray, cells: float, law: str, more: dict, fires: bool, up: float
) -> None:
    """Whichever way gravity acts; energies are in J, of 1,600 kg of water 0.8 m deep."""
    scene = pool(**more)
    domain = scene.domain.model_copy(update={"gravity": (0.0, up * 9.81)})
    scene = scene.model_copy(update={"domain": domain})
    # The domain is 1.6 m high.
    stored = 1600.0 * 9.81 * (0.4 if up < 0 else -1.2)
    rows = [
        made_row(k, 2, kinetic=kinetic[k], potential=stored - released[k], elastic=0.0, mass=1600.0)
        for k in range(len(PHASE))
    ]
    places = [POOL + np.array([cells * H * max(k - 10, 0) / 10, 0.0]) for k in range(len(PHASE))]
    _, found = seen(RestCheck, header_of(scene, law), places, len(places) - 1, rows=rows)
    assert [(one.rule, one.frame) for one in found] == [("turns", 20)] * fires
    if fires:
        assert found[0].value == pytest.approx(cells)


def bar(speed: float, count: int = 4, walls: str = "separate", **more: object) -> Scene:
    """Return a bar of 8 x 4 cells whose ends move apart, each at `speed` times sqrt(E / density)."""
    return scene_of(
        domain={"size": [48 * H, 16 * H], "spacing": H, "walls": walls},
        time={"end": LENGTH / SOUND, "frames": 20},
        bodies=[
            {
                "name": "bar",
                "material": RUBBER,
                "particles_per_cell": count,
                "shape": box([2.0, 0.6], [2.0 + LENGTH, 1.0]),
                "velocity_gradient": [[2 * speed * SOUND / LENGTH, 0.0], [0.0, 0.0]],
            }
            | more
        ],
        solver={"precision": "f64"},
    )


def pulled(scene: Scene, backend_of: Callable) -> tuple[ResultCheck, list[Frame]]:
    """Return the check of a run, and its frames."""
    frames, rows = zip(*build_run(scene, backend_of("f64", 1)).frames(), strict=True)
    return check_kept(header_of(scene), frames, rows), list(frames)


def widest_gap(frames: list[Frame]) -> float:
    """Return the largest distance along x of two neighbours of one row of particles, cells."""
    first = frames[0].position
    row = np.flatnonzero(np.abs(first[:, 1] - first[0, 1]) < 1e-6)
    row = row[np.argsort(first[row, 0])]
    return max(float(np.abs(np.diff(frame.position[row, 0])).max()) for frame in frames) / H


def before(scene: Scene) -> list[Finding]:
    """Return what the check of a scene says of stretch."""
    return [one for one in check_scene(LoadedScene(scene, (), "scene.toml")).findings if one.rule == "stretch"]


@pytest.mark.parametrize("speed", [0.6, 1.2])
def test_a_bar_pulled_apart_is_stretched_as_foretold(backend_of: Callable, speed: float) -> None:
    """Waves of v from both ends strain it by v / c: gaps of (1 + v / c) d0, above 0.9 h told before and after."""
    scene = bar(speed)
    checked, frames = pulled(scene, backend_of)
    expected = (1 + speed) / 2
    assert widest_gap(frames) == pytest.approx(expected, rel=0.05)
    assert checked.figures["neighbour_distance"] == pytest.approx(expected, rel=0.05)
    after = [one for one in checked.findings if one.rule == "stretch"]
    told = [("note", "bar")] if expected > 0.9 else []
    assert [(one.severity, one.body) for one in before(scene)] == [(one.severity, one.body) for one in after] == told
    if told:
        assert before(scene)[0].value == pytest.approx(expected) and checked.verdict == "stable"
        assert 0.9 < after[0].value <= checked.figures["neighbour_distance"]


def test_a_bar_that_tears_says_so(backend_of: Callable) -> None:
    """Gaps wider than a kernel reaches, in a material that cannot tear: the run is suspect from that frame on."""
    scene = bar(2.0)
    assert before(scene)[0].value == pytest.approx(1.5)
    checked, frames = pulled(scene, backend_of)
    assert widest_gap(frames) > 1.5 and checked.verdict == "suspect"
    torn = next(one for one in checked.findings if one.rule == "stretch" and one.severity == "warning")
    assert torn.value > 1.5 and torn.frame == checked.first_bad_frame
    assert widest_gap(frames[: torn.frame]) <= 1.5


STILL = {"velocity_gradient": None}


@pytest.mark.parametrize(
    ("speed", "count", "more", "severity", "value", "fix"),
    [
        # With 16 in a cell, as the note advises, d0 is a quarter of a cell; with one, a stretch of 1.9 tears.
        (1.2, 4, {}, "note", 1.1, "particles_per_cell = 9"),
        (1.2, 9, {}, None, 0.0, ""),
        (1.2, 16, {}, None, 0.0, ""),
        (0.9, 1, {}, "warning", 1.9, ""),
        (0.05, 1, {}, None, 0.0, ""),
        # F = diag(1, s) relaxes by 1 / s, which sets particles d0 / s apart; what spins is not stretched by it.
        (0.0, 4, STILL | {"deformation": [[1.0, 0.0], [0.0, 0.6]]}, None, 0.0, ""),
        (0.0, 4, STILL | {"deformation": [[1.0, 0.0], [0.0, 0.5]]}, "note", 1.0, ""),
        (0.0, 4, {"velocity_gradient": [[0.0, -200.0], [200.0, 0.0]]}, None, 0.0, ""),
    ],
)
def test_what_a_scene_will_stretch_is_foretold(
    speed: float, count: int, more: dict, severity: str | None, value: float, fix: str
) -> None:
    found = before(bar(speed, count, **more))
    assert [(one.severity, one.value) for one in found] == ([(severity, pytest.approx(value))] if severity else [])
    assert all(fix in one.fix for one in found)


@pytest.mark.parametrize(
    ("law", "sampling", "stretch", "fires"),
    [
        ("neo_hookean", "lattice", 1.79, False),
        ("neo_hookean", "lattice", 1.81, True),
        ("neo_hookean", "jittered", 3.0, True),
        ("von_mises", "lattice", 3.0, False),
        ("sand", "lattice", 3.0, False),
        ("fluid", "lattice", 3.0, False),
    ],
)
def test_neighbours_of_elastic_bodies_are_followed(law: str, sampling: str, stretch: float, fires: bool) -> None:
    """Half a cell apart on a lattice, 0.9 is reached at 1.8; what yields may part its neighbours."""
    scene = bar(0.0, sampling=sampling)
    x = sample_bodies(scene)[0].position
    figures, found = seen(StretchCheck, header_of(scene, law), [x, x * [stretch, 1.0], x * [stretch, 1.0]])
    assert [(one.frame, "1 more frame" in one.what) for one in found] == [(1, True)] * fires
    if sampling == "lattice" and law == "neo_hookean":
        assert figures["neighbour_distance"] == pytest.approx(stretch / 2)


def test_neighbours_on_both_sides_of_a_periodic_face_are_near_each_other() -> None:
    scene = bar(0.0, walls="periodic")
    x, size = sample_bodies(scene)[0].position, np.array(scene.domain.size)
    figures, found = seen(StretchCheck, header_of(scene), [x, (x + size / 2) % size])
    assert found == [] and figures["neighbour_distance"] == pytest.approx(0.5)


@pytest.mark.parametrize(("transfer", "drift"), [("apic", 0.05), ("aflip", 0.0)])
def test_spin_that_is_lost_is_a_fault_of_apic_alone(transfer: str, drift: float) -> None:
    """One kilogram that turns, 0.1 J, of whose spin 0.05 sqrt(2 M E) times the diagonal is gone; AFLIP's may go."""
    first = LedgerRow(
        time=0.0, steps=0, step_min=0.1, step_max=0.1, limit="wave", speed_max=0.5, courant_max=0.1,
        volume_ratio_min=1.0, volume_ratio_max=1.0, mass=1.0, kinetic=0.1, elastic=0.0, potential=0.0,
        linear_momentum=(0.0, 0.0), angular_momentum=(1.0,),
    )  # fmt: skip
    lost = 0.05 * np.sqrt(0.2) * np.hypot(2.0, 1.6)
    then = replace(first, time=0.1, steps=1, angular_momentum=(1.0 - lost,))
    scene = pool(particles_per_cell=4)
    scene = scene.model_copy(update={"solver": scene.solver.model_copy(update={"transfer": transfer})})
    x = np.array([[0.9, 0.8], [1.1, 0.8]])
    figures, found = seen(MomentumCheck, header_of(scene), [x, x], rows=[first, then])
    assert figures == {"momentum_frames": 1, "momentum_drift": pytest.approx(drift, abs=1e-12)}
    assert [one.rule for one in found] == ["momentum"] * (drift > 0)


@pytest.mark.parametrize(
    ("precision", "off", "fires"), [("f32", 3e-6, False), ("f32", 1e-4, True), ("f64", 3e-6, True)]
)
def test_what_a_collider_carries_is_known_to_its_rounding(precision: str, off: float, fires: bool) -> None:
    """Water of 1,200 N at rest on a collider, for 0.1 s: 120 N s, of which f32 knows 7e-6."""
    first = made_row(0, 2, mass=1200 / 9.81, kinetic=1e-9, linear_momentum=(0.0, 0.0), collider_force=((0.0, 0.0),))
    more = {"step_min": 1e-12, "step_max": 1e-12, "linear_momentum": (0.0, off)}
    then = replace(first, time=0.1, steps=1, collider_force=((0.0, -1200.0),), **more)
    collider = {"name": "floor", "shape": box([0.5, 0.2], [1.9, 0.6])}
    domain = {"size": [2.4, 1.6], "spacing": H, "gravity": [0.0, -9.81]}
    water = {"name": "water", "material": WATER, "shape": box([0.5, 0.6], [1.9, 1.0])}
    scene = scene_of(domain=domain, time={"end": 1.0, "frames": 1}, bodies=[water], colliders=[collider])
    x = np.array([[0.9, 0.8], [1.1, 0.8]])
    _, found = seen(MomentumCheck, header_of(scene, "fluid", precision), [x, x], rows=[first, then])
    assert [one.rule for one in found] == ["momentum"] * fires
