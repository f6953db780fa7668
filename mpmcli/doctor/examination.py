"""Tries every component that mpmcli needs in a separate process, so that a crash affects only one, in order."""

import importlib.metadata
import io
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Literal

from mpmcli import __version__
from mpmcli.errors import MpmcliError
from mpmcli.plain_text import counted, size_text
from mpmcli.processes.questions import Question, Reply, answering, ask_each, module_command

# "missing" and "broken" are faults: a required component is absent or does not work.
Status = Literal["ok", "information", "missing", "broken"]
# System libraries that the wheels of required packages load, and their Debian and Ubuntu packages.
SYSTEM_PACKAGES = {
    "libX11.so.6": "libx11-6",
    "libXrender.so.1": "libxrender1",
    "libGL.so.1": "libgl1",
    "libEGL.so.1": "libegl1",
    "libstdc++.so.6": "libstdc++6",
    "libgcc_s.so.1": "libgcc-s1",
    "libz.so.1": "zlib1g",
}
STATUSES: tuple[Status, ...] = ("ok", "information", "missing", "broken")
# As in pyproject.toml.
OLDEST, NEWEST = (3, 11), (3, 13)
# Bytes. Below this a run of the size of the demo may not fit.
LITTLE_DISK = LITTLE_MEMORY = 1e9
# Bytes. Below this nothing useful can be written.
NO_DISK = 1e7
CGROUP = Path("/sys/fs/cgroup")
# Time limit of ffmpeg, s. It usually takes 0.1 s.
FFMPEG_TIMEOUT = 20.0
# Number of concurrent processes. They mostly load libraries.
AT_ONCE = 2
# Time limit, s. Loading a large library from a cold disk may take most of it.
TIMEOUT = 60.0
# Time limit for three window types, s.
WINDOW_TIMEOUT = 400.0
# Maximum length of a detail, characters.
LONGEST = 300


@dataclass(frozen=True)
class ProbeResult:
    """One line of the report: a status, the detail, and what the user can do, "" if nothing is required."""

    status: Status
    detail: str
    remedy: str = ""

    @property
    def is_fault(self) -> bool:
        """Whether a required component is missing or broken."""
        return self.status in ("missing", "broken")


def package_remedy(package: str, *, again: bool = False) -> str:
    """Return the command that installs, or reinstalls, a package in the version that mpmcli requires."""
    return f"{'install it again' if again else 'install it'} by `python -m pip install {_requirement(package, again)}`"


def library_remedy(complaint: str) -> str:
    """Return how to install the system library that the dynamic linker did not find; "" if none is named."""
    missed = re.search(r"(lib[\w.+-]*\.so[\d.]*): (?:cannot open shared object|file too short)", complaint)
    if missed is None:
        return ""
    library = missed[1]
    package = SYSTEM_PACKAGES.get(library)
    by = f", on Debian and Ubuntu by `apt-get install {package}`" if package else ""
    return f"install the system's package of {library}{by}"


def _requirement(package: str, again: bool) -> str:
    try:
        listed = importlib.metadata.requires("mpmcli") or []
    except importlib.metadata.PackageNotFoundError:
        listed = []
    # Without extras such as "; extra == 'test'".
    found = [line for line in listed if re.split(r"[^\w.-]", line)[0].lower() == package.lower() and ";" not in line]
    return ("--force-reinstall " if again else "") + f'"{found[0] if found else package}"'


def python(version: tuple[int, int] = sys.version_info[:2]) -> ProbeResult:
    """Examine the version of the interpreter."""
    kind = "virtual environment" if sys.prefix != sys.base_prefix else "no virtual environment,"
    detail = f"{platform.python_version()}, {kind} {sys.prefix}"
    if OLDEST <= version <= NEWEST:
        return ProbeResult("ok", detail)
    oldest, newest = (".".join(map(str, numbers)) for numbers in (OLDEST, NEWEST))
    return ProbeResult("broken", detail, f"install mpmcli into an environment of Python {oldest} to {newest}")


def mpmcli() -> ProbeResult:
    """Examine the package."""
    return ProbeResult("ok", f"{__version__}, {Path(__file__).resolve().parent.parent}")


