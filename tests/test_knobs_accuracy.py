"""What the knobs of [solver] buy and cost on a wave: the vibrating bar of the validation cases, and a free transfer."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene
from mpmcli.scene.schema import USUAL_FLIP
from mpmcli.solver.engine.build import build_run
from mpmcli.stability.transfer_factors import loss_per_step
from mpmcli.validation.case import Setting
from mpmcli.validation.cases.bar import LENGTH, PERIODS, Bar

BAR = Bar("bar", "bar", 2, 0)
KH = np.pi / 13


@pytest.fixture(scope="module")
def measured(backend_of: Callable) -> Iterator[Callable[..., tuple[dict[str, float], float, Scene]]]:
    """Return `run(n, **knobs)`: the measures of a bar of n cells, its steps in a period, and its scene."""
    known: dict = {}

    def run(n: int, **knobs: str) -> tuple[dict[str, float], float, Scene]:
        key = (n, *sorted(knobs.items()))
        if key not in known:
            scene = parse_scene(BAR.scene_tables(n, Setting(**knobs)), laws=parameter_models()).scene
            solver = build_run(scene, backend_of("f64", 1))
            known[key] = (BAR.measure(n, scene, solver.frames()), solver.step_count / PERIODS, scene)
        return known[key]

    return run


@pytest.mark.parametrize(
    "knobs",
    [
        {"transfer": "pic"},
        {"kernel": "cubic"},
        pytest.param({"transfer": "pic", "kernel": "cubic"}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_wave_loses_what_the_spectrum_has(measured: Callable, knobs: dict) -> None:
    """Per step 0.25 (k h)^2 of the energy with PIC, 1/3 with cubic splines; 0.047 (k h)^4 with cubic ones and APIC."""
    found, steps, scene = measured(13, **knobs)
    per_step = loss_per_step(scene.solver, KH)
    assert -np.log1p(-found["energy loss"]) / steps == pytest.approx(per_step, rel=0.06)


def test_aflip_loses_the_share_that_it_does_not_keep(measured: Callable) -> None:
    apic, aflip = (measured(13, transfer=transfer)[0] for transfer in ("apic", "aflip"))
    assert aflip["energy loss"] == pytest.approx((1 - USUAL_FLIP) * apic["energy loss"], rel=0.1)
    # The grid, and with it the frequency, is the same.
    assert aflip["period error"] == pytest.approx(apic["period error"], rel=0.05)


@pytest.mark.slow
def test_zeroed_walls_are_first_order(measured: Callable) -> None:
    """Two fixed ends: an error of 0.36 h/L at least (docs/theory.md, 3.3), halved with h; folded ones fall by four."""
    coarse, fine = (measured(n, walls="zeroed")[0]["period error"] for n in (13, 26))
    assert 0.9 < np.log2(coarse / fine) < 1.2
    assert fine > 0.36 / 26
    folded, folded_fine = (measured(n)[0]["period error"] for n in (13, 26))
    assert np.log2(folded / folded_fine) > 1.9
    assert folded_fine < 0.1 * fine


def test_a_free_transfer_of_pic_takes_a_quarter(backend_of: Callable) -> None:
    """Without stress a wave of velocity loses D / h^2 (k h)^2 of its amplitude a step, twice what it does in a bar."""
    tables = BAR.scene_tables(13, Setting(transfer="pic"))
    tables["bodies"][0]["material"]["youngs_modulus"] = 1e-9
    # So slow that nothing moves.
    tables["time"] |= {"end": 0.1, "frames": 1, "step": 0.005}
    scene = parse_scene(tables, laws=parameter_models()).scene
    run = build_run(scene, backend_of("f64", 1))
    (before, _), (after, _) = run.frames()
    first, last = (amplitude(frame.position, frame.fields, frame.velocity) for frame in (before, after))
    assert 1 - (last / first) ** (1 / run.step_count) == pytest.approx(0.25 * KH**2, rel=0.03)


def amplitude(position: np.ndarray, fields: dict[str, np.ndarray], velocity: np.ndarray) -> float:
    """Return the amplitude of the first mode in the velocities."""
    return float(velocity[:, 0] @ np.sin(np.pi * fields["initial_position"][:, 0] / LENGTH))
