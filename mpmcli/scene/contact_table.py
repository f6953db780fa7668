"""Who meets whom in a scene: by which method, with which friction, and why. All that depends on contact reads it."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, product

from mpmcli.scene.domain import PASSED, SEPARATING, STICKING
from mpmcli.scene.quantity import AXES
from mpmcli.scene.schema import Body, Emitter, Scene

# A node stores the numbers of the velocity fields with mass in bytes of one integer; of more than eight, the first are
# lost. And the largest number of nodes of all fields with contact.default = "auto", which take 1 GB in 3D.
MOST_FIELDS, MOST_NODES = 255, 2**26
# How two things meet: where their surfaces are; a collider at points of its surface; on the nodes that both act on; and
# particles of bodies on the grid of the state at rest.
SURFACE, POINTS, NODES, PARTICLES = "surface", "points", "nodes", "particles"


@dataclass(frozen=True)
class Meeting:
    """How things meet.

    Attributes:
        first, second: names of bodies, emitters and rigid bodies, and of what they meet, equal if they meet each other.
        method: SURFACE, POINTS, NODES or PARTICLES.
        friction: its coefficient; None if they stick.
        source: what sets the friction.
    """

    first: tuple[str, ...]
    second: tuple[str, ...]
    method: str
    friction: float | None
    source: str


@dataclass(frozen=True)
class ContactTable:
    """The contact of a scene: each body that separates has a velocity field of its own, all others share one."""

    scene: Scene

    @property
    def excluded(self) -> dict[str, bool]:
        """Settings of the solver, or the number of bodies, that exclude fields of their own, and whether they apply."""
        solver = self.scene.solver
        fields = 1 + sum(source.has_surface for source in self.scene.sources)
        return {
            'solver.solids = "total"': solver.solids == "total",
            'solver.grid = "sparse"': solver.grid == "sparse",
            "so many bodies": fields > MOST_FIELDS or fields * math.prod(self.scene.domain.cells) > MOST_NODES,
        }

    @property
    def one_field(self) -> str:
        """The first of `excluded` that applies; "" if none does."""
        return next((setting for setting, applies in self.excluded.items() if applies), "")

    @cached_property
    def has_obstacles(self) -> bool:
        """Whether there is a wall or a collider that separates."""
        scene = self.scene
        faces = scene.domain.walls.faces(scene.dimension)
        return any(SEPARATING & {*pair} for pair in faces) or any(one.wall == "separate" for one in scene.colliders)

    @cached_property
    def parts(self) -> bool:
        """Whether elastic bodies separate from all that are not in `contact.pairs`."""
        scene = self.scene
        if scene.contact.default != "auto":
            return scene.contact.default == "separate"
        meets = len(scene.sources) > 1 or self.has_obstacles
        return meets and any(source.has_surface for source in scene.sources) and not self.one_field

    def separates(self, source: Body | Emitter) -> bool:
        """Return whether a body has its own velocity field: contact is then resolved at its surface."""
        pairs = self.scene.contact.pairs
        named = any(source.name in pair.between and pair.friction != "stick" for pair in pairs)
        return source.has_surface and (named or self.parts)

    @cached_property
    def fields(self) -> tuple[tuple[int, ...], ...]:
        """Numbers of the sources of each velocity field; those that share one are the first."""
        sources = self.scene.sources
        shared = tuple(k for k, source in enumerate(sources) if not self.separates(source))
        return ((shared,) if shared else ()) + tuple((k,) for k, one in enumerate(sources) if self.separates(one))

    @property
    def numbers(self) -> tuple[int, ...]:
        """Number of the field of each source."""
        return tuple(next(n for n, own in enumerate(self.fields) if k in own) for k in range(len(self.scene.sources)))

    @property
    def shares(self) -> bool:
        """Whether the first of several fields, or the only one, belongs to all bodies that do not separate."""
        return not self.scene.sources or not self.separates(self.scene.sources[self.fields[0][0]])

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Names of each pair of velocity fields, in the order of the ledger."""
        names = [", ".join(self.scene.sources[k].name for k in field) for field in self.fields]
        return tuple((first, second) for k, second in enumerate(names) for first in names[:k])

    @property
    def by_points(self) -> bool:
        """Whether colliders act at points of their surfaces: some do not hold, and a field is shared."""
        return self.shares and any(collider.wall != "hold" for collider in self.scene.colliders)

    def between(self, first: int, second: int) -> tuple[float | None, str]:
        """Return the coefficient of friction between two fields, None if they stick, and what sets it.

        Of the bodies that share a field the one with the lowest counts, and any that sticks.
        """
        sources = self.scene.sources
        found = [self._of_pair(sources[i], sources[k]) for i in self.fields[first] for k in self.fields[second]]
        return min(found, key=lambda one: -1.0 if one[0] is None else one[0])

    def _of_pair(self, first: Body | Emitter, second: Body | Emitter) -> tuple[float | None, str]:
        """Return the coefficient of friction of two sources, None if they stick, and what determines it."""
        contact = self.scene.contact
        for k, pair in enumerate(contact.pairs):
            if set(pair.between) == {first.name, second.name}:
                return None if pair.friction == "stick" else pair.friction, f"contact.pairs[{k}]"
        bodies = [body for body in (first, second) if body.has_surface]
        if not bodies:
            return None, "neither is elastic"
        if not self.parts:
            return None, self.one_field or "contact.default"
        if any(body.material.hydrostatic for body in (first, second)):
            return 0.0, "a liquid"
        if contact.friction is not None:
            return contact.friction, "contact.friction"
        # That of the softer body, the lower of two equally soft ones; a plugin's law may have none.
        found = ((one.material.shear_modulus, getattr(one.material, "surface_friction", 0.0)) for one in bodies)
        return min(found)[1], "surface_friction"

    def rows(self) -> Iterator[Meeting]:
        """Yield how all meet, without what is alike twice."""
        found: dict[tuple, list[tuple[str, str]]] = {}
        for k, pairs in enumerate((self._bodies(), self._rigid(), self._obstacles(), self._fixed())):
            for first, second, *how in pairs:
                found.setdefault((k, *how), []).append((first, second))
        for (k, method, friction, source), pairs in found.items():
            names = tuple(dict.fromkeys(name for pair in pairs for name in pair))
            if k < 2 and len(names) > 2 and 2 * len(pairs) == len(names) * (len(names) - 1):
                yield Meeting(names, names, method, friction, source)
                continue
            met: dict[str, list[str]] = {}
            for first, second in pairs:
                met.setdefault(first, []).append(second)
            alike: dict[tuple[str, ...], list[str]] = {}
            for first, seconds in met.items():
                alike.setdefault(tuple(seconds), []).append(first)
            for seconds, firsts in alike.items():
                yield Meeting(tuple(firsts), seconds, method, friction, source)

    def _bodies(self) -> Iterator[tuple]:
        sources, total = self.scene.sources, self.scene.solver.solids == "total"
        for a, field in enumerate(self.fields):
            for first, second in combinations(field, 2):
                how = (PARTICLES, 0.0, 'solver.solids = "total"') if total else (NODES, *self.between(a, a))
                yield sources[first].name, sources[second].name, *how
            for b in range(a):
                friction, source = self.between(a, b)
                method = NODES if friction is None else SURFACE
                for first, second in product(self.fields[b], field):
                    yield sources[first].name, sources[second].name, method, friction, source

    def _obstacles(self) -> Iterator[tuple]:
        """Yield (source, obstacle, method, friction, its origin) for all sources with all colliders and walls."""
        total = self.scene.solver.solids == "total"
        solids = [(one.name, one.wall, one.friction) for one in self.scene.colliders]
        for k, (name, word, friction) in enumerate((*solids, *self._walls())):
            wall = k >= len(solids)
            how = (friction, f"friction of the {'wall' if wall else 'collider'}")
            if word in STICKING or word == "hold":
                how = (None, f'wall = "{word}"')
            for source in self.scene.sources:
                method = NODES if wall or word == "hold" else POINTS
                if word in SEPARATING and total:
                    method = PARTICLES
                elif self.separates(source):
                    method = SURFACE if word in SEPARATING else NODES
                yield source.name, name, method, *how

    def _rigid(self) -> Iterator[tuple]:
        for first, second in combinations([one for one in self.scene.colliders if one.free], 2):
            yield first.name, second.name, POINTS, max(first.friction, second.friction), "the larger friction"

    def _fixed(self) -> Iterator[tuple]:
        fixed = [(one.name, one.friction) for one in self.scene.colliders if not (one.free or one.holds)]
        fixed += [(name, friction) for name, _, friction in self._walls()]
        for body in (one for one in self.scene.colliders if one.free):
            for name, friction in fixed:
                yield body.name, name, POINTS, max(body.friction, friction), "the larger friction"

    def _walls(self) -> list[tuple[str, str, float]]:
        """Return name, word and friction of the faces, of all of them at once if they are alike."""
        domain, d = self.scene.domain, self.scene.dimension
        found = [
            (f"{AXES[a]}_{end}", word, friction)
            for a, words in enumerate(domain.walls.faces(d))
            for end, word, friction in zip(("min", "max"), words, domain.frictions[a], strict=True)
            if word not in PASSED
        ]
        alike = len(found) == 2 * d and len({face[1:] for face in found}) == 1
        return [("walls", *found[0][1:])] if alike else found
