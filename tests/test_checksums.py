"""Checksums of results: against zlib and hashlib, independent of how frames were grouped, and compared when read."""

import hashlib
import json
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from made_dataset import made_dataset
from made_result import made_frame, made_header, write_made
from test_output_frames import make_frame
from test_output_frames import make_row as any_row

import mpmcli.dataset
from mpmcli.check.result_check import check_result
from mpmcli.errors import InputError
from mpmcli.output import SegmentStore, open_result
from mpmcli.output.layout import PACKED, sealed_segments

GROUPS = ([12], [1] * 12, [5, 6, 1])


def flip(path: Path, place: int) -> None:
    """Flip one bit of a file."""
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def place_of(path: Path, name: str, row: int) -> int:
    """Return where the last byte of a row of a contiguous array is."""
    with h5py.File(path) as file:
        data = file[name]
        return data.id.get_offset() + (row + 1) * data.dtype.itemsize * int(np.prod(data.shape[1:])) - 1


@pytest.mark.parametrize("compress", [False, True])
def test_the_packed_file_does_not_depend_on_how_frames_were_sealed(tmp_path, monkeypatch, compress):
    """Chunks of 1 MiB hold several frames, and parts of frames."""
    monkeypatch.setattr("os.fsync", lambda descriptor: None)
    frames = [make_frame(k, 9000 if compress else 500, 2) for k in range(12)]
    packed = []
    for number, groups in enumerate(GROUPS):
        directory = tmp_path / str(number)
        directory.mkdir()
        store = SegmentStore(directory, {"scene": "x = 1"}, compress=compress, hold=np.inf)
        k = 0
        for size in groups:
            for frame in frames[k : k + size]:
                store.write(frame, any_row(frame.index, 2))
            store.seal()
            k += size
        assert len(sealed_segments(directory)) == len(groups)
        store.finish()
        packed.append((directory / PACKED).read_bytes())
    assert packed[0] == packed[1] == packed[2]


def test_checksums_are_those_of_zlib(tmp_path):
    """Read by h5py alone, as docs/results.md says."""
    write_made(tmp_path, frames=3)
    content = (tmp_path / PACKED).read_bytes()
    with h5py.File(tmp_path / PACKED) as file:
        data = file["mpmcli/checksums"]
        told = json.loads(data.attrs["list"])
        assert told["arrays"][0] == "VTKHDF/Points" and data.shape == (3, len(told["arrays"]))
        for column, name in enumerate(told["arrays"]):
            for k in range(3):
                assert zlib.crc32(file[name][4 * k : 4 * k + 4].tobytes()) == data[k, column]
        assert zlib.crc32(file["mpmcli"].attrs["header"].encode()) == told["items"]["mpmcli@header"]
        gaps = sorted((file[name].id.get_offset(), file[name].nbytes) for name in told["arrays"])
    body, end = bytearray(content[:-23]), content[-23:]
    for offset, length in reversed(gaps):
        del body[offset : offset + length]
    assert end == b"\nmpmcli crc32 %08x\n" % zlib.crc32(body)


@pytest.mark.parametrize("form", ["packed", "segments"])
def test_a_flipped_bit_is_named_and_never_read(tmp_path, form):
    """It would move a particle by 2e-9 m, which no physics notices."""
    write_made(tmp_path, form)
    path = tmp_path / (PACKED if form == "packed" else "segments/frame_000002.vtkhdf")
    place = place_of(path, "VTKHDF/Points", 8 if form == "packed" else 0) - 11
    sound = run_here("info", tmp_path, "--verify")
    assert sound.status == 0 and sound.stdout.rstrip().endswith(": ok")
    flip(path, place)
    outcome = run_here("info", tmp_path, "--verify", "--json")
    found = json.loads(outcome.stdout)
    assert outcome.status == 1 and not found["ok"] and len(found["faults"]) == 1 and str(path) in found["faults"][0]
    assert "Points of frame 2 has changed" in found["faults"][0]
    result = open_result(tmp_path)
    with pytest.raises(InputError, match="damaged"):
        result.frame(2)
    np.testing.assert_array_equal(result.frame(3).position, made_frame(3, 2).position)
    assert {f.frame for f in check_result(tmp_path).findings if f.rule == "unreadable"} == {2}
    refused = run_here("export", tmp_path, "--to", "npz", "-o", tmp_path / "out")
    assert refused.status == 2 and "damaged" in refused.stderr and not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["ledger/mass", "VTKHDF/Steps/Values", "mpmcli/frame"])
