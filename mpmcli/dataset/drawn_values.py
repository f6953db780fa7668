"""What the trajectories of a dataset have drawn, one component at a time: range, mean and histogram."""

import json
import math
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# Of a histogram; where values repeat and there are few, each is counted by itself.
BINS = 10
MOST_COUNTED = 6
LEVELS = "▁▂▃▄▅▆▇█"
EMPTY = "·"


class DrawnComponent:
    """Values of one component of a key, such as "domain.gravity.1", over all trajectories.

    Args:
        label: key and component.
        source: what it is drawn from, as the sweep file says it.
    """

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


def placements(sweep: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the tables [place] of a sweep file, of which there may be one, a list or none."""
    place = sweep.get("place", [])
    return [place] if isinstance(place, dict) else place


def values_of(sweep: Mapping[str, Any], drawn: Mapping[str, Any]) -> Iterator[tuple[str, str, Any]]:
    """Yield label, source and value of each component that a trajectory has drawn, in the order of the sweep file.

    Args:
        sweep: parsed TOML of the sweep file.
        drawn: `Draw.values`.
    """
    for key, table in sweep.get("vary", {}).items():
        if key in drawn:
            yield from _components(key, table, drawn[key])
    for place in placements(sweep):
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
