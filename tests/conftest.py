"""Fixtures that every test may use."""

import gc
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from mpmcli.solver.machine.backend import Backend

pytest_plugins = ("cost",)

ROOT = Path(__file__).resolve().parent.parent

# Kernels compile inside examples and machines are shared: time says nothing about correctness.
# A run of the suite tries the same examples each time; `--hypothesis-profile random` tries others.
settings.register_profile("random", deadline=None, max_examples=50, print_blob=True)
settings.register_profile("mpmcli", settings.get_profile("random"), derandomize=True, max_examples=25)
settings.load_profile("mpmcli")

# The backend of tests marked gpu; scripts/gpu sets it to that of the device.
GPU = os.environ.get("MPMCLI_TEST_GPU", "vulkan")

# Taichi's variable, and its value for few optimisations.
FEW = ("TI_ADVANCED_OPTIMIZATION", "0")

# Where the shell has left these ignored, as it does for jobs in the background, so would all processes of tests.
for name, usual in (("SIGINT", signal.default_int_handler), ("SIGHUP", signal.SIG_DFL)):
    if signal.getsignal(getattr(signal, name)) is signal.SIG_IGN:
        signal.signal(getattr(signal, name), usual)

# Files that take longest, which begin first: at the end of a run one core would wait for the other.
LONG = ("test_docs", "test_configs", "test_sweep_run", "test_batch", "test_solver_paths", "test_hard_materials")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    places = {name: k for k, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path.stem, len(LONG)))


def pytest_collection_finish() -> None:
    """Leave modules and tests, which stay, out of collections of garbage: one comes with every restart of Taichi."""
    gc.collect()
    gc.freeze()


@dataclass(frozen=True)
class PythonRun:
    """What a Python process left: exit status, stdout and stderr as text."""

    status: int
    stdout: str
    stderr: str


def python(
    words: Sequence[object], stdin: str = "", environment: Mapping[str, str] | None = None, **how: object
) -> PythonRun:
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    process, how = [sys.executable, *map(str, words)], {"capture_output": True, "text": True, "timeout": 300} | how
    done = subprocess.run(process, input=stdin, env={**os.environ, "PYTHONPATH": path, **(environment or {})}, **how)
    return PythonRun(done.returncode, done.stdout, done.stderr)


@pytest.fixture
def run_python(tmp_path: Path) -> Callable[..., PythonRun]:
    """Return `run(code_or_arguments, ...)`: it runs Python in a process of its own and returns a PythonRun.

    A string is code, a sequence is arguments (`["-m", "mpmcli.cli", "--help"]`). Taichi can start only once
    per process, so whatever needs a second backend, or a fresh interpreter, runs here. `check=True` (the
    default) fails the test with the process's stderr when its status is not 0. Further keywords: `stdin`
    (text), `cwd` (default tmp_path), `timeout` in seconds, `environment` to add to the present one.
    """

    def run(
        code_or_arguments: str | list[str],
        *,
        check: bool = True,
        stdin: str | None = None,
        cwd: Path = tmp_path,
        timeout: float = 300,
        environment: dict[str, str] | None = None,
    ) -> PythonRun:
        words = ["-c", code_or_arguments] if isinstance(code_or_arguments, str) else code_or_arguments
        done = python(words, stdin or "", environment, cwd=cwd, timeout=timeout)
        if check and done.status != 0:
            pytest.fail(f"python exited with {done.status}:\n{done.stdout}\n{done.stderr}")
        return done

    return run


@pytest.fixture(scope="session")
def run_module() -> Callable[..., PythonRun]:
    """Return `run(file, *arguments)`: a Python file in a process of its own, with any exit status."""
    return lambda file, *arguments: python([file, *arguments])


@pytest.fixture(scope="session", autouse=True)
def few_optimisations() -> Iterator[None]:
    """Let all commands and processes compile with few of Taichi's optimisations.

    All of them take half of the time to compile or more, and leave the bytes as they are (test_optimisation.py).
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(*FEW)
        yield


@pytest.fixture
def own_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let runs of a test neither take stored kernels nor store theirs."""
    monkeypatch.setenv("MPMCLI_KERNEL_STORE", "off")


@pytest.fixture
def usual_optimisations(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a test compile with the optimisations that users have."""
    monkeypatch.delenv(FEW[0], raising=False)


@pytest.fixture
def record_property(record_property: Callable[[str, object], None]) -> Callable[[str, object], None]:
    """Return pytest's own, for numbers of numpy too, which a worker could not send to the process that reports."""
    return lambda name, value: record_property(name, value.item() if hasattr(value, "item") else value)


@pytest.fixture(scope="session")
def backend_of() -> "Iterator[Callable[..., Backend]]":
    """Return `start(precision, threads=1, arch="cpu", fully_optimised=False)`, which replaces the running backend.

    Taichi is global: whatever was built on the backend before dies with it, so a module starts one and
    builds its runs on it, or keeps no run from one test to the next.

    It compiles with few of Taichi's optimisations, as all tests do; a `fully_optimised` one has all.

    Vulkan stands for the GPU of the tests, see GPU.
    """
    from mpmcli.solver.machine.backend import start_backend, stop_backend

    def start(precision: str, threads: int = 1, arch: str = "cpu", *, fully_optimised: bool = False) -> "Backend":
        stop_backend()
        arch = GPU if arch == "vulkan" else arch
        with pytest.MonkeyPatch.context() as patch:
            if fully_optimised:
                patch.delenv(FEW[0], raising=False)
            return start_backend(arch, threads, precision)

    yield start
    stop_backend()


@pytest.fixture(scope="session")
def drawing() -> str:
    """The window that draws without a screen; a test that asks for it is skipped where there is none."""
    from mpmcli.errors import InputError
    from mpmcli.render.window import choose_window

    try:
        return choose_window()
    except InputError as error:
        pytest.skip(str(error))
