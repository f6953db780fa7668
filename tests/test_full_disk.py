"""Disks that fill up, by a limit on the size of files or a small file system: a sentence, and nothing half written."""

import json
import os
import resource
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from command import ROOT, SCENE, run_here
from scenes import slow

from mpmcli.output import open_result
from mpmcli.render.image_files import read_image

# Each frame takes 14 kB.
MANY = SCENE.replace("end = 0.05", "end = 0.5").replace("frames = 4", "frames = 40")


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished run of 41 frames."""
    directory = tmp_path_factory.mktemp("whole")
    (directory / "scene.toml").write_text(MANY, encoding="utf-8")
    assert run_here("simulate", directory / "scene.toml", "-o", directory / "run", "-q").status == 0
    return directory


def run_limited(directory: Path, limit: int | None, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command in which no file may have more bytes than `limit`."""

    def restrict() -> None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    return subprocess.run(
        [sys.executable, "-m", "mpmcli", *map(str, words)],
        cwd=directory,
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        preexec_fn=restrict,
    )


def check_stop(directory: Path, truth: Path, outcome: subprocess.CompletedProcess[str]) -> int:
    """Check that a run which found no room says so, and holds what it counted; return the number of its frames."""
    assert outcome.returncode == 1 and "Traceback" not in outcome.stderr, (outcome.returncode, outcome.stderr)
    error = outcome.stderr.strip().splitlines()[-1]
    assert error.startswith("error: ") and error.endswith("."), outcome.stderr
    left = [path.name for path in directory.rglob("*") if path.is_file()]
    assert not [name for name in left if name.endswith((".tmp", ".lock"))]
    if "run.json" not in left:
        assert left == []
        return 0
    record = json.loads((directory / "run.json").read_text(encoding="utf-8"))
    assert record["status"] == "stopped" and record["failure"]["message"] in error
    count = record["frames_written"]
    if count:
        result, expected = open_result(directory), open_result(truth)
        assert result.frame_count == count
        for k in range(count):
            assert np.array_equal(result.frame(k).position, expected.frame(k).position)
    return count


@pytest.mark.parametrize("limit", [300_000, *(slow(round(300 * 1.2**k)) for k in range(45))])
def test_a_limit_on_the_size_of_files_stops_a_run(whole: Path, tmp_path: Path, limit: int) -> None:
    size = (whole / "run" / "particles.vtkhdf").stat().st_size
    outcome = run_limited(whole, limit, "simulate", "scene.toml", "-o", tmp_path / "result", "-q")
    if limit > 1.2 * size:
        assert outcome.returncode == 0
    else:
        assert check_stop(tmp_path / "result", whole / "run", outcome) * size / 41 <= limit


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """Return what makes a file system with so many free bytes; skip where none can be mounted."""
    place = tmp_path / "disk"
    place.mkdir()
    options = ["mount", "-t", "tmpfs", "-o", "size=32m", "tmpfs", str(place)]
    try:
        mounted = subprocess.run(options, capture_output=True).returncode == 0
    except OSError:
        mounted = False
    if not mounted:
        pytest.skip("no file system can be mounted here")

    def leave(free: int) -> Path:
        (place / "filling").unlink(missing_ok=True)
        stat = os.statvfs(place)
        (place / "filling").write_bytes(bytes(max(0, stat.f_bavail * stat.f_frsize - free)))
        return place

    try:
        yield leave
    finally:
        subprocess.run(["umount", str(place)], check=True)


def files_in(place: Path) -> list[str]:
    return sorted(path.name for path in place.rglob("*") if path.is_file() and path.name != "filling")


@pytest.mark.slow
def test_a_small_disk_stops_a_run(whole: Path, small_disk: Callable[[int], Path]) -> None:
    place = small_disk(17_000_000)
    outcome = run_limited(whole, None, "simulate", "scene.toml", "-o", place / "result", "-q")
    check_stop(place / "result", whole / "run", outcome)


@pytest.mark.slow
def test_a_full_disk_takes_no_run(whole: Path, small_disk: Callable[[int], Path]) -> None:
    """Not even the lock can be written."""
    place = small_disk(0)
    outcome = run_limited(whole, None, "simulate", "scene.toml", "-o", place / "result", "-q")
    assert outcome.returncode == 2 and "No space left" in outcome.stderr
    assert not (place / "result").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["export", "run", "--to", "npz", "-o", "DISK/exported"],
        slow(["export", "run", "--to", "vtkhdf", "-o", "DISK/exported"]),
        slow(["plot", "run", "-o", "DISK/ledger.png"]),
    ],
    ids=["npz", "vtkhdf", "plot"],
)
def test_a_full_disk_leaves_no_half_files(whole: Path, small_disk: Callable[[int], Path], words: list[str]) -> None:
    place = small_disk(4096)
    outcome = run_limited(whole, None, *(word.replace("DISK", str(place)) for word in words))
    assert outcome.returncode == 1 and "Traceback" not in outcome.stderr
    assert outcome.stderr.startswith("error: ") and "free some space" in outcome.stderr
    assert files_in(place) == []


@pytest.mark.parametrize("form", ["vtkhdf", *(slow(f) for f in ("npz", "lagrangebench", "zarr", "webdataset"))])
def test_an_export_above_the_limit_of_files_leaves_nothing(whole: Path, tmp_path: Path, form: str) -> None:
    outcome = run_limited(whole, 20_000, "export", "run", "--to", form, "-o", tmp_path / "exported")
    assert outcome.returncode == 1 and "File too large" in outcome.stderr, outcome.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("free", [4096, 300_000])
def test_a_disk_that_fills_up_with_images(
    whole: Path, small_disk: Callable[[int], Path], free: int, drawing: str
) -> None:
    """Those that are finished stay, and are whole."""
    place = small_disk(free)
    outcome = run_limited(whole, None, "render", "run", "--cameras", "--workers", "1", "-o", place / "images")
    assert outcome.returncode == 1 and "Traceback" not in outcome.stderr
    assert outcome.stderr.splitlines()[-1].startswith("error: ") and "free some space" in outcome.stderr
    left = [path for path in place.glob("images/**/*.*") if path.name != "cameras.json"]
    assert bool(left) == (free > 100_000)
    for path in left:
        read_image(path, path.name.partition("_")[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["frames.mp4", "frames.gif"])
def test_a_film_on_a_full_disk(whole: Path, small_disk: Callable[[int], Path], name: str, drawing: str) -> None:
    place = small_disk(4096)
    words = ["--frame", "0:4", "--size", "160x120", "--workers", "1", "--movie", place / name]
    outcome = run_limited(whole, None, "render", "run", *words)
    assert outcome.returncode == 1 and "No space left on device" in outcome.stderr
    assert "free some space" in outcome.stderr and files_in(place) == []
