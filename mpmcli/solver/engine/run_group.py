"""The particles of one law of one run: initial states of its bodies, and access to the current state."""

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np

from mpmcli.errors import InputError
from mpmcli.materials.law import Law
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.contact.layers import Layers
from mpmcli.solver.contact.surfaces import rest_surface
from mpmcli.solver.engine.batch import Batch
from mpmcli.solver.machine.costs import members_of
from mpmcli.solver.particles.arrays import CONSTANTS
from mpmcli.solver.particles.state_bounds import floor_of

# Particles per copy to the device.
PART = 2**15


def table_of(law: Law, particles: Sequence[BodyParticles]) -> np.ndarray:
    """Return the rows of `ParticleArrays.table` for the members of a law, (bodies, columns)."""
    rows = [(b.mass, b.volume, *law.constants(p)) for b, p in zip(particles, law.members, strict=True)]
    return np.array(rows) if rows else np.empty((0, CONSTANTS))


def initial_states(
    law: Law,
    particles: Sequence[BodyParticles],
    first_ids: Sequence[int],
    origin: np.ndarray,
    surfaces: Sequence[np.ndarray],
) -> Iterator[tuple[int, dict[str, np.ndarray], np.ndarray]]:
    """Yield the initial particles of some bodies, PART at a time, which bounds the memory.

    Args:
        law: the law of the bodies.
        particles: particles of each body.
        first_ids: id of the first particle of each body.
        origin: origin of the domain, (d,), m.
        surfaces: surface data of the particles of each body, see `rest_surface`; empty without surfaces.

    Yields:
        The number of particles before, and the arguments `found` and `row` of `ParticleArrays.write`, with rows
            relative to the first body.
    """
    rest = np.ones(1) if law.deformation == "J" else np.eye(len(origin))[None]
    before = 0
    for place, (body, first_id, surface) in enumerate(zip(particles, first_ids, surfaces, strict=True)):
        count = len(body.position)
        internal = [np.broadcast_to(body.internal.get(one.name, one.at_rest), count) for one in law.internal]
        for first in range(0, count, PART):
            own = slice(first, min(first + PART, count))
            n = own.stop - first
            position = body.position[own] - origin
            found = {
                "x": position,
                "initial": position if body.initial is None else body.initial[own] - origin,
                "v": body.velocity[own],
                "C": body.affine[own],
                "deformation": np.repeat(rest, n, 0) if body.deformation is None else body.deformation[own],
                "internal": np.stack([values[own] for values in internal], axis=1) if internal else np.empty((n, 0)),
                "id": first_id + np.arange(first, own.stop),
                "activity": 0 if body.waits else 1,
                "carried": surface[own],
                # A particle that waits enters beside few others.
                "borne": 1 / law.relief if body.waits else 1.0,
            }
            yield before + first, found, np.full(n, place)
        before += count