def cpu() -> ProbeResult:
    """Examine the CPU backend, which is required."""
    from mpmcli.solver.machine.backend import try_backend

    started = try_backend("cpu")
    version = importlib.metadata.version("taichi")
    return ProbeResult("ok", f"Taichi {version}, {counted(started.threads, 'thread')}")


def gpu(arch: str) -> ProbeResult:
    """Examine a backend of GPUs: CUDA, Metal, or Vulkan, whose device may be a software renderer."""
    try:
        from mpmcli.solver.machine.backend import backend_is_here, try_backend
    except ImportError as error:
        return ProbeResult("information", f"not tried, since Taichi cannot be loaded ({error})")
    if not backend_is_here(arch):
        return ProbeResult("information", "not here")
    try_backend(arch)
    from mpmcli.doctor.devices import device_names

    devices = device_names(arch)
    names = ", ".join(device.name for device in devices) or "device of unknown name"
    if devices and all(device.is_software for device in devices):
        return ProbeResult("information", f"software only: {names}", "--arch cpu uses the processor directly")
    return ProbeResult("ok", names)


def vtk() -> ProbeResult:
    """Examine VTK by drawing. A missing window may abort the process, so each window is tried in a separate one."""
    from vtkmodules.vtkCommonCore import vtkVersion

    from mpmcli.render.window import remedy, try_windows, why_none

    version = vtkVersion.GetVTKVersion()
    attempts = list(try_windows())
    window = attempts[-1].window
    if window is None:
        return ProbeResult("missing", f"{version}, no OpenGL window opens ({why_none(attempts)})", remedy(attempts))
    return ProbeResult("ok", f"{version}, {window.name} on {window.renderer}, OpenGL {window.version}")


def importable(package: str) -> ProbeResult:
    """Examine a package by importing it."""
    return ProbeResult("ok", importlib.import_module(package).__version__)


def pysplashsurf() -> ProbeResult:
    """Examine pysplashsurf by reconstructing the surface of a cube of particles."""
    import numpy as np
    import pysplashsurf

    axis = np.arange(4, dtype=np.float32)
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    surface, _ = pysplashsurf.reconstruction_pipeline(
        cube, particle_radius=0.5, smoothing_length=2.0, cube_size=1.0, iso_surface_threshold=0.6
    )
    version = importlib.metadata.version("pysplashsurf")
    if not surface.ncells:
        return ProbeResult("broken", f"{version}, finds no surface around a cube of particles")
    return ProbeResult("ok", version)


def pillow() -> ProbeResult:
    """Examine Pillow by drawing a letter."""
    import PIL
    from PIL import Image, ImageDraw

    ImageDraw.Draw(Image.new("RGB", (16, 16))).text((0, 0), "a")
    return ProbeResult("ok", PIL.__version__)


def hdf5() -> ProbeResult:
    """Examine h5py by writing and reading back a file in memory, with the filters of results."""
    import h5py
    import numpy as np

    versions = f"h5py {h5py.version.version}, HDF5 {h5py.version.hdf5_version}"
    values = np.arange(3000, dtype=np.float32).reshape(1000, 3)
    with io.BytesIO() as memory:
        with h5py.File(memory, "w", libver=("v110", "v110")) as file:
            file.create_dataset("values", data=values, chunks=(100, 3), compression="gzip", shuffle=True)
        with h5py.File(memory, "r") as file:
            stored = file["values"]
            filters = [name for name, on in (("gzip", stored.compression == "gzip"), ("shuffle", stored.shuffle)) if on]
            intact = np.array_equal(stored[:], values)
    if not intact or len(filters) < 2:
        return ProbeResult("broken", f"{versions}, gzip and shuffle do not give back what was written")
    return ProbeResult("ok", f"{versions}, filters gzip and shuffle")


