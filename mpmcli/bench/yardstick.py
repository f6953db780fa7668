"""The yardstick: the same block in C, compiled where gcc is, which tells how far the limit of a processor is."""

import ctypes
import shutil
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from mpmcli.bench.cases import BULK_MODULUS, DENSITY, EDGE, GRAVITY, BenchCase
from mpmcli.errors import RunError

SOURCE = Path(__file__).with_suffix(".c")
# Those of -ffast-math but without it: a library linked with that flushes denormal numbers of its process to zero.
FAST_MATH = (
    *("-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math", "-freciprocal-math"),
    "-ffinite-math-only",
)
FLAGS = ("-O3", "-march=native", *FAST_MATH, "-fopenmp", "-std=gnu11", "-shared", "-fPIC")
# Phases in the order of the source; P2G includes clearing.
PHASES = ("sort", "p2g", "grid", "g2p")
# Share of a cell by which a particle may be behind a wall: velocities are zero on nodes alone.
BEHIND = 0.5
ABSENT = "gcc is not here: the table has no column of the yardstick in C."


def is_here() -> bool:
    """Return whether gcc is on the PATH."""
    return shutil.which("gcc") is not None


def load_yardstick(dimension: int) -> ctypes.CDLL:
    """Compile the source for a dimension in a temporary directory, and load it.

    Raises:
        RunError: gcc is not here, or cannot compile it.
    """
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "yardstick.so"
        command = ["gcc", *FLAGS, f"-DD={dimension}", "-o", str(library), str(SOURCE)]
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
    loaded.yardstick_new.argtypes = [*[whole] * 4, *[real] * 6, pointer, pointer]
    loaded.yardstick_new.restype = pointer
    loaded.yardstick_advance.argtypes = [pointer, whole]
    loaded.yardstick_read.argtypes = [pointer, pointer, pointer]
    loaded.yardstick_seconds.argtypes = [pointer, pointer]
    loaded.yardstick_bytes.argtypes = [pointer]
    loaded.yardstick_bytes.restype = ctypes.c_long
    loaded.yardstick_free.argtypes = [pointer]
    return loaded


class Yardstick:
    """A block of fluid without tension, in f32, between walls that slip.

    Attributes:
        particles, threads, smallest_step, bytes_per_particle: see `Contestant`.
    """

    def __init__(
        self, case: BenchCase, *, threads: int, position: np.ndarray, velocity: np.ndarray, tension: bool = False
    ) -> None:
        """Compile, and put particles into a unit box.

        Args:
            case: grid, number of particles and step; its particles share its block in equal parts.
            position, velocity: (particles, dimension), m and m/s.
            tension: whether the fluid takes tension.
        """
        self._library = load_yardstick(case.dimension)
        self.particles, self.threads, self.smallest_step = case.particles, threads, case.step
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
            raise RunError(f"The memory does not suffice for {case.particles} particles in the yardstick.")
        self.bytes_per_particle: int = self._library.yardstick_bytes(self._handle)

    def advance(self, count: int) -> int:
        """Take `count` steps."""
        self._library.yardstick_advance(self._handle, count)
        return count

    def sync(self) -> None:
        """Do nothing: every step waits."""

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
        """Whether every particle is in the box, or less than BEHIND cells behind a wall."""
        position, beyond = self.state()[0], BEHIND * self._spacing
        return bool(((position > -beyond) & (position < 1 + beyond)).all())

    def close(self) -> None:
        """Give the memory back."""
        self._library.yardstick_free(self._handle)


def falling_block(case: BenchCase, *, threads: int, precision: str, arch: str) -> Yardstick:
    """Return the block of the other contestants.

    Raises:
        RunError: it has no such precision or arch, or gcc cannot compile it.
    """
    if (precision, arch) != ("f32", "cpu"):
        raise RunError(f"The yardstick computes in f32 on the CPU, not in {precision} on {arch}.")
    velocity = np.tile(case.velocity(), (case.particles, 1))
    return Yardstick(case, threads=threads, position=case.positions(), velocity=velocity)
