"""What is compared between a scene and its siblings: numbers of each frame, and a coarse map of the mass."""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from mpmcli.error_bars.siblings import Reach
from mpmcli.errors import InputError
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.scene.domain import PERIODIC
from mpmcli.scene.expression import Expression, ExpressionError
from mpmcli.scene.expression_reader import parse
from mpmcli.scene.quantity import AXES

# The map of the mass, always first.
DENSITY = "density"
# Parts of the quaternion of a rigid body, the real part first.
QUATERNION = ("q0", "q1", "q2", "q3")
# Cells of the scene per cell of the map: two of the coarsest grid.
MAP_CELLS = 4
# Shares of the mass of a body beyond its extents on either side.
TAIL = 0.01
# Names in expressions: place, velocity, time.
NAMES = (*AXES, "vx", "vy", "vz", "t")


@dataclass(frozen=True)
class Map:
    """Nodes, (M,) in all, with hat functions: lower corner (d,), m, edge, m, and nodes per axis."""

    low: np.ndarray
    edge: float
    shape: tuple[int, ...]

    @staticmethod
    def of(scene: Scene) -> "Map":
        """Return the map on which a scene is compared with its siblings."""
        edge = MAP_CELLS * scene.domain.spacing
        shape = tuple(math.ceil(size / edge) + 4 for size in scene.domain.size)
        return Map(np.array(scene.domain.origin) - edge, edge, shape)

    def shares(self, x: np.ndarray, mass: np.ndarray) -> np.ndarray:
        """Return the share of the mass at each node, (M,), of particles at x, (n, d)."""
        place = np.clip((x - self.low) / self.edge, 0, np.array(self.shape) - 1.001)
        cell = np.floor(place).astype(int)
        part, total = place - cell, np.zeros(math.prod(self.shape))
        for corner in np.ndindex(*(2,) * x.shape[1]):
            weight = np.prod(np.where(np.array(corner) == 1, part, 1 - part), axis=1) * mass
            total += np.bincount(np.ravel_multi_index((cell + corner).T, self.shape), weight, len(total))
        return total / max(mass.sum(), np.finfo(float).tiny)


@dataclass
class Series:
    """Observables of a run at K frames.

    Attributes:
        time: (K,), s.
        values: (K,) by name; NaN where there is none.
        maps: (K, M), shares of the mass.
        reach: of particles and rigid bodies; `mass`: theirs, the largest, kg; `seconds`: wall time without
            compilation; `steps`, `particles`: counts.
    """

    time: np.ndarray
    values: dict[str, np.ndarray]
    maps: np.ndarray
    reach: Reach
    mass: float = 0.0
    seconds: float = 0.0
    steps: int = 0
    particles: int = 0


