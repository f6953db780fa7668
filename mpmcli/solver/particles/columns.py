"""The fields of particles, and the columns of them that operations read and write.

A line of `fields_of` adds a field to all that knows them: it is allocated and an attribute of `ParticleArrays`, the
plan counts it, operations read and write it as the column of that name, sorts move it, and states save it.
"""

from typing import Any, NamedTuple

import numpy as np

from mpmcli.quick_taichi import ti


class ParticleField(NamedTuple):
    """A field of particles.

    Attributes:
        name: its name in saved states.
        attribute: of `ParticleArrays`, None if it is not present; the fields of internal variables form a tuple.
        shape: its shape for one particle, () for a number.
        present: whether the group has it.
        kind: float or int.
        lasts: whether it outlives a step, so that sorts move it and states save it.
        columns: the columns that it consists of, if not one with the name of the attribute.
        shown: its name in a plan, if it is another.
    """

    name: str
    attribute: str
    shape: tuple[int, ...]
    present: bool = True
    kind: type = float
    lasts: bool = True
    columns: tuple[str, ...] = ()
    shown: str = ""

    def allocated(self, count: int) -> ti.Field:
        """Return a field for a number of particles."""
        if not self.shape:
            return ti.field(self.kind, shape=count)
        make = ti.Vector.field if len(self.shape) == 1 else ti.Matrix.field
        return make(*self.shape, self.kind, shape=count, layout=ti.Layout.SOA)


def fields_of(group: Any) -> tuple[ParticleField, ...]:
    """Return the fields that particles of `ParticleArrays` may have, in the order of memory, sorts and states."""
    d, stores_F, change = group.dimension, group.law.deformation == "F", {"columns": ("deformation",)}
    return (
        # Position relative to the origin of the domain, m, and velocity, m/s.
        ParticleField("position", "x", (d,)),
        ParticleField("velocity", "v", (d,)),
        # Row a is dv/dx_a, 1/s (the transpose of C), followed by the remainder of x along a, m, if it `carries` one.
        ParticleField("velocity_gradient", "gradient", (d, d + group.carries), columns=("C", "remainder")),
        # F - I or J - 1: the difference from rest, because a step adds strains of 1e-6 and less, which single precision
        # would lose next to 1.
        ParticleField("deformation", "displacement_gradient", (d, d), stores_F, **change, shown="deformation_gradient"),
        ParticleField("deformation", "J_minus_1", (), not stores_F, **change, shown="volume_ratio"),
        *(ParticleField(variable.name, "internal", ()) for variable in group.law.internal),
        # Initial position relative to the origin, m.
        ParticleField("initial_position", "initial", (d,), group.keeps_initial),
        # ln J during P2G, or for a frame the mean of ln J over the cell minus its own; and the cell.
        ParticleField("volume_to_mean", "to_mean", (), group.averages, lasts=False),
        ParticleField("cell", "cell", (), group.averages, int, lasts=False),
        # Growth of ln J in the last step.
        ParticleField("volume_growth", "growth", (), group.evened),
        # The share of its stress that a particle bears, see `easing`.
        ParticleField("borne", "borne", (), group.eased),
        # Slip on the wall that pushes the particle, see `total_solids`.
        ParticleField("slip", "slip", (d,), group.has_wall_friction),
        # The normal to the nearest face of the body, and the depth below it, m, at rest or, if the law projects F, at
        # present, see `contact.surfaces`.
        ParticleField("surface", "carried", (d + 1,), group.surfaced),
        # Row of the particle in every frame, row of the body in the table, and status, see `particles.sort`.
        ParticleField("id", "id", (), kind=int),
        ParticleField("body", "body", (), group.many_bodies, int),
        ParticleField("activity", "activity", (), group.particle_count_varies, int),
    )


class Column(NamedTuple):
    """What an operation reads or writes of a particle, see `loop`.

    Attributes:
        shape: its shape, () for a number.
        entries: for each of its numbers, row by row, a field and the entry of it; empty for the row of the table.
    """

    shape: tuple[int, ...]
    entries: tuple[tuple[ti.Field, tuple[int, ...]], ...]


def columns_of(group: Any) -> dict[str, Column]:
    """Return the columns of `ParticleArrays` by name; those of absent fields have a shape alone."""
    d, gradient, internal = group.dimension, group.gradient, tuple((field, ()) for field in group.internal)
    found = {
        one.attribute: Column(one.shape, tuple((field, place) for place in np.ndindex(one.shape) if field is not None))
        for one, field in ((one, group.held.get(one)) for one in group.known)
    }
    return found | {
        "C": Column((d, d), tuple((gradient, (a, c)) for c, a in np.ndindex(d, d))),
        "remainder": Column((d,), tuple((gradient, (c, d)) for c in range(d) if group.carries)),
        "deformation": found["J_minus_1" if group.displacement_gradient is None else "displacement_gradient"],
        "internal": Column((len(internal),), internal),
        # Kernels have no empty vectors.
        "inner": Column((max(len(internal), 1),), internal),
        "place": found["initial" if group.total else "x"],
        "row": Column((group.table.n,), ()),
    }


@ti.func
def column_of(group: ti.template(), name: ti.template(), p: int):
    """Return the value of a column of particle p."""
    (column,) = ti.static((group.column(name),))
    if ti.static(name == "row"):
        return group.row(p)
    elif ti.static(len(column.shape) == 0):
        return column.entries[0][0][p]
    else:
        value = ti.Matrix.zero(float, *column.shape)
        for entry, place in ti.static(zip(column.entries, np.ndindex(column.shape), strict=False)):
            value[place] = entry_of_field(entry, p)
        return value


@ti.func
def entry_of_field(entry: ti.template(), p: int):
    """Return a number of particle p, given its field and the entry of it."""
    if ti.static(len(entry[1]) == 0):
        return entry[0][p]
    else:
        return entry[0][p][entry[1]]


@ti.func
def set_entry(entry: ti.template(), p: int, number: float):
    if ti.static(len(entry[1]) == 0):
        entry[0][p] = number
    else:
        entry[0][p][entry[1]] = number
