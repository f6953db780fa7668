"""The card of a dataset, README.md in its directory: what varies, what was kept, how to load it."""

import json
import tomllib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.dataset.drawn_values import DrawnComponent, values_of
from mpmcli.dataset.manifest import VERDICTS, Manifest, Row
from mpmcli.dataset.paths import BASE, SWEEP
from mpmcli.dataset.report import MOST_NAMED
from mpmcli.dataset.shard import LABELS, LEDGER, SPLITS, TABLES, group_name, open_shard
from mpmcli.errors import RunError
from mpmcli.output.durable import write_text
from mpmcli.plain_text import counted, one_line, size_text

CARD, MONTAGE = "README.md", "montage.png"


def write_card(directory: Path) -> Path:
    """Write the card of a dataset of which every trajectory has been tried, and return its path.

    Its bytes depend on the sweep and on the trajectories alone: not on times, machines, interrupts or parts. A
    picture montage.png that lies in the directory is shown.

    Raises:
        InputError: the directory holds no dataset, or a shard is missing or damaged.
        RunError: the disk refuses.
    """
    manifest = Manifest(directory)
    facts, rows = manifest.facts(), manifest.rows()
    sweep_text = (directory / SWEEP).read_text(encoding="utf-8")
    sweep = tomllib.loads(sweep_text)
    base = tomllib.loads((directory / BASE).read_text(encoding="utf-8"))
    included = [row for row in rows if row.accepted]
    found = _Found.of(directory, included)
    sections = [
        f"# {one_line(base.get('title') or 'Trajectories of particles')}",
        first_paragraph(sweep_text),
        "![Some of the trajectories](montage.png)" if (directory / MONTAGE).is_file() else "",
        _contents(found, included),
        _counts(facts["count"], rows),
        _left_out([row for row in rows if not row.accepted]),
        _drawn(sweep, included),
        _loading(included[0], found) if included else "",
        f"Drawn with seed {facts['seed']}; computed with mpmcli {facts['version']}. `sweep.toml` and `base.toml` are "
        "the sweep and its base scene.",
    ]
    try:
        write_text(directory / CARD, "\n\n".join(section for section in sections if section) + "\n")
    except OSError as error:
        raise RunError(f"{directory / CARD} could not be written ({error.strerror}); the dataset is kept.") from error
    return directory / CARD


def first_paragraph(text: str) -> str:
    """Return the comment that a TOML file begins with, up to its first empty line; editors' directives are left out."""
    lines = []
    for line in text.splitlines():
        said = line.removeprefix("#").strip()
        if not line.startswith("#") or (lines and not said):
            break
        if said and not line.startswith("#:"):
            lines.append(said)
    return "\n".join(lines)


@dataclass
class _Found:
    """What the trajectories in the shards have in common, and what they have not.

    Attributes:
        dimension: 2 or 3.
        lower, upper: corners of the box around all domains, m.
        spacings: of the grids, m; intervals: shortest and longest time between frames, s; durations: s.
        arrays: name and shape of what moves; laws: of the materials.
        bytes: of the shards.
    """

    dimension: int = 0
    lower: np.ndarray | None = None
    upper: np.ndarray | None = None
    spacings: set[float] = field(default_factory=set)
    intervals: set[float] = field(default_factory=set)
    durations: set[float] = field(default_factory=set)
    arrays: dict[str, tuple[int, ...]] = field(default_factory=dict)
    laws: set[str] = field(default_factory=set)
    bytes: int = 0

    @classmethod
    def of(cls, directory: Path, included: Sequence[Row]) -> "_Found":
        """Read the heads of all trajectories, one at a time."""
        found = cls()
        for name in sorted({row.file for row in included}):
            found.bytes += (directory / name).stat().st_size
            with open_shard(directory / name) as shard:
                for group in shard.values():
                    found._add(group)
        return found

    def _add(self, group: Any) -> None:
        header = json.loads(group.attrs["header"])
        lower = np.array(header["origin"])
        upper = lower + header["size"]
        self.dimension = header["dimension"]
        self.lower = lower if self.lower is None else np.minimum(self.lower, lower)
        self.upper = upper if self.upper is None else np.maximum(self.upper, upper)
        self.spacings.add(header["spacing"])
        self.laws |= set(header["materials"])
        times = group["time"][:]
        if len(times) > 1:
            self.intervals |= {float(f"{apart:.6g}") for apart in (np.diff(times).min(), np.diff(times).max())}
        self.durations.add(float(f"{times[-1]:.6g}"))
        moving = [name for name in group if name not in (*LABELS, *TABLES, LEDGER)]
        self.arrays |= {name: group[name].shape[2:] for name in moving}


