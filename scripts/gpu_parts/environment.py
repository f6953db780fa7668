"""The machine, its device, and the versions of what computes."""

import csv
import ctypes
import importlib.metadata
import os
import platform
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from page_section import markdown_table

from gpu_parts.parts import Setup, Task

ROOT = Path(__file__).resolve().parent.parent.parent
PACKAGES = ("taichi", "numpy", "h5py", "pydantic", "pytest", "pytest-xdist", "vtk")
ASKED = (
    "name",
    "driver_version",
    "memory.total",
    "memory.used",
    "clocks.sm",
    "clocks.max.sm",
    "clocks.mem",
    "power.limit",
)
# Attribute of the CUDA driver: whether it has memory pools. Without them Taichi takes all fields from 1 GB.
MEMORY_POOLS = 115


def tasks(setup: Setup) -> Sequence[Task]:
    """Return the machine, the packages, and the device."""
    return (
        Task("machine", lambda left: machine()),
        Task("packages", lambda left: {name: version_of(name) for name in PACKAGES}),
        Task("device", lambda left: device(setup.arch)),
    )


def machine() -> dict:
    """Return processor, memory and versions."""
    import psutil

    from mpmcli import __version__
    from mpmcli.bench.report import describe_machine
    from mpmcli.cores import available_cores

    return {
        "processor": describe_machine()["processor"],
        "cores": available_cores(),
        "memory_bytes": psutil.virtual_memory().total,
        "system": f"{platform.system()} {platform.machine()}",
        "python": sys.version.split()[0],
        "mpmcli": __version__,
        "commit": said(["git", "-C", str(ROOT), "rev-parse", "--short", "HEAD"]),
    }


def version_of(package: str) -> str | None:
    """Return the version of an installed package, None where it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def device(arch: str) -> dict:
    """Start the backend and return the names of its devices, what is free there, and what nvidia-smi says."""
    from mpmcli.doctor.devices import device_names
    from mpmcli.solver.machine.backend import start_backend
    from mpmcli.solver.machine.device_memory import CUDA_LIBRARIES, free_memory

    start_backend(arch)
    row = {
        "arch": arch,
        "names": [found.name for found in device_names(arch)],
        "free_bytes": free_memory(arch),
        "visible": os.environ.get("CUDA_VISIBLE_DEVICES"),
    }
    if arch == "cuda":
        driver, pools, version = ctypes.CDLL(CUDA_LIBRARIES[sys.platform]), ctypes.c_int(), ctypes.c_int()
        driver.cuDeviceGetAttribute(ctypes.byref(pools), MEMORY_POOLS, 0)
        driver.cuDriverGetVersion(ctypes.byref(version))
        row |= {
            "memory_pools": bool(pools.value),
            "driver_cuda": f"{version.value // 1000}.{version.value % 1000 // 10}",
        }
    answer = said(["nvidia-smi", f"--query-gpu={','.join(ASKED)}", "--format=csv,noheader"])
    cells = [cell.strip() for cell in next(csv.reader([answer]))] if answer else []
    return row | {"nvidia_smi": dict(zip(ASKED, cells, strict=False))}


def said(command: list[str]) -> str | None:
    """Return the first line that a command prints, None where it fails or is not there."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return None
    lines = done.stdout.strip().splitlines()
    return lines[0] if done.returncode == 0 and lines else None


def section(rows: dict[str, dict]) -> str:
    """Return everything as a table of names and values."""
    cells = [[f"{key}: {name}", text_of(value)] for key, row in rows.items() for name, value in row.items()]
    return markdown_table(["what", "value"], cells, set())


def text_of(value: object) -> str:
    """Return a value as text."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {text_of(item)}" for name, item in value.items()) or "-"
    if isinstance(value, list):
        return ", ".join(map(text_of, value)) or "-"
    return (
        "-" if value is None else f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)
    )
