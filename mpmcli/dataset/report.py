"""Reports on a dataset from its manifest and files: counts, reasons for exclusions, and checksums.

Also its card, README.md in its directory: distributions, contents, and code that loads it.
"""

import json
import math
import os
import re
import tomllib
from array import array
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Any

import h5py
import numpy as np

from mpmcli.dataset.certify import FIGURE, TITLE, certificates, error_of, error_section
from mpmcli.dataset.folder import VERDICTS, Folder, Manifest, Row
from mpmcli.dataset.hold_out import Rules, rules_text
from mpmcli.dataset.image_folder import image_faults
from mpmcli.dataset.shard import (
    BASE,
    IMAGES,
    SHARDS,
    SPLITS,
    SWEEP,
    StoredGroup,
    checksum,
    group_name,
    moving_names,
    open_shard,
)
from mpmcli.errors import InputError
from mpmcli.output.checksums import SUMS, checksum_is_right
from mpmcli.output.durable import sealed, write_text, writing
from mpmcli.plain_text import counted, markdown_table, one_line, size_text
from mpmcli.render.picture_file import digest_of

# Largest number of trajectories named in a text.
MOST_NAMED = 10


@dataclass(frozen=True)
class Status:
    """Counts of a dataset with `part` (i, n) of a sweep: `expected` trajectories, and `rows` of those tried.

    `missing` files of trajectories do not exist; trajectories with the numbers `waiting` have not been tried; `imaged`
    is the number of those with images, None if the sweep asks for none.
    """

    path: Path
    part: tuple[int, int]
    expected: int
    rows: tuple[Row, ...]
    missing: frozenset[str] = frozenset()
    waiting: frozenset[int] = frozenset()
    imaged: int | None = None

    @property
    def accepted(self) -> int:
        """Trajectories that the dataset includes."""
        return sum(row.accepted for row in self.rows if row.file not in self.missing)

    @property
    def absent(self) -> list[int]:
        """Numbers of the trajectories without their file."""
        return [row.number for row in self.rows if row.file in self.missing]

    def as_dict(self) -> dict:
        """Return the counts, and the reason of each trajectory that is not included."""
        verdicts = Counter(row.verdict for row in self.rows)
        splits = Counter(row.split for row in self.rows if row.accepted)
        told = ("number", "verdict", "reason", "file")
        return {
            "path": str(self.path),
            "part": list(self.part),
            "trajectories": self.expected,
            "done": len(self.rows),
            "missing": self.absent,
            "accepted": self.accepted,
            "imaged": self.imaged,
            "retried": sum(row.retries > 0 for row in self.rows),
            "verdicts": {verdict: verdicts[verdict] for verdict in VERDICTS},
            "splits": dict(sorted(splits.items())),
            "steps": sum(row.steps for row in self.rows),
            "seconds": sum(row.seconds for row in self.rows),
            "excluded": [{name: getattr(row, name) for name in told} for row in self.rows if not row.accepted],
        }

    def lack(self) -> str:
        """Return the part of the sweep that the dataset lacks, apart from exclusions by verdict, "" if none."""
        failed, waiting = sum(row.verdict == "failed" for row in self.rows), self.expected - len(self.rows)
        counts = ((waiting, "not computed"), (failed, "failed"), (len(self.absent), "without their file"))
        told = [f"{n} {what}" for n, what in counts if n]
        (i, n), of = self.part, counted(self.expected, "trajectory")
        if n > 1:
            told.append(f"this is part {i} of {n} of the sweep")
        return f"{self.accepted} of {of} included, {', '.join(told)}" if told else ""

    def text(self) -> str:
        """Return it as text: a line of counts, a line per verdict, and the reasons of the first exclusions."""
        told = self.as_dict()
        lines = [
            f"{self.path}: {self.accepted} of {counted(self.expected, 'trajectory')} included, "
            f"{self.expected - len(self.rows)} to compute, {told['retried']} retried"
        ]
        lines += [f"  {name} is missing" for name in sorted(self.missing)]
        lines += [f"  {verdict:<9} {count}" for verdict, count in told["verdicts"].items() if count]
        lines += [f"  {split:<9} {count}" for split, count in told["splits"].items()]
        lines += [f"  images    {self.imaged}"] * (self.imaged is not None)
        excluded = told["excluded"]
        lines += [f"  {one['number']:06d} {one['verdict']}: {one['reason']}" for one in excluded[:MOST_NAMED]]
        if len(excluded) > MOST_NAMED:
            lines.append(f"  and {len(excluded) - MOST_NAMED} more; --json lists all")
        return "\n".join(lines)


