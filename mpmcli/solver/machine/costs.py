"""Sizes and costs of kernels, known before anything is allocated.

Array sizes are rounded to few values, because they are part of compiled kernels: other scenes then reuse cached
kernels. CPU times of the compilation and of a step follow from a table of measurements on one machine
(`scripts/measure_costs`). The table determines which of Taichi's optimisations pay off, which depends only on ratios,
and predicts the time of a run to a factor of two.
"""

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

from mpmcli.boundaries.colliders import ColliderKind
from mpmcli.materials.law import Law
from mpmcli.materials.registry import laws
from mpmcli.scene import Scene
from mpmcli.scene.sampling import estimate_sources
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.machine.backend import Optimisation

# Smallest numbers of entries and of colliders for which arrays have space.
FEWEST, FEWEST_COLLIDERS = 1024, 4
# Up to FEW_CELLS cells along an axis, their number is a multiple of FEW_TIMES in 2D and 3D; above, at least of CELLS.
FEW_CELLS, FEW_TIMES, CELLS = 64, {2: 64, 3: 8}, 4
# Entries added to larger sizes, which are multiples of powers of two: consecutive arrays of such sizes would begin in
# the same cache set, and steps in 2D take a fifth longer.
SKEW = 336


def power_of_two(count: int) -> int:
    """Return the next power of two, at least 1."""
    return 1 << max(0, count - 1).bit_length()


def in_steps(count: int) -> int:
    """Return the padded number of entries, in eighths of a power of two; at least `FEWEST`, or 0 for 0."""
    if count > FEWEST:
        return _multiple(count - SKEW, power_of_two(count - SKEW) // 16) + SKEW
    return FEWEST if count else 0


def padded_cells(cells: Sequence[int]) -> tuple[int, ...]:
    """Return the padded cells per axis of a dense grid, in sixteenths of a power of two above 64."""
    few = FEW_TIMES[len(cells)]
    return tuple(_multiple(n, few if n <= FEW_CELLS else max(CELLS, power_of_two(n) // 32)) for n in cells)


def padded_colliders(kind: ColliderKind) -> ColliderKind:
    count = max(FEWEST_COLLIDERS, power_of_two(kind.count)) if kind.count else 0
    sizes = {name: in_steps(getattr(kind, name)) for name in ("parts", "numbers", "samples", "points")}
    return replace(kind, count=count, **sizes)


def _multiple(count: int, step: int) -> int:
    return -(-count // max(1, step)) * max(1, step)


TABLE = Path(__file__).with_name("costs.toml")
# Seconds of compilation shared by all laws.
SHARED = 1.0
# Exponent of the speed-up by threads. Particles per thread from which a thread is useful.
WORTH, WORTH_A_THREAD = 0.9, 2_500


@dataclass(frozen=True)
class Cost:
    """Seconds of the compilation, and of a step on one thread."""

    compile: float
    step: float

    def step_on(self, threads: int) -> float:
        """Return the seconds of a step on a number of threads."""
        return self.step / threads**WORTH

    def seconds(self, steps: int, threads: int) -> float:
        """Return the seconds of a number of steps, including compilation."""
        return self.compile + steps * self.step_on(threads)


@cache
def _table() -> dict:
    return tomllib.loads(TABLE.read_text(encoding="utf-8"))


def cost_of(scene: Scene, optimisation: Optimisation) -> Cost:
    """Return the cost of a scene at a level of optimisation; a plugin law costs as much as the most expensive law."""
    table, axis, layers = _table(), scene.dimension - 2, Layers.of(scene)
    how = "few" if optimisation == "few" else "most"
    known = {law: entry[how][axis] for law, entry in table["laws"].items()}
    costs = {s.material.law: known.get(s.material.law, max(known.values())) for s in scene.sources}
    seconds = SHARED + sum(compiling - SHARED for compiling, _ in costs.values())
    counts = zip(scene.sources, estimate_sources(scene), strict=True)
    step = 1e-9 * sum(n * costs[source.material.law][1] for source, n in counts)
    beside = {
        "colliders": any(not collider.free for collider in scene.colliders),
        "rigid": any(collider.free for collider in scene.colliders),
        "emitters": bool(scene.emitters),
        "separate": layers.separate and layers.count > 1,
        "alone": layers.separate and layers.count == 1,
    }
    for name in (name for name, there in beside.items() if there):
        more, factor = table["beside"][name][axis]
        seconds, step = seconds + more, step * factor
    if scene.solver.kernel == "cubic":
        step *= (4 / 3) ** scene.dimension
    return Cost(seconds, step)


def useful_threads(particles: int, threads: int) -> int:
    """Return how many of these threads are useful to a run with this number of particles."""
    return min(threads, max(1, particles // WORTH_A_THREAD))


def cheapest(scene: Scene, steps: int, threads: int) -> Optimisation:
    """Return the level of optimisation with the shortest total time of a run with this number of steps."""
    return min(("few", "most"), key=lambda how: cost_of(scene, how).seconds(steps, threads))


def members_of(scene: Scene, law: str) -> list[int]:
    return [i for i, body in enumerate(scene.sources) if body.material.law == law]


def law_objects(scene: Scene) -> tuple[Law, ...]:
    """Return the laws of a scene; without material one of any parameters, which no particle has."""
    found = []
    for name in scene.laws:
        law, own = laws()[name], [scene.sources[i].material for i in members_of(scene, name)]
        found.append(law(own or [law.parameters(density=1.0, youngs_modulus=1.0)], scene.dimension))
    return tuple(found)
