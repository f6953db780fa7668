"""What `mpmcli doctor` finds, says and returns, where things work and where they crash, hang or are not there."""

import json
import os
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from asked_process import CRASH, HANG, SILENCE, answering, running
from command import ROOT, run_here

from mpmcli.doctor import examination
from mpmcli.doctor.examination import EXAMINATIONS, Examination, ProbeResult, attempt, examine, judge
from mpmcli.errors import RunError
from mpmcli.processes.questions import Reply

WELL = ProbeResult("ok", "works")
FINE = answering('{"status": "ok", "detail": "works", "remedy": ""}')


def examination_of(name: str) -> Examination:
    return next(each for each in EXAMINATIONS if each.name == name)


@pytest.fixture
def trials(monkeypatch) -> Callable[[dict[str, str]], None]:
    """Return `put({name: code})`: this code runs in the trials of these names, and in all others one that is well."""

    def put(codes: dict[str, str]) -> None:
        code = f"import sys\nexec({codes!r}.get(sys.argv[1], {FINE!r}))\n"
        monkeypatch.setattr(examination, "module_command", lambda module: running(code))

    return put


def test_the_report_in_json_has_one_check_for_each_examination(trials):
    trials({"taichi cuda": answering('{"status": "information", "detail": "not here", "remedy": ""}')})
    done = run_here("doctor", "--json")
    report = json.loads(done.stdout)
    assert (done.status, done.stderr) == (0, "")
    assert set(report) == {"ok", "checks"}
    assert report["ok"] is True
    assert [check["name"] for check in report["checks"]] == [each.name for each in EXAMINATIONS]
    assert all(set(check) == {"name", "status", "detail", "remedy"} for check in report["checks"])
    assert report["checks"][3] == {"name": "taichi cuda", "status": "information", "detail": "not here", "remedy": ""}


def test_the_report_as_text_has_one_line_for_each_examination(trials):
    trials({"vtk": CRASH})
    done = run_here("doctor")
    lines = done.stdout.splitlines()
    assert (done.status, done.stderr) == (1, "")
    assert len(lines) == len(EXAMINATIONS) + 2
    for line, each in zip(lines, EXAMINATIONS, strict=False):
        status, rest = line.split(maxsplit=1)
        assert rest.startswith(each.name)
        assert status == ("broken" if each.name == "vtk" else "ok")
    assert lines[-1] == "not everything that mpmcli needs works: vtk"


def test_a_fault_of_something_needed_is_exit_code_1(trials):
    trials({"pyvista": answering('{"status": "missing", "detail": "the package is not installed", "remedy": "do"}')})
    done = run_here("doctor", "--json")
    assert done.status == 1
    assert json.loads(done.stdout)["ok"] is False


def test_crash_hang_and_silence_are_told_apart(trials):
    trials({"one": CRASH, "two": HANG, "three": SILENCE, "five": FINE + "raise SystemExit(7)\n"})
    names = ("one", "two", "three", "four", "five")
    found = dict(examine([Examination(name, cheap, "h5py", timeout=0.5 if name == "two" else 60.0) for name in names]))
    assert found["one"].detail == "its trial died by SIGSEGV"
    assert found["two"].detail == "its trial took longer than 0.5 s"
    assert found["three"].detail == "its trial gave no answer"
    assert found["four"] == WELL
    assert found["five"].detail == "works; then its trial exited with 7"
    assert [found[name].status for name in names] == ["broken", "broken", "broken", "ok", "broken"]
    assert found["one"].remedy.startswith("install it again by `python -m pip install --force-reinstall ")


def cheap() -> ProbeResult:
    return WELL


def test_what_is_not_needed_cannot_fail_the_report():
    vulkan, cuda = examination_of("taichi vulkan"), examination_of("taichi cuda")
    crash = Reply({}, "died by SIGSEGV", "")
    assert judge(vulkan, crash).status == "information"
    assert "died by SIGSEGV" in judge(vulkan, crash).detail
    # --arch auto takes CUDA where it is, and would crash as well.
    assert judge(cuda, crash).is_fault
    assert "--arch cpu" in judge(cuda, crash).remedy


