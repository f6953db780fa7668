"""Starts Taichi, once per process, on the requested backend; finds available backends and free memory."""

import ast
import atexit
import contextlib
import ctypes
import gc
import inspect
import io
import linecache
import os
import platform
import stat
import sys
import tempfile
import textwrap
import time
import weakref
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import Literal

import numpy as np
from taichi.lang import kernel_impl
from taichi.lang.ast import transform_tree
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.kernel_impl import Kernel

from mpmcli.cores import available_cores
from mpmcli.errors import InputError, RunError
from mpmcli.plain_text import counted
from mpmcli.quick_taichi import ti

# Taichi's optimisations: all, all except those across branches, or few. Optimisations across branches take half to
# three quarters of the compile time on a CPU without making steps faster. "few" takes half to four fifths of the
# remaining compile time, and a step on a CPU 1.4 to 4.3 times as long.
Optimisation = Literal["all", "most", "few"]
OPTIMISATION: dict[str, dict[str, bool]] = {
    "all": {},
    "most": {"cfg_optimization": False},
    "few": {"advanced_optimization": False},
}

Arch = Literal["auto", "cpu", "cuda", "vulkan", "metal"]
ARCHES: tuple[str, ...] = ("auto", "cpu", "cuda", "vulkan", "metal")

# Number of threads accepted on any machine; the limit is twice the number of cores if that is larger.
FEW_THREADS = 64
# Largest size of the cache of compiled kernels: a kernel of four laws in 3D takes 6 MB and is stored twice.
CACHE_BYTES = 2**29
# Age, s, from which a lock on the kernel cache is considered left by a killed process.
LONGEST_LOCK = 60.0

_started: "Backend | None" = None
# Functions called once after the backend has stopped.
_endings: list[Callable[[], None]] = []
# Syntax trees of the functions that a kernel has inlined, by their source.
_trees: defaultdict[str, list[ast.Module]] = defaultdict(list)


@dataclass(frozen=True)
class Backend:
    """The backend that runs the kernels: "cpu", "cuda", "vulkan" or "metal".

    Attributes:
        threads: CPU threads used by kernels (1 on a GPU).
        precision: "f32" or "f64", the type of all particle and node values.
        compile_cache: whether compiled kernels are cached on disk.
        optimisation: level of Taichi's optimisation; results are identical in every byte at all levels.
    """

    arch: str
    threads: int
    precision: str
    compile_cache: bool
    optimisation: Optimisation = "all"

    @property
    def facts(self) -> dict[str, str | int]:
        """The backend as in headers and records."""
        return {"arch": self.arch, "threads": self.threads, "precision": self.precision}

    @property
    def on_cpu(self) -> bool:
        """Whether kernels run on the CPU, where the scatter needs no atomics."""
        return self.arch == "cpu"

    @property
    def doubles(self) -> bool:
        """Whether the device has double precision, in which a run accumulates its time."""
        return self.arch != "metal"


def choose_backend(
    arch: Arch = "auto",
    threads: int | None = None,
    precision: str = "f32",
    *,
    compile_cache: bool = True,
    optimisation: Optimisation | None = None,
    doubles: bool = False,
) -> Backend:
    """Return the backend for a name on this machine without starting it.

    "auto" selects Metal on a Mac (in f32, unless kernels need `doubles`), CUDA if a driver and a device are present,
    and otherwise the CPU. Vulkan is selected only by name, because software Vulkan counts as a device.

    Args:
        threads: number of CPU threads; None for one per core.
        optimisation: None for "most" on the CPU and "few" on a GPU, whose driver optimises again.

    Raises:
        InputError: the backend or the precision is unknown, the backend lacks the precision, or the number of threads
            is out of range.
    """
    if arch not in ARCHES:
        raise InputError(f'--arch "{arch}" is not a backend; use one of {", ".join(ARCHES)}.')
    if precision not in ("f32", "f64"):
        raise InputError(f'precision "{precision}" is not known; use f32 or f64.')
    wanted = _best(doubles or precision == "f64") if arch == "auto" else arch
    if wanted in ("vulkan", "metal") and precision == "f64":
        raise InputError(f"precision f64 is not available on {wanted}; use --arch cpu or cuda, or f32.")
    cores = available_cores()
    count = (threads or cores) if wanted == "cpu" else 1
    most = max(FEW_THREADS, 2 * cores)
    if not 1 <= count <= most:
        raise InputError(f"--threads {count} is not possible; give 1 to {most}, ideally {cores} on this machine.")
    usual: Optimisation = "most" if wanted == "cpu" else "few"
    return Backend(wanted, count, precision, compile_cache, optimisation or usual)


