"""How strongly gravity and forces drive a scene: where its particles start and as far as they can get, pulses included.

A force of the place is looked at where particles start, and in the cells of a lattice that they can reach: at most as
far as they move freely under the forces of their start. Cells in which interval arithmetic allows more than was found
are halved, so that a narrow force is found.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mpmcli.scene.entry import Entry, value_of, varies
from mpmcli.scene.expression import INITIAL, POSITION, Apply, Expression, Tree, names_in
from mpmcli.scene.intervals import bounds_of
from mpmcli.scene.quadrature import parts_of
from mpmcli.scene.schema import Body, Force, Scene

# Equal parts of a run beside those in which what depends on time alone varies, and parts at most.
SLICES, MOST_SLICES = 32, 400
# Cells along each axis of the lattice in 2D and 3D, and how often those that may hold more are halved; at most so many.
CELLS, HALVINGS, MOST_CELLS = {2: 16, 3: 8}, 10, 4096
# Particles of a body that are looked at.
MOST_PLACES = 4096
# Instants at which cells are halved: those of the strongest forces.
SEARCHED = 3


@dataclass(frozen=True)
class Drive:
    """An acceleration over a run.

    Attributes:
        largest: its largest magnitude, m/s^2.
        impulse: integral over the run of the largest magnitude at each time, m/s.
    """

    largest: float = 0.0
    impulse: float = 0.0


@dataclass(frozen=True)
class Slices:
    """Parts of a run in each of which no pulse hides, and the times at which they are looked at.

    Attributes:
        lengths: of the parts, (n,), s.
        times: (m,), s: the middle of each part, and where what depends on time alone is largest in it.
        part: index of the part of each time, (m,).
    """

    lengths: np.ndarray
    times: np.ndarray
    part: np.ndarray

    def largest(self, values: np.ndarray) -> np.ndarray:
        """Return the largest of the values at the times of each part, (n,)."""
        found = np.zeros(len(self.lengths))
        np.maximum.at(found, self.part, values)
        return found


def slices_of(entries: tuple[Entry, ...], end: float) -> Slices:
    """Divide a run of `end` seconds for some entries."""
    edges, peaks = [np.linspace(0.0, end, SLICES + 1)], [np.array([0.0, end])]
    for tree in {tree for entry in entries if isinstance(entry, Expression) for tree in _timed(entry.tree)}:
        parts = parts_of(tree, 0.0, end, precise=False)
        chosen = slice(None, None, len(parts.low) // MOST_SLICES + 1)
        edges += [parts.low[chosen], parts.high[chosen]]
        each = np.arange(len(parts.low))
        for node in (parts.values.argmax(axis=1), parts.values.argmin(axis=1)):
            times = parts.times()[each, node]
            # Of more parts than are looked at, those with the largest values.
            peaks.append(times[np.argsort(-np.abs(parts.values[each, node]), kind="stable")[:MOST_SLICES]])
    found = np.unique(np.concatenate(edges))
    times = np.unique(np.concatenate([0.5 * (found[1:] + found[:-1]), *peaks]))
    part = np.clip(np.searchsorted(found, times, side="right") - 1, 0, len(found) - 2)
    return Slices(np.diff(found), times, part)


def _timed(tree: Tree) -> Iterator[Tree]:
    """Yield the largest parts of a tree that depend on time alone."""
    names = names_in(tree)
    if names == {"t"}:
        yield tree
    elif "t" in names and isinstance(tree, Apply):
        for argument in tree.arguments:
            yield from _timed(argument)


def gravity_drive(scene: Scene) -> tuple[Drive, list[np.ndarray]]:
    """Return how strongly gravity acts, and its values, (d,), m/s^2, at instants of the run."""
    if scene.domain.steady:
        gravity = scene.domain.gravity_at(0.0)
        size = float(np.linalg.norm(gravity))
        return Drive(size, size * scene.time.end), [gravity]
    slices = slices_of(scene.domain.gravity, scene.time.end)
    times = slices.times
    columns = [np.broadcast_to(value_of(entry, t=times), times.shape) for entry in scene.domain.gravity]
    values = np.nan_to_num(np.stack(columns, axis=1))
    with np.errstate(over="ignore"):
        sizes = np.linalg.norm(values, axis=1)
    return Drive(float(sizes.max()), float(slices.largest(sizes) @ slices.lengths)), list(values)


def force_drive(scene: Scene, body: Body, places: np.ndarray, speed: float, gravity: Drive) -> Drive:
    """Return how strongly forces act on a body, magnitudes added up.

    Args:
        scene: with the forces.
        body: that they act on.
        places: where its particles start, (n, d), m; MOST_PLACES of them are used.
        speed: largest at the start, m/s; gravity: that acts as well.
    """
    found = [_one(scene, force, places, speed, gravity) for force in scene.forces if force.body in (None, body.name)]
    return Drive(sum(one.largest for one in found), sum(one.impulse for one in found))


def _one(scene: Scene, force: Force, places: np.ndarray, speed: float, gravity: Drive) -> Drive:
    end = scene.time.end
    if not varies(*force.acceleration):
        size = float(np.linalg.norm(force.acceleration))
        return Drive(size, size * end)
    names = frozenset().union(*(entry.names for entry in force.acceleration if varies(entry)))
    still = Slices(np.array([end]), np.array([0.0]), np.array([0]))
    slices = slices_of(force.acceleration, end) if "t" in names else still
    places = places[:: len(places) // MOST_PLACES + 1]
    times = slices.times.tolist()
    strongest = np.array([_largest(force, t, places, places) for t in times])
    way = (speed + gravity.impulse + float(slices.largest(strongest) @ slices.lengths)) * end
    if names & set(POSITION):
        low, high = _cells(scene, places, way)
        # At the middles of the cells that particles can reach, from wherever they started.
        for start in (places[0], places[-1], places[len(places) // 2]):
            there = np.array([_largest(force, t, 0.5 * (low + high), start[None]) for t in times])
            strongest = np.maximum(strongest, there)
        begun = places.min(axis=0), places.max(axis=0)
        for k in np.argsort(strongest)[-SEARCHED:]:
            strongest[k] = _search(force, times[k], low, high, begun, float(strongest[k]))
    return Drive(float(strongest.max()), float(slices.largest(strongest) @ slices.lengths))


def _cells(scene: Scene, places: np.ndarray, way: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners, (n, d), m, of the cells of the lattice that something within `way` of a place meets."""
    d, domain = scene.dimension, scene.domain
    size = np.array(domain.size) / CELLS[d]
    index = np.stack(np.meshgrid(*[np.arange(CELLS[d])] * d, indexing="ij"), axis=-1).reshape(-1, d)
    low = np.array(domain.origin) + index * size
    middle = low + size / 2
    near = np.full(len(low), np.inf)
    for place in np.array_split(places, max(1, len(places) * len(low) // 1_000_000)):
        apart = np.linalg.norm(middle[:, None] - place[None], axis=2).min(axis=1)
        near = np.minimum(near, apart)
    reached = near <= way + float(np.linalg.norm(size)) / 2
    return low[reached], (low + size)[reached]


def _largest(force: Force, time: float, x: np.ndarray, X: np.ndarray) -> float:
    """Return the largest finite magnitude at a time, s, of particles at x that started at X, m/s^2."""
    values = dict(zip(POSITION, x.T, strict=False)) | dict(zip(INITIAL, X.T, strict=False))
    squares = np.asarray(sum(np.square(value_of(entry, t=time, **values)) for entry in force.acceleration))
    # What is not finite somewhere is so for no particle, or stops the run.
    return float(np.max(squares, initial=0.0, where=np.isfinite(squares))) ** 0.5


def _search(
    force: Force, time: float, low: np.ndarray, high: np.ndarray, begun: tuple[np.ndarray, np.ndarray], found: float
) -> float:
    """Return the largest magnitude in some cells, where bounds are finite; at least `found`."""
    d = low.shape[1]
    instant = np.float64(time)
    for _ in range(HALVINGS):
        ranges = {"t": (instant, instant)}
        ranges |= {name: (low[:, a], high[:, a]) for a, name in enumerate(POSITION[:d])}
        ranges |= {name: (begun[0][a], begun[1][a]) for a, name in enumerate(INITIAL[:d])}
        squares = np.zeros(len(low))
        for entry in force.acceleration:
            if isinstance(entry, Expression):
                least, most = bounds_of(entry.tree, ranges)
                squares = squares + np.maximum(np.abs(least), np.abs(most)) ** 2
            else:
                squares = squares + entry**2
        bound = np.sqrt(squares)
        middle = 0.5 * (low + high)
        X = np.clip(middle, *begun)
        found = max(found, _largest(force, time, middle, X))
        # A twentieth more is no reason to look on; nor is a place where nothing bounds the force, a pole.
        open_cells = np.flatnonzero((bound > 1.05 * found) & np.isfinite(bound))
        if not len(open_cells):
            break
        best = open_cells[np.argsort(bound[open_cells])[-MOST_CELLS // 2**d :]]
        low, middle, high = low[best], middle[best], high[best]
        corners = np.stack(np.meshgrid(*[[False, True]] * d, indexing="ij"), axis=-1).reshape(-1, d)
        upper = np.concatenate([np.where(corner, high, middle) for corner in corners])
        low = np.concatenate([np.where(corner, middle, low) for corner in corners])
        high = upper
    return found
