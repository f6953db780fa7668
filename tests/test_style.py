"""The rules of the code that a reader relies on, held by the parser rather than by good intentions."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "mpmcli"
MODULES = sorted(PACKAGE.rglob("*.py"))
SOURCES = sorted([*MODULES, *(ROOT / "tests").rglob("*.py")])

# Imports run downwards only, or within a level.
LEVELS = {
    "cli": 9,
    "__main__": 9,
    "dataset": 8,
    "validation": 8,
    "doctor": 8,
    "plot": 8,
    "render": 8,
    "bench": 8,
    "simulation": 7,
    "check": 6,
    "solver": 5,
    "output": 4,
    "stability": 3,
    "boundaries": 3,
    "materials": 3,
    "frames": 2,
    "scene": 1,
    "child_process": 0,
    "cores": 0,
    "errors": 0,
    "plain_json": 0,
    "plain_text": 0,
    "__init__": 0,
}
TAICHI_ROOMS = {"solver", "materials", "boundaries"}
# These know frames and files, never the device state.
WITHOUT_SOLVER = {"render", "plot", "output", "dataset"}
HEAVY = {"taichi", "numpy", "h5py", "pydantic", "vtk", "vtkmodules", "pyvista", "meshio", "matplotlib", "PIL"}
LINES_MAX = 400


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def room_of(path: Path) -> str:
    """Return the room of a module: its sub-package, or its own name directly below mpmcli."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Yield (absolute dotted name, line) of everything a module imports, at any depth of its code."""
    package = ("mpmcli", *path.relative_to(PACKAGE).parts[:-1])
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            base = list(package[: len(package) - node.level + 1]) if node.level else []
            base += [node.module] if node.module else []
            for alias in node.names:
                yield ".".join([*base, alias.name]), node.lineno


def imported_rooms(path: Path) -> Iterator[tuple[str, int]]:
    for name, line in imports(path):
        parts = name.split(".")
        if parts[0] != "mpmcli":
            continue
        # `from mpmcli import __version__` names an attribute of the package itself.
        is_room = len(parts) > 1 and ((PACKAGE / parts[1]).is_dir() or (PACKAGE / f"{parts[1]}.py").is_file())
        yield (parts[1] if is_room else "__init__"), line


def calls(path: Path) -> Iterator[tuple[str, int]]:
    """Yield (dotted name as written, line) of every call whose callee is a plain dotted name."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Call):
            name = ast.unparse(node.func)
            if re.fullmatch(r"[\w.]+", name):
                yield name, node.lineno


def repository_files() -> list[Path]:
    """Return the files that git holds or would add; all but hidden and built ones where git cannot say."""
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"], cwd=ROOT, capture_output=True
    )
    if listed.returncode == 0:
        paths = [ROOT / name for name in listed.stdout.decode().split("\0") if name]
    else:
        built = {".venv", "results", "build", "dist", "__pycache__"}
        paths = [path for path in ROOT.rglob("*") if not built & set(path.relative_to(ROOT).parts)]
    return [path for path in paths if path.is_file()]


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_every_module_has_a_level(path: Path) -> None:
    assert room_of(path) in LEVELS, f"{name_of(path)}: give its room a level in {Path(__file__).name}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_imports_run_downwards(path: Path) -> None:
    room = room_of(path)
    for imported, line in imported_rooms(path):
        assert LEVELS[imported] <= LEVELS[room], f"{name_of(path)}:{line}: {room} may not import {imported}"
        upward = imported == "solver" and room in WITHOUT_SOLVER
        assert not upward, f"{name_of(path)}:{line}: {room} knows frames and files, never the solver"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_taichi_is_imported_where_kernels_live_and_nowhere_else(path: Path) -> None:
    lines = [line for name, line in imports(path) if name.split(".")[0] == "taichi"]
    assert not lines or room_of(path) in TAICHI_ROOMS, f"{name_of(path)}:{lines[0]} imports taichi"


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_annotations_are_never_postponed(path: Path) -> None:
    """Taichi reads annotations as objects: postponed ones are strings, and fail far from their cause."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module == "__future__":
            assert "annotations" not in {alias.name for alias in node.names}, f"{name_of(path)}:{node.lineno}"


def test_taichi_starts_in_one_place() -> None:
    """A second ti.init kills every field of the first, so there is one call, in the backend."""
    found = [
        f"{name_of(path)}:{line}"
        for path in MODULES
        for name, line in calls(path)
        if name in {"ti.init", "taichi.init"}
    ]
    assert len(found) == 1, found
    assert found[0].startswith("mpmcli/solver/backend.py:"), found


@pytest.mark.parametrize("path", [p for p in MODULES if room_of(p) not in {"cli", "__main__"}], ids=name_of)
def test_nothing_below_the_command_line_prints_or_exits(path: Path) -> None:
    banned = {
        "print",
        "sys.exit",
        "exit",
        "quit",
        "os._exit",
        "sys.stdout.write",
        "sys.stderr.write",
        "click.echo",
    }
    # The worker is the main program of its own process; its answers on stdout are its protocol.
    if path == PACKAGE / "bench" / "worker.py":
        return
    for name, line in calls(path):
        assert name not in banned, f"{name_of(path)}:{line}: {name}() belongs in mpmcli/cli"
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Raise) and node.exc is not None:
            assert "SystemExit" not in ast.unparse(node.exc), f"{name_of(path)}:{node.lineno}"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_modules_stay_short(path: Path) -> None:
    lines = len(path.read_text(encoding="utf-8").splitlines())
    assert lines <= LINES_MAX, f"{name_of(path)} has {lines} lines: split it by what it does"


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_modules_say_what_they_are(path: Path) -> None:
    assert not path.read_text(encoding="utf-8").strip() or ast.get_docstring(tree(path)), name_of(path)


def test_every_imported_package_is_a_declared_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    declared = {re.split(r"[^\w.-]", requirement)[0] for requirement in project["dependencies"]}
    # pydantic pins its core, and its documentation imports errors from there.
    declared = {name.lower().replace("_", "-") for name in declared} | {"pydantic-core"}
    distributions = packages_distributions()
    for path in MODULES:
        for name, line in imports(path):
            package = name.split(".")[0]
            if package == "mpmcli" or package in sys.stdlib_module_names:
                continue
            owners = {owner.lower().replace("_", "-") for owner in distributions.get(package, [package])}
            assert owners & declared, f"{name_of(path)}:{line}: {package} is not in pyproject.toml"


def test_no_file_names_a_package_registry() -> None:
    """Where packages come from is the installing machine's own choice."""
    hosts = ["pypi" + ".org", "python" + "hosted.org", "conda" + ".anaconda.org", "--index" + "-url"]
    found = []
    for path in repository_files():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        found += [f"{path.relative_to(ROOT)}: {host}" for host in hosts if host in text]
    assert not found, found


def test_help_imports_nothing_heavy(run_python: Callable) -> None:
    code = (
        "import sys, mpmcli.cli\n"
        "try:\n    mpmcli.cli.main(['--help'])\n"
        "except SystemExit as end:\n    assert not end.code, end.code\n"
        f"print('heavy:', sorted({HEAVY!r} & set(sys.modules)))"
    )
    assert run_python(code).stdout.splitlines()[-1] == "heavy: []"
