"""Tests and measures mpmcli on a device, the most valuable first, and writes a report of what was found."""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from page_section import ROOT, replace_section

from mpmcli.plain_text import markdown_table

MPMCLI = (sys.executable, "-m", "mpmcli")
MEASURE = (sys.executable, str(ROOT / "scripts" / "gpu_step.py"))
# 4.1 million particles.
LARGE = ("configs/dam_break_3d.toml", "--set", "domain.spacing=0.00375", "--set", "time.end=0.06")
SMALL = ("configs/dam_break_2d.toml", "--set", "time.end=0.2")
AS_IT_IS = "as it is"
# Test files that run at once; each has a process of its own.
TOGETHER = 4
# A scene of `runs`, what is set in it on any device, and on one that a processor emulates.
RUNS = {
    "small": ("configs/dam_break_2d.toml", (), ("time.end=0.01", "time.frames=1")),
    "large": (LARGE[0], (LARGE[2], "time.end=0.1", "time.frames=5"), ("time.end=0.01", "time.frames=1")),
}
# Share of a step below which a launch is not listed.
SHOWN = 0.01
HEAD = ["measurement", "particles", "runs", "ms a step", "M particle-steps/s", "host, ms a step", "compile, s"]


@dataclass(frozen=True)
class Place:
    """Where a part runs: the device, whether a processor emulates it, the directory of output, and its seconds."""

    arch: str
    emulated: bool
    out: Path
    seconds: float

    def share(self, count: int) -> "Place":
        """Return the place of one of `count` measurements of a part."""
        return Place(self.arch, self.emulated, self.out, self.seconds / count)


@dataclass(frozen=True)
class Part:
    """A part of the report: what it finds, how that is written, and its share of the time."""

    find: Callable[[Place], dict]
    write: Callable[[dict], str]
    share: int = 1


def main() -> int:
    """Write the report after each part, so that a crash or an end of time leaves what was found; 1 if a part failed."""
    parser = argparse.ArgumentParser(prog="scripts/gpu", description=__doc__, epilog="See docs/gpu.md.")
    parser.add_argument("--arch", choices=("cuda", "vulkan", "cpu"), help="CUDA where there is a device, or Vulkan")
    parser.add_argument(
        "--out", type=Path, default=Path(os.environ.get("OUT") or "results/gpu"), help="$OUT, results/gpu"
    )
    parser.add_argument("--budget", type=float, default=540.0, help="seconds of the whole call, 540 by default")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=[*PARTS], metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--report", type=Path, metavar="JSON", help="measure nothing; the report of another call")
    parser.add_argument("--write", action="store_true", help="put the report into docs/gpu.md")
    options = parser.parse_args()
    record = json.loads(options.report.read_text(encoding="utf-8")) if options.report else found(options)
    text = report(record)
    print(text)
    if options.write:
        replace_section("gpu", text)
    return int(any("failed" in one for one in record["parts"].values()))


def found(options: argparse.Namespace) -> dict:
    """Return what the parts find."""
    arch, out, end = options.arch or usual_arch(), options.out.resolve(), time.monotonic() + options.budget
    out.mkdir(parents=True, exist_ok=True)
    record = {"machine": machine(arch), "parts": {}}
    for number, name in enumerate(options.parts):
        part, left = PARTS[name], end - time.monotonic()
        seconds = max(left * part.share / sum(PARTS[one].share for one in options.parts[number:]), 1.0)
        try:
            record["parts"][name] = part.find(Place(arch, arch != "cuda", out, seconds))
        except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
            record["parts"][name] = {"failed": reason(error)}
        (out / "report.json").write_text(json.dumps(record, indent=1), encoding="utf-8")
        (out / "report.md").write_text(report(record), encoding="utf-8")
        print(f"{name}: {end - time.monotonic():.0f} s left", file=sys.stderr, flush=True)
    return record


def report(record: dict) -> str:
    """Return a record as the text of the page."""
    sections = [record["machine"]]
    for name, one in record["parts"].items():
        text = f"Failed: {one['failed']}" if set(one) == {"failed"} else PARTS[name].write(one)
        sections.append(f"### {name.capitalize()}\n\n{text}")
    return "\n\n".join(sections) + "\n"


def reason(error: subprocess.SubprocessError) -> str:
    """Return why a process failed, in a line."""
    if isinstance(error, subprocess.TimeoutExpired):
        return f"not ended after {error.timeout:.0f} s."
    lines = (error.stderr or error.stdout or "").strip().splitlines()
    return f"exit code {error.returncode}: {lines[-1] if lines else ''}"


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


def run(command: tuple[str, ...], place: Place, check: bool = True, **variables: str) -> subprocess.CompletedProcess:
    """Run a command; CalledProcessError: it fails, TimeoutExpired: it takes longer."""
    cache = ROOT / "build" / "gpu-cache"
    environment = {"XDG_CACHE_HOME": str(cache), "CUDA_CACHE_PATH": str(cache / "cuda"), **os.environ, **variables}
    return subprocess.run(
        command, capture_output=True, text=True, check=check, timeout=place.seconds, cwd=ROOT, env=environment
    )


