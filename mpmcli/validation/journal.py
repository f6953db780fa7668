"""The results of finished runs, one file each, so that an interrupted study can be resumed."""

import json
from pathlib import Path

from mpmcli.errors import InputError, RunError
from mpmcli.output.directory import check_directory
from mpmcli.output.durable import TEMPORARY_SUFFIX, write_text
from mpmcli.validation.matrix import Run
from mpmcli.validation.run_result import RunResult

RUNS = "runs"
FIGURES = "figures"
REPORTS = ("report.json", "report.md", "report.html")


class Journal:
    """The directory of a report.

    Attributes:
        directory: directory of the report; runs/ contains the results.
    """

    def __init__(self, directory: Path, *, resume: bool, overwrite: bool) -> None:
        """Create the directory, or reuse or clear an existing one.

        Args:
            resume: reuse results that are still valid.
            overwrite: remove all results and the report.

        Raises:
            InputError: the directory is not empty and neither option is set, or it cannot be written.
        """
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
        """Return the stored result of a run; None if there is none with this key.

        Failed runs are repeated, since time or memory may have run out.
        """
        try:
            content = json.loads(self._file(run).read_text(encoding="utf-8"))
            result = RunResult.from_dict(content["result"])
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return result if content.get("key") == key and result.status != "failed" else None

    def keep(self, run: Run, key: str, result: RunResult) -> None:
        """Write the result of a run atomically.

        Raises:
            RunError: the file cannot be written.
        """
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
