"""Starts Taichi, once per process, on the requested backend, and returns the one that started."""

import ast
import contextlib
import gc
import inspect
import io
import os
import platform
import tempfile
import textwrap
import time
import weakref
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import CodeType, SimpleNamespace
from typing import Literal

import taichi as ti
from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext
from taichi.lang.kernel_impl import Kernel

from mpmcli.cores import available_cores
from mpmcli.errors import InputError
from mpmcli.plain_text import counted
from mpmcli.solver.device_memory import has_cuda_device

# Taichi's optimisations: all, all but those across branches, or few. Those across branches take half to three quarters
# of the time to compile for a CPU, and save nothing. Few halve the rest, and steps are 7 to 30 % slower.
Optimisation = Literal["all", "most", "few"]
OPTIMISATION: dict[str, dict[str, bool]] = {
    "all": {},
    "most": {"cfg_optimization": False},
    "few": {"advanced_optimization": False},
}

Arch = Literal["auto", "cpu", "cuda", "vulkan", "metal"]
ARCHES: tuple[str, ...] = ("auto", "cpu", "cuda", "vulkan", "metal")

# Threads that are accepted on any machine; beyond that, twice the number of cores.
FEW_THREADS = 64
# Age, s, at which a lock on the compiled kernels counts as left behind by a killed process.
LONGEST_LOCK = 60.0

_started: "Backend | None" = None


@dataclass(frozen=True)
class Backend:
    """The backend that runs the kernels.

    Attributes:
        arch: "cpu", "cuda", "vulkan" or "metal": the one that started.
        threads: CPU threads that kernels use (1 on a GPU).
        precision: "f32" or "f64", the type of every particle and node value.
        compile_cache: whether compiled kernels are kept for the next start.
        optimisation: how much of Taichi's optimisation kernels get; results have the same bytes with any.
    """

    arch: str
    threads: int
    precision: str
    compile_cache: bool
    optimisation: Optimisation = "all"

    @property
    def on_cpu(self) -> bool:
        """Whether kernels run on the CPU, where the scatter needs no atomics."""
        return self.arch == "cpu"


def choose_backend(
    arch: Arch = "auto",
    threads: int | None = None,
    precision: str = "f32",
    *,
    compile_cache: bool = True,
    optimisation: Optimisation | None = None,
) -> Backend:
    """Return the backend that a name stands for on this machine; it is not started.

    "auto" takes CUDA where a driver and a device are present, Metal on a Mac, and otherwise the CPU. Vulkan is taken
    only by name, since software Vulkan counts as a device.

    Args:
        threads: of the CPU; None for one on each core.
        optimisation: None for most on the CPU, and all on a GPU.

    Raises:
        InputError: it cannot do this precision, or not with so many threads.
    """
    if arch not in ARCHES:
        raise InputError(f'--arch "{arch}" is not a backend; use one of {", ".join(ARCHES)}.')
    if precision not in ("f32", "f64"):
        raise InputError(f'precision "{precision}" is not known; use f32 or f64.')
    wanted = _best(precision) if arch == "auto" else arch
    if wanted in ("vulkan", "metal") and precision == "f64":
        raise InputError(f"precision f64 is not available on {wanted}; use --arch cpu or cuda, or f32.")
    cores = available_cores()
    count = (threads or cores) if wanted == "cpu" else 1
    most = max(FEW_THREADS, 2 * cores)
    if not 1 <= count <= most:
        raise InputError(f"--threads {count} is not possible; give 1 to {most}, best {cores} on this machine.")
    usual: Optimisation = "most" if wanted == "cpu" else "all"
    return Backend(wanted, count, precision, compile_cache, optimisation or usual)