def test_a_table_that_has_changed_is_refused(tmp_path, name):
    write_made(tmp_path)
    flip(tmp_path / PACKED, place_of(tmp_path / PACKED, name, 1) - 7)
    with pytest.raises(InputError, match=f"{name} does not have the checksum"):
        open_result(tmp_path)
    outcome = run_here("info", tmp_path, "--verify")
    assert outcome.status == 1 and name in outcome.stdout
    # A result can be checked all the same.
    assert check_result(tmp_path).verdict == "unstable"


def test_tables_that_only_paraview_reads_are_verified(tmp_path):
    write_made(tmp_path)
    flip(tmp_path / PACKED, place_of(tmp_path / PACKED, "VTKHDF/Steps/CellOffsets", 1))
    assert open_result(tmp_path).frame_count == 6
    outcome = run_here("info", tmp_path, "--verify")
    assert outcome.status == 1 and "VTKHDF/Steps/CellOffsets" in outcome.stdout


def test_bytes_that_are_appended_or_cut_off_are_noticed(tmp_path):
    write_made(tmp_path)
    content = (tmp_path / PACKED).read_bytes()
    for changed in (content + b"x", content[:-1], content[:-23]):
        (tmp_path / PACKED).write_bytes(changed)
        outcome = run_here("info", tmp_path, "--verify")
        assert outcome.status == 1 and "or at its end" in outcome.stdout


def test_a_scene_beside_the_frames_that_was_edited_is_said(tmp_path):
    write_made(tmp_path)
    (tmp_path / "scene.toml").write_text(made_header(2)["scene"], encoding="utf-8")
    assert run_here("info", tmp_path, "--verify").status == 0
    (tmp_path / "scene.toml").write_text("title = 'another'\n", encoding="utf-8")
    outcome = run_here("info", tmp_path, "--verify")
    assert outcome.status == 1 and "scene.toml is not the scene of the frames" in outcome.stdout


def test_a_trajectory_of_a_shard_that_has_changed_is_not_read(tmp_path):
    path = made_dataset(tmp_path / "set")
    shard = path / "shards/00000.h5"
    flip(shard, place_of(shard, "000002/position", 5))
    dataset = mpmcli.dataset.open(path)
    with pytest.raises(InputError, match="position of frame 5 does not have the checksum"):
        _ = dataset[2].position
    # What is asked for is compared, and nothing else.
    assert dataset[2].read("position", slice(0, 5)).shape[0] == 5
    assert dataset[2].velocity.shape == dataset[2].read("velocity").shape
    assert dataset[0].position.shape[0] == 11


def test_checksums_of_exports_are_those_of_hashlib(tmp_path):
    """Every file is listed, as sha256sum lists it."""
    path = made_dataset(tmp_path / "set")
    out = tmp_path / "out"
    assert run_here("export", path, "--to", "lagrangebench", "-o", out, "--trajectory", 0, "-q").status == 0
    lines = (out / "checksums.sha256").read_text(encoding="ascii").splitlines()
    assert lines == [
        f"{hashlib.sha256((out / n).read_bytes()).hexdigest()}  {n}" for n in ("metadata.json", "train.h5")
    ]
    for command in (["info", out, "--verify"], ["dataset", "verify", out]):
        assert run_here(*command).status == 0
    flip(out / "train.h5", 4000)
    for command in (["info", out, "--verify"], ["dataset", "verify", out]):
        outcome = run_here(*command)
        assert outcome.status == 1 and "train.h5 has changed" in outcome.stdout
