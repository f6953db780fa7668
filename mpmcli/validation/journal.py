"""The results of finished runs, one file each, so that an interrupted study can be resumed, and the keys of runs.

Runs with equal keys have the same scene, code and processor, so their results can be reused.
"""

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
from mpmcli.errors import InputError, RunError
from mpmcli.output.directory import check_directory
from mpmcli.output.durable import TEMPORARY_SUFFIX, write_text
from mpmcli.scene import scene_to_toml
from mpmcli.validation.carry_out import scene_of
from mpmcli.validation.case import Case
from mpmcli.validation.runs import Run, RunResult

RUNS = "runs"
FIGURES = "figures"
REPORTS = ("report.json", "report.md", "report.html")
PACKAGE = Path(__file__).resolve().parent.parent
# Packages hashed in full. Of mpmcli.validation only the files that a run imports are hashed.
ROOMS = ("scene", "frames", "materials", "boundaries", "stability", "solver", "output")
RUNNER = PACKAGE / "validation" / "runner.py"


class Journal:
    """The directory of a report; runs/ in it contains the results."""

    def __init__(self, directory: Path, *, resume: bool, overwrite: bool) -> None:
        """Create the directory, or reuse the results in it, or clear it; InputError where neither is asked for."""
        self.directory = Path(directory)
        check_directory(self.directory, overwrite=True)
        if self.directory.is_dir() and any(self.directory.iterdir()) and not (resume or overwrite):
            raise InputError(
                f"{self.directory} exists and is not empty: --resume keeps the runs in it that still hold and does the "
                "others, --overwrite does all again; or give another directory with -o."
            )
        try:
            if overwrite:
                self._clear()
            (self.directory / RUNS).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise InputError(f"{self.directory} cannot be used ({reason}): give another place with -o.") from error

    def find(self, run: Run, key: str) -> RunResult | None:
        """Return the stored result of a run with this key; not a failure, as time or memory may have run out."""
        try:
            content = json.loads(self._file(run).read_text(encoding="utf-8"))
            result = RunResult.from_dict(content["result"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return result if content.get("key") == key and result.status != "failed" else None

    def keep(self, run: Run, key: str, result: RunResult) -> None:
        """Write the result of a run atomically; RunError where that fails."""
        text = json.dumps({"key": key, "result": result.as_dict()}, indent=1, ensure_ascii=False)
        try:
            write_text(self._file(run), text + "\n")
        except OSError as error:
            raise RunError(f"{self._file(run)} could not be written ({error.strerror or error}).") from error

    def _file(self, run: Run) -> Path:
        return self.directory / RUNS / f"{run.name}.json"

    def _clear(self) -> None:
        """Remove the files of a report and no others."""
        ours = [self.directory / name for name in REPORTS]
        for folder, suffix in ((RUNS, ".json"), (FIGURES, ".svg")):
            ours += [*(self.directory / folder).glob(f"*{suffix}")]
            ours += [*(self.directory / folder).glob(f"*{suffix}{TEMPORARY_SUFFIX}")]
        for path in ours:
            path.unlink(missing_ok=True)


def run_key(case: Case, run: Run, machine: str) -> str:
    """Return the key of a run on a machine, 64 hexadecimal digits; InputError where its scene is not valid.

    The machine is the name of the processor, on which times depend.
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
    return tuple(sorted(Path(name) for name in {inspect.getsourcefile(kind) for kind in ours} if name))


@cache
def code_digest(files: tuple[Path, ...]) -> str:
    """Return the SHA-256 digest of all code and data that a run depends on, the files of its case included."""
    rooms = [path for room in ROOMS for path in (PACKAGE / room).rglob("*.py")]
    data = [path for path in (PACKAGE / "validation" / "data").rglob("*") if path.is_file()]
    sources = {*rooms, *data, PACKAGE / "__init__.py", PACKAGE / "errors.py"}
    waiting = [RUNNER, *files]
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
            module = PACKAGE.joinpath(*name.split(".")[1:])
            yield from (file for file in (module.with_suffix(".py"), module / "__init__.py") if file.exists())
