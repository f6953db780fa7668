"""Results are data: nothing in them leads to another file, and no name in them speaks to the terminal."""

import json
import os
import shutil
import sqlite3
from pathlib import Path

import h5py
import numpy as np
import pytest
from changed_result import accept_changes
from command import run_here
from made_dataset import made_dataset
from made_result import made_frame, made_header, made_row, write_made

import mpmcli.dataset
from mpmcli.errors import InputError
from mpmcli.output import SegmentStore, open_result
from mpmcli.output.collider_files import read_stored_surfaces
from mpmcli.output.segments import PACKED
from mpmcli.plain_text import escaped

GOLDEN = Path(__file__).resolve().parent / "golden"
LINKS = ("external", "soft", "virtual", "raw")


@pytest.fixture
def old(tmp_path) -> Path:
    """A result without checksums, whose links nothing else gives away; and the same one as another person's."""
    shutil.copytree(GOLDEN / "1" / "packed", tmp_path / "packed")
    shutil.copy(GOLDEN / "1" / "packed" / PACKED, tmp_path / "secret.h5")
    return tmp_path / "packed"


def lead_away(file: h5py.File, name: str, kind: str, secret: Path) -> None:
    """Put something that reads another file in place of an item."""
    item = file[name]
    shape, dtype = getattr(item, "shape", None), getattr(item, "dtype", None)
    del file[name]
    if kind == "external":
        file[name] = h5py.ExternalLink(str(secret), name)
    elif kind == "soft":
        file["elsewhere"] = h5py.ExternalLink(str(secret), "/")
        file[name] = h5py.SoftLink(f"/elsewhere/{name}")
    elif kind == "virtual":
        layout = h5py.VirtualLayout(shape, dtype)
        layout[...] = h5py.VirtualSource(str(secret), name, shape)
        file.create_virtual_dataset(name, layout)
    else:
        file.create_dataset(name, shape, dtype, external=[(str(secret), 0, h5py.h5f.UNLIMITED)])


@pytest.mark.parametrize("kind", LINKS)
@pytest.mark.parametrize("name", ["VTKHDF/Points", "VTKHDF/Steps/Values", "ledger/mass", "VTKHDF/PointData/velocity"])
def test_no_link_to_another_file_is_followed(old, tmp_path, name, kind):
    with h5py.File(old / PACKED, "r+") as file:
        lead_away(file, name, kind, tmp_path / "secret.h5")
    with pytest.raises(InputError, match=r"link to another place|from another file"):
        list(open_result(old).frames())
    for command in (["info", old, "--verify"], ["check", old], ["export", old, "--to", "npz", "-o", tmp_path / "out"]):
        outcome = run_here(*command)
        assert outcome.status in (1, 2) and "a fault of mpmcli" not in outcome.stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["mpmcli", "VTKHDF", "ledger"])
def test_no_group_of_another_file_is_taken(old, tmp_path, name):
    with h5py.File(old / PACKED, "r+") as file:
        lead_away(file, name, "external", tmp_path / "secret.h5")
    with pytest.raises(InputError):
        open_result(old)


