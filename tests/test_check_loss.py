"""What the transfers will take, as the check of a scene says it, against what runs lose."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from check_scenes import FLUID, SOLID, box, found, loaded
from solver_state import scene_of

from mpmcli.check import step_rules
from mpmcli.check.facts import SceneFacts
from mpmcli.check.finding import Finding
from mpmcli.check.forecast import expected_steps
from mpmcli.check.scene_check import check_scene
from mpmcli.check.step_rules import NOTED_LOSS, chord, flow_width
from mpmcli.scene import LoadedScene, Scene
from mpmcli.scene.forces import Contact
from mpmcli.scene.schema import USUAL_FLIP, SolverSettings
from mpmcli.scene.shapes import Ball, Box, Polygon
from mpmcli.solver.engine.run import build_run
from mpmcli.stability.transfer_factors import impact_loss
from mpmcli.validation.case import Setting
from mpmcli.validation.cases import all_cases
from mpmcli.validation.runs import scene_of as scene_of_case

DENSITY, SOUND, NU = 1000.0, 20.0, 0.1


def channel(cells: int, safety: float, **more: Any) -> Scene:
    """Return a slug of fluid between walls with "stick" 1 m apart, driven to 0.1 m/s; Re = 1, and 4 m long."""
    relaxed = 1 / (NU * math.pi**2)
    material = FLUID | {"density": DENSITY, "bulk_modulus": DENSITY * SOUND**2, "viscosity": DENSITY * NU}
    return scene_of(
        domain={
            "size": [6.0, 1.0],
            "spacing": 1 / cells,
            "gravity": [8 * NU * 0.1, 0.0],
            "walls": {"default": "slip", "y_min": "stick", "y_max": "stick"},
        },
        time={"end": 5 * relaxed, "frames": 5, "safety": safety},
        bodies=[{"name": "slug", "material": material, "shape": box([1.0, 0.0], [5.0, 1.0])}],
        solver={"precision": "f64"} | more,
    )


def bars(cells: int, safety: float, speed: float, *, free: bool = False, **more: Any) -> Scene:
    """Return two elastic bars of 1 m, as wide as the domain, that meet head on at `speed` times their wave speed.

    `free` ones, in a domain of 64 x 32 cells, do the same at low speeds, as they do not become wider. Their kernels are
    those of test_body_contact.py: no gravity is two expressions, which the check would not look through.
    """
    h, rows, gap = 1 / cells, 5, 4
    sound = math.sqrt(SOLID["youngs_modulus"] / SOLID["density"])
    room = math.ceil(8 * speed * cells) + 2
    material = SOLID | {"poissons_ratio": 0.0}
    lows = [room * h, (room + cells + gap) * h]
    low = 12 * h if free else 0.0
    domain = {"size": [(2 * (cells + room) + gap) * h, rows * h], "spacing": h, "walls": "slip"}
    if free:
        walls = {"default": "separate", "y_min": "stick"}
        domain |= {"size": [64 * h, 32 * h], "walls": walls, "gravity": ["0*t", "0*t*t"]}
    return scene_of(
        domain=domain,
        time={"end": (gap * h / 2 / speed + 12) / sound, "frames": 40, "safety": safety},
        bodies=[
            {
                "name": name,
                "material": material,
                "shape": box([left, low], [left + 1.0, low + rows * h]),
                "velocity": [sign * speed * sound, 0.0],
            }
            for name, left, sign in (("left", lows[0], 1), ("right", lows[1], -1))
        ],
        solver={"precision": "f64"} | more,
    )


@pytest.fixture(autouse=True)
def _small_losses_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_rules, "NOTED_LOSS", 0.02)


def told(scene: Scene, rule: str) -> list[Finding]:
    """Return what a rule finds in a scene."""
    return [one for one in check_scene(LoadedScene(scene, (), "scene.toml")).findings if one.rule == rule]


def driven(y: np.ndarray, time: float) -> np.ndarray:
    """Return the velocity at the height y of a flow between walls at rest that gravity drives, m/s."""
    k = np.arange(1, 100, 2) * math.pi
    modes = 4 * 8 * NU * 0.1 / (k * NU * k**2) * -np.expm1(-NU * k**2 * time)
    return np.sin(np.outer(y, k)) @ modes


@pytest.mark.parametrize(("cells", "safety"), [(10, 0.8), pytest.param(10, 0.3, marks=pytest.mark.slow)])
def test_a_viscous_flow_is_as_slow_as_foretold(backend_of: Callable, cells: int, safety: float) -> None:
    """nu_num = loss per step / (dt k^2), k = pi / W: the flow is slower by nu_num / (nu + nu_num), within a half.

    dt is the step of safety 0.8, whatever the safety.
    """
    scene = channel(cells, safety)
    (finding,) = told(scene, "numerical-viscosity")
    step = scene.time.end / expected_steps(SceneFacts(channel(cells, 0.8)))
    k = math.pi
    assert finding.value == pytest.approx(0.024 * (k / cells) ** 4 / (step * k**2) / NU, rel=5e-3)
    assert finding.severity == "note"
    *_, (frame, _) = build_run(scene, backend_of("f64", 1)).frames()
    middle = np.abs(frame.position[:, 0] - np.median(frame.position[:, 0])) < 0.5
    expected = driven(frame.position[middle, 1], scene.time.end)
    slow = 1 - frame.velocity[middle, 0].mean() / expected.mean()
    assert slow / 1.5 < finding.value / (1 + finding.value) < 1.5 * slow


def test_what_lowers_the_viscosity_of_the_transfers() -> None:
    """An eighth with half the spacing where waves bind; 1 - flip with AFLIP; below 2 % nothing is said."""
    (one,), (slow,) = (told(channel(10, safety), "numerical-viscosity") for safety in (0.8, 0.3))
    assert f"{100 * one.value / 8:.2g} %" in one.fix and f"{100 * (1 - USUAL_FLIP) * one.value:.2g} %" in one.fix
    assert slow.value == pytest.approx(one.value, rel=2e-3)
    assert told(channel(20, 0.8), "numerical-viscosity") == []
    assert told(channel(10, 0.8, transfer="aflip", flip=0.95), "numerical-viscosity") == []
    # Water: in the run its own viscosity does nothing.
    assert found("numerical-viscosity", material=FLUID | {"viscosity": 1e-3}) == []


@pytest.mark.parametrize(
    ("low", "high", "walls", "width"),
    [
        # Between two walls; a film on one; free on both sides; along the film without end.
        ([0.25, 0.0], [0.75, 1.0], {"default": "slip", "y_min": "stick", "y_max": "stick"}, 0.5),
        ([0.0, 0.0], [1.0, 1.0], {"default": "slip", "y_min": "stick", "y_max": "stick"}, 1.0),
        ([0.0, 0.0], [1.0, 0.25], {"default": "slip", "y_min": "stick"}, 0.5),
        ([0.0, 0.5], [1.0, 0.75], {"default": "slip", "y_min": "stick"}, 0.25),
    ],
)
def test_the_longest_wave_of_a_flow(low: list[float], high: list[float], walls: dict, width: float) -> None:
    """Half a wave between two surfaces of one kind, a quarter between a wall and a free surface."""
    facts = SceneFacts(loaded(shape=box(low, high), domain={"walls": walls}).scene)
    assert flow_width(facts, facts.bodies[0]) == pytest.approx(width)


@pytest.mark.parametrize(
    ("cells", "safety", "speed"),
    [(16, 0.8, 0.01), *(pytest.param(*how, marks=pytest.mark.slow) for how in ((16, 0.3, 0.01), (32, 0.8, 0.05)))],
)
def test_an_impact_loses_what_was_foretold(backend_of: Callable, cells: int, safety: float, speed: float) -> None:
    """Bars that meet slowly: the share of the energy that is gone when they have parted, within a half."""
    scene = bars(cells, safety, speed)
    finding, other = told(scene, "impact-loss")
    assert (finding.body, other.body, finding.severity) == ("left", "right", "note")
    assert finding.value == pytest.approx(other.value)
    rows = [row for _, row in build_run(bars(cells, safety, speed, free=cells == 16), backend_of("f64", 1)).frames()]
    lost = 1 - rows[-1].energy / rows[0].energy
    assert lost / 1.5 < finding.value < 1.5 * lost


@pytest.mark.parametrize("speed", [0.01, pytest.param(0.3, marks=pytest.mark.slow)])
def test_an_impact_of_surfaces_loses_what_was_foretold(backend_of: Callable, speed: float) -> None:
    """The same where bars have velocity fields of their own, within a factor of 2; AFLIP is no cure."""
    scene, same = (
        bars(16, 0.8, speed, free=free).model_copy(update={"contact": Contact(default="separate")})
        for free in (False, speed < 0.1)
    )
    finding, _ = told(scene, "impact-loss")
    assert "aflip" not in finding.fix
    rows = [row for _, row in build_run(same, backend_of("f64", 1)).frames()]
    lost = 1 - rows[-1].energy / rows[0].energy
    assert lost / 2 < finding.value < 2 * lost


def test_disks_that_collide_lose_what_was_foretold(backend_of: Callable) -> None:
    """The validation case of two disks at its coarsest, 8 cells across, within a factor of 2."""
    case = all_cases()["two_disks"]
    scene = scene_of_case(case, 20, Setting())
    finding, _ = told(scene, "impact-loss")
    frames = list(build_run(scene, backend_of("f64", 1)).frames())
    lost = case.measure(20, scene, iter(frames))["energy loss"]
    assert lost / 2 < finding.value < 2 * lost


def test_no_impact_is_told_where_there_is_none() -> None:
    """A block at rest on the floor, one that touches a wall along which it flies, one that arrives after the end."""
    resting = {"material": SOLID, "shape": box([0.25, 0.0], [0.5, 0.25])}
    assert found("impact-loss", **resting) == []
    flying = {"shape": box([0.25, 0.0], [0.5, 0.25]), "material": SOLID, "domain": {"gravity": [0.0, 0.0]}}
    assert found("impact-loss", velocity=[1.0, 0.0], time={"end": 0.4}, **flying) == []
    assert len(found("impact-loss", velocity=[1.0, 0.0], time={"end": 0.6}, **flying)) == 1
    # AFLIP loses an eighth of it at least, and fluid is not looked at.
    assert told(bars(32, 0.8, 0.01, transfer="aflip", flip=0.95), "impact-loss") == []
    assert found("impact-loss", material=FLUID, shape=box([0.25, 0.5], [0.5, 0.75])) == []


def test_the_law_of_the_loss_in_an_impact() -> None:
    """~ 1 / (n C), layers a cell thick in each step; the slower the longer, until waves have crossed the bars."""
    usual = SolverSettings()
    small = impact_loss(usual, 1000, 0.01, 0.8)
    assert impact_loss(usual, 2000, 0.01, 0.8) == pytest.approx(small / 2, rel=1e-2)
    assert impact_loss(usual, 1000, 0.01, 0.4) == pytest.approx(2 * small, rel=1e-2)
    assert impact_loss(usual, 1000, 0.0025, 0.8) == pytest.approx(2 * small, rel=1e-2)
    assert impact_loss(usual, 1000, 1e-9, 0.8) == impact_loss(usual, 1000, 0.0, 0.8) < 12 * small
    assert impact_loss(SolverSettings(transfer="aflip", flip=0.95), 1000, 0.01, 0.8) < 0.13 * small
    assert small < NOTED_LOSS


def test_the_mean_length_of_a_shape() -> None:
    """Volume over projection: pi R / 2 of a disk, 4 R / 3 of a ball; half the base of a triangle."""
    x = np.array([1.0, 0.0])
    flat = Box.model_construct(min=(0, 0), max=(3, 2))
    square = Box.model_construct(min=(0, 0), max=(2, 2))
    assert chord(flat, x) == 3
    assert chord(square, np.sqrt([0.5, 0.5])) == pytest.approx(math.sqrt(2))
    assert chord(Ball.model_construct(center=(0, 0), radius=2), x) == pytest.approx(math.pi)
    assert chord(Ball.model_construct(center=(0, 0, 0), radius=3), np.array([0, 0, 1.0])) == pytest.approx(4)
    assert chord(Polygon.model_construct(vertices=((0, 0), (4, 0), (0, 1))), x) == pytest.approx(2)
