"""Heights of the water measured in a dam break on an obstacle (Kleefsman et al. 2005), and those of particles."""

import math
import tomllib
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np

# The gauges stand in the middle of the width, m.
MIDDLE = 0.5
# A gauge is reached by the water where it reads this much, m. A dry one reads up to 1.5 mm.
WET = 0.01
# Half the width of the columns in which the water of a simulation is measured, m.
REACH = 1 / 16
# The face of the obstacle that the front meets, m, its speed, m/s, from its times at x = 1.488 and 0.992 m, and when
# it meets it, s.
FACE = 0.8245
SPEED = (1.488 - 0.992) / (0.358 - 0.194)
IMPACT = 0.358 + (0.992 - FACE) / SPEED
# The front is where all but this share of the water is behind: what is left are drops and a film.
FILM = 0.001


@dataclass(frozen=True)
class Gauge:
    """Where a height was measured, and what it was.

    Attributes:
        x: m.
        arrival: the first time with more than WET, s.
        time: (n,), s.
        height: (n,), m.
    """

    x: float
    arrival: float
    time: np.ndarray
    height: np.ndarray

    def mean_error(self, time: np.ndarray, height: np.ndarray, last: float) -> float:
        """Return the mean of |height - measured| from the arrival to a last time, over the mean of the measured.

        Args:
            time, height: (m,), a computed curve, s and m; must extend to the last time.
        """
        here = (self.time > self.arrival) & (self.time <= last * (1 + 1e-9))
        known = self.height[here]
        return float(np.mean(np.abs(np.interp(self.time[here], time, height) - known)) / np.mean(known))


@lru_cache
def measured() -> dict[str, Gauge]:
    """Return the gauges by name, H1 to H4."""
    tables = tomllib.loads(files("mpmcli.validation").joinpath("data/kleefsman.toml").read_text(encoding="utf-8"))
    time = np.array(tables["time"])
    return {row["name"]: Gauge(row["x"], row["arrival"], time, np.array(row["height"])) for row in tables["gauge"]}


def water_height(position: np.ndarray, x: float, volume: float, reach: float = REACH) -> float:
    """Return how high the water of a column stands, m: its volume over its floor, so that a lone drop adds little.

    The column has no edge that a particle could jump over: what it holds counts by a hat function along both axes,
    one in the middle and zero at `reach`.

    Args:
        position: (n, 3), m.
        x: where the gauge stands, m.
        volume: that of a particle, m^3.
        reach: m.
    """
    off = np.abs(position[:, :2] - [x, MIDDLE]) / reach
    return volume * float(np.prod(np.maximum(1 - off, 0.0), axis=1).sum()) / reach**2


def impact(time: np.ndarray, front: np.ndarray) -> float:
    """Return when the front, which comes from larger x, is at the obstacle, s."""
    return float(np.interp(-FACE, -front, time))


def arrival(time: np.ndarray, value: np.ndarray, level: float = WET) -> float:
    """Return when a curve, such as the height at a gauge, rises above a level, s; nan where it never does."""
    above = value > level
    if not above.any():
        return math.nan
    k = int(np.argmax(above))
    return float(np.interp(level, value[k - 1 : k + 1], time[k - 1 : k + 1])) if k else float(time[0])