def status_of(path: Path) -> Status:
    """Read the counts of a dataset; InputError: it is not a dataset, or its manifest cannot be read."""
    manifest = Manifest(path)
    facts, rows = manifest.facts(), manifest.rows()
    folder = Folder(path, facts["count"], facts["per_shard"], tuple(facts["part"]))
    missing = frozenset(name for name in {row.file for row in rows} if name and not (path / name).is_file())
    waiting = frozenset(folder.all_numbers()) - {row.number for row in rows}
    places = [path / IMAGES / group_name(row.number) / SUMS for row in rows if row.accepted]
    imaged = sum(place.exists() for place in places) if "images" in facts else None
    return Status(path, folder.part, folder.expected, tuple(rows), missing, waiting, imaged)


@dataclass(frozen=True)
class Verification:
    """Outcome of a comparison of a dataset with its manifest: number of trajectories, and a sentence per fault."""

    path: Path
    trajectories: int
    faults: tuple[str, ...]

    def as_dict(self) -> dict:
        """Return it for JSON."""
        read = {"trajectories": self.trajectories, "faults": list(self.faults)}
        return {"path": str(self.path), "ok": not self.faults, **read}

    def text(self) -> str:
        """Return the outcome, and a line for each fault."""
        outcome = counted(len(self.faults), "fault") if self.faults else "all checksums and counts are right"
        return "\n".join([f"{self.path}: {counted(self.trajectories, 'trajectory')} read, {outcome}", *self.faults])


def verify(path: Path, on_file: Callable[[int, int], None] = lambda done, total: None) -> Verification:
    """Compare a dataset with its manifest; after each file, `on_file` gets the number of files read and the total."""
    status = status_of(path)
    faults = []
    missing = status.expected - len(status.rows)
    if missing:
        faults.append(f"{counted(missing, 'trajectory')} not computed; mpmcli sweep --resume goes on.")
    by_file = _by_file(status.rows)
    faults += [
        f"trajectory {row.number} is included, but has no file." for row in status.rows if row.accepted and not row.file
    ]
    others = set((path / SHARDS).glob("*.h5")) - {path / name for name in by_file}
    faults += [f"{other} is in no row of the manifest." for other in sorted(others)]
    for done, (name, rows) in enumerate(sorted(by_file.items()), 1):
        faults += _faults_of(path / name, rows)
        on_file(done, len(by_file))
    certified, damaged = certificates(path)
    wanted = {*Manifest(path).facts().get("certify", {}).get("numbers", ())} - certified.keys()
    lacking = [row.number for row in status.rows if row.accepted and row.number in wanted]
    faults += [*damaged, *(f"trajectory {n} has no certificate; mpmcli sweep --resume computes it." for n in lacking)]
    if Manifest(path).facts().get("images"):
        faults += chain.from_iterable(image_faults(path, status.rows).values())
    return Verification(path, sum(len(rows) for rows in by_file.values()), tuple(faults))


def final_rows(path: Path, rows: Sequence[Row]) -> list[Row]:
    """Return the rows that are not computed again: neither failed, nor with a file that is missing or damaged."""
    faulty = {name for name, its in _by_file(rows).items() if _faults_of(path / name, its)}
    return [row for row in rows if row.verdict != "failed" and row.file not in faulty]


def _by_file(rows: Sequence[Row]) -> dict[str, list[Row]]:
    found: dict[str, list[Row]] = {}
    for row in rows:
        if row.file:
            found.setdefault(row.file, []).append(row)
    return found


