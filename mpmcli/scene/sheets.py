"""The particles of an emitter, sheet after sheet: their positions, number and times of entry.

Particles enter a nozzle before the mouth, in which they keep their velocity. The stream hangs on them: if it began at
the mouth, it would fall freely over the width of the kernel, and be less dense.

A layer has a particle for each cell of the lattice on the mouth. It enters as one sheet, or as several in succession: a
slow stream stretched by gravity would tear between sheets that are a particle distance apart.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from mpmcli.scene.entry import tree_of, value_of, varies
from mpmcli.scene.primitives import grid_points
from mpmcli.scene.quadrature import largest_of
from mpmcli.scene.schema import Emitter, Scene
from mpmcli.scene.shapes import Shape

# Points along each axis of a mouth for its area, in 2D and 3D; the error is 3e-4 and 1e-3.
_MEASURED = {2: 4096, 3: 768}
# Sheets late by at most this fraction of a period count as on time.
_LATE_SHARE = 1e-9
# Instants at which a varying rate is integrated; a jump of the rate costs half an interval.
_INSTANTS = 2**15 + 1
# Speed, m/s, and area below which nothing flows.
_SLOWEST = _TINY = 1e-300
# Length of the nozzle before a mouth, cells: the kernel at the mouth is full.
_NOZZLE = 2.0
# Sheets per layer, if a layer is divided.
_PER_LAYER = 8
# Golden and plastic number, the smallest real roots above 1 of z^2 = z + 1 and z^3 = z + 1.
_ROOTS = {2: (1 + math.sqrt(5)) / 2, 3: 1.3247179572447460}


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
        """The middles of cells that hold a particle, (n, d), m."""
        return self.place(np.argwhere(self.filled) + 0.5)

    def place(self, cells: np.ndarray) -> np.ndarray:
        """Return places on the section, (n, d), m, of those on the lattice, (n, d - 1), in cells."""
        return self.centre + (self.low + cells * self.spacing[1:]) @ self.across


@dataclass(frozen=True)
class Sheets:
    """All sheets of an emitter."""

    mouth: Mouth
    size: int  # particles of one; the last one may have fewer
    per_layer: int  # sheets of a layer
    particles: int  # of all sheets
    period: float  # between two of them at the largest speed, s
    lead: float  # length of the nozzle: how far before the mouth particles enter, m
    due: np.ndarray  # when each enters, (count,), s
    speeds: np.ndarray  # at which each enters, (count,), m/s
    volume: float  # of a particle at rest, m^3 (m^2 in 2D)

    @property
    def count(self) -> int:
        return -(-self.particles // max(1, self.size))

    @property
    def stretches(self) -> np.ndarray:
        """Time from each sheet to the next one over `period`, (count,)."""
        return np.diff(self.due, append=self.due[-1:] + self.period) / self.period

    @property
    def early(self) -> float:
        """How long before it passes the mouth a particle enters, s."""
        return self.lead / float(self.speeds[0]) if self.lead and self.count else 0.0

    def passed(self, times: Sequence[float]) -> np.ndarray:
        """Return how many particles have passed the mouth at some times, s, if none was blocked."""
        return np.minimum(np.searchsorted(self.due + self.early, times, "right") * self.size, self.particles)

    def velocities(self) -> np.ndarray:
        """Return the velocities at which all particles enter, (n, d), m/s."""
        return self.speeds[np.arange(self.particles) // self.size, None] * self.mouth.direction

    def places(self, emitter: Emitter) -> np.ndarray:
        """Return the positions of entry of all particles, (n, d), m, in the order of entry: `lead` before the mouth.

        The particles of a partial sheet lie in front of the mouth, as if each had entered at its own time since the
        previous sheet.
        """
        mouth, number = self.mouth, np.arange(self.particles)
        filled = np.argwhere(mouth.filled)
        if emitter.sampling == "lattice":
            return mouth.place(filled[number % len(filled)] + 0.5) - self.lead * mouth.direction
        if emitter.sampling == "jittered":
            layers = -(-self.particles // len(filled))
            random = np.random.default_rng(emitter.seed).random((layers, len(filled), len(mouth.centre)))
            order = np.argsort(random[..., 0], axis=1)
            random = np.take_along_axis(random, order[..., None], axis=1)
            due = ((np.arange(layers)[:, None] + random[..., 0]) * (len(filled) / self.size)).reshape(-1)[number]
            cells = (filled[order] + random[..., 1:]).reshape(-1, len(mouth.counts))[number]
        else:
            cells, due = _even_cells(mouth, emitter.shape, self.particles), (number + 0.5) / self.size
        ahead = (number // self.size + 1 - due) * (mouth.spacing[0] * self.size / max(1, len(filled)))
        return mouth.place(cells) + (ahead[:, None] - self.lead) * mouth.direction


def _even_cells(mouth: Mouth, shape: Shape, count: int) -> np.ndarray:
    """Return points of an even sequence on the lattice of a mouth, (count, d - 1), in cells.

    Point k of the sequence is (k / r mod 1, k / r^2 mod 1), r the golden number in 2D and the plastic one in 3D. With k
    as an additional coordinate they are points of a lattice whose points stay apart under any stretch along that
    coordinate (docs/theory.md, 5.13).
    """
    # A fraction of the lattice is filled, and about the same fraction of the sequence is used.
    many, d = 16 + int(1.1 * count * mouth.filled.size / max(1, mouth.filled.sum())), len(mouth.centre)
    steps = _ROOTS[d] ** -np.arange(1.0, d)
    while True:
        cells = (0.5 + np.arange(many)[:, None] * steps) % 1.0 * mouth.counts
        cells = cells[shape.form.contains(mouth.place(cells))]
        if len(cells) >= count:
            return cells[:count]
        many *= 2


def mouth_of(emitter: Emitter, h: float) -> Mouth:
    """Return the mouth of an emitter at grid spacing h, m."""
    return _mouth(emitter.shape, emitter.velocity, emitter.particles_per_cell, h)


@lru_cache(maxsize=64)
def _opening(shape: Shape, velocity: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """Return direction, centre, axes, reach, steps of a fine lattice across, and which of its points are inside."""
    d, form = len(velocity), shape.form
    direction = np.array(velocity) / np.linalg.norm(velocity)
    centre, axes, reach = _section(shape, direction)
    # A fine sampling of the section gives its extent and its area.
    n = _MEASURED[d]
    steps = 2 * reach / n
    fine = grid_points(*[-r + (np.arange(n) + 0.5) * s for r, s in zip(reach, steps, strict=True)])
    return direction, centre, axes, reach, steps, form.contains(centre + fine @ axes).reshape((n,) * (d - 1))


def _area(shape: Shape, velocity: tuple[float, ...]) -> float:
    """Return the area of the section, m^2 (m in 2D)."""
    *_, steps, inside = _opening(shape, velocity)
    return float(inside.sum() * np.prod(steps))


@lru_cache(maxsize=64)
def _mouth(shape: Shape, velocity: tuple[float, ...], particles_per_cell: int, h: float) -> Mouth:
    """Return the mouth of an emitter: its axes, and a lattice that fits its section, with the cells that are inside."""
    d, form = len(velocity), shape.form
    direction, centre, axes, reach, steps, inside = _opening(shape, velocity)
    area, n = _area(shape, velocity), _MEASURED[d]
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
    """Return a bound on the number of particles in a mouth, in constant time."""
    direction = np.array(emitter.velocity) / np.linalg.norm(emitter.velocity)
    spacing = h / emitter.particles_per_cell ** (1 / len(direction))
    return float(np.prod(np.maximum(1.0, 2 * _section(emitter.shape, direction)[2] / spacing)))


def _section(shape: Shape, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the centre of a shape, axes normal to a direction, (d - 1, d), and its extent along them."""
    lower, upper = (np.array(bound, float) for bound in shape.form.bounds())
    # The scene axes closest to normal to the flow, made normal to it.
    across: list[np.ndarray] = []
    for axis in np.argsort(np.abs(direction), kind="stable")[: len(direction) - 1]:
        vector = np.eye(len(direction))[axis]
        for other in (direction, *across):
            vector = vector - (vector @ other) * other
        across.append(vector / np.linalg.norm(vector))
    axes = np.array(across)
    return (lower + upper) / 2, axes, np.abs(axes) @ ((upper - lower) / 2)


