"""The contestants from the taichi package: its MPM examples, read from the installed files.

Only settings change: backend, threads, precision, grid, particles and step. The window at the end of each
example is left out. Every line that is changed must be found exactly once, so that another version of the
package is noticed rather than measured wrongly.
"""

import importlib.util
import linecache
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np

from mpmcli.bench.cases import BenchCase
from mpmcli.errors import RunError

_INIT = "ti.init(arch=ti.gpu)"
_SIZES = {
    "mpm3d": ("dim, n_grid, steps, dt = 3, 32, 25, 4e-4", "n_particles = n_grid**dim // 2 ** (dim - 1)"),
    "mpm88": ("n_particles = 8192", "n_grid = 128", "dt = 2e-4"),
}
# First line of what is left out: everything from here on draws.
_DRAWING = {"mpm3d": "def T(a):", "mpm88": "init()"}
_VELOCITY = {"mpm3d": "F_v", "mpm88": "v"}
_POSITION = {"mpm3d": "F_x", "mpm88": "x"}


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


def adapted_source(text: str, case: BenchCase, *, threads: int, precision: str, arch: str) -> str:
    """Return the source of an example with its settings replaced and its drawing removed.

    `text` is the example's own source, `precision` "f32" or "f64", `arch` a name in taichi like "cpu".

    Raises:
        RunError: a line that has to change is not there exactly once.
    """
    name = case.peer
    sizes = {
        "mpm3d": (
            f"dim, n_grid, steps, dt = 3, {case.cells}, 25, {case.step!r}",
            f"n_particles = {case.particles}",
        ),
        "mpm88": (f"n_particles = {case.particles}", f"n_grid = {case.cells}", f"dt = {case.step!r}"),
    }
    options = f"arch=ti.{arch}, default_fp=ti.{precision}, cpu_max_num_threads={threads}, offline_cache=False"
    changes = {_INIT: f"ti.init({options})", **dict(zip(_SIZES[name], sizes[name], strict=True))}
    lines = text.splitlines()
    for old, new in changes.items():
        lines[_only_line(lines, old, name)] = new
    return "\n".join(lines[: _only_line(lines, _DRAWING[name], name)]) + "\n"


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

    def __init__(self, case: BenchCase, *, threads: int, precision: str, arch: str) -> None:
        path = example_path(case.peer)
        source = adapted_source(path.read_text(encoding="utf-8"), case, threads=threads, precision=precision, arch=arch)
        module = _run_source(source, f"<{case.peer} of taichi, adapted>")
        self.particles: int = module.n_particles
        self.smallest_step = case.step
        self.threads = threads
        self._step: Callable[[], None] = module.substep
        self._sync: Callable[[], None] = module.ti.sync
        self._position = getattr(module, _POSITION[case.peer])
        module.init()
        self._position.from_numpy(case.positions().astype(np.float32 if precision == "f32" else np.float64))
        getattr(module, _VELOCITY[case.peer]).fill(module.ti.Vector(case.velocity().tolist()))
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
