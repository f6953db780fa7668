"""Tests of the PNG files: what they hold, what they remember, and what happens where they cannot be written."""

import errno
import os
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mpmcli.errors import InputError, RunError
from mpmcli.render import picture_file
from mpmcli.render.picture_file import digest_of, settings_digest, write_picture

DIGEST = settings_digest({"mode": "dots"})


def an_image(height: int = 9, width: int = 14) -> np.ndarray:
    rows, columns = np.mgrid[:height, :width]
    return np.stack([rows * 20, columns * 15, rows * columns], -1).astype(np.uint8)


def test_a_picture_reads_back_bit_for_bit_and_knows_its_digest(tmp_path):
    path = tmp_path / "new" / "place" / "picture.png"
    write_picture(path, an_image(), DIGEST)
    with Image.open(path) as found:
        assert (found.format, found.mode, found.text["mpmcli"]) == ("PNG", "RGB", DIGEST)
        assert np.array_equal(np.asarray(found), an_image())
    assert digest_of(path) == DIGEST
    assert [entry.name for entry in path.parent.iterdir()] == ["picture.png"]
    first = path.read_bytes()
    write_picture(path, an_image(), DIGEST)
    assert path.read_bytes() == first


def test_a_digest_is_that_of_the_values_and_of_nothing_else():
    settings = {"limits": [0.1, 2.0], "mode": "dots", "camera": None}
    assert settings_digest(settings) == settings_digest(dict(reversed(settings.items())))
    assert settings_digest(settings) == settings_digest({**settings, "limits": np.array([0.1, 2.0])})
    others = [{"limits": [0.1, np.nextafter(2.0, 3.0)]}, {"mode": "surface"}, {"camera": "iso"}, {"more": 1}]
    assert len({settings_digest({**settings, **other}) for other in [{}, *others]}) == 5
    with pytest.raises(TypeError, match="cannot be part of the settings of a picture"):
        settings_digest({"path": Path("x")})


def test_the_version_is_part_of_the_digest(monkeypatch):
    monkeypatch.setattr(picture_file, "__version__", "another")
    assert settings_digest({"mode": "dots"}) != DIGEST


def test_only_whole_pictures_of_mpmcli_are_known(tmp_path):
    path = tmp_path / "picture.png"
    assert digest_of(path) is None
    assert digest_of(tmp_path) == ""
    assert digest_of(Path(__file__) / "picture.png") is None
    Image.fromarray(an_image()).save(path)
    assert digest_of(path) == ""
    path.write_text("mpmcli", encoding="utf-8")
    assert digest_of(path) == ""
    write_picture(path, an_image(), DIGEST)
    whole = path.read_bytes()
    # Cut at any byte before the checksum of the end it is no picture.
    for length in range(len(whole) - 4):
        path.write_bytes(whole[:length])
        assert digest_of(path) == "", length


def test_a_digest_is_found_behind_other_chunks_and_not_over_damaged_pixels(tmp_path):
    """Chunks are length, kind, content, CRC-32 of kind and content, in this order (PNG specification, 5.3)."""
    path = tmp_path / "picture.png"
    write_picture(path, an_image(), DIGEST)
    whole, content = path.read_bytes(), b"Title\x00a picture"
    chunk = len(content).to_bytes(4, "big") + b"tEXt" + content + zlib.crc32(b"tEXt" + content).to_bytes(4, "big")
    # Signature and IHDR are 8 + 25 bytes.
    path.write_bytes(whole[:33] + chunk + whole[33:])
    with Image.open(path) as found:
        assert found.text == {"Title": "a picture", "mpmcli": DIGEST}
    assert digest_of(path) == DIGEST
    pixels = whole.index(b"IDAT") + 4
    path.write_bytes(whole[:pixels] + b"?" * (len(whole) - pixels - 12) + whole[-12:])
    assert digest_of(path) == ""


def test_a_place_that_cannot_be_written_is_bad_input(tmp_path):
    (tmp_path / "file").write_text("x", encoding="utf-8")
    for path, reason in ((tmp_path / "file" / "picture.png", "file is no directory"), (tmp_path, "Is a directory")):
        with pytest.raises(InputError, match=rf"cannot be written \(.*{reason}\): give another place with -o\.$"):
            write_picture(path, an_image(), DIGEST)
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]


def test_a_full_disk_ends_the_run_and_keeps_the_picture_before(tmp_path, monkeypatch):
    path = tmp_path / "picture.png"
    write_picture(path, an_image(), DIGEST)
    before = path.read_bytes()

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("mpmcli.output.durable.sync_file", full)
    with pytest.raises(RunError, match=r"could not be written \(No space left on device\): free some space"):
        write_picture(path, an_image(3, 3), DIGEST)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_two_that_write_one_picture_both_end(tmp_path, monkeypatch):
    """One writes all of its picture in the midst of the other: the last one to end gives the file."""
    path, save, others = tmp_path / "a.png", Image.Image.save, [np.full((4, 4, 3), 200, np.uint8)]

    def slow_save(image, target, **options):
        if others:
            write_picture(path, others.pop(), "of the other")
            assert digest_of(path) == "of the other"
        save(image, target, **options)

    monkeypatch.setattr(Image.Image, "save", slow_save)
    write_picture(path, np.zeros((4, 4, 3), np.uint8), "of the first")
    assert digest_of(path) == "of the first" and os.listdir(tmp_path) == ["a.png"]
