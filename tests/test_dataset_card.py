"""The card of a dataset: what it says, that its code runs, and that its bytes depend on the content alone."""

import json
import re
import sqlite3
from pathlib import Path

import h5py
import numpy as np
import pytest
from command import run_here
from made_sweep import COUNT, VERDICTS, made_workers, make_dataset  # noqa: F401

import mpmcli.dataset
from mpmcli.dataset.export import ExportSettings, export
from mpmcli.dataset.folder import MANIFEST, Manifest
from mpmcli.dataset.merge import merge
from mpmcli.dataset.report import MARKS, DrawnComponent, first_paragraph, histogram, remove_card, values_of, write_card

pytestmark = pytest.mark.usefixtures("made_workers")


def card_of(dataset: Path) -> str:
    return (dataset / "README.md").read_text(encoding="utf-8")


def table(card: str, head: str) -> list[list[str]]:
    """Return the rows of the table whose first cell is `head`."""
    lines = card[card.index(f"| {head} |") :].split("\n\n")[0].splitlines()
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def test_the_card_says_what_the_dataset_holds():
    dataset = make_dataset("whole")
    card, opened = card_of(dataset), mpmcli.dataset.open(dataset)
    assert f"{COUNT - 2} trajectories in 2D" in card
    assert "* particles N: 20 to 31" in card and "* frames T: 11" in card
    assert "* interval between frames: 0.01 s" in card and "* end: 0.1 s" in card
    assert "* domain: [0.0, 0.0] to [1.0, 1.0] m, cells of 0.05 m" in card
    assert "`deformation_gradient` (T, N, 2, 2)" in card and "`checksums`" not in card
    rows = {row[0]: row[1:] for row in table(card, "split")}
    assert rows["all"] == ["12", "10", "10", "1", "1"]
    assert {split: int(rows[split][1]) for split in opened.splits} == {s: len(n) for s, n in opened.splits.items()}


def test_the_card_begins_with_the_files_of_each_split():
    """As YAML between lines of three dashes; each is a table of the trajectories of its split, none in quarantine."""
    dataset = make_dataset("whole")
    opened, lines = mpmcli.dataset.open(dataset), card_of(dataset).split("---\n")
    assert lines[0] == "" and any((dataset / "quarantine").iterdir())
    files = dict(re.findall(r"  - split: (\w+)\n    path: (\S+)\n", lines[1]))
    assert set(files) == set(opened.splits)
    for split, numbers in opened.splits.items():
        rows = [json.loads(line) for line in (dataset / files[split]).read_text(encoding="utf-8").splitlines()]
        assert [row["number"] for row in rows] == list(numbers)
        for row, number in zip(rows, numbers, strict=True):
            with h5py.File(dataset / row["file"]) as shard:
                shape = shard[row["group"]]["position"].shape
            assert shape[:2] == (row["frames"], row["particles"])
            assert json.loads(row["draws"]) == opened[number].draws


def test_the_reasons_are_told_without_paths():
    card = card_of(make_dataset("whole"))
    assert "* 4, unstable: it blew up." in card and "* 9, suspect: it blew up." in card
    assert "sweep.toml:" not in card and str(Path.cwd()) not in card


def test_what_was_drawn_is_that_of_the_included_trajectories():
    dataset = make_dataset("whole")
    draws = [trajectory.draws for trajectory in mpmcli.dataset.open(dataset)]
    rows = {row[0].strip("`"): row[1:] for row in table(card_of(dataset), "key")}
    angles = [drawn["bodies.sand.material.friction_angle"] for drawn in draws]
    shown = rows["bodies.sand.material.friction_angle"]
    assert shown[0] == "uniform [25, 40]"
    assert [float(x) for x in shown[1:4]] == pytest.approx([min(angles), np.mean(angles), max(angles)], rel=1e-3)
    heights = [body["max"][1] - body["min"][1] for drawn in draws for body in drawn["place.sand"]]
    shown = rows["place.sand.size.1"]
    assert [float(x) for x in shown[1:4]] == pytest.approx([min(heights), np.mean(heights), max(heights)], rel=1e-3)
    counts = [len(drawn["place.sand"]) for drawn in draws]
    told = dict(one.split(": ") for one in rows["place.sand.count"][4].split(", "))
    assert told == {str(n): str(counts.count(n)) for n in sorted(set(counts))}
    assert rows["place.sand.velocity.0"][0] == "uniform [-2.5, 2.5]"
    assert rows["place.sand.center.0"][0] == "within [0.2, 0.8]"