def _faults_of(file: Path, rows: list[Row]) -> list[str]:
    """Return what is wrong with a shard: trajectories missing, out of place or damaged, or bytes changed."""
    faults = []
    try:
        with open_shard(file) as opened:
            names = {group_name(row.number): row for row in rows}
            others = sorted(opened.keys() - names.keys())
            faults += [f"{file} holds {one_line(name)}, which the manifest does not place there." for name in others]
            for name, row in names.items():
                there = name in opened
                faults += _trajectory_faults(opened, row) if there else [f"{file} lacks trajectory {row.number}."]
        if not faults and not checksum_is_right(file):
            faults.append(f"{file} has changed between its data: the checksum at its end differs.")
    except InputError as error:
        faults.append(str(error))
    return faults


def _trajectory_faults(file: h5py.File, row: Row) -> list[str]:
    """Compare a trajectory with its row and its own checksums."""
    it = f"trajectory {row.number} in {file.filename}"
    try:
        stored = StoredGroup(file, row.number)
        if checksum(stored.group) != row.checksum:
            return [f"{it} has changed: its checksum differs."]
        if stored.group["position"].shape[:2] != (row.frames, row.particles):
            return [f"{it} has other counts than its row."]
        if stored.attribute("split") != row.split or stored.attribute("draws") != json.loads(row.draws):
            return [f"{it} has other draws or another split than its row."]
        stored.require_all()
    except (OSError, RuntimeError, ValueError, KeyError, TypeError):
        return [f"{it} is damaged: it cannot be read."]
    except InputError as error:
        return [str(error)]
    return []


CARD, MONTAGE = "README.md", "montage.png"
# Marks around the card in README.md, whose other text is its owner's; a part without its end mark is the owner's, too.
MARKS = b"<!-- card: written by mpmcli -->", b"<!-- end of card -->"
_MARKED = re.compile(rb"(?s)%b((?!%b).)*?%b\n?" % (MARKS[0], MARKS[0], MARKS[1]))
# First lines of the front matter; one with other lines is the owner's.
FRONT = "---", "configs:", "- config_name: default", "  data_files:"
_FRONT = re.compile(("\n".join(FRONT) + r"\n(?:  - split: \w+\n    path: \S+\n)+---\n+").encode())
# Entries of a trajectory in the table of its split, after which comes its group in the file.
_FACTS = "number", "file", "frames", "particles", "draws"
# Bins of a histogram; if there are few distinct values, each is counted separately.
BINS = 10
MOST_COUNTED = 6
# Probability of such ranks by chance below which trajectories left out are said to cluster.
CLUSTERED = 0.05
LEVELS = "▁▂▃▄▅▆▇█"
NO_BAR = "·"


def write_card(directory: Path) -> Path:
    """Write the card of a dataset whose trajectories have all been tried, and tables of its splits; return its path.

    Its bytes depend on the sweep and the trajectories alone, not on times, machines, interrupts or parts. It shows the
    picture montage.png if the directory contains one. Other text in the file is kept. InputError, nothing written: a
    file of another has the name of a table.
    """
    require_own_tables(directory)
    manifest = Manifest(directory)
    facts, rows = manifest.facts(), manifest.rows()
    sweep_text = (directory / SWEEP).read_text(encoding="utf-8")
    sweep = tomllib.loads(sweep_text)
    base = tomllib.loads((directory / BASE).read_text(encoding="utf-8"))
    included = [row for row in rows if row.accepted]
    error, plan = error_of(directory), facts.get("certify")
    if error != facts.get("error"):
        manifest.tell("error", error)
    tables, loading = split_tables(included), ""
    if included:
        one, d = included[0], len(base["domain"]["size"])
        loading = _LOADING.format(file=one.file, group=group_name(one.number), split=one.split, d=d)
    sections = [
        f"# {one_line(base.get('title') or 'Trajectories of particles')}",
        first_paragraph(sweep_text),
        "![Some of the trajectories](montage.png)" if (directory / MONTAGE).is_file() else "",
        _contents(directory, included) + _images(facts.get("images")) if included else "No trajectory is included.",
        _counts(facts["count"], rows),
        rules_text(facts.get("hold_out", {}), [(json.loads(row.draws), row.particles) for row in included]),
        _left_out([row for row in rows if not row.accepted]),
        _drawn(sweep, rows, facts.get("hold_out", {})),
        error_section(directory, facts["count"], plan, error) if plan else "",
        loading,
        f"Drawn with seed {facts['seed']}; computed with mpmcli {facts['version']}. `sweep.toml` and `base.toml` are "
        "the sweep and its base scene.",
    ]
    with writing(directory / CARD, "the dataset is kept"):
        for name, text in tables.items():
            write_text(directory / name, text)
        card = "\n\n".join(section for section in sections if section)
        _put_card(directory / CARD, card.encode(), _front_matter(tables).encode())
    return directory / CARD