def start(backend: Backend) -> Backend:
    """Start Taichi and return the backend; a second call must request the same, but for its optimisation.

    Raises:
        InputError: the backend is not there, or another one is running.
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
    """Start what `choose_backend` returns; see both for the errors."""
    return start(choose_backend(arch, threads, precision, compile_cache=compile_cache))


def stop_backend() -> None:
    """End the running backend, and with it every field and kernel; another may start then."""
    global _started
    ti.reset()
    _forget_kernels()
    _started = None


def _forget_kernels() -> None:
    """Let go of kernels that nothing else holds.

    Taichi keeps a list of all kernels ever made, to empty them at a restart. Those made in a function, as ours are,
    hold everything that they were made for.
    """
    runtime = ti.lang.impl.get_runtime()
    known = [weakref.ref(kernel) for kernel in runtime.kernels]
    runtime.kernels = []
    gc.collect()
    runtime.kernels = [kernel for reference in known if (kernel := reference()) is not None]
    for kernel in runtime.kernels:
        # By the fields that it was called with; what was compiled for them is gone.
        kernel.mapper.mapping.clear()


def _settle_cache() -> None:
    """Set a writable cache directory; Taichi crashes at exit where it has none.

    A process that is killed while it writes leaves its lock behind, and later ones could not store kernels.
    """
    os.environ.pop("TI_OFFLINE_CACHE_FILE_PATH", None)
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        lock = folder / "ticache" / "ticache.lock"
        if lock.exists() and time.time() - lock.stat().st_mtime > LONGEST_LOCK:
            lock.unlink(missing_ok=True)
    except OSError:
        os.environ["XDG_CACHE_HOME"] = tempfile.mkdtemp(prefix="mpmcli-cache-")


def _best(precision: str) -> str:
    """Name the fastest backend that this machine has for this precision."""
    if platform.system() == "Darwin" and precision == "f32" and _has("metal"):
        return "metal"
    return "cuda" if _has("cuda") else "cpu"


def _has(arch: str) -> bool:
    if arch == "cpu":
        return True
    # Taichi loads CUDA wherever the driver's library is present, and ends the process without a device.
    if arch == "cuda" and not has_cuda_device():
        return False
    return bool(ti.lang.misc.is_arch_supported(getattr(ti, arch)))


def _position(context: ASTTransformerContext, node: ast.AST) -> str:
    """Return the position of a node of a kernel's source, for Taichi's error messages.

    Taichi's own function adds the source lines and underlines the node. It runs for every node of every kernel, whether
    an error follows or not, and takes a quarter of the start of a run whose kernels are cached.
    """
    line = node.lineno + context.lineno_offset
    return f'File "{context.file}", line {line}, in {context.func.func.__name__}:\n'


@cache
def _source(code: CodeType) -> tuple[list[str], int]:
    """Return the lines of a function and the number of the first; a code object keeps no fields alive."""
    return inspect.getsourcelines(code)


def _builder(kernel: Kernel) -> object:
    """Return what collects the statements of the function that is being compiled.

    Where a real function calls one that is inlined, Taichi's own method returns that of the kernel, and a loop in there
    ends the process.
    """
    return ti.lang.impl.get_runtime().compiling_callable.ast_builder()


def _initialise(backend: Backend) -> None:
    if not _has(backend.arch):
        raise InputError(f"--arch {backend.arch} needs a device that this machine does not have; use --arch cpu.")
    arch = getattr(ti, backend.arch)
    # This variable would override `arch`. Taichi prints a line to standard output when it starts.
    os.environ.pop("TI_ARCH", None)
    _settle_cache()
    ASTTransformerContext.get_pos_info = _position
    Kernel.ast_builder = _builder
    # Taichi asks for all of this anew each time that it inlines a function, and wraps lines at 9,999 columns: together
    # a fifth of the work of its front end.
    ti.lang.kernel_impl.getsourcelines = lambda function: _source(function.__code__)
    ti.lang.kernel_impl.getsourcefile = lambda function: function.__code__.co_filename
    ti.lang.kernel_impl.textwrap = SimpleNamespace(fill=lambda line, **_: line.rstrip(), dedent=textwrap.dedent)
    # Taichi would warn of each of its variables that `ti.init` overrides, before it reads `log_level`.
    ti.set_logging_level(ti.ERROR)
    with contextlib.redirect_stdout(io.StringIO()):
        ti.init(
            arch=arch,
            default_fp=ti.f64 if backend.precision == "f64" else ti.f32,
            cpu_max_num_threads=backend.threads,
            offline_cache=backend.compile_cache,
            # Strict arithmetic is as fast on the CPU, and a NaN stays a NaN in every comparison.
            fast_math=False,
            # Real functions may write what a serial loop would keep in variables; steps are as fast without.
            cache_loop_invariant_global_vars=not backend.on_cpu,
            log_level=ti.ERROR,
            **OPTIMISATION[backend.optimisation],
        )
    came = ti.lang.impl.current_cfg().arch
    if came != arch:
        raise InputError(f"--arch {backend.arch} did not start ({came.name} came instead); use --arch cpu.")
