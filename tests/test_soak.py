"""The soak in its short form, and what it would notice."""

from dataclasses import replace

import numpy as np
import taichi as ti
from soak.laws import broken_laws
from soak.rounds import Round, memory_growth, soak
from soak.scenes import soak_scenes

from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow

SHORT = {case.name: case for case in soak_scenes(0.02)}


def still(case: object, **more: float) -> tuple[list[Frame], list[LedgerRow]]:
    """Return frames and ledger of a particle that rests."""
    scene = case.loaded.scene
    times = [scene.time.end * k / scene.time.frames for k in range(scene.time.frames + 1)]
    zeros = np.zeros((1, 2), np.float32)
    ones = np.zeros(1, np.int32)
    frames = [Frame(k, time, k, zeros, zeros, ones, ones) for k, time in enumerate(times)]
    row = LedgerRow(
        time=0.0,
        steps=1,
        step_min=0.1,
        step_max=0.1,
        limit="",
        speed_max=0.0,
        courant_max=0.0,
        volume_ratio_min=1.0,
        volume_ratio_max=1.0,
        mass=2.0,
        kinetic=0.0,
        elastic=0.0,
        potential=1.0,
        linear_momentum=(0.0, 0.0),
        angular_momentum=(0.0,),
    )
    rows = [replace(row, time=time) for time in times]
    rows[-1] = replace(rows[-1], **more)
    return frames, rows


def test_a_short_soak_finds_nothing() -> None:
    """Two rounds of a scene that is kept and one that is stored: their laws hold, and their bytes are equal."""
    kernels: list[int] = []

    def tell(number: int, one: Round) -> None:
        kernels.append(len(ti.lang.impl.get_runtime().kernels))

    cases = [SHORT["water at rest 2D"], SHORT["ball bounces 2D"]]
    faults = soak(cases, lambda done: len(done) < 2, tell)
    assert faults == []
    # Taichi keeps every kernel that it is not made to forget, and with it all that the kernel was made for.
    assert kernels[1] <= kernels[0]


def test_a_state_that_stays_breaks_no_law() -> None:
    case = SHORT["water at rest 2D"]
    assert list(broken_laws(case, *still(case))) == []


def test_energy_mass_and_rest_are_laws() -> None:
    case = SHORT["water at rest 2D"]
    assert "energy grew" in " ".join(broken_laws(case, *still(case, kinetic=0.1)))
    assert "mass" in " ".join(broken_laws(case, *still(case, mass=2.1)))
    assert "speed" in " ".join(broken_laws(case, *still(case, speed_max=0.1)))
    frames, rows = still(case)
    frames[-1] = replace(frames[-1], position=np.full((1, 2), 0.1, np.float32))
    assert "surface" in " ".join(broken_laws(case, frames, rows))
    assert "frames" in " ".join(broken_laws(case, frames[:-1], rows))


def test_the_work_of_a_turning_collider_is_no_gain() -> None:
    """-torque rate dt: 3 rad/s with 2 N m on the collider take 6 W from the material, with -2 N m they give 6 W."""
    case = SHORT["stirred water 2D"]
    frames, rows = still(case)
    duration = rows[-1].time - rows[-2].time
    for torque, sound in ((-2.0, True), (2.0, False)):
        rows[-1] = replace(rows[-1], kinetic=5.9 * duration, collider_torque=((torque,),))
        rows[:-1] = [replace(row, collider_torque=((0.0,),)) for row in rows[:-1]]
        assert (not list(broken_laws(case, frames, rows))) == sound


def test_growth_of_memory_is_that_of_the_last_half() -> None:
    assert memory_growth([100, 200, 300, 300, 300, 300]) < 1e-12
    # A line from 100 to 120 has the mean 110.
    assert abs(memory_growth([0, 0, 0, 100, 110, 120]) - 20 / 110) < 1e-12
