"""What `mpmcli doctor` finds, says and returns, where things work and where they crash or are not there."""

import json
import os
import signal
import sys
import tomllib
from functools import partial
from pathlib import Path

import pytest
from command import ROOT, run_here

from mpmcli.doctor import examination
from mpmcli.doctor.examination import CHECKS, OPTIONAL, Check, run_check


def test_the_report_of_this_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One line for each check, and what the tests of the suite need is there."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    done = run_here("doctor", "--json")
    report = json.loads(done.stdout)
    checks = {check["name"]: check for check in report["checks"]}
    assert [*checks] == [*CHECKS] and done.stderr == ""
    assert report["ok"] == all(check["status"] != "broken" for check in checks.values()) == (done.status == 0)
    for name in ("python", "mpmcli", "taichi cpu", *examination.PACKAGES, "ffmpeg", "directory", "kernel cache"):
        assert checks[name]["status"] == "ok", checks[name]
    assert "libx264" in checks["ffmpeg"]["detail"]
    assert any((tmp_path / "cache" / "taichi").rglob("*")), "kernels are not kept where the report says"
    assert os.listdir(tmp_path) == ["cache"]


def die(name: str) -> Check:
    os.abort()


def test_a_process_that_crashes_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each check has a process of its own: all crash here, the report is whole, and the exit code is 1."""
    monkeypatch.setattr(examination, "examine", partial(examination.examine, die))
    done = run_here("doctor")
    lines = done.stdout.splitlines()
    assert done.status == 1 and len(lines) == len(CHECKS) + 2
    for line, name in zip(lines, CHECKS, strict=False):
        assert line.split()[0] == ("information" if name in OPTIONAL else "broken") and name in line
        assert f"its process ended with exit code {-signal.SIGABRT}" in line
    assert lines[-1].startswith("not everything that mpmcli needs works: python, mpmcli, ")


def test_a_system_library_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def bare() -> Check:
        raise ImportError("libX11.so.6: cannot open shared object file: No such file or directory")

    monkeypatch.setitem(CHECKS, "taichi cpu", bare)
    found = run_check("taichi cpu")
    assert found.status == "broken" and "apt-get install libx11-6" in found.remedy


@pytest.mark.skipif(sys.platform != "linux", reason="needs a directory in which nobody can write")
def test_an_unwritable_directory_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/proc")
    assert run_check("directory").status == "broken"


def test_a_full_disk_is_a_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(examination.shutil, "disk_usage", lambda place: type("Usage", (), {"free": 5e6}))
    assert examination.writable(tmp_path).status == "broken"


@pytest.mark.parametrize(
    ("devices", "status", "detail"),
    [
        ([("llvmpipe", True)], "information", "software only: llvmpipe"),
        ([("A100", False), ("llvmpipe", True)], "ok", "A100, llvmpipe"),
        ([], "ok", "device of unknown name"),
    ],
)
def test_software_vulkan_is_named_as_such(monkeypatch: pytest.MonkeyPatch, devices, status, detail) -> None:
    from mpmcli.solver.machine import backend

    monkeypatch.setattr(backend, "backend_is_here", lambda arch: True)
    monkeypatch.setattr(backend, "try_backend", lambda arch: None)
    monkeypatch.setattr(examination, "device_names", lambda arch: devices)
    assert (examination.taichi("vulkan").status, examination.taichi("vulkan").detail) == (status, detail)


def test_the_driver_of_vulkan_names_its_devices() -> None:
    devices = examination.device_names("vulkan")
    if not devices:
        pytest.skip("there is no Vulkan device here, nor Mesa's software Vulkan")
    for name, is_software in devices:
        assert name.isprintable() and name
        assert is_software or not name.startswith("llvmpipe")
    assert examination.device_names("metal") == []


def test_the_versions_of_python_are_those_of_the_package() -> None:
    asked = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["requires-python"]
    oldest, newest = examination.OLDEST, examination.NEWEST
    assert asked == f">={oldest[0]}.{oldest[1]},<{newest[0]}.{newest[1] + 1}"
    assert examination.python(oldest).status == examination.python(newest).status == "ok"
    for version in [(3, oldest[1] - 1), (3, newest[1] + 1), (2, 7)]:
        assert examination.python(version).status == "broken"
        assert "3.11 to 3.13" in examination.python(version).remedy


def test_a_command_that_cannot_be_loaded_sends_to_the_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    def bare(name: str) -> None:
        raise ImportError("libX11.so.6: cannot open shared object file: No such file or directory", name="taichi_core")

    monkeypatch.setattr("mpmcli.cli.program.importlib.import_module", bare)
    done = run_here("schema")
    assert done.status == 1
    assert done.stderr.rstrip().endswith("(mpmcli doctor says what is missing; --debug shows where)")


def test_a_part_of_mpmcli_that_is_missing_is_no_case_for_the_doctor(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mpmcli.cli.materials", None)
    done = run_here("schema")
    assert done.status == 1 and done.stderr.rstrip().endswith("(a fault of mpmcli; --debug shows where)")


def test_the_table_is_light_to_load(run_python) -> None:
    heavy = {"taichi", "numpy", "h5py", "vtk", "vtkmodules", "pyvista", "matplotlib", "PIL", "psutil", "pysplashsurf"}
    code = f"import sys, mpmcli.cli.inspection, mpmcli.doctor.examination\nprint(sorted({heavy!r} & set(sys.modules)))"
    assert run_python(code).stdout == "[]\n"
