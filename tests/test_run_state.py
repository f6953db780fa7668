"""The numbers of a run: a kernel and the host reach the same ones by the same names."""

import math
from collections.abc import Callable

import numpy as np
import pytest

from mpmcli.quick_taichi import ti
from mpmcli.solver.engine.run_state import RUN, Layout, RunState

REALS, INTS = ti.types.ndarray(ti.f64, 2), ti.types.ndarray(ti.i32, 2)
# Two axes, two laws with one and no internal variable, of two and one bodies, and one emitter.
LAYOUT = Layout(2, [1, 0], emitters=1, bodies=(2, 1))


@ti.data_oriented
class Writer:
    """A kernel that writes numbers of some runs."""

    def state(self, w: object, numbers: object, counts: object) -> RunState:
        return RunState(LAYOUT, numbers, counts, w)

    @ti.kernel
    def write(self, numbers: REALS, counts: INTS):
        for w in range(2):
            (run,) = ti.static((self.state(w, numbers, counts),))
            run.time = 1.0 + w
            run.last_step = 0.5
            run.kick_carry = 0.125
            run.unrelaxed_steps += 3
            for g in ti.static(range(2)):
                run.rate[g] = run.velocity_time + g
                for i in range(2 - g):
                    run.own[g][i] = run.rate[g] * (1 + i)


def arrays() -> tuple[np.ndarray, np.ndarray]:
    """Return the arrays of two runs."""
    return np.zeros((2, LAYOUT.widths["numbers"])), np.zeros((2, LAYOUT.widths["counts"]), np.int32)


def test_a_kernel_and_the_host_have_the_same_numbers(backend_of: Callable) -> None:
    backend_of("f32", 1)
    numbers, counts = arrays()
    Writer().write(numbers, counts)
    for w in range(2):
        run = RunState(LAYOUT, numbers, counts, w)
        assert (run.time, run.velocity_time, run.unrelaxed_steps) == (1.0 + w, 0.625 + w, 3)
        assert list(run.rate) == [0.625 + w, 1.625 + w]
        assert [list(own) for own in run.own] == [[0.625 + w, 1.25 + 2 * w], [1.625 + w]]
    every = RunState(LAYOUT, numbers, counts, slice(None))
    assert every.time.tolist() == [1.0, 2.0]
    every.drift[every.time > 1.5] = math.inf
    assert [RunState(LAYOUT, numbers, counts, w).drift for w in range(2)] == [0.0, math.inf]


def test_every_number_has_a_place_of_its_own() -> None:
    numbers, counts = arrays()
    run, written = RunState(LAYOUT, numbers, counts, 0), {}
    for value, (name, entry) in enumerate(RUN.items(), start=1):
        if entry.per in ("body", "maximum"):
            for own in range(2):
                getattr(run, name)[own] = value
        else:
            setattr(run, name, value)
        written[name] = value
    assert (numbers[0] > 0).all() and (counts[0] > 0).all() and not numbers[1].any() and not counts[1].any()
    for name, value in written.items():
        found = getattr(run, name)
        flat = [found] if np.isscalar(found) else [x for own in found for x in ([own] if np.isscalar(own) else own)]
        assert set(flat) == {value}, name
    # What a scene sets is kept where a state is loaded.
    of_scene = {name for name, entry in RUN.items() if entry.writer == "scene"}
    kept = {numbers[0, k] for k in LAYOUT.of_scene("numbers")} | {counts[0, k] for k in LAYOUT.of_scene("counts")}
    assert kept == {written[name] for name in of_scene}
    run.reset()
    assert (run.drift, run.low, run.time, run.step_count) == (math.inf, math.inf, 0.0, 0.0)
    assert run.particles[1] == written["particles"], "what fills the device has set it before"


def test_there_is_no_other_number() -> None:
    run = RunState(LAYOUT, *arrays(), 0)
    with pytest.raises(AttributeError, match="tmie"):
        run.tmie = 1.0
    with pytest.raises(AttributeError, match="tmie"):
        _ = run.tmie