def start(backend: Backend) -> Backend:
    """Start Taichi and return the backend; a second call must request the same backend, apart from its optimisation.

    Raises:
        InputError: the backend is not available, or another one is running.
    """
    global _started
    if _started is not None:
        if replace(_started, optimisation=backend.optimisation) != backend:
            raise InputError(
                f"this process already runs on {_started.arch} with {counted(_started.threads, 'thread')} in "
                f"{_started.precision}; another backend needs a new process."
            )
        return _started
    _initialise(backend)
    _started = backend
    return backend


def start_backend(
    arch: Arch = "auto", threads: int | None = None, precision: str = "f32", *, compile_cache: bool = True
) -> Backend:
    """Start the result of `choose_backend`; for errors see `choose_backend` and `start`."""
    return start(choose_backend(arch, threads, precision, compile_cache=compile_cache))


def stop_backend() -> None:
    """Stop the running backend and free all fields and kernels; another backend may start afterwards."""
    global _started
    ti.reset()
    _forget_kernels()
    _started = None
    while _endings:
        _endings.pop()()


def after_stop(ending: Callable[[], None]) -> None:
    """Call a function once after the backend has stopped, at the latest at the end of the process."""
    if ending not in _endings:
        _endings.append(ending)
    # Registered only once.
    atexit.unregister(stop_backend)
    atexit.register(stop_backend)


def _forget_kernels() -> None:
    """Free kernels, which Taichi keeps in a list; kernels defined in a function keep objects of their closure alive."""
    runtime = ti.lang.impl.get_runtime()
    known = [weakref.ref(kernel) for kernel in runtime.kernels]
    runtime.kernels = []
    gc.collect()
    runtime.kernels = [kernel for reference in known if (kernel := reference()) is not None]
    for kernel in runtime.kernels:
        # The mapping refers to the fields of earlier calls, whose compiled code no longer exists.
        kernel.mapper.mapping.clear()


def _settle_cache() -> None:
    """Set a writable cache directory, without which Taichi crashes at exit, and remove the lock of a killed process."""
    os.environ.pop("TI_OFFLINE_CACHE_FILE_PATH", None)
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi"
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        lock = folder / "ticache" / "ticache.lock"
        if lock.exists() and time.time() - lock.stat().st_mtime > LONGEST_LOCK:
            lock.unlink(missing_ok=True)
    # A user without a home directory and without a password entry.
    except (OSError, RuntimeError):
        os.environ["XDG_CACHE_HOME"] = _spare_cache()


def _spare_cache() -> str:
    """Return a directory for temporary files, the same for all runs of this user if no other user can write there."""
    user = os.getuid() if hasattr(os, "getuid") else 0
    place = Path(tempfile.gettempdir()) / f"mpmcli-cache-{user}"
    with contextlib.suppress(OSError):
        place.mkdir(mode=0o700, exist_ok=True)
        found = place.lstat()
        if stat.S_ISDIR(found.st_mode) and found.st_uid == user and not found.st_mode & 0o077:
            return str(place)
    return tempfile.mkdtemp(prefix="mpmcli-cache-")


def _best(doubles: bool) -> str:
    """Return the name of the fastest backend of this machine, for kernels with or without double precision."""
    if platform.system() == "Darwin" and not doubles and backend_is_here("metal"):
        return "metal"
    return "cuda" if backend_is_here("cuda") else "cpu"


