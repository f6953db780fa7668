"""The other workers: MPM examples of the taichi package, and the yardstick, the same block in C.

Examples are read from the installed files. Only settings change: backend, threads, precision, grid, particles and step.
The code of the window at the end is omitted. Each changed line must occur exactly once, so that another version of the
package is an error and not a wrong measurement.

The yardstick is compiled if gcc is available. It shows the distance of mpmcli from the limit of the processor.
"""

import ctypes
import importlib.util
import linecache
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, DENSITY, EDGE, GRAVITY, BenchCase
from mpmcli.errors import RunError


@dataclass(frozen=True)
class Example:
    """Adaptation of an example: changed lines, the line at which `drawing` begins, and names of its fields."""

    changes: dict[str, str]
    drawing: str
    position: str = "x"
    velocity: str = "v"


EXAMPLES = {
    "mpm3d": Example(
        {
            "dim, n_grid, steps, dt = 3, 32, 25, 4e-4": "dim, n_grid, steps, dt = 3, {cells}, 25, {step!r}",
            "n_particles = n_grid**dim // 2 ** (dim - 1)": "n_particles = {particles}",
        },
        "def T(a):",
        position="F_x",
        velocity="F_v",
    ),
    "mpm88": Example(
        {
            "n_particles = 8192": "n_particles = {particles}",
            "n_grid = 128": "n_grid = {cells}",
            "dt = 2e-4": "dt = {step!r}",
        },
        "init()",
    ),
}
_INIT = "ti.init(arch=ti.gpu)"
YARDSTICK = Path(__file__).with_name("yardstick.c")
# The options of -ffast-math one by one: a library linked with -ffast-math flushes denormals of its process to zero.
FAST_MATH = (
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math", "-freciprocal-math"),
    "-ffinite-math-only",
)
FLAGS = ("-O3", "-march=native", *FAST_MATH, "-fopenmp", "-std=gnu11", "-shared", "-fPIC")
# Phases in the order of the source; P2G includes clearing.
PHASES = ("sort", "p2g", "grid", "g2p")
# Fraction of a cell by which a particle may be behind a wall: velocities are zero only on nodes.
BEHIND = 0.5


def example_path(name: str) -> Path:
    """Return the path of an example of the installed taichi package, without importing taichi."""
    package = importlib.util.find_spec("taichi")
    if package is None or package.origin is None:
        raise RunError("The taichi package is not installed, so its examples cannot be measured.")
    path = Path(package.origin).parent / "examples" / "simulation" / f"{name}.py"
    if not path.is_file():
        raise RunError(f"The installed taichi package has no example {name}: {path} does not exist.")
    return path


def adapted_source(text: str, case: BenchCase, threads: int, arch: str, precision: str) -> str:
    """Return an example with new settings and without drawing. Raises RunError if a line does not occur once."""
    example = EXAMPLES[case.peer]
    options = f"arch=ti.{arch}, default_fp=ti.{precision}, cpu_max_num_threads={threads}, offline_cache=False"
    lines = text.splitlines()
    for old, new in {_INIT: f"ti.init({options})", **example.changes}.items():
        lines[_only_line(lines, old, case.peer)] = new if old == _INIT else new.format(**vars(case))
    return "\n".join(lines[: _only_line(lines, example.drawing, case.peer)]) + "\n"


def _only_line(lines: list[str], wanted: str, name: str) -> int:
    found = [number for number, line in enumerate(lines) if line == wanted]
    if len(found) != 1:
        raise RunError(
            f"The example {name} of the installed taichi package has the line `{wanted}` {len(found)} times "
            "instead of once, so it cannot be measured; the expected example is that of taichi 1.7.4."
        )
    return found[0]


class Peer:
    """An example of the taichi package with the block of a case."""

    def __init__(self, case: BenchCase, threads: int, arch: str = "cpu", precision: str = "f32") -> None:
        """Run the adapted example as a module, and set its particles to those of the case."""
        path = example_path(case.peer)
        source = adapted_source(path.read_text(encoding="utf-8"), case, threads, arch, precision)
        module, filename = ModuleType("taichi_example"), f"<{path.name} of bench>"
        # Taichi reads the source of a kernel again, through linecache.
        linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
        exec(compile(source, filename, "exec"), module.__dict__)
        example = EXAMPLES[case.peer]
        self.particles: int = module.n_particles
        self.threads = threads
        self._step: Callable[[], None] = module.substep
        self._sync: Callable[[], None] = module.ti.sync
        self._position = getattr(module, example.position)
        module.init()
        self._position.from_numpy(case.positions().astype(np.float32 if precision == "f32" else np.float64))
        getattr(module, example.velocity).fill(module.ti.Vector(case.velocity().tolist()))
        self._sync()

    def advance(self, count: int) -> int:
        """Take `count` steps."""
        for _ in range(count):
            self._step()
        return count

    def sync(self) -> None:
        """Wait until every requested step is done."""
        self._sync()

    def positions(self) -> np.ndarray:
        """Return the positions of the particles, (particles, dimension), in their initial order."""
        return self._position.to_numpy()

    def is_sound(self) -> bool:
        """Return whether every particle is in the domain."""
        position = self.positions()
        return bool(((position > 0) & (position < 1)).all())


