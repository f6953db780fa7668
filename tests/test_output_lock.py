"""The lock of a directory: one writer, named; taken over from a process that has ended and from no other."""

import json
import os
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from mpmcli.errors import InputError
from mpmcli.output import RunRecord
from mpmcli.output.directory import take_directory
from mpmcli.output.lock import LOCK, NO_LOCKS, Owner, lock_is_held, process_start, take_lock
from mpmcli.output.run_record import DIED, ELSEWHERE, read_record, run_status

HOLD = """
import sys
from pathlib import Path
from mpmcli.output.lock import take_lock
lock = take_lock(Path(sys.argv[1]))
print("held", flush=True)
sys.stdin.read()
"""


def hold(directory: Path) -> subprocess.Popen[str]:
    """Let another process take the lock of a directory, until its stdin is closed or it is killed."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(directory)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    return process


def told(**changes: object) -> str:
    """Return what a lock file of this process tells, with changes."""
    return json.dumps({"machine": "node7", "since": "2026-01-01T00:00:00+00:00", **asdict(Owner.here()), **changes})


def test_the_holder_is_named_and_nothing_changes(tmp_path: Path) -> None:
    (tmp_path / "scene.toml").write_text("title = 'x'\n", encoding="utf-8")
    RunRecord(tmp_path).write()
    with hold(tmp_path) as process:
        before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
        for take in (take_lock, lambda place: take_directory(place, overwrite=True)):
            with pytest.raises(InputError, match=rf"being written by process {process.pid} on .* since 20"):
                take(tmp_path)
        assert lock_is_held(tmp_path)
        assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
        process.stdin.close()
        process.wait()
    # It ended without releasing, so the file is there, and is taken over.
    assert (tmp_path / LOCK).exists() and not lock_is_held(tmp_path)
    with take_lock(tmp_path):
        assert json.loads((tmp_path / LOCK).read_text(encoding="utf-8"))["pid"] == os.getpid()
    assert not (tmp_path / LOCK).exists()


def test_a_killed_holder_does_not_keep_the_directory(tmp_path: Path) -> None:
    process = hold(tmp_path)
    process.kill()
    process.wait()
    process.stdin.close()
    process.stdout.close()
    take_directory(tmp_path, overwrite=False).release()
    assert list(tmp_path.iterdir()) == []


def test_a_symbolic_link_is_not_followed(tmp_path: Path) -> None:
    """Neither as the lock nor as the temporary name of a file: what it points to stays as it is."""
    target, place = tmp_path / "precious", tmp_path / "place"
    target.write_text("mine", encoding="utf-8")
    place.mkdir()
    (place / LOCK).symlink_to(target)
    with pytest.raises(InputError, match=r"run\.lock is a symbolic link, .*: remove it"):
        take_lock(place)
    (place / "run.json.tmp").symlink_to(target)
    RunRecord(place).write()
    assert target.read_text(encoding="utf-8") == "mine" and (place / LOCK).is_symlink()
    assert sorted(path.name for path in place.iterdir()) == ["run.json", LOCK]


@pytest.mark.parametrize("code", NO_LOCKS)
def test_a_file_system_without_locks_is_no_obstacle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int) -> None:
    """As NFS and Lustre answer where they are mounted without: the process in the file counts, if it lives."""

    def no_lock(*_: object) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("mpmcli.output.lock.fcntl.flock", no_lock)
    with hold(tmp_path) as process:
        with pytest.raises(InputError, match=rf"being written by process {process.pid} on"):
            take_lock(tmp_path)
        process.stdin.close()
        process.wait()
    take_lock(tmp_path).close()
    assert list(tmp_path.iterdir()) == []


def test_of_many_that_take_it_at_once_one_has_it_at_any_time(tmp_path: Path) -> None:
    """Each writes its number into a file while it has the lock, and looks whether it is still there."""
    work = """
