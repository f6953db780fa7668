"""What a scene costs on the CPU, by a table of measured kinds: the compilation of its kernels, and a step.

The table is of one machine, see `scripts/measure_costs`. It tells which of Taichi's optimisations pay, which depends on
ratios alone, and what a run takes, to a factor of two.
"""

import tomllib
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from mpmcli.scene import Scene
from mpmcli.scene.sampling import estimate_body
from mpmcli.scene.sheets import sheets_of
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.machine.backend import Optimisation

TABLE = Path(__file__).with_name("costs.toml")
# Seconds of a compilation that several laws share.
SHARED = 1.0
# What threads are worth: the power of their number. Particles that are worth a thread.
WORTH, WORTH_A_THREAD = 0.9, 2_500


@dataclass(frozen=True)
class Cost:
    """Seconds to compile, and of a step on one thread."""

    compile: float
    step: float

    def step_on(self, threads: int) -> float:
        """Return the seconds of a step on some threads."""
        return self.step / threads**WORTH

    def seconds(self, steps: int, threads: int) -> float:
        """Return what so many steps take, compilation included."""
        return self.compile + steps * self.step_on(threads)


@cache
def _table() -> dict:
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


def cost_of(scene: Scene, optimisation: Optimisation) -> Cost:
    """Return the cost of a scene whose kernels get some of Taichi's optimisations; a law of a plugin costs most."""
    table, axis, h = _table(), scene.dimension - 2, scene.domain.spacing
    how = "few" if optimisation == "few" else "most"
    known = {law: entry[how][axis] for law, entry in table["laws"].items()}
    costs = {s.material.law: known.get(s.material.law, max(known.values())) for s in scene.sources}
    seconds = SHARED + sum(compiling - SHARED for compiling, _ in costs.values())
    counts = [estimate_body(body, h) for body in scene.bodies]
    counts += [sheets_of(emitter, scene).particles for emitter in scene.emitters]
    step = 1e-9 * sum(n * costs[s.material.law][1] for s, n in zip(scene.sources, counts, strict=True))
    beside = {
        "colliders": any(not collider.free for collider in scene.colliders),
        "rigid": any(collider.free for collider in scene.colliders),
        "emitters": bool(scene.emitters),
        "separate": Layers.of(scene).separate,
    }
    for name in (name for name, there in beside.items() if there):
        more, factor = table["beside"][name][axis]
        seconds, step = seconds + more, step * factor
    if scene.solver.kernel == "cubic":
        step *= (4 / 3) ** scene.dimension
    return Cost(seconds, step)


def useful_threads(particles: int, threads: int) -> int:
    """Return how many of these threads a run of so many particles has use for."""
    return min(threads, max(1, particles // WORTH_A_THREAD))


def cheapest(scene: Scene, steps: int, threads: int) -> Optimisation:
    """Return which optimisations make a run of so many steps end first."""
    return min(("few", "most"), key=lambda how: cost_of(scene, how).seconds(steps, threads))