def backend_is_here(arch: str) -> bool:
    """Return whether this machine has a device for a backend; the backend may still fail to start."""
    if arch == "cpu":
        return True
    # Taichi loads CUDA if the library of the driver is present, and ends the process if there is no device.
    if arch == "cuda" and not has_cuda_device():
        return False
    return bool(ti.lang.misc.is_arch_supported(getattr(ti, arch)))


def _position(context: ASTTransformerContext, node: ast.AST) -> str:
    """Return the source position of a node of a kernel, for error messages of Taichi.

    Taichi's own function, which is called for every node, takes a quarter of the start time of a run with cached
    kernels.
    """
    line = node.lineno + context.lineno_offset
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n'


@cache
def _source(code: CodeType) -> tuple[list[str], int]:
    """Return the lines of a function, dedented, and the number of the first; the code object keeps no fields alive.

    `inspect.getsourcelines` would search all loaded modules.
    """
    first = code.co_firstlineno
    lines = inspect.getblock(linecache.getlines(code.co_filename)[first - 1 :])
    return textwrap.dedent("".join(lines)).splitlines(), first


def _tree_of(text: str) -> ast.Module:
    """Return a syntax tree of a function that no function under construction uses: one may inline itself."""
    free = _trees[text]
    tree = free.pop() if free else ast.parse(text)
    tree.text = text
    return tree


def _built(tree: ast.Module, context: ASTTransformerContext) -> object:
    """Build a function from its syntax tree, which is kept for the next time that the same kernel inlines it."""
    result = transform_tree(tree, context)
    if context.is_kernel:
        # Trees refer to the fields of a kernel.
        _trees.clear()
    elif not context.is_real_function:
        # Taichi removes the parameters of other functions from their trees.
        _trees[tree.text].append(tree)
    return result


def _builder(kernel: Kernel) -> object:
    """Return the AST builder of the function that is being compiled.

    Taichi's own method returns the builder of the kernel; then a loop in a function inlined by a real function crashes
    the process.
    """
    return ti.lang.impl.get_runtime().compiling_callable.ast_builder()


def launcher(kernel: Callable, *arguments: int) -> Callable[[], None]:
    """Return a function that launches a kernel of an object again, given arguments that all are templates.

    Taichi's own call takes 30 microseconds more, to find the compiled kernel. The names are those of Taichi 1.7.4.
    """
    program, primal = ti.lang.impl.get_runtime().prog, kernel._primal
    compiled = primal.compiled_kernels[primal.ensure_compiled(kernel._kernel_owner, *arguments)]
    code = program.compile_kernel(program.config(), program.get_device_caps(), compiled)
    return lambda: program.launch_kernel(code, compiled.make_launch_context())


def _initialise(backend: Backend) -> None:
    """Start Taichi with the settings of a backend. Raises InputError if the device is missing or another one starts."""
    if not backend_is_here(backend.arch):
        raise InputError(f"--arch {backend.arch} needs a device that this machine does not have; use --arch cpu.")
    arch = getattr(ti, backend.arch)
    # This variable would override `arch`. (Standard output is redirected below because Taichi prints a line when it
    # starts.)
    os.environ.pop("TI_ARCH", None)
    _settle_cache()
    ASTTransformerContext.get_pos_info = _position
    Kernel.ast_builder = _builder
    # Taichi recomputes these each time it inlines a function, and wraps lines at 9,999 columns, which together is a
    # fifth of the time of its front end.
    kernel_impl.getsourcelines = lambda function: _source(function.__code__)
    kernel_impl.getsourcefile = lambda function: function.__code__.co_filename
    kernel_impl.textwrap = SimpleNamespace(fill=lambda line, **_: line, dedent=str)
    # It also parses the function again, which is another fifth.
    kernel_impl.ast, kernel_impl.transform_tree = SimpleNamespace(parse=_tree_of), _built
    # Before it reads `log_level`, Taichi would warn of each environment variable that `ti.init` overrides.
    ti.set_logging_level(ti.ERROR)
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(
            arch=arch,
            default_fp=ti.f64 if backend.precision == "f64" else ti.f32,
            cpu_max_num_threads=backend.threads,
            offline_cache=backend.compile_cache,
            offline_cache_max_size_of_files=CACHE_BYTES,
            # Strict arithmetic is as fast on the CPU, and comparisons with NaN remain correct.
            fast_math=False,
            # Real functions may write values that a serial loop would cache in variables; steps are equally fast
            # without.
            cache_loop_invariant_global_vars=not backend.on_cpu,
            # Formulas are loops that are unrolled, a step for each operator.
            unrolling_limit=0,
            log_level=ti.ERROR,
            **OPTIMISATION[backend.optimisation],
        )
    came = ti.lang.impl.current_cfg().arch
    if came != arch:
        raise InputError(f"--arch {backend.arch} did not start (Taichi started {came.name} instead); use --arch cpu.")


