"""Checks each component that mpmcli needs, in a separate process."""

import ctypes
import importlib.metadata
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

from mpmcli import __version__
from mpmcli.plain_text import counted, size_text
from mpmcli.processes.pool import Fault, in_processes

# Supported versions of Python, as in pyproject.toml.
OLDEST, NEWEST = (3, 11), (3, 13)
# Number of concurrent processes, which mostly load libraries; their time limit, s, and that of ffmpeg.
AT_ONCE, TIMEOUT, FFMPEG_TIMEOUT = 2, 120.0, 20.0
# Free disk space below which a directory is a fault, bytes.
NO_DISK = 1e7
# Packages and their import names.
PACKAGES = {name: name for name in ("pyvista", "pysplashsurf", "matplotlib", "h5py", "meshio", "trimesh")} | {
    "pillow": "PIL"
}
# System libraries that packages load, and their Debian packages.
SYSTEM_PACKAGES = {"libX11": "libx11-6", "libXrender": "libxrender1", "libGL": "libgl1", "libEGL": "libegl1"}
# The name of a device, and whether it is emulated by the CPU.
Device = tuple[str, bool]
NAME_LENGTH = 256
# VkPhysicalDeviceProperties: offsets of deviceType and deviceName, an upper bound of its size, and the type of a CPU.
VULKAN_TYPE, VULKAN_NAME, VULKAN_SIZE, VULKAN_CPU = 16, 20, 4096, 4
# Size of VkInstanceCreateInfo in words of 8 bytes.
INSTANCE_INFO_WORDS = 8
VULKAN_LIBRARIES = {"linux": "libvulkan.so.1", "win32": "vulkan-1.dll", "darwin": "libvulkan.1.dylib"}


@dataclass(frozen=True)
class Check:
    """One line of the report: `detail` is the finding, `remedy` the advice to the user, "" for none."""

    status: Literal["ok", "information", "broken"]
    detail: str
    remedy: str = ""


def python(version: tuple[int, int] = sys.version_info[:2]) -> Check:
    """Check the version of the interpreter."""
    detail = f"{platform.python_version()}, {sys.prefix}"
    if OLDEST <= version <= NEWEST:
        return Check("ok", detail)
    oldest, newest = (".".join(map(str, numbers)) for numbers in (OLDEST, NEWEST))
    return Check("broken", detail, f"install mpmcli into an environment of Python {oldest} to {newest}")


def mpmcli() -> Check:
    """Return the version and the path of mpmcli."""
    return Check("ok", f"{__version__}, {Path(__file__).resolve().parent.parent}")


def taichi(arch: str) -> Check:
    """Check a backend by starting it. A missing GPU is not a fault."""
    from mpmcli.solver.machine.backend import backend_is_here, try_backend

    if arch == "cpu":
        threads = try_backend("cpu").threads
        return Check("ok", f"Taichi {importlib.metadata.version('taichi')}, {counted(threads, 'thread')}")
    if not backend_is_here(arch):
        return Check("information", "not available")
    try_backend(arch)
    devices = device_names(arch)
    names = ", ".join(name for name, _ in devices) or "device of unknown name"
    if devices and all(is_software for _, is_software in devices):
        return Check("information", f"software only: {names}", "--arch cpu uses the processor directly")
    return Check("ok", names)


def device_names(arch: str) -> list[Device]:
    """Return the devices of a backend from its driver, because Taichi does not name them; empty if the query fails."""
    from mpmcli.solver.machine.backend import CUDA_LIBRARIES

    asked = {"cuda": (_cuda, CUDA_LIBRARIES), "vulkan": (_vulkan, VULKAN_LIBRARIES)}
    if arch not in asked:
        return []
    ask, libraries = asked[arch]
    try:
        return ask(ctypes.CDLL(libraries[sys.platform]))
    except (OSError, KeyError, AttributeError):
        return []


def _cuda(driver: ctypes.CDLL) -> list[Device]:
    count, name = ctypes.c_int(), ctypes.create_string_buffer(NAME_LENGTH)
    if driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)):
        return []
    devices = []
    for number in range(count.value):
        handle = ctypes.c_int()
        if driver.cuDeviceGet(ctypes.byref(handle), number) or driver.cuDeviceGetName(name, NAME_LENGTH, handle):
            continue
        devices.append((name.value.decode(errors="replace"), False))
    return devices


