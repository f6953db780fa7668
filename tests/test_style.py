"""The rules of the code that a reader relies on, held by the parser rather than by good intentions."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from importlib import import_module
from importlib.metadata import packages_distributions
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGE = ROOT / "mpmcli"
MODULES = sorted(PACKAGE.rglob("*.py"))
SOURCES = sorted([*MODULES, *(ROOT / "tests").rglob("*.py")])
# The page without its line breaks.
ARCHITECTURE = " ".join((ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split())

# Imports run downwards only, or within a level.
LEVELS = {
    **dict.fromkeys(("api", "cli", "__main__"), 8),
    **dict.fromkeys(("dataset", "validation", "render", "plot", "bench", "doctor", "error_bars"), 7),
    "simulation": 6,
    "check": 5,
    **dict.fromkeys(("solver", "output"), 4),
    **dict.fromkeys(("boundaries", "materials", "stability"), 3),
    "frames": 2,
    "scene": 1,
    **dict.fromkeys(
        ("processes", "cores", "errors", "extras", "plain_json", "plain_text", "quick_taichi", "__init__"), 0
    ),
}
TAICHI_ROOMS = {"solver", "materials", "boundaries", "quick_taichi"}
# These know frames and files, never the device state; the solver knows no store.
BARRED = {"solver": "output", "render": "solver", "plot": "solver", "output": "solver", "dataset": "solver"}
# The distributions of packages of another name that may not be installed.
ABSENT = {"pxr": "usd-core"}
HEAVY = {"taichi", "numpy", "h5py", "pydantic", "vtk", "vtkmodules", "pyvista", "meshio", "matplotlib", "PIL"}


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def room_of(path: Path) -> str:
    """Return the room of a module: its sub-package, or its own name directly below mpmcli."""
    first = path.relative_to(PACKAGE).parts[0]
    return first.removesuffix(".py")


def module_of(path: Path) -> str:
    """Return the dotted name of a file of the package."""
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


MODULE_NAMES = {module_of(path) for path in MODULES}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Yield (absolute dotted name, line) of everything a file imports, at any depth of its code."""
    package = path.relative_to(ROOT).parts[:-1]
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


def imported_modules(path: Path) -> Iterator[str]:
    """Yield the modules of the package that a module imports, at any depth of its code."""
    for name, _ in imports(path):
        for known in (name, name.rpartition(".")[0]):
            if known in MODULE_NAMES:
                yield known
                break


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


def offenders(rule: Callable[[Path], Iterable[int]], paths: Iterable[Path] = MODULES) -> list[str]:
    """Return "file:line" of every line that breaks a rule."""
    return [f"{name_of(path)}:{line}" for path in paths for line in rule(path)]


def test_every_module_has_a_level() -> None:
    unknown = [name_of(path) for path in MODULES if room_of(path) not in LEVELS]
    assert not unknown, f"give their rooms a level in {Path(__file__).name}: {unknown}"


def test_imports_run_downwards() -> None:
    """Imports inside functions, and those for type checking, count too."""

    def upward(path: Path) -> Iterator[int]:
        room = room_of(path)
        for imported, line in imported_rooms(path):
            if LEVELS[imported] > LEVELS[room] or imported == BARRED.get(room):
                yield line

    assert not offenders(upward)


def test_no_module_imports_itself_through_others() -> None:
    graph = {module_of(path): set(imported_modules(path)) - {"mpmcli"} for path in MODULES}
    sorter = TopologicalSorter(graph)
    try:
        sorter.prepare()
    except CycleError as error:
        pytest.fail(f"a circle of imports: {' -> '.join(error.args[1])}")


def test_taichi_is_imported_where_kernels_live_and_nowhere_else() -> None:
    def taichi(path: Path) -> Iterator[int]:
        if room_of(path) not in TAICHI_ROOMS:
            yield from (line for name, line in imports(path) if name.split(".")[0] == "taichi")

    assert not offenders(taichi)


def test_the_page_on_the_code_has_the_order_of_imports() -> None:
    levels = sorted(set(LEVELS.values()), reverse=True)
    rooms = (", ".join(f"`{room}`" for room, its in LEVELS.items() if its == level) for level in levels)
    assert f"within a level: {' → '.join(rooms)}." in ARCHITECTURE


