"""An elastic body that is pulled until its particles stand a cell apart is named before the run and after it."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from check_scenes import SOLID, box
from solver_state import scene_of

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_check import ResultCheck, check_kept
from mpmcli.check.result_state import StretchCheck
from mpmcli.check.scene_check import check_scene
from mpmcli.frames.frame import Frame
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader
from mpmcli.scene import LoadedScene, Scene, sample_bodies, scene_to_toml
from mpmcli.solver.engine.build import build_run

H, LENGTH = 0.1, 0.8
SOUND = math.sqrt(SOLID["youngs_modulus"] / SOLID["density"])
RUBBER = SOLID | {"poissons_ratio": 0.3}


def bar(speed: float, count: int = 4, **more: object) -> Scene:
    """Return a bar of 8 x 4 cells whose ends move apart, each at `speed` times sqrt(E / density)."""
    return scene_of(
        domain={"size": [48 * H, 16 * H], "spacing": H, "walls": "separate"},
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


def header_of(scene: Scene, law: str = "neo_hookean") -> RunHeader:
    """Return the header of a run of a scene whose bodies follow one law."""
    backend = {"arch": "cpu", "threads": 1, "precision": "f64"}
    return RunHeader.of(scene, scene_to_toml(scene), [laws()[law]], backend)


def pulled(scene: Scene, backend_of: Callable) -> tuple[ResultCheck, list[Frame]]:
    """Return the check of a run, and its frames."""
    run = list(build_run(scene, backend_of("f64", 1)).frames())
    frames = [frame for frame, _ in run]
    return check_kept(header_of(scene), frames, [row for _, row in run]), frames


def widest_gap(frames: list[Frame]) -> float:
    """Return the largest distance along x of two neighbours of one row of particles, cells."""
    first = frames[0].position
    row = np.flatnonzero(np.abs(first[:, 1] - first[0, 1]) < 1e-6)
    row = row[np.argsort(first[row, 0])]
    return max(float(np.abs(np.diff(frame.position[row, 0])).max()) for frame in frames) / H


def before(scene: Scene) -> list:
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
    if expected < 0.9:
        assert before(scene) == after == []
    else:
        (foretold,) = before(scene)
        assert foretold.value == pytest.approx(expected) and foretold.severity == "note"
        assert [(one.severity, one.body) for one in after] == [("note", "bar")]
        assert checked.verdict == "stable" and 0.9 < after[0].value <= checked.figures["neighbour_distance"]


def test_a_bar_that_tears_says_so(backend_of: Callable) -> None:
    """Gaps wider than a kernel reaches, in a material that cannot tear: the run is suspect from that frame on."""
    scene = bar(2.0)
    assert before(scene)[0].value == pytest.approx(1.5)
    checked, frames = pulled(scene, backend_of)
    assert widest_gap(frames) > 1.5 and checked.verdict == "suspect"
    torn = next(one for one in checked.findings if one.rule == "stretch" and one.severity == "warning")
    assert torn.value > 1.5 and torn.frame == checked.first_bad_frame
    assert widest_gap(frames[: torn.frame]) <= 1.5


def test_more_particles_stand_closer() -> None:
    """With 16 in a cell, as the note advises, d0 is a quarter of a cell; with one, a stretch of 1.9 tears."""
    assert "particles_per_cell = 9" in before(bar(1.2))[0].fix
    assert before(bar(1.2, 9)) == before(bar(1.2, 16)) == []
    assert before(bar(0.9, 1))[0].severity == "warning"
    assert before(bar(0.05, 1)) == []


@pytest.mark.parametrize(("squeezed", "fires"), [(0.6, False), (0.5, True)])
def test_a_body_that_starts_deformed_relaxes(squeezed: float, fires: bool) -> None:
    """F = diag(1, s) relaxes by 1 / s, which sets particles d0 / s apart; what spins is not stretched by it."""
    still = {"velocity_gradient": None, "deformation": [[1.0, 0.0], [0.0, squeezed]]}
    assert [one.value for one in before(bar(0.0, **still))] == ([pytest.approx(0.5 / squeezed)] if fires else [])
    assert before(bar(0.0, velocity_gradient=[[0.0, -200.0], [200.0, 0.0]])) == []


def moved(frame: Frame, k: int, stretch: float) -> Frame:
    """Return a frame as the k-th with its positions stretched along x."""
    return replace(frame, index=k, position=frame.position * [stretch, 1.0])


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
    position = sample_bodies(scene)[0].position
    label = np.zeros(len(position), np.int32)
    frame = Frame(0, 0.0, 0, position, np.zeros_like(position), label, label)
    findings = FrameFindings()
    check = StretchCheck(header_of(scene, law), findings)
    for k in range(3):
        check.check(moved(frame, k, stretch if k else 1.0))
    found = findings.found()
    assert bool(found) is fires
    if fires:
        assert found[0].frame == 1 and "1 more frame" in found[0].what
    if sampling == "lattice" and law == "neo_hookean":
        assert check.figures["neighbour_distance"] == pytest.approx(stretch / 2)
