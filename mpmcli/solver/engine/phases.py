"""What a step consists of: phases, one after the other, which CPU threads and GPU launches carry out.

The body of a phase is the method of its name: of `cpu_phases.CpuPhases`, for a part of the nodes or particles, and of
`gpu_phases.GpuPhases`, for one of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from mpmcli.materials.law import Law
from mpmcli.quick_taichi import ti


@dataclass(frozen=True)
class Phase:
    """A loop of a step; the next one begins when it is done.

    Attributes:
        name: of its body.
        over: what it runs over: the nodes in use, those on the planes of faces, the particles of a group, or the rows
            of nodes for each collider.
        group: number of the group of particles.
        adds: whether particles add to nodes. Without atomics pencils of one colour after another do.
    """

    name: str
    over: Literal["nodes", "planes", "particles", "loads"]
    group: int = 0
    adds: bool = False


def step_phases(
    laws: Sequence[Law],
    averaged: Sequence[bool],
    *,
    contact: bool,
    friction: bool,
    deterministic: bool = False,
    loads: bool = False,
) -> tuple[Phase, ...]:
    """Return the phases of a step; neighbours of one name that add nothing to nodes may be carried out at once.

    averaged: whether the particles of each law share their change of volume; contact, friction: whether walls let go,
    or rub; deterministic: whether P2G is in fixed point; loads: whether there are colliders, too.
    """
    groups = range(len(laws))
    return (
        Phase("clear", "nodes"),
        *(Phase("average", "particles", g, adds=True) for g in groups if averaged[g]),
        *(Phase("scatter", "particles", g, adds=True) for g in groups),
        *[Phase("settle", "nodes")] * deterministic,
        *(Phase("relax", "particles", g) for g in groups if laws[g].relaxes),
        *[Phase("find_contact", "planes")] * contact,
        *[Phase("find_friction", "planes")] * friction,
        Phase("update", "nodes"),
        *[Phase("book_loads", "loads")] * loads,
        *(Phase("advance", "particles", g) for g in groups),
    )


def sorted_fields(groups: Sequence) -> tuple[tuple[ti.Field, ...], ...]:
    """Return the fields of each group that a sort moves with a particle."""
    return tuple((*group.state, *group.labels) for group in groups)
