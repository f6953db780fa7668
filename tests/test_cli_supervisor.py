"""The parent process: codes, signals, and the end by force of a child that attends to nothing."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from command import ROOT, SCENE, started

from mpmcli.cli.supervisor import may_supervise

# Work that no signal ends, as C code is, in which Python attends to none.
DEAF = "import time; time.sleep(600)"
PROGRAM = """
import os, signal, sys
from pathlib import Path
from mpmcli.cli import supervisor
from mpmcli.cli.interrupt import catch_interrupts
supervisor.PATIENCE, supervisor.LITTLE = {patience}, 0.2

def work():
    catch_interrupts()
    signal.pthread_sigmask(signal.SIG_BLOCK, range(1, 16))
    {before}
    print(os.getpid(), flush=True)
    {work}
    return 0

sys.exit(supervisor.supervise(work))
"""


def begin(work: str, before: str = "pass", patience: float = 0.5) -> tuple[subprocess.Popen[str], int]:
    """Start a supervised process; return it, and the number of its child."""
    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(work=work, before=before, patience=patience)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
    )
    return process, int(process.stdout.readline())


def lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False


def wait_for(what: Callable[[], bool]) -> None:
    until = time.monotonic() + 60
    while not what():
        assert time.monotonic() < until
        time.sleep(0.02)


def test_the_code_of_the_work_is_that_of_the_process() -> None:
    process, _ = begin("return 7")
    assert process.communicate() == ("", "") and process.returncode == 7


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 143)])
def test_a_child_that_hears_nothing_is_ended(number: signal.Signals, code: int) -> None:
    process, child = begin(DEAF)
    time.sleep(0.3)
    process.send_signal(number)
    _, stderr = process.communicate()
    assert (process.returncode, stderr) == (code, "interrupted\n") and not lives(child)


def test_a_second_signal_does_not_wait() -> None:
    """With a patience of an hour."""
    process, child = begin(DEAF, patience=3600)
    time.sleep(0.3)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.3)
    process.communicate(timeout=60)
    assert process.returncode == 130 and not lives(child)


def test_the_result_of_a_child_that_was_ended_is_closed(tmp_path: Path) -> None:
    """A run without a frame leaves nothing, not even the directories made for it."""
    before = (
        f"place = Path({str(tmp_path)!r}) / 'a' / 'b'; supervisor.announce(place, []); "
        "from mpmcli.output import RunRecord; from mpmcli.output.directory import take_directory; "
        "take_directory(place, False); RunRecord(place).write()"
    )
    process, _ = begin(DEAF, before, patience=0.5)
    assert (tmp_path / "a/b/run.json").exists()
    process.send_signal(signal.SIGTERM)
    process.communicate()
    assert process.returncode == 143 and list(tmp_path.iterdir()) == []


def test_a_crash_is_a_sentence() -> None:
    process, _ = begin("signal.pthread_sigmask(signal.SIG_SETMASK, []); os.kill(os.getpid(), signal.SIGSEGV)")
    _, stderr = process.communicate()
    assert process.returncode == 1
    assert stderr == "error: the process crashed (SIGSEGV); what it had reported is kept.\n"


def test_a_kill_of_one_of_both_ends_both() -> None:
    process, child = begin(DEAF)
    os.kill(child, signal.SIGKILL)
    _, stderr = process.communicate()
    assert process.returncode == -signal.SIGKILL and "was killed (SIGKILL)" in stderr
    process, child = begin(DEAF)
    process.kill()
    # The pipes stay open for as long as the child has them.
    process.communicate(timeout=60)
    wait_for(lambda: not lives(child))


def test_an_early_interrupt_leaves_no_directory(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    with started(tmp_path, "simulate", "scene.toml", "-o", "results/drop") as process:
        wait_for(lambda: len(psutil.Process(process.pid).children()) == 1)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130 and sorted(tmp_path.iterdir()) == [tmp_path / "scene.toml"]


def test_a_second_writer_is_refused_and_spoils_nothing(tmp_path: Path) -> None:
    """The first one, as it goes on, does not notice."""
    from mpmcli.output import open_result

    long = SCENE.replace("end = 0.05", "end = 5000.0").replace("frames = 4", "frames = 2000")
    (tmp_path / "scene.toml").write_text(long, encoding="utf-8")
    words = ("simulate", "scene.toml", "-o", "result", "--overwrite")
    with started(tmp_path, *words) as one:
        wait_for(lambda: list((tmp_path / "result" / "segments").glob("*.vtkhdf")) != [])
        (child,) = psutil.Process(one.pid).children()
        with started(tmp_path, *words) as other:
            _, refusal = other.communicate()
        assert other.returncode == 2 and f"result is being written by process {child.pid} on " in refusal
        assert open_result(tmp_path / "result").status == "running"
        one.send_signal(signal.SIGINT)
        one.communicate()
    assert one.returncode == 130
    result = open_result(tmp_path / "result")
    assert result.status == "interrupted" and result.frame_count == result.record["frames_written"] > 0


def test_only_long_commands_have_a_parent() -> None:
    assert may_supervise(["simulate", "scene.toml"]) and may_supervise(["-x", "sweep", "x"])
    for words in (
        [],
        ["check", "x"],
        ["simulate", "--help"],
        ["--debug", "simulate", "x"],
        ["simulate", "x", "--debug"],
    ):
        assert not may_supervise(words)
