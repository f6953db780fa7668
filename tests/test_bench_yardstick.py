"""The yardstick in C: the physics of mpmcli, on any number of threads, or a sentence where there is no gcc."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from mpmcli.bench import peers
from mpmcli.bench.cases import DENSITY, EDGE, BenchCase
from mpmcli.errors import RunError

needs_gcc = pytest.mark.skipif(not peers.has_compiler(), reason="gcc, which compiles the yardstick, is not here")
# Cells enough that there are tiles of every colour, and steps enough that particles are sorted again.
CASES = (
    BenchCase(dimension=2, cells=32, particles=1_500, step=8e-4),
    BenchCase(dimension=3, cells=32, particles=6_000, step=8e-4),
)
STEPS = 50

# The fields of initial positions and velocities of both: vortices that compress, so that pressure acts, and a fall.
START = """
import numpy as np
from dataclasses import replace
from mpmcli.bench.cases import BenchCase
case = {case!r}
x = case.positions()
v = 3 * case.velocity() + 0.5 * np.sin(9 * x + np.arange(case.dimension)) * np.cos(7 * x[:, ::-1])
"""


@pytest.fixture
def states(run_python: Callable, tmp_path: Path) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """Return `run(case, code)`: positions and velocities that the code stores with np.savez("found.npz", x=, v=)."""

    def run(case: BenchCase, code: str) -> tuple[np.ndarray, np.ndarray]:
        run_python(START.format(case=case) + code)
        found = np.load(tmp_path / "found.npz")
        return found["x"].astype(np.float64), found["v"].astype(np.float64)

    return run


def in_c(states: Callable, case: BenchCase) -> tuple[np.ndarray, np.ndarray]:
    """Return what the yardstick computes, on one thread and on three.

    In a process of its own, as Taichi starts once.
    """
    return states(
        case,
        f"""
from mpmcli.bench.peers import Yardstick
found = []
for threads in (3, 1):
    side = Yardstick(case, threads=threads, position=x, velocity=v, tension=True)
    side.advance({STEPS // 2})
    side.advance({STEPS - STEPS // 2})
    assert side.is_sound()
    assert all(seconds > 0 for seconds in side.phases().values()), side.phases()
    found.append(side.state())
for one, other in zip(*found):
    np.testing.assert_array_equal(one, other)
np.savez("found.npz", x=found[0][0], v=found[0][1])
""",
    )


@needs_gcc
@pytest.mark.parametrize("case", [pytest.param(CASES[0], marks=pytest.mark.slow), CASES[1]], ids=lambda case: case.name)
def test_physics_is_that_of_mpmcli(states: Callable, case: BenchCase) -> None:
    """The same particles in f32 and f64.

    A position keeps 24 bits, 4e-6 cells here, in each of the steps. Momentum, kinetic energy and mean height are of all
    particles. Mass is that of the particles, times weights whose sum is 1.
    """
    expected, speeds = states(
        case,
        f"""
from mpmcli.bench.ours import Ours, falling_block
data, (particles,) = falling_block(case, "f64")
data["solver"]["redistribute"] = False
data["bodies"][0]["material"]["tension_cutoff"] = False
side = Ours(data, [replace(particles, velocity=v)], 1)
# The yardstick's first step begins with a whole step of gravity, leapfrog with half a step.
side.run.begin()
side.run.state.last_step = case.step
# The yardstick has no eased stress.
side.run.state.unrelaxed_steps = -{STEPS}
assert side.advance({STEPS}) == {STEPS}
frame = side.run.frame()[0]
np.savez("found.npz", x=frame.position, v=frame.velocity)
""",
    )
    found, own = in_c(states, case)
    # Walls are out of reach: those of the yardstick set velocities of nodes to zero, and mirror nothing.
    assert expected.min() > 2 / case.cells
    # In 50 steps rounding adds up to 50 times as much where nothing amplifies it.
    assert np.abs(found - expected).max() * case.cells < 50 * 4e-6
    assert found[:, 1].mean() == pytest.approx(expected[:, 1].mean(), abs=5e-6)
    mass = DENSITY * EDGE**case.dimension / case.particles
    assert mass * own.sum(axis=0) == pytest.approx(mass * speeds.sum(axis=0), abs=3e-5 * mass * case.particles)
    assert (own**2).sum() == pytest.approx((speeds**2).sum(), rel=5e-5)


@needs_gcc
def test_source_compiles_without_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(peers, "FLAGS", (*peers.FLAGS, "-Wall", "-Wextra", "-Werror"))
    for dimension in (2, 3):
        peers.load_yardstick(dimension)


class TestWhereItCannotBe:
    def test_no_gcc_is_a_sentence(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("PATH", "/nowhere")
        assert not peers.has_compiler()
        with pytest.raises(RunError, match="needs gcc, which cannot be run"):
            peers.load_yardstick(2)

    @needs_gcc
    def test_what_gcc_says_is_in_the_sentence(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        broken = tmp_path / "broken.c"
        broken.write_text("#error that is no yardstick\n", encoding="utf-8")
        monkeypatch.setattr(peers, "YARDSTICK", broken)
        with pytest.raises(RunError, match="cannot compile the yardstick in C"):
            peers.load_yardstick(2)


@needs_gcc
def test_denormal_numbers_stay() -> None:
    """A library linked with -ffast-math would flush them to zero in all of the process, as Taichi does in its own."""
    tell = "import numpy as np; print(np.array([5e-324])[0] * 1.0)"
    program = f"from mpmcli.bench.peers import load_yardstick; load_yardstick(2); {tell}"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "5e-324"
