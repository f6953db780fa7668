"""The numbers of a run shared by its host and its kernels, each with a name, a type and a writer.

They are stored in arrays with a row for each run of a batch: `numbers`, float64, and `counts`, int32, in memory shared
by host and kernels; and `step`, for the current step, in the precision of particles and only on the device. A line in
RUN or STEP adds a number: kernels and host then access it as `run.name`, and it is saved and loaded.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

from taichi.lang.impl import inside_kernel, subscript

from mpmcli.quick_taichi import ti
from mpmcli.solver.particles.state_bounds import ENTRIES
from mpmcli.stability.transfer_factors import INTERVAL

Columns = int | range | tuple[range, ...]
# Status of a run: idle (free, or waiting for the host); to be measured; advancing; measured, because a bound on its
# step requires it, the target is reached, or no space for frames is left; with lost particles; with a collapsed stable
# step; before a kick that ends beyond its time tables; before a sort with more blocks of nodes than are allocated.
IDLE, MEASURE, GOING, ATTEND, LOST, COLLAPSED, BEYOND, CROWDED = range(8)
# Bounds on the step by their code; of equal ones the lower code is reported, as in a comparison of `Limit`s.
LIMITS = ("", "collider", "deformation", "force", "forced", "maximum", "speed", "viscosity", "wave")
# Numbers of the run that are stored with a frame, as float64, before the sums of each group.
FRAME_NUMBERS = (
    *("time", "step_count", "last_step", "smallest", "smallest_courant", "largest", "largest_courant", "limit"),
    "blocked",
)
# Largest number of frames that a launch records per run.
MOST_FRAMES = 128


class Entry(NamedTuple):
    """One or several numbers of a run under one name.

    Attributes:
        type: float or int.
        writer: "scene", written once per scene; "host", written between launches; or "kernel".
        start: value at time 0; None if the writer sets it before.
        per: "" for one number, or "axis", "group" or "emitter" for one per item; "body" (of each group) and "maximum"
            (of each group, see `state_bounds`) have a range of columns per group.
    """

    type: type
    writer: str
    start: float | None = 0.0
    per: str = ""


def _real(writer: str, start: float | None = 0.0, per: str = "") -> Entry:
    return Entry(float, writer, start, per)


def _int(writer: str, start: float | None = 0, per: str = "") -> Entry:
    return Entry(int, writer, start, per)


RUN: Mapping[str, Entry] = {
    # The scene.
    "spacing": _real("scene"),  # spacing of the grid, m
    "inverse_spacing": _real("scene"),  # 1/m
    "gradient_scale": _real("scene"),  # see `Grid`, 1/m
    "extent": _real("scene", per="axis"),  # size of the domain, m
    "cells": _int("scene", per="axis"),
    "gravity": _real("scene", per="axis"),  # gravity at time 0, m/s^2
    "wall_speed": _real("scene"),  # speed of the fastest wall, m/s
    "slowest": _real("scene"),  # lower bound of the speed: that of the fastest emitter, m/s
    "end": _real("scene"),  # time, s
    "frames": _int("scene"),  # number of output times after time 0
    "safety": _real("scene"),  # time.safety
    "maximum": _real("scene", math.inf),  # time.step, s
    "forced": _int("scene"),  # whether the maximum is used even above the stable step
    "collider": _real("scene", math.inf),  # bound on the step by colliders, s
    "capacity": _int("scene", None, "group"),  # particles, including waiting ones
    "sensitivity": _real("scene", per="group"),  # sensitivity of stiffness to strain, see `Law`
    "hardening": _real("scene", per="group"),
    "period": _real("scene", per="emitter"),  # time between two sheets, s
    "until": _real("scene", per="emitter"),  # time from which no sheet enters, s
    "sheets": _int("scene", per="emitter"),  # number of sheets
    # Progress of the run.
    "time": _real("kernel"),  # s
    "step_count": _real("kernel"),
    "last_step": _real("kernel"),  # s
    "kick_carry": _real("kernel"),  # lag of velocities behind the middle of the last step, s
    "speed": _real("kernel"),  # bound on the speed of every particle, m/s
    "courant": _real("kernel"),  # displacement of the fastest node in the last step, cells
    "drift": _real("kernel", math.inf),  # bound on the displacement of particles since the last sort, cells
    "unrelaxed": _real("kernel"),  # time since the last relaxation of volumes, s
    "unrelaxed_steps": _int("kernel", INTERVAL - 1),  # the first step relaxes
    "rate": _real("kernel", per="group"),  # largest rate of deformation in the last step, 1/s
    "particles": _int("kernel", None, "group"),  # active particles
    "blocked": _int("kernel"),  # blocked particles of emitters
    "due": _real("kernel", math.inf),  # time of the next sheet of any emitter, s
    "due_of": _real("kernel", per="emitter"),
    "entered": _int("kernel", per="emitter"),  # number of entered sheets
    "waits": _int("kernel", per="emitter"),  # whether the next layer is blocked
    # Bounds on the next step.
    "stiffness": _real("host", math.inf),  # bound by the laws from the last measurement, s
    "stiffness_limit": _int("host"),  # code of this bound in LIMITS
    "pull": _real("host"),  # bound on the acceleration by forces and steady gravity, m/s^2
    "force": _real("host", math.inf),  # bound by the gradient of forces, s
    "first_stable_step": _real("host"),  # stable step at time 0, s
    "own": _real("host", None, "body"),  # bound by the stiffness of each body, s
    "horizon": _real("host", -math.inf),  # end of the filled time tables, s
    "held": _real("kernel", math.inf),  # the bound with a delayed rise, see `StepSize.limit_rise`, s
    "low": _real("kernel", math.inf),  # the smallest bound in this series of steps, s
    "low_before": _real("kernel", math.inf),  # the smallest bound in the previous series, s
    "held_steps": _real("kernel"),  # steps of this series
    # When to measure the state again.
    "longest": _int("host"),  # largest number of steps between two measurements
    "growth_allowed": _real("host"),  # permitted growth of the logarithm of a stiffness
    "unwatched": _int("kernel", per="group"),  # steps since the last measurement
    "change": _real("kernel", per="group"),  # growth of that logarithm since then, by deformation
    "hardened": _real("kernel", per="group"),  # the same, by hardening
    # Requests of the host.
    "status": _int("host"),
    "target": _real("host"),  # target time, s
    "given": _real("host"),  # a prescribed step, s, 0 if the kernel chooses it
    "budget": _int("host"),  # steps that may be taken in this launch
    "arrived": _int("kernel"),  # whether the target is reached
    # The current step.
    "dt": _real("kernel"),  # s
    "kick": _real("kernel"),  # s
    "stable": _real("kernel"),  # the largest stable step, s
    "relaxed": _real("kernel"),  # time over which volumes relax, s, 0 in most steps
    "steps_to_target": _real("kernel"),  # number of equal steps, including this one
    "deformation": _real("kernel"),  # bound by deformation, s
    "step_limit": _int("kernel"),  # code of the smallest bound, also if the step was given or its rise is held back
    # The steps since the last frame, for the ledger.
    "smallest": _real("kernel", math.inf),  # s
    "smallest_courant": _real("kernel"),  # Courant number of the smallest step
    "limit": _int("kernel"),  # code of the bound of the smallest step
    "largest": _real("kernel"),  # s
    "largest_courant": _real("kernel"),
    # Frames that the kernel records.
    "records": _int("host"),  # whether the kernel records frames
    "frame": _int("kernel"),  # index of the next frame
    "frame_recorded": _int("kernel"),  # whether a frame was recorded and no step taken since
    "recorded": _int("kernel"),  # number of frames recorded in this launch
    "frame_capacity": _int("host"),  # largest number of frames in this launch
    "row": _int("kernel"),  # next row of the frame buffer
    "affine": _int("host"),  # first columns in the frame buffer, -1 if omitted
    "gradient": _int("host"),
    "tau": _int("host"),
    "activity": _int("host"),
    # The last measurement; after all other numbers.
    "maxima": _real("kernel", None, "maximum"),
}
STEP: Mapping[str, Entry] = {
    "spacing": _real("host"),  # spacing of the grid, m
    "inverse_spacing": _real("host"),
    "gradient_scale": _real("host"),
    "extent": _real("host", per="axis"),  # size of the domain, m
    "dt": _real("kernel"),  # s
    "kick": _real("kernel"),  # s
    "stable": _real("kernel"),  # the largest stable step, s
    "relaxed": _real("kernel"),  # time over which volumes relax, s, 0 in most steps
    "gravity": _real("kernel", per="axis"),  # change of velocity by gravity, m/s
    "speed_squared": _real("kernel"),  # squared speed of the fastest node, m^2/s^2
    "rate": _real("kernel", per="group"),  # largest rate of deformation, 1/s
    "volume_change": _real("kernel", per="group"),  # largest change of the logarithm of a volume by relaxation
    "broken": _real("kernel"),  # 1 if the pose of a rigid body is not finite, else 0
}


class Layout:
    """Columns of the arrays for runs in d dimensions with some laws.

    Attributes:
        bodies: number of bodies per law.
        numbers, counts, step: columns of each array by name: one column; a range with a column per axis, group or
            emitter; or a range per group.
        widths: number of columns of each array, by its name.
    """

    def __init__(self, dimension: int, internal: Sequence[int], emitters: int = 0, bodies: Sequence[int] = ()) -> None:
        """Assign columns, given the number of internal variables and of bodies of each law."""
        self.bodies = tuple(bodies)
        several = {"axis": dimension, "group": len(internal), "emitter": emitters}
        of_groups = {"body": self.bodies, "maximum": [ENTRIES + 2 * n for n in internal]}
        self.widths: dict[str, int] = {}

        def columns(array: str, entries: Mapping[str, Entry]) -> dict[str, Columns]:
            found: dict[str, Columns] = {}
            end = 0
            for name, entry in entries.items():
                ranges = []
                for size in of_groups.get(entry.per, [several.get(entry.per, 1)]):
                    ranges.append(range(end, end + size))
                    end += size
                found[name] = tuple(ranges) if entry.per in of_groups else ranges[0] if entry.per else ranges[0].start
            self.widths[array] = end
            return found

        self.numbers = columns("numbers", {name: entry for name, entry in RUN.items() if entry.type is float})
        self.counts = columns("counts", {name: entry for name, entry in RUN.items() if entry.type is int})
        self.step = columns("step", STEP)

    def of_scene(self, array: str) -> list[int]:
        """Return the columns of "numbers" or "counts" that are written once per scene."""
        found = [columns for name, columns in getattr(self, array).items() if RUN[name].writer == "scene"]
        return [k for columns in found for k in ([columns] if isinstance(columns, int) else columns)]


def _entry(array: object, w: object, column: object) -> object:
    """Return a number: an expression in a kernel, otherwise a Python number, or an array for several runs."""
    if inside_kernel():
        return subscript(None, array, w, column)
    found = array[w, column]
    return found if found.ndim else found.item()


class Several:
    """Several numbers of a run under one name, by index."""

    def __init__(self, array: object, w: object, columns: range | tuple[range, ...]) -> None:
        self._array, self._w, self._columns = array, w, columns

    def __getitem__(self, k: object) -> object:
        if isinstance(self._columns, tuple):
            return Several(self._array, self._w, self._columns[k])
        return _entry(self._array, self._w, self._columns.start + k)

    def __setitem__(self, k: int, values: object) -> None:
        columns = self._columns[k]
        self._array[self._w, columns if isinstance(columns, int) else slice(columns.start, columns.stop)] = values

    def __len__(self) -> int:
        return len(self._columns)

    def __iter__(self) -> Iterator[object]:
        return (self[k] for k in range(len(self)))


class _Named:
    """Numbers of run `w` by name, in arrays with tables of columns."""

    def __init__(self, w: object, *tables: tuple[Mapping[str, Columns], object]) -> None:
        self.__dict__.update(w=w, _tables=tables)

    def __getattr__(self, name: str) -> object:
        for columns, array in self.__dict__["_tables"]:
            if name in columns:
                if not isinstance(columns[name], int):
                    return Several(array, self.w, columns[name])
                return _entry(array, self.w, columns[name])
        raise AttributeError(name)

    def __setattr__(self, name: str, values: object) -> None:
        for columns, array in self._tables:
            if name in columns:
                found = columns[name]
                array[self.w, slice(found.start, found.stop) if isinstance(found, range) else found] = values
                return
        raise AttributeError(name)


class RunState(_Named):
    """The numbers of run `w` of a batch, see RUN: rows of arrays on the host, or in a kernel, where `w` is a variable.

    On the host `w` may be `slice(None)`: each number is then an array with an entry per run.
    """

    def __init__(self, layout: Layout, numbers: object, counts: object, w: object) -> None:
        super().__init__(w, (layout.numbers, numbers), (layout.counts, counts))

    @property
    def velocity_time(self) -> object:
        """Time of the velocities, s: the middle of the last step minus their lag."""
        return self.time - 0.5 * self.last_step - self.kick_carry

    def reset(self) -> None:
        """Set all numbers with a start value, on the host."""
        for name, entry in RUN.items():
            if entry.start is not None:
                setattr(self, name, entry.start)


class StepState(_Named):
    """The numbers of the current step of run `w` in a kernel, see STEP; `w` is a variable."""

    def __init__(self, layout: Layout, field: ti.Field, w: object) -> None:
        super().__init__(w, (layout.step, field))
