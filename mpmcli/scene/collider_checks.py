"""Checks of colliders against the rest of the scene: apart from bodies, within reach, and moving without jumps."""

from collections.abc import Iterator

import numpy as np

from mpmcli.scene.colliders import Collider, Plane, slope_of
from mpmcli.scene.composite import Composite
from mpmcli.scene.expression import Expression
from mpmcli.scene.mesh import Mesh
from mpmcli.scene.motion import has_jump
from mpmcli.scene.polygon import Polygon
from mpmcli.scene.problem import Problem
from mpmcli.scene.quadrature import integral_of
from mpmcli.scene.sampling import lattice_points, particle_places
from mpmcli.scene.schema import Scene

# Cells that a particle may lie inside of a collider: of round-off, and of curved surfaces that are given by chords.
_SLACK = 0.1
# Lattices above this size are not looked at.
_MOST_PLACES = 1_000_000
# Cells within the bounding box of a collider whose distances are kept on a grid, of as many nodes.
_MOST_CELLS = 100_000_000


def collider_problems(scene: Scene) -> Iterator[Problem]:
    """Find colliders that share a name, that bodies overlap, that nothing can meet, and that jump."""
    if scene.colliders and scene.solver.solids == "total":
        said = '"total" knows walls only, and the scene has colliders: give solids = "updated"'
        yield Problem(("solver", "solids"), said)
    first: dict[str, int] = {}
    placed = True
    for k, collider in enumerate(scene.colliders):
        if first.setdefault(collider.name, k) != k:
            said = f'"{collider.name}" is the name of colliders[{first[collider.name]}] already; each needs its own'
            yield Problem(("colliders", k, "name"), said)
        unfit = list(_unfit(collider, k, scene.time.end))
        yield from unfit
        placed = placed and not unfit
        if not unfit:
            yield from _out_of_reach(collider, k, scene)
            yield from _too_large(collider, k, scene)
    if placed:
        yield from _overlaps(scene)


def _unfit(collider: Collider, index: int, end: float) -> Iterator[Problem]:
    """Find motions that are not finite, and places that jump."""
    for key in ("velocity", "angular_velocity", "offset", "angle"):
        value = getattr(collider, key)
        for a, entry in enumerate(value if isinstance(value, tuple) else [value]):
            if isinstance(entry, Expression) and not _finite(entry, end):
                path = ("colliders", index, key, a) if isinstance(value, tuple) else ("colliders", index, key)
                yield Problem(path, "must be finite from time 0 to time.end; it is not, as 1 / t at 0 is not")
                return
    entries = [(("offset", a), entry) for a, entry in enumerate(collider.offset or ())]
    for key, entry in [*entries, (("angle",), collider.angle)]:
        if isinstance(entry, Expression) and has_jump(entry.tree, slope_of(entry), end):
            said = "jumps between 0 and time.end, and a collider must move; let it go from place to place in some time"
            yield Problem(("colliders", index, *key), said)


def _finite(entry: Expression, end: float) -> bool:
    """Return whether an entry and its integral are numbers wherever they are looked at."""
    values = [float(entry(t=time)) for time in (0.0, 0.5 * end, end)]
    return bool(np.isfinite([*values, integral_of(entry.tree, 0.0, end)]).all())


def _out_of_reach(collider: Collider, index: int, scene: Scene) -> Iterator[Problem]:
    """Find colliders at rest that lie beyond the domain."""
    domain = scene.domain
    if isinstance(collider.form, Plane) or collider.motion.moves or collider.side == "inside":
        return
    lower, upper = collider.form.bounds()
    if collider.motion.angle == 0.0:
        shift = np.array(collider.motion.offset)
        if np.any(upper + shift < domain.origin) or np.any(lower + shift > domain.upper):
            spans = " x ".join(f"{size:.4g}" for size in upper - lower)
            box = " x ".join(f"{size:.4g}" for size in domain.size)
            cure = "give its mesh scale = 0.001, if it is in millimetres" if collider.shape.files else "leave it out"
            said = f'collider "{collider.name}" ({spans} m) lies outside of the domain ({box} m); move it, or {cure}'
            yield Problem(("colliders", index, "shape"), said)


def _too_large(collider: Collider, index: int, scene: Scene) -> Iterator[Problem]:
    """Find colliders whose distances would be computed at too many nodes."""
    if isinstance(collider.form, Mesh | Composite | Polygon):
        spans = np.ptp(np.array(collider.form.bounds()), axis=0) / scene.domain.spacing
        if not (count := float(np.prod(spans + 1))) <= _MOST_CELLS:
            said = f'"{collider.name}" spans {count:.3g} cells, and {_MOST_CELLS:g} is the most for meshes, polygons '
            yield Problem(("colliders", index, "shape"), said + "and shapes of several; leave out what is out of reach")


def _overlaps(scene: Scene) -> Iterator[Problem]:
    """Find bodies of which a particle starts in a collider."""
    h = scene.domain.spacing
    if not scene.colliders:
        return
    for i, body in enumerate(scene.bodies):
        if lattice_points(body, h) > _MOST_PLACES:
            continue
        places = particle_places(body, i, h)
        for k, collider in enumerate(scene.colliders if len(places) else ()):
            distance = collider.signed_distance(places)
            if distance.min() < -_SLACK * h:
                where = ", ".join(f"{x:.6g}" for x in places[distance.argmin()])
                said = (
                    f'body "{body.name}" overlaps collider "{collider.name}" at the start, for example at [{where}]; '
                    "move one of them, or subtract the shape of the collider from that of the body"
                )
                yield Problem(("colliders", k, "shape"), said)