def sheets_in(scene: Scene) -> list[Sheets]:
    """Return the sheets of each emitter of a scene."""
    return [sheets_of(emitter, scene) for emitter in scene.emitters]


def sheets_of(emitter: Emitter, scene: Scene) -> Sheets:
    """Return the sheets of an emitter of a scene.

    A layer contains the material of a slice of the mouth as thick as the distance of the lattice sheets, so that the
    volume flow is the area times the speed.
    """
    mouth = mouth_of(emitter, scene.domain.spacing)
    layer, whole = int(mouth.filled.sum()), emitter.sampling == "lattice"
    size = layer if whole else max(1, round(layer / _PER_LAYER))
    volume = mouth.area * float(mouth.spacing[0]) / max(1, layer)
    speed = fastest_inflow(emitter, scene.time.end)
    period = float(mouth.spacing[0] / max(speed, _SLOWEST)) * size / max(1, layer)
    step = size if whole else 1
    lead = _lead(emitter, scene, mouth)
    early = lead / max(speed, _SLOWEST)
    totals = [most_until_end(emitter, scene, period, size, early)]
    totals += [emitter.particles] * (emitter.particles is not None)
    if emitter.volume is not None and volume > 0:
        totals.append(emitter.volume / volume)
    particles = step * max(1, round(min(totals) / step)) if totals[0] and layer else 0
    number = np.arange(-(-particles // max(1, size)))
    due, speeds = emitter.start - early + number * period, np.full(len(number), speed)
    if varies(emitter.rate):
        times, flown = _flow(emitter, scene)
        due = np.interp(number * size * volume, flown, times)
        middle = np.interp((number + 0.5) * size * volume, flown, times)
        speeds = np.maximum(value_of(emitter.rate, t=middle), 0.0) / mouth.area
    return Sheets(mouth, size, max(1, round(layer / max(1, size))), particles, period, lead, due, speeds, volume)


def _lead(emitter: Emitter, scene: Scene, mouth: Mouth) -> float:
    """Return the length of the nozzle of an emitter, m: up to the next face, body or collider, 0 if its rate varies."""
    lead, step = 0.0, 0.25 * scene.domain.spacing
    lower = np.array(scene.domain.origin)
    upper = lower + scene.domain.size
    for k in range(1, 1 if varies(emitter.rate) else 1 + round(4 * _NOZZLE)):
        places = mouth.places - k * step * mouth.direction
        taken = ~((places >= lower) & (places <= upper)).all()
        taken = taken or any(body.shape.form.contains(places).any() for body in scene.bodies)
        if taken or any((collider.signed_distance(places) < 0).any() for collider in scene.colliders):
            break
        lead = k * step
    return lead


def fastest_inflow(emitter: Emitter, end: float) -> float:
    """Return the largest speed of the inflow of an emitter in a scene until `end`, s: m/s."""
    if emitter.rate is None:
        return float(np.linalg.norm(emitter.velocity))
    until = end if emitter.end is None else min(end, emitter.end)
    return largest_of(tree_of(emitter.rate), emitter.start, until) / max(_area(emitter.shape, emitter.velocity), _TINY)


def _flow(emitter: Emitter, scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return times, s, and the volume that has flown in until then, m^3 (m^2 in 2D)."""
    until = scene.time.end if emitter.end is None else min(scene.time.end, emitter.end)
    times = np.linspace(emitter.start, until, _INSTANTS)
    rates = np.maximum(np.broadcast_to(value_of(emitter.rate, t=times), times.shape), 0.0)
    return times, np.concatenate([[0.0], np.cumsum((rates[1:] + rates[:-1]) / 2 * np.diff(times))])


def most_until_end(emitter: Emitter, scene: Scene, period: float, size: int, early: float = 0.0) -> int:
    """Return the number of particles that enter until the end of an emitter or its scene, in sheets of a size.

    They enter `early` before they pass the mouth, s: the nozzle is full at the end of the scene.
    """
    end = min(scene.time.end + early, math.inf if emitter.end is None else emitter.end)
    sheets = (end - emitter.start) / period
    if varies(emitter.rate) and end > emitter.start:
        mouth = mouth_of(emitter, scene.domain.spacing)
        sheets = _flow(emitter, scene)[1][-1] / (mouth.area * float(mouth.spacing[0])) * mouth.filled.sum() / size
    return max(0, math.ceil(sheets - _LATE_SHARE)) * size
