"""Numbers of the runs of a batch that expressions read: gravity that varies, and forces."""

from collections.abc import Sequence
from dataclasses import dataclass

import taichi as ti

from mpmcli.scene import Scene
from mpmcli.scene.expression import Tree, names_in
from mpmcli.solver.forces import ForceTerms, gravity_terms
from mpmcli.solver.run_values import DeviceValues, Entries, Place
from mpmcli.solver.time_tables import TimeTables


@dataclass(frozen=True)
class Drives:
    """Gravity and forces as the kernels of a batch compute them; runs for which they are equal share kernels.

    Attributes:
        gravity: along each axis, of the numbers of a run; nothing where it is steady.
        forces: on the particles of each law.
        motions: of each collider that moves, for velocity and spin the place of what depends on time, None of others.
        timed: of each number of a run whether it depends on time.
    """

    gravity: tuple[Tree | Place, ...]
    forces: tuple[ForceTerms, ...]
    motions: tuple[tuple[Place | None, ...], ...]
    timed: tuple[bool, ...]

    @staticmethod
    def of(scene: Scene, members: Sequence[Sequence[int]]) -> "tuple[Drives, list[float | Tree]]":
        """Return those of a scene, and its numbers; `members` are the indices of the bodies of each law."""
        entries = Entries(scene.domain.origin, constant=True)
        gravity = gravity_terms(scene, entries)
        forces = tuple(ForceTerms.of(scene, own, entries, several=True) for own in members)
        moving = [collider.motion.rates for collider in scene.colliders if collider.motion.moves]
        motions = tuple(tuple(entries.placed(tree) if names_in(tree) else None for tree in rates) for rates in moving)
        return Drives(gravity, forces, motions, entries.timed), entries.found


@ti.data_oriented
class BatchValues:
    """The numbers of all runs on the device, and what depends on time in tables.

    Attributes:
        device: the numbers; tables: of those that depend on time, None where none does.
        gravity_varies: whether gravity is among them.
    """

    def __init__(self, drives: Drives, runs: int) -> None:
        timed = [k for k, depends in enumerate(drives.timed) if depends]
        self.device = DeviceValues(runs, len(drives.timed))
        # Each number that depends on time, with its table.
        self.timed = tuple(enumerate(timed))
        self.tables = TimeTables(runs, len(timed)) if timed else None
        # Of the colliders that move: (which, of velocity and spin which, table).
        self.motions = tuple(
            (m, a, timed.index(leaf.index))
            for m, places in enumerate(drives.motions)
            for a, leaf in enumerate(places)
            if leaf is not None
        )
        self.gravity_varies = bool(drives.gravity)
        self.gravity = tuple(
            (leaf.index, timed.index(leaf.index) if leaf.index in timed else -1) for leaf in drives.gravity
        )

    @ti.func
    def set_means(self, w: int, start: ti.f64, end: ti.f64):
        """Set what depends on time in a run to its means over a kick."""
        for table, k in ti.static(self.timed):
            row = w * ti.static(len(self.timed)) + table
            self.device.field[w, k] = ti.cast(self.tables.mean(row, start, end), float)

    @ti.func
    def set_motions(self, w: int, motion: ti.template(), start: ti.f64, end: ti.f64):
        """Set the rates of the colliders of a run that depend on time to their means over a step."""
        for m, a, table in ti.static(self.motions):
            row = w * ti.static(len(self.timed)) + table
            motion.rates[w * ti.static(len(motion.moving)) + m, a] = self.tables.mean(row, start, end)

    @ti.func
    def largest_gravity(self, w: int, start: ti.f64, end: ti.f64):
        """Return a bound on gravity between two times, m/s^2."""
        square = 0.0 * start
        for k, table in ti.static(self.gravity):
            if ti.static(table < 0):
                value = ti.cast(self.device.field[w, k], ti.f64)
                square += value * value
            else:
                value = self.tables.largest(w * ti.static(len(self.timed)) + table, start, end)
                square += value * value
        return ti.sqrt(square)
