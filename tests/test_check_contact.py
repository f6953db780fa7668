"""What `check RESULT` says of elastic bodies that meet obstacles and each other: friction, spin, and energy lost.

Frames are those of rigid motion in closed form, but for a disc that a run computes with both kinds of contact.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from check_scenes import SOLID
from made_result import made_row
from solver_state import scene_of
from test_check_frames import header_of

from mpmcli.check.finding import Finding, FrameFindings
from mpmcli.check.result_check import check_kept
from mpmcli.check.result_contact import ContactCheck
from mpmcli.frames.frame import Frame
from mpmcli.scene import Scene, sample_bodies
from mpmcli.solver.engine.run import build_run

H, R, END, COUNT = 0.02, 0.2, 0.6, 31
TIMES = np.linspace(0.0, END, COUNT)
G = 9.81


def disc(mu: float = 0.1, slope: float = 0.0, d: int = 2, **more: object) -> Scene:
    """Return the scene of a ball on a floor that is turned by an angle, by gravity."""
    gravity = [G * math.sin(slope), -G * math.cos(slope), 0.0][:d]
    domain = {"size": [3.0, 0.6, 0.6][:d], "spacing": H if d == 2 else 2 * H, "gravity": gravity}
    domain |= {"walls": "separate", "friction": mu}
    shape = {"ball": {"center": [0.4, R, 0.3][:d], "radius": R}}
    body = {"name": "disc", "material": SOLID, "shape": shape} | more
    return scene_of(domain=domain, time={"end": END, "frames": COUNT - 1}, bodies=[body], contact={"default": "auto"})


def told(
    scene: Scene,
    motion: Callable[[float], tuple[float, float, float, float]],
    hop: Callable[[float], tuple[float, float]] = lambda t: (0.0, 0.0),
) -> list[Finding]:
    """Return what is found in a ball that moves along x: `motion` gives its way, speed, angle and spin at a time.

    `hop` gives its height and how fast it rises.
    """
    findings = FrameFindings()
    check = ContactCheck(header_of(scene), findings)
    x, d = sample_bodies(scene)[0].position, scene.dimension
    center = x.mean(axis=0)
    label = np.zeros(len(x), np.int32)
    for k, t in enumerate(TIMES.tolist()):
        way, speed, angle, spin = motion(t)
        turn, out = np.eye(d), np.zeros((d, d))
        turn[:2, :2] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
        out[:2, :2] = [[0.0, -spin], [spin, 0.0]]
        r = (x - center) @ turn.T
        up, rise = hop(t)
        moved, speeds = (np.pad([along, y], (0, d - 2)) for along, y in ((way, up), (speed, rise)))
        check.check(Frame(k, t, k, center + moved + r, speeds + r @ out.T, label, label), made_row(k, d, time=t))
    check.end()
    return list(findings.found())


def sliding(
    mu: float, slope: float, d: int, turns: float = 1.0
) -> Callable[[float], tuple[float, float, float, float]]:
    """Return how a rigid ball slides down from rest: a = g (sin - mu cos), angular acceleration mu g cos R m / I."""
    a = G * (math.sin(slope) - mu * math.cos(slope))
    alpha = -turns * mu * G * math.cos(slope) / R * (2.0 if d == 2 else 2.5)
    return lambda t: (a * t * t / 2, a * t, alpha * t * t / 2, alpha * t)


@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("mu", [0.05, 0.1])
def test_a_ball_that_slides_as_coulomb_says_is_right(mu: float, d: int) -> None:
    assert told(disc(mu, 0.5, d), sliding(mu, 0.5, d)) == []


@pytest.mark.parametrize("d", [2, 3])
def test_a_body_that_slides_with_less_friction_is_found_with_what_it_had(d: int) -> None:
    found = told(disc(0.1, 0.5, d), sliding(0.05, 0.5, d))
    assert [(one.rule, one.severity, one.body) for one in found] == [("slides", "warning", "disc")]
    assert found[0].value == pytest.approx(0.05, rel=1e-3)  # exact for a constant force


def test_a_body_that_slides_below_its_friction_angle_is_found() -> None:
    """At constant speed on a slope of 0.1 rad the friction is tan(0.1), where 0.4 would stop the body."""
    found = told(disc(0.4, 0.1), lambda t: (0.3 * t, 0.3, 0.0, 0.0))
    assert [one.rule for one in found][:1] == ["slides"]
    assert found[0].value == pytest.approx(math.tan(0.1), rel=1e-3)


def test_a_body_that_hops_does_not_slide() -> None:
    """The same in hops of 0.06 s and 4 mm: in an impact friction stops the surface, and then is what it must be."""
    fall, lasts = G * math.cos(0.1), 0.06
    hop = lambda t: (fall / 2 * (t % lasts) * (lasts - t % lasts), fall * (lasts / 2 - t % lasts))  # noqa: E731
    found = told(disc(0.4, 0.1), lambda t: (0.3 * t, 0.3, 0.0, 0.0), hop)
    assert "slides" not in [one.rule for one in found]


@pytest.mark.parametrize("turns", [0.0, 0.5, -1.0])
def test_a_spin_that_friction_does_not_give_is_found(turns: float) -> None:
    found = told(disc(0.05, 0.5), sliding(0.05, 0.5, 2, turns))
    assert [one.rule for one in found] == ["spin"]
    assert found[0].value == pytest.approx(1 - turns, rel=1e-2)


@pytest.mark.parametrize("d", [2, 3])
def test_a_ball_that_rolls_is_right_though_its_friction_is_less(d: int) -> None:
    """a = g sin / (1 + I / m R^2), and the spin is the speed over R."""
    a = G * math.sin(0.3) / (1.5 if d == 2 else 1.4)
    assert told(disc(0.5, 0.3, d), lambda t: (a * t * t / 2, a * t, -a * t * t / 2 / R, -a * t / R)) == []


def test_a_soft_ball_may_rest_on_a_slope() -> None:
    assert told(disc(0.5, 0.1), lambda t: (0.0, 0.0, 0.0, 0.0)) == []


def thrown(kept: Sequence[float]) -> list[Finding]:
    """Return what is found in a disc that hits the upper wall along x, and leaves with the energies `kept` (J)."""
    findings = FrameFindings()
    scene = disc(0.0)
    gravity = scene.domain.model_copy(update={"gravity": (0.0, 0.0)})
    scene = scene.model_copy(update={"domain": gravity})
    check = ContactCheck(header_of(scene), findings)
    x = sample_bodies(scene)[0].position + np.array([1.0, 0.1])
    label, gap = np.zeros(len(x), np.int32), 3.0 - x[:, 0].max()
    for k, t in enumerate(np.linspace(-1.5, 1.5, len(kept))):
        speed = -math.copysign(0.1, t) * kept[k] ** 0.5
        place = x + np.array([gap - 0.1 * abs(t) - 0.01, 0.0])
        row = made_row(k, 2, time=float(t), kinetic=kept[k], elastic=0.0, potential=0.0)
        check.check(Frame(k, t, k, place, np.tile([speed, 0.0], (len(x), 1)), label, label), row)
    check.end()
    return list(findings.found())


@pytest.mark.parametrize(("left", "severity"), [(0.98, None), (0.85, "note"), (0.5, "warning")])
def test_a_meeting_that_takes_energy_is_found(left: float, severity: str | None) -> None:
    """Turned over is the range of the kinetic energy, which has no minimum between these frames: what is lost."""
    found = thrown([1.0] * 15 + [0.0, left] + [left] * 14)
    assert [one.severity for one in found] == ([severity] if severity else [])
    if found:
        assert (found[0].rule, found[0].body) == ("meeting", "disc") and '"x_max"' in found[0].what
        assert found[0].value == pytest.approx(1 - left)


def test_a_disc_that_sticks_to_a_slope_does_not_spin_and_by_default_does(backend_of: Callable) -> None:
    """A run of each kind of contact: on the grid friction has no moment (docs/theory.md, 2.8)."""
    verdicts = []
    for contact in ("stick", "auto"):
        scene = disc(0.05, 0.35)
        scene = scene.model_copy(update={"contact": scene.contact.model_copy(update={"default": contact})})
        frames = zip(*build_run(scene, backend_of("f32", 1)).frames(), strict=True)
        verdicts.append({one.rule for one in check_kept(header_of(scene, precision="f32"), *frames).findings})
    assert verdicts == [{"spin"}, set()]