import os, sys, time
from pathlib import Path
from mpmcli.errors import InputError
from mpmcli.output.lock import take_lock
place, taken = Path(sys.argv[1]), 0
until = time.monotonic() + 2
while time.monotonic() < until:
    try:
        lock = take_lock(place)
    except InputError:
        continue
    with lock:
        (place / "inside").write_text(str(os.getpid()))
        time.sleep(0.002)
        assert (place / "inside").read_text() == str(os.getpid()), "two at once"
        taken += 1
print(taken)
"""
    processes = [
        subprocess.Popen([sys.executable, "-c", work, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    counts = [process.communicate()[0] for process in processes]
    assert all(process.returncode == 0 for process in processes)
    assert sum(map(int, counts)) > 10 and not (tmp_path / LOCK).exists()


@pytest.mark.parametrize(
    "changes",
    [{"pid": 2**22 + 1}, {"started": 1.0}, {"boot": "another"}, {"pid": 2**22 + 1, "host": "0" * 16}],
    ids=["no such process", "the number of another process", "before the machine was started anew", "in a container"],
)
def test_a_lock_that_the_system_has_released_is_taken_over(tmp_path: Path, changes: dict) -> None:
    (tmp_path / LOCK).write_text(told(**changes), encoding="utf-8")
    take_directory(tmp_path, overwrite=False).release()


def test_a_lock_of_another_machine_is_respected(tmp_path: Path) -> None:
    text = told(host="0" * 16, boot="another", machine="node7\x1b[31m")
    (tmp_path / LOCK).write_text(text, encoding="utf-8")
    for overwrite in (False, True):
        with pytest.raises(InputError) as caught:
            take_directory(tmp_path, overwrite)
        sentence = str(caught.value)
        assert "on node7?[31m since 2026-01-01T00:00:00+00:00" in sentence
        assert f"if it has, remove {tmp_path / LOCK}" in sentence
    assert (tmp_path / LOCK).read_text(encoding="utf-8") == text


@pytest.mark.parametrize("content", ["", "{", "[]", '{"pid": "x"}', '{"pid": 1, "started": null}', "\x00" * 100])
def test_a_damaged_lock_file_is_no_obstacle(tmp_path: Path, content: str) -> None:
    (tmp_path / LOCK).write_text(content, encoding="utf-8")
    take_lock(tmp_path).close()


def test_the_start_of_a_process_tells_it_from_one_of_the_same_number() -> None:
    assert process_start(os.getpid()) == process_start(os.getpid()) == Owner.here().started
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        assert process_start(child.pid) >= process_start(os.getpid())
        child.kill()
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        # It has ended, though its number is not free yet.
        assert process_start(child.pid) is None


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "running"),
        ({"pid": 2**22 + 1}, DIED),
        ({"started": 1.0}, DIED),
        ({"boot": "another"}, DIED),
        ({"boot": "another", "host": "0" * 16}, ELSEWHERE),
        ({"space": "pid:[1]"}, ELSEWHERE),
    ],
)
def test_a_run_goes_on_while_its_process_lives(tmp_path: Path, changes: dict, expected: str) -> None:
    RunRecord(tmp_path).write()
    record = read_record(tmp_path)
    record["process"] |= changes
    assert run_status(tmp_path, record) == expected
    # Whatever is known of the process, one that has the lock is at work.
    with take_lock(tmp_path):
        assert run_status(tmp_path, record) == "running"
    assert run_status(tmp_path, {**record, "status": "finished"}) == "finished"


def test_of_a_record_without_a_process_nothing_is_claimed(tmp_path: Path) -> None:
    assert run_status(tmp_path, {"status": "running"}) == ELSEWHERE
    assert run_status(tmp_path, None) == "unknown"


def test_no_name_of_a_machine_is_in_the_record(tmp_path: Path) -> None:
    import socket

    RunRecord(tmp_path).write()
    assert len(socket.gethostname()) < 2 or f'"{socket.gethostname()}"' not in (tmp_path / "run.json").read_text()
