"""Builds frames and ledger rows from particle data of a device and from sums over the particles of each law."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mpmcli.frames.frame import ACTIVE, BLOCKED, RETIRED, STATUS, WAITING, Frame
from mpmcli.frames.ledger import LOADS, RIGID, LedgerRow
from mpmcli.scene import BodyParticles, Scene
from mpmcli.solver.frames.columns import FrameArrays, FrameColumns, ParticleConstants, RunConstants, parts_of
from mpmcli.stability.transfer_factors import affine_moment

# Particles per batch of sums, which bounds the memory.
ROWS = 65_536


@dataclass(frozen=True)
class Sums:
    """Sums over the particles of a law at T times, in float64.

    Attributes:
        mass: sum m, (T,).
        place: sum m x, (T, d).
        momentum: sum m v, (T, d).
        motion: sum m v^2, (T,).
        affine: sum m |C|^2, (T,).
        turning: sum m x cross v, (T, 1) in 2D and (T, 3) in 3D.
        spin: sum of m times the axial vector of C, of the same shape.
        elastic: stored energy, J, half a step earlier, (T,).
        speed_squared: the largest squared speed, (T,).
    """

    mass: np.ndarray
    place: np.ndarray
    momentum: np.ndarray
    motion: np.ndarray
    affine: np.ndarray
    turning: np.ndarray
    spin: np.ndarray
    elastic: np.ndarray
    speed_squared: np.ndarray


@dataclass(frozen=True)
class StepsTaken:
    """The steps between two frames.

    Attributes:
        count: number of steps.
        smallest: size, s, Courant number and bound of the smallest step.
        largest: size of the largest step, s.
        courant: the largest Courant number.
    """

    count: int = 0
    smallest: tuple[float, float, str] = (0.0, 0.0, "")
    largest: float = 0.0
    courant: float = 0.0


NO_STEPS = StepsTaken()


def axis_pairs(dimension: int) -> tuple[tuple[int, int], ...]:
    """Return the axes (a, b) of each component x_a v_b - x_b v_a of a cross product."""
    return ((0, 1),) if dimension == 2 else ((1, 2), (2, 0), (0, 1))


def sums_of_rows(arrays: FrameArrays, constants: ParticleConstants, *, total: bool) -> list[Sums]:
    """Return the sums over the particles of each law at one time, from sum m a a^T with a = (1, x, v, C).

    On the CPU the kernel of a batch computes them (`reader.sum_range`). `arrays` must have the columns "affine", and
    "gradient" if bodies are `total`.
    """
    d, result = arrays.columns.dimension, []
    activity = arrays["activity"][0] if arrays.columns.first["activity"] >= 0 else None
    numbers = np.arange(len(constants.mass))
    for _, rows in constants.members:
        products, spins, elastic, fastest = np.zeros((1 + 2 * d + d * d,) * 2), np.zeros((d, d)), 0.0, 0.0
        own = numbers[rows] if activity is None else numbers[rows][activity[rows] == ACTIVE]
        for first in range(0, len(own), ROWS):
            part = own[first : first + ROWS]
            mass, v = constants.mass[part], arrays["v"][0, part]
            C = arrays["affine"][0, part].reshape(-1, d, d).astype(np.float64)
            spin = C
            if total:
                # Nodes are at F (X_i - X_p) relative to the particle and have the relative velocity C F (X_i - X_p).
                F = arrays["gradient"][0, part].reshape(-1, d, d).astype(np.float64)
                C, spin = C @ F, C @ F @ F.transpose(0, 2, 1)
            spins += np.tensordot(mass, spin, 1)
            a = np.concatenate([np.ones((len(part), 1)), arrays["x"][0, part], v, C.reshape(-1, d * d)], axis=1)
            products += (a * mass[:, None]).T @ a
            elastic += float(constants.volume[part] @ arrays["energy"][0, part].astype(np.float64))
            fastest = max(fastest, float(np.einsum("pc,pc->p", v, v).max()))
        x, v, C = slice(1, 1 + d), slice(1 + d, 1 + 2 * d), slice(1 + 2 * d, None)
        turning, pairs = products[x, v], axis_pairs(d)
        result.append(
            Sums(
                mass=products[None, 0, 0],
                place=products[None, 0, x],
                momentum=products[None, 0, v],
                motion=np.array([products[v, v].trace()]),
                affine=np.array([products[C, C].trace()]),
                turning=np.array([[turning[a, b] - turning[b, a] for a, b in pairs]]),
                spin=np.array([[spins[b, a] - spins[a, b] for a, b in pairs]]),
                elastic=np.array([elastic]),
                speed_squared=np.array([fastest]),
            )
        )
    return result


def ledger_sums(
    sums: Sequence[Sums], gravity: np.ndarray, spacing: float, dt: np.ndarray, moment: float = 0.25
) -> dict[str, np.ndarray]:
    """Return, by name, the entries of `LedgerRow`s that depend only on the state, (T,) or (T, k).

    The affine velocity contributes to energy and angular momentum (Jiang et al. 2017). All energies are evaluated half
    a step back, at the time of the leapfrog velocities, where their sum is second order in the step; with the current
    positions it would oscillate by v dt/2 times the force.

    Args:
        sums: sums of each law.
        gravity: gravity, m/s^2, (T, d).
        spacing: spacing of the grid, m.
        dt: the last step, s, (T,).
        moment: see `affine_moment`.
    """
    inertia = moment * spacing**2
    momentum, place = sum(one.momentum for one in sums), sum(one.place for one in sums)
    return {
        "mass": sum(one.mass for one in sums),
        "kinetic": sum(0.5 * (one.motion + inertia * one.affine) for one in sums),
        "elastic": sum(one.elastic for one in sums),
        "potential": -((place - 0.5 * dt[:, None] * momentum) * gravity).sum(axis=1),
        "linear_momentum": momentum,
        "angular_momentum": sum(one.turning + inertia * one.spin for one in sums),
        "speed_max": np.sqrt(np.max([one.speed_squared for one in sums], axis=0)),
    }


def ledger_rows(sums: dict[str, np.ndarray], times: Sequence[float], taken: Sequence[StepsTaken]) -> list[LedgerRow]:
    """Return a ledger row for each time, from the result of `ledger_sums` and the steps up to that time."""
    columns = {name: values.tolist() for name, values in sums.items()}
    for name in ("linear_momentum", "angular_momentum"):
        columns[name] = list(map(tuple, columns[name]))
    for name in (*LOADS, *RIGID):
        if name in columns:
            columns[name] = [tuple(map(tuple, rows)) for rows in columns[name]]
    return [
        LedgerRow(
            time=time,
            steps=steps.count,
            step_min=steps.smallest[0],
            step_max=steps.largest,
            limit=steps.smallest[2],
            courant_max=steps.courant,
            **dict(zip(columns, values, strict=True)),
        )
        for time, steps, values in zip(times, taken, zip(*columns.values(), strict=True), strict=True)
    ]


# Smallest number of cells inside the material for an estimate, because its boundary is resolved only to about a
# particle.
FEWEST = 64
# Largest number of cells that are evaluated as a whole. In a larger domain only the bounding box of the particles is.
WHOLE = 2**16


class FilledCells:
    """The cells filled by particles at T times; particles are added in parts.

    A cell is inside if it and all of its neighbours, including corners, contain only particles of flowing materials,
    and at least one. Neighbours beyond a wall impose no condition; beyond a periodic face they are the cells at the
    opposite face.
    """

    def __init__(self, x: np.ndarray, spacing: float, cells: Sequence[int], periodic: Sequence[bool]) -> None:
        """Choose the cells from the positions of all particles that may be added, (T, n, d), m."""
        self._spacing, self._cells, self._periodic = spacing, tuple(cells), periodic
        self._low, self._high = [0] * len(cells), [n - 1 for n in cells]
        if math.prod(cells) > WHOLE:
            lower, upper = _bounds(x)
            for a in range(len(cells)):
                self._low[a], self._high[a] = (max(0, int(self._cell(bound[a], a))) for bound in (lower, upper))
        # One more cell on each side: it counts as inside beyond a wall, otherwise as empty.
        self._shape = [len(x)] + [last - first + 3 for first, last in zip(self._low, self._high, strict=True)]
        self._held = np.zeros(math.prod(self._shape))
        self._others: np.ndarray | None = None

    def _cell(self, x: np.ndarray, a: int) -> np.ndarray:
        return np.minimum((x * (1 / self._spacing)).astype(np.intp), self._cells[a] - 1)

    def add(self, x: np.ndarray, volume: np.ndarray, flows: np.ndarray) -> None:
        """Add particles: x, (T, k, d), m, current volume, (T, k), and whether each flows, (k,)."""
        index = np.arange(len(x))[:, None]
        for a, (first, count) in enumerate(zip(self._low, self._shape[1:], strict=True)):
            index = index * count
            index = index + (self._cell(x[:, :, a], a) + (1 - first))
        if not flows.all():
            if self._others is None:
                self._others = np.zeros(len(self._held), bool)
            self._others[index[:, ~flows].ravel()] = True
            index, volume = index[:, flows], volume[:, flows]
        np.add.at(self._held, index.ravel(), volume.ravel())

    def errors(self) -> np.ndarray:
        """Return the volume of the inside cells divided by that of their particles, minus 1, (T,); 0 with few cells."""
        held = self._held.reshape(self._shape)
        inside = held > 0
        if self._others is not None:
            inside &= ~self._others.reshape(self._shape)
        for axis, count in enumerate(self._cells):
            planes = inside.swapaxes(0, 1 + axis)
            whole = self._low[axis] == 0, self._high[axis] == count - 1
            planes[0], planes[-1] = whole
            if self._periodic[axis]:
                # Cells outside the chosen range are empty.
                planes[0], planes[-1] = (planes[-2], planes[1]) if all(whole) else (False, False)
        for axis in range(len(self._cells)):
            planes = inside.swapaxes(0, 1 + axis)
            inside = (planes[:-2] & planes[1:-1] & planes[2:]).swapaxes(0, 1 + axis)
        inside = inside.reshape(len(held), -1)
        within = held[(slice(None), *(slice(1, -1),) * len(self._cells))].reshape(len(held), -1)
        counts = np.count_nonzero(inside, axis=1)
        enough = counts >= FEWEST
        # Summed in the same order for any number of times.
        filled = np.where(inside, within, 0.0).sum(axis=1)
        return np.where(enough, counts * self._spacing ** len(self._cells) / np.where(enough, filled, 1.0) - 1, 0.0)


def _bounds(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest coordinate along each axis, (d,), of positions (T, n, d)."""
    found = [[(x[:, rows, a].min(), x[:, rows, a].max()) for a in range(x.shape[2])] for rows in parts_of(x.shape[1])]
    bounds = np.array(found, x.dtype)
    return bounds[:, :, 0].min(axis=0), bounds[:, :, 1].max(axis=0)


