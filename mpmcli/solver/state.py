"""The complete state of a run: everything that its next step depends on, saved and loaded as one."""

import math
from collections.abc import Iterator, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
import taichi as ti

from mpmcli.errors import InputError
from mpmcli.solver.external_forces import ExternalForces
from mpmcli.solver.kernels import Kernels
from mpmcli.solver.particle_update import NOT_LOST
from mpmcli.solver.particles import ParticleGroup
from mpmcli.solver.schedule import Schedule
from mpmcli.solver.step_control import StepControl
from mpmcli.solver.volume_relaxation import INTERVAL

# Bytes of a number on the device.
SIZES = {ti.f32: 4, ti.f64: 8, ti.i32: 4}


@dataclass(frozen=True)
class SavedState:
    """A state on the host, as a file can hold it.

    Attributes:
        numbers: plain numbers, lists and dictionaries of them, by name; infinity occurs.
        arrays: of the particles in the order of the device, the tables of the sort and the box of the grid, by name.
    """

    numbers: dict[str, object]
    arrays: Mapping[str, np.ndarray]


class ArraysOnDevice(Mapping[str, np.ndarray]):
    """Arrays of a state that are copied one by one, as they are asked for, before the next step.

    Attributes:
        nbytes: of all of them.
    """

    def __init__(self, fields: Mapping[str, ti.Field], others: Mapping[str, np.ndarray] = MappingProxyType({})) -> None:
        """Name the arrays: those of fields, and others, which are on the host."""
        self._fields, self._others = fields, others
        entries = sum(math.prod(shape_of(field)) * SIZES[field.dtype] for field in fields.values())
        self.nbytes = entries + sum(array.nbytes for array in others.values())

    def __getitem__(self, name: str) -> np.ndarray:
        return self._others[name].copy() if name in self._others else self._fields[name].to_numpy()

    def __iter__(self) -> Iterator[str]:
        yield from self._fields
        yield from self._others

    def __len__(self) -> int:
        return len(self._fields) + len(self._others)


class Progress:
    """What changes in a run beside its particles.

    Attributes:
        time: s, in double precision; step_count: steps taken; last_step: size of the last one, s, 0 before the first.
        speed: bound on the speed of every particle, m/s; courant: cells that the fastest one moved in the last step.
        drift: cells that a particle may have moved since particles were sorted; infinite before the first sort.
        first_stable_step: s, at the start of the run.
        owed: time by which velocities lag behind the middle of the last step, s, after a step that fell steeply.
        unrelaxed: s since volumes were last relaxed, in unrelaxed_steps steps.
        step_control, external_forces: what is known of the bounds on the next step.
    """

    NUMBERS = (
        *("time", "step_count", "last_step", "speed", "courant", "drift", "first_stable_step"),
        *("owed", "unrelaxed", "unrelaxed_steps"),
    )

    def __init__(self, step_control: StepControl, external_forces: ExternalForces) -> None:
        self.step_control = step_control
        self.external_forces = external_forces
        self.begin()

    def begin(self) -> None:
        """Begin a run with the particles that are on the device."""
        self.time = 0.0
        self.step_count = 0
        self.last_step = 0.0
        self.speed = self.step_control.speed
        self.courant = 0.0
        self.drift = math.inf
        self.first_stable_step = 0.0
        self.owed = 0.0
        self.unrelaxed = 0.0
        self.unrelaxed_steps = 0
        self.step_control.begin()

    @property
    def velocity_time(self) -> float:
        """Time to which velocities have advanced, s: the middle of the last step, less what is owed."""
        return self.time - 0.5 * self.last_step - self.owed

    def relaxed_in(self, dt: float) -> float:
        """Count a step of dt, s, and return the time over which it relaxes volumes, s: 0 in all but one of INTERVAL."""
        self.unrelaxed += dt
        self.unrelaxed_steps += 1
        if self.unrelaxed_steps < INTERVAL:
            return 0.0
        relaxed, self.unrelaxed, self.unrelaxed_steps = self.unrelaxed, 0.0, 0
        return relaxed


class State(Progress):
    """The state of a run on its device.

    On the CPU a run that is saved, loaded and continued, on any number of threads, gives the bytes of one that was not.
    """

    def __init__(
        self,
        groups: Sequence[ParticleGroup],
        kernels: Kernels,
        step_control: StepControl,
        external_forces: ExternalForces,
        schedule: Schedule | None = None,
    ) -> None:
        self._schedule = schedule
        self._groups = groups
        self._kernels = kernels
        super().__init__(step_control, external_forces)

    def begin(self) -> None:
        super().begin()
        if self._schedule is not None:
            self._schedule.begin()
        self._kernels.particles.lost.fill(NOT_LOST)
        self._kernels.forget_beyond()

    def save(self) -> SavedState:
        """Copy the state to the host."""
        saved = self.on_device()
        return SavedState(saved.numbers, dict(saved.arrays))

    def on_device(self) -> SavedState:
        """Return the state, whose arrays are copied as they are asked for, before the next step."""
        numbers = {name: getattr(self, name) for name in self.NUMBERS}
        numbers["step_control"] = self.step_control.save()
        numbers["external_forces"] = self.external_forces.save()
        if self._schedule is not None:
            numbers["schedule"] = {name: copy(getattr(self._schedule, name)) for name in self._schedule.STATE}
        if self._groups[0].comes_and_goes:
            numbers["active"] = [group.active for group in self._groups]
        return SavedState(numbers, ArraysOnDevice(self._fields()))

    def load(self, saved: SavedState) -> None:
        """Replace the state by one that was saved, of a solver of the same scene.

        Raises:
            InputError: the saved state has other fields or other numbers of particles or nodes.
        """
        fields = self._fields()
        shapes = {name: shape_of(field) for name, field in fields.items()}
        if shapes != {name: array.shape for name, array in saved.arrays.items()}:
            raise InputError("the saved state belongs to another scene or to another kind of backend.")
        for name, field in fields.items():
            field.from_numpy(saved.arrays[name])
        for name in self.NUMBERS:
            setattr(self, name, saved.numbers[name])
        self.step_control.load(saved.numbers["step_control"])
        self.external_forces.load(saved.numbers["external_forces"])
        for name, value in saved.numbers.get("schedule", {}).items():
            setattr(self._schedule, name, copy(value))
        for group, count in zip(self._groups, saved.numbers.get("active", ()), strict=False):
            group.set_active(count)
        self._kernels.particles.lost.fill(NOT_LOST)
        self._kernels.forget_beyond()
        self._kernels.share_work()

    def _fields(self) -> dict[str, ti.Field]:
        """Return every field of the device that outlives a step, by name."""
        fields = {"grid.box": self._kernels.grid.box}
        for group, order in zip(self._groups, self._kernels.orders, strict=True):
            fields |= {f"{group.law.name}.{name}": field for name, field in group.fields().items()}
            fields[f"{group.law.name}.tile_start"] = order.start
        if self._kernels.colliders is not None:
            fields |= self._kernels.colliders.fields()
        return fields | ({} if self._kernels.contact is None else self._kernels.contact.fields())


def shape_of(field: ti.Field) -> tuple[int, ...]:
    """Return the shape of a field as a numpy array."""
    if isinstance(field, ti.lang.matrix.MatrixField):
        return (*field.shape, field.n) if field.m == 1 else (*field.shape, field.n, field.m)
    return tuple(field.shape)
