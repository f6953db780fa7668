"""Names from files do not speak to the terminal, and lead nowhere."""

import json

import pytest
from command import run_here
from made_dataset import made_dataset
from made_result import made_frame, made_header, made_row

from mpmcli.output import SegmentStore
from mpmcli.plain_text import escaped


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
