"""What each test costs: a plugin of pytest that writes wall clock, CPU time and compiled kernels to build/tests.csv."""

import csv
import os
import sys
import time
from collections import defaultdict
from collections.abc import Generator
from pathlib import Path

import pytest

TABLE = Path(__file__).resolve().parent.parent / "build" / "tests.csv"
COLUMNS = ("seconds", "cpu_seconds", "kernels")

_costs: dict[str, list[float]] = defaultdict(lambda: [0.0, 0.0, 0])
_compiled = 0


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


def _now() -> tuple[float, float, int]:
    """Return the wall clock and the CPU time of this process and of those that it has waited for, and the count."""
    return time.perf_counter(), sum(os.times()[:4]), _compiled


def _measured(item: pytest.Item, phase: str) -> Generator[None, object, object]:
    _count_kernels()
    before = _now()
    try:
        return (yield)
    finally:
        _count_kernels()
        item.user_properties.append((f"cost of {phase}", [b - a for a, b in zip(before, _now(), strict=True)]))


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


def pytest_sessionfinish(session: pytest.Session) -> None:
    if not _costs or hasattr(session.config, "workerinput"):
        return
    TABLE.parent.mkdir(exist_ok=True)
    with TABLE.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow((*COLUMNS, "test"))
        for test, (wall, cpu, kernels) in sorted(_costs.items(), key=lambda entry: -entry[1][0]):
            rows.writerow((f"{wall:.2f}", f"{cpu:.2f}", int(kernels), test))
