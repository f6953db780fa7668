"""Checks how elastic bodies of a result meet: the friction and the spin of one that slides, and the energy lost."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mpmcli.check.finding import FrameFindings
from mpmcli.check.result_state import FrameCheck, extent
from mpmcli.frames.frame import Frame
from mpmcli.frames.ledger import LedgerRow
from mpmcli.materials.registry import laws
from mpmcli.output.header import RunHeader, nearest_image
from mpmcli.scene.colliders import Collider
from mpmcli.scene.domain import PASSED, STICKING
from mpmcli.scene.problem import quoted, several
from mpmcli.scene.quantity import AXES

# Distances of a particle, in cells, up to which it touches an obstacle, and up to which things may act on each other.
TOUCHES, NEAR = 1.0, 2.0
# Cosine of the angle up to which normals agree. A body touches a plane if those of half the particles there agree with
# the one below its centre.
AGREE, HALF = 0.99, 0.5
# Cells of sliding, its share of the way of the centre, and the coefficient of friction measured over that given, beyond
# which a body slides too easily.
SLID, SHARE, RUBS = 3.0, 0.1, 0.7
# Speed of the centre normal to an obstacle, over that along it, up to which a body slides and does not hop or tip.
STAYS = 0.1
# Relative error of the spin of a ball that is reported, if neither the speed of its rim nor its own is below TURNS of
# the other: a soft ball may rest on a slope.
SPUN, TURNS = 0.25, 0.1
# Impulse of a body between two frames, over its largest one, below which nothing acts on it.
IDLE = 0.01
# Fraction of the energy turned over that a meeting may take, and that which is a warning.
LOST, MOST_LOST = 0.05, 0.2
# Largest number of particles of a body whose distances are computed in a frame.
SAMPLE = 20_000


@dataclass(frozen=True)
class _Obstacle:
    """A wall, or a collider at rest; `friction` is infinite where bodies stick to it."""

    name: str
    friction: float
    distance: Callable[[np.ndarray], np.ndarray]

    def normals(self, points: np.ndarray, h: float) -> np.ndarray:
        """Return the gradients of the distance, (n, 3), at points, (n, d)."""
        steps = 0.05 * h * np.eye(points.shape[1])
        slopes = [(self.distance(points + one) - self.distance(points - one)) / (0.1 * h) for one in steps]
        return _in_3d(np.stack(slopes, axis=1))


@dataclass(frozen=True)
class _Body:
    """An elastic body in a frame; vectors have three components, also in 2D.

    `spin` is the angular momentum about the centre, and `rate` the angular velocity of a rigid body that has it, whose
    smallest moment of inertia is `inertia`. If the body touches one plane obstacle and nothing else is near, that is
    `obstacle`, with its normal and the height of the centre above it.
    """

    mass: float
    momentum: np.ndarray
    spin: np.ndarray
    rate: np.ndarray
    inertia: float
    radius: float
    near: tuple[str, ...]
    obstacle: _Obstacle | None
    normal: np.ndarray
    height: float

    @property
    def slip(self) -> np.ndarray:
        """Velocity where it touches the obstacle, along the obstacle, m/s."""
        return _along(self.momentum / self.mass - np.cross(self.rate, self.height * self.normal), self.normal)

    def speed_across(self, way: np.ndarray) -> float:
        """Return the largest speed of a point of the body normal to a direction, m/s."""
        return float(np.linalg.norm(_along(self.momentum, way)) / self.mass + np.linalg.norm(self.rate) * self.radius)


@dataclass
class _Slide:
    """Sums over the time in which a body touches an obstacle.

    `way`, m, is how far it slid, `moved` how far its centre went; `rubbed` is the work of friction, and `pressed` that
    of a coefficient of 1, J; `expected` and `found` are changes of spin, up to `frame`.
    """

    body: _Body
    way: np.ndarray | float = 0.0
    moved: float = 0.0
    rubbed: float = 0.0
    pressed: float = 0.0
    expected: np.ndarray | float = 0.0
    found: np.ndarray | float = 0.0
    frame: int = 0


class ContactCheck(FrameCheck):
    """Follows elastic bodies where they touch obstacles at rest, and the energy of meetings (docs/theory.md, 9.3)."""

    def __init__(self, header: RunHeader, findings: FrameFindings) -> None:
        """Prepare to follow elastic bodies; none are if the header lacks what this needs, or something moves them."""
        super().__init__(header, findings)
        colliders = header.read_colliders({})
        unknown = any(one is None for one in (header.spacing, header.gravity, header.origin, *colliders))
        known = not (unknown or header.driven or header.moved) and bool(header.faces and header.densities)
        elastic = [known and law.name in laws() and laws()[law.name].elastic for law in header.laws]
        self._elastic = np.array(elastic, bool)
        self._free = [one for one in colliders if one is not None and one.free]
        self._obstacles = _obstacles(header, colliders) if self._elastic.any() else []
        self._slides: dict[tuple[int, str], _Slide] = {}
        # Of each frame: the bodies, their impulses since the one before, a bound on the work of friction, and its row.
        self._frames: list[tuple[dict[int, _Body], dict[int, float], float, LedgerRow]] = []

    def check(self, frame: Frame, row: LedgerRow) -> None:
        """Check a frame of finite values; frames must come in order, without gaps."""
        masses = self._header.masses(frame.body) if self._elastic.any() else None
        if masses is None:
            return
        rows = {label: np.flatnonzero(frame.body == label) for label in np.unique(frame.body).tolist()}
        boxes = {label: extent(frame.position[own]) for label, own in rows.items()}
        bodies = {
            label: self._body(frame, masses[own], own, label, boxes, row)
            for label, own in rows.items()
            if self._elastic[frame.material[own[0]]]
        }
        impulses, work = dict.fromkeys(bodies, 0.0), 0.0
        for label, after in bodies.items() if self._frames else ():
            before, _, _, last = self._frames[-1]
            span = row.time - last.time
            given = after.momentum - before[label].momentum - after.mass * _in_3d(self._header.gravity) * span
            self._slide(label, before[label], after, given, span, frame.index)
            impulses[label] = size = float(np.linalg.norm(given))
            speeds = [one.speed_across(given / max(size, np.finfo(float).tiny)) for one in (before[label], after)]
            work += self._friction * size * max(speeds)
        self._frames.append((bodies, impulses, work, row))

    def _body(self, frame: Frame, m: np.ndarray, rows: np.ndarray, label: int, boxes: dict, row: LedgerRow) -> _Body:
        """Return the motion of a body in a frame, what is near it, and the obstacle if it touches one plane alone."""
        header, reach = self._header, NEAR * self._header.spacing
        x, v, mass = frame.position[rows].astype(np.float64), frame.velocity[rows].astype(np.float64), float(m.sum())
        x = x[0] + nearest_image(x - x[0], header.period)
        place, momentum = m @ x / mass, m @ v
        r = _in_3d(x - place)
        spin, squares = np.cross(r, _in_3d(v - momentum / mass)).T @ m, np.einsum("ij,ij->i", r, r)
        inertia = np.eye(3) * (m @ squares) - np.einsum("i,ij,ik->jk", m, r, r)
        low, high = boxes[label]
        near = [
            header.body_name(other)
            for other, (lowest, highest) in boxes.items()
            if other != label and (np.maximum(lowest - high, low - highest) < reach).all()
        ]
        sample = x[:: 1 + len(x) // SAMPLE]
        placed = [
            one.along(np.array([row.time]), np.array([pose]))
            for one, pose in zip(self._free, row.rigid_pose, strict=False)
        ]
        near += [one.name for one in placed if one.signed_distance(sample, row.time).min() < reach]
        distances = {one: one.distance(sample) for one in self._obstacles}
        beside = [one for one, found in distances.items() if found.min() < reach]
        near += [one.name for one in beside]
        obstacle, normal, height = None, np.zeros(3), 0.0
        if len(near) == 1 and beside and distances[beside[0]].min() < TOUCHES * header.spacing:
            touching = sample[distances[beside[0]] < TOUCHES * header.spacing]
            normal, *others = beside[0].normals(np.vstack([place, touching]), header.spacing)
            if np.mean(np.array(others) @ normal > AGREE) > HALF:
                obstacle, height = beside[0], float(beside[0].distance(place[None])[0])
        rate, turns = np.linalg.pinv(inertia) @ spin, np.diag(inertia)[2 if header.dimension == 2 else 0 :]
        sums = (mass, _in_3d(momentum), spin, rate, float(turns.min()), float(np.sqrt(squares.max())))
        return _Body(*sums, tuple(near), obstacle, normal, height)

    def _slide(self, label: int, before: _Body, after: _Body, given: np.ndarray, span: float, number: int) -> None:
        """Add the time between two frames in which the body touches the same plane."""
        n = after.normal
        if before.obstacle is None or before.obstacle is not after.obstacle or before.normal @ n < AGREE:
            return
        slide = self._slides.setdefault((label, after.obstacle.name), _Slide(after))
        slide.body, slide.frame = after, number
        slide.expected = slide.expected - 0.5 * (before.height + after.height) * np.cross(n, given)
        slide.found = slide.found + after.spin - before.spin
        slip = 0.5 * (before.slip + after.slip)
        slide.moved += float(np.linalg.norm(_along(after.momentum, n))) / after.mass * span
        # In hops, friction stops the surface in each impact, and the body springs back: only what stays down slides.
        stays = all(abs(one.momentum @ n) < STAYS * np.linalg.norm(_along(one.momentum, n)) for one in (before, after))
        if before.slip @ after.slip > 0 and given @ n > 0 and stays:
            slide.way = slide.way + slip * span
            slide.rubbed -= float(given @ slip)
            slide.pressed += float(given @ n * np.linalg.norm(slip))

    @property
    def _friction(self) -> float:
        """The largest coefficient of friction of the scene."""
        contact = self._header.scene.contact
        found = [one.friction for one in self._obstacles if np.isfinite(one.friction)]
        found += [body.material.get("surface_friction", 0.0) for body in self._header.bodies]
        found += [pair["friction"] for pair in contact.pairs if pair["friction"] != "stick"]
        return max([*found, contact.friction or 0.0])

    def end(self) -> None:
        """Add what all frames tell together."""
        for (label, name), slide in self._slides.items():
            self._sliding(label, name, slide)
        if self._frames and self._elastic.all() and len(self._free) < 2:
            self._meetings()

    def _sliding(self, label: int, name: str, slide: _Slide) -> None:
        """Report a slide at less friction than is given, and a spin that the force of the obstacle does not explain."""
        header, mu = self._header, slide.body.obstacle.friction
        body, kind = header.body_name(label), f"{label} {name}"
        cells, least = float(np.linalg.norm(slide.way)) / header.spacing, SHARE * slide.moved / header.spacing
        if mu > 0 and cells > max(SLID, least) and slide.rubbed < RUBS * mu * slide.pressed:
            found = slide.rubbed / slide.pressed
            given = "it should stick" if np.isinf(mu) else f"the scene gives {mu:g}"
            what = f'Body "{body}" slid {cells:.3g} cells along "{name}" until frame {slide.frame} at a coefficient of '
            what += f"friction of {found:.2g}, where {given}"
            self._findings.add("warning", "slides", slide.frame, what, self._remedy, found, body, kind)
        expected, wrong = (float(np.linalg.norm(one)) for one in (slide.expected, slide.found - slide.expected))
        # The force of a plane on a ball acts below its centre.
        ball = label < len(header.scene.bodies) and "ball" in header.scene.bodies[label].shape
        rim = expected / slide.body.inertia * slide.body.radius
        speed = float(np.linalg.norm(slide.body.momentum)) / slide.body.mass
        if ball and wrong > SPUN * expected and TURNS * speed < rim < speed / TURNS:
            found, given = (np.linalg.norm(one) / slide.body.inertia for one in (slide.found, slide.expected))
            what = f'By frame {slide.frame} "{name}" changed the spin of body "{body}" by {found:.3g} rad/s, where the '
            what += f"force between them gives {given:.3g} rad/s"
            self._findings.add("warning", "spin", slide.frame, what, self._remedy, wrong / expected, body, kind)

    def _meetings(self) -> None:
        """Add the energy lost from each frame in which nothing meets to the next one."""
        rows, parts = [row for *_, row in self._frames], ("kinetic", "elastic", "potential")
        turned = sum(np.ptp([getattr(row, name) for row in rows]) for name in parts)
        largest = {label: max(one[label] for _, one, _, _ in self._frames) for label in self._frames[0][1]}
        near = [{(label, other) for label, body in one.items() for other in body.near} for one, *_ in self._frames]
        # What is near acts if the body gets an impulse before or after the frame.
        acting, always, first, work = set(), set.intersection(*near), 0, 0.0
        for k, (_, given, rubbed, row) in enumerate(self._frames):
            after = self._frames[min(k + 1, len(rows) - 1)][1]
            acts = {label for label in largest if max(given[label], after[label]) > IDLE * largest[label]}
            now, work = {(label, other) for label, other in near[k] - always if label in acts}, work + rubbed
            if now or k == 0:
                acting |= now
                continue
            lost = rows[first].energy - row.energy - work
            if lost > LOST * turned and acting:
                met = {self._header.body_name(label) for label, _ in acting} | {other for _, other in acting}
                what = (
                    f"By frame {k} {several(quoted(sorted(met)))} have met, which took {100 * lost / turned:.3g} % of "
                )
                what += "the energy turned over, although all of them are elastic"
                severity = "warning" if lost > MOST_LOST * turned else "note"
                self._findings.add(severity, "meeting", k, what, self._remedy, lost / turned, min(met))
            acting, first, work = set(), k, 0.0

    @property
    def _remedy(self) -> str:
        if self._frames[-1][-1].contact_overlap is not None:
            return "Refine the domain."
        setting = 'solver.solids = "updated"' if self._header.total else 'contact.default = "separate"'
        return f"Bodies meet on the grid; set {setting} to let them meet at their surfaces."


def _in_3d(vectors: np.ndarray) -> np.ndarray:
    """Return vectors, (..., d), with three components."""
    return np.pad(vectors, [(0, 0)] * (vectors.ndim - 1) + [(0, 3 - vectors.shape[-1])])


def _along(u: np.ndarray, n: np.ndarray) -> np.ndarray:
    """Return the part of a vector normal to a unit vector."""
    return u - u @ n * n


def _obstacles(header: RunHeader, colliders: tuple[Collider, ...]) -> list[_Obstacle]:
    """Return the walls, and the colliders at rest."""
    found, friction = [], header.friction
    for a, words in enumerate(header.faces):
        for word, end, corner, side in zip(words, ("min", "max"), (header.origin, header.upper), (1, -1), strict=True):
            own = getattr(friction, f"{AXES[a]}_{end}")
            mu = np.inf if word in STICKING else friction.default if own is None else own
            distance = lambda x, a=a, corner=corner, side=side: side * (x[:, a] - corner[a])  # noqa: E731
            found += [_Obstacle(f"{AXES[a]}_{end}", mu, distance)] * (word not in PASSED)
    for one in colliders:
        mu = np.inf if one.wall in {"stick", "hold"} else one.friction
        found += [_Obstacle(one.name, mu, one.signed_distance)] * (not one.free)
    return found
