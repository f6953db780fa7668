"""The formula: bars of the observables of a run from those of its siblings.

The bar of the grid takes the error as of first order, so that a difference of a grid r times coarser gives
|q_rh - q_h| / (r - 1), and the larger of those of two grids, but at least MARGIN of the smaller one: an error of first
order would equal its bar. Orders that three grids show are mostly spurious. Another choice of the model counts where
it moves an observable by more than that, any other cause by its largest difference. Differences are the largest within
WINDOW of the duration around each time: one that crosses 0 proves nothing. The bar is the root of the sum of squares of
the causes. docs/validation.md has the study.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mpmcli.error_bars.observables import DENSITY, QUATERNION, Series
from mpmcli.error_bars.siblings import LEVELS, Sibling
from mpmcli.output.directory import ERROR_BARS

# The file of bars in the directory ERROR_BARS of a result.
BARS = "error_bars.json"
# Share of the duration.
WINDOW = 0.05
# Smallest bar relative to the size of an observable: rounding of f32.
FLOOR = 1e-5
# Factor on the smaller of the differences of two grids.
MARGIN = 1.25
# Share of the size of an observable that another choice of the model moves it by at least, to count.
MATTERS = 0.01
# Factors on bars for a coverage of 90 and 95 %; the second if other causes than the grid and the model were varied.
FACTORS = {90: (1.0, 1.0), 95: (1.42, 1.18)}
# Runs have parted where gravity x (1 + 1e-6) moves this share of the mass on the map.
PARTED = 0.005
# A cause is named if it has this share of a bar.
NAMED = 0.3

Runs = Sequence[tuple[Sibling, Series]]


@dataclass(frozen=True)
class Bar:
    """One observable over time.

    Attributes:
        value: (K,) of the run, NaN where it or all siblings have none; 0 for the map of the mass, whose bar is the
            share of the mass that is elsewhere.
        bar: (K,), 0 where it has no value.
        causes: parts of the bar by cause, (K,).
        size: what it is compared with: the extent of the material, its energy, its speed, or its own range.
    """

    value: np.ndarray
    bar: np.ndarray
    causes: dict[str, np.ndarray]
    size: float

    def text(self, k: int) -> str:
        """Return the value and the bar at a time with one digit of the bar, two below 3, such as "0.83 ± 0.05"."""
        value, bar = float(self.value[k]), float(self.bar[k])
        if not 1e-7 <= bar < 1e5:
            return f"{value:.3g} ± {bar:.1g}"
        leading, power = f"{bar:.0e}".split("e")
        digits = max(0, (leading < "3") - int(power))
        return f"{value + 0.0:.{digits}f} ± {bar:.{digits}f}"

    def main_cause(self, k: int) -> str:
        """Return the causes that make a bar, the largest first; none if it is the FLOOR."""
        parts = sorted(((float(part[k]), cause) for cause, part in self.causes.items()), reverse=True)
        return ", ".join(cause for part, cause in parts if part > NAMED * self.bar[k])


@dataclass(frozen=True)
class Bars:
    """The bars of a run at K frames by observable, the map of the mass first.

    `parted`, s: see PARTED; `depends`: the observables that another choice of the model moves, by that choice.
    """

    time: np.ndarray
    of: dict[str, Bar]
    parted: float | None = None
    confidence: int = 90
    warnings: tuple[str, ...] = field(default=())
    depends: Mapping[str, list[str]] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "confidence_percent": self.confidence,
            "parted_s": self.parted,
            "warnings": list(self.warnings),
            "depends_on": dict(self.depends),
            "time_s": self.time.tolist(),
            "observables": {
                name: {
                    "value": one.value.tolist(),
                    "bar": one.bar.tolist(),
                    "size": one.size,
                    "causes": {cause: part.tolist() for cause, part in one.causes.items()},
                }
                for name, one in self.of.items()
            },
        }


def read_bars(directory: Path, times: np.ndarray) -> dict[str, Any] | None:
    """Return the stored study of a result in a directory; None without bars at its times."""
    path = directory / ERROR_BARS / BARS
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        return stored if np.array_equal(stored["time_s"], times) else None
    except (OSError, ValueError, KeyError):
        return None


def bars_of(base: Series, runs: Runs, confidence: int = 90, warnings: Sequence[str] = ()) -> Bars:
    """Return the bars of a run from the series of its siblings, which have the same times."""
    factor = FACTORS[confidence][any(sibling.cause not in LEVELS["grids"] for sibling, _ in runs)]
    sizes, found, depends = sizes_of(base), {}, {}
    coarse = {sibling.ratio: series for sibling, series in runs if sibling.cause == "grid"}
    for name in (DENSITY, *base.values):
        value = base.values.get(name, np.zeros(len(base.time)))
        parts: dict[str, list[np.ndarray]] = {}
        known = np.zeros(len(base.time), bool)
        for sibling, series in runs:
            # Another choice of the model is compared on the grid that it was computed on.
            other = coarse.get(sibling.ratio) if sibling.cause == "model" else base
            if other is None or (name != DENSITY and not (name in series.values and name in other.values)):
                continue
            # The map has no sign: the share of the mass that is elsewhere takes the place of a difference.
            gap = distance(series, other) if name == DENSITY else series.values[name] - other.values[name]
            known |= np.isfinite(value) & np.isfinite(gap)
            part = enveloped(gap, base.time) / (sibling.ratio - 1 if sibling.cause == "grid" else 1.0)
            if sibling.cause == "model":
                if not (part > np.fmax(np.max(parts.get("grid", [0.0]), axis=0), MATTERS * sizes[name])).any():
                    continue
                depends.setdefault(sibling.name, []).append(name)
            parts.setdefault(sibling.cause, []).append(part)
        if not known.any():
            continue
        causes = {cause: np.max(those, axis=0) for cause, those in parts.items()}
        if "grid" in causes:
            causes["grid"] = np.fmax(causes["grid"], MARGIN * np.min(parts["grid"], axis=0))
        squares = sum((part**2 for part in causes.values()), np.zeros(len(base.time)))
        bar = np.sqrt(factor**2 * squares + (FLOOR * sizes[name]) ** 2)
        found[name] = Bar(np.where(known, value, np.nan), np.where(known, bar, 0.0), causes, sizes[name])
    return Bars(base.time, found, parting(base, runs), confidence, tuple(warnings), depends)


def enveloped(difference: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Return the largest |difference|, (K,), within WINDOW of the duration around each time."""
    reach, size = WINDOW * (times[-1] - times[0]) * (1 + 1e-9), np.abs(difference)
    return np.array([np.nanmax(size[np.abs(times - t) <= reach], initial=0.0) for t in times])


