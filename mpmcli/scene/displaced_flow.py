"""Flow of the material that moving colliders push, through what is open: its speed, and the strain that it imposes."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mpmcli.scene.colliders import Collider
from mpmcli.scene.domain import OPEN, STICKING
from mpmcli.scene.points import Points
from mpmcli.scene.primitives import grid_points
from mpmcli.scene.schema import Body, Scene

# Largest number of cells of the lattice, 2D and 3D; until then they are those of the grid.
CELLS = {2: 40_000, 3: 60_000}
# Instants at which the flow is determined, levels of its potential, and relative residual of the potential.
INSTANTS, LEVELS, RESIDUAL = 6, 512, 1e-3
# Time over which a velocity is measured, a fraction of the run.
MOMENT = 1e-4
# Resistance of a perfectly plastic medium to a bar that moves through it, in units of its shear strength (Randolph and
# Houlsby 1984). It bounds the strain where nothing is narrow.
AROUND = 12.0
# Pressure that drives a jet of water over density v^2, which is 1/2 without losses: measured in a nozzle of four cells.
JET = 4.0


@dataclass(frozen=True)
class DisplacedFlow:
    """Largest mean speed over a section of a flow, m/s; strain and mean shear rate, 1/s, of what flows through it.

    `fastest` is the speed of the colliders, m/s.
    """

    fastest: float = 0.0
    speed: float = 0.0
    strain: float = 0.0
    rate: float = 0.0

    def pressure(self, density: float, shear_stress: float) -> float:
        """Return the pressure, Pa, that pushes material of this shear stress, Pa, at `rate`, and makes its jet."""
        return self.strain * shear_stress + JET * density * max(
            (self.speed - self.fastest) * (self.speed + self.fastest), 0.0
        )


def displaced_flow(scene: Scene) -> DisplacedFlow:
    """Return the largest speed, strain and rate over several instants of a run, at the largest speed of the colliders.

    The flow is the potential flow from faces of prescribed motion that push material to those that recede, to open
    walls, and to what stays empty. Its mean speed over each section is exact, by continuity. As its rate of strain is
    admissible where walls slip, the pressure from the power that it dissipates is an upper bound (Prager and Hodge
    1951). Along surfaces that stick, a parabolic profile over the narrowest section is added.
    """
    pushing = [one for one in scene.colliders if one.driven and not one.holds]
    if not (pushing and scene.bodies):
        return DisplacedFlow()
    end = scene.time.end
    fastest = max(one.fastest(scene.domain, end) for one in pushing)
    if not fastest > 0:
        return DisplacedFlow()
    lattice = _Lattice(scene)
    # Squares of lengths and speeds may overflow; nothing is pushed then.
    with np.errstate(over="ignore", invalid="ignore"):
        flows = [_flow_at(lattice, pushing, time, fastest) for time in np.linspace(0, end * (1 - MOMENT), INSTANTS)]
    speed, strain, rate = (max(getattr(flow, key) for flow in flows) for key in ("speed", "strain", "rate"))
    return DisplacedFlow(fastest, speed, strain if speed > 1.05 * fastest else min(strain, AROUND), rate)


class _Lattice:
    """Cells of edge about `h`, m, in a domain, and the pairs of neighbours along each axis, lower and upper."""

    def __init__(self, scene: Scene) -> None:
        """Divide the domain into cells as large as those of the grid, or larger, so that there are about CELLS."""
        self.scene, d = scene, scene.dimension
        size, spacing = np.array(scene.domain.size), scene.domain.spacing
        self.h = float(spacing * np.ceil(max(1.0, np.prod(size / spacing / CELLS[d] ** (1 / d))) ** (1 / d)))
        self.counts = np.maximum(2, np.round(size / self.h)).astype(int)
        self.cell, self.origin = size / self.counts, np.array(scene.domain.origin)
        self.points = grid_points(*(np.arange(n) + 0.5 for n in self.counts)) * self.cell + self.origin
        number = np.arange(len(self.points)).reshape(self.counts)
        self.pairs = []
        for a, repeats in enumerate(scene.domain.periodic):
            kept = slice(None) if repeats else slice(-1)
            lower, upper = (np.moveaxis(each, a, 0)[kept] for each in (number, np.roll(number, -1, a)))
            self.pairs.append((lower.ravel(), upper.ravel()))

    @cached_property
    def open(self) -> np.ndarray:
        """Whether a cell is outside the colliders at rest."""
        still = [one for one in self.scene.colliders if not (one.driven or one.free or one.holds)]
        return np.all([self.points[:, 0] < np.inf, *(one.signed_distance(self.points) > 0 for one in still)], axis=0)

    @cached_property
    def filled(self) -> np.ndarray:
        """Whether a cell contains material at the start."""
        return np.any([self._holds(body) for body in self.scene.bodies], axis=0)

    def _holds(self, body: Body) -> np.ndarray:
        form = body.shape.form
        if not isinstance(form, Points):
            return form.contains(self.points)
        index = np.clip(((form.position - self.origin) / self.cell).astype(int), 0, self.counts - 1)
        found = np.zeros(len(self.points), bool)
        found[np.ravel_multi_index(tuple(index.T), tuple(self.counts))] = True
        return found

    def beside(self, words: frozenset[str]) -> np.ndarray:
        """Return whether a cell is beside a wall of the domain of one of these conditions."""
        found = np.zeros(self.counts, bool)
        for a, pair in enumerate(self.scene.domain.walls.faces(len(self.counts))):
            for face, word in zip((0, -1), pair, strict=True):
                np.moveaxis(found, a, 0)[face] |= word in words
        return found.ravel()


def _flow_at(lattice: _Lattice, pushing: list[Collider], time: float, fastest: float) -> DisplacedFlow:
    """Return the flow at one instant, with velocities scaled so that the fastest point has the speed `fastest`."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.csgraph import connected_components, dijkstra
    from scipy.sparse.linalg import cg

    points, pairs, filled = lattice.points, lattice.pairs, lattice.filled
    n, d, end = *points.shape, lattice.scene.time.end
    free, velocity = lattice.open.copy(), np.zeros((n, d))
    for one in pushing:
        inside = one.signed_distance(points, time) <= 0
        velocity[inside] = _velocity(one, points[inside], time, MOMENT * end)
        free &= ~inside
    velocity /= max(float(np.linalg.norm(velocity, axis=1).max()), 1e-9 * fastest)
    # Velocities of faces, each at its lower cell; they are those of the fastest point here.
    inflow, faces = np.zeros(n), np.zeros((d, n))
    for a, (lower, upper) in enumerate(pairs):
        for cell, solid, sign in ((lower, upper, -1.0), (upper, lower, 1.0)):
            flux = velocity[solid, a] * (free[cell] & ~free[solid] & filled[cell])
            np.add.at(inflow, cell, sign * flux)
            faces[a, lower] += flux
    pushed = float(inflow[inflow > 0].sum())
    if not pushed > 0:
        return DisplacedFlow()
    i, j = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    i, j = (ends[free[i] & free[j]] for ends in (i, j))
    graph = coo_array((np.ones(2 * len(i)), (np.append(i, j), np.append(j, i))), shape=(n, n)).tocsr()
    part = connected_components(graph)[1]
    reached = free & np.isin(part, part[inflow > 0])
    inflow[~reached] = 0.0
    # The displaced volume fills the empty cells next to the material, at most half of them.
    empty = np.flatnonzero(reached & ~filled)
    sink = reached & lattice.beside(frozenset({OPEN}))
    if len(empty):
        away = dijkstra(graph, indices=np.flatnonzero(reached & filled), unweighted=True, min_only=True)[empty]
        taken = min(pushed * fastest * end / lattice.h, len(empty) / 2)
        sink[empty[away >= np.sort(away)[int(taken)]]] = True
    # Where nothing is open the volume itself changes, evenly.
    shut = reached & ~np.isin(part, part[sink])
    inflow[shut] -= (np.bincount(part, inflow) / np.bincount(part))[part[shut]]
    inner = reached & ~sink
    links = np.maximum(np.asarray(graph.sum(axis=1)).ravel(), 1.0)
    matrix = (diags_array(links) - graph).tocsr()[inner][:, inner]
    potential = np.zeros(n)
    potential[inner] = cg(matrix, inflow[inner], rtol=RESIDUAL, maxiter=4000, M=diags_array(1 / links[inner]))[0]
    centre = np.zeros((n, d))
    for a, (lower, upper) in enumerate(pairs):
        faces[a, lower] += (free[lower] & free[upper]) * (potential[lower] - potential[upper])
        centre[:, a] += 0.5 * faces[a]
        centre[upper, a] += 0.5 * faces[a, lower]
    speed, section, least = _narrowest(potential, i, j)
    sticks = lattice.beside(STICKING)
    for one in lattice.scene.colliders:
        if one.wall == "stick" and not one.free:
            sticks |= one.signed_distance(points, time) < lattice.h
    # Beyond the narrowest section a jet does not expand.
    before = inner & (potential >= least)
    rate, along = _rates(centre, pairs, inner)[before], np.linalg.norm(centre[before & sticks], axis=1)
    strained = float(rate.sum() + along.sum())
    squares = float((rate**2).sum() + 6 / section ** (1 / (d - 1)) * (along**2).sum())
    return DisplacedFlow(
        fastest, speed * fastest, strained / pushed, squares / max(strained, 1e-9) * fastest / lattice.h
    )