def raising(error: Exception) -> Callable[[], ProbeResult]:
    def examine_it() -> ProbeResult:
        raise error

    return examine_it


@pytest.mark.parametrize(
    ("error", "status", "detail"),
    [
        (ModuleNotFoundError("No module named 'h5py'", name="h5py"), "missing", "the package h5py is not installed"),
        (ModuleNotFoundError("No module named 'h5py.h5'", name="h5py.h5"), "broken", "ModuleNotFoundError: No module"),
        (ImportError("two lines\nof text"), "broken", "ImportError: two lines of text"),
        (RunError("it computed wrong numbers."), "broken", "it computed wrong numbers"),
        (ValueError("3"), "broken", "ValueError: 3"),
    ],
)
def test_what_a_trial_raises_is_a_finding_with_a_remedy(error, status, detail):
    found = attempt(Examination("hdf5", raising(error), "h5py"))
    assert found.status == status
    assert found.detail.startswith(detail)
    assert "\n" not in found.detail
    assert "python -m pip install" in found.remedy
    assert ("--force-reinstall" in found.remedy) == (status == "broken")


def test_a_library_that_the_system_lacks_is_named_with_its_package():
    """On a bare Debian Taichi's first complaint is this one, and no installing of Taichi mends it."""
    bare = ImportError("libX11.so.6: cannot open shared object file: No such file or directory")
    found = attempt(Examination("taichi cpu", raising(bare), "taichi"))
    assert found.status == "broken"
    assert found.remedy == (
        "install the system's package of libX11.so.6, on Debian and Ubuntu by `apt-get install libx11-6`"
    )
    unknown = "/usr/lib/libfoo-1.2.so.3: file too short"
    assert examination.library_remedy(unknown) == "install the system's package of libfoo-1.2.so.3"


def test_a_command_that_cannot_be_loaded_sends_to_the_doctor(monkeypatch):
    def bare(name):
        raise ImportError("libX11.so.6: cannot open shared object file: No such file or directory", name="taichi_core")

    monkeypatch.setattr("mpmcli.cli.program.importlib.import_module", bare)
    done = run_here("schema")
    assert done.status == 1
    assert done.stderr.rstrip().endswith("(mpmcli doctor says what is missing; --debug shows where)")


def test_a_part_of_mpmcli_that_is_missing_is_no_case_for_the_doctor(monkeypatch):
    monkeypatch.setitem(sys.modules, "mpmcli.cli.materials", None)
    done = run_here("schema")
    assert done.status == 1 and done.stderr.rstrip().endswith("(a fault of mpmcli; --debug shows where)")


def test_a_remedy_names_the_version_that_is_wanted(monkeypatch):
    listed = ["h5py>=3.11", "h5py-other>=1", "pytest>=8; extra == 'test'"]
    monkeypatch.setattr(examination.importlib.metadata, "requires", lambda name: listed)
    assert examination.package_remedy("h5py") == 'install it by `python -m pip install "h5py>=3.11"`'
    assert examination.package_remedy("pytest") == 'install it by `python -m pip install "pytest"`'


def test_gpus_are_not_here_where_taichi_has_none_or_is_not_here(monkeypatch):
    from mpmcli.solver.machine import backend

    monkeypatch.setattr(backend, "backend_is_here", lambda arch: False)
    assert examination.gpu("cuda") == ProbeResult("information", "not here")
    # As if the module could not be loaded.
    monkeypatch.setitem(sys.modules, "mpmcli.solver.machine.backend", None)
    assert examination.gpu("vulkan").status == "information"
    assert examination.gpu("vulkan").detail.startswith("not tried")


