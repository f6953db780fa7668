"""What colliders take: told by check and info, drawn by plot, and not missed in the budget of momentum."""

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import run_here
from drawn_results import WATER, frame, header, row
from scenes import ball, body, box, scene_of
from test_plot import drawn

from mpmcli.check.collider_work import unsure_work, work_of_colliders
from mpmcli.check.result_check import ENERGY_SUSPECT, ResultCheck, check_result, energy_change
from mpmcli.output import SegmentStore
from mpmcli.scene.colliders import Collider
from mpmcli.solver.engine.run import build_run

POST = {"name": "post", "shape": ball([0.5, 0.1], 0.1)}
ROD = {"name": "rod", "shape": box([0.1, 0.1], [0.2, 0.2]), "velocity": [0.1, 0.0]}
MASS, G, PAUSE, STEP = 2.0, 9.81, 0.01, 1e-3
# On the post and on the rod, N/m, since the frame before.
FORCES = np.array([[[0.0, 0.0], [0.0, 0.0]], [[1.0, -3.0], [0.5, 0.0]], [[2.0, -5.0], [0.0, 1.0]]])


def written(
    directory: Path,
    colliders: list[dict[str, Any]],
    contacts: Sequence[list[str]] = (),
    *,
    gain: float = 0.0,
    **changes: Any,
) -> Path:
    """Write a run of three frames whose momentum is what gravity gave less what the colliders took.

    Its kinetic energy changes by the work of the rod, which moves at constant velocity, and by `gain` a frame, J.
    """
    facts = header((1.0, 1.0), 0.05, [WATER], colliders)
    facts["contacts"] = list(contacts)
    facts["scene"] = facts["scene"].replace("[domain]", '[domain]\nwalls = "separate"')
    store = SegmentStore(directory, facts)
    for k in range(3):
        entry = frame(k, np.array([[0.5, 0.5], [0.51, 0.5]]))
        time = PAUSE * k
        taken = PAUSE * FORCES[: k + 1, : len(colliders)].sum(axis=(0, 1))
        fallen = MASS * G * max(time - STEP / 2, 0.0)
        numbers = {
            "steps": 10 * bool(k), "step_min": STEP * bool(k), "step_max": STEP * bool(k), "speed_max": 1.0,
            "courant_max": 1e-2, "volume_ratio_min": 1.0, "volume_ratio_max": 1.0, "mass": MASS,
            "kinetic": 0.5 + gain * k - 0.1 * PAUSE * FORCES[: k + 1, 1, 0].sum(),
            "linear_momentum": (-taken[0], -fallen - taken[1]),
            "collider_force": tuple(map(tuple, FORCES[k, : len(colliders)].tolist())),
            "collider_torque": ((0.0,),) * len(colliders),
        }  # fmt: skip
        store.write(entry, replace(row(time, 2), **(numbers | changes)))
    store.finish()
    return directory


def rules(check: ResultCheck) -> set[str]:
    """The rules of its warnings and errors on momentum and energy."""
    return {finding.rule for finding in check.findings if finding.severity != "note"} & {"momentum", "energy"}


def test_what_colliders_took_is_not_missed(tmp_path: Path) -> None:
    check = check_result(written(tmp_path / "run", [POST, ROD]))
    assert rules(check) == set()
    assert check.figures["collider_work"] == pytest.approx(-0.1 * PAUSE * FORCES[:, 1, 0].sum(), rel=1e-12)
    assert check.figures["energy_growth"] < 1e-12
    assert check.figures["momentum_frames"] == 2 and check.figures["momentum_drift"] < 1e-12
    taken = PAUSE * np.linalg.norm(FORCES.sum(axis=(0, 1)))
    assert check.figures["collider_impulse"] == pytest.approx(taken, rel=1e-12)
    assert "momentum that colliders took, kg m/s  0.07826" in check.text()
    # Half of it is not told.
    half = tuple(map(tuple, (0.5 * FORCES[2]).tolist()))
    wrong = check_result(written(tmp_path / "wrong", [POST, ROD], collider_force=half))
    assert "momentum" in rules(wrong)
    assert "nothing but gravity and colliders acted" in wrong.text()


def test_a_ledger_that_does_not_tell_is_not_compared(tmp_path: Path) -> None:
    check = check_result(written(tmp_path / "run", [POST], collider_force=(), collider_torque=()))
    assert check.figures["momentum_frames"] == 0 and check.figures["collider_impulse"] is None


