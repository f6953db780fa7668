"""scripts/gpu: parts in processes of their own, of which a crash, a hang or a kill loses nothing, and their report."""

import importlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
from conftest import GPU, ROOT

# A process of a part whose tasks are "one" to "four"; what it does at each stands in a file, by the name of the part.
FAKE = """
import json, os, signal, sys, time
name, arch, scale, seconds, last, *done = sys.argv[1:]
plan = json.load(open(os.environ["PLAN"]))[name]
print("a line of Taichi", file=sys.stderr)
for key in sorted(plan, key=lambda key: key == last):
    if key in done:
        continue
    print(json.dumps({"begin": key}), flush=True)
    with open(os.environ["PLAN"] + ".log", "a") as log:
        log.write(f"{name} {key}\\n")
    if plan[key] == "crash":
        print("the last words", file=sys.stderr, flush=True)
        os.kill(os.getpid(), signal.SIGSEGV)
    if plan[key] == "hang":
        time.sleep(600)
    print(json.dumps({"key": key, "row": {"figure": plan[key]}}), flush=True)
if plan.get("end") == "crash":
    sys.exit(3)
"""


@pytest.fixture
def parts(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], object]:
    """Return `part_module(name)`, which imports a module of the script."""
    monkeypatch.syspath_prepend(ROOT / "scripts")
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    return lambda name: importlib.import_module(f"gpu_parts.{name}")


@pytest.fixture
def play(parts: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict]:
    """Return `play(plan, budget)`: the JSON of each part of a plan, and as "began" the tasks that this call began."""
    fake, plan_file, folder = tmp_path / "fake.py", tmp_path / "plan.json", tmp_path / "out"
    fake.write_text(FAKE)
    log = Path(f"{plan_file}.log")
    monkeypatch.setenv("PLAN", str(plan_file))
    # Sections of rows that no part would have.
    monkeypatch.setattr(parts("parts").Part, "section", lambda self, rows: json.dumps(rows))

    def played(plan: dict[str, dict[str, object]], budget: float = 60, seconds: float = 60) -> dict:
        plan_file.write_text(json.dumps(plan))
        log.write_text("")
        chosen = [parts("parts").Part(name, name.title(), seconds) for name in plan]
        runner = parts("runner").Runner(folder, "cpu", "tiny", budget, lambda line: None, (sys.executable, str(fake)))
        runner.run(chosen)
        found = {name: json.loads((folder / f"{name}.json").read_text()) for name in plan}
        return found | {"began": log.read_text().splitlines(), "report": (folder / "report.md").read_text()}

    return played


def figures(record: dict) -> dict:
    """Return the figure of each row of a part."""
    return {key: row["figure"] for key, row in record["rows"].items()}


def test_a_crash_loses_its_task_alone(play: Callable) -> None:
    found = play({"limits": {"one": 1, "two": "crash", "three": 3}, "bench": {"one": 4}})
    assert found["limits"]["state"] == "failed" and figures(found["limits"]) == {"one": 1, "three": 3}
    assert found["limits"]["failures"].keys() == {"two"}
    assert found["limits"]["failures"]["two"].startswith("signal SIGSEGV\n")
    assert found["limits"]["failures"]["two"].endswith("\nthe last words")
    assert found["bench"]["state"] == "done" and figures(found["bench"]) == {"one": 4}
    assert "* two: failed, signal SIGSEGV: `the last words`" in found["report"]
    # Another call tries what failed once more, and nothing else.
    again = play({"limits": {"one": 1, "two": 2, "three": 3}, "bench": {"one": 4}})
    assert again["began"] == ["limits two"] and again["limits"]["state"] == "done"
    assert figures(again["limits"]) == {"one": 1, "three": 3, "two": 2}
    assert again["limits"]["failures"] == {} and "failed" not in again["report"]


def test_a_part_that_fails_outside_of_tasks_is_not_repeated_for_ever(play: Callable) -> None:
    found = play({"limits": {"one": 1, "end": "crash"}})
    assert found["began"] == ["limits one", "limits end"]
    assert found["limits"]["state"] == "failed" and found["limits"]["failures"]["end"].startswith("signal")
    fails_at_end = {"limits": {"one": 1}}
    assert play(fails_at_end)["limits"]["state"] == "done"