def _put_card(path: Path, card: bytes, front: bytes) -> None:
    """Put a card between its marks, or after all other text, and the front matter first unless there is another."""
    before, marked = path.read_bytes() if path.exists() else b"", b"\n\n".join([MARKS[0], card, MARKS[1]]) + b"\n"
    text, found = _MARKED.subn(lambda _: marked, _FRONT.sub(b"", before))
    if not found:
        text = b"\n".join(filter(None, [text, marked]))
    with sealed(path) as temporary:
        temporary.write_bytes(text if text.startswith(b"---") else front + text)


def remove_card(directory: Path) -> None:
    """Remove the card of a dataset, its tables and its picture; README.md stays if it has other text."""
    path = directory / CARD
    if path.exists() and _MARKED.sub(b"", _FRONT.sub(b"", path.read_bytes())).strip():
        _put_card(path, b"", b"")
    else:
        path.unlink(missing_ok=True)
    for path in filter(_is_table, (directory / table_name(split) for split in SPLITS)):
        path.unlink()
    if digest_of(directory / MONTAGE):
        (directory / MONTAGE).unlink()
    if (directory / FIGURE).is_file() and TITLE.encode() in (directory / FIGURE).read_bytes():
        (directory / FIGURE).unlink()


def table_name(split: str) -> str:
    """Return the name of the file of `split_tables` of a split."""
    return f"{split}.jsonl"


def require_own_tables(directory: Path) -> None:
    """Refuse a directory with a file of another under the name of a table: InputError."""
    for path in (directory / table_name(split) for split in SPLITS):
        if os.path.lexists(path) and not _is_table(path):
            raise InputError(f"{path} would be replaced by a table of the card: give it another name.")


def _is_table(path: Path) -> bool:
    try:
        return all([*json.loads(line)] == [*_FACTS, "group"] for line in path.read_bytes().splitlines())
    except (OSError, ValueError, TypeError):
        return False


def split_tables(included: Sequence[Row]) -> dict[str, str]:
    """Return a table of each split that has trajectories, as JSON lines by the name of its file, for `load_dataset`.

    Of files of HDF5 that function makes one table, whatever their splits, and it would take those in quarantine.
    """
    found: dict[str, str] = {}
    for row in sorted(included, key=lambda row: SPLITS.index(row.split)):
        facts = {name: getattr(row, name) for name in _FACTS}
        name = table_name(row.split)
        found[name] = found.get(name, "") + json.dumps(facts | {"group": group_name(row.number)}) + "\n"
    return found


def _front_matter(tables: Collection[str]) -> str:
    """Return the YAML with which a card on Hugging Face begins: the file of each split."""
    lines = [f"  - split: {name.removesuffix('.jsonl')}\n    path: {name}" for name in tables]
    return "\n".join([*FRONT, *lines, "---\n\n"]) if lines else ""


def first_paragraph(text: str) -> str:
    """Return the first comment of a TOML file up to its first empty line, without editor directives."""
    lines = []
    for line in text.splitlines():
        said = line.removeprefix("#").strip()
        if not line.startswith("#") or (lines and not said):
            break
        if said and not line.startswith("#:"):
            lines.append(said)
    return "\n".join(lines)


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _range(values: Collection[float], unit: str = "") -> str:
    low, high = min(values), max(values)
    told = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"{told} {unit}".rstrip()


