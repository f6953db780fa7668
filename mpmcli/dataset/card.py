"""The card of a dataset, README.md in its directory: what varies, what was kept, how to load it."""

import json
import math
import tomllib
from array import array
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from mpmcli.dataset.folder import VERDICTS, Manifest, Row
from mpmcli.dataset.report import MOST_NAMED
from mpmcli.dataset.shard import BASE, LABELS, LEDGER, SPLITS, SWEEP, TABLES, group_name, open_shard
from mpmcli.errors import RunError
from mpmcli.output.checksums import NAME as CHECKSUMS
from mpmcli.output.durable import write_text
from mpmcli.plain_text import counted, markdown_table, one_line, size_text

CARD, MONTAGE = "README.md", "montage.png"
# Of a histogram; where values repeat and there are few, each is counted by itself.
BINS = 10
MOST_COUNTED = 6
LEVELS = "▁▂▃▄▅▆▇█"
EMPTY = "·"


def write_card(directory: Path) -> Path:
    """Write the card of a dataset of which every trajectory has been tried, and return its path.

    Its bytes depend on the sweep and on the trajectories alone: not on times, machines, interrupts or parts. A
    picture montage.png that lies in the directory is shown.
    """
    manifest = Manifest(directory)
    facts, rows = manifest.facts(), manifest.rows()
    sweep_text = (directory / SWEEP).read_text(encoding="utf-8")
    sweep = tomllib.loads(sweep_text)
    base = tomllib.loads((directory / BASE).read_text(encoding="utf-8"))
    included = [row for row in rows if row.accepted]
    heads = _Heads(directory, included)
    sections = [
        f"# {one_line(base.get('title') or 'Trajectories of particles')}",
        first_paragraph(sweep_text),
        "![Some of the trajectories](montage.png)" if (directory / MONTAGE).is_file() else "",
        _contents(heads, included) if included else "No trajectory is included.",
        _counts(facts["count"], rows),
        _left_out([row for row in rows if not row.accepted]),
        _drawn(sweep, included),
        _loading(included[0], heads.dimension) if included else "",
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


class _Heads:
    """What the heads of all included trajectories have in common, and what they have not: lengths in m, times in s."""

    def __init__(self, directory: Path, included: Sequence[Row]) -> None:
        self.dimension = self.bytes = 0
        self.lowers, self.uppers = [], []
        # Of the intervals between frames the shortest and the longest.
        self.spacings, self.intervals, self.durations, self.laws = set(), set(), set(), set()
        # What moves: the shape of a particle's value by name.
        self.arrays: dict[str, tuple[int, ...]] = {}
        for name in sorted({row.file for row in included}):
            self.bytes += (directory / name).stat().st_size
            with open_shard(directory / name) as shard:
                for group in shard.values():
                    self._add(group)

    def _add(self, group: h5py.Group) -> None:
        header, times = json.loads(group.attrs["header"]), group["time"][:]
        self.dimension = header["dimension"]
        self.lowers.append(np.array(header["origin"]))
        self.uppers.append(self.lowers[-1] + header["size"])
        self.spacings.add(header["spacing"])
        self.laws |= set(header["materials"])
        if len(times) > 1:
            self.intervals |= {_rounded(apart) for apart in (np.diff(times).min(), np.diff(times).max())}
        self.durations.add(_rounded(times[-1]))
        moving = [name for name in group if name not in (*LABELS, *TABLES, LEDGER, CHECKSUMS)]
        self.arrays |= {name: group[name].shape[2:] for name in moving}


def _rounded(value: float) -> float:
    return float(f"{value:.6g}")


def _range(values: Collection[float], unit: str = "") -> str:
    low, high = min(values), max(values)
    told = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"{told} {unit}".rstrip()


def _contents(heads: _Heads, included: Sequence[Row]) -> str:
    lower, upper = np.min(heads.lowers, axis=0).tolist(), np.max(heads.uppers, axis=0).tolist()
    names = [f"`{name}` ({', '.join(['T', 'N', *map(str, shape)])})" for name, shape in heads.arrays.items()]
    lines = [
        f"{counted(len(included), 'trajectory')} in {heads.dimension}D, {size_text(heads.bytes)}; T frames of the same "
        "N particles, in SI units:",
        "",
        f"* particles N: {_range([row.particles for row in included])}",
        f"* frames T: {_range([row.frames for row in included])}, with the initial one",
        f"* end: {_range(heads.durations, 's')}",
        f"* domain: {[*map(_rounded, lower)]} to {[*map(_rounded, upper)]} m, cells of {_range(heads.spacings, 'm')}",
        f"* laws: {', '.join(sorted(heads.laws))}",
        f"* arrays: {', '.join(names)}",
    ]
    if heads.intervals:
        lines.insert(4, f"* interval between frames: {_range(heads.intervals, 's')}")
    return "\n".join(lines)


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
        f"from min to max.\n\n{markdown_table(head, rows, range(len(head)))}"
    )


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


def _loading(first: Row, d: int) -> str:
    return _LOADING.format(file=first.file, group=group_name(first.number), split=first.split, d=d)


class DrawnComponent:
    """Values over all trajectories of one component of a key, such as "domain.gravity.1", drawn from `source`."""

    def __init__(self, label: str, source: str) -> None:
        self.label, self.source = label, source
        self._numbers = array("d")
        self._texts: Counter[str] = Counter()

    def add(self, value: Any) -> None:
        """Count a value: a finite number, or anything else that JSON holds."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            self._numbers.append(value)
        else:
            self._texts[value if isinstance(value, str) else json.dumps(value)] += 1

    @property
    def row(self) -> tuple[str, ...]:
        """Label, source, minimum, mean, maximum and distribution, as text; "" where there is none."""
        ends = ("", "", "")
        if self._numbers and not self._texts:
            # The exact sum does not depend on the order.
            mean = math.fsum(self._numbers) / len(self._numbers)
            ends = (number_text(min(self._numbers)), number_text(mean), number_text(max(self._numbers)))
        return (self.label, self.source, *ends, self._distribution())

    def _distribution(self) -> str:
        # Sorted as numbers; a key that draws texts has few of them.
        counts = Counter(map(number_text, sorted(self._numbers))) + self._texts
        repeated = len(counts) < max(len(self._numbers), 2)
        if (len(counts) <= MOST_COUNTED and repeated) or self._texts:
            told = [f"{value}: {count}" for value, count in list(counts.items())[:MOST_COUNTED]]
            return ", ".join([*told, "..."] if len(counts) > MOST_COUNTED else told)
        return f"`{histogram(self._numbers)}`"


def histogram(values: Sequence[float]) -> str:
    """Return bars of equal bins from the smallest to the largest value, which differ, as high as their counts."""
    low, high = min(values), max(values)
    counts = [0] * BINS
    for value in values:
        counts[min(BINS - 1, int(BINS * ((value - low) / (high - low))))] += 1
    most = max(counts)
    return "".join(LEVELS[-(-count * len(LEVELS) // most) - 1] if count else EMPTY for count in counts)


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
    """Write a distribution as the sweep file does; of one with bounds for each component, those of one."""
    if not isinstance(table, dict):
        return json.dumps(table)

    def written(name: str, given: Any) -> str:
        bounds = name not in ("choice", "grid") and component is not None
        if bounds and all(isinstance(one, list) for one in given):
            given = [one[component] for one in given]
        return f"{name} {json.dumps(given)}"

    return ", ".join(written(name, given) for name, given in table.items())