def test_a_task_that_hangs_is_ended_and_comes_last(play: Callable) -> None:
    """It takes the time of its part; the others have theirs, and the next call begins with what it held up."""
    found = play({"limits": {"one": 1, "two": "hang", "three": 3}, "bench": {"one": 4}}, budget=12, seconds=6)
    assert found["limits"]["state"] == "out of time" and found["limits"]["missing"] == "two"
    assert found["bench"]["state"] == "done"
    # What is left of the call goes to what ran out of time: "three", then "two" once more.
    assert found["began"][:5] == ["limits one", "limits two", "bench one", "limits three", "limits two"]
    assert figures(found["limits"]) == {"one": 1, "three": 3}
    assert "* two: the time was up." in found["report"]
    again = play({"limits": {"one": 1, "two": 2, "three": 3}, "bench": {"one": 4}})
    assert again["began"] == ["limits two"] and again["limits"]["state"] == "done"


def test_a_row_that_did_not_end_is_measured_again(play: Callable, parts: Callable, tmp_path: Path) -> None:
    play({"tests": {"quick": 1, "slow": 2}})
    path = tmp_path / "out" / "tests.json"
    record = parts("records").read_record(path)
    record.rows["slow"]["ended"], record.state = False, "out of time"
    record.write(path.parent)
    assert play({"tests": {"quick": 1, "slow": 3}})["began"] == ["tests slow"]
    assert figures(json.loads(path.read_text())) == {"quick": 1, "slow": 3}


def test_what_is_of_another_device_is_measured_anew(play: Callable, parts: Callable, tmp_path: Path) -> None:
    play({"limits": {"one": 1}})
    records = parts("records")
    assert records.record_of(tmp_path / "out", "limits", "cpu", "tiny").rows == {"one": {"figure": 1}}
    assert records.record_of(tmp_path / "out", "limits", "cuda", "tiny").rows == {}
    (tmp_path / "out" / "limits.json").write_text('{"half of')
    assert records.record_of(tmp_path / "out", "limits", "cpu", "tiny").rows == {}


def call(folder: Path, *options: str) -> subprocess.Popen:
    """Start scripts/gpu on the CPU."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "scripts"), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(
        [sys.executable, "-m", "gpu_parts.call", "--arch", "cpu", "--scale", "tiny", "--out", str(folder), *options],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": path, "PYTHONDONTWRITEBYTECODE": "1"},
    )


def test_a_call_that_was_killed_goes_on(tmp_path: Path) -> None:
    """Environment and limits on the CPU: killed after the first row of limits, the next call has the rest."""
    folder = tmp_path / "out"
    killed = call(folder, "--parts", "environment", "limits")
    for line in killed.stderr:
        if line.startswith("limits, copy"):
            break
    killed.kill()
    killed.communicate()
    before = {name: json.loads((folder / f"{name}.json").read_text()) for name in ("environment", "limits")}
    assert before["environment"]["state"] == "done" and before["limits"]["state"] == "out of time"
    assert "copy" in before["limits"]["rows"]
    resumed = tmp_path / "resumed"
    going_on = call(resumed, "--parts", "environment", "limits", "--resume", str(folder))
    report, progress = going_on.communicate(timeout=240)
    assert going_on.returncode == 0, progress
    assert not [line for line in progress.splitlines() if line.startswith(("environment, ", "limits, copy"))]
    after = {name: json.loads((resumed / f"{name}.json").read_text()) for name in ("environment", "limits")}
    assert after["environment"] == before["environment"]
    assert after["limits"]["rows"]["copy"] == before["limits"]["rows"]["copy"]
    assert len(after["limits"]["rows"]) == 11 and after["limits"]["state"] == "done"
    assert all(row["right"] for key, row in after["limits"]["rows"].items() if "launch" not in key)
    assert report.startswith("### Environment\n") and "| launch, 16 loops |" in report
    assert "Not measured: Tests marked gpu, Agreement with the CPU, Speed, " in report
    # Nothing but the parts and the report.
    assert sorted(path.name for path in resumed.iterdir()) == ["environment.json", "limits.json", "report.md"]


def test_a_call_that_is_ended_ends_its_parts(tmp_path: Path) -> None:
    ended = call(tmp_path / "out", "--parts", "limits")
    for line in ended.stderr:
        if line.startswith("limits, copy"):
            break
    children = psutil.Process(ended.pid).children()
    ended.send_signal(signal.SIGTERM)
    ended.communicate(timeout=60)
    assert children and not any(child.is_running() for child in children)


@pytest.mark.parametrize(
    "arch", [pytest.param("cpu", marks=pytest.mark.slow), pytest.param(GPU, marks=pytest.mark.gpu)]
)
def test_rounding_is_agreement(parts: Callable, arch: str, tmp_path: Path) -> None:
    """Five steps of the fluid: the same bytes on the CPU, and on a GPU as far apart as rounding puts them."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "scripts"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, "-m", "gpu_parts", "agreement", arch, "tiny", "100", ""],
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    assert done.returncode == 0, done.stderr
    row = json.loads(done.stdout.splitlines()[-1])["row"]
    assert row["agrees"] and row["steps"] == 5 and row["particles"] == 5184
    assert (row["largest_m"] == 0) == (arch == "cpu")
    far = row | {"agrees": False, "largest_m": 0.1}
    assert parts("agreement").section({"fluid": far}).endswith("| **no** |")