def test_the_page_on_the_code_names_what_there_is() -> None:
    """Each `file.py` is in the repository, and defines each name of `file.py: name`."""
    for place, name in re.findall(r"`([\w/]+\.py)\b(?:: (\w[\w.]*\w))?", ARCHITECTURE):
        texts = [path.read_text(encoding="utf-8") for path in SOURCES if path.as_posix().endswith(f"/{place}")]
        parts = [rf"(?m)\b(def|class) {part}\b|^ *{part}\b.*=" for part in name.split(".") if part]
        assert any(all(re.search(part, text) for part in parts) for text in texts), f"{place}: {name}"


def named_between(start: str, end: str) -> set[str]:
    """Return the files that the page on the code names between two words."""
    return set(re.findall(r"`([\w/]+\.py)`", ARCHITECTURE.partition(start)[2].partition(end)[0]))


def test_the_page_on_the_code_names_what_imports_taichi_itself() -> None:
    direct = {str(p.relative_to(PACKAGE)) for p in MODULES if any(n.split(".")[0] == "taichi" for n, _ in imports(p))}
    assert named_between("use taichi:", "No module below") == direct


def test_the_page_on_the_code_names_what_moves_files() -> None:
    moving = {str(p.relative_to(PACKAGE)) for p in MODULES if {"os.replace", "os.rename"} & {n for n, _ in calls(p)}}
    assert named_between("A file gets its name", "`output/lock.py`") == moving


def test_annotations_are_never_postponed() -> None:
    """Taichi reads annotations as objects: postponed ones are strings, and fail far from their cause."""

    def postponed(path: Path) -> Iterator[int]:
        yield from (line for name, line in imports(path) if name == "__future__.annotations")

    assert not offenders(postponed, SOURCES)


def test_taichi_starts_in_one_place() -> None:
    """A second ti.init kills every field of the first, so there is one call, in the backend."""
    found = offenders(lambda path: (line for name, line in calls(path) if name in {"ti.init", "taichi.init"}))
    assert len(found) == 1, found
    assert found[0].startswith("mpmcli/solver/machine/backend.py:"), found


def test_nothing_below_the_command_line_prints_or_exits() -> None:
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

    def speaks(path: Path) -> Iterator[int]:
        # What runs as a process of its own answers on stdout.
        if room_of(path) in {"cli", "__main__", "processes"} or path == PACKAGE / "bench" / "worker.py":
            return
        yield from (line for name, line in calls(path) if name in banned)
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.Raise) and node.exc is not None and "SystemExit" in ast.unparse(node.exc):
                yield node.lineno

    assert not offenders(speaks)


def test_modules_say_what_they_are() -> None:
    silent = [
        name_of(path)
        for path in MODULES
        if path.read_text(encoding="utf-8").strip() and not ast.get_docstring(tree(path))
    ]
    assert not silent, f"without a docstring: {silent}"


def test_functions_of_twelve_lines_say_what_they_do() -> None:
    def silent(path: Path) -> Iterator[int]:
        functions = (node for node in ast.walk(tree(path)) if isinstance(node, ast.FunctionDef))
        yield from (
            node.lineno for node in functions if node.end_lineno - node.lineno > 10 and not ast.get_docstring(node)
        )

    assert not offenders(silent)


def test_every_imported_package_is_a_declared_dependency() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    extras = {name: extra for name, extra in project["optional-dependencies"].items() if name != "test"}
    wanted = sum(extras.values(), project["dependencies"])
    declared = {re.split(r"[^\w.-]", requirement)[0] for requirement in wanted}
    # pydantic pins its core, and its documentation imports errors from there.
    declared = {name.lower().replace("_", "-") for name in declared} | {"pydantic-core"}
    distributions = packages_distributions()

    def undeclared(path: Path) -> Iterator[int]:
        for name, line in imports(path):
            package = name.split(".")[0]
            owners = {
                owner.lower().replace("_", "-") for owner in distributions.get(package, [ABSENT.get(package, package)])
            }
            if package != "mpmcli" and package not in sys.stdlib_module_names and not owners & declared:
                yield line

    assert not offenders(undeclared)


def test_scripts_import_what_there_is() -> None:
    """No test runs all of them: a module that was merged into another one would be missed late."""
    missing = []
    for path in sorted((ROOT / "scripts").iterdir()):
        if path.suffix != ".py" and not (path.is_file() and path.read_bytes().startswith(b"#!/usr/bin/env python")):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("mpmcli"):
                there = import_module(node.module)
                names = [one.name for one in node.names if not hasattr(there, one.name)]
                missing += [name for name in names if find_spec(f"{node.module}.{name}") is None]
    assert not missing


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