def distance(one: Series, other: Series) -> np.ndarray:
    """Return the share of the mass that is elsewhere on the map, (K,)."""
    return np.abs(one.maps - other.maps).sum(axis=1) / 2


def parting(base: Series, runs: Runs) -> float | None:
    """Return the time, s, from which rounding alone parts runs; None if it does not."""
    far = [distance(series, base) > PARTED for sibling, series in runs if sibling.cause == "rounding"]
    parted = np.any(far, axis=0) if far else np.zeros(1, bool)
    return float(base.time[np.argmax(parted)]) if parted.any() else None


def sizes_of(base: Series) -> dict[str, float]:
    """Return the size of each observable, so that one that is conserved is compared with what moves."""

    def largest(part: str) -> float:
        found = [np.nanmax(np.abs(q)) for name, q in base.values.items() if part in name and np.isfinite(q).any()]
        return float(max(found, default=0.0)) or 1.0

    extent = float((base.reach.high - base.reach.low).max())
    energy, force = max(largest("energy.kinetic"), largest("energy.elastic")), largest(".force.")
    # With E = m v^2 / 2; the centre of what spins in place is at rest.
    momentum = math.sqrt(2 * base.mass * energy)
    speed = max(largest(".velocity."), momentum / base.mass if base.mass else 0.0)
    likes = {"velocity": speed, "energy": energy, "spin": extent * momentum}
    likes |= {"force": force, "torque": force * extent} | dict.fromkeys(("volume error", "angle", *QUATERNION), 1.0)
    likes |= dict.fromkeys(("low", "high", "centre", *"xyz"), extent)
    found = {DENSITY: 1.0}
    for name, q in base.values.items():
        parts = name.split(".")
        kind = next((part for part in (*parts[-2:], parts[0]) if part in likes), "")
        span = float(np.nanmax(q) - np.nanmin(q)) if np.isfinite(q).any() else 0.0
        found[name] = max(span, likes.get(kind, 0.0)) or 1.0
    return found