class FakeWorker:
    """A contestant that takes 2 steps in a second, but for "solid", which fails at the command that it is told."""

    def __init__(self, who: str, fails_at: str) -> None:
        self.who, self.fails_at, self.start_seconds = who, fails_at, 1.5
        self.ready = {"bytes_per_particle": 100, "particles": 300}
        self.closed = False

    def ask(self, command: str) -> dict:
        from mpmcli.errors import RunError

        if self.who == "solid" and command.startswith(self.fails_at):
            raise RunError("The benchmark process stopped: out of memory")
        answers = {"first": {"seconds": 2.5}, "finish": {"sound": True, "smallest_step": 1e-4, "peak_memory": 10}}
        return answers.get(command, {"steps": 2, "seconds": 1.0})

    def __enter__(self) -> "FakeWorker":
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True


@pytest.mark.parametrize("fails_at", ["first", "run", "finish"])
def test_contestants_are_measured_though_one_fails(
    parts: Callable, monkeypatch: pytest.MonkeyPatch, fails_at: str
) -> None:
    bench, workers = parts("bench"), []
    size = bench.Size(3, 300, 16, 8e-4, ("ours", "solid", "peer"))

    def start(who: str, case: object, setting: object) -> FakeWorker:
        workers.append(FakeWorker(who, fails_at))
        return workers[-1]

    monkeypatch.setattr(bench, "start_worker", start)
    row = bench.compare(size, "cpu", 0.1)
    assert row["contestants"]["ours"]["rates"] == [600.0] * bench.BLOCKS == row["contestants"]["peer"]["rates"]
    assert row["contestants"]["solid"]["error"].endswith("out of memory")
    assert len(workers) == 3 and all(worker.closed for worker in workers)
    lines = bench.section({size.key: row}).splitlines()
    assert lines[2].startswith("| 3D 300 | 16 | fluid | 0.0006 | 0.0006 to 0.0006 | 1.00 | 100, - | 1.5 + 2.5 | yes |")
    assert "out of memory" in lines[3] and "`mpm3d`" in lines[4]


def test_launches_are_told_by_their_share(parts: Callable) -> None:
    launches = [{"name": "step_2", "launches": 1.0, "us": 90.0}, {"name": "sort", "launches": 0.1, "us": 1.0}]
    text = parts("bench").section({"profile 3D 300 ours": {"us": 91.0, "launches": launches}})
    assert text.endswith("| profile 3D 300 ours | `step_2` | 1 | 90.0 | 99% |")


