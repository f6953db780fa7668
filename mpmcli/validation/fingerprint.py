"""Keys of runs: runs with equal keys have the same scene, code and processor, so their results can be reused."""

import ast
import hashlib
import importlib.metadata
import inspect
import json
import sys
from collections.abc import Iterator
from dataclasses import asdict
from functools import cache
from pathlib import Path

from mpmcli import __version__
from mpmcli.scene import scene_to_toml
from mpmcli.validation.carry_out import scene_of
from mpmcli.validation.case import Case
from mpmcli.validation.matrix import Run

PACKAGE = Path(__file__).resolve().parent.parent
# Packages hashed in full. Of mpmcli.validation only the files that a run imports are hashed.
ROOMS = ("scene", "frames", "materials", "boundaries", "stability", "solver", "output")
CASE_PROCESS = PACKAGE / "validation" / "case_process.py"


def run_key(case: Case, run: Run, machine: str) -> str:
    """Return the key of a run: 64 hexadecimal digits.

    Args:
        machine: name of the processor, on which times depend.

    Raises:
        InputError: the scene is not valid.
    """
    facts = {
        "case": run.case,
        "n": run.n,
        "setting": asdict(run.setting),
        "version": __version__,
        "taichi": importlib.metadata.version("taichi"),
        "machine": machine,
        "scene": scene_to_toml(scene_of(case, run.n, run.setting)),
        "code": code_digest(case_files(case)),
    }
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def case_files(case: Case) -> tuple[Path, ...]:
    """Return the source files of the class of a case and of its base classes."""
    ours = [kind for kind in type(case).__mro__ if kind.__module__.partition(".")[0] not in sys.stdlib_module_names]
    found = {inspect.getsourcefile(kind) for kind in ours}
    return tuple(sorted(Path(name) for name in found if name))


@cache
def code_digest(files: tuple[Path, ...]) -> str:
    """Return the SHA-256 digest of all code and data that a run depends on.

    Args:
        files: source files of the case, see `case_files`.
    """
    rooms = [path for room in ROOMS for path in (PACKAGE / room).rglob("*.py")]
    data = [path for path in (PACKAGE / "validation" / "data").rglob("*") if path.is_file()]
    sources = {*rooms, *data, PACKAGE / "__init__.py", PACKAGE / "errors.py"}
    waiting = [CASE_PROCESS, *files]
    while waiting:
        path = waiting.pop()
        if path not in sources:
            sources.add(path)
            waiting += _imported(path)
    digest = hashlib.sha256()
    for path in sorted(sources):
        digest.update(path.name.encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def _imported(path: Path) -> Iterator[Path]:
    """Yield the files of mpmcli.validation that a module imports; cases are found by `all_cases` and not imported."""
    names = []
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module:
            names += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    for name in names:
        if name.startswith("mpmcli.validation"):
            place = PACKAGE.joinpath(*name.split(".")[1:])
            yield from (file for file in (place.with_suffix(".py"), place / "__init__.py") if file.exists())
