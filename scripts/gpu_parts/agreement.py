"""Short runs on the device and on the CPU: how far their positions and energies are apart."""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from page_section import markdown_table

from gpu_parts.parts import Setup, Task
from gpu_parts.report import measured
from mpmcli.bench.cases import BenchCase
from mpmcli.bench.column import SPEED, column_of
from mpmcli.cores import available_cores
from mpmcli.materials.registry import parameter_models
from mpmcli.scene import parse_scene

LAWS = ("fluid", "neo_hookean", "snow", "sand")
# The column of `mpmcli bench --profile` falls to the floor within 31 ms, and lands. In these steps an elastic wave
# crosses a ninth of a cell.
CELLS, SECONDS = {2: 48, 3: 24}, 0.045
STEP = {2: 1.0e-4, 3: 2.0e-4}
# Differences that count as rounding: of positions, m, in a box of 1 m, and of energies, relative to the kinetic energy
# at the start. Software Vulkan differs by up to 4.8e-7 m and 1.1e-5, both with sand in 2D.
POSITION, ENERGY = {"f32": 1e-5, "f64": 1e-12}, {"f32": 1e-4, "f64": 1e-12}
MOST_PROCESSES = 8


def tasks(setup: Setup) -> Sequence[Task]:
    """Return the laws in 3D and in 2D; on CUDA in double precision too, which Vulkan lacks."""
    names, dimensions = setup.sized(LAWS[:1], LAWS, LAWS), setup.sized((2,), (3, 2), (3, 2))
    cases = [(law, dimension, "f32") for dimension in dimensions for law in names]
    if setup.arch == "cuda":
        cases += [(law, 3, "f64") for law in names]
    # Most of the time goes into compiling, on one core each.
    pool = ThreadPoolExecutor(max(1, min(MOST_PROCESSES, available_cores() // 2)))
    return [task(Case(law, d, precision, 5 if setup.scale == "tiny" else steps_of(d)), setup.arch, pool)
            for law, d, precision in cases]  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A run: law, dimension, precision, and the number of steps."""

    law: str
    dimension: int
    precision: str
    steps: int


def steps_of(dimension: int) -> int:
    """Return the number of steps of a case."""
    return round(SECONDS / STEP[dimension])


def task(case: Case, arch: str, pool: ThreadPoolExecutor) -> Task:
    """Return the task of a case: a process on the CPU and one on the device, begun by `prepare`."""
    runs: list[Future] = []

    def prepare() -> None:
        runs.extend(pool.submit(run_apart, one, case) for one in ("cpu", arch))

    def measure(left: float) -> dict:
        (x, expected), (y, found) = (run.result() for run in runs)
        return compared(case, x, expected, y, found)

    return Task(f"{case.law} {case.dimension}D {case.precision}", measure, prepare)


def compared(case: Case, x: np.ndarray, expected: dict, y: np.ndarray, found: dict) -> dict:
    """Return how far positions and energies of two runs are apart."""
    spread = np.abs(x - y)
    energies = {
        name: abs(found[name] - expected[name]) / expected["kinetic at the start"]
        for name in ("kinetic", "elastic", "potential")
    }
    tolerance = POSITION[case.precision]
    return {
        "particles": len(x),
        "steps": case.steps,
        "largest_m": float(spread.max()),
        "root_mean_square_m": float(np.sqrt((spread**2).mean())),
        "tolerance_m": tolerance,
        "energies": energies,
        "energy_tolerance": ENERGY[case.precision],
        # Written so that a NaN does not agree.
        "agrees": bool(spread.max() <= tolerance) and all(x <= ENERGY[case.precision] for x in energies.values()),
    }


def run_apart(arch: str, case: Case) -> tuple[np.ndarray, dict[str, float]]:
    """Return what `run` does, in a process of its own: a crash of one case leaves the others.

    Raises:
        RuntimeError: it failed.
    """
    with tempfile.NamedTemporaryFile(suffix=".npz") as file:
        arguments = [arch, case.law, str(case.dimension), case.precision, str(case.steps), file.name]
        done = subprocess.run([sys.executable, "-m", "gpu_parts.agreement", *arguments], capture_output=True, text=True)
        if done.returncode != 0:
            raise RuntimeError(f"on {arch}, status {done.returncode}: {done.stderr.strip()[-600:]}")
        with np.load(file.name) as found:
            return found["position"], {name: float(found[name]) for name in found.files if name != "position"}


def run(arch: str, case: Case) -> dict[str, np.ndarray | float]:
    """Return "position", in the order of ids, and energies after some equal steps."""
    from mpmcli.solver.engine.build import build_run
    from mpmcli.solver.machine.backend import choose_backend, start

    size = BenchCase(dimension=case.dimension, cells=CELLS[case.dimension], particles=0, step=STEP[case.dimension])
    data = column_of(case.law, size, case.precision)
    scene = parse_scene(data, laws=parameter_models(), source=data["title"]).scene
    # On the CPU the bytes are the same, and compiled sooner.
    backend = choose_backend(arch, 1, case.precision, optimisation="few" if arch == "cpu" else None)
    found = build_run(scene, start(backend))
    mass = found.frame()[1].mass
    for _ in range(case.steps):
        found.step(size.step)
    frame, row = found.frame()
    energies = {name: getattr(row, name) for name in ("kinetic", "elastic", "potential")}
    return {"position": frame.position, "kinetic at the start": 0.5 * mass * SPEED**2, **energies}


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


if __name__ == "__main__":
    ARCH, LAW, DIMENSION, PRECISION, STEPS, FILE = sys.argv[1:]
    np.savez(FILE, **run(ARCH, Case(LAW, int(DIMENSION), PRECISION, int(STEPS))))