def _contents(directory: Path, included: Sequence[Row]) -> str:
    """Return the common properties of the included trajectories and the ranges of others: lengths in m, times in s."""
    lowers, uppers = [], []
    # The shortest and the longest interval between frames.
    spacings, intervals, durations, laws = set(), set(), set(), set()
    # Arrays over time: the shape of a particle's value by name.
    arrays: dict[str, tuple[int, ...]] = {}
    shards = [directory / name for name in sorted({row.file for row in included})]
    for path in shards:
        with open_shard(path) as shard:
            for group in shard.values():
                header, times = json.loads(group.attrs["header"]), group["time"][:]
                lowers.append(np.array(header["origin"]))
                uppers.append(lowers[-1] + header["size"])
                spacings.add(header["spacing"])
                laws |= set(header["materials"])
                if len(times) > 1:
                    intervals |= {_rounded(apart) for apart in (np.diff(times).min(), np.diff(times).max())}
                durations.add(_rounded(times[-1]))
                arrays |= {name: group[name].shape[2:] for name in moving_names(group)}
    lower, upper = np.min(lowers, axis=0).tolist(), np.max(uppers, axis=0).tolist()
    names = [f"`{name}` ({', '.join(['T', 'N', *map(str, shape)])})" for name, shape in arrays.items()]
    size = size_text(sum(path.stat().st_size for path in shards))
    lines = [
        f"{counted(len(included), 'trajectory')} in {len(lower)}D, {size}; T frames of the same "
        "N particles, in SI units:",
        "",
        f"* particles N: {_range([row.particles for row in included])}",
        f"* frames T: {_range([row.frames for row in included])}, with the initial one",
        f"* end: {_range(durations, 's')}",
        f"* domain: {[*map(_rounded, lower)]} to {[*map(_rounded, upper)]} m, cells of {_range(spacings, 'm')}",
        f"* laws: {', '.join(sorted(laws))}",
        f"* arrays: {', '.join(names)}",
    ]
    if intervals:
        lines.insert(4, f"* interval between frames: {_range(intervals, 's')}")
    return "\n".join(lines)


def _images(plan: Mapping[str, Any] | None) -> str:
    """Return a line on the images of a dataset, "" if it has none."""
    if not plan:
        return ""
    where = f"`{IMAGES}/{group_name(0)}/`, a directory for each camera; `cameras.json` has the matrices"
    return f"\n* images: {', '.join(plan['what'])} of the frames {plan['frames']}, in {where}"


def _counts(expected: int, rows: Sequence[Row]) -> str:
    verdicts = [verdict for verdict in VERDICTS if any(row.verdict == verdict for row in rows)]
    table = [("split", "computed", "included", *verdicts)]
    for split in (*SPLITS, "all"):
        own = [row for row in rows if split in ("all", row.split)]
        counts = Counter(row.verdict for row in own)
        told = [len(own), sum(row.accepted for row in own), *(counts[verdict] for verdict in verdicts)]
        table.append((split, *(f"{count:,}" for count in told)))
    told = markdown_table(table[0], table[1:], range(len(table[0])))
    return f"## Splits and verdicts\n\nOf {counted(expected, 'trajectory')} of the sweep:\n\n{told}"


def _left_out(rows: Sequence[Row]) -> str:
    """Return the reasons of the first trajectories that are not included."""
    if not rows:
        return ""
    lines = []
    for row in rows[:MOST_NAMED]:
        first = (row.reason.splitlines() or [""])[0]
        # Omit the path of the sweep on the machine that computed it.
        said = first.partition(f": trajectory {row.number}: ")[2] or first
        lines.append(f"* {row.number}, {row.verdict}: {one_line(said)}")
    if len(rows) > MOST_NAMED:
        lines.append(f"* and {len(rows) - MOST_NAMED} more; `mpmcli dataset status --json` lists all")
    return "\n".join(["Left out:", "", *lines])


