"""What each test costs: a plugin of pytest that writes wall clock, CPU time and compiled kernels to build/tests.csv.

Most of the time of the suite is that of the kernels of runs, one for each kind of run. `kinds.toml` says how many kinds
the tests of a file run in their own process, those marked slow aside; a file that runs more fails the suite.
"""

import csv
import hashlib
import os
import sys
import time
import tomllib
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path

import pytest

TABLE = Path(__file__).resolve().parent.parent / "build" / "tests.csv"
COLUMNS = ("seconds", "cpu_seconds", "kernels")

KINDS = tomllib.loads(Path(__file__).with_name("kinds.toml").read_text(encoding="utf-8"))

_costs: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0])
_compiled = 0
# Kinds run in this process during the present phase of a test; by file, those of all tests.
_run: set[str] = set()
_kinds: dict[str, set[str]] = defaultdict(set)


def _count_kernels() -> None:
    """Count the kernels whose code Taichi makes in this process from now on, once Taichi is there."""
    kernel_impl = sys.modules.get("taichi.lang.kernel_impl")
    if kernel_impl is None or hasattr(kernel_impl.Kernel.materialize, "uncounted"):
        return
    materialize = kernel_impl.Kernel.materialize

    def counted(kernel: object, key: object = None, *args: object, **options: object) -> object:
        global _compiled
        _compiled += key not in kernel.compiled_kernels
        return materialize(kernel, key, *args, **options)

    counted.uncounted = materialize
    kernel_impl.Kernel.materialize = counted


def _note_kinds() -> None:
    """Note the kind of each batch that is launched in this process from now on, once there are batches."""
    module = sys.modules.get("mpmcli.solver.engine.batch")
    if module is None or hasattr(module.Batch.launch, "unnoted"):
        return
    launch = module.Batch.launch

    def noted(batch: object) -> None:
        backend = batch.backend
        kind = repr((batch.kind, backend.arch, backend.threads, backend.precision, batch.runs))
        _run.add(hashlib.sha256(kind.encode()).hexdigest()[:16])
        launch(batch)

    noted.unnoted = launch
    module.Batch.launch = noted


def _now() -> tuple[float, float, int]:
    """Return the wall clock and the CPU time of this process and of those that it has waited for, and the count."""
    return time.perf_counter(), sum(os.times()[:4]), _compiled


def _measured(item: pytest.Item, phase: str) -> Generator[None, object, object]:
    _count_kernels()
    _note_kinds()
    _run.clear()
    before = _now()
    try:
        return (yield)
    finally:
        _count_kernels()
        _note_kinds()
        item.user_properties.append((f"cost of {phase}", [b - a for a, b in zip(before, _now(), strict=True)]))
        if item.get_closest_marker("slow") is None:
            item.user_properties.append((f"kinds of {phase}", sorted(_run)))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _measured(item, "setup"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _measured(item, "call"))


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None, object, object]:
    return (yield from _measured(item, "teardown"))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Sum the phases of a test, in the process that reports."""
    for name, cost in report.user_properties:
        if name == f"cost of {report.when}":
            _costs[report.nodeid] = [a + b for a, b in zip(_costs[report.nodeid], cost, strict=True)]
        if name == f"kinds of {report.when}":
            _kinds[Path(report.nodeid.partition("::")[0]).stem].update(cost)


def _beyond() -> dict[str, int]:
    """Return the kinds of those files that run more than `kinds.toml` has."""
    return {file: len(kinds) for file, kinds in sorted(_kinds.items()) if len(kinds) > KINDS.get(file, 0)}


@pytest.hookimpl(trylast=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for file, n in _beyond().items():
        terminalreporter.write_line(
            f"{file} runs {n} kinds of kernels, and {KINDS.get(file, 0)} in tests/kinds.toml: share a kind, or mark "
            "tests as slow.",
            red=True,
        )


def pytest_sessionfinish(session: pytest.Session) -> None:
    if not _costs or hasattr(session.config, "workerinput"):
        return
    if _beyond() and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
    TABLE.parent.mkdir(exist_ok=True)
    kinds = [f"{file} = {len(found)}\n" for file, found in sorted(_kinds.items()) if found]
    TABLE.with_name("kinds.toml").write_text("".join(kinds), encoding="utf-8")
    with TABLE.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow((*COLUMNS, "test"))
        for test, (wall, cpu, kernels) in sorted(_costs.items(), key=lambda entry: -entry[1][0]):
            rows.writerow((f"{wall:.2f}", f"{cpu:.2f}", int(kernels), test))
