"""What colliders take: told by check and info, drawn by plot, and not missed in the budget of momentum."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import run_here
from drawn_results import WATER, frame, header, row
from test_plot import drawn

from mpmcli.check.result_check import ResultCheck, check_result
from mpmcli.output import SegmentStore

POST = {"name": "post", "shape": {"ball": {"center": [0.5, 0.1], "radius": 0.1}}}
ROD = {"name": "rod", "shape": {"box": {"min": [0.1, 0.1], "max": [0.2, 0.2]}}, "velocity": [0.1, 0.0]}
MASS, G, PAUSE, STEP = 2.0, 9.81, 0.01, 1e-3
# On the post and on the rod, N/m, since the frame before.
FORCES = np.array([[[0.0, 0.0], [0.0, 0.0]], [[1.0, -3.0], [0.5, 0.0]], [[2.0, -5.0], [0.0, 1.0]]])


def written(
    directory: Path, colliders: list[dict[str, Any]], contacts: Sequence[list[str]] = (), **changes: Any
) -> Path:
    """Write a run of three frames whose momentum is what gravity gave less what the colliders took."""
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
            "steps": 10 * bool(k),
            "step_min": STEP * bool(k),
            "step_max": STEP * bool(k),
            "speed_max": 1.0,
            "courant_max": 1e-2,
            "volume_ratio_min": 1.0,
            "volume_ratio_max": 1.0,
            "mass": MASS,
            "kinetic": 0.5 + 0.3 * k,
            "linear_momentum": (-taken[0], -fallen - taken[1]),
            "collider_force": tuple(map(tuple, FORCES[k, : len(colliders)].tolist())),
            "collider_torque": ((0.0,),) * len(colliders),
        }
        store.write(entry, replace(row(time, 2), **(numbers | changes)))
    store.finish()
    return directory


def rules(check: ResultCheck) -> set[str]:
    """The rules of its warnings and errors on momentum and energy."""
    return {finding.rule for finding in check.findings if finding.severity != "note"} & {"momentum", "energy"}


def test_what_colliders_took_is_not_missed(tmp_path: Path) -> None:
    check = check_result(written(tmp_path / "run", [POST, ROD]))
    assert rules(check) == set()
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


def test_colliders_that_move_do_work_and_those_that_rest_do_not(tmp_path: Path) -> None:
    moving, resting = (
        check_result(written(tmp_path / name, colliders))
        for name, colliders in (("moving", [POST, ROD]), ("resting", [POST]))
    )
    assert rules(moving) == set() and rules(resting) == {"energy"}
    assert "Colliders that move do work" in moving.text()


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