def _velocity(one: Collider, points: np.ndarray, time: float, moment: float) -> np.ndarray:
    """Return the velocity, (n, d), m/s, of the points of a collider that are at `points` at a time, s."""
    (place, turn), (then, turned) = one.motion.pose(time), one.motion.pose(time + moment)
    return np.nan_to_num((then + (points - place) @ (turned @ turn.T).T - points) / moment)


def _narrowest(potential: np.ndarray, i: np.ndarray, j: np.ndarray) -> tuple[float, float, float]:
    """Return the largest mean speed over a surface of equal potential, its faces, and the lowest such potential."""
    low, high = np.minimum(potential[i], potential[j]), np.maximum(potential[i], potential[j])
    levels = np.quantile(potential[np.unique([i, j])], (np.arange(LEVELS) + 0.5) / LEVELS)
    crossing = np.zeros((2, LEVELS))
    for ends, sign in ((low, 1), (high, -1)):
        order = np.argsort(ends)
        passed = np.searchsorted(ends[order], levels, side="right")
        crossing += sign * np.stack([passed, np.append(0.0, np.cumsum((high - low)[order]))[passed]])
    mean = crossing[1] / np.maximum(crossing[0], 1)
    last = int((mean > 0.95 * mean.max()).argmax())
    return float(mean.max()), float(max(crossing[0, last], 1.0)), float(levels[last])


def _rates(velocity: np.ndarray, pairs: list[tuple[np.ndarray, np.ndarray]], inner: np.ndarray) -> np.ndarray:
    """Return sqrt(2 D:D) of cells, (n,), in units of 1/h, from differences between neighbours that are `inner`."""
    n, d = velocity.shape
    gradient = np.zeros((n, d, d))
    for b, (lower, upper) in enumerate(pairs):
        pair = inner[lower] & inner[upper]
        i, j = lower[pair], upper[pair]
        for cell in (i, j):
            gradient[cell, :, b] += velocity[j] - velocity[i]
        gradient[:, :, b] /= np.maximum(np.bincount(i, minlength=n) + np.bincount(j, minlength=n), 1)[:, None]
    return np.sqrt(0.5 * ((gradient + gradient.transpose(0, 2, 1)) ** 2).sum(axis=(1, 2)))