def _range(values: Collection[float], unit: str = "") -> str:
    low, high = min(values), max(values)
    told = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"{told} {unit}".rstrip()


def _contents(found: _Found, included: Sequence[Row]) -> str:
    if not included:
        return "No trajectory is included."
    lower, upper = ([float(f"{x:.6g}") for x in corner.tolist()] for corner in (found.lower, found.upper))
    names = [f"`{name}` ({', '.join(['T', 'N', *map(str, shape)])})" for name, shape in found.arrays.items()]
    lines = [
        f"{counted(len(included), 'trajectory')} in {found.dimension}D, {size_text(found.bytes)}; T frames of the same "
        "N particles, in SI units:",
        "",
        f"* particles N: {_range([row.particles for row in included])}",
        f"* frames T: {_range([row.frames for row in included])}, with the initial one",
        f"* end: {_range(found.durations, 's')}",
        f"* domain: {lower} to {upper} m, cells of {_range(found.spacings, 'm')}",
        f"* laws: {', '.join(sorted(found.laws))}",
        f"* arrays: {', '.join(names)}",
    ]
    if found.intervals:
        lines.insert(4, f"* interval between frames: {_range(found.intervals, 's')}")
    return "\n".join(lines)


def _counts(expected: int, rows: Sequence[Row]) -> str:
    """Return a table of the trajectories by split and verdict."""
    verdicts = [verdict for verdict in VERDICTS if any(row.verdict == verdict for row in rows)]
    table = [("split", "computed", "included", *verdicts)]
    for split in (*SPLITS, "all"):
        own = [row for row in rows if split in ("all", row.split)]
        counts = Counter(row.verdict for row in own)
        told = [len(own), sum(row.accepted for row in own), *(counts[verdict] for verdict in verdicts)]
        table.append((split, *(f"{count:,}" for count in told)))
    return f"## Splits and verdicts\n\nOf {counted(expected, 'trajectory')} of the sweep:\n\n{_table(table)}"


def _left_out(rows: Sequence[Row]) -> str:
    """Return the reasons of the first trajectories that are not included."""
    if not rows:
        return ""
    lines = [f"* {row.number}, {row.verdict}: {_reason(row)}" for row in rows[:MOST_NAMED]]
    if len(rows) > MOST_NAMED:
        lines.append(f"* and {len(rows) - MOST_NAMED} more; `mpmcli dataset status --json` lists all")
    return "\n".join(["Left out:", "", *lines])


def _reason(row: Row) -> str:
    """Return the first line of a reason, without the path of the sweep on the machine that computed it."""
    first = (row.reason.splitlines() or [""])[0]
    _, told, rest = first.partition(f": trajectory {row.number}: ")
    return one_line(rest if told else first)


def _drawn(sweep: Mapping[str, Any], included: Sequence[Row]) -> str:
    """Return a table of the keys that vary, and what the included trajectories have drawn."""
    components: dict[str, DrawnComponent] = {}
    for row in included:
        for label, source, value in values_of(sweep, json.loads(row.draws)):
            components.setdefault(label, DrawnComponent(label, source)).add(value)
    rows = [(f"`{label}`", source, *rest) for label, source, *rest in (one.row for one in components.values())]
    if not rows:
        return ""
    method = sweep.get("method", "random")
    head = ("key", "drawn from", "min", "mean", "max", "values")
    return (
        f"## What varies\n\nWhat the included trajectories have drawn (method: {method}); a histogram has ten bins "
        f"from min to max.\n\n{_table([head, *rows])}"
    )


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Write rows below their head as a table of Markdown."""
    lines = [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows]
    return "\n".join([lines[0], f"|{' --- |' * len(rows[0])}", *lines[1:]])


def _loading(first: Row, found: _Found) -> str:
    """Return code that loads the first trajectory from the directory of the dataset, and from exports beside it."""
    return _LOADING.format(file=first.file, group=group_name(first.number), split=first.split, d=found.dimension)


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

With h5py alone:

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