@pytest.mark.parametrize(
    ("devices", "status", "detail"),
    [
        ([("llvmpipe", True)], "information", "software only: llvmpipe"),
        ([("A100", False), ("llvmpipe", True)], "ok", "A100, llvmpipe"),
        ([], "ok", "device of unknown name"),
    ],
)
def test_software_vulkan_is_named_as_such(monkeypatch, devices, status, detail):
    from mpmcli.doctor import devices as names
    from mpmcli.solver.machine import backend

    monkeypatch.setattr(backend, "backend_is_here", lambda arch: True)
    monkeypatch.setattr(backend, "try_backend", lambda arch: None)
    monkeypatch.setattr(names, "device_names", lambda arch: [names.Device(*device) for device in devices])
    assert (examination.gpu("vulkan").status, examination.gpu("vulkan").detail) == (status, detail)


def test_the_driver_of_vulkan_names_its_devices():
    from mpmcli.doctor.devices import device_names

    devices = device_names("vulkan")
    if not devices:
        pytest.skip("there is no Vulkan device here, nor Mesa's software Vulkan")
    for device in devices:
        assert device.name.isprintable() and device.name
        # The one of Mesa that the processor plays.
        assert device.is_software or not device.name.startswith("llvmpipe")
    assert device_names("metal") == []


def test_the_versions_of_python_are_those_of_the_package():
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["requires-python"]
    oldest, newest = examination.OLDEST, examination.NEWEST
    assert asked == f">={oldest[0]}.{oldest[1]},<{newest[0]}.{newest[1] + 1}"
    assert examination.python(oldest).status == examination.python(newest).status == "ok"
    for version in [(3, oldest[1] - 1), (3, newest[1] + 1), (2, 7)]:
        assert examination.python(version).status == "broken"
        assert "3.11 to 3.13" in examination.python(version).remedy


def test_files_and_surfaces_work_here():
    """As the tests of output and of pictures show at length; versions are in the line."""
    assert examination.hdf5().status == examination.ffmpeg().status == examination.pysplashsurf().status == "ok"
    assert "filters gzip and shuffle" in examination.hdf5().detail
    assert "libx264" in examination.ffmpeg().detail


def test_a_program_without_the_encoder_is_found_out(monkeypatch, tmp_path):
    program = tmp_path / "ffmpeg"
    program.write_text(
        "#!/bin/sh\ncase $* in *libx264*) echo 'Unknown encoder' >&2; exit 8;; esac\necho ffmpeg version 1\n"
    )
    program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    import imageio_ffmpeg

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(program))
    found = examination.ffmpeg()
    assert found.status == "broken"
    assert "Unknown encoder" in found.detail
    assert "IMAGEIO_FFMPEG_EXE" in found.remedy


@pytest.mark.parametrize(("text", "reason"), [("exit 3", "exited with 3"), (None, "No such file")])
def test_a_program_of_the_user_that_is_no_ffmpeg_is_named(monkeypatch, tmp_path, text, reason):
    program = tmp_path / "ffmpeg"
    if text:
        program.write_text(f"#!/bin/sh\n{text}\n")
        program.chmod(0o755)
    monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(program))
    import imageio_ffmpeg

    monkeypatch.setattr(imageio_ffmpeg._utils, "get_ffmpeg_exe", lambda: str(program))
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: str(program))
    found = examination.ffmpeg()
    assert found.status == "broken" and found.detail.startswith(f"{program} is no ffmpeg that runs (")
    assert reason in found.detail and "unset IMAGEIO_FFMPEG_EXE" in found.remedy


def test_a_sermon_becomes_one_line_of_how_it_begins_and_ends():
    """NumPy explains at length why it cannot be loaded, and says last what is missing."""
    sermon = "\n\nNumPy cannot be loaded.\n" + "Read this.\n" * 200 + "libstdc++.so.6: file too short\n"
    each = next(each for each in EXAMINATIONS if each.name == "taichi cuda")
    reply = Reply({"status": "information", "detail": f"not tried ({sermon})", "remedy": ""}, "", "")
    for found in (judge(each, reply), attempt(Examination("hdf5", raising(ImportError(sermon)), "h5py"))):
        assert "\n" not in found.detail and len(found.detail) < 320
        assert "NumPy cannot be loaded." in found.detail and "libstdc++.so.6: file too short" in found.detail