COUNT = 1000


def try_backend(arch: Arch) -> Backend:
    """Start a backend in f32, fill a field by a kernel, and return the backend if the values are correct.

    Raises:
        InputError: the backend is not available, does not start, or another one is running.
        RunError: the values are wrong.
    """
    started = start_backend(arch)
    squares = ti.field(ti.f32, COUNT)

    @ti.kernel
    def fill():
        for i in squares:
            squares[i] = float(i) * float(i)

    fill()
    # Squares of integers below 2^12 are exact in f32.
    if not np.array_equal(squares.to_numpy(), np.arange(COUNT, dtype=np.float32) ** 2):
        raise RunError(f"the test kernel of --arch {arch} computed wrong values.")
    return started


CUDA_LIBRARIES = {"linux": "libcuda.so.1", "win32": "nvcuda.dll"}
WORDS = ("out of memory", "out_of_memory", "failed to allocate", "out_of_device_memory", "bad_alloc")

# Taichi addresses fields with 32-bit integers.
LARGEST_INDEX = 2**31 - 1
# Fraction of the free memory that a run may use.
MEMORY_SHARE = 0.8


def has_cuda_device() -> bool:
    """Return whether there is a CUDA device, according to device files in /dev or to the driver.

    In a container the files may be those of any device of the host.
    """
    if any(Path("/dev").glob("nvidia[0-9]*")) or os.path.exists("/dev/dxg"):
        return True
    count = ctypes.c_int()
    try:
        driver = ctypes.CDLL(CUDA_LIBRARIES[sys.platform])
        return not driver.cuInit(0) and not driver.cuDeviceGetCount(ctypes.byref(count)) and count.value > 0
    except (OSError, KeyError, AttributeError):
        return False


def free_memory(arch: str) -> int | None:
    """Return the free bytes of the device that Taichi uses; None if it uses main memory or the size is unknown."""
    if arch != "cuda":
        return None
    try:
        return _free_cuda_memory(ctypes.CDLL(CUDA_LIBRARIES[sys.platform]))
    except (OSError, KeyError, AttributeError):
        return None


def _free_cuda_memory(driver: ctypes.CDLL) -> int | None:
    """Return the free bytes of the first device from the driver, in the context that Taichi will use."""
    device, context, free, total = ctypes.c_int(), ctypes.c_void_p(), ctypes.c_size_t(), ctypes.c_size_t()
    if driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0):
        return None
    if driver.cuDevicePrimaryCtxRetain(ctypes.byref(context), device):
        return None
    try:
        if driver.cuCtxPushCurrent_v2(context):
            return None
        failed = driver.cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total))
        driver.cuCtxPopCurrent_v2(ctypes.byref(context))
        return None if failed else free.value
    finally:
        driver.cuDevicePrimaryCtxRelease_v2(device)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error reports a failed allocation of memory on the device or on this machine."""
    if isinstance(error, MemoryError):
        return True
    said = str(error).lower()
    return isinstance(error, RuntimeError) and any(word in said for word in WORDS)


def out_of_memory_sentence(arch: str, error: BaseException) -> str:
    first = (str(error).strip().splitlines() or [type(error).__name__])[-1].strip().rstrip(".")
    where = "this machine" if arch == "cpu" else f"the {arch} device"
    return (
        f"There is not enough memory on {where} ({first}): use a larger domain.spacing or fewer particles_per_cell, "
        "or end other programs that use memory."
    )
