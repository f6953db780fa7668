"""What the knobs of [solver] buy and cost on a wave: the vibrating bar of the validation cases, and a free transfer."""

from collections.abc import Callable, Iterator

import numpy as np
import pytest

from mpmcli.materials.registry import parameter_models
from mpmcli.scene import Scene, parse_scene
from mpmcli.scene.schema import USUAL_FLIP
from mpmcli.solver.engine.run import build_run
from mpmcli.stability.transfer_factors import loss_per_step
from mpmcli.validation.case import Setting
from mpmcli.validation.cases.bar import PERIODS, Bar

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


def test_a_wave_loses_what_the_spectrum_has(measured: Callable) -> None:
    """Per step 0.047 (k h)^4 of the energy with cubic splines."""
    found, steps, scene = measured(13, kernel="cubic")
    per_step = loss_per_step(scene.solver, KH)
    assert -np.log1p(-found["energy loss"]) / steps == pytest.approx(per_step, rel=0.06)


def test_aflip_loses_the_share_that_it_does_not_keep(measured: Callable) -> None:
    apic, aflip = (measured(13, transfer=transfer)[0] for transfer in ("apic", "aflip"))
    assert aflip["energy loss"] == pytest.approx((1 - USUAL_FLIP) * apic["energy loss"], rel=0.1)
    # The grid, and with it the frequency, is the same.
    assert aflip["period error"] == pytest.approx(apic["period error"], rel=0.05)