# Steps.


def measured(place: Place, rows: dict[str, tuple[str, ...]], **variables: str) -> dict:
    """Return what scripts/gpu_step.py measures with each tuple of arguments, or why it failed, by name."""
    rows_found = {}
    for name, arguments in rows.items():
        try:
            done = run((*MEASURE, "--arch", place.arch, *arguments), place.share(len(rows)), **variables)
            rows_found[name] = json.loads(done.stdout.splitlines()[-1])
        except (subprocess.TimeoutExpired, subprocess.CalledProcessError) as error:
            rows_found[name] = {"failed": reason(error)}
    return {"rows": rows_found}


def variants(scene: tuple[str, ...], *settings: str) -> dict[str, tuple[str, ...]]:
    """Return measurements of a scene with other constants between two as it is."""
    others = {setting: (*scene, "--constant", setting) for setting in settings}
    return {AS_IT_IS: scene, **others, f"{AS_IT_IS}, again": scene}


def steps_table(one: dict) -> str:
    """Return measurements as a table, with the launches of each below if they were measured."""
    rows, notes = [], []
    for name, row in one["rows"].items():
        if "failed" in row:
            notes.append(f"{name}: {row['failed']}")
            continue
        speed = row["particles"] * row["runs"] / row["step_ms"] / 1e3
        figures = [f"{row['step_ms']:.3g}", f"{speed:.3g}", f"{row['host_ms']:.2g}", f"{row['compile_s']:.1f}"]
        rows.append([name, f"{row['particles']:,}", str(row["runs"]), *figures])
        if row["kernels"]:
            longest = sorted(row["kernels"].items(), key=lambda item: -item[1])
            shown = [f"{launch} {ms:.3g}" for launch, ms in longest if ms > SHOWN * row["step_ms"]]
            notes.append(f"{name}, ms a step of the launches: {', '.join(shown)}.")
    return "\n\n".join([*([markdown_table(HEAD, rows, left={0})] if rows else []), *notes])


def launches(place: Place) -> dict:
    """Return a step as it is, and what its launches take by themselves."""
    scene = ("2d-64", "--steps", "100") if place.emulated else ("2d-512",)
    whole = measured(place.share(2), {scene[0]: scene})
    profiled = measured(place.share(2), {f"{scene[0]}, profiled": scene}, TI_KERNEL_PROFILER="1")
    return {"rows": whole["rows"] | profiled["rows"]}


def large(place: Place) -> dict:
    """Return a step of many particles by launches, and with other lengths of runs and ages of the order."""
    if place.emulated:
        return measured(place, variants(("3d-32", "--steps", "40"), "transfer.run_sums.SHORTEST=8"))
    profiled = measured(place.share(6), {"profiled": LARGE}, TI_KERNEL_PROFILER="1")
    runs = [f"transfer.run_sums.LONGEST={number}" for number in (8, 32)]
    ages = [f"engine.gpu_launch.AGED={age}" for age in (0.15, 0.6)]
    return {"rows": profiled["rows"] | measured(place.share(1), variants(LARGE, *runs, *ages))["rows"]}


def medium(place: Place) -> dict:
    """Return a step of 168,000 particles with other lengths of runs, numbers of threads and steps of a launch."""
    if place.emulated:
        return measured(place, variants(("2d-64", "--steps", "100"), "engine.gpu_launch.FEW_WORKERS=(8192,1)"))
    settings = ["transfer.run_sums.SHORTEST=8", "engine.gpu_launch.MANY=131072", "engine.gpu_launch.STEPS=32"]
    return measured(place, variants(("2d-512",), *settings, "engine.gpu_launch.WORKERS=(32768,1)"))


def optimisation(place: Place) -> dict:
    """Return steps with more of Taichi's optimisations."""
    scenes = [("2d-64", "--steps", "100")] if place.emulated else [("2d-512",), ("3d-128", "--steps", "200")]
    rows = {f"{scene[0]}, {how}": (*scene, "--optimisation", how) for scene in scenes for how in ("few", "most")}
    return measured(place, rows)


def batches(place: Place) -> dict:
    """Return steps of many runs at once."""
    scene, numbers = ((*SMALL[:1], "--set", "time.end=0.02"), (1, 4)) if place.emulated else (SMALL, (1, 16, 64, 128))
    return measured(place, {f"{number} runs": (*scene, "--runs", str(number)) for number in numbers})


# Tests.


def tests(place: Place) -> dict:
    """Run the quick tests that are marked gpu, file by file, and return how many passed and why others did not."""
    # Other files may need packages that are not here.
    files = [path for path in (ROOT / "tests").glob("test_*.py") if "mark.gpu" in path.read_text(encoding="utf-8")]
    (place.out / "tests").mkdir(exist_ok=True)
    end = time.monotonic() + place.seconds
    with ThreadPoolExecutor(TOGETHER) as pool:
        outcomes = list(pool.map(lambda path: test_file(path, place, end), sorted(files)))
    failed = {name: words for outcome in outcomes for name, words in outcome["failed"].items()}
    return {"passed": sum(outcome["passed"] for outcome in outcomes)} | ({"failed": failed} if failed else {})