def test_the_bytes_are_those_of_a_resumed_and_of_a_merged_dataset():
    whole = (make_dataset("whole") / "README.md").read_bytes()
    assert (make_dataset("resumed", broken_after=2) / "README.md").read_bytes() == whole
    parts = [make_dataset(f"part{i}", (i, 2)) for i in (1, 2)]
    assert not any((part / "README.md").exists() for part in parts)
    merge(parts, Path("merged"))
    assert Path("merged/README.md").read_bytes() == whole


def test_the_code_of_the_card_runs(monkeypatch):
    dataset = make_dataset("whole")
    opened = mpmcli.dataset.open(dataset)
    card = card_of(dataset)
    for form in re.findall(r"mpmcli export \. --to (\w+) -o \.\./\1", card):
        export(opened, ExportSettings(form, Path(form)))
    monkeypatch.chdir(dataset)
    blocks = re.findall(r"```python\n(.*?)```", card, re.DOTALL)
    assert len(blocks) == 5 and all(len(block.splitlines()) <= 5 for block in blocks)
    first = int(re.search(r'group = file\["(\d+)"\]', card).group(1))
    expected = mpmcli.dataset.open(".")[first].position
    for block in blocks:
        names: dict = {}
        exec(block, names)
        np.testing.assert_array_equal(names["position"], expected)


def test_the_picture_is_shown_where_it_lies():
    dataset = make_dataset("whole")
    assert "montage.png" not in card_of(dataset)
    (dataset / "montage.png").write_bytes(b"")
    write_card(dataset)
    assert "](montage.png)" in card_of(dataset)


BEGIN, END = MARKS
HOWS = "--resume", "--overwrite"


@pytest.mark.parametrize(("above", "old", "below"), [
    (b"# Ours\r\n\r\nCite us: \xff.\r\n\n", b"", b""),
    (b"Above.\n", BEGIN + b"\nold\n" + END + b"\n", b"Below.\n"),
    (BEGIN + b"\nno end\n\n", b"", b""),
    (BEGIN + b"\nno end\n", BEGIN + b"\nold\n" + END + b"\n", b"Below.\n"),
    (b"---\nlicense: mit\n---\nAbove.\n", BEGIN + b"\nold\n" + END + b"\n", b"Below.\n"),
], ids=["no marks", "marks", "no end mark", "a mark too many", "front matter"])  # fmt: skip
def test_the_text_of_its_owner_is_kept(above, old, below):
    """Byte for byte, around the card; written twice, the file is the same. Front matter of the owner replaces ours."""
    dataset = make_dataset("whole")
    readme = dataset / "README.md"
    front, card = readme.read_bytes().split(BEGIN)
    front, card = b"" if above.startswith(b"---") else front, BEGIN + card
    assert card.endswith(END + b"\n")
    # A card that is not there yet comes after an empty line.
    readme.write_bytes(above + old + below if old else above[:-1])
    for _ in range(2):
        assert write_card(dataset).read_bytes() == front + above + card + below


