"""Bounds on gravity and forces: pulses and narrow forces are found, and what nothing reaches does not count."""

import math

import pytest
from check_scenes import SOLID, box, check, loaded

from mpmcli.check.facts import SceneFacts
from mpmcli.scene import scene_bounds
from mpmcli.scene.bounds import gravity_drive
from mpmcli.scene.schema import Force

FREE = {"gravity": [0.0, 0.0]}


def forced(*acceleration: object, **keywords: object) -> object:
    """Return a block under a force, without gravity, for 0.5 s."""
    asked = loaded(domain=FREE, **{"shape": box([0.25, 0.25], [0.5, 0.5])} | keywords).scene

    force = Force.model_validate({"acceleration": list(acceleration)}, context={"dimension": 2})
    return asked.model_copy(update={"forces": (force,)})


def test_a_pulse_of_gravity_is_found() -> None:
    """5000 m/s^2 for 20 us: as strong as it is, and no faster than ten times its impulse of 0.1 m/s."""
    asked = loaded(domain={"gravity": [0.0, "-5000 if t > 0.2003 and t < 0.20032 else 0"]})
    drive, _ = gravity_drive(asked.scene)
    assert drive.largest == 5000.0
    assert 0.1 * (1 - 1e-9) <= drive.impulse <= 1.0
    bounds = scene_bounds(asked.scene)
    assert (bounds.gravity, bounds.speed) == (5000.0, pytest.approx(drive.impulse))


def test_a_narrow_force_is_found() -> None:
    """A jet 2 mm wide in the block, and one beside it that the block reaches: 1000 m/s^2 to 5 %.

    Neither lies on a lattice of 17 points.
    """
    for centre in (0.3333, 0.5777):
        asked = forced("100 * x", f"1000 * exp(-((x - {centre}) / 1e-3) ** 2)")
        assert scene_bounds(asked).gravity == pytest.approx(1000.0, rel=0.06), centre


def test_places_that_nothing_reaches_do_not_count() -> None:
    """A block 0.2 m from a pole of a central force, for a time in which it falls by millimetres."""
    pull = [f"-1e-2 * ({c} - 0.05) / hypot(x - 0.05, y - 0.05) ** 3" for c in "xy"]
    asked = forced(*pull, time={"end": 0.02})
    nearest = math.hypot(0.2, 0.2)
    assert 1e-2 / nearest**2 * 0.9 < scene_bounds(asked).gravity < 1e-2 / (nearest - 0.1) ** 2
    # It has time to get there: the lattice around the pole counts.
    assert scene_bounds(forced(*pull, time={"end": 20.0})).gravity > 5.0


def test_the_check_says_what_a_narrow_force_takes() -> None:
    """The speed that a force gives binds the step."""
    without = check(domain=FREE, material=SOLID, shape=box([0.25, 0.25], [0.5, 0.5])).facts.step

    facts = SceneFacts(forced("1e6 if abs(x - 0.3333) < 0.02 else 0", 0.0, material=SOLID))
    assert facts.step < 0.5 * without
    assert facts.binding.name in ("speed", "deformation", "wave")