def test_a_pipe_behind_a_link_is_not_waited_for(old, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(old / PACKED, "r+") as file:
        lead_away(file, "mpmcli", "external", tmp_path / "pipe")
    with pytest.raises(InputError):
        open_result(old)


def test_an_array_that_claims_more_than_its_file_holds_is_not_read(old):
    """2 TB of zeros that were never written."""
    with h5py.File(old / PACKED, "r+") as file:
        del file["VTKHDF/Points"]
        file.create_dataset("VTKHDF/Points", (2**38, 3), np.float32, chunks=(2**16, 3))
        file["VTKHDF/NumberOfPoints"][0] = 2**38
    with pytest.raises(InputError, match="claims to be more than the file holds"):
        open_result(old).frame(0)


@pytest.mark.parametrize("kind", LINKS)
def test_no_shard_leads_away(tmp_path, kind):
    path = made_dataset(tmp_path / "set")
    shutil.copy(path / "shards/00000.h5", tmp_path / "secret.h5")
    with h5py.File(path / "shards/00000.h5", "r+") as file:
        lead_away(file, "000000/position", kind, tmp_path / "secret.h5")
    with pytest.raises(InputError, match=r"link to another place|from another file"):
        _ = mpmcli.dataset.open(path)[0].position


def test_a_manifest_does_not_lead_out_of_its_dataset(tmp_path):
    shutil.copytree(GOLDEN / "2" / "dataset", tmp_path / "dataset")
    shutil.copy(tmp_path / "dataset/shards/00000.h5", tmp_path / "outside.h5")
    for place in ("../outside.h5", str(tmp_path / "outside.h5"), "shards/../../outside.h5"):
        with sqlite3.connect(tmp_path / "dataset/manifest.sqlite") as connection:
            connection.execute("UPDATE trajectories SET file = ?", (place,))
        connection.close()
        outcome = run_here("dataset", "verify", tmp_path / "dataset")
        assert outcome.status == 2 and "places trajectory 0 in" in outcome.stderr


@pytest.mark.parametrize(
    "name", ["../outside.vtu", "/etc/hostname", "particles_000000.vtu/../../outside.vtu", "ledger.csv"]
)
def test_a_series_names_no_file_but_its_frames(tmp_path, name):
    write_made(tmp_path / "run", "series")
    shutil.copy(tmp_path / "run/particles_000000.vtu", tmp_path / "outside.vtu")
    listed = tmp_path / "run/particles.pvd"
    listed.write_text(listed.read_text().replace("particles_000000.vtu", name))
    accept_changes(tmp_path / "run")
    with pytest.raises(InputError, match="reads no file but the frames beside it"):
        open_result(listed)


@pytest.mark.parametrize(
    "line", ["0" * 64 + "  ../secret\n", "0" * 64 + "  /etc/passwd\n", "0" * 63 + "  train.h5\n", "\x1b[2J\n"]
)
def test_checksums_are_of_files_of_their_directory(tmp_path, line):
    path = made_dataset(tmp_path / "set")
    assert run_here("export", path, "--to", "gns", "-o", tmp_path / "out", "-q").status == 0
    with (tmp_path / "out/checksums.sha256").open("a") as file:
        file.write(line)
    outcome = run_here("info", tmp_path / "out", "--verify")
    assert outcome.status == 1 and "a line of it is not a checksum" in outcome.stdout


@pytest.mark.parametrize("kind", LINKS)
def test_the_surfaces_of_colliders_lie_in_their_file(tmp_path, kind):
    for name in ("colliders.vtkhdf", "secret.h5"):
        with h5py.File(tmp_path / name, "w") as file:
            file["mpmcli/surfaces/0/vertices"] = np.eye(3)
            file["mpmcli/surfaces/0/triangles"] = np.array([[0, 1, 2]])
    assert list(read_stored_surfaces(tmp_path)) == [0]
    with h5py.File(tmp_path / "colliders.vtkhdf", "r+") as file:
        lead_away(file, "mpmcli/surfaces/0/vertices", kind, tmp_path / "secret.h5")
    with pytest.raises(InputError, match=r"link to another place|from another file"):
        read_stored_surfaces(tmp_path)


def test_names_from_files_do_not_speak_to_the_terminal(tmp_path):
    """A title that clears the screen, and a body that writes from right to left."""
    header = {**made_header(2), "title": "x\x1b[2J\x9b1m", "bodies": ["a\u202eb", "c\rd"]}
    store = SegmentStore(tmp_path, header)
    store.write(made_frame(0, 2), made_row(0, 2))
    store.finish()
    outcome = run_here("info", tmp_path)
    assert outcome.status == 0
    assert all(character.isprintable() or character == "\n" for character in outcome.stdout)
    assert "x\\u001b[2J\\u009b1m" in outcome.stdout and "a\\u202eb" in outcome.stdout
    told = json.loads(run_here("info", tmp_path, "--json").stdout)
    assert told["title"] == header["title"] and told["bodies"] == header["bodies"]


def test_escapes_are_those_of_json():
    text = "".join(map(chr, [*range(32), 0x7F, 0x9B, 0x202E, 0xDCFF, 0xE0001])) + "Grüße, 日本 😀"
    shown = escaped(text)
    assert all(character.isprintable() or character in "\n\t" for character in shown)
    assert json.loads(f'"{shown}"', strict=False) == text and escaped("Grüße\n") == "Grüße\n"
