"""Short runs on the device and on the CPU: how far their positions and energies are apart."""

from collections.abc import Sequence

import numpy as np
from page_section import markdown_table

from gpu_parts.parts import Setup, Task
from gpu_parts.report import measured
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.materials import SPEED, scene_of
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene

LAWS = ("fluid", "neo_hookean", "snow", "sand")
# The column of `mpmcli bench --materials` falls to the floor within 31 ms; these steps are a fifth of the stable one or
# less, and the run ends when half of its speed is gone into the ground.
CELLS, SECONDS = {2: 48, 3: 24}, 0.045
STEP = {2: 1.0e-4, 3: 2.0e-4}
# Rounding of positions by half a unit in the last place of 1 m in each step would add up to steps times this, m; what
# flows or separates multiplies differences. Energies are compared with the kinetic energy at the start.
ROUNDING = {"f32": np.finfo(np.float32).eps, "f64": np.finfo(np.float64).eps}
GROWTH = 10.0
ENERGY = {"f32": 1e-3, "f64": 1e-9}


def tasks(setup: Setup) -> Sequence[Task]:
    """Return the laws in 3D and in 2D; on CUDA in double precision too, which Vulkan lacks."""
    names, dimensions = setup.sized(LAWS[:1], LAWS, LAWS), setup.sized((2,), (3, 2), (3, 2))
    cases = [(law, dimension, "f32") for dimension in dimensions for law in names]
    if setup.arch == "cuda":
        cases += [(law, 3, "f64") for law in names]
    return [Task(f"{law} {d}D {precision}", agreement(law, d, precision, setup)) for law, d, precision in cases]


def agreement(law: str, dimension: int, precision: str, setup: Setup):
    """Return the measurement of one case."""

    def measure(left: float) -> dict:
        steps = 5 if setup.scale == "tiny" else round(SECONDS / STEP[dimension])
        (x, rows), (y, others) = (run(arch, law, dimension, precision, steps) for arch in ("cpu", setup.arch))
        spread = np.abs(x - y)
        scale = rows["kinetic at the start"]
        energies = {name: abs(others[name] - rows[name]) / scale for name in ("kinetic", "elastic", "potential")}
        tolerance = GROWTH * steps * float(ROUNDING[precision])
        return {
            "particles": len(x),
            "steps": steps,
            "largest_m": float(spread.max()),
            "root_mean_square_m": float(np.sqrt((spread**2).mean())),
            "tolerance_m": tolerance,
            "energies": energies,
            "energy_tolerance": ENERGY[precision],
            "agrees": bool(spread.max() <= tolerance and max(energies.values()) <= ENERGY[precision]),
        }

    return measure


def run(arch: str, law: str, dimension: int, precision: str, steps: int) -> tuple[np.ndarray, dict[str, float]]:
    """Return positions, in the order of ids, and energies after some equal steps; the backend ends with it."""
    from mpmcli.solver.backend import start_backend, stop_backend
    from mpmcli.solver.solver import Solver

    case = BenchCase(dimension=dimension, cells=CELLS[dimension], particles=0, step=STEP[dimension])
    data = scene_of([law], case, precision)
    scene = parse_scene(data, laws=parameter_models(), source=data["title"]).scene
    backend = start_backend(arch, None, precision)
    try:
        solver = Solver(scene, backend)
        start = solver.frame()[1]
        for _ in range(steps):
            solver.step(case.step)
        frame, row = solver.frame()
    finally:
        stop_backend()
    kinetic = 0.5 * start.mass * SPEED**2
    energies = {"kinetic": row.kinetic, "elastic": row.elastic, "potential": row.potential}
    return frame.position, energies | {"kinetic at the start": kinetic}


def section(rows: dict[str, dict]) -> str:
    """Return a line for each case."""
    cells = [
        [
            key,
            f"{row['particles']:,}",
            f"{row['steps']:,}",
            f"{row['largest_m']:.1e}",
            f"{row['root_mean_square_m']:.1e}",
            f"{row['tolerance_m']:.1e}",
            f"{max(row['energies'].values()):.1e}",
            "yes" if row["agrees"] else "**no**",
        ]
        for key, row in measured(rows).items()
    ]
    head = ["case", "particles", "steps", "largest, m", "r.m.s., m", "tolerance, m", "energies, relative", "agrees"]
    return markdown_table(head, cells, set(range(1, 7)))