def _drawn(sweep: Mapping[str, Any], rows: Sequence[Row], rules: Rules) -> str:
    """Return a table of the varying keys, and of the values drawn, with a line for each key that decides who is in."""
    components: dict[str, DrawnComponent] = {}
    for row in rows:
        for label, source, value in values_of(sweep, json.loads(row.draws)):
            components.setdefault(label, DrawnComponent(label, source)).add(value, row.accepted, row.split in rules)
    if not components or not any(row.accepted for row in rows):
        return ""
    head = ("key", "drawn from", "min", "mean", "max", "values")
    # What was left out has a column if there is any.
    head += ("left out",) * (not all(row.accepted for row in rows))
    told = [(f"`{one.label}`", one.source, *one.row[2 : len(head)]) for one in components.values()]
    if rules:
        head, told = (*head, "held out"), [(*its, one.held) for its, one in zip(told, components.values(), strict=True)]
    method = sweep.get("method", "random")
    lines = [
        f"## What varies\n\nWhat the included trajectories have drawn (method: {method}); a histogram has ten bins "
        f"from the smallest to the largest value drawn.\n\n{markdown_table(head, told, range(len(head)))}"
    ]
    return "\n\n".join([*lines, *filter(None, (one.truncation() for one in components.values()))])


_LOADING = """\
## Loading

With mpmcli, in this directory:

```python
import mpmcli.dataset
dataset = mpmcli.dataset.open(".")
trajectory = dataset[dataset.splits["{split}"][0]]
position, velocity = trajectory.position, trajectory.velocity    # (T, N, {d}), m and m/s
times, body, draws = trajectory.times, trajectory.body, trajectory.draws
```

With h5py alone; `datasets.load_dataset(".")` of Hugging Face has each one's `file`, `group` and `draws`, by split:

```python
import h5py
file = h5py.File("{file}")
group = file["{group}"]
position, times = group["position"][:], group["time"][:]
split, draws = group.attrs["split"], group.attrs["draws"]        # draws and header are JSON
```

After `mpmcli export . --to gns -o ../gns`:

```python
import numpy as np
entries = np.load("../gns/{split}.npz", allow_pickle=True)
position, particle_type, *parameters = entries["trajectory_{group}"]
```

After `mpmcli export . --to lagrangebench -o ../lagrangebench`:

```python
import h5py
file = h5py.File("../lagrangebench/{split}.h5")
position, particle_type = file["00000/position"][:], file["00000/particle_type"][:]
```

After `mpmcli export . --to npz -o ../npz`:

```python
import numpy as np
arrays = np.load("../npz/{group}.npz")
position, velocity, times = arrays["position"], arrays["velocity"], arrays["time"]
```"""