def _vulkan(loader: ctypes.CDLL) -> list[Device]:
    """Return the devices that a Vulkan loader finds: name, and whether it is a processor."""
    instance, count = ctypes.c_void_p(), ctypes.c_uint32()
    # VkInstanceCreateInfo: sType is 1, and all other members may be zero.
    info = (ctypes.c_uint64 * INSTANCE_INFO_WORDS)(1)
    if loader.vkCreateInstance(ctypes.byref(info), None, ctypes.byref(instance)):
        return []
    loader.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), None)
    handles = (ctypes.c_void_p * count.value)()
    loader.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), handles)
    devices = []
    for handle in handles[: count.value]:
        properties = ctypes.create_string_buffer(VULKAN_SIZE)
        loader.vkGetPhysicalDeviceProperties(ctypes.c_void_p(handle), properties)
        kind = int.from_bytes(properties[VULKAN_TYPE : VULKAN_TYPE + 4], sys.byteorder)
        name = properties[VULKAN_NAME : VULKAN_NAME + NAME_LENGTH].split(b"\0")[0].decode(errors="replace")
        devices.append((name, kind == VULKAN_CPU))
    loader.vkDestroyInstance(instance, None)
    return devices


def vtk() -> Check:
    """Check VTK by drawing a picture off screen."""
    from mpmcli.render.window import choose_window

    name = choose_window()
    from vtkmodules.vtkCommonCore import vtkVersion
    from vtkmodules.vtkRenderingCore import vtkRenderWindow

    window = vtkRenderWindow()
    window.SetOffScreenRendering(True)
    window.Render()
    facts = dict(line.split(" string:", 1) for line in window.ReportCapabilities().splitlines() if " string:" in line)
    words = [vtkVersion.GetVTKVersion(), name, *(facts.get(f"OpenGL {fact}", "") for fact in ("renderer", "version"))]
    return Check("ok", ", ".join(word.strip() for word in words if word))


def package(name: str, module: str) -> Check:
    """Check a package by importing it."""
    importlib.import_module(module)
    return Check("ok", importlib.metadata.version(name))


def ffmpeg() -> Check:
    """Check ffmpeg by encoding one image with the codec of films."""
    import imageio_ffmpeg

    program = imageio_ffmpeg.get_ffmpeg_exe()
    source = ["-f", "lavfi", "-i", "color=s=16x16", "-frames:v", "1", "-c:v", "libx264", "-f", "null", "-"]
    subprocess.run([program, "-v", "error", *source], check=True, timeout=FFMPEG_TIMEOUT, stdin=subprocess.DEVNULL)
    return Check("ok", f"{program}, encoder libx264")


def writable(place: Path) -> Check:
    """Check a directory by creating a file in it."""
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=place):
        free = shutil.disk_usage(place).free
    status = "ok" if free >= NO_DISK else "broken"
    return Check(status, f"{place}, writable, {size_text(free)} free", "" if status == "ok" else "free some space")


def memory() -> Check:
    """Return the total and the free memory of this machine."""
    import psutil

    found = psutil.virtual_memory()
    return Check("ok", f"{size_text(found.total)}, {size_text(found.available)} free")


# Checks in the order of the report. A broken OPTIONAL component is not a fault, because mpmcli runs without it.
CHECKS: dict[str, Callable[[], Check]] = {
    "python": python,
    "mpmcli": mpmcli,
    **{f"taichi {arch}": partial(taichi, arch) for arch in ("cpu", "cuda", "vulkan", "metal")},
    "vtk": vtk,
    **{name: partial(package, name, module) for name, module in PACKAGES.items()},
    "ffmpeg": ffmpeg,
    "directory": lambda: writable(Path.cwd()),
    "kernel cache": lambda: writable(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi"),
    "memory": memory,
}
OPTIONAL = ("taichi vulkan", "kernel cache")


def run_check(name: str) -> Check:
    """Return the result of a check in this process."""
    try:
        return CHECKS[name]()
    except Exception as error:
        return _fault(name, f"{type(error).__name__}: {error}")


def examine(work: Callable[[str], Check] = run_check) -> Iterator[tuple[str, Check]]:
    """Yield (name, result) of every check, in order. Each runs in a separate process, which may crash."""
    ended: dict[str, Check] = {}
    waiting = list(CHECKS)
    for name, answer in in_processes(waiting, AT_ONCE, work, TIMEOUT):
        ended[name] = _fault(name, answer.words) if isinstance(answer, Fault) else answer
        while waiting and waiting[0] in ended:
            first = waiting.pop(0)
            yield first, ended[first]


def _fault(name: str, detail: str) -> Check:
    """Return a fault, with the system library to install if one is missing."""
    missed = re.search(r"(lib\w+)[\w.+-]*: cannot open shared object", detail)
    remedy = "reinstall mpmcli"
    if missed:
        remedy = f"install the system package of {missed[1]}"
        if missed[1] in SYSTEM_PACKAGES:
            remedy += f", on Debian and Ubuntu by `apt-get install {SYSTEM_PACKAGES[missed[1]]}`"
    elif name.startswith("taichi ") and name != "taichi cpu":
        remedy = "repair or remove the driver; --arch cpu runs without it"
    return Check("information" if name in OPTIONAL else "broken", " ".join(detail.split())[-300:], remedy)
