"""The tests that are marked gpu, on this device."""

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from page_section import markdown_table

from gpu_parts.parts import Setup, Task
from mpmcli.cores import available_cores

ROOT = Path(__file__).resolve().parent.parent.parent
# A line of pytest -v: "tests/test_x.py::test_y[2D] PASSED [ 10%]", or with pytest-xdist "[gw0] [ 10%] PASSED
# tests/test_x.py::test_y[2D]".
WORDS = ("PASSED", "FAILED", "ERROR", "SKIPPED", "XFAIL", "XPASS")
LINE = re.compile(
    rf"^(?:\[gw\d+\]\s+\[\s*\d+%\]\s+(?P<before>{'|'.join(WORDS)})\s+)?(?P<test>tests/\S+?::.*?)"
    rf"(?:\s+(?P<after>{'|'.join(WORDS)})\b.*)?$"
)
# Lines of its summary that say why: "FAILED tests/test_x.py::test_y - AssertionError: ...".
REASON = re.compile(r"^(?:FAILED|ERROR|SKIPPED) .*$")
HEADER = re.compile(
    r"^(?:=+ test session|platform |hypothesis |cachedir: |rootdir: |configfile: |plugins: |created: ).*$"
)
MOST_REASONS, MOST_PROCESSES = 20, 8
# Time that is kept for pytest's own end, s.
MARGIN = 4.0


def tasks(setup: Setup) -> Sequence[Task]:
    """Return the quick tests, then the slow ones, which compile for long."""
    files = setup.sized(["tests/test_elementary.py"], gpu_files(), gpu_files())
    quick = Task("quick", lambda left: run_tests("gpu and not slow", files, setup.arch, left))
    if setup.scale == "tiny":
        return (quick,)
    return (quick, Task("slow", lambda left: run_tests("gpu and slow", files, setup.arch, left)))


def gpu_files() -> list[str]:
    """Return the files with tests that are marked gpu, but for that of this script; others may need absent packages."""
    files = [path for path in sorted((ROOT / "tests").glob("test_*.py")) if path.name != "test_gpu_script.py"]
    return [f"tests/{path.name}" for path in files if "mark.gpu" in path.read_text(encoding="utf-8")]


def run_tests(marks: str, files: Sequence[str], arch: str, left: float) -> dict:
    """Run pytest and return counts, and what failed and was skipped; those that had no time are missing."""
    processes = min(available_cores(), MOST_PROCESSES)
    parallel = ["--numprocesses", str(processes), "--dist", "load"] if processes > 1 and has_xdist() else []
    command = [sys.executable, "-m", "pytest", "-v", "-rfEs", "-p", "no:cacheprovider", "-m", marks, *parallel, *files]
    settings = {**os.environ, "MPMCLI_TEST_GPU": arch, "COLUMNS": "200"}
    began, ended = time.monotonic(), True
    # A file: a worker that goes on for a while would hold a pipe open.
    with tempfile.TemporaryFile(mode="w+", encoding="utf-8", errors="replace") as words:
        process = subprocess.Popen(command, cwd=ROOT, stdout=words, stderr=subprocess.STDOUT, env=settings)
        try:
            process.wait(timeout=max(1.0, left - MARGIN))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            ended = False
        words.seek(0)
        output = words.read()
    return read_output(output) | {"seconds": time.monotonic() - began, "ended": ended, "status": process.returncode}


def has_xdist() -> bool:
    """Return whether pytest can use several processes here."""
    try:
        import xdist  # noqa: F401
    except ImportError:
        return False
    return True


def read_output(output: str) -> dict:
    """Return counts by outcome, names of tests that failed, and the lines that give reasons."""
    outcomes: dict[str, str] = {}
    for line in output.splitlines():
        if (found := LINE.match(line)) and (word := found["before"] or found["after"]):
            outcomes[found["test"].strip()] = word
    counts = Counter(outcomes.values())
    reasons = [line for line in output.splitlines() if REASON.match(line) and "%]" not in line]
    row = {
        "counts": {word.lower(): counts[word] for word in WORDS if counts[word]},
        "failed": [test for test, word in outcomes.items() if word in ("FAILED", "ERROR")],
        "reasons": reasons[:MOST_REASONS],
    }
    # Where nothing ran, the last lines say why; those with which pytest begins say where and with what.
    lines = [line for line in output.strip().splitlines() if not HEADER.match(line)]
    return row if outcomes else row | {"said": lines[-8:]}


def section(rows: dict[str, dict]) -> str:
    """Return the counts, and a line for each reason."""
    cells = [
        [
            key,
            ", ".join(f"{count} {word}" for word, count in row["counts"].items()) or "none ran",
            f"{row['seconds']:.0f}" + ("" if row["ended"] else ", ended by time"),
        ]
        for key, row in rows.items()
        if "counts" in row
    ]
    lines = [markdown_table(["tests", "outcome", "s"], cells, {2}), ""]
    for row in rows.values():
        lines += [f"* `{line}`" for line in (*row.get("reasons", ()), *row.get("said", ()))]
    return "\n".join(lines).strip()
