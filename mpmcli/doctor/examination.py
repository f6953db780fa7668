"""Runs every examination in a process of its own, so that none can stop the others, and reports in order."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from mpmcli.doctor import backends, drawing, files, interpreter, machine
from mpmcli.doctor.probe_result import STATUSES, ProbeResult, library_remedy, package_remedy
from mpmcli.errors import MpmcliError
from mpmcli.processes.questions import Question, Reply, ask_each, module_command

# Processes at a time: each of them loads libraries, and then waits little.
AT_ONCE = 2
# Seconds; a cold disk may need most of them for a large library.
TIMEOUT = 60.0
# Three windows may be tried, each as long as the first picture may wait.
WINDOW_TIMEOUT = 400.0
# Characters of a detail.
LONGEST = 300


@dataclass(frozen=True)
class Examination:
    """What is examined.

    Attributes:
        name: what the report calls it.
        examine: finds out; loads what it needs itself.
        package: the distribution that it is about, "" for none.
        remedy: what to do where it is broken, if not install the package again.
        needed: whether mpmcli is less than whole without it.
        timeout: seconds.
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
    # Where it is there, --arch auto takes it.
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
    """Yield (name, finding) of every examination, in order, as they end."""
    command = module_command("mpmcli.doctor.probe_process")
    questions = [Question([*command, each.name], each.timeout, leads_a_group=True) for each in examinations]
    for each, reply in zip(examinations, ask_each(questions, AT_ONCE), strict=True):
        yield each.name, judge(each, reply)


def attempt(each: Examination) -> ProbeResult:
    """Examine in this process; what an examination raises is a finding, too."""
    try:
        return each.examine()
    except ModuleNotFoundError as error:
        # A package that does not find a part of its own is broken.
        if error.name and "." not in error.name:
            return _fault(each, "missing", f"the package {error.name} is not installed")
        return _fault(each, "broken", f"{type(error).__name__}: {error}")
    except MpmcliError as error:
        return _fault(each, "broken", str(error).rstrip("."))
    except Exception as error:
        return _fault(each, "broken", f"{type(error).__name__}: {error}")


def judge(each: Examination, reply: Reply) -> ProbeResult:
    """Make a finding of what the process of an examination left."""
    if reply.answer.get("status") not in STATUSES:
        return _fault(each, "broken", f"its trial {reply.fault or 'gave no answer'}")
    finding = ProbeResult(**reply.answer)
    finding = replace(finding, detail=_line(finding.detail))
    if reply.fault and not finding.is_fault:
        return _fault(each, "broken", f"{finding.detail}; then its trial {reply.fault}")
    return finding


def _fault(each: Examination, status: str, detail: str) -> ProbeResult:
    remedy = library_remedy(detail) or each.remedy
    if each.package and not (remedy and status == "broken"):
        remedy = package_remedy(each.package, again=status == "broken")
    return ProbeResult(status if each.needed else "information", _line(detail), remedy)


def _line(detail: str) -> str:
    """Return a detail as one line that is not too long: of a sermon, how it begins and how it ends."""
    line = " ".join(detail.split())
    return line if len(line) <= LONGEST else f"{line[: LONGEST // 3]} ... {line[-2 * LONGEST // 3 :]}"
