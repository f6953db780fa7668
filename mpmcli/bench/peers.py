"""The contestants from the taichi package: its MPM examples, read from the installed files.

Only settings change: backend, threads, precision, grid, particles and step. The window at the end of each
example is left out. Every line that is changed must be found exactly once, so that another version of the
package is noticed rather than measured wrongly.
"""

import importlib.util
import linecache
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, GRAVITY, BenchCase
from mpmcli.errors import RunError

_SHAPE = "n_particles, n_grid = 9000 * quality**2, 128 * quality"
_QUALITY_STEP = "dt = 1e-4 / quality"
_STIFFNESS = ", 0.2  # Young's modulus and Poisson's ratio"
_HINT = (
    'print("[Hint] Use WSAD/arrow keys to control gravity. Use left/right mouse buttons to attract/repel. '
    'Press R to reset.")'
)
# Poisson's ratio of both examples with several laws, and Young's modulus with which lambda is that of the fluid.
_NU = 0.2
_YOUNGS = BULK_MODULUS * (1 + _NU) * (1 - 2 * _NU) / _NU


@dataclass(frozen=True)
class Example:
    """How an example is adapted.

    Attributes:
        changes: lines, and what replaces them; fields of a case in braces.
        drawing: first line of what is left out: everything from here on draws.
        begin: name of the function that places the particles; position, velocity: of its fields.
    """

    changes: dict[str, str]
    drawing: str
    begin: str = "init"
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
    "mpm99": Example(
        {
            _SHAPE: "n_particles, n_grid = {particles}, {cells}",
            _QUALITY_STEP: "dt = {step!r}",
            f"E, nu = 0.1e4{_STIFFNESS}": f"E, nu = {_YOUNGS}, {_NU}",
            "            grid_v[i, j][1] -= dt * 50  # gravity": f"            grid_v[i, j][1] -= dt * {GRAVITY}",
        },
        "def main():",
        begin="initialize",
    ),
    "mpm128": Example(
        {
            _SHAPE: "n_particles, n_grid = {particles}, {cells}",
            _QUALITY_STEP: "dt = {step!r}",
            f"E, nu = 5e3{_STIFFNESS}": f"E, nu = {_YOUNGS}, {_NU}",
            "            grid_v[i, j] += dt * gravity[None] * 30  # gravity": (
                f"            grid_v[i, j] += dt * ti.Vector([0, -{GRAVITY}])"
            ),
        },
        _HINT,
        begin="reset",
    ),
}
_INIT = "ti.init(arch=ti.gpu)"
# The same line with a comment, as two examples have it.
_INITS = (_INIT, f"{_INIT}  # Try to run on GPU")


def example_path(name: str) -> Path:
    """Return the path of an example of the installed taichi package, without importing taichi.

    Raises:
        RunError: taichi is not installed, or this version has no such example.
    """
    package = importlib.util.find_spec("taichi")
    if package is None or package.origin is None:
        raise RunError("The taichi package is not installed, so its examples cannot be measured.")
    path = Path(package.origin).parent / "examples" / "simulation" / f"{name}.py"
    if not path.is_file():
        raise RunError(f"The installed taichi package has no example {name}: {path} does not exist.")
    return path


def adapted_source(text: str, case: BenchCase, name: str, *, threads: int, precision: str, arch: str) -> str:
    """Return the source of an example with its settings replaced and its drawing removed.

    `text` is the source of the example `name`, `precision` "f32" or "f64", `arch` a name in taichi like "cpu".

    Raises:
        RunError: a line that has to change is not there exactly once.
    """
    example = EXAMPLES[name]
    options = f"arch=ti.{arch}, default_fp=ti.{precision}, cpu_max_num_threads={threads}, offline_cache=False"
    lines = text.splitlines()
    init = next((line for line in _INITS if line in lines), _INIT)
    for old, new in {init: f"ti.init({options})", **example.changes}.items():
        lines[_only_line(lines, old, name)] = new if old == init else new.format(**vars(case))
    return "\n".join(lines[: _only_line(lines, example.drawing, name)]) + "\n"


def _only_line(lines: list[str], wanted: str, name: str) -> int:
    found = [number for number, line in enumerate(lines) if line == wanted]
    if len(found) != 1:
        raise RunError(
            f"The example {name} of the installed taichi package has the line `{wanted}` {len(found)} times "
            "instead of once, so it cannot be measured; taichi 1.7.4 has the example that is expected."
        )
    return found[0]


class Peer:
    """An example of the taichi package in this process; Taichi starts only once per process."""

    bytes_per_particle = None

    def __init__(self, case: BenchCase, name: str | None = None, *, threads: int, precision: str, arch: str) -> None:
        """Load an example; by default the one that the case is compared with."""
        name = name or case.peer
        text = example_path(name).read_text(encoding="utf-8")
        source = adapted_source(text, case, name, threads=threads, precision=precision, arch=arch)
        module = _run_source(source, f"<{name} of taichi, adapted>")
        example = EXAMPLES[name]
        self.particles: int = module.n_particles
        self.smallest_step = case.step
        self.threads = threads
        self._step: Callable[[], None] = module.substep
        self._sync: Callable[[], None] = module.ti.sync
        self._position = getattr(module, example.position)
        getattr(module, example.begin)()
        self._position.from_numpy(case.positions().astype(np.float32 if precision == "f32" else np.float64))
        self._velocity = getattr(module, example.velocity)
        self._velocity.fill(module.ti.Vector(case.velocity().tolist()))
        if hasattr(module, "material"):
            # Of several laws the fluid.
            module.material.fill(0)
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
        """Whether every particle is in the domain."""
        position = self.positions()
        return bool(((position > 0) & (position < 1)).all())


def _run_source(source: str, filename: str) -> ModuleType:
    module = ModuleType("taichi_example")
    # Taichi reads the source of a kernel again, through linecache.
    linecache.cache[filename] = (len(source), None, source.splitlines(keepends=True), filename)
    exec(compile(source, filename, "exec"), module.__dict__)
    return module
