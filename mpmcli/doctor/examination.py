"""Runs every examination in a separate process, so that a crash affects only one, and reports in order."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from mpmcli.doctor import backends, drawing, files, interpreter, machine
from mpmcli.doctor.probe_result import STATUSES, ProbeResult, library_remedy, package_remedy
from mpmcli.errors import MpmcliError
from mpmcli.processes.questions import Question, Reply, ask_each, module_command

# Number of concurrent processes. They mostly load libraries.
AT_ONCE = 2
# Time limit, s. Loading a large library from a cold disk may take most of it.
TIMEOUT = 60.0
# Time limit for three window types, s.
WINDOW_TIMEOUT = 400.0
# Maximum length of a detail, characters.
LONGEST = 300


@dataclass(frozen=True)
class Examination:
    """One component to examine.

    Attributes:
        name: name in the report.
        examine: examines the component; imports the libraries it needs.
        package: distribution that provides the component; "" for none.
        remedy: remedy for a broken component; "" for reinstalling the package.
        needed: whether mpmcli requires the component.
        timeout: time limit, s.
    """

    name: str
    examine: Callable[[], ProbeResult]
    package: str = ""
    remedy: str = ""
    needed: bool = True
    timeout: float = TIMEOUT


DRIVER = "mend or remove the driver; --arch cpu runs without it"
EXAMINATIONS = (
    Examination("python", interpreter.python),
    Examination("mpmcli", interpreter.mpmcli, "mpmcli"),
    Examination("taichi cpu", backends.cpu, "taichi"),
    # --arch auto selects CUDA if it is available.
    Examination("taichi cuda", backends.cuda, "taichi", DRIVER),
    Examination("taichi vulkan", backends.vulkan, "taichi", DRIVER, needed=False),
    Examination("taichi metal", backends.metal, "taichi", DRIVER),
    Examination("vtk", drawing.vtk, "vtk", timeout=WINDOW_TIMEOUT),
    Examination("pyvista", drawing.pyvista, "pyvista"),
    Examination("pysplashsurf", drawing.pysplashsurf, "pysplashsurf"),
    Examination("matplotlib", drawing.matplotlib, "matplotlib"),
    Examination("pillow", drawing.pillow, "pillow"),
    Examination("hdf5", files.hdf5, "h5py"),
    Examination("ffmpeg", files.ffmpeg, "imageio-ffmpeg"),
    Examination("directory", machine.current_directory, remedy="go to a directory that exists"),
    Examination("kernel cache", machine.kernel_cache, needed=False),
    Examination("memory", machine.memory, "psutil"),
    Examination("cores", machine.cores, needed=False),
)


def examine(examinations: Sequence[Examination] = EXAMINATIONS) -> Iterator[tuple[str, ProbeResult]]:
    """Yield (name, result) of every examination, in order."""
    command = module_command("mpmcli.doctor.probe_process")
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
