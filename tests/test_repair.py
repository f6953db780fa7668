"""`mpmcli repair`: what is sound of a broken run becomes one file, and nothing else is lost by it."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from made_result import made_frame, made_header, made_row, write_made
from test_checksums import flip, place_of

from mpmcli.errors import InputError, RunError
from mpmcli.output import SegmentStore, open_result, pack, repair
from mpmcli.output.run_record import RECORD, RunRecord
from mpmcli.output.segments import DAMAGED, PACKED, SEGMENTS, sealed_segments


@pytest.fixture
def died(tmp_path, monkeypatch) -> Path:
    """A run of nine frames that was killed: three segments of three frames, and half of a fourth."""
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    directory = tmp_path / "died"
    directory.mkdir()
    store = SegmentStore(directory, made_header(2), hold=np.inf)
    for k in range(9):
        store.write(made_frame(k, 2), made_row(k, 2))
        if k % 3 == 2:
            store.seal()
    (directory / SEGMENTS / "frame_000009.vtkhdf.tmp").write_bytes(b"\x89HDF torn")
    return directory


def assert_holds(directory: Path, count: int) -> None:
    result = open_result(directory)
    assert (result.kind, result.frame_count) == ("packed", count)
    assert result.ledger == [made_row(k, 2) for k in range(count)]
    for k, frame in enumerate(result.frames()):
        assert (frame.index, frame.time, frame.step) == (k, made_frame(k, 2).time, 10 * k)
        np.testing.assert_array_equal(frame.position, made_frame(k, 2).position)


def files_of(directory: Path) -> dict[str, bytes]:
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def test_the_segments_of_a_run_that_died_become_the_file_of_one_that_ended(died, tmp_path):
    outcome = run_here("repair", died, "--json")
    told = json.loads(outcome.stdout)
    assert outcome.status == 0 and told["ok"] and (told["frames"], told["packed"]) == (9, 3)
    assert_holds(died, 9)
    assert sorted(files_of(died)) == [PACKED, "scene.toml"]
    assert (died / "scene.toml").read_text(encoding="utf-8") == made_header(2)["scene"]
    write_made(tmp_path / "ended", frames=9)
    assert (died / PACKED).read_bytes() == (tmp_path / "ended" / PACKED).read_bytes()
    # Once more there is nothing to do.
    before = files_of(died)
    again = run_here("repair", died)
    assert again.status == 0 and "nothing to repair" in again.stdout and files_of(died) == before


@pytest.mark.parametrize("record", [None, "torn", "true"])
def test_it_works_without_the_record(died, record):
    if record == "true":
        RunRecord(died, frames_expected=12, frames_written=9).write()
    elif record:
        (died / RECORD).write_text('{"program": "mpm', encoding="utf-8")
    outcome = run_here("repair", died / SEGMENTS)
    assert outcome.status == (1 if record == "torn" else 0)
    assert ("run.json is damaged" in outcome.stdout) == (record == "torn")
    assert_holds(died, 9)


def test_frames_before_a_hole_are_kept_and_the_rest_is_named_and_left(died):
    segments = sealed_segments(died)
    segments[1].unlink()
    last = segments[2].read_bytes()
    outcome = run_here("repair", died)
    assert outcome.status == 1
    assert "Frames 3 to 5 are missing" in outcome.stdout
    assert "Frames 6 to 8 are sound, but after a hole" in outcome.stdout
    assert_holds(died, 3)
    assert sealed_segments(died) == [segments[2]] and segments[2].read_bytes() == last


def test_sound_frames_of_a_damaged_segment_are_kept(died):
    segment = sealed_segments(died)[1]
    flip(segment, place_of(segment, "VTKHDF/PointData/velocity", 2 * 4 + 1))
    content = segment.read_bytes()
    outcome = run_here("repair", died)
    assert outcome.status == 1 and "velocity of frame 5 has changed" in outcome.stdout
    assert "Frames 6 to 8 are sound" in outcome.stdout
    assert_holds(died, 5)
    assert [path.name for path in sealed_segments(died)] == ["frame_000003.vtkhdf", "frame_000006.vtkhdf"]
    assert segment.read_bytes() == content


def test_a_damaged_table_that_frames_do_not_need_costs_no_frame(died):
    segment = sealed_segments(died)[1]
    flip(segment, place_of(segment, "VTKHDF/Steps/CellOffsets", 1))
    outcome = run_here("repair", died)
    assert outcome.status == 0 and "CellOffsets" in outcome.stdout
    assert_holds(died, 9)
    assert not sealed_segments(died)


def test_a_damaged_packed_file_keeps_its_frames_before_the_damage(tmp_path):
    write_made(tmp_path)
    flip(tmp_path / PACKED, place_of(tmp_path / PACKED, "VTKHDF/Points", 4 * 4 + 2))
    content = (tmp_path / PACKED).read_bytes()
    outcome = run_here("repair", tmp_path)
    assert outcome.status == 1 and "Points of frame 4 has changed" in outcome.stdout and DAMAGED in outcome.stdout
    assert_holds(tmp_path, 4)
    assert (tmp_path / DAMAGED).read_bytes() == content


def test_a_damaged_packed_file_beside_its_segments_is_packed_again(died):
    """As if the run was killed between the two, and the packed file damaged since."""
    sound = files_of(died)
    run_here("repair", died)
    packed = (died / PACKED).read_bytes()
    for name, content in sound.items():
        (died / name).parent.mkdir(exist_ok=True)
        (died / name).write_bytes(content)
    (died / PACKED).write_bytes(packed[:500])
    outcome = run_here("repair", died)
    assert outcome.status == 0, outcome.stdout
    assert_holds(died, 9)
    assert (died / PACKED).read_bytes() == packed


def test_nothing_is_removed_unless_the_new_file_reads_back(died, monkeypatch):
    before = files_of(died)

    def corrupt(path: Path) -> None:
        with h5py.File(path, "r+") as file:
            file["VTKHDF/Points"][3, 0] += 1

    monkeypatch.setattr(pack, "sync_file", corrupt)
    with pytest.raises(RunError, match="does not read back"):
        repair.repair(died)
    assert files_of(died) == before


@pytest.mark.parametrize("what", ["empty", "no directory", "all damaged", "nothing"])
def test_where_there_is_nothing_to_keep_nothing_is_changed(died, tmp_path, what):
    path = died
    if what == "all damaged":
        for segment in sealed_segments(died):
            segment.write_bytes(segment.read_bytes()[:300])
    elif what == "empty":
        shutil.rmtree(died / SEGMENTS)
    else:
        path = tmp_path / "nothing"
        if what == "no directory":
            path.write_text("mine")
    before = files_of(tmp_path)
    with pytest.raises(InputError):
        repair.repair(path)
    assert files_of(tmp_path) == before


def test_a_series_is_said_to_be_sound_or_named(tmp_path):
    write_made(tmp_path, "series")
    assert run_here("repair", tmp_path).status == 0
    flip(tmp_path / "particles_000001.vtu", 600)
    outcome = run_here("repair", tmp_path)
    assert (
        outcome.status == 1
        and "particles_000001.vtu" in outcome.stdout
        and "A series is not repaired" in outcome.stdout
    )