def refuse(place: Path) -> None:
    raise PermissionError(13, "Permission denied")


def test_an_unwritable_directory_is_a_fault_and_an_unwritable_cache_is_not(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert examination.current_directory().detail.startswith(f"{tmp_path}, writable, ")
    assert examination.kernel_cache().status == "ok"
    monkeypatch.setattr(examination, "_writable_bytes", refuse)
    assert examination.current_directory().status == "broken"
    assert examination.kernel_cache().status == "information"
    assert "XDG_CACHE_HOME" in examination.kernel_cache().remedy


@pytest.mark.parametrize(("free", "status"), [(5e6, "broken"), (5e8, "information"), (5e10, "ok")])
def test_a_full_disk_is_a_fault(monkeypatch, tmp_path, free, status):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(examination.shutil, "disk_usage", lambda place: type("Usage", (), {"free": free}))
    assert examination.current_directory().status == status


def test_limits_of_containers_are_read_in_both_versions(tmp_path):
    assert examination.memory_limit(tmp_path) is examination.processor_limit(tmp_path) is None
    (tmp_path / "memory").mkdir()
    (tmp_path / "cpu").mkdir()
    (tmp_path / "memory" / "memory.limit_in_bytes").write_text("4000000000\n")
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("-1\n")
    (tmp_path / "cpu" / "cpu.cfs_period_us").write_text("100000\n")
    assert examination.memory_limit(tmp_path) == 4_000_000_000
    assert examination.processor_limit(tmp_path) is None
    (tmp_path / "cpu" / "cpu.cfs_quota_us").write_text("150000\n")
    assert examination.processor_limit(tmp_path) == 1.5
    (tmp_path / "memory.max").write_text("max\n")
    (tmp_path / "cpu.max").write_text("max 100000\n")
    assert examination.memory_limit(tmp_path) is examination.processor_limit(tmp_path) is None
    (tmp_path / "memory.max").write_text("2000\n")
    (tmp_path / "cpu.max").write_text("50000 100000\n")
    assert (examination.memory_limit(tmp_path), examination.processor_limit(tmp_path)) == (2000, 0.5)


def test_a_container_with_less_time_than_cores_wants_fewer_threads(monkeypatch):
    monkeypatch.setattr(examination, "processor_limit", lambda: 0.5)
    assert examination.cores().status == "information"
    assert examination.cores().remedy == "simulate with --threads 1"
    monkeypatch.setattr(examination, "memory_limit", lambda: 10**8)
    assert "the container may take 100 MB" in examination.memory().detail
    assert examination.memory().status == "information"


def test_the_real_trial_of_the_processor_keeps_kernels_where_the_report_says(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    [(_, found)] = examine([examination_of("taichi cpu")])
    assert found.status == "ok", found
    place = Path(examination.kernel_cache().detail.split(",")[0])
    assert place.is_relative_to(tmp_path)
    assert any(path.is_file() for path in place.rglob("*"))


def test_the_table_is_light_to_load(run_python):
    heavy = {"taichi", "numpy", "h5py", "vtk", "vtkmodules", "pyvista", "matplotlib", "PIL", "psutil", "pysplashsurf"}
    code = f"import sys, mpmcli.cli.inspection, mpmcli.doctor.examination\nprint(sorted({heavy!r} & set(sys.modules)))"
    assert run_python(code).stdout == "[]\n"


@pytest.mark.slow
def test_the_whole_report_of_this_machine(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    done = run_here("doctor", "--json")
    checks = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
    assert done.status == int(not all(check["status"] in ("ok", "information") for check in checks.values()))
    for name in ("python", "mpmcli", "taichi cpu", "pyvista", "pysplashsurf", "matplotlib", "pillow", "hdf5", "ffmpeg"):
        assert checks[name]["status"] == "ok", checks[name]
    assert checks["vtk"]["status"] in ("ok", "missing")
    assert os.listdir(tmp_path) == []
