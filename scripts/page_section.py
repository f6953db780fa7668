"""Sections of the pages under docs/ that a command writes, and the results of the example scenes that they show."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PICTURES = DOCS / "pictures"
RESULTS = ROOT / "results" / "scene_table"


def run(*words: object) -> str:
    """Run mpmcli and return what it prints."""
    command = [sys.executable, "-m", "mpmcli", *map(str, words)]
    return subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True).stdout


def result_of(name: str) -> Path:
    """Return the result of an example scene, which is run if there is none."""
    result = RESULTS / name
    if not (result / "particles.vtkhdf").exists():
        run("simulate", f"configs/{name}.toml", "-o", result, "--overwrite", "--quiet")
    return result


def page_of(name: str) -> Path:
    """Return the page of docs/ that has the section.

    Raises:
        ValueError: not exactly one page has it.
    """
    pages = [page for page in DOCS.glob("*.md") if f"<!-- {name}:" in page.read_text(encoding="utf-8")]
    if len(pages) != 1:
        raise ValueError(f"one page of docs/ needs a section <!-- {name}: ... -->, not {len(pages)}")
    return pages[0]


def replace_section(name: str, text: str, file: Path | None = None) -> None:
    """Put `text` between `<!-- NAME: ... -->` and `<!-- end of NAME -->`, each on a line of its own.

    Args:
        file: the page; by default the one of docs/ that has the section.

    Raises:
        ValueError: the file does not hold exactly one such pair.
    """
    file = file or page_of(name)
    lines = file.read_text(encoding="utf-8").splitlines()
    starts = [i for i, line in enumerate(lines) if line.startswith(f"<!-- {name}:")]
    ends = [i for i, line in enumerate(lines) if line == f"<!-- end of {name} -->"]
    if len(starts) != 1 or len(ends) != 1 or ends[0] < starts[0]:
        raise ValueError(f"{file.name} needs one <!-- {name}: ... --> and one <!-- end of {name} --> after it")
    lines[starts[0] + 1 : ends[0]] = text.strip("\n").splitlines()
    file.write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
