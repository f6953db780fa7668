"""Runs what scripts/gpu is for on a device, and writes a report: tests, speed, a small run and a large one."""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from page_section import ROOT, replace_section

from mpmcli.plain_text import markdown_table

# A scene, what is set in it, and its name in the report: 20,000 particles, and 4.1 million on CUDA.
RUNS = {
    "small": ("configs/dam_break_2d.toml", ()),
    "large": ("configs/dam_break_3d.toml", ("domain.spacing=0.00375", "time.end=0.1", "time.frames=5")),
}
# On a device that the processor emulates.
EMULATED = ("time.end=0.01", "time.frames=1")
MPMCLI = (sys.executable, "-m", "mpmcli")


def main() -> int:
    """Write the report after each part, so that a crash or an end of time leaves what was found; 1 if a part failed."""
    parser = argparse.ArgumentParser(prog="scripts/gpu", description=__doc__, epilog="See docs/gpu.md.")
    parser.add_argument("--arch", choices=("cuda", "vulkan", "cpu"), help="CUDA where there is a device, or Vulkan")
    parser.add_argument(
        "--out", type=Path, default=Path(os.environ.get("OUT") or "results/gpu"), help="$OUT, results/gpu"
    )
    parser.add_argument("--budget", type=float, default=540.0, help="seconds of the whole call, 540 by default")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--write", action="store_true", help="put the report into docs/gpu.md")
    options = parser.parse_args()
    arch, out, end = options.arch or usual_arch(), options.out.resolve(), time.monotonic() + options.budget
    out.mkdir(parents=True, exist_ok=True)
    sections, failed = [machine(arch)], False
    for number, name in enumerate(options.parts):
        left = (end - time.monotonic()) / (len(options.parts) - number)
        try:
            text = PARTS[name](arch, out, max(left, 1.0))
        except subprocess.TimeoutExpired:
            text, failed = f"Not ended after {left:.0f} s.", True
        except subprocess.CalledProcessError as error:
            words = "\n".join((error.stderr or error.stdout or "").strip().splitlines()[-20:])
            text, failed = f"Failed, exit code {error.returncode}:\n\n```\n{words}\n```", True
        sections.append(f"### {name.capitalize()}\n\n{text}")
        report = "\n\n".join(sections) + "\n"
        (out / "report.md").write_text(report, encoding="utf-8")
        print(f"{name}: {text}", file=sys.stderr, flush=True)
    print(report)
    if options.write:
        replace_section("gpu", report)
    return int(failed)


def usual_arch() -> str:
    """Return "cuda" where Taichi can be expected to start on it, and "vulkan" elsewhere."""
    from mpmcli.solver.machine.backend import choose_backend

    return "cuda" if choose_backend("auto").arch == "cuda" else "vulkan"


def machine(arch: str) -> str:
    """Return a line about the machine and its device."""
    from mpmcli.bench.report import describe_machine
    from mpmcli.doctor.examination import device_names

    facts = describe_machine()
    names = ", ".join(name for name, _ in device_names(arch)) or facts["processor"]
    commit = said(["git", "rev-parse", "--short", "HEAD"])
    driver = said(["nvidia-smi", "--query-gpu=driver_version,memory.total", "--format=csv,noheader"]).replace(
        "\n", "; "
    )
    words = [f"{arch}: {names}", driver, f"Python {facts['python']}", f"Taichi {facts['taichi']}", f"commit {commit}"]
    return ", ".join(filter(None, words)) + "."


def said(command: list[str]) -> str:
    """Return what a command prints, "" where it fails or is not there."""
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=20, cwd=ROOT).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def run(command: tuple[str, ...], seconds: float, **variables: str) -> str:
    """Return what a command prints; CalledProcessError: it fails, TimeoutExpired: it takes longer."""
    cache = ROOT / "build" / "gpu-cache"
    places = {"XDG_CACHE_HOME": str(cache), "CUDA_CACHE_PATH": str(cache / "cuda")}
    environment = {**places, **os.environ, **variables}
    done = subprocess.run(
        command, capture_output=True, text=True, check=True, timeout=seconds, cwd=ROOT, env=environment
    )
    return done.stdout


def tests(arch: str, out: Path, seconds: float) -> str:
    """Run the quick tests that are marked gpu, and return pytest's last line."""
    # Other files may need packages that are not here.
    files = [path for path in (ROOT / "tests").glob("test_*.py") if "mark.gpu" in path.read_text(encoding="utf-8")]
    options = ("-q", "-p", "no:cacheprovider", "-m", "gpu and not slow")
    command = (sys.executable, "-m", "pytest", *options, *map(str, sorted(files)))
    return run(command, seconds, MPMCLI_TEST_GPU=arch).strip().splitlines()[-1].strip("= ")


def bench(arch: str, out: Path, seconds: float) -> str:
    """Return the table of the benchmark: one case where a processor emulates the device, three on CUDA."""
    cases = ("2d-512", "3d-64", "3d-128") if arch == "cuda" else ("2d-64",)
    options = [word for case in cases for word in ("--case", case)]
    return run((*MPMCLI, "bench", "--arch", arch, "--threads", "1", "--blocks", "3", *options), seconds).strip()


def runs(arch: str, out: Path, seconds: float) -> str:
    """Simulate a small scene and a large one, and return what they took."""
    rows = []
    for name, (scene, settings) in RUNS.items():
        settings = settings if arch == "cuda" else EMULATED
        options = [word for setting in settings for word in ("--set", setting)]
        command = (*MPMCLI, "simulate", scene, "--arch", arch, "--overwrite", "--json", "-o", str(out / name), *options)
        found = json.loads(run(command, seconds / len(RUNS)))
        (out / name / "particles.vtkhdf").unlink()
        figures = [f"{found['particles']:,}", f"{found['steps']:,}"]
        figures += [f"{found['timings'][key]:.1f}" for key in ("compile_s", "solve_s", "wall_s")]
        figures += [f"{found['particle_steps_per_s'] / 1e6:.1f}"]
        rows.append([name, Path(scene).stem, *figures, found["status"]])
    head = ["run", "scene", "particles", "steps", "compile, s", "steps, s", "all, s", "M particle-steps/s", "status"]
    return markdown_table(head, rows, left={0, 1, 8})


PARTS: dict[str, Callable[[str, Path, float], str]] = {"tests": tests, "bench": bench, "runs": runs}

if __name__ == "__main__":
    sys.exit(main())
