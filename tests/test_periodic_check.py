"""What looks across periodic faces on the host: checks before and after a run, the ledger, and exports."""

import json
from pathlib import Path

import numpy as np
import pytest
from check_scenes import forms_of
from command import CONFIGS, run_here
from scenes import ball, body, box, scene_of, volume_errors

from mpmcli.check.facts import arrivals
from mpmcli.check.geometry import close_pairs
from mpmcli.dataset.metadata import motion_statistics
from mpmcli.scene import Scene, scene_bounds

JELLY = {"law": "neo_hookean", "density": 1000.0, "youngs_modulus": 1e5, "poissons_ratio": 0.3}


def two_balls(gravity: tuple[float, float] = (0.0, 0.0), speed: float = 1.0, **domain: object) -> Scene:
    """Return a ball that flies to the right, 0.3 m from the face, and one that rests 0.1 m behind the other face."""
    places = {"flying": ([1.6, 0.5], [speed, 0.0]), "resting": ([0.2, 0.5], [0.0, 0.0])}
    walls = {"default": "stick", "x_min": "periodic", "x_max": "periodic"}
    return scene_of(
        *(body(name, JELLY, ball(center, 0.1), velocity=velocity) for name, (center, velocity) in places.items()),
        domain={"size": [2.0, 1.0], "spacing": 0.05, "gravity": list(gravity), "walls": walls} | domain,
        end=2.0,
    )


def test_a_body_meets_another_across_the_face() -> None:
    """0.4 m apart, and in contact within a cell: after 0.35 s at 1 m/s. The faces stop nothing."""
    for found in arrivals(two_balls()):
        assert found.time == pytest.approx(0.35) and found.speed == pytest.approx(1.0)
    assert arrivals(two_balls(speed=0.0))[0].time == np.inf
    assert [pair[:2] for pair in close_pairs(two_balls(), forms_of(two_balls()), 0.41)] == [(0, 1)]
    assert [pair[2] for pair in close_pairs(two_balls(), forms_of(two_balls()), 0.41)] == [pytest.approx(0.4)]
    assert list(close_pairs(two_balls(), forms_of(two_balls()), 0.39)) == []


def test_nothing_falls_onto_a_periodic_face() -> None:
    """Gravity along it acts for as long as the run, and presses on nothing."""
    bounds = scene_bounds(two_balls(gravity=(3.0, 0.0)))
    assert bounds.speed == pytest.approx(1.0 + 3.0 * 2.0)
    assert bounds.height == pytest.approx(1.6)
    assert scene_bounds(two_balls(wall_velocity={"y_max": [7.0, 0.0]})).speed == 7.0


@pytest.mark.parametrize(
    ("material", "speed"),
    [
        ({"law": "fluid", "viscosity": 50.0}, 1000.0 * 3.0 * 0.5**2 / 50.0),
        ({"law": "viscoplastic", "yield_stress": 2000.0, "consistency": 1.0}, 0.0),
        ({"law": "fluid"}, 60.0),
    ],
)
def test_a_layer_that_sticks_is_no_faster_than_its_weight_shears_it(material: dict, speed: float) -> None:
    """rho g H^2 / mu at most, to the spacing of the rates; a paste below its yield stress rests; else gravity t."""
    shape = box([0.0, 0.0], [2.0, 0.5])
    film = body("film", material | {"density": 1000.0}, shape)
    walls = {"x_min": "periodic", "x_max": "periodic", "y_min": "stick"}
    domain = {"size": [2.0, 1.0], "spacing": 0.05, "gravity": [3.0, 0.0], "walls": walls}
    found = scene_bounds(scene_of(film, domain=domain, end=20.0)).speed
    assert speed <= found <= 1.3 * speed


def test_the_cells_across_the_face_are_neighbours() -> None:
    """A layer that fills the lower half from face to face is inside up to both, where walls would say the same.

    Half of it, cut off at a face, is not inside there: the other side is empty.
    """
    x = (np.stack(np.meshgrid(np.arange(64), np.arange(32), indexing="ij"), -1).reshape(-1, 2) + 0.5) / 64
    full, flows = np.full((1, len(x)), 1 / 64**2), np.ones(len(x), bool)
    for periodic in (True, False):
        assert volume_errors(x[None], 0.5 * full, flows, 1 / 64, (64, 64), (periodic, False)) == pytest.approx(1.0)
    edge = np.where(x[:, 0] < 1 / 64, 0.5, 1.0) / 64**2
    left = x[:, 0] < 0.5
    assert volume_errors(x[None, left], edge[None, left], flows[left], 1 / 64, (64, 64), (True, False)) == 0.0
    assert volume_errors(x[None, left], edge[None, left], flows[left], 1 / 64, (64, 64), (False, False)) > 0.01


def test_statistics_of_motion_take_the_way_across_the_face() -> None:
    path = np.arange(12.0)[:, None, None] * np.array([0.3, 0.1]) + np.random.default_rng(1).uniform(0, 1, (1, 20, 2))
    wrapped = path % np.array([1.0, 1e9])
    found = motion_statistics([[wrapped[:5], wrapped[5:]]], [np.array([1.0, np.inf])])
    expected = motion_statistics([[path]])
    assert np.abs(found["vel_mean"] - expected["vel_mean"]).max() < 1e-12
    assert (found["vel_std"] == 1.0).all() and np.abs(found["acc_mean"]).max() < 1e-12


@pytest.mark.slow
def test_a_run_that_repeats_is_sound_and_exported(tmp_path: Path) -> None:
    """Particles cross the face in every frame, and none is taken for one that was moved."""
    more = {
        "domain.spacing": "0.0125",
        "domain.wall_velocity.y_min": "[0.1, 0.0]",
        "time.frames": "20",
        "time.end": "2",
    }
    options = [word for key, value in more.items() for word in ("--set", f"{key}={value}")]
    result = tmp_path / "result"
    assert run_here("simulate", CONFIGS / "couette_2d.toml", "-o", result, "--quiet", *options).status == 0
    checked = json.loads(run_here("check", result, "--json").stdout)
    assert {finding["severity"] for finding in checked["findings"]} <= {"note"}
    assert run_here("export", result, "--to", "lagrangebench", "-o", tmp_path / "out").status == 0
    facts = json.loads((tmp_path / "out" / "metadata.json").read_text(encoding="utf-8"))
    assert facts["periodic_boundary_conditions"] == [True, False, False]
    assert 0 < facts["vel_mean"][0] < 0.011 and facts["vel_std"][0] < 0.01