def times_at_once(cells: Sequence[int]) -> int:
    """Return how many times one `FilledCells` may cover: only one if its cells depend on the particles."""
    return max(1, WHOLE // math.prod(cells))


# Largest rounding error of a stored position, cells.
POSITION_ERROR = 1e-3


class Moment(NamedTuple):
    """The time of a frame, and the steps and loads since the previous frame.

    Attributes:
        index: index of the frame.
        time: time, s.
        step: number of steps so far.
        last_step: size of the last step, s.
        taken: the steps since the previous frame.
        loads: "collider": impulse, N s, and angular impulse, N m s, on each collider since the previous frame, (count,
            k); "contact": the same on the first body of each pair; "rigid": pose relative to the lower corner and rates
            of each rigid body, (count, k); `WORK` and `EXTREMES`. Entries without objects are missing.
        blocked: number of blocked particles of emitters so far.
    """

    index: int
    time: float
    step: int
    last_step: float
    taken: StepsTaken
    loads: Mapping[str, np.ndarray] = {}
    blocked: int = 0


class FrameBuilder:
    """Builds the frames of a run.

    Attributes:
        constants: constant data of the particles.
        columns: the columns that the frames need.
        before: time of the previous frame, s.
    """

    def __init__(
        self, scene: Scene, particles: Sequence[BodyParticles], groups: Sequence, columns: Sequence[str] = ()
    ) -> None:
        """Store the constants of the `RunGroup`s; `columns` are fields whose columns are needed in addition."""
        self._scene = scene
        self.constants = RunConstants(groups, [len(b.position) for b in particles])
        self._flows = any(group.law.flows for group in groups)
        self._names = [name for name in scene.output.fields if name not in ("velocity", "initial_position")]
        internal = max(len(group.law.internal) for group in groups)
        shown = [*self._names, *columns]
        self.columns = FrameColumns(scene.dimension, internal, shown, particle_count_varies=scene.particle_count_varies)
        self._waits = np.array([b.waits for b in particles])
        self._sheets = [b.sheets for b in particles if b.waits]
        self._origin = np.array(scene.domain.origin)
        # Far from zero, single precision does not resolve neighbouring particles; the solver does, because its
        # positions are relative to the origin of the domain.
        farthest = float(np.abs([self._origin, scene.domain.upper]).max())
        coarse = farthest * np.finfo(np.float32).eps > POSITION_ERROR * scene.domain.spacing
        self._position_type = np.float64 if coarse or groups[0].real == np.float64 else np.float32
        self.before = 0.0
        self._initial = None
        if "initial_position" in scene.output.fields:
            initial = [b.position if b.initial is None else b.initial for b in particles]
            self._initial = np.concatenate([np.empty((0, scene.dimension)), *initial]).astype(self._position_type)

    def build(
        self, moments: Sequence[Moment], arrays: FrameArrays, sums: Sequence[Sums]
    ) -> list[tuple[Frame, LedgerRow]]:
        """Return frames and ledger rows from the particles and the sums of each law at T moments."""
        scene, constants = self._scene, self.constants
        (times, n), d = arrays.reals.shape[:2], scene.dimension
        position = np.empty((times, n, d), self._position_type)
        velocity = np.empty((times, n, d), arrays.reals.dtype)
        status = np.empty((times, n), np.int8) if scene.particle_count_varies else None
        fields: dict[str, np.ndarray] = {}
        totals = _Totals(scene, arrays["x"], times, self._waits, flows=self._flows)
        for rows in parts_of(n):
            own, same = arrays.of_rows(rows), constants.of_rows(rows)
            ratios = same.volume_ratios(own)
            position[:, rows], velocity[:, rows] = own["x"] + self._origin, own["v"]
            for name, values in same.fields(own, ratios, self._names).items():
                if name not in fields:
                    fields[name] = np.empty((times, n, *values.shape[2:]), values.dtype)
                fields[name][:, rows] = values
            if status is not None:
                status[:, rows] = own["activity"]
                # On the device those that wait have the velocity at which they will enter.
                velocity[:, rows][np.isin(status[:, rows], (WAITING, BLOCKED))] = 0.0
            totals.add(own["x"], ratios, same, constants.body[rows], None if status is None else status[:, rows])
        if self._initial is not None:
            fields["initial_position"] = np.broadcast_to(self._initial, position.shape)
        frames = [
            Frame(
                index=moment.index,
                time=moment.time,
                step=moment.step,
                position=position[t],
                velocity=velocity[t],
                body=constants.body,
                material=constants.material,
                fields={name: fields[name][t] for name in scene.output.fields if name != "velocity"}
                | ({} if status is None else {STATUS: status[t]}),
            )
            for t, moment in enumerate(moments)
        ]
        if scene.output.drop_retired:
            frames = [frame.of_present for frame in frames]
        gravity = np.array([scene.domain.gravity_at(moment.time) for moment in moments])
        last_steps = np.array([moment.last_step for moment in moments])
        spacing = scene.domain.spacing
        conserved = ledger_sums(sums, gravity, spacing, last_steps, affine_moment(scene.solver))
        times, taken = [moment.time for moment in moments], [moment.taken for moment in moments]
        conserved |= totals.entries(constants.masses, [one.passed(times) for one in self._sheets])
        if status is not None:
            conserved["blocked"] = np.array([moment.blocked for moment in moments])
        self._add_loads(moments, conserved, gravity, last_steps)
        return list(zip(frames, ledger_rows(conserved, times, taken), strict=True))

    def _add_loads(
        self,
        moments: Sequence[Moment],
        conserved: dict[str, np.ndarray],
        gravity: np.ndarray,
        last_steps: np.ndarray,
    ) -> None:
        """Add loads and rigid bodies at T moments to the entries of their `LedgerRow`s, by name.

        `gravity` is gravity, m/s^2, (T, d), `last_steps` the last step before each moment, s.
        """
        scene, d = self._scene, self._scene.dimension
        durations = np.diff([self.before, *(moment.time for moment in moments)])
        self.before = moments[-1].time
        for name in moments[0].loads:
            found = np.array([moment.loads[name] for moment in moments])
            if found.ndim == 1:
                conserved[name] = found
            elif name == "rigid":
                found[..., :d] += self._origin
                rates = 3 if d == 2 else 6
                pose, motion = found[..., :-rates], found[..., -rates:]
                conserved |= {"rigid_pose": pose, "rigid_motion": motion}
                free = [collider.moments for collider in scene.colliders if collider.free]
                middle = pose[..., :d] - self._origin - 0.5 * last_steps[:, None, None] * motion[..., :d]
                for j, body in enumerate(free):
                    conserved["kinetic"] = conserved["kinetic"] + body.kinetic(pose[:, j], motion[:, j])
                    conserved["potential"] = conserved["potential"] - body.mass * (middle[:, j] * gravity).sum(axis=1)
            else:
                # There are no loads before frame 0.
                spans = durations[:, None, None]
                found = np.divide(found, spans, where=spans > 0, out=np.zeros_like(found))
                conserved[f"{name}_force"], conserved[f"{name}_torque"] = found[..., :d], found[..., d:]


class _Totals:
    """Ledger entries over all particles at T times; particles are added in parts.

    `x` are the positions of all particles, (T, n, d), m. `waits` is whether the particles of each body belong to an
    emitter, `flows` whether any material flows.
    """

    def __init__(self, scene: Scene, x: np.ndarray, times: int, waits: np.ndarray, *, flows: bool) -> None:
        """Begin the sums; filled cells are counted only if any material `flows`."""
        domain = scene.domain
        self._extent, self._waits = np.array(domain.size), waits
        self._low, self._high = np.full(times, np.inf), np.full(times, -np.inf)
        # Numbers of entered and of retired particles per body.
        self._entered, self._retired = (np.zeros((times, len(waits)), np.int64) for _ in range(2))
        self._particle_count_varies = scene.particle_count_varies
        at_once = 1 if scene.particle_count_varies else times_at_once(domain.cells)
        self._filled = [
            (own, FilledCells(x[own], domain.spacing, domain.cells, domain.periodic))
            for own in (slice(t, t + at_once) for t in range(0, times, at_once) if flows)
        ]

    def add(
        self, x: np.ndarray, ratios: np.ndarray, same: ParticleConstants, body: np.ndarray, status: np.ndarray | None
    ) -> None:
        """Add particles: x, (T, k, d), m, ratios and status, (T, k), body, (k,)."""
        if status is not None:
            self._add_active(x, ratios, same, body, status)
            return
        self._low = np.minimum(self._low, ratios.min(axis=1, initial=np.inf))
        self._high = np.maximum(self._high, ratios.max(axis=1, initial=-np.inf))
        for own, filled in self._filled:
            filled.add(x[own], ratios[own] * same.volume, same.flows)

    def _add_active(
        self, x: np.ndarray, ratios: np.ndarray, constants: ParticleConstants, body: np.ndarray, status: np.ndarray
    ) -> None:
        """Add particles that enter and leave, see `add`; only active ones count in extremes and filled cells."""
        for t, (place, J, state) in enumerate(zip(x, ratios, status, strict=True)):
            active = state == ACTIVE
            self._low[t] = J[active].min(initial=self._low[t])
            self._high[t] = J[active].max(initial=self._high[t])
            # There are no cells beyond an open face.
            seen = active & ((place >= 0) & (place <= self._extent)).all(axis=1)
            for _, filled in self._filled[t : t + 1]:
                filled.add(place[None, seen], (J * constants.volume)[None, seen], constants.flows[seen])
            for counts, own in (
                (self._entered, (state != WAITING) & (state != BLOCKED)),
                (self._retired, state == RETIRED),
            ):
                counts[t] += np.bincount(body[own], minlength=len(self._waits))

    def entries(self, masses: np.ndarray, passed: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Return the entries of `LedgerRow` by name, (T,).

        `masses` are the particle masses of each body, kg, `passed` the particles that passed the mouth of each emitter.
        """
        # Without active particles the volume ratio is 1.
        none = self._low > self._high
        errors = [filled.errors() for _, filled in self._filled]
        found = {
            "volume_ratio_min": np.where(none, 1.0, self._low),
            "volume_ratio_max": np.where(none, 1.0, self._high),
            "volume_error": np.concatenate(errors) if errors else np.zeros(len(none)),
        }
        if self._particle_count_varies:
            emitted, entered = np.zeros_like(self._entered), self._entered * self._waits
            if passed:
                emitted[:, self._waits] = np.minimum(np.transpose(passed), entered[:, self._waits])
            for name, counts in (("emitted", emitted), ("retired", self._retired)):
                found[name], found[f"{name}_mass"] = counts.sum(axis=1), counts @ masses
            found["nozzle_mass"] = (entered - emitted) @ masses
        return found