class DrawnComponent:
    """Values over all trajectories of one component of a key, such as "domain.gravity.1", drawn from `source`."""

    def __init__(self, label: str, source: str) -> None:
        self.label, self.source = label, source
        # Of the trajectories left out, of those included, and of those included that a split holds out.
        self._numbers = array("d"), array("d"), array("d")
        self._texts: tuple[Counter[str], ...] = Counter(), Counter(), Counter()

    def add(self, value: Any, accepted: bool = True, held: bool = False) -> None:
        """Count a value, a finite number or any other JSON value, of a trajectory that is included or left out."""
        for group in (accepted, 2) if accepted and held else (accepted,):
            if isinstance(value, int | float) and not isinstance(value, bool):
                self._numbers[group].append(value)
            else:
                self._texts[group][value if isinstance(value, str) else json.dumps(value)] += 1

    @property
    def row(self) -> tuple[str, ...]:
        """Label, source, minimum, mean, maximum and distribution, and that of values left out; "" if there is none."""
        ends, numbers = ("", "", ""), self._numbers[True]
        if numbers and not self._texts[True]:
            # The exact sum is independent of the order.
            mean = math.fsum(numbers) / len(numbers)
            ends = (number_text(min(numbers)), number_text(mean), number_text(max(numbers)))
        return (self.label, self.source, *ends, self._distribution(True), self._distribution(False))

    @property
    def held(self) -> str:
        """Distribution of the values that splits hold out, in the bins of all."""
        return self._distribution(2)

    def _distribution(self, group: int) -> str:
        drawn = [*self._numbers[True], *self._numbers[False]]
        # Sorted as numbers; a key that draws texts has few distinct ones.
        distinct = len({*map(number_text, drawn), *self._texts[True], *self._texts[False]})
        if (distinct <= MOST_COUNTED and distinct < max(len(drawn), 2)) or any(self._texts):
            counts = Counter(map(number_text, sorted(self._numbers[group]))) + self._texts[group]
            told = [f"{value}: {count}" for value, count in list(counts.items())[:MOST_COUNTED]]
            return ", ".join([*told, "..."] if len(counts) > MOST_COUNTED else told)
        numbers = self._numbers[group]
        return f"`{histogram(numbers, min(drawn), max(drawn))}`" if numbers else ""

    def truncation(self) -> str:
        """Return a sentence if the values left out rank otherwise than those included (Mann and Whitney), else ""."""
        gone, kept, _ = self._numbers
        if not gone or not kept or any(self._texts):
            return ""
        from scipy.stats import mannwhitneyu

        found = mannwhitneyu(gone, kept)
        if not found.pvalue < CLUSTERED:
            return ""
        side = "lower" if found.statistic < len(gone) * len(kept) / 2 else "higher"
        return (
            f"The trajectories left out have {side} values of `{self.label}` than those included (medians "
            f"{number_text(median(gone))} and {number_text(median(kept))}; a rank test gives p = {found.pvalue:.2g}): "
            "the dataset lacks this end of the distribution."
        )


def histogram(values: Sequence[float], low: float, high: float) -> str:
    """Return bars with heights proportional to the counts in equal bins between two values."""
    counts = [0] * BINS
    for value in values:
        counts[min(BINS - 1, int(BINS * ((value - low) / (high - low))))] += 1
    most = max(counts)
    return "".join(LEVELS[-(-count * len(LEVELS) // most) - 1] if count else NO_BAR for count in counts)


def number_text(value: float) -> str:
    """Write a number with four digits."""
    return f"{value:.4g}"


def values_of(sweep: Mapping[str, Any], drawn: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yield label, source and value of each drawn component, in the order of the `sweep` file's TOML."""
    for key, table in sweep.get("vary", {}).items():
        if key in drawn:
            yield from _components(key, table, drawn[key])
    places = sweep.get("place", [])
    for place in [places] if isinstance(places, dict) else places:
        key = f"place.{place['body']}" if "body" in place else f"place.colliders.{place['collider']}"
        bodies = drawn.get(key, [])
        if key in drawn:
            yield f"{key}.count", _source(place["count"]), len(bodies)
        for body in bodies:
            low, high = body.get("min"), body.get("max")
            if low and "size" in place:
                size = [b - a for a, b in zip(low, high, strict=True)]
                yield from _components(f"{key}.size", place["size"], size)
            if "radius" in body and "radius" in place:
                yield f"{key}.radius", _source(place["radius"]), body["radius"]
            center = body.get("center") or [(a + b) / 2 for a, b in zip(low, high, strict=True)]
            region = {"within": [place["region"]["min"], place["region"]["max"]]}
            yield from _components(f"{key}.center", region, center)
            if "velocity" in body:
                yield from _components(f"{key}.velocity", place["velocity"], body["velocity"])


def _components(key: str, table: Any, value: Any) -> Iterator[tuple[str, str, Any]]:
    if not isinstance(value, list):
        yield key, _source(table), value
        return
    for index, one in enumerate(value):
        yield f"{key}.{index}", _source(table, index), one


def _source(table: Any, component: int | None = None) -> str:
    """Write a distribution as in the sweep file; with a `component`, only the bounds of that one."""
    if not isinstance(table, dict):
        return json.dumps(table)

    def written(name: str, given: Any) -> str:
        bounds = name not in ("choice", "grid") and component is not None
        if bounds and all(isinstance(one, list) for one in given):
            given = [one[component] for one in given]
        return f"{name} {json.dumps(given)}"

    return ", ".join(written(name, given) for name, given in table.items())