class RunGroup:
    """The particles of one law of one run: a range of `ParticleArrays`.

    Attributes:
        law: the law with the parameters of this run.
        bodies: index in the scene of each body of the group.
        arrays: the fields.
        first: index of the first particle in the fields.
        count: number of particles n.
        row: first row in `table`.
        rows: host copy of the rows of `table`.
        floor: lower bounds of the maxima of a measurement if there may be no particle, else None.
        total, dimension, real, internal: attributes of the arrays.
    """

    def __init__(self, batch: Batch, g: int, slot: int, law: Law, bodies: list[int], rows: np.ndarray, count: int):
        self.law, self.bodies, self.count = law, tuple(bodies), count
        self.arrays = batch.device.groups[g]
        self.total = self.arrays.total
        self.dimension, self.real, self.internal = self.arrays.dimension, self.arrays.real, self.arrays.internal
        self.rows = rows.astype(self.real)
        self.first = slot * batch.kind.particles[g]
        self.row = slot * batch.kind.bodies[g]
        self.floor: np.ndarray | None = None
        self._state, self._number = batch.state(slot), g

    @property
    def active(self) -> int:
        """Number of active particles, which precede all others."""
        return self._state.particles[self._number]

    def read(self) -> dict[str, np.ndarray]:
        """Return x, v, C, deformation, internal, (n, k), id and body, (n), in solver order."""
        return self.arrays.read(self.first, self.count, self.bodies, self.row)

    def replace(self, **state: np.ndarray) -> None:
        """Replace x, v, C, deformation, internal or id of all particles, in the form of `read`.

        `Run.state_was_replaced` or `Run.restart` must follow.
        """
        if "C" in state:
            state["remainder"] = 0
        if "deformation" in state:
            state |= {"deformation": state["deformation"] - self.arrays.rest, "growth": 0}
        for name, values in state.items():
            column = self.arrays.column(name)
            numbers = np.broadcast_to(values, (self.count, *column.shape)).reshape(self.count, -1)
            for (field, place), own in zip(column.entries, numbers.T, strict=False):
                whole = field.to_numpy()
                whole[(slice(self.first, self.first + self.count), *place)] = own
                field.from_numpy(whole)

    def fill(self, states: Iterable[tuple[int, Mapping[str, np.ndarray], np.ndarray]], layers: Layers) -> None:
        """Write particles (see `initial_states`), the table and the layers of bodies to the device."""
        for first, found, row in states:
            self.arrays.write(self.first + first, found, self.row + row)
        numbers = [[layers.numbers[body] for body in self.bodies]] if self.arrays.layers > 1 else []
        if self.bodies:
            self.arrays.rows.write(self.row, self.rows, *numbers)


def groups_of(batch: Batch, slot: int, scene: Scene, particles: Sequence[BodyParticles]) -> list[RunGroup]:
    """Write the particles of a run, one entry per source, to the device; return its groups, one per law."""
    first_ids = np.concatenate([[0], np.cumsum([len(b.position) for b in particles])])
    groups, layers, state = [], Layers.of(scene), batch.state(slot)
    if any(state.capacity):
        # The place of an earlier run.
        batch.device.particles.forget_lost(slot * len(batch.kind.members), len(batch.kind.members))
    for g, shared in enumerate(batch.kind.members):
        bodies = members_of(scene, shared.name)
        own = [particles[i] for i in bodies]
        law = type(shared)([scene.sources[i].material for i in bodies], scene.dimension)
        group = RunGroup(batch, g, slot, law, bodies, table_of(law, own), sum(len(b.position) for b in own))
        state.particles[g], state.capacity[g] = sum(len(b.position) for b in own if not b.waits), group.count
        group.floor = floor_of(scene, law, bodies)
        surfaces = [
            rest_surface(scene.sources[i], particles[i], scene.domain.spacing if layers.has_own(i) else None)
            if group.arrays.surfaced
            else np.empty(0)
            for i in bodies
        ]
        first, origin = [int(first_ids[i]) for i in bodies], np.array(scene.domain.origin)
        group.fill(initial_states(law, own, first, origin, surfaces), layers)
        groups.append(group)
    if batch.device.grid.deterministic:
        batch.device.grid.fixed.write(slot, groups, scene.domain.spacing)
    return groups


def require_inside(scene: Scene, particles: Sequence[BodyParticles]) -> None:
    """Raise an InputError for particles more than two cells outside the domain or at NaN, which have no tiles."""
    lower, upper, margin = np.array(scene.domain.origin), np.array(scene.domain.upper), 2 * scene.domain.spacing
    for sample in particles:
        inside = ((sample.position >= lower - margin) & (sample.position <= upper + margin)).all(axis=1)
        if not inside.all():
            p = int(np.argmin(inside))
            place, low, high = (", ".join(f"{x:.6g}" for x in point) for point in (sample.position[p], lower, upper))
            raise InputError(
                f'particle {p} of body "{sample.name}" lies at ({place}) m, outside the domain from ({low}) to '
                f"({high}) m; every particle must start inside it."
            )