@pytest.mark.parametrize("text", ['{"number": 1, "text": "mine"}\n', "1\n", "mine\n"])
def test_a_table_of_its_owner_is_kept(text):
    """`dataset card` and a sweep say so before they write, and neither removes it."""
    dataset = make_dataset("whole")
    table = dataset / "valid.jsonl"
    table.write_text(text, encoding="utf-8")
    before = {path: path.read_bytes() for path in dataset.rglob("*") if path.is_file()}
    for words in (("dataset", "card", "whole"), *(("sweep", "sweep.toml", "-o", "whole", how) for how in HOWS)):
        outcome = run_here(*words)
        assert outcome.status == 2 and "valid.jsonl would be replaced by a table of the card" in outcome.stderr
        assert before == {path: path.read_bytes() for path in dataset.rglob("*") if path.is_file()}
    remove_card(dataset)
    assert table.exists() and not (dataset / "train.jsonl").exists()


def test_a_dataset_without_trajectories_has_a_card(monkeypatch):
    monkeypatch.setattr("made_sweep.VERDICTS", dict.fromkeys(range(COUNT), "unstable"))
    card = card_of(make_dataset("whole"))
    assert "No trajectory is included." in card and "* and 2 more;" in card
    assert "## Loading" not in card
    assert len(VERDICTS) == 2


def test_the_times_of_the_manifest_do_not_matter():
    dataset = make_dataset("whole")
    before = card_of(dataset)
    with sqlite3.connect(dataset / MANIFEST) as manifest:
        manifest.execute("UPDATE trajectories SET seconds = seconds + 1, arch = 'cuda'")
    assert Manifest(dataset).rows()[0].arch == "cuda"
    assert write_card(dataset).read_text(encoding="utf-8") == before


def test_a_histogram_counts_every_value():
    assert histogram([0.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0], 0.0, 1.0) == "▁········█"
    assert histogram([k / 10 for k in range(11)], 0.0, 1.0) == "▄▄▄▄▄▄▄▄▄█"


def test_values_left_out_are_shown_and_told_if_they_cluster():
    """Three of eight draws are the lowest in 2 of 56 choices of three, at either end: p = 0.036; 1, 4 and 7 are not."""
    for gone, told in (((0, 1, 2), "lower"), ((5, 6, 7), "higher"), ((0, 3, 6), "")):
        component = DrawnComponent("bodies.jelly.material.youngs_modulus", "uniform [10, 90]")
        for k in range(8):
            component.add(10.0 + 10 * k, k not in gone)
        *_, drawn, left = component.row
        # Eight values evenly over ten bins; the two histograms have the same ones.
        bins = [min(9, 10 * k // 7) for k in range(8)]
        assert {k for k, bar in enumerate(left.strip("`")) if bar != "·"} == {bins[k] for k in gone}
        assert {k for k, bar in enumerate(drawn.strip("`")) if bar != "·"} == {bins[k] for k in {*range(8)} - {*gone}}
        said = component.truncation()
        assert bool(said) == bool(told) and f"have {told} values" in (said or "have  values")
        assert not told or "p = 0.036" in said


def test_the_card_shows_what_was_left_out():
    dataset = make_dataset("whole")
    rows = table(card_of(dataset), "key")
    left = {row[0].strip("`"): row[6] for row in rows}
    assert sum(int(one.split(": ")[1]) for one in left["place.sand.count"].split(", ")) == 2


def test_texts_and_constants_are_counted():
    component = DrawnComponent("bodies.ball.material", 'choice ["jelly", "rubber"]')
    for value in ("jelly", "rubber", "jelly"):
        component.add(value)
    assert component.row[2:] == ("", "", "", "jelly: 2, rubber: 1", "")
    sweep = {"vary": {"time.end": 2, "domain.gravity": {"uniform": [[0, -10], [0, -9]]}}}
    told = list(values_of(sweep, json.loads('{"time.end": 2, "domain.gravity": [0, -9.5]}')))
    assert told == [
        ("time.end", "2", 2),
        ("domain.gravity.0", "uniform [0, 0]", 0),
        ("domain.gravity.1", "uniform [-10, -9]", -9.5),
    ]


def test_the_first_paragraph_of_a_sweep_describes_it():
    assert first_paragraph("#:schema s\n#\n# One.\n# Two.\n#\n# Three.\nbase = 1\n") == "One.\nTwo."
    assert first_paragraph("base = 1\n# no\n") == ""