def has_compiler() -> bool:
    """Return whether gcc is on the PATH."""
    return shutil.which("gcc") is not None


def load_yardstick(dimension: int) -> ctypes.CDLL:
    """Compile the yardstick for a dimension in a temporary directory, and load it. Raises RunError on failure."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "yardstick.so"
        command = ["gcc", *FLAGS, f"-DD={dimension}", "-o", str(library), str(YARDSTICK)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        except OSError as error:
            raise RunError(f"The yardstick in C needs gcc, which cannot be run ({error.strerror}).") from error
        if done.returncode:
            said = (done.stderr.strip().splitlines() or [f"status {done.returncode}"])[-1]
            raise RunError(f"gcc cannot compile the yardstick in C: {said}")
        try:
            loaded = ctypes.CDLL(str(library))
        except OSError as error:
            raise RunError(f"The yardstick in C cannot be loaded: {error}") from error
    whole, real, pointer = ctypes.c_int, ctypes.c_float, ctypes.c_void_p
    arguments = {"advance": [whole], "read": [pointer, pointer], "seconds": [pointer]}
    for name, others in arguments.items():
        getattr(loaded, f"yardstick_{name}").argtypes = [pointer, *others]
    loaded.yardstick_new.argtypes = [*[whole] * 4, *[real] * 6, pointer, pointer]
    loaded.yardstick_new.restype = pointer
    return loaded


class Yardstick:
    """A block of fluid in C, in f32, between slip walls."""

    def __init__(
        self,
        case: BenchCase,
        threads: int,
        position: np.ndarray | None = None,
        velocity: np.ndarray | None = None,
        tension: bool = False,
    ) -> None:
        """Compile, and put particles, (particles, dimension), by default those of the case, into a unit box.

        With `tension` the fluid bears tension. Raises RunError if gcc fails or the memory does not suffice.
        """
        position = case.positions() if position is None else position
        velocity = np.tile(case.velocity(), (case.particles, 1)) if velocity is None else velocity
        self._library = load_yardstick(case.dimension)
        self.particles, self.threads = case.particles, threads
        volume = EDGE**case.dimension / case.particles
        self._before = np.zeros(len(PHASES))
        self._spacing = 1 / case.cells
        self._shape = (case.particles, case.dimension)
        arrays = [np.ascontiguousarray(array, dtype=np.float32) for array in (position, velocity)]
        numbers = (self._spacing, case.step, GRAVITY, DENSITY * volume, volume, BULK_MODULUS)
        self._handle = self._library.yardstick_new(
            case.particles, case.cells, threads, tension, *numbers, *(array.ctypes.data for array in arrays)
        )
        if not self._handle:
            raise RunError(f"There is not enough memory for {case.particles} particles in the yardstick.")

    def advance(self, count: int) -> int:
        """Take `count` steps."""
        self._library.yardstick_advance(self._handle, count)
        return count

    def sync(self) -> None:
        """Do nothing: `advance` returns when its steps are done."""

    def phases(self) -> dict[str, float]:
        """Return the time in each of PHASES since the last call, s: processor time on one thread, else wall time."""
        found = np.zeros(len(PHASES))
        self._library.yardstick_seconds(self._handle, found.ctypes.data)
        since, self._before = found - self._before, found
        return dict(zip(PHASES, since.tolist(), strict=True))

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return positions and velocities, (particles, dimension) float32, in their initial order."""
        position, velocity = np.empty(self._shape, np.float32), np.empty(self._shape, np.float32)
        self._library.yardstick_read(self._handle, position.ctypes.data, velocity.ctypes.data)
        return position, velocity

    def is_sound(self) -> bool:
        """Return whether every particle is in the box, or less than BEHIND cells behind a wall."""
        position, beyond = self.state()[0], BEHIND * self._spacing
        return bool(((position > -beyond) & (position < 1 + beyond)).all())