def ffmpeg() -> ProbeResult:
    """Examine ffmpeg, which encodes films, by encoding one image."""
    import imageio_ffmpeg

    try:
        program = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        return ProbeResult("missing", str(error).partition("\n")[0], package_remedy("imageio-ffmpeg", again=True))
    remedy = "unset IMAGEIO_FFMPEG_EXE if it is set, or " + package_remedy("imageio-ffmpeg", again=True)
    try:
        version = imageio_ffmpeg.get_ffmpeg_version()
    except (OSError, subprocess.CalledProcessError, ValueError) as error:
        reason = f"exited with {error.returncode}" if isinstance(error, subprocess.CalledProcessError) else error
        return ProbeResult("broken", f"{program} is no ffmpeg that runs ({reason})", remedy)
    source = ["-f", "lavfi", "-i", "color=s=16x16", "-frames:v", "1"]
    done = subprocess.run(
        [program, "-v", "error", *source, "-c:v", "libx264", "-f", "null", "-"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
        timeout=FFMPEG_TIMEOUT,
    )
    if done.returncode:
        first = (done.stderr.strip().splitlines() or [f"exited with {done.returncode}"])[0]
        return ProbeResult("broken", f"{version}, libx264 does not encode ({first}): {program}", remedy)
    return ProbeResult("ok", f"{version}, encoder libx264")


def current_directory() -> ProbeResult:
    """Examine the current directory, the default place of results."""
    place = Path.cwd()
    try:
        free = _writable_bytes(place)
    except OSError as error:
        remedy = "go to a directory of your own, or name one by -o"
        return ProbeResult("broken", f"{place} cannot be written ({error.strerror})", remedy)
    detail = f"{place}, writable, {size_text(free)} free"
    if free >= LITTLE_DISK:
        return ProbeResult("ok", detail)
    status = "broken" if free < NO_DISK else "information"
    return ProbeResult(status, detail, "free some space, or name another disk by -o")


def kernel_cache() -> ProbeResult:
    """Examine the cache of compiled kernels, which is optional."""
    place = Path(os.environ.get("XDG_CACHE_HOME") or Path(os.path.expanduser("~")) / ".cache") / "taichi"
    try:
        place.mkdir(parents=True, exist_ok=True)
        free = _writable_bytes(place)
    except OSError as error:
        detail = f"{place} cannot be written ({error.strerror}), so kernels are kept among temporary files"
        return ProbeResult("information", detail, "make it writable, or let XDG_CACHE_HOME name a directory that is")
    detail = f"{place}, writable, {size_text(free)} free"
    return ProbeResult("ok", detail) if free >= NO_DISK else ProbeResult("information", detail, "free some space")


def memory() -> ProbeResult:
    """Examine the memory available to a run."""
    import psutil

    whole = psutil.virtual_memory()
    free, detail = whole.available, f"{size_text(whole.total)}, {size_text(whole.available)} free"
    limit = memory_limit()
    if limit is not None and limit < whole.total:
        free = min(free, limit)
        detail += f", the container may take {size_text(limit)}"
    if free < LITTLE_MEMORY:
        return ProbeResult("information", detail, "end other programs, or simulate fewer particles")
    return ProbeResult("ok", detail)


def cores() -> ProbeResult:
    """Examine the number of cores available to a run."""
    there = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else there
    detail = f"{usable} of {there} usable"
    limit = processor_limit()
    if limit is None or limit >= usable:
        return ProbeResult("ok", detail)
    detail += f", the container may take the time of {limit:.3g}"
    return ProbeResult("information", detail, f"simulate with --threads {max(1, int(limit))}")


def memory_limit(root: Path = CGROUP) -> int | None:
    """Return the memory limit of the container, bytes, from Linux control groups v2 or v1; None without a limit."""
    words = _words(root / "memory.max") or _words(root / "memory" / "memory.limit_in_bytes")
    return int(words[0]) if words and words[0].isdigit() else None


def processor_limit(root: Path = CGROUP) -> float | None:
    """Return the processor limit of the container, in cores; None without a limit."""
    words = _words(root / "cpu.max") or [
        word for name in ("cpu.cfs_quota_us", "cpu.cfs_period_us") for word in _words(root / "cpu" / name)
    ]
    if len(words) != 2 or not all(word.isdigit() for word in words) or not int(words[1]):
        return None  # "max" or -1
    return int(words[0]) / int(words[1])


def _writable_bytes(place: Path) -> int:
    """Return the free bytes of a directory in which a file can be made."""
    with tempfile.TemporaryFile(dir=place):
        return shutil.disk_usage(place).free


def _words(path: Path) -> list[str]:
    try:
        return path.read_text().split()
    except OSError:
        return []


@dataclass(frozen=True)
class Examination:
    """One component to examine.

    `examine` imports the libraries it needs. A broken `package` (a distribution, "" for none) is reinstalled, unless
    there is another `remedy`. mpmcli requires what is `needed`. The time limit is in s.
    """

    name: str
    examine: Callable[[], ProbeResult]
    package: str = ""
    remedy: str = ""
    needed: bool = True
    timeout: float = TIMEOUT


DRIVER = "mend or remove the driver; --arch cpu runs without it"
EXAMINATIONS = (
    Examination("python", python),
    Examination("mpmcli", mpmcli, "mpmcli"),
    Examination("taichi cpu", cpu, "taichi"),
    # --arch auto selects CUDA if it is available.
    Examination("taichi cuda", partial(gpu, "cuda"), "taichi", DRIVER),
    Examination("taichi vulkan", partial(gpu, "vulkan"), "taichi", DRIVER, needed=False),
    Examination("taichi metal", partial(gpu, "metal"), "taichi", DRIVER),
    Examination("vtk", vtk, "vtk", timeout=WINDOW_TIMEOUT),
    Examination("pyvista", partial(importable, "pyvista"), "pyvista"),
    Examination("pysplashsurf", pysplashsurf, "pysplashsurf"),
    Examination("matplotlib", partial(importable, "matplotlib"), "matplotlib"),
    Examination("pillow", pillow, "pillow"),
    Examination("hdf5", hdf5, "h5py"),
    Examination("ffmpeg", ffmpeg, "imageio-ffmpeg"),
    Examination("directory", current_directory, remedy="go to a directory that exists"),
    Examination("kernel cache", kernel_cache, needed=False),
    Examination("memory", memory, "psutil"),
    Examination("cores", cores, needed=False),
)


def examine(examinations: Sequence[Examination] = EXAMINATIONS) -> Iterator[tuple[str, ProbeResult]]:
    """Yield (name, result) of every examination, in order."""
    command = module_command("mpmcli.doctor.examination")
    questions = [Question([*command, each.name], each.timeout, leads_a_group=True) for each in examinations]
    for each, reply in zip(examinations, ask_each(questions, AT_ONCE), strict=True):
        yield each.name, judge(each, reply)


def attempt(each: Examination) -> ProbeResult:
    """Examine in this process. Exceptions become faults."""
    try:
        return each.examine()
    except ModuleNotFoundError as error:
        # A package that lacks one of its own modules is broken.
        if error.name and "." not in error.name:
            return _fault(each, "missing", f"the package {error.name} is not installed")
        return _fault(each, "broken", f"{type(error).__name__}: {error}")
    except MpmcliError as error:
        return _fault(each, "broken", str(error).rstrip("."))
    except Exception as error:
        return _fault(each, "broken", f"{type(error).__name__}: {error}")


def judge(each: Examination, reply: Reply) -> ProbeResult:
    """Return the result from the reply of the process of an examination."""
    if reply.answer.get("status") not in STATUSES:
        return _fault(each, "broken", f"its trial {reply.fault or 'gave no answer'}")
    result = ProbeResult(**reply.answer)
    result = replace(result, detail=_line(result.detail))
    if reply.fault and not result.is_fault:
        return _fault(each, "broken", f"{result.detail}; then its trial {reply.fault}")
    return result


def _fault(each: Examination, status: str, detail: str) -> ProbeResult:
    remedy = library_remedy(detail) or each.remedy
    if each.package and not (remedy and status == "broken"):
        remedy = package_remedy(each.package, again=status == "broken")
    return ProbeResult(status if each.needed else "information", _line(detail), remedy)


def _line(detail: str) -> str:
    """Return a detail as one line. A long one is shortened in the middle."""
    line = " ".join(detail.split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 3]} ... {line[-2 * LONGEST // 3 :]}"


if __name__ == "__main__":
    with answering() as answer:
        answer(**asdict(attempt(next(each for each in EXAMINATIONS if each.name == sys.argv[1]))))
