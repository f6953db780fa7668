"""The command line of scripts/gpu."""

import argparse
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from page_section import replace_section

from gpu_parts.parts import PARTS, SCALES
from gpu_parts.records import DONE
from gpu_parts.report import NAME, write_report
from gpu_parts.runner import BUDGET, Runner

ARCHES = ("cuda", "vulkan", "cpu")


def main(arguments: Sequence[str] | None, output: IO[str]) -> int:
    """Run the parts and print the report; return 0 where all are done, 1 where something failed or is missing."""
    parser = argparse.ArgumentParser(prog="scripts/gpu", description=__doc__, epilog="See docs/gpu.md.")
    names = [part.name for part in PARTS]
    parser.add_argument("--arch", choices=ARCHES, help="backend; CUDA where there is a device, Vulkan otherwise")
    parser.add_argument("--scale", choices=SCALES, help="sizes: full on CUDA, small otherwise")
    parser.add_argument("--out", type=Path, help="directory of results: $OUT, or results/gpu")
    parser.add_argument("--budget", type=float, default=BUDGET, help="seconds of the whole call, 540 by default")
    parser.add_argument("--parts", nargs="+", choices=names, default=names, metavar="PART", help=", ".join(names))
    parser.add_argument(
        "--resume", type=Path, metavar="DIR", help="begin with the parts that an earlier call left there"
    )
    parser.add_argument("--again", action="store_true", help="measure what is done once more")
    parser.add_argument("--write", action="store_true", help="put the report into docs/gpu.md")
    options = parser.parse_args(arguments)
    folder = options.out or Path(os.environ.get("OUT") or "results/gpu")
    arch = options.arch or usual_arch()
    scale = options.scale or ("full" if arch == "cuda" else "small")
    folder.mkdir(parents=True, exist_ok=True)
    take_over(options.resume, folder, names)
    if options.again:
        for name in options.parts:
            (folder / f"{name}.json").unlink(missing_ok=True)

    def tell(line: str) -> None:
        print(line, file=sys.stderr, flush=True)

    # The process of a part does not outlive the call.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))
    runner = Runner(folder.resolve(), arch, scale, options.budget, tell)
    records = runner.run([part for part in PARTS if part.name in options.parts])
    write_report(folder)
    report = (folder / NAME).read_text(encoding="utf-8")
    output.write(report)
    if options.write:
        replace_section("gpu-cpu" if arch == "cpu" else "gpu", report)
    return 0 if all(record.state == DONE for record in records) else 1


def usual_arch() -> str:
    """Return "cuda" where Taichi can be expected to start on it, and "vulkan" elsewhere."""
    from mpmcli.solver.machine.backend import choose_backend

    return "cuda" if choose_backend("auto").arch == "cuda" else "vulkan"


def take_over(earlier: Path | None, folder: Path, names: Sequence[str]) -> None:
    """Copy the parts of an earlier call that are not in the folder yet."""
    for name in names if earlier else ():
        source, target = earlier / f"{name}.json", folder / f"{name}.json"
        if source.exists() and not target.exists():
            shutil.copyfile(source, target)


if __name__ == "__main__":
    # Taichi prints a line to standard output.
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as output:
        os.dup2(2, 1)
        sys.exit(main(None, output))