@dataclass
class Observer:
    """Collects the observables of the frames of a run of a scene with some particles."""

    scene: Scene
    particles: Iterable[BodyParticles]
    map: Map
    observed: Mapping[str, Expression] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Prepare for frames: masses, kg, sizes of rigid bodies, m, and axes along which places have an origin."""
        self._mass = np.concatenate([np.empty(0), *(np.full(body.count, body.mass) for body in self.particles)])
        self.particles = ()
        d = self.scene.dimension
        free = [collider for collider in self.scene.colliders if collider.free]
        boxes = [np.array(collider.form.bounds()) for collider in free]
        self._radii = [float(np.linalg.norm(high - low)) / 2 for low, high in boxes]
        self._rigid = {collider.name: collider.moments.mass for collider in free}
        faces = self.scene.domain.walls.faces(d)
        # Places along a periodic axis have no origin.
        self._axes = [k for k in range(d) if PERIODIC not in faces[k]]
        self._times: list[float] = []
        self._heaviest = 0.0
        self._rows: list[dict[str, float]] = []
        self._maps: list[np.ndarray] = []
        self._bounds: list[tuple[np.ndarray, np.ndarray]] = []

    def take(self, frame: Frame, row: LedgerRow) -> None:
        """Add a frame with all its particles."""
        present = frame.of_present
        mass = self._mass if present.id is None else self._mass[present.id]
        x = present.position.astype(float)
        self._times.append(row.time)
        self._heaviest = max(self._heaviest, row.mass + sum(self._rigid.values()))
        self._rows.append(self._observe(x, present, mass, row))
        self._maps.append(self.map.shares(x, mass).astype(np.float32))
        d = self.scene.dimension
        bounds = [(x.min(0), x.max(0))] if len(x) else []
        for pose, radius in zip(row.rigid_pose, self._radii, strict=True):
            bounds.append((np.array(pose[:d]) - radius, np.array(pose[:d]) + radius))
        if bounds:
            lows, highs = zip(*bounds, strict=True)
            self._bounds.append((np.min(lows, 0), np.max(highs, 0)))

    def taken(self, frames: Iterable[Frame], ledger: Iterable[LedgerRow]) -> Series:
        """Return the observables of all frames of a run."""
        for frame, row in zip(frames, ledger, strict=True):
            self.take(frame, row)
        return self.series()

    def series(self) -> Series:
        """Return the observables of the frames taken."""
        # A body that enters later has no values before.
        names = dict.fromkeys(name for row in self._rows for name in row)
        values = {name: np.array([row.get(name, math.nan) for row in self._rows]) for name in names}
        domain = self.scene.domain
        whole = np.array(domain.origin), np.array(domain.origin) + domain.size
        lows, highs = (np.array(part) for part in zip(*(self._bounds or [whole]), strict=True))
        reach = Reach(lows.min(0), highs.max(0), (lows[0] + highs[0]) / 2)
        return Series(np.array(self._times), values, np.array(self._maps), reach, self._heaviest)

    def _observe(self, x: np.ndarray, frame: Frame, mass: np.ndarray, row: LedgerRow) -> dict[str, float]:
        """Return the observables of a frame by name: places, velocities, energies, loads, poses and expressions."""
        d, found = self.scene.dimension, {}
        v = frame.velocity.astype(float)
        for k, source in enumerate(self.scene.sources):
            own = frame.body == k
            if not own.any():
                continue
            width = (mass[own][0] / source.material.density) ** (1 / d)
            for a in self._axes:
                low, high = spread_quantiles(x[own, a], width, (TAIL, 1 - TAIL))
                found |= {f"{source.name}.low.{AXES[a]}": low, f"{source.name}.high.{AXES[a]}": high}
                found[f"{source.name}.centre.{AXES[a]}"] = x[own, a].mean()
            for a in range(d):
                found[f"{source.name}.velocity.{AXES[a]}"] = v[own, a].mean()
        # About the origin of coordinates: the ledger's is that of the domain, which siblings move.
        gravity = np.array(self.scene.domain.gravity_at(row.time))
        found |= {"energy.kinetic": row.kinetic, "energy.elastic": row.elastic}
        if gravity.any() and len(self._axes) == d:
            heavy = zip(self._rigid.values(), row.rigid_pose, strict=True)
            potential = -float((mass * (x @ gravity)).sum()) - sum(m * gravity @ pose[:d] for m, pose in heavy)
            found |= {"energy.potential": potential, "energy.total": row.kinetic + row.elastic + potential}
        arm, push = (np.append(one, [0.0] * (3 - d)) for one in (self.scene.domain.origin, row.linear_momentum))
        spin = np.array(row.angular_momentum) + np.cross(arm, push)[2 if d == 2 else 0 :]
        found |= {f"spin.{axis}": float(part) for axis, part in zip(AXES[-len(spin) :], spin, strict=True)}
        found |= {"volume error": row.volume_error} if row.volume_error else {}
        names = [collider.name for collider in self.scene.colliders]
        for name, force, torque in zip(names, row.collider_force, row.collider_torque, strict=True):
            found |= {f"{name}.force.{axis}": part for axis, part in zip(AXES, force, strict=False)}
            found |= {f"{name}.torque.{axis}": part for axis, part in zip(AXES[-len(torque) :], torque, strict=True)}
        for name, pose in zip(self._rigid, row.rigid_pose, strict=True):
            parts = (*AXES[:d], *(("angle",) if d == 2 else QUATERNION))
            found |= {f"{name}.{part}": value for part, value in zip(parts, pose, strict=True)}
        places = dict(zip(AXES, x.T, strict=False)) | {f"v{axis}": part for axis, part in zip(AXES, v.T, strict=False)}
        for name, expression in self.observed.items():
            values = np.broadcast_to(expression(**places, t=row.time), mass.shape)
            found[name] = float(np.average(values, weights=mass)) if len(mass) else math.nan
        return {name: float(value) for name, value in found.items()}


def read_observed(texts: Iterable[str], scene: Scene, where: str = "--observe") -> dict[str, Expression]:
    """Read observables "NAME=EXPRESSION" over particles, whose value is the mean by mass.

    Raises:
        InputError: one is wrong; the sentence begins with `where` it was given.
    """
    d, found = scene.dimension, {}
    for text in texts:
        name, equals, expression = (part.strip() for part in text.partition("="))
        if not (equals and name.isidentifier()):
            raise InputError(f"{where} {text}: give NAME=EXPRESSION, such as right=1 if x > 0.5 else 0.")
        try:
            parsed = parse(expression, [each for each in NAMES if each == "t" or each[-1] in AXES[:d]])
        except ExpressionError as error:
            raise InputError(f"{where} {name}: the expression {error}.") from None
        if not isinstance(parsed, Expression):
            raise InputError(f"{where} {name}: {expression} is the same for all particles; use x or vx, for example.")
        found[name] = parsed
    return found


def spread_quantiles(x: np.ndarray, width: float, shares: tuple[float, ...]) -> np.ndarray:
    """Return quantiles of equal particles at x, (n,), each spread over its width; points alone are off by O(h)."""
    edges = np.concatenate([x - width / 2, x + width / 2])
    order = np.argsort(edges, kind="stable")
    edges, inside = edges[order], np.cumsum(np.repeat([1.0, -1.0], len(x))[order])
    filled = np.concatenate([[0.0], np.cumsum(inside[:-1] * np.diff(edges))]) / (width * len(x))
    return np.interp(shares, filled, edges)
