"""The sheets of particles that an emitter lets in: where they lie, how many there are, and when they come."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mpmcli.scene.primitives import grid_points
from mpmcli.scene.schema import Emitter, Scene
from mpmcli.scene.shapes import Shape

# Points along each axis of a mouth at which its area is measured, in 2D and 3D: to 3e-4 and to 1e-3.
_MEASURED = {2: 4096, 3: 768}
# Sheets that are a part of a period late count as in time.
_SLACK = 1e-9


@dataclass(frozen=True)
class Mouth:
    """The section of the shape of an emitter, and the lattice on it."""

    centre: np.ndarray  # (d,), m, in the coordinates of the scene
    direction: np.ndarray  # of the flow, (d,), of length 1
    across: np.ndarray  # d - 1 more axes, (d - 1, d)
    spacing: np.ndarray  # between sheets and between particles, m
    low: np.ndarray  # (d - 1,), m, where cell 0 of the lattice begins, from the centre
    counts: tuple[int, ...]  # cells along each axis across
    filled: np.ndarray  # which of the cells hold a particle, of shape `counts`
    area: float  # of the section, m^2 (m in 2D)

    @property
    def places(self) -> np.ndarray:
        """Where the particles of a sheet enter, (n, d), m."""
        cells = np.argwhere(self.filled)
        return self.centre + (self.low + (cells + 0.5) * self.spacing[1:]) @ self.across


@dataclass(frozen=True)
class Sheets:
    """All sheets of an emitter."""

    mouth: Mouth
    places: np.ndarray  # of the particles of one, (n, d), m
    count: int
    period: float  # between two of them, s
    start: float  # when the first one is due, s
    volume: float  # of a particle at rest, m^3 (m^2 in 2D)

    @property
    def particles(self) -> int:
        """Particles of all sheets."""
        return self.count * len(self.places)


def mouth_of(emitter: Emitter, h: float) -> Mouth:
    """Return the mouth of an emitter at grid spacing h, m."""
    return _mouth(emitter.shape, emitter.velocity, emitter.particles_per_cell, h)


@lru_cache(maxsize=64)
def _mouth(shape: Shape, velocity: tuple[float, ...], particles_per_cell: int, h: float) -> Mouth:
    d, form = len(velocity), shape.form
    direction = np.array(velocity) / np.linalg.norm(velocity)
    centre, axes, reach = _section(shape, direction)
    # The section, finely: its extent and its area.
    n = _MEASURED[d]
    steps = 2 * reach / n
    fine = grid_points(*[-r + (np.arange(n) + 0.5) * s for r, s in zip(reach, steps, strict=True)])
    inside = form.contains(centre + fine @ axes).reshape((n,) * (d - 1))
    area = float(inside.sum() * np.prod(steps))
    spacing = h / particles_per_cell ** (1 / d)
    low, counts, spacings = [], [], [spacing]
    for a in range(d - 1):
        line = np.flatnonzero(inside.any(axis=tuple(b for b in range(d - 1) if b != a)))
        first, last = (line[0], line[-1] + 1) if len(line) else (0, n)
        width = (last - first) * steps[a]
        # The lattice is stretched to fit the section.
        count = max(1, round(width / spacing))
        counts.append(count)
        spacings.append(width / count)
        low.append(-reach[a] + first * steps[a])
    cells = grid_points(*map(np.arange, counts))
    places = centre + (np.array(low) + (cells + 0.5) * np.array(spacings[1:])) @ axes
    filled = form.contains(places).reshape(counts)
    return Mouth(centre, direction, axes, np.array(spacings), np.array(low), tuple(counts), filled, area)


def most_in_mouth(emitter: Emitter, h: float) -> float:
    """Return a bound on the number of particles in a mouth, in a time that does not depend on it."""
    direction = np.array(emitter.velocity) / np.linalg.norm(emitter.velocity)
    spacing = h / emitter.particles_per_cell ** (1 / len(direction))
    return float(np.prod(np.maximum(1.0, 2 * _section(emitter.shape, direction)[2] / spacing)))


def _section(shape: Shape, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre of a shape, axes normal to a direction, (d - 1, d), and how far it reaches along them."""
    lower, upper = (np.array(bound, float) for bound in shape.form.bounds())
    # The axes of the scene that lie most across the flow, made normal to it.
    across: list[np.ndarray] = []
    for axis in np.argsort(np.abs(direction), kind="stable")[: len(direction) - 1]:
        vector = np.eye(len(direction))[axis]
        for other in (direction, *across):
            vector = vector - (vector @ other) * other
        across.append(vector / np.linalg.norm(vector))
    axes = np.array(across)
    return (lower + upper) / 2, axes, np.abs(axes) @ ((upper - lower) / 2)


def sheets_of(emitter: Emitter, scene: Scene) -> Sheets:
    """Return the sheets of an emitter of a scene.

    A sheet holds the material of a slice of the mouth that is as thick as sheets are apart, so that the flow is the
    area times the speed.
    """
    mouth = mouth_of(emitter, scene.domain.spacing)
    places = mouth.places
    period = float(mouth.spacing[0] / np.linalg.norm(emitter.velocity))
    slice_volume = mouth.area * float(mouth.spacing[0])
    count = sheets_until(emitter, scene, period)
    if emitter.particles is not None and len(places):
        count = min(count, max(1, round(emitter.particles / len(places))))
    if emitter.volume is not None and slice_volume > 0:
        count = min(count, max(1, round(emitter.volume / slice_volume)))
    return Sheets(mouth, places, count, period, emitter.start, slice_volume / max(1, len(places)))


def sheets_until(emitter: Emitter, scene: Scene, period: float) -> int:
    """Return how many sheets enter up to the end of an emitter, or of its scene."""
    end = min(scene.time.end, math.inf if emitter.end is None else emitter.end)
    return max(0, math.ceil((end - emitter.start) / period - _SLACK))


def emitted_volumes(scene: Scene) -> list[float]:
    """Return the volume at rest of all particles of each emitter, m^3 (m^2 in 2D)."""
    return [sheets.particles * sheets.volume for sheets in (sheets_of(emitter, scene) for emitter in scene.emitters)]
