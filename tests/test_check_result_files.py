"""A result whose files are cut off, lost, mixed up or doubled: what can be read is checked, and the rest is named."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from changed_result import changed
from result_copies import StoredRun, real_run
from test_check_result import rules, the

from mpmcli.check import result_check
from mpmcli.check.result_check import check_result
from mpmcli.errors import InputError
from mpmcli.output.layout import PACKED, SEGMENTS, segment_name
from mpmcli.output.run_record import RECORD

K = 6


@pytest.fixture(scope="module")
def run() -> StoredRun:
    return real_run()


@pytest.fixture
def packed(run: StoredRun, tmp_path: Path) -> Path:
    return shutil.copytree(run.directory, tmp_path / "packed_copy")


@pytest.fixture
def segments(run: StoredRun, tmp_path: Path) -> Path:
    return run.write(tmp_path / "segments_copy", "segments")


def cut(path: Path, part: float) -> None:
    """Cut a file off behind this part of it."""
    content = path.read_bytes()
    path.write_bytes(content[: int(part * len(content))])


@pytest.mark.parametrize("part", [0.0, 0.001, 0.5, 0.999])
def test_a_packed_file_that_is_cut_off(packed, part):
    """HDF5 refuses a file that ends before its superblock says so: no frame of it can be read."""
    cut(packed / PACKED, part)
    for path in (packed, packed / PACKED):
        check = check_result(path)
        assert rules(check) == {"unreadable"} and check.verdict == "unstable"
        assert (check.first_bad_frame, check.frames, check.frames_expected) == (0, 0, 11)
        assert PACKED in check.findings[0].what
    json.dumps(check.as_dict(), allow_nan=False)
    assert check.text().endswith(check.findings[0].line)


def test_a_packed_file_without_its_record(packed):
    (packed / RECORD).unlink()
    check = check_result(packed)
    assert rules(check) == {"no-record"} and check.verdict == "stable" and check.status == "unknown"
    cut(packed / PACKED, 0.5)
    with pytest.raises(InputError, match="is not an HDF5 file, or a damaged one"):
        check_result(packed / PACKED)


@pytest.mark.parametrize("part", [0.0, 0.5, 0.99])
def test_a_segment_that_is_cut_off(segments, part):
    cut(segments / SEGMENTS / segment_name(K), part)
    check = check_result(segments)
    assert rules(check) == {"unreadable"} and check.verdict == "unstable"
    assert (check.first_bad_frame, check.frames) == (K, 10)
    assert f"frame {K} cannot be read" in check.findings[0].what


@pytest.mark.parametrize("gone", [(0,), (K,), (10,), (2, 3, K)])
def test_segments_that_are_missing(segments, gone):
    for k in gone:
        (segments / SEGMENTS / segment_name(k)).unlink()
    check = check_result(segments)
    finding = the(check, "missing-frames")
    assert rules(check) == {"missing-frames"} and check.frames == 11 - len(gone)
    assert finding.frame == check.first_bad_frame == gone[0] and finding.value == len(gone)


def test_a_frame_at_a_wrong_time(packed, segments):
    """As of a segment under two names."""
    shutil.copy(segments / SEGMENTS / segment_name(K - 1), segments / SEGMENTS / segment_name(K))
    checks = [check_result(segments)]
    for time in (0.1201, 0.0801, np.nan):
        with changed(packed / PACKED) as file:
            file["VTKHDF/Steps/Values"][K] = time
        checks.append(check_result(packed))
    for check in checks:
        assert rules(check) == {"frame-time"} and check.verdict == "unstable"
        assert the(check, "frame-time").frame == check.first_bad_frame == K


def test_a_run_that_is_packed_while_it_is_checked(run, segments, monkeypatch):
    real = result_check.check_order

    def packed_meanwhile(*arguments: object) -> None:
        shutil.copy(run.directory / PACKED, segments / PACKED)
        shutil.rmtree(segments / SEGMENTS, ignore_errors=True)
        real(*arguments)

    monkeypatch.setattr(result_check, "check_order", packed_meanwhile)
    check = check_result(segments)
    assert (check.kind, check.verdict) == ("packed", "stable")


@pytest.mark.parametrize("compressed", [False, True])
def test_a_damaged_frame_is_one_frame_and_not_the_whole(run, packed, compressed):
    """A value that has changed since; and a compressed chunk, of a frame each, that does not decompress."""
    path, name = packed / PACKED, "VTKHDF/PointData/density"
    if compressed:
        with changed(path) as file:
            values = file[name][:]
            del file[name]
            file.create_dataset(name, data=values, chunks=(run.particles,), compression="gzip")
            place = file[name].id.get_chunk_info(K)
        with path.open("r+b") as file:
            file.seek(place.byte_offset)
            file.write(b"\xff" * place.size)
    else:
        with h5py.File(path, "r+") as file:
            file[name][K * run.particles + 3] *= 2
    check = check_result(packed)
    assert rules(check) == {"unreadable"} and (check.first_bad_frame, check.frames) == (K, 10)


@pytest.mark.parametrize(
    ("status", "rule", "verdict"),
    [
        ("running", "running", "suspect"),
        ("interrupted", "interrupted-run", "suspect"),
        ("stopped", "stopped-run", "suspect"),
        ("failed", "failed-run", "unstable"),
        ("unstable", "unstable-run", "unstable"),
        ("finished", "missing-frames", "unstable"),
    ],
)
def test_a_run_that_did_not_come_to_its_end(segments, status, rule, verdict):
    for k in range(K, 11):
        (segments / SEGMENTS / segment_name(k)).unlink()
    record = json.loads((segments / RECORD).read_text(encoding="utf-8"))
    record |= {"status": status, "failure": {"message": "the disk was full.", "limit": "deformation"}}
    (segments / RECORD).write_text(json.dumps(record), encoding="utf-8")
    check = check_result(segments / SEGMENTS)
    assert rules(check) == {rule} and check.verdict == verdict and check.status == status
    assert (check.first_bad_frame, check.frames, check.frames_expected) == (K, K, 11)
    assert check.limit == "deformation"
    assert ("the disk was full." in check.findings[0].what) == (status in ("stopped", "failed", "unstable"))


@pytest.mark.parametrize("emptied", [False, True])
def test_a_run_without_a_frame_that_can_be_read(segments, emptied):
    """None was written, or all are damaged."""
    for segment in (segments / SEGMENTS).iterdir():
        segment.write_bytes(b"")
    if not emptied:
        shutil.rmtree(segments / SEGMENTS)
    check = check_result(segments)
    assert (check.verdict, check.frames, check.first_bad_frame) == ("unstable", 0, 0)


def test_what_is_no_result_is_bad_input(packed, tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.vtkhdf").write_text("notes")
    with h5py.File(tmp_path / "foreign.vtkhdf", "w") as file:
        file["x"] = np.zeros(3)
    for name in ("missing", "empty", "notes.vtkhdf", "foreign.vtkhdf"):
        with pytest.raises(InputError):
            check_result(tmp_path / name)
    with changed(packed / PACKED) as file:
        file["mpmcli"].attrs["format"] = 99
    with pytest.raises(InputError, match="has format 99"):
        check_result(packed)