def test_energy_beyond_the_work_of_colliders_is_found(tmp_path: Path) -> None:
    """With a rigid body that moves freely the balance is not known, as colliders do work on it, too."""
    assert rules(check_result(written(tmp_path / "more", [POST, ROD], gain=0.02))) == {"energy"}
    free = check_result(written(tmp_path / "free", [POST | {"density": 500.0}, ROD], gain=0.02))
    assert rules(free) == set() and "so that the balance of energy is not known" in free.text()


@pytest.mark.parametrize("dimension", [2, 3])
def test_the_work_of_a_collider_is_the_integral_of_its_power(dimension: int) -> None:
    """Of fourth order in the time between frames, with means of its load between them, for any motion."""
    d, turns = dimension, 2 * dimension - 3
    motion = {"velocity": ["cos(3*t)", "2*t", "0*t"][:d], "angular_velocity": "sin(5*t)"}
    motion |= {"axis": [2.0, 2.0, 1.0]} if d == 3 else {}
    shape = ball([0.5] * d, 0.1)
    collider = Collider.model_validate({"name": "one", "shape": shape} | motion, context={"dimension": d})

    def gone(t: np.ndarray) -> np.ndarray:
        """Impulse and angular impulse up to t, of the load (cos t, 1, t) and a torque of cos 2t per axis."""
        angular = np.sin(2 * t) / 2
        return np.stack([np.sin(t), t, t**2 / 2][:d] + [angular] * turns, axis=-1)

    errors = []
    for frames in (8, 16):
        t = np.linspace(0.0, 1.0, frames + 1)
        means = np.diff(gone(t), axis=0, prepend=0.0) * frames
        rows = [
            replace(row(time, d), collider_force=(tuple(mean[:d]),), collider_torque=(tuple(mean[d:]),))
            for time, mean in zip(t, means, strict=True)
        ]
        s = (np.arange(100_000) + 0.5) / 100_000
        around = np.cos(2 * s) * np.sin(5 * s) * (1.0 if d == 2 else 5.0 / 3.0)
        exact = -(np.cos(s) * np.cos(3 * s) + 2 * s + around).mean()
        errors.append(abs(work_of_colliders(rows, [collider])[-1] - exact))
    assert errors[0] < 2e-3 and errors[1] < errors[0] / 6


def test_work_is_unsure_where_a_collider_starts_abruptly() -> None:
    """At constant acceleration against a load that grows from zero with time: no energy from nothing is found there."""
    motion = {"velocity": ["3*clamp(t-0.2,0,9)", "0*t"]}
    shape = ball([0.5, 0.5], 0.1)
    collider = Collider.model_validate({"name": "one", "shape": shape} | motion, context={"dimension": 2})
    t = np.linspace(0.0, 1.0, 51)
    moves = np.maximum(t - 0.2, 0.0)
    means = np.diff(moves**2 / 2, prepend=0.0) * 50
    rows = [
        replace(row(time, 2), collider_force=((-mean, 0.0),), collider_torque=((0.0,),))
        for time, mean in zip(t, means, strict=True)
    ]
    taken, work, unsure = moves**3, work_of_colliders(rows, [collider]), unsure_work(rows, [collider])
    still = np.zeros(51)
    assert energy_change(taken, still, still, work)[0].max() > ENERGY_SUSPECT
    assert energy_change(taken, still, still, work + unsure)[0].max() < 1e-9
    assert (np.abs(work - taken) <= unsure + 1e-12).all() and unsure[-1] < 1e-3 * work[-1]
    assert energy_change(1.03 * taken, still, still, work + unsure)[0].max() > ENERGY_SUSPECT


@pytest.mark.parametrize("dimension", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_work_is_summed_by_step(backend_of: Callable, dimension: int) -> None:
    """A collider that starts at 0.3 of a frame holds a body and turns: its work is m v^2/2 and what turns, to first
    order in the step. From means over frames it is wrong by a seventh in the first frame."""
    d, h = dimension, 0.1
    shape = box([0.8] * d, [1.4] * d)
    material = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}
    start = "clamp((t - 0.013) / 0.02, 0, 1)"
    holder = {"name": "holder", "wall": "hold", "velocity": [f"0.5 * {start}"] + ["0 * t"] * (d - 1)}
    holder |= {"angular_velocity": f"2 * {start}", "pivot": [1.0] * d} | ({"axis": [1.0, 2.0, 2.0]} if d == 3 else {})
    scene = scene_of(
        body("body", material, shape),
        domain={"size": [2.4] * d, "spacing": h, "gravity": [0.0] * d},
        time={"end": 0.04, "frames": 4, "step": 1e-4},
        colliders=[holder | {"shape": box([0.4] * d, [1.8] * d)}],
    )
    rows = [row for _, row in build_run(scene, backend_of("f32", 1)).frames()]
    kinetic, works = np.array([row.kinetic for row in rows]), np.array([row.collider_work for row in rows])
    assert rows[0].collider_work == 0 and kinetic[-1] > 1
    # Each step adds v dv, of which dv^2/2 does not stay: one in 70 and in 200 steps.
    assert np.cumsum(works) == pytest.approx(kinetic, rel=0.02)
    estimated = work_of_colliders(rows, scene.colliders)
    assert abs(estimated[2] - kinetic[2]) > 0.1 * kinetic[2]