def test_file(path: Path, place: Place, end: float) -> dict:
    """Return the outcome of a test file; its whole output is kept."""
    outcome = place.out / "tests" / f"{path.stem}.xml"
    outcome.unlink(missing_ok=True)
    options = ("-v", "-p", "no:cacheprovider", "-m", "gpu and not slow", f"--junitxml={outcome}")
    limit = Place(place.arch, place.emulated, place.out, max(end - time.monotonic(), 0.1))
    try:
        done = run((sys.executable, "-m", "pytest", *options, str(path)), limit, False, MPMCLI_TEST_GPU=place.arch)
    except subprocess.TimeoutExpired as error:
        return {"passed": 0, "failed": {path.stem: reason(error)}}
    outcome.with_suffix(".txt").write_text(done.stdout + done.stderr, encoding="utf-8")
    if not outcome.exists():
        return {"passed": 0, "failed": {path.stem: f"exit code {done.returncode}"}}
    passed, failed = 0, {}
    for case in ElementTree.parse(outcome).iter("testcase"):
        faults = [fault for fault in case if fault.tag in ("failure", "error")]
        passed += not faults and case.find("skipped") is None
        failed |= {f"{path.stem}::{case.get('name')}": (fault.get("message") or "").splitlines()[0] for fault in faults}
    return {"passed": passed, "failed": failed}


def tests_text(one: dict) -> str:
    """Return the failures as a table, and the number of tests that passed."""
    failed = one.get("failed", {})
    table = markdown_table(["test", "reason"], [[name, words[:120]] for name, words in failed.items()], left={0, 1})
    return f"{one['passed']} passed, {len(failed)} failed." + (f"\n\n{table}" if failed else "")


# Whole runs.


def speed(place: Place) -> dict:
    """Return the outcome of the benchmark: one case where a processor emulates the device, three on CUDA."""
    cases = ("2d-64",) if place.emulated else ("2d-512", "3d-64", "3d-128")
    options = [word for case in cases for word in ("--case", case)]
    command = (*MPMCLI, "bench", "--arch", place.arch, "--threads", "1", "--blocks", "3", "--json", *options)
    return json.loads(run(command, place).stdout)


def speed_text(one: dict) -> str:
    """Return the benchmark as a table."""
    rows = []
    for case in one["cases"]:
        sides = [case["sides"][name] for name in ("mpmcli", case["peer"])]
        speeds = [f"{1e3 / side['ns_per_particle_step']:.3g}" for side in sides]
        ms = f"{1e-6 * case['particles'] * sides[0]['ns_per_particle_step']:.3g}"
        rows.append([case["case"], f"{case['particles']:,}", speeds[0], f"{case['peer']}: {speeds[1]}", ms])
    head = ["case", "particles", "M particle-steps/s", "peer's", "ms a step"]
    return markdown_table(head, rows, left={0})


def runs(place: Place) -> dict:
    """Simulate a small scene twice, from a cold start and with stored kernels, and a large one."""
    rows = {}
    with tempfile.TemporaryDirectory() as empty:
        for name, kind in (("small, cold start", "small"), ("small", "small"), ("large", "large")):
            scene, settings, emulated = RUNS[kind]
            options = [word for setting in (emulated if place.emulated else settings) for word in ("--set", setting)]
            to = place.out / kind
            command = (
                *MPMCLI,
                "simulate",
                scene,
                "--arch",
                place.arch,
                "--overwrite",
                "--json",
                "-o",
                str(to),
                *options,
            )
            caches = {"XDG_CACHE_HOME": empty, "CUDA_CACHE_PATH": str(Path(empty) / "cuda")}
            rows[name] = json.loads(run(command, place.share(3), **caches).stdout)
            (to / "particles.vtkhdf").unlink()
    return {"rows": rows}


def runs_text(one: dict) -> str:
    """Return what runs took as a table."""
    rows = []
    for name, row in one["rows"].items():
        figures = [f"{row['particles']:,}", f"{row['steps']:,}"]
        figures += [f"{row['timings'][key]:.1f}" for key in ("compile_s", "solve_s", "wall_s")]
        rows.append([name, *figures, f"{row['particle_steps_per_s'] / 1e6:.1f}", row["status"]])
    head = ["run", "particles", "steps", "compile, s", "steps, s", "all, s", "M particle-steps/s", "status"]
    return markdown_table(head, rows, left={0, 7})


PARTS = {
    "launches": Part(launches, steps_table),
    "tests": Part(tests, tests_text, share=4),
    "speed": Part(speed, speed_text, share=2),
    "large": Part(large, steps_table, share=3),
    "optimisation": Part(optimisation, steps_table, share=2),
    "medium": Part(medium, steps_table, share=2),
    "batches": Part(batches, steps_table, share=2),
    "runs": Part(runs, runs_text),
}

if __name__ == "__main__":
    sys.exit(main())