def test_a_size_without_room_is_left_out(parts: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = parts("bench")
    size = bench.Size(3, 100_000_000, 512, 2e-5, ("ours",))
    monkeypatch.setattr(bench, "free_memory", lambda arch: 10**10)
    assert bench.no_room(size, "cuda").endswith("on the device, where 10 GB are free.")
    monkeypatch.setattr(bench, "free_memory", lambda arch: 10**12)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(total=10**10))
    assert bench.no_room(size, "cuda") == "it needs 25 GB of the machine, which has 10 GB."
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(total=10**12))
    assert bench.no_room(size, "cuda") == ""
    skipped = {"3D 100,000,000 ours": {"skipped": "it needs 25 GB."}}
    assert len(parts("largest").section(skipped).splitlines()) == 2


def test_sizes_fit_32_bit_indices(parts: Callable) -> None:
    from mpmcli.solver.machine.device_memory import LARGEST_INDEX

    for size in (*parts("bench").FULL, parts("largest").FULL):
        # Numbers of a particle in a frame: place, velocity, volume, energy and six of a stress, and a little more.
        assert size.particles * 16 < LARGEST_INDEX
        assert (size.cells + 6) ** size.dimension < LARGEST_INDEX
        # Particles of a cell, and waves of 20 m/s in a step.
        filled = size.particles / (0.4 * size.cells) ** size.dimension
        assert 4 < filled < 15 and 20 * size.step * size.cells < 0.6


OUTPUT = """\
tests/test_a.py::test_one[2D, water] PASSED                              [ 33%]
[gw1] [ 66%] FAILED tests/test_a.py::test_two[a b]
[gw0] [100%] SKIPPED tests/test_b.py::test_three
FAILED tests/test_a.py::test_two[a b] - AssertionError: assert 1 == 2
SKIPPED [1] tests/test_b.py:7: no cuda device here: signal 11
"""


def test_the_output_of_pytest_is_read(parts: Callable) -> None:
    found = parts("tests").read_output(OUTPUT)
    assert found["counts"] == {"passed": 1, "failed": 1, "skipped": 1}
    assert found["failed"] == ["tests/test_a.py::test_two[a b]"]
    assert found["reasons"] == OUTPUT.splitlines()[3:]
    row = found | {"seconds": 12.3, "ended": False, "status": 1}
    text = parts("tests").section({"quick": row})
    assert "| quick | 1 passed, 1 failed, 1 skipped | 12, ended by time |" in text
    assert "* `FAILED tests/test_a.py::test_two[a b] - AssertionError: assert 1 == 2`" in text
    assert parts("tests").read_output("ERROR: no module\n")["said"] == ["ERROR: no module"]
    begun = "==== test session starts ====\nplatform linux -- Python 3.11 -- /opt/python\nrootdir: /home/me\nno tests\n"
    assert parts("tests").read_output(begun)["said"] == ["no tests"]


def test_every_file_with_tests_of_a_gpu_is_found(parts: Callable) -> None:
    files = parts("tests").gpu_files()
    assert "tests/test_batch_gpu.py" in files and "tests/test_solver_paths.py" in files
    assert "tests/test_plan.py" not in files and "tests/test_gpu_script.py" not in files


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["cpu", pytest.param(GPU, marks=pytest.mark.gpu)])
def test_every_part_measures(arch: str, tmp_path: Path) -> None:
    """All parts at the smallest size, the shell script included."""
    folder = tmp_path / "out"
    command = [ROOT / "scripts" / "gpu", "--arch", arch, "--scale", "tiny", "--out", folder, "--budget", "900"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == (folder / "report.md").read_text() and "not measured" not in done.stdout.lower()
    records = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    assert len(records) == 7 and all(record["state"] == "done" for record in records.values())
    assert records["tests"]["rows"]["quick"]["counts"] == {"passed": 1}
    for part in ("bench", "largest"):
        for key, row in records[part]["rows"].items():
            if key.startswith("profile"):
                assert row["us"] > 0 and row["launches"]
                continue
            assert all(one["sound"] and min(one["rates"]) > 0 for one in row["contestants"].values())


@pytest.mark.gpu
@pytest.mark.slow
def test_runs_at_once_are_counted(parts: Callable, tmp_path: Path) -> None:
    datasets = parts("datasets")
    row = datasets.together(2, 1, GPU)
    assert (row["runs"], row["completed"], row["stable"], row["particles"]) == (2, 2, 2, 1444)
    assert row["steps"] == 10
    from mpmcli.solver.machine.backend import stop_backend

    stop_backend()