def test_a_load_that_is_no_number_is_found(tmp_path: Path) -> None:
    check = check_result(written(tmp_path / "run", [POST], collider_torque=((np.nan,),)))
    assert "collider_torque of the ledger is not finite" in check.text()


def test_plot_draws_the_force_on_each_collider(tmp_path: Path) -> None:
    written(tmp_path / "run", [POST, ROD])
    with drawn(tmp_path / "run") as panels:
        assert list(panels)[-2:] == ["Force on colliders along x", "Force on colliders along y"]
        assert "Impulse of the walls and colliders" in panels
        assert panels["Change of total energy"].get_ylabel().replace("\n", " ").endswith("while colliders do work")
        for axis, title in enumerate(list(panels)[-2:]):
            post, rod = (line.get_xydata() for line in panels[title].lines[:2])
            assert [line.get_label() for line in panels[title].lines[:2]] == ["post", "rod"]
            assert np.allclose(post[:, 1], FORCES[1:, 0, axis]) and np.allclose(rod[:, 1], FORCES[1:, 1, axis])
            assert panels[title].get_ylabel().replace("\n", " ") == "mean since the previous frame, N/m"
    written(tmp_path / "bare", [])
    with drawn(tmp_path / "bare") as panels:
        assert not any("colliders" in title for title in panels)


def test_plot_adds_up_the_forces_on_many_colliders(tmp_path: Path) -> None:
    posts = [{**POST, "name": f"post {k}"} for k in range(8)]
    forces = tuple((float(k), 1.0) for k in range(8))
    written(tmp_path / "run", posts, collider_force=forces, collider_torque=((0.0,),) * 8)
    with drawn(tmp_path / "run") as panels:
        (line,) = panels["Force on colliders along x"].lines[:-1]
        assert line.get_label() == "all together" and np.allclose(line.get_ydata(), 28.0)


def test_plot_shows_the_pairs_with_the_largest_forces(tmp_path: Path) -> None:
    """Of seven pairs the one that never touched is left out; each has the name of who pushes whom."""
    contacts = [["base", f"block {k}"] for k in range(7)]
    forces = tuple((0.1 * k, -float(k)) for k in range(7))
    written(tmp_path / "run", [], contacts=contacts, contact_force=forces, contact_torque=((0.0,),) * 7)
    with drawn(tmp_path / "run") as panels:
        *lines, _level = panels["Force on bodies along y"].lines
        assert [line.get_label() for line in lines] == [f"block {k} on base" for k in range(1, 7)]
        assert np.allclose(lines[-1].get_ydata(), -6.0)
    assert json.loads(run_here("info", tmp_path / "run", "--json").stdout)["contacts"][0] == "base - block 0"


def test_info_names_colliders(tmp_path: Path) -> None:
    written(tmp_path / "run", [POST, ROD])
    assert json.loads(run_here("info", tmp_path / "run", "--json").stdout)["colliders"] == ["post", "rod"]
    scene = """\
[domain]
size = [1.0, 1.0]
cells = [20, 20]
[time]
end = 0.1
frames = 1
[[bodies]]
name = "water"
material = "water"
shape = { box = { min = [0.3, 0.5], max = [0.6, 0.8] } }
[[colliders]]
name = "post"
shape = { ball = { center = [0.5, 0.1], radius = 0.1 } }
[[colliders]]
name = "rod"
shape = { box = { min = [0.1, 0.1], max = [0.2, 0.2] } }
velocity = [0.1, 0.0]
"""
    (tmp_path / "scene.toml").write_text(scene, encoding="utf-8")
    told = json.loads(run_here("info", tmp_path / "scene.toml", "--json").stdout)["colliders"]
    assert told == ["post: ball", "rod: box, moving"]
